"""Rivals of a compressed lightmap of a mesh: sizes, known answers, budgets, and errors."""

import math

import numpy as np
import pytest
import torch
from builders.lit_cube import HEIGHT, WIDTH, lit_cube, waves

from benchmarks.rivals.atlas import RIVALS, block_codec, downsampling, share_of
from wlm.atlas.data import from_arrays
from wlm.atlas.evaluation import compare
from wlm.atlas.resize import resized
from wlm.atlas.views import Points
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5
from wlm.ops import raster

FULL = np.ones((HEIGHT, WIDTH), bool)


def _sheet(lightmap, mask=None):
    """A square that shows the whole lightmap."""
    position = np.array([[-1, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]], np.float64)
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float64)
    return from_arrays(position, np.array([[0, 1, 2], [2, 1, 3]]), uv, lightmap, mask, name="sheet")


def _read(rival, mesh):
    """What the rival decodes to at the lightmap's texels, float64 [H, W, 3]; for meshes whose triangles don't count."""
    height, width = mesh.sheets[0].mask.shape
    y, x = np.mgrid[:height, :width] + 0.5
    uv = torch.tensor(np.stack([x / width, y / height], -1).reshape(-1, 2), dtype=torch.float32)
    none = torch.zeros(len(uv), dtype=torch.int32)
    light = rival.decoded(Points(uv, none, none.long(), torch.zeros(len(uv), 3)), 0)
    return light.numpy().astype(np.float64).reshape(height, width, 3)


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("share", [0.17, 0.5])
def test_every_one_within_its_budget(name, share):
    mesh = lit_cube(2)
    result = RIVALS[name](mesh, share)
    # "astc" is the block of its choice.
    assert result.name.startswith(name) and result.encode_seconds > 0.0
    used = share_of(result, mesh)
    assert used == result.bytes * 8 / (HEIGHT * WIDTH * 48)
    # All it can: at least the budget less one row, column or rank of blocks, or its own size.
    sizes = {"bc6h": 8, "bc6h own": 8, "astc": 8, "astc4x4": 8, "astc6x6": 3.84, "astc8x8": 2}
    most = sizes.get(name, 32) / 48
    assert min(share, most) * 0.8 < used <= share
    report = compare(mesh, {"it": result.decoded}, views=2, resolution=48)["it"]
    assert report.psnr > 25.0


FILTERS = ("fit", "box")


def small(image, mask, height, width, filter="fit"):
    return resized(image.astype(np.float32), mask, height, width, filter).numpy()


@pytest.mark.parametrize("filter", FILTERS)
def test_resizing_keeps_one_colour_and_the_size(filter):
    one = np.full((HEIGHT, WIDTH, 3), 0.7, np.float32)
    for height, width in ((HEIGHT, WIDTH), (31, 47), (5, 3), (1, 1)):
        result = small(one, FULL, height, width, filter)
        assert result.dtype == np.float64
        np.testing.assert_allclose(result, np.full((height, width, 3), np.float32(0.7)), rtol=1e-9)
    np.testing.assert_array_equal(small(waves(), FULL, HEIGHT, WIDTH, filter), waves())


def test_halves_by_hand():
    line = np.array([[1.0, 3.0, 4.0, 8.0, 9.0, 5.0]])
    image = np.repeat(np.repeat(line, 2, 0)[..., None], 3, 2)
    mask = np.ones((2, 6), bool)
    halves = ((1, 3), [2.0, 6.0, 7.0]), ((1, 2), [8 / 3, 22 / 3]), ((2, 4), [5 / 3, 11 / 3, 25 / 3, 19 / 3])
    for size, expected in halves:
        np.testing.assert_allclose(small(image, mask, *size, "box")[0, :, 0], expected)


def test_the_fit_has_the_least_squares():
    """Against NumPy's least squares on a small texture; and better than every filter where the mask is."""
    random = np.random.default_rng(4)
    image = (3.0 + waves(12, 15) + random.uniform(0.0, 0.2, (12, 15, 3))).astype(np.float32)
    mask = np.zeros((12, 15), bool)
    mask[1:11, 2:13] = True
    size = (5, 6)
    fitted = small(image, mask, *size)
    columns = []
    for number in range(30):
        unit = np.zeros((30, 3), np.float32)
        unit[number] = 1.0
        texture = torch.tensor(unit.reshape(*size, 3))
        y, x = (np.argwhere(mask) + 0.5).T / np.array([[12], [15]])
        columns.append(raster.texture(texture, torch.tensor(np.stack([x, y], 1), dtype=torch.float32)).numpy()[:, 0])
    matrix = np.stack(columns, 1).astype(np.float64)

    def squares(texels):
        return ((matrix @ texels.reshape(30, 3) - image[mask]) ** 2).sum()

    best, *_ = np.linalg.lstsq(matrix, image[mask].astype(np.float64), rcond=None)
    assert squares(best) <= squares(fitted) < squares(best) * 1.01
    assert squares(fitted) < 0.9 * squares(small(image, mask, *size, "box"))
    # Texels that nothing in the mask reads keep the box filter's value.
    unread = ~matrix.any(axis=0)
    box = small(image, mask, *size, "box")
    assert not unread.all()
    np.testing.assert_allclose(fitted.reshape(30, 3)[unread], box.reshape(30, 3)[unread])


@pytest.mark.parametrize("bilinear", [False, True])
def test_what_is_in_the_gaps_counts_for_nothing(bilinear):
    mask = FULL.copy()
    mask[10:40, 20:70] = False
    other = waves()
    other[~mask] = 60000.0
    clean, dirty = (downsampling(_sheet(image, mask), 0.3, bilinear) for image in (waves(), other))
    np.testing.assert_array_equal(_read(clean, _sheet(waves())), _read(dirty, _sheet(waves())))


def test_downsampling_keeps_the_shape_and_never_enlarges():
    mesh = _sheet(waves())
    small = downsampling(mesh, 1 / 6)
    assert small.size == (HEIGHT // 2, WIDTH // 2) and share_of(small, mesh) == pytest.approx(1 / 6)
    for share in (2 / 3, 3.0):
        whole = downsampling(mesh, share)
        assert whole.size == (HEIGHT, WIDTH) and share_of(whole, mesh) == pytest.approx(2 / 3)
        np.testing.assert_allclose(_read(whole, mesh), unpack_rgb9e5(pack_rgb9e5(waves())), rtol=2e-6)
    thin = _sheet(np.repeat(waves(1, 50), 1, 0))
    assert downsampling(thin, 0.335).size == (1, 25) and downsampling(thin, 0.02).size == (1, 1)
    # More texels, less error.
    errors = [np.abs(_read(downsampling(mesh, share), mesh) - waves()).mean() for share in (0.05, 0.2, 0.6)]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("codec", ["bc6h", "astc4x4", "astc8x5", "astc12x12"])
def test_blocks(codec):
    light = waves()[..., :1] * np.array([1.0, 0.8, 0.5], np.float32)
    mesh = _sheet(light)
    whole = block_codec(mesh, 1.0, codec)
    width, height = (4, 4) if codec == "bc6h" else map(int, codec[4:].split("x"))
    assert whole.size == (HEIGHT, WIDTH) and whole.name == codec
    assert whole.bytes == math.ceil(WIDTH / width) * math.ceil(HEIGHT / height) * 16
    # 2% of the mean; 3% with the largest blocks. Blocks in any other order are 30% off.
    assert np.abs(_read(whole, mesh) - light).mean() < 0.03
    small = block_codec(mesh, 0.01, codec)
    assert 0.005 < share_of(small, mesh) <= 0.01 and small.size[0] < HEIGHT
    odd = _sheet(light[:13, :10])
    assert block_codec(odd, 20.0, codec).size == (13, 10)
    assert np.abs(_read(block_codec(odd, 20.0, codec), odd) - light[:13, :10]).mean() < 0.03
