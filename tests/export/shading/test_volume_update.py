"""The exported compute shaders that update a volume, run in every language that runs here, beside our kernels."""

import re

import numpy as np
import pytest
from builders.checks import error_of
from builders.probe_models import random_model
from builders.shader_runs import compiled, device, gl

from wlm import probe
from wlm.bundle import Bundle
from wlm.export.shading import translate
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.update import update_bundle


def _volume(model, position, **settings) -> Volume:
    normal = np.random.default_rng(1).normal(size=position.shape)
    light = model.decoder(position=position).light(position)
    return Volume(position, light, live=model.live, normal=normal, side=6, **settings)


@pytest.fixture(scope="module")
def components() -> Bundle:
    """A pool with too few rows, which therefore replaces some."""
    random = np.random.default_rng(5)
    place = random.uniform(0.0, 4.0, (150, 3)) * [6.0, 1.0, 1.0]
    values = 1.0 + np.sin(place @ random.normal(size=(3, 27)))
    values[7] = 0.0
    model = probe.compress(probe.from_arrays(place, values), "pca")
    made = update_bundle(_volume(model, place, budget=12, rows=80), model, frames=9)
    assert made.document["words"]["tables"] > 2 * 80 + 100
    return made


@pytest.fixture(scope="module")
def gaussians() -> Bundle:
    """A row for each block; places on both sides of a block's number 0."""
    model, place = _random()
    return update_bundle(_volume(model, place, budget=24), model, frames=4)


def _random():
    model = random_model(outputs=12)
    place = np.random.default_rng(4).random((model.probes, 3))
    place[:2] = [[0.0] * 3, [1.0] * 3]
    return model, model.origin + model.extent * model.size * place


def _buffers(made: Bundle) -> dict[str, np.ndarray]:
    """All buffers before the first frame, as the document describes them."""
    words = {name: np.zeros(count, np.uint32) for name, count in made.document["words"].items()}
    for name in ("pages", "tables"):
        words[name] |= np.uint32(0xFFFFFFFF)
    return {name: np.ascontiguousarray(each).view(np.uint32).reshape(-1) for name, each in made.buffers.items()} | words


def _heads(made: Bundle) -> list[np.ndarray]:
    """The buffer head of each frame, from the document and the constant words of the first."""
    first = made.buffers["head"].reshape(-1, made.document["words"]["head"])[0]
    heads, before = [], None
    for frame, viewpoint in enumerate(made.reference["viewpoint"], 1):
        head, bases = first.copy(), []
        head[4] = frame
        for i, level in enumerate(made.document["levels"]):
            start, low, high, sides = (np.array(level[name]) for name in ("start", "low", "high", "sides"))
            at = viewpoint / level["block"] - start
            base = np.clip(np.floor(at + 0.5) - sides // 2, low, high + 1 - sides)
            own = head[8 + 16 * i : 24 + 16 * i]
            own[:3] = (at - base - 0.5).astype("<f4").view("<u4")
            own[4:7] = base
            own[12:15] = base + sides if before is None else before[i]
            bases.append(base)
        before = bases
        heads.append(head)
    return heads


def _run_glsl(made: Bundle) -> dict[str, np.ndarray]:
    text = made.shader
    places = {name.lower(): int(i) for name, i in re.findall(r"define WLM_[A-Z]+_(\w+)_BINDING (\d+)", text)}
    with gl() as context:
        bound = {name: context.buffer(data.tobytes()) for name, data in _buffers(made).items()}
        head = "#version 430\nlayout(local_size_x = 64) in;\n"
        work = [
            (context.compute_shader(f"{head}{text}void main() {{ {step['function']}({_THREAD}); }}\n"), step["threads"])
            for step in made.document["dispatches"]
        ]
        for words in _heads(made):
            bound["head"].write(words.tobytes())
            for name, i in places.items():
                bound[name].bind_to_storage_buffer(i)
            for shader, threads in work:
                shader.run(-(-threads // 64))
                context.memory_barrier()
        return {name: np.frombuffer(bound[name].read(), np.uint32) for name in ("pages", "pool")}


_THREAD = "int(gl_GlobalInvocationID.x)"


def _wgsl(text: str, function: str, _) -> tuple[str, dict[str, int]]:
    places = {name: int(i) for i, name in re.findall(r"@binding\((\d+)\) var(?:<[^>]*>)? (\w+)", text)}
    main = "@compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3u)"
    return f"{text}{main} {{ {function}(i32(id.x)); }}\n", places


def _hlsl(text: str, function: str, folder) -> tuple[bytes, dict[str, int]]:
    declared = r"^(?:RW)?StructuredBuffer<\w+> (\w+);"
    places = {match[1]: i for i, match in enumerate(re.finditer(declared, text, re.MULTILINE))}
    text = re.sub(declared, lambda m: f"[[vk::binding({places[m[1]]}, 0)]] {m[0]}", text, flags=re.MULTILINE)
    text += f"[numthreads(64, 1, 1)] void main(uint3 id : SV_DispatchThreadID) {{ {function}(int(id.x)); }}\n"
    compiled(text, folder, "-D", "-e", "main")
    return (folder / "shader.spv").read_bytes(), places


def _run_wgpu(made: Bundle, language: str, folder) -> dict[str, np.ndarray]:
    gpu = device()
    import wgpu

    usage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
    bound = {name: gpu.create_buffer_with_data(data=data, usage=usage) for name, data in _buffers(made).items()}
    text, work = translate(made.shader, language), []
    for step in made.document["dispatches"]:
        code, places = (_wgsl if language == "wgsl" else _hlsl)(text, step["function"], folder)
        module = gpu.create_shader_module(code=code)
        pipeline = gpu.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
        own = {name.split("_")[-1]: i for name, i in places.items()}
        entries = [{"binding": own[name], "resource": {"buffer": bound[name]}} for name in step["buffers"]]
        group = gpu.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
        work.append((pipeline, group, step["threads"]))
    for words in _heads(made):
        gpu.queue.write_buffer(bound["head"], 0, words)
        encoder = gpu.create_command_encoder()
        for pipeline, group, threads in work:
            run = encoder.begin_compute_pass()
            run.set_pipeline(pipeline)
            run.set_bind_group(0, group)
            run.dispatch_workgroups(-(-threads // 64))
            run.end()
        gpu.queue.submit([encoder.finish()])
    return {name: np.frombuffer(gpu.queue.read_buffer(bound[name]), np.uint32) for name in ("pages", "pool")}


@pytest.mark.parametrize(
    ("language", "kind"),
    [
        ("glsl", "components"),
        pytest.param("glsl", "gaussians", marks=pytest.mark.slow),
        pytest.param("hlsl", "components", marks=pytest.mark.slow),
        pytest.param("wgsl", "gaussians", marks=pytest.mark.slow),
    ],
)
def test_a_walk_fills_the_same_volume(language, kind, request, tmp_path):
    """After some frames the page table is that of our kernels, and every row of the pool within rounding."""
    made = request.getfixturevalue(kind)
    for got, want in zip(_heads(made), made.buffers["head"].reshape(-1, len(_heads(made)[0])), strict=True):
        np.testing.assert_array_equal(got, want)
    found = _run_glsl(made) if language == "glsl" else _run_wgpu(made, language, tmp_path)
    pages = made.reference["pages"]
    np.testing.assert_array_equal(found["pages"].view(np.int16)[: len(pages)], pages)
    rows, outputs = np.unique(pages[pages >= 0]), 27 if kind == "components" else 12
    assert len(rows) > 40
    one = 1 + outputs // 2 + outputs % 2
    light = [_light(each.reshape(-1, one), outputs) for each in (found["pool"], made.reference["pool"])]
    np.testing.assert_allclose(light[0][rows], light[1][rows], rtol=2e-3, atol=2e-4 * np.abs(light[1][rows]).max())


def _light(words: np.ndarray, outputs: int) -> np.ndarray:
    words = np.ascontiguousarray(words)
    halves = np.ascontiguousarray(words[:, 1:]).view(np.float16)[:, :outputs]
    return halves * words[:, :1].view(np.float32)


def test_update_of_nothing_and_of_a_volume_with_light():
    model, place = _random()
    volume = _volume(model, place)
    volume.update(place[0])
    assert "has not been updated" in error_of(update_bundle, volume, model)
    nothing = Volume(place, volume.light, live=np.zeros(len(place), bool))
    assert "no probe is live" in error_of(update_bundle, nothing, model)
