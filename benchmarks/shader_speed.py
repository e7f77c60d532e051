"""Speed of the exported shaders of lightmaps on a GPU, beside the decoders of `benchmarks.rivals.whole_tiles`.

The map has 1024 x 1024 texels with random maps and networks. The rows:

- "ours": the fast decoder at a stored hour, 8 bits per channel, of profiles M and `standard`; and all pages of a
  virtual texture of the map, of all mips with borders, in one list.
- "GLSL": the exported functions in a compute shader through OpenGL, which decodes the same hour to half floats; numbers
  of networks and of the hour are in textures as exported, or by the shader's macros in storage buffers. "groups share a
  network" is the exported compute shader, with storage buffers.
- "WGSL": the same translated, through wgpu; a time is the difference of long and short runs, over the difference of
  their dispatches.
- "Chromium", on the CPU: the page of a map of 128 x 128 texels, by WebGL2 in software, beside our decoder of this map.
- "read": a view of 1280 x 720 pixels of four sheets, read trilinearly: from a virtual texture, and from two hours of
  BC7, BC6H and RGB9E5 with mips, interpolated. "nothing" reads the view's coordinates alone, as all others do.

`max_error` is the largest difference from `SheetDecoder`, relative to the brightest texel of the map; the texture
filter has 8 bits for a position between two texels. A way that this machine cannot measure is a row with the reason.
"""

import re
import time
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.lightmap import ALL, PAGE_FRAMES, PAGES, texels_of, view_of_all_pages
from benchmarks.lightmap_run_time import _PlainCamera, large_model, random_sheet
from benchmarks.rivals.browser_run import page_time
from benchmarks.rivals.gl_run import Screen
from benchmarks.rivals.whole_tiles import fast_decoder
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.export.compute import compute_shader
from wlm.export.shading import translate
from wlm.lightmap.bundle import sheet_bundle
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.profile import Profile
from wlm.lightmap.shader import GROUP_SIZE
from wlm.lightmap.sheet import LIGHT, Sheet
from wlm.lightmap.tiles import TILE
from wlm.lightmap.virtual.shader import sheet_words, virtual_glsl
from wlm.lightmap.virtual.texture import VirtualTexture

_PROFILES = ("M", "standard")
_SIDE, _QUICK_SIDE = 1024, 128
_LEAST_SIDE = 512  # of a sheet of the view, whose camera walks in a circle of 6.4 m
_VIEW, _QUICK_VIEW = (720, 1280), (90, 160)
_HOURS = (0.0, 6.0, 12.0, 18.0)
_FRAMES = 64  # of a virtual texture until its view is there
_CELL = GROUP_SIZE[0], 2 * GROUP_SIZE[1]  # texels of a group of the exported compute shader
_ROW = 1024  # groups of four floats in a row of a texture of numbers
_DISPATCHES = (10, 110)  # of the two runs of WGSL
_BUFFERS = {"networks": ("NET", 0), "hours": ("HOUR_AT", 1)}  # macro and binding of each buffer

_SHOWN = "vec4 shown(ivec2 pixel) { return vec4(wlm_radiance(pixel), 1.0); }\n"
_WGSL_MAIN = """
@group(1) @binding(0) var wlm_out: texture_storage_2d<rgba16float, write>;
@compute @workgroup_size(8, 8) fn main(@builtin(global_invocation_id) id: vec3u)
{
    textureStore(wlm_out, id.xy, shown(vec2i(id.xy)));
}
"""
_TEXTURES, _BUFFERED, _GROUPS = "numbers in textures", "numbers in buffers", "groups share a network"
_READ = """
uniform sampler2D u_view;
uniform sampler2D u_slopes;
uniform sampler2DArray u_early;
uniform sampler2DArray u_late;
vec4 shown(ivec2 pixel)
{
    vec4 view = texelFetch(u_view, pixel, 0);
    vec4 slopes = texelFetch(u_slopes, pixel, 0);
    vec2 dx = slopes.xz;
    vec2 dy = slopes.yw;
    if (view.z < 0.0)
        return vec4(0.0);
    return vec4(%s, 1.0);
}
"""
_TWO = "mix({0}, {1}, 0.3)"
_GRAD = "textureGrad(u_{0}, view.xyz, dx, dy).rgb"
_GAMMA = "pow({0}, vec3(2.2))"


def run(*, quick: bool, device: str, progress: Note | None = None) -> list[Row]:
    """Measures the exported shaders.

    Args:
        quick: Whether to draw a map of 128 x 128 texels and a small view.
        device: "cpu" or "cuda:0", the device of our decoder; "cpu" lets shaders run in software.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, in the order of the module's docstring.

    Raises:
        WlmError: There is no such device.
    """
    bench = _ShaderBench(quick, device, progress)
    # In software OpenGL compiles the larger network for minutes.
    profiles = _PROFILES[:1] if bench.device == "cpu" else _PROFILES
    rows = [row for name in profiles for row in bench.profile_rows(name)]
    return [*rows, *(bench.browser_rows() if bench.device == "cpu" else []), *bench.read_rows()]


class _ShaderBench(Bench):
    def __init__(self, quick: bool, device: str, progress: Note | None) -> None:
        self._side, self._view = (_QUICK_SIDE, _QUICK_VIEW) if quick else (_SIDE, _VIEW)
        super().__init__("lightmap", device, progress, scene=f"shaders, {self._side} x {self._side}")
        self._screen: Screen | WlmError
        try:
            self._screen = Screen(hardware=self.device != "cpu")
        except WlmError as error:
            self._screen = error

    def profile_rows(self, name: str) -> list[Row]:
        """Returns the rows of our decoder and of the shaders of a profile."""
        self.note(f"decoding {name}")
        model = random_sheet(self._side, np.array(_HOURS), 0, Profile.load(name))
        decoder = fast_decoder(model, self.device)
        (ours,) = self.time_rows([(self.row("ours", name, f"RGB9E5, {self.mode}"), self.replay(decoder.decode))])
        made = sheet_bundle(Sheet(), model, name, "0" * 16, self.device)
        rows = [ours]
        for language, option, draw in [
            (language, option, partial(draw, made, option == _TEXTURES, option == _GROUPS))
            for language, draw in (("GLSL", self._glsl), ("WGSL", self._wgsl))
            for option in (_TEXTURES, _BUFFERED, _GROUPS)
        ]:
            self.note(f"{language} of {name}, {option}")
            try:
                picture, duration, renderer = draw()
            except Exception as error:  # whatever a driver says
                rows.append(self.missing_row(language, f"{name}, {option}", error))
                continue
            frame = made.reference["frame"]
            error = float(np.abs(picture[..., :3] - frame).max() / frame.max())
            figures = {"decode_ms": duration, "times_ours": duration / ours["decode_ms"], "max_error": error}
            rows.append(self.row(language, f"{name}, {option}", renderer, **figures))
        return [*rows, self.pages_row(name)]

    def pages_row(self, name: str) -> Row:
        """Returns the row of all pages of a virtual texture of a map, of at least 256 x 256 texels."""
        self.note(f"all pages of {name}")
        model = random_sheet(max(self._side, 2 * TILE), np.array(_HOURS), 0, Profile.load(name))
        frame = SheetDecoder(model, self.device).frame(_HOURS[0])
        whole = LightmapModel("pages", "0" * 16, model.profile, {Sheet(): model})
        read, timed = (VirtualTexture(whole, self.device, budget=ALL, decodes=PAGES, tolerance=1e-6) for _ in range(2))
        with read, timed:
            view = view_of_all_pages(read)
            for _ in range(PAGE_FRAMES):
                read.frame(_HOURS[0], *view)
            error = float(np.abs(read.sample(*texels_of(frame.shape[:2])).light - frame).max() / frame.max())
            timed.frame(_HOURS[0], *view)  # all pages are missing, so that its list has all of them
            figures = {"pages_decoded": timed.report()["decoded"], "max_error": error}
            notes = f"all pages of all mips with borders of {read.layout.border} texels, RGB9E5, {self.mode}"
            row = self.row("ours", f"{name}, all pages", notes, **figures)
            return self.time_rows([(row, self.replay(timed.stages["decode"]))])[0]

    def browser_rows(self) -> list[Row]:
        """Returns the rows of a tile in a browser, and of our decoder of this tile."""
        self.note("decoding a tile in Chromium")
        sheet, scene = random_sheet(TILE, np.array(_HOURS), 0, Profile.load("M")), f"a tile, {TILE} x {TILE}"
        decoder = fast_decoder(sheet, self.device)
        (ours,) = self.time_rows([(self.row("ours", "M", f"RGB9E5, {self.mode}", scene=scene), decoder.decode)])
        try:
            duration = page_time(LightmapModel("tile", "0" * 16, sheet.profile, {LIGHT: sheet}), self._repeats)
        except Exception as error:  # whatever a browser says
            return [ours, self.missing_row("Chromium", "M", error)]
        figures = {"decode_ms": duration, "times_ours": duration / ours["decode_ms"]}
        return [ours, self.row("Chromium", "M", "WebGL2 by SwiftShader", scene=scene, **figures)]

    def read_rows(self) -> list[Row]:
        """Returns the rows of the ways to read a view."""
        try:
            return self._read_rows()
        except Exception as error:  # whatever a driver says
            return [self.missing_row("read", "", error)]

    def _opened(self) -> Screen:
        if isinstance(self._screen, WlmError):
            raise self._screen
        return self._screen

    def _glsl(self, made: Bundle, textured: bool, groups: bool) -> tuple[np.ndarray, float, str]:
        screen = self._opened()
        textures = {
            f"wlm_lightmap_{name}": screen.texture([part.data], part.fmt, part.width, part.height, part.layers)
            for name, part in made.textures.items()
        }
        text, stored = compute_shader(made, "glsl") if groups else made.shader + _SHOWN, {}
        numbers = {"networks": made.buffers["networks"], "hours": made.buffers["hours"][0]}
        for name, (macro, place) in _BUFFERS.items():
            if not textured:
                block = f"layout(std430, binding = {place}) readonly buffer Wlm{place} {{ vec4 wlm_{name}[]; }};\n"
                text = f"{block}#define WLM_LIGHTMAP_{macro}(i) wlm_{name}[i]\n{text}"
                stored[place] = np.float32(numbers[name])
            else:
                rows = _rows_of_fours(numbers[name])
                textures[_uniform(name)] = screen.texture([rows], "R32G32B32A32_FLOAT", _ROW, len(rows))
        picture = screen.picture(text, (self._side, self._side), textures, stored, _CELL if groups else None)
        return picture.read(), picture.time(self._repeats), screen.name

    @cached_property
    def _device_of_wgpu(self) -> tuple[Any, Any]:
        import wgpu

        adapters = wgpu.gpu.enumerate_adapters_sync()
        found = [each for each in adapters if self.device == "cpu" or "GPU" in str(each.info["adapter_type"])]
        if not found:
            names = ", ".join(str(each.info["device"]) for each in adapters) or "no adapter"
            raise WlmError(f"shaders: expected a GPU for wgpu, found {names}")
        # Vulkan before OpenGL.
        adapter = min(found, key=lambda each: str(each.info["backend_type"]) != "Vulkan")
        side = adapter.limits["max-texture-dimension-2d"]
        shared = "max-compute-workgroup-storage-size"
        gpu = adapter.request_device_sync(
            required_features=["texture-compression-bc"],
            required_limits={"max-texture-dimension-2d": side, shared: adapter.limits[shared]},
        )
        return adapter, gpu

    def _wgsl(self, made: Bundle, textured: bool, groups: bool) -> tuple[np.ndarray, float, str]:
        import wgpu

        adapter, gpu = self._device_of_wgpu
        text = compute_shader(made, "wgsl") if groups else translate(made.shader + _SHOWN, "wgsl") + _WGSL_MAIN
        for name in () if textured else ("hour", "networks"):
            own = f"wlm_lightmap_{name}"
            text = text.replace(f"var {own}: texture_2d<f32>", f"var<storage, read> {own}: array<vec4f>")
            text = text.replace(f"textureLoad({own}, vec2i(i & 1023, i >> 10), 0)", f"{own}[i]")
        pipeline = gpu.create_compute_pipeline(
            layout="auto", compute={"module": gpu.create_shader_module(code=text), "entry_point": "main"}
        )
        # The mask is read to fill gaps only, which no shader is asked for here.
        names = re.findall(r"@group\(0\) @binding\((\d+)\) var(?:<[^>]*>)? (?!wlm_lightmap_valid\b)(\w+)", text)
        entries = [
            {"binding": int(place), "resource": _wgpu_resource(gpu, made, name, not textured)}
            for place, name in names
            if len(re.findall(rf"\b{name}\b", text)) > 1
        ]
        kinds = wgpu.TextureUsage
        size = (self._side, self._side, 1)
        out = gpu.create_texture(size=size, format="rgba16float", usage=kinds.STORAGE_BINDING | kinds.COPY_SRC)
        bound = [
            gpu.create_bind_group(layout=pipeline.get_bind_group_layout(i), entries=each)
            for i, each in enumerate((entries, [{"binding": 0, "resource": out.create_view()}]))
        ]

        columns, rows = _CELL if groups else (8, 8)

        def dispatch(count: int) -> float:
            encoder = gpu.create_command_encoder()
            work = encoder.begin_compute_pass()
            work.set_pipeline(pipeline)
            for i, group in enumerate(bound):
                work.set_bind_group(i, group)
            for _ in range(count):
                work.dispatch_workgroups(self._side // columns, self._side // rows)
            work.end()
            start = time.perf_counter()
            gpu.queue.submit([encoder.finish()])
            texel = {"bytes_per_row": 8, "rows_per_image": 1}
            gpu.queue.read_texture({"texture": out}, texel, (1, 1, 1))  # waits
            return time.perf_counter() - start

        short, long = (1, 3) if self.device == "cpu" else _DISPATCHES
        dispatch(short)
        samples = [(dispatch(long) - dispatch(short)) / (long - short) for _ in range(self._repeats)]
        layout = {"bytes_per_row": 8 * self._side, "rows_per_image": self._side}
        data = gpu.queue.read_texture({"texture": out}, layout, size)
        picture = np.frombuffer(data, np.float16).reshape(self._side, self._side, 4).astype(np.float32)
        return picture, 1e3 * float(np.median(samples)), f"{adapter.info['device']}, {adapter.info['backend_type']}"

    def _read_rows(self) -> list[Row]:
        self.note("reading a view")
        screen, side = self._opened(), max(self._side, _LEAST_SIDE)
        model, camera = large_model(side), _PlainCamera(side, self._view, self.device)
        view = camera(0.1)
        with VirtualTexture(model, self.device, decodes=64) as texture:
            for _ in range(_FRAMES):
                texture.frame(12.0, *view)
            state, table, words = texture.state(), texture.table.numpy(), sheet_words(texture.layout)
            light = texture.sample(*view).light
        number, uv, slopes = (wp.to_torch(part).cpu().numpy() for part in view)
        points = np.concatenate([uv, number[..., None], 0.0 * uv[..., :1]], 2).astype(np.float32)
        form, (height, width) = "R32G32B32A32_FLOAT", self._view
        where = {
            "u_view": screen.texture([points], form, width, height),
            "u_slopes": screen.texture([slopes], form, width, height),
        }
        slots, edge = state.texture.shape[:2]
        virtual = {
            "wlm_virtual_pages": screen.texture([state.texture], "R9G9B9E5_SHAREDEXP", edge, edge, slots),
            "wlm_virtual_table": screen.texture([table.astype(np.uint32)], "R32_UINT", 1024, len(table) // 1024),
            "wlm_virtual_sheets": screen.texture([words], "R32_UINT", words.shape[1], len(words)),
        }
        two = _TWO.format(_GRAD.format("early"), _GRAD.format("late"))
        levelled = _TWO.format(*(_GAMMA.format(_GRAD.format(name)) for name in ("early", "late")))
        ways: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
            "nothing": ("vec3(view.xy, slopes.x + slopes.w)", dict),
            "virtual texture": ("wlm_virtual_light(int(view.z), view.xy, dx, dy)", lambda: virtual),
            "two hours of RGB9E5": (two, lambda: self._hours("R9G9B9E5_SHAREDEXP", side)),
            "two hours of BC7": (levelled, lambda: self._hours("BC7_UNORM", side)),
            "two hours of BC6H": (two, lambda: self._hours("BC6H_UF16", side)),
        }
        rows = []
        for name, (expression, textures) in ways.items():
            text = virtual_glsl() + _READ % expression
            picture = screen.picture(text, self._view, where | textures())
            figures: dict[str, float] = {"time_ms": picture.time(self._repeats)}
            if name == "virtual texture":
                figures["max_error"] = float(np.abs(picture.read()[..., :3] - light).max() / light.max())
            rows.append(self.row("read", name, f"{width}x{height} pixels, {screen.name}", **figures))
        return rows

    def _hours(self, fmt: str, side: int) -> dict[str, Any]:
        """Uploads the mips of four sheets at two hours, of random texels or blocks, which take as long as any."""
        made, random, screen = {}, np.random.default_rng(0), self._opened()
        blocks = fmt != "R9G9B9E5_SHAREDEXP"
        for name in ("u_early", "u_late"):
            levels = []
            for level in range(side.bit_length()):
                size = max(side >> level, 1)
                count = 4 * (-(-size // 4)) ** 2 * 16 if blocks else 4 * size * size * 4
                levels.append(random.integers(0, 256, count, np.uint8))
                if fmt == "BC7_UNORM":
                    levels[-1][::16] = 64  # mode 6
            made[name] = screen.texture(levels, fmt, side, side, 4)
        return made


def _rows_of_fours(numbers: np.ndarray) -> np.ndarray:
    fours = np.asarray(numbers, np.float32).reshape(-1, 4)
    return np.pad(fours, ((0, -len(fours) % _ROW), (0, 0))).reshape(-1, _ROW, 4)


def _uniform(buffer: str) -> str:
    return "wlm_lightmap_hour" if buffer == "hours" else f"wlm_lightmap_{buffer}"


def _wgpu_resource(gpu: Any, made: Bundle, name: str, buffers: bool) -> Any:
    """Uploads what a binding of a translated shader needs: a texture, a buffer of numbers, or the sampler."""
    import wgpu

    part = name.removeprefix("wlm_lightmap_")
    if part in ("networks", "hour"):
        data = _rows_of_fours(made.buffers["networks"] if part == "networks" else made.buffers["hours"][0])
        if buffers:
            return {"buffer": gpu.create_buffer_with_data(data=data, usage=wgpu.BufferUsage.STORAGE)}
        fmt, size, pitch, rows = "rgba32float", (_ROW, len(data), 1), 16 * _ROW, len(data)
    elif part in made.textures:
        own = made.textures[part]
        data, size = own.data, (own.width, own.height, max(own.layers, 1))
        fmt, block, texels = {
            "BC7_UNORM": ("bc7-rgba-unorm", 16, 4),
            "R8G8_UNORM": ("rg8unorm", 2, 1),
            "R8_UNORM": ("r8unorm", 1, 1),
        }[own.fmt]
        pitch, rows = own.width // texels * block, own.height // texels
    else:
        return gpu.create_sampler(mag_filter="linear", min_filter="linear")
    kinds = wgpu.TextureUsage
    texture = gpu.create_texture(size=size, format=fmt, usage=kinds.TEXTURE_BINDING | kinds.COPY_DST)
    layout = {"bytes_per_row": pitch, "rows_per_image": rows}
    gpu.queue.write_texture({"texture": texture}, np.ascontiguousarray(data), layout, size)
    return texture.create_view()
