"""Probes for Unreal: its packing, read by the shader that is written with it, gives the light of ours."""

import json
import shutil
import struct
import subprocess

import numpy as np
import pytest
from builders.probe_models import random_model

import wlm
from benchmarks.rivals.probe import pack_unreal, unpack_unreal
from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.conventions import from_canonical
from wlm.probe.engines.lattice import lattice_of
from wlm.probe.engines.unreal import SH_FILES
from wlm.probe.sphere import fibonacci_sphere, irradiance

FILES = ("ambient.dds", *SH_FILES)
_HEADER = 148

# HLSL as C++.
_PRELUDE = """
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>
#define OPERATORS(T, EACH) \\
    T operator*(T a, T b) { return EACH(*); } T operator+(T a, T b) { return EACH(+); } \\
    T operator-(T a, T b) { return EACH(-); } T operator/(T a, T b) { return EACH(/); } \\
    T operator*(T a, double b) { return a * T(b); } T operator-(T a, double b) { return a - T(b); } \\
    T& operator+=(T& a, T b) { return a = a + b; }
struct float3 {
    float x, y, z;
    float3() {} float3(double v) : x(v), y(v), z(v) {} float3(double a, double b, double c) : x(a), y(b), z(c) {}
};
struct float4 {
    float x, y, z, w;
    float4() {} float4(double v) : x(v), y(v), z(v), w(v) {}
    float4(double a, double b, double c, double d) : x(a), y(b), z(c), w(d) {}
    float3 three() { return float3(x, y, z); }
};
#define THREE(o) float3(a.x o b.x, a.y o b.y, a.z o b.z)
#define FOUR(o) float4(a.x o b.x, a.y o b.y, a.z o b.z, a.w o b.w)
OPERATORS(float3, THREE)
OPERATORS(float4, FOUR)
float3 max(float3 a, float3 b) { return float3(std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)); }
struct SamplerState {};
struct Texels {
    int size[3];
    std::vector<float4> texel;
    float4 SampleLevel(SamplerState, float3 uvw, int) {
        float place[3] = {uvw.x, uvw.y, uvw.z};
        float4 sum(0);
        for (int corner = 0; corner < 8; corner++) {
            int at = 0;
            float weight = 1;
            for (int a = 2; a >= 0; a--) {
                float x = place[a] * size[a] - 0.5f, whole = std::floor(x);
                int side = corner >> a & 1;
                weight *= side ? x - whole : 1 - (x - whole);
                at = at * size[a] + std::min(std::max(int(whole) + side, 0), size[a] - 1);
            }
            sum += texel[at] * weight;
        }
        return sum;
    }
};
typedef Texels& Texture3D;
#define out
#define xyz three()
"""
_MAIN = """
int main()
{
    Texels t[7];
    for (Texels& each : t) {
        std::fread(each.size, 4, 3, stdin);
        each.texel.resize(each.size[0] * each.size[1] * each.size[2]);
        std::fread(each.texel.data(), 16, each.texel.size(), stdin);
    }
    float p[6];
    while (std::fread(p, 4, 6, stdin) == 6) {
        float3 sh[9], n(p[3], p[4], p[5]), place(p[0], p[1], p[2]);
        WlmProbeSh(t[0], t[1], t[2], t[3], t[4], t[5], t[6], SamplerState(), place, sh);
        std::fwrite(sh, 4, 27, stdout);
        float3 light = WlmProbeDiffuse(t[0], t[1], t[2], t[3], t[4], t[5], t[6], SamplerState(), place, n);
        std::fwrite(&light, 4, 3, stdout);
    }
}
"""


def _floats(code: np.ndarray, mantissa: int) -> np.ndarray:
    """Positive floats of 5 bits of exponent, as the DXGI format states them."""
    exponent, fraction = code >> mantissa, (code & ((1 << mantissa) - 1)) / (1 << mantissa)
    return np.where(exponent > 0, (1.0 + fraction) * 2.0 ** (exponent.astype(float) - 15.0), fraction * 2.0**-14)


def _texture(content: bytes) -> np.ndarray:
    """float32 [depth, height, width, 4] of a DDS file."""
    height, width = struct.unpack_from("<2I", content, 12)
    (depth,), (kind,) = struct.unpack_from("<I", content, 24), struct.unpack_from("<I", content, 128)
    if kind == 28:
        texel = np.frombuffer(content, np.uint8, offset=_HEADER).reshape(-1, 4) / 255.0
    else:
        assert kind == 26
        word = np.frombuffer(content, "<u4", offset=_HEADER)
        parts = (_floats(word & 2047, 6), _floats(word >> 11 & 2047, 6), _floats(word >> 22, 5), np.ones(len(word)))
        texel = np.stack(parts, -1)
    return texel.astype("<f4").reshape(depth, height, width, 4)


@pytest.fixture(scope="module")
def model() -> wlm.probe.ProbeModel:
    random = np.random.default_rng(0)
    position = random.uniform(0, 1, (60, 3)) * [6.0, 3.0, 4.0] + [100.0, -7.0, 20.0]
    values = random.uniform(-0.4, 0.4, (60, 9, 3))
    values[:, 0] = np.exp(position[:, :1] - 103.0) * [1.0, 0.6, 0.3]
    values[:, 1:] *= values[:, :1]
    return wlm.probe.compress(wlm.probe.from_arrays(position, values), positions=True)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
def test_the_shader_reads_the_light(model, tmp_path):
    paths = export(model, tmp_path / "out", "unreal", cells=6)
    assert {path.name for path in paths} == {*FILES, "WlmProbes.usf", "light.json", "bundle.json"}
    paths = [tmp_path / "out" / name for name in (*FILES, "WlmProbes.usf")]
    content = json.loads((tmp_path / "out" / "light.json").read_text())
    count = np.array(content["resolution"])
    assert count[0] == 6 and len(set(count.tolist())) == 3
    centre = lattice_of(model, 6, 128, None, "cpu").centres()
    light = model.decoder().decode(centre).reshape(-1, 9, 3)
    turned = from_canonical(light.astype(float), "unreal")
    stored = unpack_unreal(pack_unreal(turned.reshape(-1, 27), 3), 27, 3).reshape(-1, 9, 3)
    textures = b"".join(count.astype("<i4").tobytes() + _texture(path.read_bytes()).tobytes() for path in paths[:7])
    normal = fibonacci_sphere(len(centre))
    middle = 0.5 * (centre[0] + centre[1])
    sent = np.concatenate([np.concatenate([centre, middle[None]]), np.concatenate([normal, normal[:1]])], 1)
    (tmp_path / "run.cpp").write_text(_PRELUDE + paths[7].read_text() + "#undef out\n" + _MAIN)
    subprocess.run(["g++", "-O1", "-std=c++17", "-o", "run", "run.cpp"], cwd=tmp_path, check=True)
    done = subprocess.run(
        [tmp_path / "run"], input=textures + sent.astype("<f4").tobytes(), capture_output=True, check=True
    )
    got = np.frombuffer(done.stdout, "<f4").reshape(-1, 10, 3)
    peak = light[:, 0].max()
    np.testing.assert_allclose(got[:-1, :9], stored, atol=1e-4 * peak)
    np.testing.assert_allclose(got[:-1, :9], turned, atol=0.03 * peak)
    shown = [irradiance(each, n[None])[0] / np.pi for each, n in zip(light, normal, strict=True)]
    np.testing.assert_allclose(got[:-1, 9], shown, atol=0.02 * peak)
    np.testing.assert_allclose(got[-1, 0], stored[:2, 0].mean(0), rtol=1e-4)


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
def test_the_shader_compiles(model, tmp_path):
    export(model, tmp_path, "unreal", cells=2)
    names = ("Ambient", *(f"Sh{number}" for number in range(6)))
    declared = "".join(f"Texture3D {name} : register(t{number});\n" for number, name in enumerate(names))
    call = f"o[0] = WlmProbeDiffuse({', '.join(names)}, S, float3(1, 2, 3), float3(0, 1, 0));"
    main = f"RWStructuredBuffer<float3> o : register(u0);\n[numthreads(1, 1, 1)] void main() {{ {call} }}\n"
    text = declared + "SamplerState S : register(s0);\n" + (tmp_path / "WlmProbes.usf").read_text() + main
    (tmp_path / "shader.comp").write_text(text)
    command = ["glslangValidator", "-D", "-V", "-e", "main", "shader.comp"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_what_is_refused(model, tmp_path):
    bright = wlm.probe.compress(wlm.probe.from_arrays(np.eye(3), np.full((3, 27), 1e6)), positions=True)
    for made, settings, message in [
        (random_model(outputs=12, positions=True), {}, "expected L2 in RGB"),
        (model, {"cells": 129}, "cells: expected 1 to 128"),
        (bright, {}, "expected light within 64512"),
    ]:
        with pytest.raises(WlmError, match=message):
            export(made, tmp_path / "out", "unreal", **settings)
    assert not (tmp_path / "out").exists()
