"""Every shader that we export, in every language that runs here, beside what Python decodes."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED, off_borders
from builders.atlas_models import random_model as random_atlas
from builders.exported import read_export
from builders.probe_models import random_model as random_probes
from builders.shader_runs import (
    HEADS,
    compiled,
    lightmap_uniforms,
    run_glsl,
    run_glsl_compute,
    run_hlsl,
    run_wgsl,
    run_wgsl_compute,
)
from builders.shader_subjects import POINTS, Subject, points_of
from builders.smoke_shader_subjects import smoke_subjects
from builders.synthetic import random_model as random_lightmap

from benchmarks.atlas_exact import decode64
from wlm import probe
from wlm.atlas.bundle import sheet_texels
from wlm.atlas.colour import quantise
from wlm.atlas.decode import Decoder as AtlasDecoder
from wlm.atlas.model import AtlasModel, Profile, SheetPlace, pack_tiles
from wlm.atlas.shader import glsl as atlas_glsl
from wlm.errors import WlmError
from wlm.export import export
from wlm.export.shading import LANGUAGES, translate
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.shader import GROUP_SIZE
from wlm.lightmap.virtual.shader import sheet_words, virtual_glsl
from wlm.lightmap.virtual.texture import VirtualTexture
from wlm.probe.sphere import irradiance
from wlm.probe.volume.bundle import volume_bundle
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.shader import volume_glsl


def lightmap(kinds, folder, **settings) -> Subject:
    model = random_lightmap(kinds, **settings)
    export(model, folder)
    uniforms, hour = lightmap_uniforms(folder)
    (sheet,) = model.sheets.values()
    expected = SheetDecoder(sheet).frame(float(model.times[2]))
    main = "vec4 shown(ivec2 pixel) { return vec4(wlm_radiance(wlm_source(pixel)), 1.0); }\n"
    text, step = (folder / "lightmap.glsl").read_text(), expected.max() / 255
    return Subject(text, main, expected, uniforms | hour(2), "WLM_LIGHTMAP_EXACT", 0.01 * step, step)


def atlas(kind, _, colour="half") -> Subject:
    model = random_atlas(charts(), kind, colour)
    uv = np.random.default_rng(0).uniform(-0.1, 1.1, (1000, 2)).astype(np.float32)
    uv = np.concatenate([uv, [[0, 0], [1, 1], [0, 1], [0.5, 1]]]).astype(np.float32)
    uv = off_borders(model, uv)
    bound = {"u_points": points_of(uv), "wlm_atlas_colour": rgba(model.texels[0])}
    if model.method != "plain":
        tiles = model.method == "tiles"
        bound["wlm_atlas_lut"] = model.lut.astype(np.uint16) if tiles else (model.lut / 65535).astype(np.float32)
    if kind == MIXED:
        bound["wlm_atlas_blocks"] = rgba(model.block_texels[0])
    main = POINTS + "vec4 shown(ivec2 pixel) { return vec4(wlm_atlas(texelFetch(u_points, pixel, 0).xy), 1.0); }\n"
    # Neighbouring texels differ by up to 3, and a 512th of a step is lost along each axis. Where a table is filtered
    # too its own 512th is one of 65,535 steps' span, up to all 22 texels of the other texture.
    filtered = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    return Subject(atlas_glsl(model), main, decode64(model, uv)[None], bound, "WLM_ATLAS_EXACT", 3e-4, filtered)


def rgba(texels: np.ndarray) -> np.ndarray:
    return np.pad(texels.astype(np.float16), ((0, 0), (0, 0), (0, 1)))


def random_scene(short: bool, mixed: bool, apart: bool) -> AtlasModel:
    """Two sheets, the first with two smaller levels."""
    random = np.random.default_rng(1)
    texels = quantise(random.random((2 * 20, 24, 3)), "rgb9e5")["texels"].reshape(2, 20, 24, 3)
    size = random.integers(1, 8, (13, 11, 2))
    count = np.minimum(random.integers(0, 4, (13, 11)), 24 // size[..., 0])
    first = random.integers(0, np.array([24, 20]) - size * np.stack([np.maximum(count, 1), np.ones_like(count)], 2) + 1)
    second, blocks = {}, False
    if mixed:
        pages = [quantise(random.random((16, 24, 3)), "bc6h") for _ in range(2)]
        second = {"blocks": np.stack([page["blocks"] for page in pages])}
        second |= {"block_texels": np.stack([page["texels"] for page in pages])}
        blocks = random.random((13, 11)) < 0.5
        whole = random.integers(1, 3, (13, 11, 2))
        size = np.where(blocks[..., None], 4 * whole, size)
        most = np.array([6, 4]) - whole * np.stack([np.maximum(count, 1), np.ones_like(count)], 2)
        first = np.where(blocks[..., None], 4 * random.integers(0, most + 1), first)
    coarse = np.where(blocks, random.integers(0, count + 1), 0)
    page = random.integers(0, 2, (13, 11))
    lut = pack_tiles(first, size, random.integers(0, 5, (13, 11)), count, page, blocks, coarse)
    sheets = (SheetPlace("a", 29, 36, 0, 0, 5, 6, 2), SheetPlace("b", 22, 29, 5, 4, 4, 5))
    levels = (SheetPlace("a", 8, 9, 9, 0, 2, 2, 3), SheetPlace("a", 4, 4, 11, 0, 1, 1))
    factor = random.uniform(-0.3, 1.0, (3, 8, 3)).astype(np.float32)
    if short:
        factor, texels, lut = np.abs(factor[:, :2]), texels[:1], lut[..., :2]
    profile = Profile(name="s", colour="mixed" if mixed else "rgb9e5")
    fixed = ("s", "0" * 16, profile, "shared", profile.colour, ("a", "b", "c"), sheets, texels, lut)
    if apart:
        rows = enumerate((*sheets, *levels) * 2)
        second["later"] = tuple(
            replace(row, row=(row.row + n) % 8, column=(row.column + n) % 5, smaller=row.smaller and row.smaller + at)
            for n, row in rows
            for at in [4 + 4 * (n // 4)]
        )
    return AtlasModel(*fixed, factor=factor, levels=levels, **second)


def scene(short, mixed, apart, _) -> Subject:
    model, random = random_scene(short, mixed, apart), np.random.default_rng(2)
    decoder, number = AtlasDecoder(model), random.integers(0, 2, 600)
    uv = random.uniform(-0.05, 1.05, (600, 2)).astype(np.float32)
    texels = np.array([0.0, 1.0, 2.0**1.5, 2.0**2.25, 2.0**7])[random.integers(0, 5, 600)]  # along a pixel
    lod = torch.from_numpy(np.log2(np.maximum(texels, 1.0)).astype(np.float32))
    points = torch.from_numpy(uv), torch.from_numpy(number)
    expected = decoder.read(*points, 1.25, lod).numpy()
    main = f"""{POINTS}vec4 shown(ivec2 pixel)
{{
    vec4 at = texelFetch(u_points, pixel, 0);
    if (at.w == 0.0)
        return vec4(wlm_scene(at.xy, int(at.z), 1.25), 1.0);
    return vec4(wlm_scene_grad(at.xy, vec2(0.0, at.w), vec2(0.0, 0.0), int(at.z), 1.25), 1.0);
}}
"""
    heights = np.array([each.height for each in model.sheets])[number]
    bound = {
        "u_points": points_of(np.column_stack([uv, number, texels / heights])),
        "wlm_scene_sheets": sheet_texels(model),
        "wlm_scene_lut": model.lut,
        "wlm_scene_factors": np.pad(model.factor, ((0, 0), (0, 0), (0, 1))),
        # Of one layer wgpu would make no array.
        "wlm_scene_colour": np.stack([rgba(layer) for layer in (*model.texels, model.texels[0])]),
    }
    if mixed:
        bound["wlm_scene_blocks"] = np.stack([rgba(page) for page in model.block_texels])
    return Subject(atlas_glsl(model), main, expected[None], bound, "", 2 / 255 * expected.max())


def volume(folder) -> Subject:
    random = np.random.default_rng(0)
    position = random.uniform(-1, 1, (400, 3)) * [9.0, 1.0, 9.0] + [4000.0, -30.0, 0.0]
    made = Volume(position, StoredLight(random.normal(size=(400, 27))), side=8, budget=40)
    for _ in range(6):
        made.update([4000.3, -29.0, 0.2])
    export(volume_bundle(made), folder)
    document, arrays = read_export(folder)
    points = arrays["position"]
    normals = random.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ahead = made.read(points, normals)
    head, pages, pool = (np.fromfile(folder / f"{name}.bin", "<u4") for name in ("volume", "pages", "pool"))
    shown = [irradiance(each.reshape(9, 3), n[None])[0, 1] for each, n in zip(ahead.values, normals, strict=True)]
    light = np.column_stack([ahead.values[:, [0, 26]], np.maximum(shown, 0.0) / np.pi])
    expected = np.column_stack([ahead.weight, light * ahead.weight[:, None]])
    main = (
        POINTS
        + """uniform sampler2D u_normals;
vec4 shown(ivec2 pixel)
{
    float values[27];
    vec3 p = texelFetch(u_points, pixel, 0).xyz;
    vec3 n = texelFetch(u_normals, pixel, 0).xyz;
    float weight = wlm_volume_read(p, n, values);
    return vec4(weight, weight * values[0], weight * values[26], weight * wlm_volume_diffuse(p, n).g);
}
"""
    )
    bound = {"u_points": points_of(points - document["viewpoint"]), "u_normals": points_of(normals)}
    bound |= {"wlm_volume_head": head, "wlm_volume_page": pages, "wlm_volume_pool": pool}
    return Subject(volume_glsl(27), main, expected[None], bound, "", 3e-5, as_textures=VOLUME, version=430)


def virtual(folder) -> Subject:
    model = random_lightmap((3, 3, 4, 1, 0, 3), columns=3)
    own, random = model.light, np.random.default_rng(0)
    y, x = (np.mgrid[:40, :40] + 0.5) / 80
    zero = np.zeros((40, 40))
    uv, level = random.uniform(-0.05, 1.05, (90, 2)), random.uniform(-1.0, 7.0, 90)
    with VirtualTexture(model, side=32, border=2, decodes=16) as texture:
        for _ in range(80):
            derivative = np.stack([zero + 2.0 / own.width, zero, zero, zero + 3.0 / own.height], 2)
            texture.frame(7.5, zero.astype(int), np.stack([x, y], 2), derivative)
        slope = 2.0**level / own.width
        derivative = np.stack([0.0 * level, slope, 0.0 * level, 0.0 * level], 1)
        expected, state = texture.sample(np.zeros(90, int), uv, derivative), texture.state()
        assert len(set(expected.coarser.tolist())) > 1, "some pages are missing"
        light, table = unpack_rgb9e5(state.texture).astype(np.float16), texture.table.numpy()
        words = sheet_words(texture.layout)
    main = (
        POINTS
        + """
vec4 shown(ivec2 pixel)
{
    vec4 at = texelFetch(u_points, pixel, 0);
    return vec4(wlm_virtual_light(0, at.xy, vec2(0.0, 0.0), vec2(at.z, 0.0)), 1.0);
}
"""
    )
    bound = {
        "u_points": points_of(np.column_stack([uv, slope])),
        "wlm_virtual_pages": np.pad(light, ((0, 0), (0, 0), (0, 0), (0, 1))),
        "wlm_virtual_table": table.astype(np.uint32).reshape(-1, 1024, 1),
        "wlm_virtual_sheets": words[..., None],
    }
    return Subject(virtual_glsl(), main, expected.light[None], bound, "", 5e-3 * float(light.max()))


VOLUME = "".join(
    f"uniform usampler2D u_{name};\n#define WLM_VOLUME_{name.upper()}(i) texelFetch(u_{name}, ivec2((i) & 1023, "
    f"(i) >> 10), 0).r\n"
    for name in ("head", "page", "pool")
)


SH = (
    POINTS
    + """vec4 shown(ivec2 pixel)
{
    vec3 sh[9];
    wlm_probe_sh(texelFetch(u_points, pixel, 0).xyz, sh);
    return vec4(sh[0].x, sh[4].y, sh[8].z, 1.0);
}
"""
)


def probes(folder) -> Subject:
    model = random_probes(seed=3)
    made = model.bundle()
    position = made.reference["position"]
    expected = model.decoder().decode(position)[:, [0, 13, 26]]
    bound = {"u_points": points_of(position)}
    bound |= {f"wlm_probe_{name}": made.buffers[name] for name in ("gaussians", "network")}
    scale = float(np.abs(expected).max())
    return Subject(made.shader, SH, expected[None], bound, "", 1e-4 * scale, as_textures=PROBES, version=430)


def component_probes(folder) -> Subject:
    random = np.random.default_rng(5)
    place = random.uniform(0.0, 4.0, (90, 3))
    light = 1.0 + np.sin(place @ random.normal(size=(3, 27)))
    made = probe.compress(probe.from_arrays(place, light), "pca").bundle()
    expected = made.reference["values"][:, [0, 13, 26]]
    # A live probe's index is the x of its point.
    points = np.pad(made.reference["live"][:, None].astype(np.float64), ((0, 0), (0, 2)))
    bound = {"u_points": points_of(points), "wlm_probe_probes": made.buffers["probes"]}
    main = SH.replace("(texelFetch(u_points, pixel, 0).xyz, sh)", "(int(texelFetch(u_points, pixel, 0).x + 0.5), sh)")
    scale = float(np.abs(expected).max())
    return Subject(made.shader, main, expected[None], bound, "", 1e-5 * scale, as_textures=PROBES, version=430)


PROBES = "".join(
    f"uniform usampler2D u_{name};\n#define WLM_PROBE_{name.upper()}(i) texelFetch(u_{name}, ivec2((i) & 1023, "
    f"(i) >> 10), 0).r\n"
    for name in ("gaussians", "network", "probes")
)

SUBJECTS: dict[str, Callable[..., Subject]] = {
    "lightmap": lambda folder: lightmap((4, 3, 3, 1), folder),
    "lightmap of odd sizes": lambda folder: lightmap((4, 3, 4, 0), folder, gelu="exact", period=None, hidden=10),
    **{f"atlas {kind}": lambda folder, kind=kind: atlas(kind, folder) for kind in (*KINDS, MIXED)},
    "atlas tiles of blocks": lambda folder: atlas("tiles", folder, "bc6h"),
    "scene": partial(scene, False, False, False),
    "scene of one component": partial(scene, True, False, False),
    "scene mixed": partial(scene, False, True, False),
    "scene apart": partial(scene, True, False, True),
    **smoke_subjects(),
    "volume": volume,
    "virtual texture": virtual,
    "probes": probes,
    "components": component_probes,
}


def as_texture(values: np.ndarray) -> np.ndarray:
    """A buffer in rows of 1,024."""
    return np.pad(values, (0, -len(values) % 1024)).reshape(-1, 1024, 1)


def shown(subject: Subject, language: str, exact: bool, folder) -> np.ndarray:
    defined = [subject.exact] if exact and subject.exact else []
    size, text = subject.expected.shape[:2], subject.text + subject.main
    if language.startswith("glsl"):
        bound, uniforms = {}, {}
        for name, values in subject.bound.items():
            if values.ndim == 1:
                kind = values if values.dtype == np.float32 else values.view(np.uint32)
                bound["u_" + name.split("_")[-1]] = as_texture(kind)
            elif values.ndim == 2:
                uniforms[name] = [tuple(row[:3].tolist()) for row in values]
            else:
                bound[name] = values
        head = "".join(f"#define {name}\n" for name in defined) + subject.as_textures
        return run_glsl(head + text, "light = shown(pixel);", size, bound, language, uniforms, subject.version)
    text = translate(text, language, defined)
    if language == "wgsl":
        return run_wgsl(text, "shown(pixel)", size, subject.bound)
    return run_hlsl(text, "shown(pixel)", size, subject.bound, folder)


@pytest.mark.parametrize("language", [*HEADS, "hlsl", "wgsl"])
@pytest.mark.parametrize("name", SUBJECTS)
def test_every_shader_shows_what_python_decodes(name, language, tmp_path):
    subject = SUBJECTS[name](tmp_path)
    channels = subject.expected.shape[-1]
    found = shown(subject, language, True, tmp_path)[..., :channels]
    np.testing.assert_allclose(found, subject.expected, rtol=0, atol=subject.tolerance)
    # WebGPU filters no 32-bit floats, and its core has no 16-bit levels: a table of coordinates is fetched there.
    if subject.filtered is not None and (not name.startswith("atlas cascade") or language.startswith("glsl")):
        found = shown(subject, language, False, tmp_path)[..., :channels]
        np.testing.assert_allclose(found, subject.expected, rtol=0, atol=subject.filtered)


COMPUTE = {"glsl": "#version 430\n", "glsl-es": "#version 310 es\n"}


@pytest.mark.parametrize("language", [*COMPUTE, "wgsl", "hlsl"])
def test_the_compute_shader_decodes_a_lightmap(language, tmp_path):
    """All kinds of tiles, and a map whose last tiles are cut."""
    model = random_lightmap((4, 3, 3, 1))
    export(model, tmp_path, shader=language, exact=True)
    text = next(tmp_path.glob("lightmap_compute.*")).read_text()
    if language == "hlsl":
        compiled(text, tmp_path, "-D", "-e", "main")
        return
    (sheet,) = model.sheets.values()
    expected = SheetDecoder(sheet).frame(float(model.times[2]))
    uniforms, hour = lightmap_uniforms(tmp_path)
    bound, size, cell = uniforms | hour(2), expected.shape[:2], (GROUP_SIZE[0], 2 * GROUP_SIZE[1])
    if language == "wgsl":
        found = run_wgsl_compute(text, size, bound, cell)
    else:
        found = run_glsl_compute(text, COMPUTE[language], size, bound, cell)
    np.testing.assert_allclose(found[..., :3], expected, rtol=2**-10, atol=1e-5 * expected.max())


def test_heads_state_language_and_macros():
    text = "// A shader.\n#ifdef WLM_A\nconst int A = 1;\n#endif\n"
    for defined, macros in (((), ""), (("WLM_A",), " with WLM_A defined")):
        written = translate(text, "hlsl", defined)
        head = "// HLSL, shader model 5 and later, translated from the GLSL that is described below"
        assert written.startswith(f"{head}{macros}; macros are expanded.\n//\n// A shader.\n")
        assert ("int A = 1" in written) == bool(defined)


def test_what_is_no_shader_of_ours():
    with pytest.raises(WlmError, match="shader: expected one of glsl, .* got 'cg'"):
        translate("", "cg")
    for text, words in (
        ("#pragma once\n", "expected ifdef"),
        ("float f() { return 1.0 $ 2.0; }", "expected a token"),
    ):
        with pytest.raises(ValueError, match=words):
            translate(text, "wgsl")
    assert set(LANGUAGES) == {*HEADS, "hlsl", "wgsl"}
