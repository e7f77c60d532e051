"""Runs our Metal on a machine without Metal: as the C++ that it is, with the little of its library that we use."""

import re
import shutil
import subprocess

import numpy as np
import pytest

_LIBRARY = """
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <vector>
typedef uint32_t uint;
#define constant
#define device
#define thread
template <class T, int N> struct vec {
    T v[N];
    vec() : v{} {}
    explicit vec(T s) { for (T& each : v) each = s; }
    template <class U> explicit vec(vec<U, N> o) { for (int i = 0; i < N; ++i) v[i] = T(o.v[i]); }
    vec(T x, T y) : v{x, y} {}
    vec(T x, T y, T z) : v{x, y, z} {}
    vec(T x, T y, T z, T w) : v{x, y, z, w} {}
    vec(vec<T, 2> a, T z) : v{a.v[0], a.v[1], z} {}
    vec(vec<T, 2> a, vec<T, 2> b) : v{a.v[0], a.v[1], b.v[0], b.v[1]} {}
    vec(vec<T, 2> a, T z, T w) : v{a.v[0], a.v[1], z, w} {}
    vec(vec<T, 3> a, T w) : v{a.v[0], a.v[1], a.v[2], w} {}
    T& operator[](int i) { return v[i]; }
    T& x() { return v[0]; } T& y() { return v[1]; } T& z() { return v[2]; } T& w() { return v[3]; }
    T& r() { return v[0]; } T& g() { return v[1]; } T& b() { return v[2]; } T& a() { return v[3]; }
    vec<T, 2> xy() { return vec<T, 2>(v[0], v[1]); }
    vec<T, 2> zw() { return vec<T, 2>(v[2], v[3]); }
    vec<T, 3> xyz() { return vec<T, 3>(v[0], v[1], v[2]); }
    vec<T, 3> rgb() { return xyz(); }
};
#define OPERATOR(o) \\
    template <class T, int N> vec<T, N> operator o(vec<T, N> a, vec<T, N> b) \\
    { for (int i = 0; i < N; ++i) a.v[i] = a.v[i] o b.v[i]; return a; } \\
    template <class T, int N, class U> vec<T, N> operator o(vec<T, N> a, U b) { return a o vec<T, N>(T(b)); } \\
    template <class T, int N, class U> vec<T, N> operator o(U a, vec<T, N> b) { return vec<T, N>(T(a)) o b; } \\
    template <class T, int N, class U> vec<T, N>& operator o##=(vec<T, N>& a, U b) { return a = a o b; }
OPERATOR(+) OPERATOR(-) OPERATOR(*) OPERATOR(/)
template <class T, int N> vec<T, N> operator-(vec<T, N> a) { return T(0) - a; }
#define WHOLE(o) template <int N> vec<uint, N> operator o(vec<uint, N> a, vec<uint, N> b) \\
    { for (int i = 0; i < N; ++i) a.v[i] = a.v[i] o b.v[i]; return a; }
WHOLE(>>) WHOLE(&)
typedef vec<float, 2> float2; typedef vec<float, 3> float3; typedef vec<float, 4> float4;
typedef vec<int, 2> int2; typedef vec<int, 3> int3; typedef vec<uint, 2> uint2; typedef vec<uint, 4> uint4;
namespace metal {
#define ONE(f, e) inline float f(float x) { return e; } \\
    template <int N> vec<float, N> f(vec<float, N> a) { for (float& x : a.v) x = f(x); return a; }
ONE(floor, std::floor(x)) ONE(abs, std::fabs(x)) ONE(exp, std::exp(x)) ONE(tanh, std::tanh(x)) ONE(sqrt, std::sqrt(x))
ONE(sign, float((x > 0) - (x < 0)))
#define TWO(f, e) template <class T> T f(T a, T b) { return e; } \\
    template <class T, int N> vec<T, N> f(vec<T, N> x, vec<T, N> y) \\
    { for (int i = 0; i < N; ++i) x.v[i] = f(x.v[i], y.v[i]); return x; }
TWO(min, std::min(a, b)) TWO(max, std::max(a, b)) TWO(pow, std::pow(a, b))
inline float clamp(float x, float a, float b) { return min(max(x, a), b); }
template <int N> vec<float, N> clamp(vec<float, N> x, vec<float, N> a, vec<float, N> b) { return min(max(x, a), b); }
inline float mix(float a, float b, float s) { return a + s * (b - a); }
template <int N, class S> vec<float, N> mix(vec<float, N> a, vec<float, N> b, S s) { return a + s * (b - a); }
inline float dot(float3 a, float3 b) { return a.x() * b.x() + a.y() * b.y() + a.z() * b.z(); }
inline float3 cross(float3 a, float3 b) { return float3(a.y() * b.z() - a.z() * b.y(), a.z() * b.x() - a.x() * b.z(),
    a.x() * b.y() - a.y() * b.x()); }
template <class T, class U> T as_type(U word) { T out; static_assert(sizeof out == sizeof word, "");
    std::memcpy(&out, &word, sizeof out); return out; }
typedef vec<_Float16, 2> half2;
enum class filter { linear }; enum class mip_filter { linear }; enum class address { clamp_to_edge };
struct sampler { constexpr sampler(filter, mip_filter, address) {} };
struct level { level(int) {} };
struct gradient2d { gradient2d(float2, float2) {} };
inline float length(float2 a) { return std::sqrt(a.x() * a.x() + a.y() * a.y()); }
inline float log2(float a) { return std::log2(a); }
template <class T> struct texture2d_array {
    int width, height; std::vector<vec<T, 4>> texels;
    int get_width() const { return width; } int get_height() const { return height; }
    vec<T, 4> read(uint2 p, uint layer, int) const { return texels.at((layer * height + p.y()) * width + p.x()); }
    vec<T, 4> sample(sampler, float2 at, uint layer, level) const {
        float x = clamp(at.x() * width - 0.5f, 0.f, width - 1.f), y = clamp(at.y() * height - 0.5f, 0.f, height - 1.f);
        uint i = x, j = y, k = std::min(int(i) + 1, width - 1), l = std::min(int(j) + 1, height - 1);
        return mix(mix(read({i, j}, layer, 0), read({k, j}, layer, 0), x - i),
                   mix(read({i, l}, layer, 0), read({k, l}, layer, 0), x - i), y - j); } };
template <class T> struct texture2d : texture2d_array<T> {
    vec<T, 4> read(uint2 p, int) const { return texture2d_array<T>::read(p, 0, 0); }
    vec<T, 4> sample(sampler s, float2 at, level l) const { return texture2d_array<T>::sample(s, at, 0, l); }
    vec<T, 4> sample(sampler s, float2 at, gradient2d) const { return sample(s, at, level(0)); } };
}
template <class N> void load(N& out, const char* path)
{
    FILE* file = std::fopen(path, "rb"); int size[3];
    if (std::fread(size, 4, 3, file) != 3) std::exit(1);
    out.width = size[0], out.height = size[1], out.texels.resize(size[0] * size[1] * size[2]);
    if (std::fread(out.texels.data(), 16, out.texels.size(), file) != out.texels.size()) std::exit(1);
    std::fclose(file);
}
template <class T> const T* load_buffer(const char* path)
{
    FILE* file = std::fopen(path, "rb"); std::vector<T>* out = new std::vector<T>; T value;
    while (std::fread(&value, sizeof value, 1, file) == 1) out->push_back(value);
    return out->data();
}
"""


def run_metal(text, expression, size, bound, folder):
    """Computes one picture, float32 [height, width, 4]."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler: install g++")
    name = re.search(r"^struct (\w+)", text, re.MULTILINE)[1]
    body = text.replace("#include <metal_stdlib>", "").replace("constexpr constant", "static const")
    # C++ has no swizzles; a word with a point before it and no bracket behind is one. Metal's numbers are floats.
    body = re.sub(r"(?<=[\w)\]])\.([xyzwrgba]{1,4})\b(?!\()", r".\1()", body)
    body = re.sub(r"(?<![\w.])(\d+\.\d*(?:e[-+]?\d+)?|\d+e[-+]?\d+)(?!\w)", r"\1f", body)
    loads = ""
    for kind, member in re.findall(r"^    (texture2d\w*<\w+>) (\w+);", text, re.MULTILINE):
        values = bound[member]
        values = values / 255.0 if values.dtype == np.uint8 else values
        layers = values.reshape(-1, *values.shape[-3:])
        whole = np.zeros((*layers.shape[:3], 4), np.uint32 if "uint" in kind else np.float32)
        whole[..., : layers.shape[3]] = layers
        head = np.array([layers.shape[2], layers.shape[1], len(layers)], np.int32)
        (folder / f"{member}.bin").write_bytes(head.tobytes() + whole.tobytes())
        loads += f'    load(shader.{member}, "{member}.bin");\n'
    for kind, member in re.findall(r"^    (?:device const|constant) (\w+)\* (\w+);", text, re.MULTILINE):
        values = bound[member]
        values = values[..., :3] if kind == "float3" else values
        (folder / f"{member}.bin").write_bytes(np.ascontiguousarray(values).tobytes())
        loads += f'    shader.{member} = const_cast<{kind}*>(load_buffer<{kind}>("{member}.bin"));\n'
    program = f"""{_LIBRARY}{body}
int main()
{{
    {name} shader;
{loads}    for (int y = 0; y < {size[0]}; ++y) for (int x = 0; x < {size[1]}; ++x) {{
        int2 pixel(x, y);
        float4 light = shader.{expression};
        std::fwrite(light.v, 4, 4, stdout);
    }}
}}
"""
    (folder / "run.cpp").write_text(program)
    words = ["g++", "-O1", "-std=c++17", "-w", "-o", "run", "run.cpp"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:3000]
    out = subprocess.run([folder / "run"], cwd=folder, capture_output=True, check=True).stdout
    return np.frombuffer(out, np.float32).reshape(*size, 4)
