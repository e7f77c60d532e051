"""The bundle and its raw folder: textures that other decoders read, and a shader that gives the same light."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of
from builders.shader_runs import HEADS, compiled, lightmap_uniforms, read_dds_levels, rows_of_floats, run_glsl
from builders.synthetic import random_model, random_sheet
from scipy.special import erf

from wlm.export import export
from wlm.formats.exr import read_exr
from wlm.lightmap.bundle import hour_tables, sheet_bundle
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.shader import decode_glsl, texture_names
from wlm.lightmap.sheet import LIGHT, Sheet
from wlm.texels import near_gaps

TIMES = (7.5, 3.3, 21.7)  # stored, between, and across midnight (or past the end)
AXES = [
    {},
    {"period": None},
    {"time_axis": "paper", "gelu": "tanh"},
    {"interpolation": "network"},
    {"time_axis": "paper", "period": None, "times": (2.0, 7.5, 20.0), "interpolation": "network"},
    {"kinds": (4, 3, 4, 4)},
    {"kinds": (4, 3, 1, 4), "interpolation": "network", "period": None},
]


def file_of(sheet):
    return LightmapModel("random", "0123456789abcdef", sheet.profile, {LIGHT: sheet})


def image_of(folder, document, name, number, layer=0):
    """One image of a texture of all tiles, as "about" says."""
    info = document["images"][name]
    (width, height), across = info["size"], info["across"]
    texels = read_dds_levels(folder / f"{name}.dds")
    row, column = divmod(number, across)
    return texels[layer, row * height : (row + 1) * height, column * width : (column + 1) * width]


def place_in_time(document, t):
    """The stored times around t, the share of the second, and tau, as "about" says."""
    times, tau, period = document["times"], document["tau"], document["period"]
    t = t % period if period else min(max(t, times[0]), times[-1])
    before = max([i for i, time in enumerate(times) if time <= t], default=len(times) - 1)
    after = (before + 1) % len(times) if period else min(before + 1, len(times) - 1)
    gap, past = times[after] - times[before], t - times[before]
    if period:
        gap, past = gap % period, past % period
    share = past / gap if gap else 0.0
    axis = document["time_axis"]
    if axis["rule"] == "frames":
        place = tau[before] + share / len(times)
        return before, after, share, place % 1.0 if axis["repeats"] else place
    return before, after, share, t / period if period else tau[before] + share * (tau[after] - tau[before])


def linear(values, at, repeats):
    """Texture filtering along the first axis at one coordinate."""
    position = at * len(values) - 0.5
    low = int(np.floor(position))
    pair = [i % len(values) if repeats else min(max(i, 0), len(values) - 1) for i in (low, low + 1)]
    return (low + 1 - position) * values[pair[0]] + (position - low) * values[pair[1]]


def features(folder, document, tile, tau, repeats):
    image = tile["image"]
    parts = [image_of(folder, document, "uv", image)]
    at = (np.arange(128) + 0.5) / 128.0
    slices = document["slices"]
    stack = np.stack([image_of(folder, document, "uvt", image * slices + i) for i in range(slices)])
    volume = linear(stack, tau, repeats)
    rows = np.stack([linear(volume, v, False) for v in at])
    parts.append(np.stack([linear(rows.swapaxes(0, 1), u, False) for u in at], axis=1))
    for i, shape in enumerate(((1, 128, 2), (128, 1, 2))):
        line = linear(image_of(folder, document, "planes", 2 * image + i), tau, repeats)
        line = np.stack([linear(line, p, False) for p in at])
        parts.append(np.broadcast_to(line.reshape(shape), (128, 128, 2)))
    turn = document["time_axis"]["turn"] * tau
    encoded = [np.sin(turn), np.cos(turn), np.sin(2 * turn), np.cos(2 * turn)]
    parts.append(np.broadcast_to(encoded, (128, 128, 4)))
    return np.concatenate(parts, axis=2)


def layers_of(folder, document, tile):
    """W1, b1, W2, b2, W3 and b3 of a tile, with their zeros."""
    numbers = np.fromfile(folder / "networks.bin", "<f4").reshape(-1, 4).astype(np.float64)
    wide, at = -(-document["hidden"] // 4), tile["network_four"]
    for rows, fours in ((16, wide), (1, wide), (4 * wide, wide), (1, wide), (4 * wide, 1), (1, 1)):
        yield numbers[at : at + rows * fours].reshape(rows, 4 * fours)
        at += rows * fours


def frame_light(folder, document, tile, i):
    """Radiance of a tile of frames at stored time i."""
    level = image_of(folder, document, tile["kind"], tile["image"], i)[..., :3]
    least, greatest = (np.array(tile[name][i]) for name in ("least", "greatest"))
    return (least + level * (greatest - least)) ** document["gamma"]


def frame_from_files(folder, t):
    """The whole map in float64 from the exported files alone."""
    document = json.loads((folder / "bundle.json").read_text())
    before, after, share, tau = place_in_time(document, t)
    if document["interpolation"] == "radiance" and share > 0.0:
        early, late = (frame_from_files(folder, document["times"][k]) for k in (before, after))
        return (1.0 - share) * early + share * late
    height, width, columns = document["height"], document["width"], document["tile_columns"]
    image = np.zeros((-(-height // 128) * 128, columns * 128, 3))

    def gelu(x):
        if document["gelu"] == "exact":
            return 0.5 * x * (1.0 + erf(x / np.sqrt(2.0)))
        return 0.5 * x * (1.0 + np.tanh(np.sqrt(2.0 / np.pi) * (x + 0.044715 * x**3)))

    def mixed(values):
        return (1.0 - share) * np.array(values[before]) + share * np.array(values[after])

    for tile in document["tiles"]:
        if tile["kind"] == "constant":
            radiance = mixed(tile["radiance"])
        elif tile["kind"] == "frames":
            radiance = mixed({i: frame_light(folder, document, tile, i) for i in {before, after}})
        else:
            x = features(folder, document, tile, tau, document["time_axis"]["repeats"])
            w1, b1, w2, b2, w3, b3 = layers_of(folder, document, tile)
            y = (gelu(gelu(x @ w1 + b1) @ w2 + b2) @ w3 + b3)[..., :3]
            colour = (np.array(tile["shift"]) + np.array(tile["spread"]) * y) * mixed(tile["scale"])
            radiance = np.maximum(colour, 0.0) ** document["gamma"]
        row, column = tile["row"] * 128, tile["column"] * 128
        image[row : row + 128, column : column + 128] = radiance
    return image[:height, :width]


@pytest.mark.parametrize("settings", AXES, ids=str)
def test_the_files_alone_give_the_decoders_light(settings, tmp_path):
    model = random_sheet(**settings)
    names = {path.name for path in export(file_of(model), tmp_path)}
    assert names == {path.name for path in tmp_path.iterdir()} >= {"bundle.json", "lightmap.glsl", "hours.bin"}
    decoder = SheetDecoder(model)
    np.testing.assert_array_equal(read_exr(tmp_path / "frame.exr")[0], decoder.frame(model.times[0]))
    for time in TIMES:
        expected, found = decoder.frame(time), frame_from_files(tmp_path, time)
        # float32 in the decoder, 9 digits in the file: 1e-6 of the brightest texel measured.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())


def test_the_textures_of_a_large_set_are_few():
    bundle = random_model((3,) * 64, columns=8, times=(0.0, 12.0)).bundle()
    assert len(bundle.textures) + len(bundle.buffers) <= 8
    assert (bundle.textures["uv"].width, bundle.textures["uv"].height) == (1024, 1024)


def test_a_texture_beyond_a_gpu():
    sheet = random_sheet((4, 4, 4, 4), times=(0.0, 7.5))
    many = replace(sheet, frames=np.broadcast_to(sheet.frames[:, :1], (4, 2049, 32, 32, 16)))
    assert "random: cannot export: frames of all tiles is 256x256x2049, more than" in error_of(file_of(many).bundle)


def test_what_cannot_be_exported():
    sheet = random_sheet((3, 0))
    net = sheet.net.copy()
    net[0, 5] = np.inf
    assert "a weight is NaN or infinite" in error_of(file_of(replace(sheet, net=net)).bundle)
    assert "device 'tpu'" in error_of(file_of(sheet).bundle, device="tpu")


MAIN = """
{layout}out vec4 light;
void main()
{{
    ivec2 texel = wlm_source(ivec2(gl_FragCoord.xy));
    light = vec4(wlm_radiance(texel), 1.0);
}}
"""


@pytest.mark.parametrize("exact", ["", "#define WLM_LIGHTMAP_EXACT\n"])
@pytest.mark.parametrize("settings", [{"gelu": "exact"}, {"kinds": (4, 3, 1, 4)}], ids=str)
def test_the_shader_compiles(settings, exact, tmp_path):
    model = random_sheet(**settings)
    names = [f"#define WLM_LIGHTMAP_{name.upper()}_BINDING {i}\n" for i, name in enumerate(texture_names(model))]
    for version, spirv, layout in (
        ("300 es\n" + "".join(HEADS["glsl-es"].splitlines(True)[1:]), False, ""),
        ("450\n" + "".join(names), True, "layout(location = 0) "),
    ):
        text = f"#version {version}{exact}{decode_glsl(model)}{MAIN.format(layout=layout)}"
        compiled(text, tmp_path, name="shader.frag", spirv=spirv)


SHOWN = "light = vec4(wlm_radiance(pixel), 1.0);"


@pytest.mark.parametrize("settings", AXES[1:5], ids=str)
def test_the_shader_gives_the_decoders_light(settings, tmp_path):
    """The other settings; `tests/export/shading` checks the default ones, kinds of tiles and languages."""
    model = random_sheet(**settings)
    export(file_of(model), tmp_path)
    uniforms, hour = lightmap_uniforms(tmp_path)
    text, decoder = (tmp_path / "lightmap.glsl").read_text(), SheetDecoder(model)
    for i in (1, len(model.times) - 1):
        expected = decoder.frame(float(model.times[i]))
        found = run_glsl("#define WLM_LIGHTMAP_EXACT\n" + text, SHOWN, expected.shape[:2], uniforms | hour(i))
        # The constants' 8 digits: 1e-6 of the brightest texel measured.
        np.testing.assert_allclose(found[..., :3], expected, rtol=0, atol=1e-5 * expected.max())


@pytest.mark.parametrize("time", TIMES[1:])
def test_a_table_between_two_hours(time, tmp_path):
    """Networks that interpolate, with frames, which do not."""
    model = random_sheet((3, 4, 1, 3), interpolation="network")
    expected = SheetDecoder(model).frame(time)
    export(file_of(model), tmp_path)
    uniforms, _ = lightmap_uniforms(tmp_path)
    uniforms["wlm_lightmap_hour"] = rows_of_floats(hour_tables(model, [time])[0])
    found = run_glsl("#define WLM_LIGHTMAP_EXACT\n" + decode_glsl(model, None), SHOWN, expected.shape[:2], uniforms)
    np.testing.assert_allclose(found[..., :3], expected, rtol=0, atol=1e-4 * expected.max())


def test_the_shader_of_values(tmp_path):
    model = random_sheet(gamma=1.0)
    bundle = sheet_bundle(Sheet("0", "dir", ("R", "G", "B"), "signed"), model, "random", "0")
    export(bundle, tmp_path)
    uniforms, hour = lightmap_uniforms(tmp_path)
    text = "#define WLM_LIGHTMAP_EXACT\n" + (tmp_path / "lightmap.glsl").read_text()
    expected = read_exr(tmp_path / "frame.exr")[0]
    assert expected.min() < 0.0 and "wlm_radiance" not in text
    found = run_glsl(text, "light = vec4(wlm_value(pixel), 1.0);", expected.shape[:2], uniforms | hour(0))
    np.testing.assert_allclose(found[..., :3], expected, rtol=0, atol=1e-4)


def test_the_shader_fills_gaps(tmp_path):
    mask = np.random.default_rng(0).random((236, 247)) < 0.03
    export(random_model(mask=mask), tmp_path)
    uniforms, hour = lightmap_uniforms(tmp_path)
    text = (tmp_path / "lightmap.glsl").read_text()
    main = "light = vec4(vec2(wlm_source(pixel)), 0.0, 1.0);"
    found = run_glsl(text, main, mask.shape, uniforms | hour(0))[..., 1::-1]
    expected = np.moveaxis(np.indices(mask.shape), 0, 2)
    target, source = near_gaps(mask)
    expected[tuple(target.T)] = source
    np.testing.assert_array_equal(found, expected)
