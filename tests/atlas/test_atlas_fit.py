"""Compressing: the budget, hard cases, the fallback, stages, and quality against smaller lightmaps."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, constant, sheet, soft, triangle

from wlm.atlas.coverage import covered_texels
from wlm.atlas.data import from_arrays
from wlm.atlas.decode import Decoder
from wlm.atlas.evaluation import compare
from wlm.atlas.fit import compress
from wlm.atlas.model import COLOUR_BITS, Profile, tile_counts, unpack_entries
from wlm.atlas.tiles.layout import layout, sizes_of
from wlm.atlas.views import Points
from wlm.atlas.weights import FineGrid, weights
from wlm.errors import WlmError

FEW = {"views": 2, "fallback": False}
PLAIN = Profile(name="half")  # half floats, as the cascade has them
HALF = PLAIN.override(FEW)
CODECS = (Profile.load("astc").override({"colour": "bc6h"}), "astc")
NAMES = (PLAIN, "standard", *CODECS)


def psnr(model, mesh) -> float:
    """Of the texels in the mask."""
    target = mesh.sheets[0].lightmap[mesh.sheets[0].mask].astype(np.float64)
    error = Decoder(model).lightmap()[mesh.sheets[0].mask] - target
    return 10 * np.log10(np.ptp(target) ** 2 / np.mean(error**2))


def downsampled(mesh, share: float) -> float:
    """PSNR of the texels of a smaller lightmap at as many bits."""
    from benchmarks.rivals.atlas import downsampling

    row, column = np.nonzero(mesh.sheets[0].mask)
    uv = torch.tensor(np.stack([column + 0.5, row + 0.5], 1) / mesh.sheets[0].mask.shape[::-1], dtype=torch.float32)
    zeros = torch.zeros(len(uv), dtype=torch.int64)
    decoded = downsampling(mesh, share).decoded(Points(uv, zeros.int(), zeros, torch.zeros(len(uv), 3)), 0)
    target = mesh.sheets[0].lightmap[mesh.sheets[0].mask].astype(np.float64)
    return 10 * np.log10(np.ptp(target) ** 2 / np.mean((decoded.numpy() - target) ** 2))


def checked(model, mesh) -> np.ndarray:
    """Checks invariants of any model; returns the lightmap that it decodes to."""
    rows, columns = model.texels.shape[1:3]
    texel_bits = {"half": 64, "rgb9e5": 32, "mixed": 32}
    bits = rows * columns * texel_bits.get(model.colour, 0) or -(-rows // 4) * -(-columns // 4) * 128
    bits += model.blocks.size * 8 * (model.colour == "mixed")
    share = (bits + model.lut.size * 16) / (mesh.sheets[0].mask.size * 48)
    assert share == pytest.approx(1.0 - model.compression_ratio) and share <= model.profile.budget
    assert model.texels.dtype == np.float16 and np.isfinite(model.texels).all() and (model.texels >= 0).all()
    if model.method == "tiles":
        first, size, blocks = unpack_entries(model.lut, model.first_block_code)
        last = np.where(
            blocks & (model.colour == "mixed"), model.block_texels.shape[2:0:-1], model.texels.shape[2:0:-1]
        )
        assert (first + size <= last).all()
        assert model.lut.shape[:2] == tile_counts(*mesh.sheets[0].mask.shape, model.profile.tile)
    else:
        assert not model.lut.size and not model.uv.size
    decoded = Decoder(model).lightmap()
    assert np.isfinite(decoded).all() and not decoded[~mesh.sheets[0].mask].any()
    return decoded


@pytest.mark.parametrize(("name", "size"), [*((name, (40, 48)) for name in NAMES), ("standard", (33, 95))])
def test_the_budget_is_kept(name: str, size: tuple[int, int]):
    """CR of eq. 9 is at least the one asked for, and not much more."""
    profile = Profile.load(name).override(FEW)
    mesh = sheet(lambda place: soft(place) + 0.3 * np.sin(place.sum(-1, keepdims=True) * 90) ** 2, *size)
    model = compress(mesh, profile)
    checked(model, mesh)
    assert model.method == "tiles" and model.colour == profile.colour
    assert 1.0 - model.compression_ratio > 0.8 * model.profile.budget


def test_it_beats_a_smaller_lightmap():
    mesh = sheet(height=96, width=96)
    model = compress(mesh, HALF)
    assert psnr(model, mesh) > downsampled(mesh, 1.0 - model.compression_ratio) + 3.0
    assert model.report["seconds"].keys() == {"weights", "curves", "allocate", "solve", "write"}
    assert model.report["samples"] <= model.texels.shape[1] * model.texels.shape[2]


def test_room_for_all_is_exact():
    """With a budget for every texel only the half floats round, where all texels count alike."""
    mesh = sheet(height=36, width=43)
    model = compress(mesh, HALF, budget=1.8, unseen=1.0, border=1.0)
    decoded = checked(model, mesh)
    np.testing.assert_allclose(decoded, mesh.sheets[0].lightmap, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("name", [PLAIN, "standard"])
def test_one_colour(name: str):
    """Of half floats one sample per tile, and no error beyond rounding."""
    mesh, exact = charts(constant(0.7, 0.2, 0.0)), name is PLAIN
    model = compress(mesh, name, **FEW, budget=0.3)
    error = {"rtol": 6e-4, "atol": 1e-6} if exact else {"rtol": 0.02, "atol": 2e-3}
    inside = mesh.sheets[0].mask
    np.testing.assert_allclose(checked(model, mesh)[inside], mesh.sheets[0].lightmap[inside], **error)
    assert not exact or model.report["samples"] == model.report["tiles"] == model.report["constant tiles"]


def test_darkness():
    """Two methods without an error: with the fallback the simpler one."""
    mesh = charts(constant(0.0, 0.0, 0.0))
    for fallback, method in ((False, "tiles"), (True, "plain")):
        model = compress(mesh, HALF, fallback=fallback, tile=5)
        assert model.method == method and not checked(model, mesh).any()


@pytest.mark.parametrize(("height", "width"), [(16, 16), (8, 64), (5, 7)])
def test_one_triangle(height: int, width: int):
    """Tiles that it doesn't touch have no samples."""
    mesh = triangle(height=height, width=width)
    model = compress(mesh, HALF, budget=0.6)
    checked(model, mesh)
    assert model.report["tiles"] <= model.report["of tiles"] == np.prod(model.lut.shape[:2])
    if width == 64:
        assert model.report["tiles"] < model.report["of tiles"]


def test_a_triangle_below_a_texel():
    """Hardly seen, but lit."""
    corner = np.array([[0.501, 0.501], [0.505, 0.501], [0.501, 0.505]])
    image = np.full((16, 16, 3), 0.25, np.float32)
    mesh = from_arrays(np.insert(corner, 2, 0.0, 1), np.array([[0, 1, 2]]), corner, image, name="speck")
    decoded = checked(compress(mesh, HALF), mesh)
    np.testing.assert_allclose(decoded[mesh.sheets[0].mask], 0.25)


@pytest.mark.parametrize("name", [PLAIN, pytest.param("cascade", marks=pytest.mark.slow)])
def test_charts_that_overlap_have_no_area_or_one_texel(name: str):
    """Beside a square that has none of this: it is decoded as well as alone, and they to finite light."""
    square = np.array([[0.1, 0.1], [0.6, 0.1], [0.6, 0.6], [0.1, 0.6]])
    speck = 0.8 + 0.5 / 40 * np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    line = np.array([[0.9, 0.1], [0.9, 0.5], [0.9, 0.5], [0.9, 0.1]])
    uv = np.concatenate([square, square + 0.1, speck, line])
    position = np.concatenate([np.insert(square, 2, height, 1) for height in range(4)])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    row, column = np.mgrid[:40, :40] / 40
    image = np.stack([1 + np.sin(4 * column), 1 + np.cos(3 * row), 1 + column * row], 2).astype(np.float32)
    mesh = from_arrays(position, np.concatenate([faces + 4 * i for i in range(4)]), uv, image)
    text = " ".join(mesh.warnings)
    assert "their UVs overlap" in text and "without area" in text and mesh.sheets[0].mask[32, 32]
    extra = {"steps": 20, "resolution": 64} if name == "cascade" else {"budget": 0.5}
    decoded = Decoder(compress(mesh, name, views=2, **extra)).lightmap()
    error = np.abs(decoded - image)[mesh.sheets[0].mask]
    assert error.max() < 0.5 and np.sqrt(np.square(error).mean()) < 0.05


@pytest.mark.parametrize("texels", [(1, 40), (40, 1), (4, 4)])
def test_small_lightmaps(texels: tuple[int, int]):
    """Of one tile, or of tiles a texel high; less than a tile is better as it is."""
    mesh = sheet(soft, *texels)
    model = compress(mesh, HALF, budget=2.0, fallback=True)
    np.testing.assert_allclose(checked(model, mesh), mesh.sheets[0].lightmap, atol=3e-3)
    assert model.method == "plain" or texels != (4, 4)


@pytest.mark.parametrize("name", ["standard", "astc"])
def test_bright_light(name: str):
    """Near the end of half floats: a lamp in a dark room."""

    def light(place):
        return 0.01 + 60000.0 * np.exp(-((place - 0.5) ** 2).sum(-1, keepdims=True) / 0.01) * [1.0, 0.9, 0.8]

    mesh = sheet(light, 64, 64)
    model = compress(mesh, name, **FEW)
    decoded = checked(model, mesh)
    assert psnr(model, mesh) > 30.0
    assert decoded.max() == pytest.approx(mesh.sheets[0].lightmap.max(), rel=0.1)


def test_parts_that_no_view_shows_stay_in_range():
    """One view shows three sides at most, and none the chart within the cube."""
    mesh = charts(height=96, width=128)
    profile = HALF.override({"views": 1})
    weight = weights(mesh, FineGrid(mesh.sheets[0], "cpu"), profile, 0).numpy()
    decoded = checked(compress(mesh, profile), mesh)
    light = mesh.sheets[0].lightmap[mesh.sheets[0].mask]
    low, high = light.min(), light.max()
    assert decoded[mesh.sheets[0].mask].min() >= low - 0.3 * (high - low) and decoded.max() <= high + 0.3 * (high - low)
    # The chart within lies in the lower row, third from the left.
    row, column = np.nonzero(mesh.sheets[0].mask)
    within = (row >= 48) & (column >= 64) & (column < 96)
    error = np.abs(decoded - mesh.sheets[0].lightmap).mean(2)[row, column]
    assert error[within].mean() < 0.1 * (high - low)
    coarse = weight.reshape(96, 2, 128, 2).sum((1, 3))[row, column]
    centre = covered_texels(mesh.sheets[0].uv, mesh.sheets[0].triangle, 96, 128).numpy()[row, column] > 0
    assert (coarse[centre] > 0).all() and centre.mean() > 0.9
    assert coarse[within].mean() < 0.2 * coarse[~within].mean()


def test_weights_follow_the_views_and_the_borders():
    """A border of a chart counts more, what has no triangle not at all."""
    mesh = charts(height=48, width=64)
    grid = FineGrid(mesh.sheets[0], "cpu")
    plain, bordered = (weights(mesh, grid, HALF.override({"border": border}), 0).numpy() for border in (1.0, 5.0))
    assert plain.shape == (96, 128) and (plain >= 0).all()
    ratio = bordered[plain > 0] / plain[plain > 0]
    assert set(np.unique(np.round(ratio, 6))) == {1.0, 5.0}
    assert not bordered[plain == 0].any() and (plain == 0).any()
    # The middle of the first side, three texels and more from its border.
    middle = np.s_[20:28, 12:20]
    np.testing.assert_array_equal(plain[middle], bordered[middle])


def test_a_budget_without_room_for_tiles():
    """It is an error that names both, or with the fallback the smaller lightmap that has room."""
    mesh = charts()
    for name, budget in ((PLAIN, 0.001), ("standard", 0.001), *((name, 0.02) for name in CODECS)):
        with pytest.raises(
            WlmError, match=rf"budget: {budget:g} of the bits of 64x48 texels is less than the"
        ) as caught:
            compress(mesh, name, **FEW, budget=budget)
        assert "\n" not in str(caught.value)
        model = compress(mesh, name, views=2, budget=budget)
        assert model.method == "plain" and model.report["why plain"] == "tiles do not fit the budget"
        assert 1.0 - model.compression_ratio <= budget


@pytest.mark.parametrize("colour", ["half", "bc6h", "mixed"])
def test_the_packed_texture_has_room(colour: str):
    """Gaps between tiles count too; where even the smallest tiles can't be packed there is nothing."""
    sizes = sizes_of(Profile(name="a", colour=colour))
    sides, cost, packed = np.array([(size.nx, size.ny) for size in sizes]), np.array([size.bits for size in sizes]), 0
    second = np.array([size.second for size in sizes])
    for seed in range(24):
        random = np.random.default_rng(seed)
        count = int(random.integers(1, 300))
        error = random.random(count) ** 4 * np.exp(-cost / cost.min() / random.uniform(5, 40))[:, None]
        room = count * cost.min() * random.uniform(1.0, 1.6)
        result = layout(error, sizes, room, 0.0)
        if result is None:
            continue
        packed += 1
        shapes = result.shapes + ((0, 0),) * (2 - len(result.shapes))
        bits = [
            np.prod(shape) * COLOUR_BITS[each] for shape, each in zip(shapes, (sizes[0].format, "bc6h"), strict=True)
        ]
        assert sum(bits) <= room
        last = np.array(shapes)[second[result.chosen].astype(int), ::-1]
        assert (result.first + sides[result.chosen] <= last).all()
    assert packed > 14


@pytest.mark.parametrize("name", CODECS)
def test_tiles_of_blocks(name: str):
    """No block holds two tiles; sizes are chosen by the error after the codec; `texels` are the decoded blocks."""
    from wlm.atlas import colour

    mesh = sheet(height=90, width=70)
    model = compress(mesh, name, **FEW)
    decoded = colour.decode(model.blocks[0], *model.texels.shape[1:3], model.colour)
    np.testing.assert_array_equal(model.texels[0], decoded.astype(np.float16))
    assert psnr(model, mesh) > 30.0
    first, size, _ = unpack_entries(model.lut, model.first_block_code)
    assert not (first % 4).any() and not (size % 4).any()
    rows, columns = -(-model.texels.shape[1] // 4), -(-model.texels.shape[2] // 4)
    assert model.blocks.shape == (1, rows * columns, 16)
    owner = np.zeros((rows, columns), int)
    for (x, y), (w, h) in zip(first.reshape(-1, 2) // 4, size.reshape(-1, 2) // 4, strict=True):
        owner[y : y + h, x : x + w] += 1
    assert owner.max() == 1


CASES = [(name, kind) for name in NAMES for kind in ("soft", "noise", "stripes")]
FAST = [("standard", "soft"), (PLAIN, "noise")]


@pytest.mark.parametrize(
    ("name", "kind"), [case if case in FAST else pytest.param(*case, marks=pytest.mark.slow) for case in CASES]
)
def test_the_fallback_is_the_better_one(name: str, kind: str):
    """Between tiles and a smaller lightmap of as many bits: never worse than the tiles, as the mesh is seen."""
    random = np.random.default_rng(0).random((64, 64, 3))
    stripes = (np.arange(64) % 4 < 2)[None, :, None] + 0.1
    light = {"soft": soft, "noise": lambda place: random, "stripes": lambda place: stripes * np.ones((64, 64, 3))}
    mesh = charts(light[kind], 64, 64)
    tiles, model = (compress(mesh, name, views=2, tile=6, fallback=fallback) for fallback in (False, True))
    ratio = model.report["error against a plain lightmap of as many bits"]
    assert model.method == ("tiles" if ratio < 1.0 else "plain")
    checked(model, mesh)
    scores = compare(mesh, {"tiles": Decoder(tiles), "either": Decoder(model)}, views=8, resolution=64)
    assert scores["either"].psnr >= scores["tiles"].psnr - 0.3
    if kind == "soft" and name == "standard":
        assert model.method == "tiles"


def test_progress_names_the_stages():
    for settings, stages in (
        (HALF.override({"fallback": True}), ["weights", "curves", "allocate", "solve", "write", "compare"]),
        ("paper", ["cluster", "compare patches", "cluster", "pack", "regenerate", "fit", "write"]),
    ):
        reports = []
        compress(sheet(), settings, progress=reports.append, steps=2, resolution=64)
        assert [stage for stage, _ in groupby(report.stage for report in reports)] == stages


def test_on_every_device(device: str):
    """Not the same bits, but the same worth."""
    mesh = sheet(height=64, width=64)
    model, reference = compress(mesh, HALF, device=device), compress(mesh, HALF)
    assert psnr(model, mesh) == pytest.approx(psnr(reference, mesh), abs=0.2)


def test_light_that_a_small_budget_loses_is_said():
    mesh = sheet()
    lightmap = mesh.sheets[0].lightmap.copy()
    lightmap[20, 20] = 1e4
    changed = replace(mesh, sheets=(replace(mesh.sheets[0], lightmaps=lightmap[None]),))
    report = compress(changed, PLAIN, views=4, unseen=1.0, budget=0.02).report
    first, second = report["lost light"]
    assert "1 texel among the brightest of the lightmap lost more than half" in first and "of 1e+04 decodes" in first
    assert "most of the lightmap, are off by more than half of their own light" in second
    assert "lost light" not in compress(mesh, PLAIN, views=4).report
