"""A volume's export: buffers that hold what is read, and shaders that read it, compiled and run as C++."""

import shutil
import subprocess

import numpy as np
import pytest
from builders.exported import read_export

from wlm.errors import WlmError
from wlm.export import export
from wlm.export.shading import translate
from wlm.probe.sphere import irradiance
from wlm.probe.volume.bundle import volume_bundle
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.shader import volume_glsl


@pytest.fixture(scope="module")
def volume() -> Volume:
    """Half done, so that there are holes, far from the origin, on both sides of a block's number 0."""
    random = np.random.default_rng(0)
    position = random.uniform(-1, 1, (400, 3)) * [9.0, 1.0, 9.0] + [4000.0, -30.0, 0.0]
    made = Volume(position, StoredLight(random.normal(size=(400, 27))), side=8, budget=40)
    for _ in range(6):
        made.update([4000.3, -29.0, 0.2])
    return made


# GLSL's types for a C++ compiler.
_PRELUDE = """
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>
typedef uint32_t uint;
struct vec3 { float x, y, z; vec3(float x, float y, float z) : x(x), y(y), z(z) {} };
vec3 operator*(float s, vec3 v) { return vec3(s * v.x, s * v.y, s * v.z); }
vec3& operator+=(vec3& a, vec3 b) { a.x += b.x; a.y += b.y; a.z += b.z; return a; }
template <class T, class U> T min(T a, U b) { return a < (T)b ? a : (T)b; }
template <class T, class U> T max(T a, U b) { return a > (T)b ? a : (T)b; }
float floor(float x) { return std::floor(x); }
float uintBitsToFloat(uint i) { float f; std::memcpy(&f, &i, 4); return f; }
template <class T> std::vector<T> load(const char* path)
{
    std::vector<T> data;
    FILE* file = std::fopen(path, "rb");
    T value;
    while (std::fread(&value, sizeof value, 1, file) == 1) data.push_back(value);
    std::fclose(file);
    return data;
}
std::vector<uint> head = load<uint>("volume.bin");
std::vector<int> pages = load<int>("pages.bin");
std::vector<float> pool = load<float>("pool.bin");
#define WLM_VOLUME_HEAD(i) head.at(i)
#define WLM_VOLUME_PAGE(i) pages.at(i)
#define WLM_VOLUME_POOL(i) pool.at(i)
#define out
"""
_MAIN = """
#undef out
int main()
{
    float p[6];
    while (std::fread(p, 4, 6, stdin) == 6) {
        float values[27];
        float weight = wlm_volume_read(vec3(p[0], p[1], p[2]), vec3(0, 0, 0), values);
        std::fwrite(&weight, 4, 1, stdout);
        std::fwrite(values, 4, 27, stdout);
        vec3 n(p[3], p[4], p[5]);
        float ahead[27];
        wlm_volume_read(vec3(p[0], p[1], p[2]), n, ahead);
        std::fwrite(ahead, 4, 27, stdout);
        vec3 light = wlm_volume_diffuse(vec3(p[0], p[1], p[2]), n);
        std::fwrite(&light, 4, 3, stdout);
    }
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler is installed")
def test_the_shader_reads_what_the_volume_has(volume, tmp_path):
    export(volume_bundle(volume), tmp_path)
    document, arrays = read_export(tmp_path)
    points, weight = arrays["position"], arrays["weight"]
    assert (weight == 0.0).any() and ((weight > 0.1) & (weight < 0.9)).any() and (weight > 0.999).any()
    normals = np.random.default_rng(1).normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sent = np.concatenate([points - document["viewpoint"], normals], 1).astype("<f4").tobytes()
    (tmp_path / "run.cpp").write_text(_PRELUDE + (tmp_path / "probe.glsl").read_text() + _MAIN)
    subprocess.run(["g++", "-O1", "-std=c++14", "-o", "run", "run.cpp"], cwd=tmp_path, check=True)
    out = subprocess.run([tmp_path / "run"], cwd=tmp_path, input=sent, capture_output=True, check=True).stdout
    got = np.frombuffer(out, "<f4").reshape(-1, 58)
    np.testing.assert_allclose(got[:, 0], weight, atol=1e-5)
    # Divided by a small weight, a rounding of the place counts for more.
    want = arrays["values"]
    np.testing.assert_allclose(got[:, 1:28] * weight[:, None], want * weight[:, None], atol=2e-5)
    ahead = volume.read(points, normals)
    far = ahead.weight[:, None]
    np.testing.assert_allclose(got[:, 28:55] * far, ahead.values * far, atol=2e-5)
    shown = np.stack([irradiance(v.reshape(9, 3), n[None])[0] for v, n in zip(got[:, 28:55], normals, strict=True)])
    np.testing.assert_allclose(got[:, 55:], shown / np.pi, atol=2e-5)


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("outputs", [27, 5])
@pytest.mark.parametrize("language", ["glsl", "vulkan", "hlsl"])
def test_the_shaders_compile(language, outputs, tmp_path):
    if language == "hlsl":
        call = "RWStructuredBuffer<float> o : register(u0);\n[numthreads(1, 1, 1)] void main()\n"
        text, options = translate(volume_glsl(outputs), "hlsl") + call, ["-D", "-V", "-e", "main"]
        body = f"{{ float v[{outputs}]; float3 p = float3(1.0, 2.0, 3.0); o[0] = wlm_volume_read(p, p, v) + v[0]; }}\n"
    else:
        body = "layout(std430, binding = 7) buffer O { float o[]; };\n"
        body += f"void main() {{ float v[{outputs}]; vec3 p = vec3(1.0); o[0] = wlm_volume_read(p, p, v) + v[0]; }}\n"
        text, options = "#version 450\nlayout(local_size_x = 1) in;\n" + volume_glsl(outputs), []
        options = ["-V"] if language == "vulkan" else []
    (tmp_path / "shader.comp").write_text(text + body)
    done = subprocess.run(["glslangValidator", *options, "shader.comp"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_export_of_nothing_and_over_another(volume, tmp_path):
    nothing = Volume(volume.position, volume.light, side=8)
    with pytest.raises(ValueError, match="viewpoint"):
        _ = nothing.viewpoint
    with pytest.raises(WlmError, match="no block"):
        export(volume_bundle(nothing), tmp_path / "none")
    assert not (tmp_path / "none").exists()
    paths = export(volume_bundle(volume), tmp_path / "out")
    assert [path.exists() for path in paths] == [True] * 8 and export(volume_bundle(volume), tmp_path / "out") == paths
    document, arrays = read_export(tmp_path / "out")
    pages, pool = arrays["pages"].reshape(4, 8, 8, 8), arrays["pool"].reshape(-1, 27)
    values, valid = volume.unscroll()
    for level, described in enumerate(document["levels"]):
        place = np.argwhere(valid[level])
        block = place + np.array(described["base"]) - np.array(described["start"], int)
        np.testing.assert_array_equal(pool[pages[level][tuple((block % 8).T)]], values[level][tuple(place.T)])
    assert (pages >= 0).sum() == valid.sum() == len(pool)
    (tmp_path / "out" / "bundle.json").write_text("{}")
    with pytest.raises(WlmError):
        export(volume_bundle(volume), tmp_path / "out")
