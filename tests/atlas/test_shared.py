"""Many meshes and several states: one lookup texture and one or two colour textures."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from builders.atlas_meshes import sheet
from builders.checks import error_of
from builders.gltf_scene import Thing, box, write_scene

import wlm
from benchmarks.atlas_exact import decode64
from wlm.atlas.data import LightmappedScene, from_arrays, join, load
from wlm.atlas.decode import Decoder
from wlm.atlas.evaluation import compare, evaluate
from wlm.atlas.fit import compress, open_checkpoint
from wlm.atlas.listing import read_listing
from wlm.atlas.model import FIRST_BLOCK_CODE, Profile, pack_tiles, unpack_tiles
from wlm.atlas.shader import glsl
from wlm.atlas.shared import curves, sharing
from wlm.atlas.shared.mixture import find_mixtures, moments
from wlm.atlas.shared.weights import peaks_of, scales, scene_weights, variation
from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.system import Meter

SIDE = 48
QUICK = {"views": 2, "budget": 0.1, "tile": 5}


def _with(sheet, light: np.ndarray) -> LightmappedScene:
    """A sheet's triangles under other lightmaps."""
    return from_arrays(sheet.position, sheet.triangle, sheet.uv, light, sheet.mask, sheet.name)


def lights(shift: float, states: int = 3) -> np.ndarray:
    """A sky that brightens and a lamp that goes out, float32 [M, H, W, 3]."""
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    sky = (1.2 + np.sin(5 * column + shift) * np.cos(4 * row))[..., None] * [0.6, 0.8, 1.0]
    lamp = np.exp(-20 * ((row - 0.3) ** 2 + (column - 0.6) ** 2))[..., None] * [2.0, 1.2, 0.5]
    share = np.linspace(0.1, 1.0, states)
    return np.stack([s * sky + (1 - s) * lamp for s in share]).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """A room with two crates, three states."""
    parts = [box((0, 0, 0), (6, 3, 5), inward=True), box((1, 0, 1), (2, 1, 2)), box((4, 0, 3), (4.2, 0.2, 3.2))]
    return join([from_arrays(*part, lights(i), name=f"part {i}") for i, part in enumerate(parts)], "room")


@pytest.fixture(scope="module")
def model(scene):
    return compress(scene, **QUICK)


def test_light_of_two_sources_has_two_components():
    """Of either of two kinds of tiles, each lit by two sources of its own."""
    random = np.random.default_rng(0)
    source = random.random((2, 6, 2, 3))  # kind, state
    texels = np.einsum("gmkc,gtykc->gtymc", source, random.random((2, 20, 16, 2, 3))).reshape(40, 16, 6, 3)
    light = torch.from_numpy(texels).float()
    moment = moments(light.permute(0, 2, 3, 1), torch.full((40, 16), 1.0 / 640))
    found = find_mixtures(moment.numpy(), texels, 2, 4, seed=0)
    number = found.nearest(moment)
    assert not set(number[:20].tolist()) & set(number[20:].tolist())
    parts = torch.einsum("tmkc,tymc->tykc", found.factor[number], light) + found.offset[number][:, None]
    assert float(parts.min()) > 0.0 and float(parts.max()) > 0.5
    factor = torch.from_numpy(np.stack([found.factors(each) for each in number])).float()
    back = factor[:, None, 0] + torch.einsum("tkmc,tykc->tymc", factor[:, 1:], parts)
    torch.testing.assert_close(back, light, rtol=0, atol=1e-3)


def test_one_table_and_one_texture_for_all(scene, model):
    assert set(model.report["components"]) <= {"1", "2", "3"} and len(model.states) == 3
    assert 0.85 <= model.compression_ratio < 0.95 and model.lut.shape[0] * model.lut.shape[1] < 3 * 11 * 11
    assert sum(model.report["components"].values()) == sum(model.report["tiles"])
    report = evaluate(model, scene, views=3, resolution=48)
    assert report.views == 6 and report.inside_views == 3 and report.eye_height == pytest.approx(0.35 * 3)
    assert report.psnr > 35.0 and report.around_psnr > 35.0 and report.inside_psnr > 35.0
    assert len(report.psnr_by_state) == len(report.peaks) == 3 and min(report.peaks) > 0.5
    # Bits go to what is seen large: the small crate has far fewer samples a tile than the room.
    samples = np.array(model.report["samples"]) / np.array(model.report["tiles"])
    assert samples[2] < 0.6 * samples[0]


def test_the_kernel_reads_what_the_reference_does(scene, model, device):
    random = np.random.default_rng(0)
    uv = random.random((500, 2)).astype(np.float32)
    uv[:4] = [[0, 0], [1, 1], [1, 0], [0.5, 2.0]]
    sheet = random.integers(0, 3, 500)
    decoder = Decoder(model, device)
    for state in range(3):
        points = torch.from_numpy(uv).to(device), torch.from_numpy(sheet).to(device)
        light = decoder.read(*points, state).cpu().numpy()
        np.testing.assert_allclose(light, decode64(model, uv, sheet, state), rtol=1e-3, atol=1e-3)
    middle = 0.5 * (decoder.lightmap(1, 0) + decoder.lightmap(1, 1))
    # What is clipped at 0 in a state is not between two.
    np.testing.assert_allclose(decoder.lightmap(1, 0.5), middle, rtol=1e-4, atol=1e-2)


def test_blocks_of_bc6h_or_none(scene, model, tmp_path):
    """Phones have no blocks."""
    plain = compress(scene, "standard", colour="rgb9e5", views=1, budget=0.2, tile=3)
    assert model.colour == "mixed" and model.report["tiles of blocks"] > 0
    assert plain.colour == "rgb9e5" and not plain.block_texels.size and not plain.report["tiles of blocks"]
    assert "wlm_scene_blocks" in glsl(model) and "wlm_scene_blocks" not in glsl(plain)


@pytest.mark.slow
def test_mips(scene, model, device):
    """Smaller levels: means of charts, in the budget, without a step from one to the next."""
    bare, model = model, compress(scene, views=1, budget=0.3, mips=True)
    assert model.compression_ratio >= 0.7 and [each.width for each in model.levels] == [12, 6, 3, 1] * 3
    decoder = model.decoder(device)
    row, column = np.mgrid[:12, :12].reshape(2, -1)
    uv = torch.from_numpy(np.stack([(column + 0.5) / 12, (row + 0.5) / 12], 1).astype(np.float32)).to(device)
    for number, own in enumerate(scene.sheets):
        mask = own.mask.reshape(12, 4, 12, 4).sum((1, 3))
        for state, frame in enumerate(own.lightmaps):
            sums = (frame * own.mask[..., None]).reshape(12, 4, 12, 4, 3).sum((1, 3))
            means = sums / mask.clip(min=1)[..., None]
            which = torch.full((144,), number, device=device)
            light = decoder.read(uv, which, state, torch.full((144,), 2.0, device=device)).cpu().numpy()
            rest = (light.reshape(12, 12, 3) - means)[mask > 0]
            assert np.sqrt(np.square(rest).mean()) < 0.02 * np.ptp(frame)
    lods = torch.linspace(0.0, 7.0, 701, device=device)
    light = decoder.read(uv[:1].expand(701, 2), torch.zeros(701, device=device), 1.0, lods)
    assert float(light.diff(dim=0).abs().max()) < 0.03 * float(light.max())
    assert torch.equal(light[0], decoder.read(uv[:1], torch.zeros(1, device=device), 1.0)[0])
    with pytest.raises(ValueError, match="lod: expected None for a model without mip levels"):
        bare.decoder().read(uv[:1].cpu(), 0, 0, torch.zeros(1))


def test_mips_of_one_lightmap_are_shared_tiles():
    model = compress(sheet(), views=1, budget=0.4, mips=True, tile=5)
    assert model.method == "shared" and len(model.levels) == 4 and model.compression_ratio >= 0.6
    assert model.profile.budget == 0.4 and Profile.load("standard").checked(2)[0].budget == 0.05
    for settings, words in (
        ({"method": "cascade", "colour": "rgb9e5"}, "method: expected tiles"),
        ({"colour": "astc"}, "colour: expected"),
    ):
        with pytest.raises(WlmError, match=f"{words} .*several lightmaps or mips"):
            compress(sheet(), views=1, mips=True, **settings)


def test_views_of_the_scene_decide(scene):
    """A crate in a closed room is hidden from around, and is seen from inside."""
    varies = variation(scene, peaks_of(scene), "cpu")
    room, crate, small = scene_weights(scene, varies, Profile(name="", views=3), 0, "cpu")
    assert min(crate.sum(), small.sum()) > 0
    per_cell = [each[each > 0].mean() for each in (room, crate, small)]
    assert per_cell[2] < per_cell[1]


def test_states_count_by_what_they_would_lose(scene):
    """At half of its light, a state counts as before; with more edges in it, less."""
    frames = [each.lightmaps.copy() for each in scene.sheets]
    for each in frames:
        each[1] = 0.5 * each[0]
        each[2] = each[0]
        each[2, :, ::8] *= 0.8
    varied = join([_with(each, light) for each, light in zip(scene.sheets, frames, strict=True)])
    peak = peaks_of(varied)
    varies = variation(varied, peak, "cpu")
    unit = scales(varies, [each.mask for each in scene.sheets]) * peak
    assert unit[1] == pytest.approx(0.5 * unit[0], rel=1e-2) and unit[2] > 3.0 * unit[0]


def test_coarse_components(model, device):
    """Of blocks of tiles in blocks: the first components larger, the others one block each."""
    assert model.report["coarse components"] > 0
    first, size, component, count, page, blocks, coarse = unpack_tiles(model.lut, FIRST_BLOCK_CODE)
    assert (coarse <= count).all() and blocks[coarse > 0].all() and (size[coarse > 0].prod(1) > 16).all()
    again = pack_tiles(first, size, component, count, page, blocks, coarse)
    assert (again == model.lut)[count > 0].all()
    # Without them all is the same but for those tiles.
    without = pack_tiles(first, size, component, count - coarse, page, blocks)
    light, rest = (Decoder(dataclasses.replace(model, lut=lut), device).lightmap(0, 0) for lut in (model.lut, without))
    assert 0.01 < (light != rest).any(2).mean() < 0.99


@pytest.fixture(scope="module")
def unlike():
    """A room and a crate under two smooth lights, each finely shadowed in another half, and in the dark."""
    row, column = np.mgrid[:32, :32] / 32
    fine = 0.4 + np.sign(np.sin(60 * column + 9 * np.sin(11 * row)))[..., None] * [0.3, 0.2, 0.3]
    smooth = 1.0 + 0.2 * row[..., None] * [1.0, 0.5, 0.2]
    left = np.where((column < 0.5)[..., None], fine, smooth)
    frames = np.stack([left, left[:, ::-1] ** 2, np.zeros_like(left)]).astype(np.float32)
    parts = [box((0, 0, 0), (6, 3, 5), inward=True), box((1, 0, 1), (2, 1, 2))]
    lit = zip(parts, (frames, frames[:, ::-1]), strict=True)
    return join([from_arrays(*part, light, name=f"part {i}") for i, (part, light) in enumerate(lit)], "unlike")


def test_states_that_have_nothing_in_common_are_apart(unlike, monkeypatch, tmp_path, device):
    """In the same bits they lose less so than with tiles in common."""
    settings = {"views": 1, "budget": 0.3, "tile": 5}
    apart = compress(unlike, mips=True, **settings)
    states, stride = len(unlike.states), len(apart.sheets) + len(apart.levels)
    assert apart.report["separate"] and apart.stride == stride and len(apart.rows) == states * stride
    assert set(apart.report["components"]) == {"1"} and apart.report["components"]["1"] > sum(apart.report["tiles"])
    assert apart.lut.shape[2] == 2 and 1.0 - apart.compression_ratio <= 0.3
    monkeypatch.setattr(sharing, "_choose_sharing", lambda together, *rest: together)
    together = compress(unlike, mips=True, **settings)
    assert not together.later and not together.stride
    psnr = [evaluate(each, unlike, views=3, resolution=48).psnr for each in (apart, together)]
    assert apart.report["expected gain of separate tiles"] > 1.0 and psnr[0] > psnr[1] + 1.0
    # Read as the reference does, whole, kept in a file, and between states and levels.
    random = np.random.default_rng(0)
    uv, sheet = random.random((300, 2)).astype(np.float32), random.integers(0, stride, 300)
    points = torch.from_numpy(uv).to(device), torch.from_numpy(sheet).to(device)
    apart.save(tmp_path / "a.wlm")
    decoder = wlm.load(tmp_path / "a.wlm").decoder(device)
    lights = [decoder.read(*points, state) for state in range(states)]
    for state, light in enumerate(lights):
        expected = decode64(apart, uv, sheet, state)
        np.testing.assert_allclose(light.cpu().numpy(), expected, rtol=1e-3, atol=1e-3)
    assert not lights[2].any()  # black stays black
    torch.testing.assert_close(decoder.read(*points, 0.25), 0.75 * lights[0] + 0.25 * lights[1], rtol=1e-5, atol=1e-6)
    far = torch.full((300,), 9.0, device=device)
    ends = [decoder.read(points[0], points[1] % 2, state, far) for state in (0.0, 1.0, 0.5)]
    torch.testing.assert_close(ends[2], 0.5 * (ends[0] + ends[1]), rtol=1e-5, atol=1e-6)
    assert float((ends[0] - ends[1]).abs().min()) > 0.01
    bare = apart.without_mips()
    near = (points[0], points[1] % 2)
    assert torch.equal(Decoder(bare, device).read(*near, 1.0), decoder.read(*near, 1.0))
    assert len(bare.rows) == states * len(apart.sheets) and not bare.levels and not bare.table()[:, 6].any()
    assert not apart.without_mips().later[0].smaller and not together.without_mips().later


@pytest.mark.slow
def test_a_sample_of_many_tiles_says_whether_apart_comes_near(unlike, monkeypatch):
    monkeypatch.setattr(sharing, "_SAMPLES", 6)
    monkeypatch.setattr(curves, "_RANKS", (1,))
    near = compress(unlike, views=1, budget=0.3)
    assert near.later and near.report["expected gain of separate tiles"] > 0.0
    # All states are one light, brighter and darker.
    sheet = unlike.sheets[0]
    alike = _with(sheet, np.stack([share * sheet.lightmap for share in (1.0, 0.5, 0.2)]))
    far = compress(alike, views=1, budget=0.1)
    assert not far.later and far.report["expected gain of separate tiles"] is None


def files(folder, states=("day", "night")):
    position, triangle, uv = box((0, 0, 0), (2, 2, 2))
    half = uv * [0.5, 1.0]
    things = [Thing("left", position, triangle, [uv, uv]), Thing("right", like=0, translation=(4, 0, 0))]
    things += [Thing("rock", position + [0, 0, 4], triangle, [uv])]
    path = write_scene(folder / "scene.gltf", things)
    for i, state in enumerate(states):
        write_exr(folder / f"{state}.exr", lights(i)[0])
    return path, half


CONVENTIONS = {
    "gltf": lambda n, x: {"node": n, "sheet": 0, "scale_offset": [0.5, 0.75, x, 0.0]},
    "unity": lambda n, x: {
        "node": n,
        "lightmapIndex": 0,
        "lightmapScaleOffset": {"x": 0.5, "y": 0.75, "z": x, "w": 0.25},
    },
    "godot": lambda n, x: {"path": f"Level/{n}", "slice_index": 0, "uv_scale": [x, 0.0, 0.5, 0.75]},
}


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_instances_with_a_rectangle_each(tmp_path, convention):
    path, _ = files(tmp_path)
    objects = [CONVENTIONS[convention](name, x) for name, x in (("left", 0.0), ("right", 0.5))]
    content = {"states": ["day", "night"], "sheets": [{"files": ["day.exr", "night.exr"]}], "objects": objects}
    (tmp_path / "lights.json").write_text(json.dumps(content | {"convention": convention}))
    scene = load(path, tmp_path / "lights.json")
    (sheet,) = scene.sheets
    assert scene.states == ("day", "night") and scene.uv_set == 1 and sheet.lightmaps.shape == (2, SIDE, SIDE, 3)
    assert [(each.label, each.scale_offset[2:]) for each in scene.objects] == [("left", (0, 0)), ("right", (0.5, 0))]
    uv = box((0, 0, 0), (2, 2, 2))[2] * [0.5, 0.75]
    np.testing.assert_allclose(np.sort(sheet.uv, 0), np.sort(np.concatenate([uv, uv + [0.5, 0]]), 0), atol=1e-6)
    assert len(scene.blocker) == 12  # the rock has no lightmap
    if convention != "unity":  # the others give the same scene
        return
    model = compress(scene, views=1, budget=0.3, tile=4)
    model.save(tmp_path / "out.wlm")
    again = wlm.load(tmp_path / "out.wlm")
    assert again.source == scene.source and again.scene.objects == scene.objects
    np.testing.assert_array_equal(again.scene.blocker, scene.blocker)
    for name in ("position", "triangle", "uv", "mask"):
        np.testing.assert_array_equal(getattr(again.scene.sheets[0], name), getattr(sheet, name))
    made = again.bundle()
    assert made.document["objects"][1]["scale_offset"] == [0.5, 0.75, 0.5, 0.0] and made.document["uv_set"] == 1
    assert set(made.textures) >= {"sheets", "lut", "factors", "colour"}


def test_materials_own_lightmaps(tmp_path):
    position, triangle, uv = box((0, 0, 0), (2, 2, 2))

    def material(**more):
        return {"extensions": {"MOZ_lightmap": {"index": 0, "texCoord": 0, "intensity": 2.0} | more}}

    shift = {"extensions": {"KHR_texture_transform": {"scale": [0.5, 0.5], "offset": [0.5, 0.5]}}}
    meshes = ("a", position, triangle, [uv * 0.5]), ("b", position + 3, triangle, [uv])
    things = [Thing(*meshes[0], material=material()), Thing(*meshes[1], material=material(**shift))]
    images = {"textures": [{"source": 0}], "images": [{"uri": "day.exr", "name": "baked"}]}
    path = write_scene(tmp_path / "scene.gltf", things, images)
    write_exr(tmp_path / "day.exr", lights(0)[0])
    scene = load(path)
    assert [each.scale_offset for each in scene.objects] == [(1, 1, 0, 0), (0.5, 0.5, 0.5, 0.5)]
    assert scene.sheets[0].name == "baked" and scene.states == ("light",)
    inside = scene.sheets[0].mask
    np.testing.assert_allclose(scene.sheets[0].lightmap[inside], 2 * lights(0)[0][inside], rtol=1e-3)


def test_what_a_list_of_lightmaps_says_wrong(tmp_path):
    path, _ = files(tmp_path)
    lists = tmp_path / "lights.json"

    def told(**content):
        lists.write_text(json.dumps({"sheets": [{"files": ["day.exr"]}]} | content))
        return error_of(load, path, lists)

    assert "no material has a lightmap (MOZ_lightmap, " in error_of(load, path)
    assert "sheets: expected 2 files each, one per state, found [1]" in told(states=["a", "b"])
    assert "objects[0].sheet: expected 0 to 0, found 3" in told(objects=[{"node": "left", "sheet": 3}])
    assert "node: expected one of left, right, found 'top'" in told(objects=[{"node": "top", "sheet": 0}])
    twice = [{"node": "left", "sheet": 0}, {"node": "left", "sheet": 0, "scale_offset": [1, 1, 0.5, 0]}]
    assert "left is listed twice, with different sheets or rectangles" in told(objects=twice)
    assert "sheets[0]: no triangle of the mesh is lit by it" in told(objects=[])
    godot = {"convention": "godot", "objects": [{"path": "a", "uv_scale": [1, 2]}]}
    assert "objects[0].uv_scale: expected 4 numbers, found [1, 2]" in told(**godot)
    lists.write_text(json.dumps({"lightmaps": [{"time_hours": 6, "file": "day.exr"}], "mesh": "scene.glb"}))
    assert read_listing(lists).states == ("6 h",)
    write_exr(tmp_path / "small.exr", lights(0)[0][:20])
    assert "small.exr: expected 48x48 texels, the size of the sheet's first lightmap, found 48x20" in told(
        sheets=[{"files": ["day.exr", "small.exr"]}]
    )


def test_hard_cases_of_a_scene(tmp_path):
    """Overlapping charts, charts without area, one of one texel, and light that is black."""
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    tiny = uv.copy()
    tiny[:4] = [0.5, 0.5]  # without area
    tiny[4:8] = 0.25 + 0.2 / SIDE * (tiny[4:8] - tiny[4:8].min(0)) * [3, 2]  # within a texel
    black = np.zeros((3, SIDE, SIDE, 3))
    uvs, light = (0.3 + 0.4 * (uv % [1 / 3, 0.5]), tiny, uv), (lights(0), lights(1), black)
    parts = [from_arrays(position, triangle, *each) for each in zip(uvs, light, strict=True)]
    model = compress(scene := join(parts), views=1, budget=0.4, tile=3)
    decoder = Decoder(model)
    assert not decoder.lightmap(2, 1).any()
    score = compare(scene, {"it": decoder}, views=2, resolution=32)["it"]
    assert score.psnr > 35.0
    dark = compress(_with(parts[0].sheets[0], black), views=1, budget=0.4, tile=3)
    assert not Decoder(dark).lightmap(0, 2).any()


@pytest.mark.slow
def test_an_interrupted_compression_goes_on_to_the_same_bytes(scene, model, tmp_path, monkeypatch):
    """Numbers of components that are done are not done again."""
    monkeypatch.setattr(Meter, "due", lambda self, done: True)
    output = tmp_path / "a.wlm"

    def stop(report):
        if report.stage == "curves" and 3 * report.done >= report.total > 0:
            raise KeyboardInterrupt

    options = {"seed": 0, "every": 0.0, **QUICK}
    with pytest.raises(KeyboardInterrupt):
        compress(scene, checkpoint=open_checkpoint(output, scene, **options), progress=stop, **QUICK)
    kept = open_checkpoint(output, scene, resume=True, **options)
    assert kept.resumed
    again = compress(scene, checkpoint=kept, **QUICK)
    for name in ("texels", "blocks", "lut", "factor"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
