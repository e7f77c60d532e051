"""Probes for three.js, Unity, Unreal and Godot: the layout, the light that an engine shows, and what is refused."""

import json
import re
import struct

import numpy as np
import pytest
from builders.checks import error_of
from builders.godot_bakes import Writer, bake
from builders.probe_models import random_model
from builders.shader_runs import compiled, run_glsl

import wlm
from benchmarks.rivals.probe import pack_unreal, unpack_unreal
from wlm.export import export
from wlm.formats.godot import read_lmbake, relit
from wlm.probe.axes import read_axes
from wlm.probe.conventions import from_canonical
from wlm.probe.data import from_arrays, save_probes
from wlm.probe.engines.lattice import lattice_of
from wlm.probe.engines.unreal import SH_FILES
from wlm.probe.sphere import fibonacci_sphere, irradiance


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A model and its grid: 6 x 3 x 5 cells of a box of 8 x 3 x 6."""
    model = random_model()
    folder = tmp_path_factory.mktemp("grid") / "out"
    export(model, folder, "three", cells=6)
    return model, folder


def test_texture_as_three_lays_it_out(grid):
    model, folder = grid
    info = json.loads((folder / "grid.json").read_text())
    nx, ny, nz = info["resolution"]
    assert (nx, ny, nz) == (6, 3, 5)
    box = np.array(info["box"])
    np.testing.assert_allclose(box.mean(0), model.origin + model.extent * model.size / 2)
    np.testing.assert_allclose(np.array(info["corners"]) - box, [[2 / 3] * 3, [-2 / 3] * 3])
    texels = np.frombuffer((folder / "grid.ktx2").read_bytes()[-nx * ny * 7 * (nz + 2) * 8 :], "<f2")
    texels = texels.reshape(7, nz + 2, ny, nx, 4)
    decoder = model.decoder()
    for x, y, z in [(0, 0, 0), (5, 2, 4), (3, 1, 2)]:
        place = box[0] + (np.array([x, y, z]) + 0.5) * 4 / 3
        got = texels[:, 1 + z, y, x].reshape(-1)
        np.testing.assert_allclose(got[:27], decoder.decode(place[None])[0], rtol=1e-3, atol=1e-6)
        assert got[27] == 0.0
    np.testing.assert_array_equal(texels[:, 0], texels[:, 1])
    np.testing.assert_array_equal(texels[:, -1], texels[:, -2])


def shade(sh: np.ndarray, n: np.ndarray) -> np.ndarray:
    """What Unity shows: SphericalHarmonicsL2.Evaluate of sh[channel, coefficient] at normals [M, 3]."""
    x, y, z = n.T
    terms = [x * 0 + 1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return np.stack([sum(sh[channel, c] * terms[c] for c in range(9)) for channel in range(3)], -1)


@pytest.mark.parametrize("mirror", [None, "x", "y", "z"])
@pytest.mark.parametrize("outputs", [27, 12])
def test_unity_shows_the_same_light(mirror, outputs, tmp_path):
    model = random_model(outputs=outputs, probes=20, positions=True)
    axes = mirror and ",".join("-" * (axis == mirror) + axis for axis in "xyz")
    export(model, tmp_path / "out", "unity", axes=axes)
    content = json.loads((tmp_path / "out" / "probes.json").read_text())
    position = np.array(content["position"]).reshape(-1, 3)
    sh = np.array(content["sh"]).reshape(-1, 3, 9)
    flip = np.array([-1.0 if axis == mirror else 1.0 for axis in "xyz"])
    np.testing.assert_allclose(position * flip, model.stored_positions(), rtol=1e-6)
    normals = fibonacci_sphere(16)
    values = model.decoder().decode_probes()
    expected = irradiance(values.reshape(20, -1, 3), normals) / np.pi
    seen = np.stack([shade(each, normals * flip) for each in sh])
    np.testing.assert_allclose(seen, expected, atol=1e-5 * np.abs(expected).max())
    assert (sh[model.dead] == 0).all()
    script = (tmp_path / "out" / "WlmLightProbes.cs").read_text()
    assert f'"{content["format"]}"' in script and f"version != {content['version']}" in script


FILES = ("ambient.dds", *SH_FILES)
_HEADER = 148

# HLSL as GLSL: a volume is an array of slices.
_PRELUDE = """
#define float3 vec3
#define float4 vec4
#define Texture3D sampler2DArray
#define SamplerState int
vec4 sampled(sampler2DArray slices, vec3 uvw)
{
    float count = float(textureSize(slices, 0).z), z = clamp(uvw.z * count - 0.5, 0.0, count - 1.0);
    return mix(texture(slices, vec3(uvw.xy, floor(z))), texture(slices, vec3(uvw.xy, ceil(z))), fract(z));
}
"""
_MAIN = """
    vec3 place = texelFetch(u_points, ivec2(pixel.x, 0), 0).xyz;
    vec3 normal = texelFetch(u_points, ivec2(pixel.x, 1), 0).xyz;
    vec3 sh[9];
    WlmProbeSh(TEXTURES, 0, place, sh);
    light = vec4(pixel.y < 9 ? sh[pixel.y] : WlmProbeDiffuse(TEXTURES, 0, place, normal), 1.0);
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


def test_the_shader_reads_the_light(model, tmp_path):
    paths = export(model, tmp_path / "out", "unreal", cells=6)
    assert {path.name for path in paths} == {*FILES, "WlmProbes.usf", "light.json", "bundle.json"}
    paths = [tmp_path / "out" / name for name in (*FILES, "WlmProbes.usf")]
    content = json.loads((tmp_path / "out" / "light.json").read_text())
    count = np.array(content["resolution"])
    assert count[0] == 6 and len(set(count.tolist())) == 3
    centre = lattice_of(model, 6, 128, None, "cpu", None).centres()
    light = model.decoder().decode(centre).reshape(-1, 9, 3)
    turned = from_canonical(light.astype(float), "unreal")
    stored = unpack_unreal(pack_unreal(turned.reshape(-1, 27), 3), 27, 3).reshape(-1, 9, 3)
    textures = {f"u_{path.stem}": _texture(path.read_bytes()) for path in paths[:7]}
    middle = 0.5 * (centre[0] + centre[1])
    normal = fibonacci_sphere(len(centre))
    sent = np.stack([np.concatenate([centre, middle[None]]), np.concatenate([normal, normal[:1]])])
    head = "".join(f"uniform sampler2DArray {name};\n" for name in textures) + "uniform sampler2D u_points;\n"
    text = re.sub(r"(\w+)\.SampleLevel\(state, uvw, 0\)", r"sampled(\1, uvw)", paths[7].read_text())
    text = _PRELUDE + head + text.replace("static const", "const")
    main = _MAIN.replace("TEXTURES", ", ".join(textures))
    drawn = run_glsl(text, main, (10, len(centre) + 1), textures | {"u_points": sent.astype(np.float32)})
    got = drawn[..., :3].transpose(1, 0, 2)
    peak = light[:, 0].max()
    np.testing.assert_allclose(got[:-1, :9], stored, atol=1e-4 * peak)
    np.testing.assert_allclose(got[:-1, :9], turned, atol=0.03 * peak)
    shown = [irradiance(each, n[None])[0] / np.pi for each, n in zip(light, normal, strict=True)]
    np.testing.assert_allclose(got[:-1, 9], shown, atol=0.02 * peak)
    np.testing.assert_allclose(got[-1, 0], stored[:2, 0].mean(0), rtol=1e-4)


def test_the_shader_compiles(model, tmp_path):
    export(model, tmp_path, "unreal", cells=2)
    names = ("Ambient", *(f"Sh{number}" for number in range(6)))
    declared = "".join(f"Texture3D {name} : register(t{number});\n" for number, name in enumerate(names))
    call = f"o[0] = WlmProbeDiffuse({', '.join(names)}, S, float3(1, 2, 3), float3(0, 1, 0));"
    main = f"RWStructuredBuffer<float3> o : register(u0);\n[numthreads(1, 1, 1)] void main() {{ {call} }}\n"
    text = declared + "SamplerState S : register(s0);\n" + (tmp_path / "WlmProbes.usf").read_text() + main
    compiled(text, tmp_path, "-D", "-e", "main")


def packed(data: bytes, key: str, kind: int, form: str, each: int) -> np.ndarray:
    """A packed array of the dictionary, found by its key."""
    mark = struct.pack("<I", len(key) + 1) + key.encode() + b"\0" + struct.pack("<I", kind)
    at = data.index(mark) + len(mark)
    return np.frombuffer(data, form, struct.unpack_from("<I", data, at)[0] * each, at + 4)


def tap(data: bytes, place: np.ndarray) -> np.ndarray:
    """The light at a place as Godot's renderer finds it, in floats (lightmap_tap_sh_light); None outside."""
    points = packed(data, "points", 35, "<f4", 3).reshape(-1, 3)
    corners, tree = packed(data, "tetrahedra", 32, "<i4", 1).reshape(-1, 4), packed(data, "bsp", 32, "<i4", 1)
    light, tree = packed(data, "sh", 36, "<f4", 4).reshape(-1, 9, 4), tree.reshape(-1, 6)
    planes, place, node = tree[:, :4].view("<f4"), place.astype(np.float32), 0
    while node >= 0:
        over = planes[node, :3] @ place > planes[node, 3]
        following = tree[node, 4 if over else 5]
        assert following < 0 or following > node
        node = following
    corner = corners[-node - 1]
    frame = np.concatenate([points[corner].T, np.ones((1, 4))])
    weight = np.linalg.solve(frame.astype(np.float64), np.append(place, 1.0))
    assert (weight > -1e-4).all(), "the place isn't in its tetrahedron"
    return np.einsum("k,kcb->cb", weight.clip(0.0, 1.0), light[corner])


@pytest.mark.parametrize("cells", [1, 5])
def test_godot_finds_the_light_at_any_place(cells, tmp_path):
    model = random_model()
    export(model, tmp_path / "out", "godot", cells=cells)
    path = tmp_path / "out" / "light.lmbake"
    data, (points, light) = path.read_bytes(), read_lmbake(path)
    np.testing.assert_allclose(light.reshape(-1, 27) * np.pi, model.decoder().decode(points), rtol=1e-4, atol=1e-5)
    side, low, high = 8.0 / cells, points.min(0), points.max(0)
    assert (low <= model.origin).all() and (high >= model.origin + model.extent * model.size).all()
    random = np.random.default_rng(cells)
    for place in low + random.random((200, 3)) * (high - low):
        found = tap(data, place)
        assert (found[:, 3] == 0).all()
        # Between the corners of its cell, and their mix along the path of Kuhn's tetrahedron.
        at = ((place - low) / side).astype(int)
        rest = (place - low) / side - at
        order = np.argsort(-rest)
        step, expected, previous = np.zeros(3, int), 0.0, 1.0
        for axis in (*order, None):
            follow = rest[axis] if axis is not None else 0.0
            nearest = np.abs(points - (low + side * (at + step))).sum(1).argmin()
            expected = expected + (previous - follow) * light[nearest]
            previous = follow
            if axis is not None:
                step[axis] = 1
        np.testing.assert_allclose(found[:, :3], expected, atol=1e-4 * np.abs(light).max())


@pytest.mark.parametrize(("order", "double"), [("<", False), (">", True)])
def test_a_bake_keeps_all_but_its_light(order, double, tmp_path):
    random = np.random.default_rng(0)
    points, light = random.random((40, 3)) * 8.0, random.random((40, 9, 3)).astype(np.float32)
    light[3] = 0.0
    writer, path = Writer(order, double), tmp_path / "room.lmbake"
    path.write_bytes(writer.file(bake(writer, points, light)))
    probes = wlm.probe.load(path)
    model = wlm.probe.compress(probes)
    export(model, tmp_path / "out", "godot", original=path)
    made = tmp_path / "out" / "light.lmbake"
    old, new = path.read_bytes(), made.read_bytes()
    differ = np.flatnonzero(np.frombuffer(old, "u1") != np.frombuffer(new, "u1"))
    colours = old.index(b"sh\0") + 3 + 8
    assert len(old) == len(new) and colours <= differ.min() and differ.max() < colours + 40 * 9 * 16
    again = wlm.probe.load(made)
    np.testing.assert_array_equal(again.live, probes.live)
    expected = model.decoder(position=probes.position).decode_probes()
    np.testing.assert_allclose(again.values, expected, rtol=1e-6)
    np.testing.assert_array_equal(relit(made, read_lmbake(path)[1]), old)


@pytest.mark.parametrize("axes", ["x,z,-y", "-y,x,z"])
def test_axes_turn_the_light_with_the_scene(axes, tmp_path):
    """In and out, mirrored and turned: the irradiance at a turned place and normal is that before."""
    model, matrix = random_model(probes=20, positions=True), read_axes(axes)
    position, values = model.stored_positions(), model.decoder().decode_probes()
    normals = fibonacci_sphere(16)
    save_probes(tmp_path / "a.npz", position, values)
    loaded = wlm.probe.load(tmp_path / "a.npz", axes=axes)
    assert loaded.source != wlm.probe.load(tmp_path / "a.npz").source
    np.testing.assert_allclose(loaded.position @ matrix, position)
    want = irradiance(values.reshape(20, 9, 3), normals)
    seen = irradiance(loaded.values.reshape(20, 9, 3), normals @ matrix.T)
    np.testing.assert_allclose(seen, want, rtol=1e-4, atol=1e-5)
    export(model, tmp_path / "bevy", "bevy", cells=3, axes=axes)
    made = json.loads((tmp_path / "bevy" / "light.json").read_text())
    volume = wlm.probe.load(tmp_path / "bevy" / "light.vxgi.ktx2")
    places = np.array(made["translation"]) + volume.position * made["scale"]
    straight = model.decoder().decode(places @ matrix).reshape(-1, 9, 3)
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    want = np.maximum(irradiance(straight, faces @ matrix), 0.0)  # a texel holds no negative light
    np.testing.assert_allclose(irradiance(volume.values.reshape(-1, 9, 3), faces), want, atol=0.02 * want.max())


def _bake_file(folder):
    path = folder / "a.lmbake"
    points = np.random.default_rng(0).random((9, 3))
    path.write_bytes(Writer().file(bake(Writer(), points, np.ones((9, 9, 3)))))
    return path


REFUSED = {
    "three": [
        ({"outputs": 12}, {}, "expected 27 numbers per probe"),
        ({}, {"cells": 0}, "cells: expected"),
        ({}, {"cells": 257}, "cells: expected"),
    ],
    "unity": [
        ({"outputs": 48, "positions": True}, {}, "expected 3, 12 or 27 numbers per probe"),
        ({"outputs": 5, "positions": True}, {}, "expected 3, 12 or 27 numbers per probe"),
        ({"positions": True}, {"axes": "x,y,w"}, "axes: expected three of x, y, z"),
        ({"positions": True}, {"axes": "x,y,y"}, "axes: expected three of x, y, z"),
        ({}, {}, "stores no positions"),
        ({}, {"original": _bake_file}, "expected the 200 probes"),
    ],
    "unreal": [
        ({"outputs": 12}, {}, "expected 27 numbers per probe"),
        ({}, {"cells": 129}, "cells: expected 1 to 128"),
        (np.full((3, 27), 1e6), {}, "expected light within 64512"),
    ],
    "godot": [
        ({"outputs": 12}, {}, "expected 27 numbers per probe"),
        ({"outputs": 12}, {"original": _bake_file}, "expected 27 numbers per probe"),
        ({}, {"axes": "x,z,-y", "original": _bake_file}, "axes: expected none with"),
        ({}, {"cells": 65}, "cells: expected 1 to 64"),
        ({}, {"cells": 4, "original": _bake_file}, "cells: expected none"),
        ({}, {"original": _bake_file}, "a.lmbake: expected the 200 probes"),
        (np.ones((9, 27)), {}, "stores no positions"),
    ],
}


@pytest.mark.parametrize("engine", REFUSED)
def test_what_an_engine_refuses(engine, tmp_path):
    for made, settings, message in REFUSED[engine]:
        if isinstance(made, dict):
            model = random_model(**made)
        else:
            places = np.random.default_rng(0).random((len(made), 3))
            model = wlm.probe.compress(from_arrays(places, made), positions=engine == "unreal")
        settings = {name: value(tmp_path) if callable(value) else value for name, value in settings.items()}
        assert re.search(message, error_of(export, model, tmp_path / "out", engine, **settings))
    assert not (tmp_path / "out").exists()
