"""Exported models: shaders compile for Vulkan, and buffers decode like Python, by shaders and by NumPy alone."""

from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of
from builders.exported import read_export
from builders.probe_models import EXTENT, ORIGIN, SIZE, random_model, with_content
from builders.probe_sets import synthetic
from builders.shader_runs import compiled, run_glsl
from builders.shader_subjects import points_of

import wlm
from benchmarks.probe_exact import decode64
from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.data import from_arrays
from wlm.probe.gaussian.shader import probe_glsl
from wlm.probe.volume.shader import volume_glsl

SHAPES = [
    {},
    {"support": "sphere"},
    {"latent": 1, "hidden": 8, "bits": 4, "outputs": 3},
    {"latent": 4, "outputs": 5, "count": 1},
    {"turn": 0.0, "error": "absolute"},
    {"latent": 13, "hidden": 24, "bits": 16, "outputs": 12, "probes": 7},
]
_VALUES = """
    vec3 x = wlm_probe_place(position);
    float all[WLM_PROBE_OUTPUTS], odd[WLM_PROBE_OUTPUTS], even[WLM_PROBE_OUTPUTS];
    wlm_probe_values(x, all);
    wlm_probe_values_listed(x, 0, ODD, odd);
    wlm_probe_values_listed(x, ODD, wlm_probe_count() - ODD, even);
    light = vec4(all[pixel.y], odd[pixel.y], even[pixel.y], 1.0);
"""
_SH = """
    vec3 all[COUNT], odd[COUNT], even[COUNT];
    wlm_probe_sh(position, all);
    wlm_probe_sh_listed(position, 0, ODD, odd);
    wlm_probe_sh_listed(position, ODD, wlm_probe_count() - ODD, even);
    int c = pixel.y / 3;
    light = vec4(all[c][pixel.y % 3], odd[c][pixel.y % 3], even[c][pixel.y % 3], 1.0);
"""


def _run(shader: str, main: str, size: tuple[int, int], buffers: dict[str, np.ndarray], head: str = "", **textures):
    """Draws a picture whose row is a number of a probe, and whose column is a probe or a point."""
    for name, words in buffers.items():
        words = words.view("<u4")
        textures[f"u_{name}"] = np.pad(words, (0, -len(words) % 1024)).reshape(-1, 1024, 1)
        head += f"uniform usampler2D u_{name};\n"
        head += f"#define WLM_PROBE_{name.upper()}(i) texelFetch(u_{name}, ivec2((i) & 1023, (i) >> 10), 0).r\n"
    return run_glsl(head + shader, main, size, textures, version=430)


@pytest.mark.parametrize("settings", SHAPES, ids=str)
def test_gaussians_and_lists_of_them(settings):
    model = random_model(**settings)
    made, count = model.bundle(), model.content.count
    position = ORIGIN + EXTENT * SIZE * np.random.default_rng(1).uniform(-0.1, 1.1, (50, 3))
    position = np.concatenate([position, made.reference["position"]]).astype(np.float32)
    head = f"uniform sampler2D u_points;\n#define ODD {count // 2}\n#define COUNT {model.outputs // 3}\n"
    head += "#define WLM_PROBE_LIST(i) uint((i) < ODD ? 2 * (i) + 1 : 2 * ((i) - ODD))\n"
    main = "vec3 position = texelFetch(u_points, ivec2(pixel.x, 0), 0).xyz;" + (_VALUES, _SH)[model.outputs != 5]
    size = model.outputs, len(position)
    got = _run(made.shader, main, size, dict(made.buffers), head, u_points=points_of(position))
    assert np.ptp(got[..., 0], axis=1).max() > 0, "the light varies"
    for kind, chosen in enumerate((slice(None), slice(1, None, 2), slice(0, None, 2))):
        code = model.content.code[chosen]
        if len(code):
            expected = decode64(with_content(model, code=code), position)
            np.testing.assert_allclose(got[..., kind].T, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize(("count", "coefficients"), [(200, 9), (20, 9), (30, 1), (600, 9)])
def test_principal_components(count, coefficients):
    probes = synthetic(count, coefficients=coefficients, dead=2)
    if count == 600:
        random, kind = np.random.default_rng(0), np.arange(count) % 8
        values = np.einsum("vk,vkd->vd", random.normal(size=(count, 3)), random.normal(size=(8, 3, 27))[kind])
        values += 5.0 * random.normal(size=(8, 27))[kind]
        probes = from_arrays(probes.position, np.where(probes.live[:, None], values, 0.0))
    made = wlm.probe.compress(probes, "pca").bundle()
    assert made.document["basis"] == (count >= 200) and (made.document["clusters"] > 1) == (count == 600)
    assert made.document["live"] == count - 2
    main = "float values[WLM_PROBE_OUTPUTS]; wlm_probe_values(pixel.x, values); light = vec4(values[pixel.y]);"
    got = _run(made.shader, main, (probes.outputs, count - 2), dict(made.buffers))[..., 0].T
    reference = made.reference
    scale = np.abs(reference["values"]).max()
    np.testing.assert_allclose(got[reference["live"]], reference["values"], rtol=0, atol=1e-5 * scale)


def _gaussians(**settings) -> tuple[str, str]:
    model = random_model(**settings)
    call = "wlm_probe_values_listed(wlm_probe_place(vec3(0.5)), 8, 4, o);"
    if model.outputs % 3 == 0:
        call += f" vec3 sh[{model.outputs // 3}]; wlm_probe_sh(vec3(1.0), sh); o[0] += sh[0].x;"
        call += " wlm_probe_sh_listed(vec3(1.0), 0, 2, sh); o[0] += sh[0].y;"
    head = "layout(std430, binding = 3) readonly buffer Lists { uint lists[]; };\n#define WLM_PROBE_LIST(i) lists[i]\n"
    return head + probe_glsl(model.content), f"float o[{model.outputs}]; {call}"


CALLERS = {str(shape): lambda shape=shape: _gaussians(**shape) for shape in SHAPES if "turn" not in shape} | {
    "components": lambda: (
        wlm.probe.compress(synthetic(100)).bundle().shader,
        "vec3 sh[9]; wlm_probe_sh(2, sh); float o[1]; o[0] = sh[0].x;",
    ),
    **{
        f"volume {outputs}": lambda outputs=outputs: (
            volume_glsl(outputs),
            f"float o[{outputs}]; o[0] += wlm_volume_read(vec3(1.0), vec3(1.0), o);",
        )
        for outputs in (27, 5)
    },
}


@pytest.mark.parametrize(
    ("version", "kind"), [*((450, kind) for kind in CALLERS), *((430, kind) for kind in list(CALLERS)[:2])]
)
def test_it_compiles(kind, version, tmp_path):
    shader, body = CALLERS[kind]()
    text = f"#version {version}\nlayout(local_size_x = 64) in;\n{shader}\n"
    text += "layout(std430, binding = 7) buffer Results { float results[]; };\n"
    compiled(f"{text}void main() {{ {body} results[0] = o[0]; }}\n", tmp_path, spirv=version == 450)


def test_the_shader_depends_on_the_shape_alone():
    assert probe_glsl(random_model(seed=0).content) == probe_glsl(random_model(seed=1, count=9, bits=7).content)
    assert probe_glsl(random_model().content) != probe_glsl(random_model(support="sphere").content)


def test_what_is_written(tmp_path):
    model = random_model(positions=True, dead=4)
    paths = export(model, tmp_path)
    names = "gaussians.bin network.bin position.bin positions.bin probe.glsl values.bin bundle.json"
    assert [path.name for path in paths] == names.split()
    assert sorted(paths) == sorted(tmp_path.iterdir())
    info, arrays = read_export(tmp_path)
    assert (info["source"], info["probes"], info["gaussians"]) == (model.source, 200, 40)
    assert info["dead"] == np.flatnonzero(model.dead).tolist() and len(info["dead"]) == 4
    assert set(info["about"]) >= {"position", "gaussian", "network", "lists", "dead", "positions", "reference"}
    codes = arrays["positions"].reshape(-1, 3)
    position = np.array(info["origin"]) + info["extent"] * np.array(info["size"]) * codes / 65535
    np.testing.assert_allclose(position, model.stored_positions(), rtol=1e-12)
    # The last point of the reference is outside the box.
    assert arrays["values"].shape == (41, 27) and (arrays["position"][-1] > ORIGIN + EXTENT * SIZE).all()
    np.testing.assert_allclose(arrays["values"], decode64(model, arrays["position"]), rtol=0, atol=1e-4)
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
    assert "device 'tpu'" in error_of(export, model, tmp_path / "new", device="tpu")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    assert "cannot write there" in error_of(export, model, tmp_path / "file")
