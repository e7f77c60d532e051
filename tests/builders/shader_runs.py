"""Runs shaders on a machine without a GPU: GLSL through Mesa's llvmpipe (moderngl), WGSL through wgpu."""

import functools
import json
import re
import shutil
import struct
import subprocess

import numpy as np
import pytest
import texture2ddecoder

ES = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n"
ES += "precision highp usampler2D;\nprecision highp sampler2DArray;\n"
HEADS = {"glsl": "#version 330\n", "glsl-es": ES}
_WHOLE = "void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }"
_FORMS = {"uint8": ("f1", 1), "uint16": ("u2", 2), "uint32": ("u4", 4), "float16": ("f2", 2), "float32": ("f4", 4)}


@functools.cache
def _context():
    import moderngl

    return moderngl.create_context(standalone=True, backend="egl", require=330)


def _works(context):
    import moderngl

    vertex = HEADS["glsl"] + _WHOLE
    try:
        with context:
            context.program(vertex_shader=vertex, fragment_shader=f"{HEADS['glsl']}void main() {{}}").release()
    except moderngl.Error:
        return False
    return True


def gl():
    """A GL context without a display; skips the test, with what to install, where there is none."""
    pytest.importorskip("moderngl", reason="moderngl is not installed (pip, extra test)")
    try:
        # VTK ends all contexts without a display when it closes a window.
        if not _works(_context()):
            _context.cache_clear()
        return _context()
    except Exception as error:  # moderngl has no class of its own for it
        pytest.skip(f"no OpenGL without a display: install Mesa (libegl1, libgl1-mesa-dri): {error}")


def run_glsl(text, main, size, textures, language="glsl", uniforms=None, version=330):
    """Draws one picture, float32 [height, width, 4]."""
    # That of wgpu may be the thread's own by now.
    with gl() as context:
        head = HEADS[language].replace("330", str(version))
        return _draw(context, head, text, main, size, textures, uniforms or {})


def _draw(context, head, text, main, size, textures, uniforms):
    vertex = head.splitlines(True)[0] + _WHOLE
    body = f"out vec4 light;\nvoid main()\n{{\n    ivec2 pixel = ivec2(gl_FragCoord.xy);\n    {main}\n}}\n"
    program = context.program(vertex_shader=vertex, fragment_shader=head + text + body)
    made = _bind(context, program, textures)
    for name, value in uniforms.items():
        program[name].value = value
    target = context.texture(size[::-1], 4, dtype="f4")
    frame = context.framebuffer([target])
    frame.use()
    array = context.vertex_array(program, [])
    array.render(context.TRIANGLES, vertices=3)
    return _read(context, target, size, np.float32, made)


def run_glsl_compute(text, head, size, textures, group):
    """What a compute shader stores, float32 [height, width, 4]."""
    with gl() as context:
        program = context.compute_shader(head + text)
        made = _bind(context, program, textures)
        target = context.texture(size[::-1], 4, dtype="f2")
        target.bind_to_image(0, read=False, write=True)
        program.run(-(-size[1] // group[0]), -(-size[0] // group[1]))
        context.memory_barrier()
        return _read(context, target, size, np.float16, made)


def _bind(context, program, textures):
    made = []
    for unit, (name, values) in enumerate(textures.items()):
        if name not in program:
            continue
        values = np.ascontiguousarray(values)
        shape = (values.shape[-2], values.shape[-3], *values.shape[:-3])
        kind = _FORMS[values.dtype.name][0]
        make = context.texture_array if values.ndim == 4 else context.texture
        texture = make(shape, values.shape[-1], values.tobytes(), dtype=kind, alignment=1)
        linear = kind in ("f1", "f2", "f4")
        texture.filter = (context.LINEAR, context.LINEAR) if linear else (context.NEAREST, context.NEAREST)
        texture.repeat_x = texture.repeat_y = False
        texture.use(unit)
        program[name].value = unit
        made.append(texture)
    return made


def _read(context, target, size, kind, made):
    error = context.error
    assert error == "GL_NO_ERROR", error
    picture = np.frombuffer(target.read(), kind).reshape(*size, 4).astype(np.float32)
    for thing in made:
        thing.release()
    return picture


@functools.cache
def _device():
    import wgpu

    adapter = wgpu.gpu.request_adapter_sync()
    return adapter.request_device_sync(required_features={"float32-filterable"} & adapter.features)


def device():
    """A device of wgpu; skips the test, with what to install, where there is none."""
    pytest.importorskip("wgpu", reason="wgpu is not installed (pip, extra test)")
    try:
        return _device()
    except Exception as error:  # whatever the driver says
        pytest.skip(f"no GPU for wgpu, not even in software: install Mesa (libegl1, mesa-vulkan-drivers): {error}")


_WGPU_FORMS = {
    ("uint8", 1): "r8unorm",
    ("uint8", 2): "rg8unorm",
    ("uint8", 4): "rgba8unorm",
    ("uint16", 2): "rg16uint",
    ("uint16", 4): "rgba16uint",
    ("uint32", 1): "r32uint",
    ("float16", 4): "rgba16float",
    ("float32", 2): "rg32float",
    ("float32", 4): "rgba32float",
}


def run_wgsl(text, expression, size, bound):
    """Computes one picture, float32 [height, width, 4], with WGSL."""
    code = f"""{text}
@group(1) @binding(0) var<storage, read_write> wlm_out: array<vec4f>;
@compute @workgroup_size(8, 8) fn main(@builtin(global_invocation_id) id: vec3u)
{{
    let pixel = vec2i(id.xy);
    if (pixel.x < {size[1]} && pixel.y < {size[0]}) {{ wlm_out[pixel.y * {size[1]} + pixel.x] = {expression}; }}
}}"""
    bindings = _bindings(text)
    used = {name: place for name, place in bindings.items() if len(re.findall(rf"\b{name}\b", text + expression)) > 1}
    return _run(code, size, {name: bound.get(name) for name in used}, used)


def _bindings(text):
    found = re.findall(r"@group\(0\) @binding\((\d+)\) var(?:<[^>]*>)? (\w+)", text)
    return {name: int(place) for place, name in found}


def run_wgsl_compute(text, size, bound, group):
    """What a compute shader stores in a texture of half floats, float32 [height, width, 4]."""
    used = {name: at for name, at in _bindings(text).items() if name in bound}
    return _run(text, size, {name: bound[name] for name in used}, used, group)


def compiled(text, folder, *words, name="shader.comp", spirv=True):
    """Compiles a shader, to shader.spv if asked to; skips the test, with what to install, where glslang is missing."""
    if shutil.which("glslangValidator") is None:
        pytest.skip("no glslangValidator: install glslang-tools")
    (folder / name).write_text(text)
    words = ["glslangValidator", *["-V", "-o", "shader.spv"] * spirv, *words, name]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


def run_hlsl(text, expression, size, bound, tmp_path):
    """The same with HLSL, which glslang compiles to SPIR-V."""
    declared = r"^((?:Texture2D\w*<\w+>|StructuredBuffer<\w+>|SamplerState) (\w+);|cbuffer (\w+)_values$)"
    names = [match[2] or match[3] for match in re.finditer(declared, text, re.MULTILINE)]
    place = iter(range(len(names)))
    text = re.sub(declared, lambda match: f"[[vk::binding({next(place)}, 0)]] {match[0]}", text, flags=re.MULTILINE)
    source = f"""{text}
[[vk::binding(0, 1)]] RWStructuredBuffer<float4> wlm_out;
[numthreads(8, 8, 1)] void main(uint3 id : SV_DispatchThreadID)
{{
    int2 pixel = int2(id.xy);
    if (pixel.x < {size[1]} && pixel.y < {size[0]}) {{ wlm_out[pixel.y * {size[1]} + pixel.x] = {expression}; }}
}}"""
    compiled(source, tmp_path, "-D", "-e", "main")
    used = {name: place for place, name in enumerate(names) if len(re.findall(rf"\b{name}\b", source)) > 1}
    code = (tmp_path / "shader.spv").read_bytes()
    return _run(code, size, {name: bound.get(name) for name in used}, used)


def _run(code, size, bound, places, group=None):
    gpu = device()
    import wgpu

    usage, kinds = wgpu.BufferUsage, wgpu.TextureUsage
    pipeline = gpu.create_compute_pipeline(
        layout="auto", compute={"module": gpu.create_shader_module(code=code), "entry_point": "main"}
    )
    entries = []
    for name, values in bound.items():
        if values is None:  # the sampler
            resource = gpu.create_sampler(mag_filter="linear", min_filter="linear")
        elif values.ndim <= 2:
            flags = usage.STORAGE | usage.UNIFORM
            resource = {"buffer": gpu.create_buffer_with_data(data=np.ascontiguousarray(values), usage=flags)}
        else:
            layers = values.reshape(-1, *values.shape[-3:])
            count, height, width, channels = layers.shape
            if channels == 3:
                layers = np.concatenate([layers, np.ones((count, height, width, 1), layers.dtype)], 3)
            texture = gpu.create_texture(
                size=(width, height, count),
                format=_WGPU_FORMS[layers.dtype.name, layers.shape[-1]],
                usage=kinds.TEXTURE_BINDING | kinds.COPY_DST,
            )
            data = np.ascontiguousarray(layers)
            layout = {"bytes_per_row": data[0, 0].nbytes, "rows_per_image": height}
            gpu.queue.write_texture({"texture": texture}, data, layout, (width, height, count))
            resource = texture.create_view(dimension="2d-array" if values.ndim == 4 else "2d")
        entries.append({"binding": places[name], "resource": resource})
    if group:
        flags = kinds.STORAGE_BINDING | kinds.COPY_SRC
        out = gpu.create_texture(size=(size[1], size[0], 1), format="rgba16float", usage=flags)
        target = out.create_view()
    else:
        out = gpu.create_buffer(size=16 * size[0] * size[1], usage=usage.STORAGE | usage.COPY_SRC)
        target = {"buffer": out}
    encoder = gpu.create_command_encoder()
    work = encoder.begin_compute_pass()
    work.set_pipeline(pipeline)
    if entries:
        work.set_bind_group(0, gpu.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
    last = [{"binding": 0, "resource": target}]
    work.set_bind_group(1, gpu.create_bind_group(layout=pipeline.get_bind_group_layout(1), entries=last))
    columns, rows = group or (8, 8)
    work.dispatch_workgroups(-(-size[1] // columns), -(-size[0] // rows))
    work.end()
    gpu.queue.submit([encoder.finish()])
    if group:
        layout = {"bytes_per_row": 8 * size[1], "rows_per_image": size[0]}
        data = gpu.queue.read_texture({"texture": out}, layout, (size[1], size[0], 1))
        return np.frombuffer(data, np.float16).reshape(*size, 4).astype(np.float32)
    return np.frombuffer(gpu.queue.read_buffer(out), np.float32).reshape(*size, 4).copy()


def read_dds_levels(path):
    """A DDS file by Microsoft's description of it and another BC7 decoder: levels [layers, H, W, C] in [0, 1]."""
    data = path.read_bytes()
    height, width = struct.unpack_from("<2I", data, 12)
    fmt, dimension, _, layers = struct.unpack_from("<4I", data, 128)
    assert dimension == 3
    payload = data[148:]
    if fmt in (49, 61):
        return np.frombuffer(payload, np.uint8).reshape(layers, height, width, -1) / 255.0
    assert fmt == 98
    size = len(payload) // layers
    slices = [texture2ddecoder.decode_bc7(payload[i * size : (i + 1) * size], width, height) for i in range(layers)]
    bgra = np.stack([np.frombuffer(s, np.uint8).reshape(height, width, 4) for s in slices])
    return bgra[..., [2, 1, 0, 3]] / 255.0


def rows_of_floats(numbers):
    """A texture of 1,024 fours a row."""
    fours = np.asarray(numbers, np.float32).reshape(-1, 4)
    return np.pad(fours, ((0, -len(fours) % 1024), (0, 0))).reshape(-1, 1024, 4)


def lightmap_uniforms(folder):
    """The textures of an exported folder, as an engine uploads them; `hour` gives the table of a stored one."""
    made = {}
    for path in folder.glob("*.dds"):
        levels = np.uint8(np.rint(read_dds_levels(path) * 255.0))
        made[f"wlm_lightmap_{path.stem}"] = levels if path.stem == "frames" else levels[0]
    if (folder / "networks.bin").exists():
        made["wlm_lightmap_networks"] = rows_of_floats(np.fromfile(folder / "networks.bin", "<f4"))
    document = json.loads((folder / "bundle.json").read_text())
    tables = np.fromfile(folder / "hours.bin", "<f4").reshape(len(document["times"]), document["hour_fours"], 4)
    return made, lambda i: {"wlm_lightmap_hour": rows_of_floats(tables[i])}
