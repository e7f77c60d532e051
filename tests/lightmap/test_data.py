"""Reading and checking sets of one and of several sheets: every stated behaviour of `wlm.lightmap.data`."""

import json
import shutil
import tempfile
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from builders.checks import error_of
from builders.layered_sets import write_set_json, write_unity
from builders.small_sets import load_sheet as load
from builders.small_sets import sheet_from_arrays as from_arrays
from builders.textures import make_dds, make_ktx2
from PIL import Image

import wlm
from wlm.formats import scratch
from wlm.formats.channels import read_channels
from wlm.formats.exr import read_exr, write_exr, write_planes
from wlm.formats.hours import hours_of_names
from wlm.formats.light import read_light
from wlm.lightmap.data import Layer, LightmapSet, from_layers, parse_times

HEIGHT, WIDTH = 5, 7
TIMES = (0.0, 6.5, 18.55)
FILES = ("a.exr", "b.exr", "c.exr")
DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"


def _frames(count: int = len(TIMES), channels: int = 3) -> np.ndarray:
    """Makes frames that half floats hold exactly, no two texels alike."""
    shape = (count, HEIGHT, WIDTH, channels)
    return (np.arange(1, np.prod(shape) + 1, dtype=np.float32) / 64.0).reshape(shape)


def _write_set(folder: Path, frames: np.ndarray, **changes: object) -> Path:
    """Writes a set with float32 files; a change to None takes the key out of set.json."""
    for name, frame in zip(FILES, frames, strict=False):
        write_exr(folder / name, frame, half=False)
    content: dict[str, object] = {
        "name": "tiny",
        "width": WIDTH,
        "height": HEIGHT,
        "period_hours": 24,
        "lightmaps": [{"time_hours": t, "file": f} for t, f in zip(TIMES, FILES, strict=True)],
    }
    content.update(changes)
    content = {key: value for key, value in content.items() if value is not None}
    path = folder / "set.json"
    path.write_text(json.dumps(content))
    return path


def _save_mask(path: Path, mask: np.ndarray, mode: str = "L") -> None:
    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).convert(mode).save(path)


def test_set_json_and_its_folder_are_read_alike(tmp_path):
    frames = _frames()
    path = _write_set(tmp_path, frames)
    for source in (path, str(path), tmp_path):
        lightmaps = load(source)
        assert (lightmaps.name, lightmaps.period, lightmaps.warnings) == ("tiny", 24.0, ())
        np.testing.assert_array_equal(lightmaps.frames, frames)
        np.testing.assert_array_equal(lightmaps.times, TIMES)
        types = lightmaps.frames.dtype, lightmaps.times.dtype, lightmaps.mask.dtype
        assert types == (np.float32, np.float64, bool)
        assert lightmaps.mask.all() and lightmaps.mask.shape == (HEIGHT, WIDTH)


def test_optional_fields_may_be_absent(tmp_path):
    lightmaps = load(_write_set(tmp_path, _frames(), name=None, period_hours=None))
    assert (lightmaps.name, lightmaps.period) == (tmp_path.name, None)


def test_times_and_period_given_replace_those_of_the_set(tmp_path):
    path = _write_set(tmp_path, _frames())
    lightmaps = load(path, times=[1, 2, 30], period=40)
    np.testing.assert_array_equal(lightmaps.times, [1, 2, 30])
    assert lightmaps.period == 40.0
    assert "2 times for 3 lightmaps" in error_of(load, path, times=[1, 2])


def test_source_names_pixels_times_and_mask(tmp_path):
    frames, mask = _frames(), np.ones((HEIGHT, WIDTH), bool)
    base = from_arrays(frames, TIMES, mask).source
    assert len(base) == 16 and int(base, 16) >= 0
    assert load(_write_set(tmp_path, frames)).source == base
    brighter, other = frames.copy(), mask.copy()
    brighter[2, 4, 6, 2] += 1.0
    other[0, 0] = False
    changed = [from_arrays(brighter, TIMES, mask), from_arrays(frames, (0, 6.5, 19), mask)]
    changed.append(from_arrays(frames, TIMES, other))
    assert len({base, *(each.source for each in changed)}) == 4


@pytest.mark.parametrize("mode", ["L", "1", "RGB", "P", "RGBA"])
def test_mask_png_of_any_mode(tmp_path, mode):
    mask = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3 == 0
    _save_mask(tmp_path / "mask.png", mask, mode)
    lightmaps = load(_write_set(tmp_path, _frames(), mask="mask.png"))
    np.testing.assert_array_equal(lightmaps.mask, mask)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[1, 2, 0] = picture[3, 4, 2] = 1  # any colour and any level
    Image.fromarray(picture).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(load(tmp_path).mask, picture.any(axis=2))


def test_mask_argument_replaces_that_of_the_set(tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[1, 2] = True
    other = tmp_path / "elsewhere.png"
    _save_mask(other, mask)
    path = _write_set(tmp_path, _frames(), mask="missing.png")
    np.testing.assert_array_equal(load(path, mask=other).mask, mask)
    assert load(path, mask="all").mask.all()
    assert "missing.png" in error_of(load, path)


def test_mask_from_alpha_may_differ_by_frame(tmp_path):
    frames = _frames(channels=4)
    frames[..., 3] = 1.0
    frames[0, 0, 0, 3] = 0.0
    frames[2, 3, 4, 3] = -1.0
    frames[:, 1, 1, 3] = 0.0
    frames[1, 2, 2, 3] = 0.25
    lightmaps = load(_write_set(tmp_path, frames, mask="alpha"))
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[1, 1] = False
    np.testing.assert_array_equal(lightmaps.mask, expected)
    np.testing.assert_array_equal(lightmaps.covered, frames[..., 3] > 0)
    assert "2 texels are valid in only some lightmaps" in lightmaps.warnings[0]
    # What a frame lacks is the nearest frame's; the rest is as it was.
    for i in range(len(frames)):
        assert np.array_equal(lightmaps.valid(i), frames[i, ..., 3] > 0)
        assert np.array_equal(lightmaps.frames[i][lightmaps.valid(i)], frames[i, ..., :3][lightmaps.valid(i)])
    for i, y, x in ((0, 0, 0), (2, 3, 4)):
        apart = np.abs(lightmaps.times - lightmaps.times[i])
        apart = np.minimum(apart, lightmaps.period - apart) if lightmaps.period else apart
        apart[i] = np.inf
        assert np.array_equal(lightmaps.frames[i, y, x], frames[np.argmin(apart), y, x, :3])


@pytest.mark.parametrize(("period", "taken"), [(None, 6.0), (24.0, 22.0)])
def test_what_a_frame_lacks_comes_from_the_nearest_in_time(period, taken):
    times = (1.0, 6.0, 22.0)
    frames = np.ones((3, 4, 4, 3)) * np.array(times)[:, None, None, None]
    mask = np.ones((3, 4, 4), bool)
    mask[0, 2, 2] = False
    frames[0, 2, 2] = np.nan
    lightmaps = from_arrays(frames, times, mask, period)
    assert (lightmaps.frames[0, 2, 2] == taken).all() and lightmaps.mask.all()
    assert len(lightmaps.warnings) == 1 and lightmaps.source != from_arrays(lightmaps.frames, times).source


def test_mask_errors(tmp_path):
    path = _write_set(tmp_path, _frames(), mask="mask.png")
    _save_mask(tmp_path / "mask.png", np.ones((HEIGHT, WIDTH + 1), bool))
    message = error_of(load, path)
    assert "mask.png" in message and "8x5" in message and "7x5" in message
    _save_mask(tmp_path / "mask.png", np.zeros((HEIGHT, WIDTH), bool))
    assert "mask is empty" in error_of(load, path)
    (tmp_path / "mask.png").write_bytes(b"no picture")
    assert "mask.png: cannot read the mask" in error_of(load, path)


def test_repairs_are_made_everywhere_and_counted_inside_the_mask(tmp_path):
    frames, mask = _frames(), np.ones((HEIGHT, WIDTH), bool)
    mask[:, 0] = False
    frames[0, 0, 0] = frames[1, 0, 0, 0] = np.nan
    frames[0, 1, 0] = -5.0
    frames[0, 1, 1], frames[0, 1, 2, 0] = (-1.0, 2.0, -3.0), -1e-6
    frames[0, 4, 4], frames[0, 4, 5] = (60_000.0, 65_504.0, 0.0), (70_000.0, 1.0, 1e30)
    frames[1, 2, 1, 2] = np.nan  # nearest finite inside: not column 0, which is outside
    frames[1, 2, 2:4, 0] = np.inf
    frames[2, 4, 6, 1] = -np.inf
    given = frames.copy()
    lightmaps = from_arrays(frames, TIMES, mask)
    np.testing.assert_array_equal(frames, given)  # the caller's array is left alone
    assert tuple(lightmaps.frames[1, 2, 1]) in {tuple(frames[1, 1, 1]), tuple(frames[1, 3, 1])}
    assert tuple(lightmaps.frames[2, 4, 6]) in {tuple(frames[2, 3, 6]), tuple(frames[2, 4, 5])}
    expected = np.clip(np.where(np.isfinite(frames).all(-1, keepdims=True), frames, 0.0), 0.0, 65_504.0)
    expected[1, 2, 1:4], expected[2, 4, 6] = lightmaps.frames[1, 2, 1:4], lightmaps.frames[2, 4, 6]
    np.testing.assert_array_equal(lightmaps.frames, expected)
    told = [text.partition(": ")[2] for text in lightmaps.warnings]
    assert told[:2] == ["2 texels negative: clamped to 0", "1 texel above 65,504: clamped to it"]
    assert told[2].startswith("3 texels NaN or infinite") and told[3].startswith("1 texel NaN or infinite")
    frames[1, :, 1:] = np.nan
    assert "frame 1 (time 6.5)" in error_of(from_arrays, frames, TIMES, mask)


def test_repair_takes_neighbours_as_they_are_after_clamping():
    frames = np.zeros((1, 1, 3, 3))
    frames[0, 0] = [[-4.0, 1e6, 1.0], [np.nan, 0.0, 0.0], [-4.0, 1e6, 1.0]]
    lightmaps = from_arrays(frames, [0.0])
    np.testing.assert_array_equal(lightmaps.frames[0, 0, 1], (0.0, 65_504.0, 1.0))


def test_unsorted_times_are_sorted_with_their_frames(tmp_path):
    frames = _frames()
    entries = [{"time_hours": t, "file": f} for t, f in zip((12, 3, 20), FILES, strict=True)]
    lightmaps = load(_write_set(tmp_path, frames, lightmaps=entries))
    np.testing.assert_array_equal(lightmaps.times, [3, 12, 20])
    np.testing.assert_array_equal(lightmaps.frames, frames[[1, 0, 2]])
    assert len(lightmaps.warnings) == 1 and "sorted" in lightmaps.warnings[0]


def test_equal_times_name_both_files(tmp_path):
    entries = [{"time_hours": t, "file": f} for t, f in zip((3, 5, 3), FILES, strict=True)]
    message = error_of(load, _write_set(tmp_path, _frames(), lightmaps=entries))
    assert "a.exr and c.exr" in message and "3" in message


@pytest.mark.parametrize("time", [24.0, -0.5, float("nan"), float("inf")])
def test_time_outside_the_period_or_not_finite_is_an_error(time):
    assert "the time of frame 1 (time" in error_of(from_arrays, _frames(), [0, time, 2], period=24.0)
    if np.isfinite(time):
        assert time in from_arrays(_frames(), [0, time, 2]).times


@pytest.mark.parametrize("period", [0.0, -24.0, float("nan"), float("inf")])
def test_bad_period_is_an_error(period):
    assert "expected a finite period above 0" in error_of(from_arrays, _frames(), TIMES, period=period)


def test_sizes_that_disagree_name_both_files(tmp_path):
    path = _write_set(tmp_path, _frames())
    write_exr(tmp_path / "b.exr", np.zeros((HEIGHT, WIDTH - 1, 3), np.float32))
    message = error_of(load, path)
    assert "b.exr: has 6x5 pixels" in message and "a.exr has 7x5" in message
    path = _write_set(tmp_path, _frames(), width=WIDTH + 1)
    message = error_of(load, path)
    assert "a.exr: has 7x5 pixels" in message and "set.json states 8x5" in message


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"width": None}, "width and height: expected both or neither, found one"),
        ({"period_hours": 0}, "period_hours: expected greater than 0, got 0"),
        ({"lightmaps": ["a.exr"]}, "lightmaps.0: expected a mapping, got 'a.exr'"),
        ({"lightmaps": [{"time_hours": 0}]}, "lightmaps.0.file: expected a value, found none"),
        ({"lightmaps": [{"time_hours": 0, "file": "a\0.exr"}]}, "lightmaps.0.file: expected a name"),
        ({"lightmaps": [{"time_hours": float("nan"), "file": "a.exr"}]}, "lightmaps.0.time_hours: expected a finite"),
    ],
)
def test_malformed_set_names_the_field(tmp_path, changes, expected):
    path = _write_set(tmp_path, _frames())
    content = json.loads(path.read_text())
    for key, value in changes.items():
        content[key] = value
        if value is None:
            del content[key]
    path.write_text(json.dumps(content))
    message = error_of(load, path)
    assert message.startswith(f"{path}: ") and expected in message


def test_path_that_does_not_exist(tmp_path):
    assert "nowhere" in error_of(load, tmp_path / "nowhere")
    expected = "expected a set.json or lightmaps (.exr, .hdr, .ktx2, .dds, .pfm, .tif, .tiff; with --encoding .png, "
    assert expected in error_of(load, tmp_path)


def test_plain_folder_takes_files_in_natural_order(tmp_path):
    frames = _frames()
    for name, frame in zip(("x10.exr", "x2.exr", "x1.EXR"), frames, strict=True):
        write_exr(tmp_path / name, frame)
    (tmp_path / "._x1.exr").write_bytes(b"another program's")
    lightmaps = load(tmp_path, times=[1, 2, 3])
    np.testing.assert_array_equal(lightmaps.frames, frames[::-1])
    assert (lightmaps.name, lightmaps.period) == (tmp_path.name, None)
    times, period = lightmaps.warnings
    assert "times given, in the order of the names: x1.EXR = 1, x2.exr = 2, x10.exr = 3" in times
    assert "no period is stated: before 1 and after 3 the first and the last lightmap stay" in period
    assert "2 times for 3 lightmaps" in error_of(load, tmp_path, times=[1, 2])


def test_plain_folder_may_mix_formats(tmp_path):
    frames = _frames(4)
    alpha = np.ones((HEIGHT, WIDTH, 1), np.float16)
    alpha[2, 3] = 0
    write_exr(tmp_path / "m_1h.exr", np.concatenate([frames[0], alpha], -1))
    (tmp_path / "m_2h.hdr").write_bytes(imagecodecs.rgbe_encode(frames[1], header=True))
    texels = np.concatenate([frames[2], alpha], -1, dtype=np.float16)
    (tmp_path / "m_3h.ktx2").write_bytes(make_ktx2(97, WIDTH, HEIGHT, [texels.tobytes()], scheme=2))
    (tmp_path / "m_4h.DDS").write_bytes(make_dds(6, WIDTH, HEIGHT, frames[3].astype("<f4").tobytes()))
    lightmaps = load(tmp_path)
    expected = frames.copy()
    expected[1] = read_light(tmp_path / "m_2h.hdr")[0]
    np.testing.assert_array_equal(lightmaps.frames, expected)
    np.testing.assert_allclose(lightmaps.frames, frames, rtol=2**-7)
    assert lightmaps.source == from_arrays(expected, [1, 2, 3, 4]).source
    message = error_of(load, tmp_path, mask="alpha")
    assert "m_2h.hdr: expected a channel A for the mask, found the channels R, G, B" in message
    (tmp_path / "m_2h.hdr").unlink()
    (tmp_path / "m_4h.DDS").unlink()
    np.testing.assert_array_equal(load(tmp_path, mask="alpha").mask, alpha[..., 0] > 0)


def test_plain_folder_reads_hours_from_names(tmp_path):
    frames = _frames(5)
    names = ("m_5.5h", "m_5.45h", "m_18_55h", "m_07h", "m_20.25")
    for name, frame in zip(names, frames, strict=True):
        write_exr(tmp_path / f"{name}.exr", frame)
    lightmaps = load(tmp_path)
    np.testing.assert_array_equal(lightmaps.times, [5.45, 5.5, 7, 18.55, 20.25])
    np.testing.assert_array_equal(lightmaps.frames, frames[[1, 0, 3, 2, 4]])
    (hours,) = lightmaps.warnings
    assert hours.endswith("m_07h.exr = 7, m_18_55h.exr = 18.55, m_20.25.exr = 20.25; period 24")


@pytest.mark.parametrize(
    ("names", "hours", "doubt"),
    [
        ("m_06_00h m_18_30h m_23_45h", [6, 18.5, 23.75], "m_18_30h is read as 18:30 h; if it means 18.30 h"),
        ("m_06_00h m_18_55h", [6, 18.55], "m_18_55h is read as 18.55 h; if it means 18:55 h"),
        ("m_18h30 m_6h05m 7-00h", [18.5, 6 + 5 / 60, 7], ""),
        ("m_1830h m_0000h", [18.5, 0], ""),
        ("m_6pm m_6_30PM m_12am m_12pm m-11-15am", [18, 18.5, 0, 12, 11.25], ""),
        ("m_2_06h m_2_18h", [6, 18], ""),
        ("m_18.5 m.7h 9h", [18.5, 7, 9], ""),
        ("m_18 m18h m_6_75pm", [None] * 3, ""),
    ],
)
def test_hours_of_names(names, hours, doubt):
    read, line = hours_of_names(names.split())
    assert read == pytest.approx(hours) and line.startswith(doubt) and bool(line) == bool(doubt)


def test_equal_files_at_several_times_are_told(tmp_path):
    for hour, brightness in ((0, 1.0), (6, 2.0), (12, 1.0), (30, 3.0)):
        write_exr(tmp_path / f"m_{hour}h.exr", brightness * _frames()[0])
    hours, period, equal = load(tmp_path).warnings
    assert hours.endswith("= 30") and "no period" in period, "hours of more than a day do not wrap"
    assert equal == f"{tmp_path}: 0/light of m_0h.exr, m_12h.exr: equal files: was one bake saved under several times?"


@pytest.mark.parametrize("odd", ["m_12", "noon", "m12h"])
def test_plain_folder_with_a_name_that_tells_no_hour(tmp_path, odd):
    for name in ("m_05_00h", odd):
        write_exr(tmp_path / f"{name}.exr", _frames()[0])
    message = error_of(load, tmp_path)
    assert "2 lightmaps and no set.json" in message and "--times" in message and odd in message


def test_from_arrays_checks_shapes():
    frames = _frames()
    assert "[T, H, W, 3]" in error_of(from_arrays, frames[..., :2], TIMES)
    assert "none of them 0" in error_of(from_arrays, frames[:0], [])
    message = error_of(from_arrays, frames, [0, 1])
    assert "expected frames [2, H, W, C]" in message and "got (3, " in message and "times (2,)" in message
    assert "mask" in error_of(from_arrays, frames, TIMES, np.ones((WIDTH, HEIGHT), bool))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0,1,2.5", [0.0, 1.0, 2.5]),
        ("0:24:1", [float(i) for i in range(24)]),
        ("0:3:1,18.45, 19:21:1", [0.0, 1.0, 2.0, 18.45, 19.0, 20.0]),
        ("0.1:0.4:0.1", [0.1, 0.2, 0.3]),
        ("0:24:0.1", [0.1 * i for i in range(240)]),
    ],
)
def test_parse_times(text, expected):
    assert parse_times(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "a", "1,,2", "0:24", "0:24:0", "0:24:-1", "3:3:1", "nan", "0:inf:1", "0:24:1e-9"])
def test_parse_times_refuses(text):
    assert "times" in error_of(parse_times, text)


def test_demo_set_loads_without_a_repair(tmp_path):
    lightmaps = load(DEMO)
    assert lightmaps.frames.shape == (26, 256, 128, 3) and lightmaps.period == 24.0 and lightmaps.warnings == ()
    assert 18.45 in lightmaps.times and 18.55 in lightmaps.times
    before, after = (lightmaps.frames[list(lightmaps.times).index(t)][lightmaps.mask].mean() for t in (18.45, 18.55))
    assert after > 1.5 * before  # the lamps
    assert not lightmaps.frames[:, ~lightmaps.mask].any()
    # Read by the names alone, the same hours are lightmaps.
    for file in DEMO.glob("*.exr"):
        shutil.copy(file, tmp_path)
    shutil.copy(DEMO / "mask.png", tmp_path)
    assert load(tmp_path).source == lightmaps.source


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
    assert lightmaps.times.tolist() == [0.0, 12.0] and lightmaps.name == "scene"
    (hours,) = lightmaps.warnings
    assert lightmaps.period == 24.0 and hours.endswith("hours from the names: day_0h = 0, day_12h = 12; period 24")
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


def test_a_map_that_a_state_lacks_is_that_of_the_nearest_time(tmp_path):
    folder = tmp_path / "scene"
    write_unity(folder, hours=(0.0, 10.0, 20.0))
    whole, late = wlm.lightmap.load(folder), folder / "day_20h"
    (late / "Lightmap-1_comp_light.exr").unlink()
    Image.open(late / "Lightmap-1_comp_dir.png").resize((6, 9)).save(late / "Lightmap-1_comp_shadowmask.png")
    (late / "Lightmap-1_comp_dir.png").unlink()
    lightmaps = wlm.lightmap.load(folder)
    told = "\n".join(lightmaps.warnings)
    assert "Lightmap-1/light is not in day_20h: the nearest time's is used there, and not scored" in told
    assert "Lightmap-1/shadowmask is not in day_0h, day_10h" in told and "in only some" not in told
    assert "Lightmap-0/shadowmask is in no state: left out" in told
    assert "Lightmap-1/shadowmask is 6x9, but the first layer of Lightmap-1 is 12x24: each keeps its size" in told
    for (sheet, own), kept in zip(lightmaps.sheets.items(), (True,) * 3 + (False,) * 3 + (None,) * 2, strict=True):
        assert own.frames.shape[1:3] == own.mask.shape == ((9, 6) if kept is None else whole.sheets[sheet].mask.shape)
        if kept is not None:
            np.testing.assert_array_equal(own.frames[:2], whole.sheets[sheet].frames[:2])
            late = whole.sheets[sheet].frames[2] if kept else own.frames[0]  # 20 h is nearer to 0 h than to 10 h
            np.testing.assert_array_equal(own.frames[2][own.mask], late[own.mask])
            assert kept == (own.covered is None) and (kept or not own.covered[2].any())
        else:
            # The first two of 24 rows are outside the charts, and so is a row of nine that covers only them.
            assert not own.mask[0].any() and own.mask[1:].all() and not own.covered[:2].any()
            np.testing.assert_array_equal(own.frames[0][own.mask], own.frames[2][own.mask])
    assert len(wlm.lightmap.load(folder, layers=["light"]).sheets) == 2
    assert "expected names among light, dir, got 'ao'" in error_of(wlm.lightmap.load, folder / "day_0h", layers=["ao"])


def test_grey_stands_for_red_green_and_blue(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((2, 5, 3)))
    colours = np.repeat(np.arange(10, dtype=np.uint8).reshape(2, 5, 1), 3, axis=2)
    Image.fromarray(colours).save(tmp_path / "colours.png")
    Image.fromarray(colours[..., 0]).save(tmp_path / "grey.png")
    entries = [
        {"time_hours": i, "files": {"0": {"light": "a.exr", "mask": f"{name}.png", "dir": f"{name}.png"}}}
        for i, name in enumerate(("colours", "grey"))
    ]
    layers = {"light": "radiance", "mask": {"encoding": "unit", "channels": ["R"]}, "dir": "unit"}
    lightmaps = wlm.lightmap.load(write_set_json(tmp_path, layers=layers, lightmaps=entries))
    for layer, count in (("mask", 1), ("dir", 3)):
        values = values_of(lightmaps, "0", layer)
        np.testing.assert_allclose(values, np.stack([colours[..., :count] / 255.0] * 2), atol=1e-7)
    assert any(line.endswith("/grey.png: its grey is taken as red, green and blue") for line in lightmaps.warnings)


def test_states_that_differ_are_one_line(tmp_path):
    folder = tmp_path / "scene"
    write_unity(folder, hours=(0.0, 12.0))
    late = folder / "day_12h"
    write_exr(late / "Lightmap-0_comp_light.exr", np.ones((4, 12, 4)))
    assert "has 12x4 pixels, but" in error_of(wlm.lightmap.load, folder)
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
    write_planes(tmp_path / "more.exr", planes, whole=names)
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
    assert "layer dir: expected a channel x.G, found the channels R, G, B" in error_of(wlm.lightmap.load, path)
    chosen = wlm.lightmap.load(path, layers=["L0", "L1"])
    np.testing.assert_array_equal(values_of(chosen, "big", "L0")[0], stacked[:6])
    np.testing.assert_array_equal(values_of(chosen, "big", "L1")[0][1:], stacked[12:18][1:])
    np.testing.assert_array_equal(values_of(chosen, "small", "L0")[0], small)
    assert values_of(chosen, "small", "L1").shape == (1, 3, 5, 1)
    assert [own.mask.sum() for own in chosen.sheets.values()] == [40, 40, 15, 15]
    write_planes(tmp_path / "order.exr", dict.fromkeys(("A", "B", "BA", "G", "R"), planes["R"]))
    assert read_channels(tmp_path / "order.exr")[1] == ("R", "G", "B", "A", "BA")
    layers["dir"]["channels"] = ["G", "R"]
    maps = [{"time_hours": 3.0, "files": {"big": first | {"dir": "more.exr"}}}]
    both = write_set_json(tmp_path, layers=layers, atlases={"big": {}}, lightmaps=maps)
    directions = values_of(wlm.lightmap.load(both), "big", "dir")[0]
    np.testing.assert_allclose(directions, np.stack([planes["G"], planes["R"]], -1), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"layers": {"light": "srgb"}}, "layers.light.encoding: expected 'radiance', 'unit' or 'signed'"),
        ({"layers": {"light": {"encoding": "unit", "channels": []}}}, "layers.light.channels"),
        ({"layers": {"a\nb": "unit"}}, "printable"),
        ({"atlases": {"0": {"width": 3, "height": 4}}}, "a.exr: has 5x2 pixels, but"),
        ({"atlases": {"0": {}, "1": {}}}, "atlas 1: expected a picture of it in an entry of lightmaps, found none"),
        (
            {"lightmaps": [{"time_hours": 1.0, "files": {"0": {}}}]},
            "lightmaps.0.files: expected a picture, found none of the atlases",
        ),
        ({"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": "../a.exr"}}}]}, "found ../a.exr; trust=True"),
        (
            {"lightmaps": [{"time_hours": 1.0, "files": {"0": {"light": {"file": "a.exr", "slice": 0, "slices": 3}}}}]},
            "expected 3 slices of equal height, found 2 rows",
        ),
        ({"layers": {"light": {"encoding": "unit", "channels": list("abcdefghijklm")}}}, "at most 12 entries"),
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
    # Not the second in place of the first.
    assert "0/b: expected every channel once" in error_of(from_layers, [*layers, layers[1]], [0.0])


def test_names_of_arrays_are_those_that_a_file_can_have():
    frames = np.ones((1, 4, 4, 3))
    for options in ({"name": ""}, {"atlas": "a" * 129}, {"channels": ["R", "G", "\n"]}):
        assert "1 to 128 printable characters" in error_of(from_layers, [Layer(frames, **options)], [0.0])
    assert next(iter(from_layers([Layer(frames, channels=["x", "y", "z"])], [0.0]).sheets)).channels == tuple("xyz")
    masks = {"b": np.ones((4, 4), bool)}
    assert "masks: expected names of atlases" in error_of(from_layers, [Layer(frames)], [0.0], masks)


def test_sheets_that_are_large_together_lie_in_a_file(tmp_path, monkeypatch):
    write_unity(tmp_path / "scene", atlases=1)
    whole = wlm.lightmap.load(tmp_path / "scene")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(scratch, "IN_MEMORY", 2 * whole.sheets[next(iter(whole.sheets))].frames.nbytes)
    mapped = wlm.lightmap.load(tmp_path / "scene")
    assert [own.frames.base is not None for own in mapped.sheets.values()] == [False, False, True]
    assert mapped.source == whole.source
