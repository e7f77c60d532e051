"""What an engine gets of a transform: a buffer and a shader that give the decoder's light between probes."""

import json
import shutil
import subprocess

import numpy as np
import pytest

import wlm
from wlm.errors import WlmError
from wlm.probe.data import from_arrays, load
from wlm.probe.exporter import export
from wlm.probe.transform_export import HEAD_WORDS

SIZES = [(300, 27), (7, 3), (1, 4)]


def exported(count, outputs, folder):
    """A set in a box of 8 x 3 x 6 far from the origin's corner, an eighth of it dead; its decoder, and its folder."""
    random = np.random.default_rng(count)
    place = random.random((count, 3)) * [8, 3, 6] + [20, -5, 3]
    values = np.sin(place @ random.normal(size=(3, outputs))).astype(np.float32)
    values[1::8] = 0.0
    probes = from_arrays(place, values)
    model = wlm.probe.compress(probes)
    export(model, folder, position=probes.position)
    return probes, model.decoder(position=probes.position)


def test_what_is_written(tmp_path):
    probes, decoder = exported(300, 27, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"light.bin", "probe.glsl", "reference.json", "probe.json"}
    info = json.loads((tmp_path / "probe.json").read_text())
    words = np.frombuffer((tmp_path / "light.bin").read_bytes(), "<u4")
    live = np.flatnonzero(probes.live)
    assert info["dead"] == np.flatnonzero(~probes.live).tolist() and words[10] == info["live"] == len(live)
    place = words[HEAD_WORDS : words[12]].view("<f4").reshape(-1, 3) + np.array(info["low"])
    np.testing.assert_allclose(place, probes.position[live], atol=1e-5)
    halves = words[words[12] : words[13]].view("<f2").reshape(len(live), 28)[:, :27]
    expected = decoder.decode_probes()[live]
    np.testing.assert_allclose(halves.astype(float) * info["gain"], expected, atol=6e-4 * np.abs(expected).max())
    reference = load(tmp_path / "reference.json")
    np.testing.assert_allclose(decoder.decode(reference.position), reference.values, atol=1e-6)
    # Every probe is listed once, in its cell.
    start, items = words[words[13] : words[14]], words[words[14] :]
    assert sorted(items) == list(range(len(live))) and start[-1] == len(live)
    cell = np.minimum((place - info["low"]) // info["side"], np.array(info["cells"]) - 1).astype(int)
    number = (cell[:, 2] * info["cells"][1] + cell[:, 1]) * info["cells"][0] + cell[:, 0]
    np.testing.assert_array_equal(number[items], np.repeat(np.arange(len(start) - 1), np.diff(start)))


def test_an_export_needs_the_places(tmp_path):
    probes = from_arrays(np.random.default_rng(0).random((20, 3)), np.ones((20, 3)))
    with pytest.raises(WlmError, match="array: holds no positions"):
        export(wlm.probe.compress(probes), tmp_path / "new")
    assert not (tmp_path / "new").exists()


SHIM = """
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>
typedef uint32_t uint;
struct vec2 { float x, y; };
struct vec3 { float x, y, z; vec3() {} vec3(float x, float y, float z) : x(x), y(y), z(z) {} };
vec3 operator-(vec3 a, vec3 b) { return vec3(a.x - b.x, a.y - b.y, a.z - b.z); }
float dot(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
float sqrt(float x) { return std::sqrt(x); }
float min(float a, float b) { return b < a ? b : a; }
int min(int a, int b) { return b < a ? b : a; }
float max(float a, float b) { return a < b ? b : a; }
float clamp(float x, float a, float b) { return min(max(x, a), b); }
vec3 clamp(vec3 x, vec3 a, vec3 b) { return vec3(clamp(x.x, a.x, b.x), clamp(x.y, a.y, b.y), clamp(x.z, a.z, b.z)); }
float uintBitsToFloat(uint u) { float f; std::memcpy(&f, &u, 4); return f; }
float half(uint h)
{
    int exponent = h >> 10 & 31, mantissa = h & 1023;
    float f = exponent ? std::ldexp(1024.0f + mantissa, exponent - 25) : std::ldexp(float(mantissa), -24);
    return h >> 15 ? -f : f;
}
vec2 unpackHalf2x16(uint u) { return vec2{half(u & 65535), half(u >> 16)}; }
std::vector<uint> words;
#define WLM_PROBE_LIGHT(i) words[i]
#define out
#define inout
#include "probe.glsl"
#undef out
int main(int, char** argument)
{
    FILE* file = fopen(argument[1], "rb");
    uint word;
    while (fread(&word, 4, 1, file) == 1) words.push_back(word);
    fclose(file);
    float p[3], values[WLM_PROBE_OUTPUTS];
    while (fread(p, 4, 3, stdin) == 3) {
        wlm_probe_values(wlm_probe_place(vec3(p[0], p[1], p[2])), values);
        fwrite(values, 4, WLM_PROBE_OUTPUTS, stdout);
    }
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
@pytest.mark.parametrize(("count", "outputs"), SIZES)
def test_the_shaders_arithmetic(count, outputs, tmp_path):
    probes, decoder = exported(count, outputs, tmp_path / "export")
    (tmp_path / "run.cpp").write_text(SHIM)
    program = tmp_path / "run"
    words = ["g++", "-O1", "-std=c++14", "-I", tmp_path / "export", "-o", program, tmp_path / "run.cpp"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    points = np.random.default_rng(1).random((300, 3)) * [10, 5, 8] + [19, -6, 2]
    points = np.concatenate([points, probes.position]).astype(np.float32)
    run = [program, tmp_path / "export" / "light.bin"]
    out = subprocess.run(run, input=points.tobytes(), capture_output=True, check=True).stdout
    expected = decoder.decode(points)
    # Half floats of the light, and single precision in a matrix of twelve.
    values = np.frombuffer(out, np.float32).reshape(expected.shape)
    np.testing.assert_allclose(values, expected, atol=3e-3 * np.abs(expected).max())


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
def test_the_shader_compiles(tmp_path):
    exported(300, 27, tmp_path / "export")
    text = (tmp_path / "export" / "probe.glsl").read_text()
    caller = "layout(std430, binding = 4) buffer Results { vec3 results[]; };\nvoid main()\n{\n    vec3 sh[9];\n"
    caller += "    wlm_probe_sh(vec3(1.0, 2.0, 3.0), sh);\n    results[0] = sh[0];\n}\n"
    (tmp_path / "shader.comp").write_text(f"#version 430\nlayout(local_size_x = 1) in;\n{text}{caller}")
    done = subprocess.run(["glslangValidator", "shader.comp"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout
