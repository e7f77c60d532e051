"""What an engine gets: numbers that decode to the same light with NumPy alone, and a shader that does the same."""

import itertools
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from builders.exported import read_export
from builders.probe_models import EXTENT, ORIGIN, SIZE, random_model, with_content

from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.gaussian.shader import probe_glsl

SHAPES = [
    {},
    {"support": "sphere"},
    {"latent": 1, "hidden": 8, "bits": 4, "outputs": 3},
    {"latent": 4, "outputs": 5, "count": 1},
    {"turn": 0.0},
    {"latent": 13, "hidden": 24, "bits": 16, "outputs": 12, "probes": 7},
]


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


class Files:
    """A raw folder, read as "about" and the head of probe.glsl say, in float64."""

    def __init__(self, folder):
        self.info, arrays = read_export(folder)
        info, words = self.info, arrays["gaussians"]
        halves = arrays["network"].view("<f2").astype(np.float64)
        self.words = words
        latent, hidden, count = info["latent"], info["hidden"], info["gaussians"]
        per, first = info["words_per_gaussian"], info["first_gaussian_word"]
        assert words[9] == count and len(words) == first + count * per
        codes = words[first:].view("<u2").reshape(count, 2 * per)[:, : 10 + latent]
        numbers = np.array(info["low"]) + codes * np.array(info["step"])
        self.centre, self.scale = numbers[:, :3], np.exp(numbers[:, 3:6])
        q = numbers[:, 6:10]
        norm = np.linalg.norm(q, axis=1, keepdims=True)
        w, x, y, z = np.where(norm < 1e-12, [1.0, 0.0, 0.0, 0.0], q / np.where(norm < 1e-12, 1.0, norm)).T
        self.rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        self.latent = numbers[:, 10:]
        self.layers, at = [], 0
        sizes = [latent + 3, hidden, hidden, info["outputs"]]
        for inputs, outputs in itertools.pairwise(sizes):
            rows, fours = 1 + -(-inputs // 4) * 4, -(-outputs // 4)
            layer = halves[at : at + 4 * rows * fours].reshape(fours, rows, 4).transpose(1, 0, 2).reshape(rows, -1)
            at += layer.size
            assert not layer[1 + inputs :].any() and not layer[:, outputs:].any()
            self.layers.append((layer[1 : 1 + inputs, :outputs], layer[0, :outputs]))
        assert at == len(halves)

    def place(self, position):
        x = (np.asarray(position) - self.info["origin"]) / self.info["extent"]
        return np.clip(x, 0.0, self.info["size"])

    def weights(self, x):
        """[M, K], 0 where a Gaussian doesn't reach."""
        d = x[:, None] - self.centre
        u = np.einsum("kij,mki->mkj", self.rotation, d) / self.scale
        square, cut = (u**2).sum(2), self.info["cut"]
        if self.info["support"] == "sphere":
            reached = (d**2).sum(2) < (cut * self.scale.max(1)) ** 2
        else:
            reached = square < cut**2
        return np.where(reached, np.exp(-0.5 * square), 0.0)

    def values(self, position):
        x = self.place(position)
        h = np.concatenate([self.weights(x) @ self.latent, x], 1)
        (w1, b1), (w2, b2), (w3, b3) = self.layers
        return self.info["gain"] * (sigmoid(sigmoid(h @ w1 + b1) @ w2 + b2) @ w3 + b3)

    def reach(self):
        """[K, 3], half the box round what a Gaussian reaches."""
        if self.info["support"] == "sphere":
            return np.repeat(self.info["cut"] * self.scale.max(1, keepdims=True), 3, 1)
        return self.info["cut"] * np.sqrt(((self.rotation * self.scale[:, None]) ** 2).sum(2))


def places(count=200, seed=1):
    """Positions in the box and a little beyond."""
    return ORIGIN + EXTENT * SIZE * np.random.default_rng(seed).uniform(-0.1, 1.1, (count, 3))


@pytest.mark.parametrize("settings", SHAPES, ids=str)
def test_the_files_alone_give_the_decoders_light(settings, tmp_path):
    model = random_model(**settings)
    export(model, tmp_path)
    files = Files(tmp_path)
    expected = model.decoder().decode(places())
    assert np.ptp(expected, axis=0).min() > 0, "the light varies"
    # float32 in the decoder.
    np.testing.assert_allclose(files.values(places()), expected, rtol=0, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("settings", SHAPES, ids=str)
def test_the_reference_is_the_files_light(settings, tmp_path):
    model = random_model(**settings)
    export(model, tmp_path)
    _, arrays = read_export(tmp_path)
    position = arrays["position"]
    assert arrays["values"].shape == (min(model.content.count, 64) + 1, model.outputs)
    values = Files(tmp_path).values(position)
    np.testing.assert_allclose(values, arrays["values"], rtol=0, atol=2e-5 * np.abs(values).max())
    outside = position[-1]
    assert (outside > ORIGIN + EXTENT * SIZE).all()


def test_the_lists_leave_nothing_out(tmp_path):
    for settings in ({}, {"support": "sphere"}):
        export(random_model(count=60, **settings), tmp_path)
        files = Files(tmp_path)
        x = files.place(places(400))
        side = max(files.info["size"]) / 8
        reach, listed = files.reach(), np.zeros((len(x), 60), bool)
        for i, cell in enumerate(np.floor(x / side)):
            low, high = cell * side - 1e-6, (cell + 1) * side + 1e-6
            listed[i] = ((files.centre + reach >= low) & (files.centre - reach <= high)).all(1)
        assert not files.weights(x)[~listed].any()
        assert listed.mean() < 0.9


def test_what_is_written(tmp_path):
    model = random_model(positions=True, dead=4)
    paths = export(model, tmp_path)
    assert [path.name for path in paths] == [
        "gaussians.bin",
        "network.bin",
        "position.bin",
        "positions.bin",
        "probe.glsl",
        "values.bin",
        "bundle.json",
    ]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    info, arrays = read_export(tmp_path)
    assert (info["source"], info["probes"], info["gaussians"]) == (model.source, 200, 40)
    assert info["dead"] == np.flatnonzero(model.dead).tolist() and len(info["dead"]) == 4
    assert set(info["about"]) >= {"position", "gaussian", "network", "lists", "dead", "positions", "reference"}
    codes = arrays["positions"].reshape(-1, 3)
    position = np.array(info["origin"]) + info["extent"] * np.array(info["size"]) * codes / 65535
    np.testing.assert_allclose(position, model.stored_positions(), rtol=1e-12)
    # As many bytes as half floats would take, but for the head (section 5.3.2).
    assert arrays["gaussians"].nbytes == 40 * 40 + 4 * (10 + 2 * 19)


def test_what_cannot_be_exported(tmp_path):
    model = random_model()
    net = model.content.net.copy()
    net[-5:] = np.inf
    with pytest.raises(WlmError, match="random: cannot export: the model decodes to NaN or infinity"):
        export(with_content(model, net=net), tmp_path / "new")
    for extent in (1e39, 1e-60):
        with pytest.raises(WlmError, match="random: cannot export: the probes' box is too"):
            export(replace(model, extent=extent), tmp_path / "new")
    with pytest.raises(WlmError, match="device 'tpu'"):
        export(model, tmp_path / "new", device="tpu")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(WlmError, match="cannot write there"):
        export(model, tmp_path / "file")


CALLER = """
layout(local_size_x = 64) in;
layout(std430, binding = 3) readonly buffer Lists { uint lists[]; };
layout(std430, binding = 4) buffer Results { float results[]; };
#define WLM_PROBE_LIST(i) lists[i]
%s
void main()
{
    int i = int(gl_GlobalInvocationID.x);
    vec3 position = vec3(float(i), 0.5, 0.25);
    float values[WLM_PROBE_OUTPUTS];
    wlm_probe_values_listed(wlm_probe_place(position), 8, 4, values);
    for (int c = 0; c < WLM_PROBE_OUTPUTS; ++c)
        results[c] = values[c];
    %s
}
"""
SH_CALLER = """vec3 sh[%d];
    wlm_probe_sh(position, sh);
    results[0] += sh[0].x;
    wlm_probe_sh_listed(position, 0, 2, sh);
    results[0] += sh[0].y;"""


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("settings", SHAPES, ids=str)
@pytest.mark.parametrize(("version", "options"), [(430, []), (450, ["-V", "-o", "shader.spv"])])
def test_the_shader_compiles(settings, version, options, tmp_path):
    model = random_model(**settings)
    sh = SH_CALLER % (model.outputs // 3) if model.outputs % 3 == 0 else ""
    (tmp_path / "shader.comp").write_text(f"#version {version}\n" + CALLER % (probe_glsl(model.content), sh))
    done = subprocess.run(["glslangValidator", *options, "shader.comp"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


def test_the_shader_depends_on_the_shape_alone():
    assert probe_glsl(random_model(seed=0).content) == probe_glsl(random_model(seed=1, count=9, bits=7).content)
    assert probe_glsl(random_model().content) != probe_glsl(random_model(support="sphere").content)


# GLSL's vectors and functions for a C++ compiler, in single precision as a GPU has it.
SHIM = """
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>
typedef uint32_t uint;
struct vec2 { float x, y; };
struct vec3 { float x, y, z; vec3() {} vec3(float x, float y, float z) : x(x), y(y), z(z) {} };
struct vec4 { float x, y, z, w; vec4() {} vec4(float x, float y, float z, float w) : x(x), y(y), z(z), w(w) {}
    float& operator[](int i) { return (&x)[i]; } };
struct mat4 { vec4 c[4]; mat4(vec4 a, vec4 b, vec4 d, vec4 e) { c[0] = a; c[1] = b; c[2] = d; c[3] = e; } };
vec3 operator*(float s, vec3 a) { return vec3(s * a.x, s * a.y, s * a.z); }
vec3 operator+(vec3 a, vec3 b) { return vec3(a.x + b.x, a.y + b.y, a.z + b.z); }
vec3 operator-(vec3 a, vec3 b) { return vec3(a.x - b.x, a.y - b.y, a.z - b.z); }
vec3 operator/(vec3 a, vec3 b) { return vec3(a.x / b.x, a.y / b.y, a.z / b.z); }
vec3 operator/(vec3 a, float s) { return vec3(a.x / s, a.y / s, a.z / s); }
vec4 operator*(vec4 a, float s) { return vec4(a.x * s, a.y * s, a.z * s, a.w * s); }
vec4 operator+(vec4 a, vec4 b) { return vec4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w); }
vec4 operator-(vec4 a) { return vec4(-a.x, -a.y, -a.z, -a.w); }
vec4 operator/(vec4 a, vec4 b) { return vec4(a.x / b.x, a.y / b.y, a.z / b.z, a.w / b.w); }
void operator+=(vec4& a, vec4 b) { a = a + b; }
vec4 operator*(mat4 m, vec4 v) { return m.c[0] * v.x + m.c[1] * v.y + m.c[2] * v.z + m.c[3] * v.w; }
float dot(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
vec3 cross(vec3 a, vec3 b)
{ return vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
float exp(float x) { return std::exp(x); }
float sqrt(float x) { return std::sqrt(x); }
float min(float a, float b) { return b < a ? b : a; }
float max(float a, float b) { return a < b ? b : a; }
vec4 exp(vec4 a) { return vec4(exp(a.x), exp(a.y), exp(a.z), exp(a.w)); }
vec4 min(vec4 a, vec4 b) { return vec4(min(a.x, b.x), min(a.y, b.y), min(a.z, b.z), min(a.w, b.w)); }
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
std::vector<uint> gaussians, network, lists;
#define WLM_PROBE_GAUSSIANS(i) gaussians[i]
#define WLM_PROBE_NETWORK(i) network[i]
#define WLM_PROBE_LIST(i) lists[i]
#define inout
#define out
#include "probe.glsl"
#undef out
void read(std::vector<uint>& to, const char* path)
{
    FILE* file = fopen(path, "rb");
    uint word;
    while (fread(&word, 4, 1, file) == 1) to.push_back(word);
    fclose(file);
}
// Positions on stdin; for each the values from all Gaussians, then those from a list of the odd and one of the even.
int main(int, char** argument)
{
    read(gaussians, argument[1]);
    read(network, argument[2]);
    int count = wlm_probe_count();
    for (int k = 1; k < count; k += 2) lists.push_back(k);
    int odd = lists.size();
    for (int k = 0; k < count; k += 2) lists.push_back(k);
    float p[3], values[WLM_PROBE_OUTPUTS];
    while (fread(p, 4, 3, stdin) == 3) {
        vec3 position(p[0], p[1], p[2]);
        for (int kind = 0; kind < 3; ++kind) {
#ifdef COEFFICIENTS
            vec3 sh[COEFFICIENTS];
            if (kind == 0) wlm_probe_sh(position, sh);
            else wlm_probe_sh_listed(position, kind == 1 ? 0 : odd, kind == 1 ? odd : count - odd, sh);
            for (int c = 0; c < COEFFICIENTS; ++c)
            { values[3 * c] = sh[c].x; values[3 * c + 1] = sh[c].y; values[3 * c + 2] = sh[c].z; }
#else
            vec3 x = wlm_probe_place(position);
            if (kind == 0) wlm_probe_values(x, values);
            else wlm_probe_values_listed(x, kind == 1 ? 0 : odd, kind == 1 ? odd : count - odd, values);
#endif
            fwrite(values, 4, WLM_PROBE_OUTPUTS, stdout);
        }
    }
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
@pytest.mark.parametrize("settings", SHAPES, ids=str)
def test_the_shaders_arithmetic(settings, tmp_path):
    model = random_model(**settings)
    folder = tmp_path / "export"
    export(model, folder)
    (tmp_path / "run.cpp").write_text(SHIM)
    program = tmp_path / "run"
    shape = [f"-DCOEFFICIENTS={model.outputs // 3}"] if model.outputs % 3 == 0 else []
    done = subprocess.run(
        ["g++", "-O1", "-std=c++14", *shape, "-I", folder, "-o", program, tmp_path / "run.cpp"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    files = Files(folder)
    position = np.concatenate([places(), read_export(folder)[1]["position"]]).astype(np.float32)
    words = [program, folder / "gaussians.bin", folder / "network.bin"]
    out = subprocess.run(words, input=position.tobytes(), capture_output=True, check=True).stdout
    values = np.frombuffer(out, np.float32).reshape(len(position), 3, model.outputs)
    x, latent = files.place(position.astype(np.float64)), files.latent
    for kind, chosen in enumerate((slice(None), slice(1, None, 2), slice(0, None, 2))):
        files.latent = np.zeros_like(latent)
        files.latent[chosen] = latent[chosen]
        expected = files.values(position.astype(np.float64))
        np.testing.assert_allclose(values[:, kind], expected, rtol=0, atol=2e-5 * np.abs(expected).max())
    assert files.weights(x).any()
