"""Reading tiles: against float64, at every border, and at coordinates that are NaN or infinite."""

import numpy as np
import pytest
import warp as wp

from benchmarks.atlas_exact import decode64
from kernels.compare import array, close
from wlm.atlas.model import AtlasModel, Profile, SheetPlace
from wlm_kernels.atlas import decode


def _table(height: int, width: int, size: int, largest: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random rectangles of a random texture: T_c uint16 [ty, tx, 2], and T_p half [40, 30, 3]."""
    random = np.random.default_rng(seed)
    counts = [max(1, -(-(n - 1) // size)) for n in (height, width)]
    sides = random.integers(1, largest + 1, (*counts, 2))
    first = random.integers(0, np.array([30, 40]) - sides + 1)
    return (first * 16 + sides - 1).astype(np.uint16), random.random((40, 30, 3)).astype(np.float16)


def _decode(uv, height: int, width: int, size: int, lut: np.ndarray, texels: np.ndarray, device: str) -> np.ndarray:
    uv = array(np.asarray(uv, np.float32), wp.vec2, device)
    out = wp.full(len(uv), wp.vec3(-1.0), dtype=wp.vec3, device=device)
    decode.decode(uv, height, width, size, array(lut, wp.uint16, device), array(texels[None], wp.vec3h, device), out)
    return out.numpy()


def _exact(uv, height: int, width: int, size: int, lut: np.ndarray, texels: np.ndarray) -> np.ndarray:
    place = SheetPlace("a", height, width, 0, 0, *lut.shape[:2])
    settings = "a", "0", Profile(name="a", tile=size), "tiles", "half", ("0",), (place,)
    return decode64(AtlasModel(*settings, texels[None], lut=lut), uv)


def _inside(height: int, width: int, size: int, count: int = 400) -> np.ndarray:
    """Random coordinates, float32 [N, 2], none within 1e-3 texels of a border, where rounding picks the tile."""
    uv = np.random.default_rng(1).random((4 * count, 2)).astype(np.float32)
    place = (uv.astype(np.float64) * [width, height] - 0.5) / size
    near = np.abs(place - np.rint(place)).min(1) < 1e-3
    return uv[~near][:count]


@pytest.mark.parametrize(
    ("height", "width", "size", "largest"),
    [(40, 57, 7, 8), (29, 29, 7, 8), (300, 500, 15, 16), (5, 200, 3, 4), *((*of, 4, 5) for of in ((1, 9), (9, 1)))],
)
def test_against_reference(device: str, height: int, width: int, size: int, largest: int):
    """Grids whose last tile ends within the lightmap, at its end and beyond it; one row, one column, one texel."""
    lut, texels = _table(height, width, size, largest)
    uv = _inside(height, width, size)
    assert len(uv) > 100
    want = _exact(uv, height, width, size, lut, texels)
    close(_decode(uv, height, width, size, lut, texels, device), want, 2e-4)
    one_sample = (height, width) == (1, 1) or largest == 1
    assert (np.ptp(want, 0) == 0).all() if one_sample else np.ptp(want, 0).min() > 0.01


def test_ends(device: str):
    """0 and 1, all beyond them, and infinity are the outermost texels' centres."""
    height, width, size = 29, 36, 7
    lut, texels = _table(height, width, size, 8)
    ends = {0.0: 0.0, 1.0: 1.0, -3.0: 0.0, 4e9: 1.0, 3e38: 1.0, np.inf: 1.0, -np.inf: 0.0}
    uv = np.array([(a, b) for a in ends for b in ends], np.float32)
    want = _exact([(ends[a], ends[b]) for a in ends for b in ends], height, width, size, lut, texels)
    close(_decode(uv, height, width, size, lut, texels, device), want, 1e-6)
    corner = [texels[lut[j, i, 1] // 16 + e * (lut[j, i, 1] % 16), lut[j, i, 0] // 16 + f * (lut[j, i, 0] % 16)]
              for j, e in ((0, 0), (-1, 1)) for i, f in ((0, 0), (-1, 1))]  # fmt: skip
    got = _decode([[0, 0], [1, 0], [0, 1], [1, 1]], height, width, size, lut, texels, device)
    np.testing.assert_allclose(got, np.array(corner, np.float32), atol=1e-6)


def test_not_a_number(device: str):
    """NaN on either axis gives NaN, and reads nothing out of range; its neighbours are as without it."""
    height, width, size = 29, 36, 7
    lut, texels = _table(height, width, size, 8)
    uv = _inside(height, width, size, 50)
    want = _decode(uv, height, width, size, lut, texels, device)
    uv[3, 0] = uv[5, 1] = np.nan
    uv[7] = np.nan
    got = _decode(uv, height, width, size, lut, texels, device)
    broken = np.isin(np.arange(50), [3, 5, 7])
    assert np.isnan(got[broken]).all()
    np.testing.assert_array_equal(got[~broken], want[~broken])


def test_exact_tiles_meet(device: str):
    """Tiles that hold every texel make the lightmap, also across their borders, where either tile may be taken."""
    height, width, size = 15, 22, 7
    image = np.random.default_rng(2).random((height, width, 3)).astype(np.float16)
    rows, columns = 2, 3
    texels = np.zeros((rows * 8, columns * 8, 3), np.float16)
    lut = np.empty((rows, columns, 2), np.uint16)
    for j in range(rows):
        for i in range(columns):
            texels[8 * j : 8 * j + 8, 8 * i : 8 * i + 8] = image[7 * j : 7 * j + 8, 7 * i : 7 * i + 8]
            lut[j, i] = 8 * i * 16 + 7, 8 * j * 16 + 7
    y, x = np.mgrid[:height, :width]
    centre = np.stack([(x + 0.5) / width, (y + 0.5) / height], -1).reshape(-1, 2)
    got = _decode(centre, height, width, size, lut, texels, device)
    np.testing.assert_allclose(got, image.reshape(-1, 3).astype(np.float32), atol=3e-6)
    # On both sides of each border between tiles, a ten thousandth of a texel off.
    v = np.linspace(0.1, 0.9, 40)
    for border in (7, 14):
        sides = [
            _decode(np.stack([np.full(40, u), v], 1), height, width, size, lut, texels, device)
            for u in ((border + 0.5 - 1e-4) / width, (border + 0.5 + 1e-4) / width)
        ]
        np.testing.assert_allclose(*sides, atol=5e-4)
        assert np.ptp(sides[0], 0).min() > 0.3


def test_entries_at_the_end_of_their_range(device: str):
    """The last texel that 12 bits can name, and 16 samples a side."""
    texels = np.zeros((1, 4096, 3), np.float16)
    texels[0, -16:] = np.arange(16)[:, None]
    lut = np.array([[[4080 * 16 + 15, 0]]], np.uint16)
    uv = np.stack([(np.linspace(0, 15, 31) + 0.5) / 16, np.zeros(31)], 1)
    got = _decode(uv, 16, 16, 15, lut, texels, device)
    np.testing.assert_allclose(got, np.repeat(np.linspace(0, 15, 31)[:, None], 3, 1), atol=1e-5)
