"""What an engine gets: textures that other decoders read, and weights and a shader that give the same light."""

import json
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import texture2ddecoder
from builders.synthetic import random_model
from PIL import Image
from scipy.special import erf

from wlm.errors import WlmError
from wlm.formats.bc7 import blocks_image, decode_image
from wlm.formats.bc7_modes import decode_blocks
from wlm.formats.exr import read_exr
from wlm.lightmap.decode import Decoder
from wlm.lightmap.exact import colour_tile64, decode_tile64
from wlm.lightmap.exporter import export
from wlm.lightmap.gaps import Gaps
from wlm.lightmap.shader import decode_glsl

TIMES = (7.5, 3.3, 21.7)  # stored, between, and across midnight (or past the end)
AXES = [
    {},
    {"period": None},
    {"time_axis": "paper", "gelu": "tanh"},
    {"interpolation": "network"},
    {"time_axis": "paper", "period": None, "times": (2.0, 7.5, 20.0), "interpolation": "network"},
    {"kinds": (4, 3, 4, 4)},
    {"kinds": (4, 2, 1, 4), "interpolation": "network", "period": None},
    {"kinds": (5, 4, 1, 5)},
]


def read_texture(path):
    """A DDS file by Microsoft's description of it and another BC7 decoder: floats [D, H, W, C] in [0, 1]."""
    data = path.read_bytes()
    height, width, _, depth = struct.unpack_from("<4I", data, 12)
    fmt = struct.unpack_from("<I", data, 128)[0]
    depth, payload = max(depth, 1), data[148:]
    if fmt == 49:
        return np.frombuffer(payload, np.uint8).reshape(depth, height, width, 2) / 255.0
    if fmt == 24:
        words = np.frombuffer(payload, "<u4").reshape(depth, height, width, 1)
        return np.concatenate([words >> shift & 1023 for shift in (0, 10, 20)], 3) / 1023.0
    assert fmt == 98
    size = len(payload) // depth
    slices = [texture2ddecoder.decode_bc7(payload[i * size : (i + 1) * size], width, height) for i in range(depth)]
    bgra = np.stack([np.frombuffer(s, np.uint8).reshape(height, width, 4) for s in slices])
    return bgra[..., [2, 1, 0, 3]] / 255.0


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


def features(folder, number, dynamic, tau, repeats):
    stem = f"tile_{number:04d}_"
    parts = [read_texture(folder / f"{stem}uv.dds")[0]]
    if dynamic:
        at = (np.arange(128) + 0.5) / 128.0
        volume = linear(read_texture(folder / f"{stem}uvt.dds"), tau, repeats)
        rows = np.stack([linear(volume, v, False) for v in at])
        parts.append(np.stack([linear(rows.swapaxes(0, 1), u, False) for u in at], axis=1))
        for name, shape in (("ut", (1, 128, 2)), ("vt", (128, 1, 2))):
            line = linear(read_texture(folder / f"{stem}{name}.dds")[0], tau, repeats)
            line = np.stack([linear(line, p, False) for p in at])
            parts.append(np.broadcast_to(line.reshape(shape), (128, 128, 2)))
        turn = (2.0 if repeats else 1.0) * np.pi * tau
        encoded = [np.sin(turn), np.cos(turn), np.sin(2 * turn), np.cos(2 * turn)]
        parts.append(np.broadcast_to(encoded, (128, 128, 4)))
    return np.concatenate(parts, axis=2)


def frame_light(folder, tile, i, gamma):
    """Radiance of a tile of frames or video at stored time i."""
    level = read_texture(folder / f"tile_{tile['number']:04d}_frame_{i:04d}.dds")[0, ..., :3]
    least, greatest = (np.array(tile[name][i]) for name in ("least", "greatest"))
    return (least + level * (greatest - least)) ** gamma


def frame_from_files(folder, t):
    """The whole map in float64 from the exported files alone."""
    document = json.loads((folder / "weights.json").read_text())
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
        elif tile["kind"] in ("frames", "video"):
            radiance = mixed({i: frame_light(folder, tile, i, document["gamma"]) for i in {before, after}})
        else:
            x = features(folder, tile["number"], tile["kind"] == "dynamic", tau, document["time_axis"]["repeats"])
            for layer in "12":
                x = gelu(x @ np.array(tile["W" + layer]) + tile["b" + layer])
            y = x @ np.array(tile["W3"]) + tile["b3"]
            colour = (np.array(tile["shift"]) + np.array(tile["spread"]) * y) * mixed(tile["scale"])
            radiance = np.maximum(colour, 0.0) ** document["gamma"]
        row, column = tile["row"] * 128, tile["column"] * 128
        image[row : row + 128, column : column + 128] = radiance
    return image[:height, :width]


@pytest.mark.parametrize("settings", AXES, ids=str)
def test_the_files_alone_give_the_decoders_light(settings, tmp_path):
    model = random_model(**settings)
    export(model, tmp_path)
    decoder = Decoder(model)
    np.testing.assert_array_equal(read_exr(tmp_path / "frame.exr")[0], decoder.frame(model.times[0]))
    for time in TIMES:
        expected, found = decoder.frame(time), frame_from_files(tmp_path, time)
        # float32 in the decoder, 9 digits in the file: 1e-6 of the brightest texel measured.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())


def test_other_decoders_read_the_textures(tmp_path):
    model = random_model((3, 2, 4, 3), times=(0.0, 7.5))
    paths = export(model, tmp_path)
    names = [path.name for path in paths]
    assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
    parts = ["uv", "uvt", "ut", "vt"]
    stems = [f"tile_0000_{p}" for p in parts] + ["tile_0001_uv"] + [f"tile_0003_{p}" for p in parts]
    stems += ["tile_0002_frame_0000", "tile_0002_frame_0001"]
    assert names == [f"{stem}.dds" for stem in stems] + ["decode.glsl", "frame.exr", "valid.png", "weights.json"]
    for place, number in enumerate((0, 1, 3)):
        with Image.open(tmp_path / f"tile_{number:04d}_uv.dds") as image:
            assert np.array_equal(np.asarray(image), decode_image(model.uv[place]))
    for i in range(2):
        frame = read_texture(tmp_path / f"tile_0002_frame_{i:04d}.dds")[0]
        assert np.array_equal(np.rint(frame * 255.0), blocks_image(decode_blocks(model.frames[0, i])))
    for row, number in enumerate((0, 3)):
        volume = read_texture(tmp_path / f"tile_{number:04d}_uvt.dds")
        expected = np.stack([decode_image(blocks) for blocks in model.uvt[row]])
        assert np.array_equal(volume * 255.0, expected)
        for part in ("ut", "vt"):
            plane = read_texture(tmp_path / f"tile_{number:04d}_{part}.dds")[0]
            assert np.array_equal(np.rint(plane * 255.0), getattr(model, part)[row])


def test_networks_lie_one_after_another(tmp_path):
    export(random_model((2, 3, 1, 3)), tmp_path)
    document = json.loads((tmp_path / "weights.json").read_text())
    tiles = [tile for tile in document["tiles"] if tile["kind"] != "constant"]
    sizes = [sum(np.size(tile[key]) for key in ("W1", "b1", "W2", "b2", "W3", "b3")) for tile in tiles]
    assert [tile["network_offset"] for tile in tiles] == [0, sizes[0], sizes[0] + sizes[1]]
    assert document["network_floats"] == sum(sizes)
    assert [tile["number"] for tile in document["tiles"]] == [0, 1, 2, 3]
    assert np.shape(tiles[0]["W1"]) == (4, 8) and np.shape(tiles[1]["W1"]) == (16, 8)


def test_what_cannot_be_exported(tmp_path):
    model = random_model((2, 0))
    net = model.net_static.copy()
    net[0, 5] = np.inf
    with pytest.raises(WlmError, match="a weight is NaN or infinite"):
        export(replace(model, net_static=net), tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(WlmError, match="cannot write there"):
            export(model, folder)
    with pytest.raises(WlmError, match="device 'tpu'"):
        export(model, tmp_path / "new", device="tpu")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


CALLER = """
layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 1) uniform sampler2D uv;
layout(binding = 2) uniform sampler3D uvt;
layout(binding = 3) uniform sampler2D ut;
layout(binding = 4) uniform sampler2D vt;
layout(binding = 5, rgba16f) uniform writeonly image2D result;
void main()
{
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    vec3 one = vec3(1.0);
    vec3 a = wlm_decode_dynamic(uv, uvt, ut, vt, texel, 0.25, 0, one, one, one);
    vec3 b = wlm_decode_static(uv, texel, 600, one, one, one) + wlm_decode_frame(uv, texel, one, a);
    imageStore(result, texel, vec4(wlm_radiance(a + b), 1.0));
}
"""


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("gelu", ["exact", "tanh"])
@pytest.mark.parametrize(("version", "options"), [(430, []), (450, ["-V", "-o", "shader.spv"])])
def test_the_shader_compiles(gelu, version, options, tmp_path):
    text = decode_glsl(random_model(gelu=gelu))
    (tmp_path / "shader.comp").write_text(f"#version {version}\n{text}{CALLER}")
    done = subprocess.run(["glslangValidator", *options, "shader.comp"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


# GLSL's vectors and texture functions for a C++ compiler, in double precision.
SHIM = """
#include <cmath>
#include <cstdio>
#include <vector>
using std::exp; using std::sin; using std::cos; using std::tanh; using std::abs;
struct vec2 { double x, y; vec2(double x, double y) : x(x), y(y) {} };
struct vec3 { double x, y, z; vec3(double x, double y, double z) : x(x), y(y), z(z) {} };
struct vec4 { double x, y, z, w; };
struct ivec2 { int x, y; ivec2(int x, int y) : x(x), y(y) {} };
vec3 operator*(double s, vec3 a) { return vec3(s * a.x, s * a.y, s * a.z); }
vec3 operator*(vec3 a, vec3 b) { return vec3(a.x * b.x, a.y * b.y, a.z * b.z); }
vec3 operator+(vec3 a, vec3 b) { return vec3(a.x + b.x, a.y + b.y, a.z + b.z); }
void operator+=(vec3& a, vec3 b) { a = a + b; }
double clamp(double x, double a, double b) { return x < a ? a : x > b ? b : x; }
double larger(double a, double b) { return a > b ? a : b; }
vec3 max(vec3 a, vec3 b) { return vec3(larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)); }
vec3 pow(vec3 a, vec3 b) { return vec3(std::pow(a.x, b.x), std::pow(a.y, b.y), std::pow(a.z, b.z)); }
int wrap; // whether the axis of time repeats
struct texture { int size[3], channels; std::vector<double> data;
    void read() { if (fread(size, 4, 3, stdin) != 3 || fread(&channels, 4, 1, stdin) != 1) throw 1;
        data.resize(size[0] * size[1] * size[2] * channels);
        if (fread(data.data(), 8, data.size(), stdin) != data.size()) throw 1; }
    vec4 at(int x, int y, int z) const {
        const double* p = &data[((z * size[1] + y) * size[0] + x) * channels];
        return channels == 4 ? vec4{p[0], p[1], p[2], p[3]} : vec4{p[0], p[1], 0, 1}; }
    // Linear in every axis; `time` is the one that may repeat.
    vec4 sample(const double* p, int time) const {
        double sum[4] = {};
        for (int corner = 0; corner < 8; ++corner) {
            int cell[3]; double share = 1;
            for (int i = 0; i < 3; ++i) {
                double q = p[i] * size[i] - 0.5, low = std::floor(q);
                int bit = corner >> i & 1, c = int(low) + bit;
                share *= bit ? q - low : 1 - (q - low);
                cell[i] = wrap && i == time ? (c + size[i]) % size[i] : c < 0 ? 0 : c < size[i] ? c : size[i] - 1;
            }
            vec4 v = at(cell[0], cell[1], cell[2]);
            sum[0] += share * v.x; sum[1] += share * v.y; sum[2] += share * v.z; sum[3] += share * v.w;
        }
        return vec4{sum[0], sum[1], sum[2], sum[3]}; } };
typedef const texture& sampler2D;
struct volume : texture {};
typedef const volume& sampler3D;
vec4 texelFetch(sampler2D s, ivec2 p, int) { return s.at(p.x, p.y, 0); }
ivec2 textureSize(sampler2D s, int) { return ivec2(s.size[0], s.size[1]); }
vec4 textureLod(sampler2D s, vec2 p, double) { double at[3] = {p.x, p.y, 0.5}; return s.sample(at, 1); }
vec4 textureLod(sampler3D s, vec3 p, double) { double at[3] = {p.x, p.y, p.z}; return s.sample(at, 2); }
std::vector<double> net;
#define WLM_NET(i) net[i]
#define float double
#include "decode.glsl"
"""
DECODE = """
int main()
{
    int dynamic, offset, floats; double tau, c[9];
    texture uv, ut, vt; volume uvt;
    if (fread(&dynamic, 4, 1, stdin) != 1 || fread(&wrap, 4, 1, stdin) != 1 || fread(&offset, 4, 1, stdin) != 1
        || fread(&tau, 8, 1, stdin) != 1 || fread(c, 8, 9, stdin) != 9 || fread(&floats, 4, 1, stdin) != 1) return 1;
    net.resize(floats);
    if (fread(net.data(), 8, floats, stdin) != size_t(floats)) return 1;
    uv.read();
    if (dynamic == 1) { uvt.read(); ut.read(); vt.read(); }
    vec3 scale(c[0], c[1], c[2]), shift(c[3], c[4], c[5]), spread(c[6], c[7], c[8]);
    for (int y = 0; y < 128; ++y) for (int x = 0; x < 128; ++x) {
        vec3 colour = dynamic > 1 ? wlm_decode_frame(uv, ivec2{x, y}, scale, shift) : dynamic
            ? wlm_decode_dynamic(uv, uvt, ut, vt, ivec2{x, y}, tau, offset, scale, shift, spread)
            : wlm_decode_static(uv, ivec2{x, y}, offset, scale, shift, spread);
        vec3 radiance = wlm_radiance(colour);
        double out[6] = {colour.x, colour.y, colour.z, radiance.x, radiance.y, radiance.z};
        fwrite(out, 8, 6, stdout);
    }
}
"""

FILL = """
int main()
{
    texture valid;
    valid.read();
    for (int y = 0; y < valid.size[1]; ++y) for (int x = 0; x < valid.size[0]; ++x) {
        ivec2 found = wlm_source(valid, ivec2(x, y));
        int out[2] = {found.y, found.x};
        fwrite(out, 4, 2, stdout);
    }
}
"""


def compile_shader(folder, main):
    """A program of the exported shader and a C++ function that calls it."""
    source, program = folder / "run.cpp", folder / "run"
    source.write_text(SHIM + main)
    command = ["g++", "-O1", "-std=c++14", "-I", folder, "-o", program, source]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def run_shader(program, folder, number, time):
    """One tile through the compiled shader: colour and radiance [128, 128, 3]."""
    document = json.loads((folder / "weights.json").read_text())
    before, after, share, tau = place_in_time(document, time)
    tile = next(tile for tile in document["tiles"] if tile["number"] == number)
    keys = ("W1", "b1", "W2", "b2", "W3", "b3")
    networks = [np.ravel(each[key]) for each in document["tiles"] if "W1" in each for key in keys]
    networks = np.concatenate(networks)
    if tile["kind"] == "frames":
        data = struct.pack("<3i10d", 2, 0, 0, 0.0, *tile["least"][before], *tile["greatest"][before], *[0.0] * 3)
        texture = read_texture(folder / f"tile_{number:04d}_frame_{before:04d}.dds")
        data += struct.pack("<5i", 0, *texture.shape[2::-1], texture.shape[3]) + texture.tobytes()
        return run_program(program, data)
    scale = (1.0 - share) * np.array(tile["scale"][before]) + share * np.array(tile["scale"][after])
    dynamic = tile["kind"] == "dynamic"
    data = struct.pack("<3i", dynamic, document["time_axis"]["repeats"], tile["network_offset"])
    data += struct.pack("<10d", tau, *scale, *tile["shift"], *tile["spread"])
    data += struct.pack("<i", len(networks)) + networks.tobytes()
    for part in ("uv", "uvt", "ut", "vt") if dynamic else ("uv",):
        texture = read_texture(folder / f"tile_{number:04d}_{part}.dds")
        data += struct.pack("<4i", *texture.shape[2::-1], texture.shape[3]) + texture.tobytes()
    return run_program(program, data)


def run_program(program, data):
    out = subprocess.run([program], input=data, capture_output=True, check=True).stdout
    out = np.frombuffer(out).reshape(128, 128, 6)
    return out[..., :3], out[..., 3:]


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
@pytest.mark.parametrize("settings", [{"gelu": "exact"}, {"gelu": "tanh", "period": None}], ids=str)
def test_the_shaders_arithmetic(settings, tmp_path):
    model = random_model((2, 3, 4, 3), interpolation="network", **settings)
    export(model, tmp_path / "export")
    program, folder = compile_shader(tmp_path / "export", DECODE), tmp_path / "export"
    for number, time in ((0, 3.3), (1, 7.5), (2, 13.0), (3, 21.7)):
        colour, radiance = run_shader(program, folder, number, time)
        # The constants' 8 digits, the file's 9, and in the exact form erf's 1.5e-7: 1e-7 measured.
        np.testing.assert_allclose(colour, colour_tile64(model, number, time), rtol=0, atol=2e-6)
        np.testing.assert_allclose(radiance, decode_tile64(model, number, time), rtol=0, atol=1e-5)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
def test_the_shader_fills_gaps(tmp_path):
    mask = np.random.default_rng(0).random((236, 247)) < 0.03
    export(random_model(mask=mask), tmp_path)
    with Image.open(tmp_path / "valid.png") as image:
        valid = np.asarray(image).astype(np.float64)
    data = struct.pack("<4i", 247, 236, 1, 2) + np.stack([valid, valid], 2).tobytes()
    out = subprocess.run([compile_shader(tmp_path, FILL)], input=data, capture_output=True, check=True).stdout
    found = np.frombuffer(out, np.int32).reshape(236, 247, 2)
    assert np.array_equal(valid, mask)
    expected = np.moveaxis(np.indices(mask.shape), 0, 2)
    gaps = Gaps.of(mask)
    expected[tuple(gaps.target.T)] = gaps.source
    np.testing.assert_array_equal(found, expected)
