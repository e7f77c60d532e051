"""Reading sets of several sheets: every stated behaviour of `wlm.lightmap.data`."""

import tempfile

import numpy as np
import pytest
from builders.checks import error_of
from builders.layered_sets import write_set_json, write_unity
from PIL import Image

import wlm
from wlm.formats import scratch
from wlm.formats.channels import read_channels
from wlm.formats.exr import read_exr, write_exr, write_part
from wlm.lightmap.data import Layer, LightmapSet, from_layers

RGB = ("R", "G", "B")


def values_of(lightmaps: LightmapSet, atlas: str, layer: str) -> np.ndarray:
    """The values of a layer, [T, H, W, C]."""
    chosen = [item for item in lightmaps.sheets.items() if (item[0].atlas, item[0].layer) == (atlas, layer)]
    return np.concatenate([sheet.to_values(own.frames) for sheet, own in chosen], axis=3)


def test_unitys_folders_are_states_of_atlases(tmp_path):
    write_unity(tmp_path / "scene", hours=(0.0, 12.0))
    (tmp_path / "scene" / "day_0h" / "ReflectionProbe-0.exr").write_bytes(b"no lightmap")
    lightmaps = wlm.lightmap.load(tmp_path / "scene")
    labels = [sheet.label for sheet in lightmaps.sheets]
    assert labels == [f"Lightmap-{n}/{rest}" for n in (0, 1) for rest in ("light RGB", "dir RGB", "dir A")]
    assert lightmaps.times.tolist() == [0.0, 12.0] and lightmaps.name == "scene" and not lightmaps.warnings
    for i, hour in enumerate((0, 12)):
        for atlas in ("Lightmap-0", "Lightmap-1"):
            state = tmp_path / "scene" / f"day_{hour}h"
            light = read_exr(state / f"{atlas}_comp_light.exr")[0][..., :3]
            np.testing.assert_array_equal(values_of(lightmaps, atlas, "light")[i], light)
            levels = np.asarray(Image.open(state / f"{atlas}_comp_dir.png")) / 255.0
            np.testing.assert_allclose(values_of(lightmaps, atlas, "dir")[i], levels, atol=1e-7)
    for sheet, own in lightmaps.sheets.items():
        # The light's alpha is the mask of its atlas; that of the directions is one of their channels.
        assert not own.mask[:3].any() and own.mask[3:].all(), sheet
    one = wlm.lightmap.load(tmp_path / "scene" / "day_12h", mask="all", layers=["dir"])
    assert one.times.tolist() == [0.0] and {sheet.layer for sheet in one.sheets} == {"dir"}
    assert all(own.mask.all() for own in one.sheets.values())


def test_a_plain_folder_stays_one_whatever_lies_beside_it(tmp_path):
    write_unity(tmp_path / "scene")
    write_exr(tmp_path / "scene" / "light_03h.exr", np.full((4, 5, 3), 0.5))
    lightmaps = wlm.lightmap.load(tmp_path / "scene")
    assert len(lightmaps.sheets) == 1 and lightmaps.times.tolist() == [3.0]


def test_states_that_differ_are_one_line(tmp_path):
    folder = tmp_path / "scene"
    write_unity(folder, hours=(0.0, 12.0))
    late = folder / "day_12h"
    (late / "Lightmap-1_comp_dir.png").rename(late / "Lightmap-1_comp_shadowmask.png")
    text = error_of(wlm.lightmap.load, folder)
    assert "day_12h has no Lightmap-1_comp_dir, but day_0h has it" in text and "--layers" in text
    assert len(wlm.lightmap.load(folder, layers=["light"]).sheets) == 2
    assert "expected some of light, dir, got 'ao'" in error_of(wlm.lightmap.load, folder / "day_0h", layers=["ao"])
    (late / "Lightmap-1_comp_shadowmask.png").rename(late / "Lightmap-1_comp_dir.png")
    write_exr(late / "Lightmap-0_comp_light.exr", np.ones((4, 12, 4)))
    assert "is 12x4, but" in error_of(wlm.lightmap.load, folder)
    write_unity(tmp_path / "other", hours=(3.0, 9.0))
    dark = tmp_path / "other" / "day_9h"
    light = read_exr(dark / "Lightmap-1_comp_light.exr")[0]
    write_exr(dark / "Lightmap-1_comp_light.exr", np.concatenate([light[..., :3], 0 * light[..., :1]], 2))
    text = error_of(wlm.lightmap.load, dark)
    assert "no texel is valid (the alpha of the light; --mask all takes all)" in text
    for name in ("day_3h", "day_9h"):
        (tmp_path / "other" / name).rename(tmp_path / "other" / name[:-1])
    text = error_of(wlm.lightmap.load, tmp_path / "other")
    assert "give 2 times with --times, in the order day_3, day_9" in text


def test_a_set_names_layers_channels_and_slices(tmp_path):
    """Four layers of Godot's, stacked; directions in an EXR of more than RGB; a second atlas of another size."""
    random = np.random.default_rng(0)
    stacked = random.random((4 * 6, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "stacked.exr", stacked, half=False)
    names = ("x.R", "x.G", "y.R", "B", "G", "R")
    planes = {name: random.uniform(-1.0, 1.0, (6, 8)).astype(np.float32) for name in names}
    write_part(tmp_path / "more.exr", planes, read_channels)
    small = random.random((3, 5, 3)).astype(np.float32)
    write_exr(tmp_path / "small.exr", small, half=False)
    Image.fromarray(np.uint8([[0, 255, 255, 0, 128]] * 3)).save(tmp_path / "grey.png")
    mask = np.zeros((6, 8), np.uint8)
    mask[1:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    layers = {"L0": "radiance", "L1": "unit", "dir": {"encoding": "signed", "channels": ["x.G", "y.R"]}}
    first = {name: {"file": "stacked.exr", "slice": i, "slices": 4} for i, name in ((0, "L0"), (2, "L1"))}
    second = {"L0": "small.exr", "L1": "grey.png", "dir": "small.exr"}
    path = write_set_json(
        tmp_path,
        layers=layers,
        atlases={"big": {"width": 8, "height": 6, "mask": "mask.png"}, "small": {}},
        lightmaps=[{"time_hours": 3.0, "files": {"big": first | {"dir": "more.exr"}, "small": second}}],
    )
    assert "layer dir: expected a channel x.G, found R, G, B" in error_of(wlm.lightmap.load, path)
    chosen = wlm.lightmap.load(path, layers=["L0", "L1"])
    np.testing.assert_array_equal(values_of(chosen, "big", "L0")[0], stacked[:6])
    np.testing.assert_array_equal(values_of(chosen, "big", "L1")[0][1:], stacked[12:18][1:])
    np.testing.assert_array_equal(values_of(chosen, "small", "L0")[0], small)
    assert values_of(chosen, "small", "L1").shape == (1, 3, 5, 1)
    assert [own.mask.sum() for own in chosen.sheets.values()] == [40, 40, 15, 15]
    write_part(tmp_path / "order.exr", dict.fromkeys(("A", "B", "BA", "G", "R"), planes["R"]), read_channels)
    assert read_channels(tmp_path / "order.exr")[1] == ("R", "G", "B", "A", "BA")
    layers["dir"]["channels"] = ["G", "R"]
    both = write_set_json(
        tmp_path,
        layers=layers,
        atlases={"big": {}},
        lightmaps=[{"time_hours": 3.0, "files": {"big": first | {"dir": "more.exr"}}}],
    )
    directions = values_of(wlm.lightmap.load(both), "big", "dir")[0]
    np.testing.assert_allclose(directions, np.stack([planes["G"], planes["R"]], -1), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"layers": {}}, "layers: expected an object of layers"),
        ({"layers": {"light": "srgb"}}, "layers.light.encoding: expected one of radiance, unit, signed"),
        ({"layers": {"light": {"encoding": "unit", "channels": []}}}, "layers.light.channels"),
        ({"layers": {"a\nb": "unit"}}, "printable"),
        ({"atlases": None}, "atlases is missing"),
        ({"atlases": {"0": {"width": 3, "height": 4}}}, "a.exr: is 5x2, but"),
        ({"atlases": {"0": {"width": 3}}}, "atlases.0.height is missing"),
        ({"atlases": {"0": {}, "1": {}}}, "lightmaps[0].files.1 is missing"),
        ({"atlases": {"0": {"mask": "alpha"}}}, "expected a channel A"),
        ({"lightmaps": [{"time_hours": 1.0, "files": {"0": {}}}]}, "lightmaps[0].files.0.light is missing"),
        ({"lightmaps": [{"time_hours": 1.0, "file": "a.exr"}]}, "lightmaps[0].files is missing"),
        ({"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": "../a.exr"}}}]}, "found ../a.exr; trust=True"),
        ({"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": "a.png"}}}]}, "expected a lightmap, EXR"),
        (
            {"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": {"file": "a.exr", "slice": 2, "slices": 2}}}}]},
            "slice: expected a whole number from 0 to 1",
        ),
        (
            {"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": {"file": "a.exr", "slice": 0, "slices": 3}}}}]},
            "expected 3 slices of one height, found 2 rows",
        ),
        ({"layers": {"light": {"encoding": "unit", "channels": ["R"] * 2}}}, "each channel of a layer once"),
        ({"layers": {"light": {"encoding": "unit", "channels": ["R", "G", "B"] * 2}}}, "each channel of a layer once"),
    ],
)
def test_a_wrong_set_is_one_line(tmp_path, changes, words):
    write_exr(tmp_path / "a.exr", np.ones((2, 5, 3)))
    Image.fromarray(np.zeros((2, 5, 3), np.uint8)).save(tmp_path / "a.png")
    assert words in error_of(wlm.lightmap.load, write_set_json(tmp_path, **changes))


def test_values_beyond_their_range_are_clamped_and_told():
    frames = np.zeros((1, 2, 4, 3))
    frames[0, 0] = [[-1.0, 0.0, 1.0], [-1.5, 0.5, 2.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.25]]
    frames[0, 1] = -7.0
    mask = np.array([[True] * 4, [False] * 4])
    lightmaps = from_layers([Layer(frames, "dir", encoding="signed")], [0.0], {"0": mask}, name="set")
    values = values_of(lightmaps, "0", "dir")[0, 0]
    np.testing.assert_array_equal(values[:2], [[-1.0, 0.0, 1.0], [-1.0, 0.5, 1.0]])
    assert values[2:].tolist() == [[-1.0, 0.5, 1.0]] * 2, "the nearest finite texel's"
    first, second = lightmaps.warnings
    assert "0/dir RGB: 1 texel beyond -1 to 1" in first and "2 texels NaN or infinite" in second


def test_twelve_channels_and_no_more():
    layers = [Layer(np.full((1, 4, 4, 6), 0.5), name, encoding="unit") for name in "ab"]
    lightmaps = from_layers(layers, [0.0])
    assert [sheet.channels for sheet in lightmaps.sheets] == [("0", "1", "2"), ("3", "4", "5")] * 2
    more = Layer(np.zeros((1, 4, 4, 1)), "c")
    assert "at most 12 channels, found 13" in error_of(from_layers, [*layers, more], [0.0])
    other = Layer(np.zeros((1, 5, 4, 1)), "c", "1")
    assert len(from_layers([*layers, other], [0.0]).sheets) == 5
    wrong = Layer(np.zeros((1, 5, 4, 1)), "c")
    assert "0/c R is 4x5, but atlas 0 is 4x4" in error_of(from_layers, [*layers, wrong], [0.0])
    # Not the second in place of the first.
    assert "0/b: expected each channel of a layer once" in error_of(from_layers, [*layers, layers[1]], [0.0])


def test_names_of_arrays_are_those_that_a_file_can_have():
    frames = np.ones((1, 4, 4, 3))
    for options in ({"name": ""}, {"atlas": "a" * 129}, {"channels": ["R", "G", "\n"]}):
        assert "1 to 128 printable characters" in error_of(from_layers, [Layer(frames, **options)], [0.0])
    assert next(iter(from_layers([Layer(frames, channels=["x", "y", "z"])], [0.0]).sheets)).channels == tuple("xyz")
    masks = {"b": np.ones((4, 4), bool)}
    assert "masks: expected those of atlases" in error_of(from_layers, [Layer(frames)], [0.0], masks)


def test_sheets_that_are_large_together_lie_in_a_file(tmp_path, monkeypatch):
    write_unity(tmp_path / "scene", atlases=1)
    whole = wlm.lightmap.load(tmp_path / "scene")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(scratch, "IN_MEMORY", 2 * whole.sheets[next(iter(whole.sheets))].frames.nbytes)
    mapped = wlm.lightmap.load(tmp_path / "scene")
    assert [own.frames.base is not None for own in mapped.sheets.values()] == [False, False, True]
    assert mapped.source == whole.source
