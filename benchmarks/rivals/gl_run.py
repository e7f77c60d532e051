"""Runs and times GLSL without a display, through EGL (the package `moderngl`), with textures in a GPU's own formats.

Shaders run as compute shaders: of the processors of a GPU for data centres only few run fragment shaders.
"""

import ctypes
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from wlm.errors import WlmError

_TEXTURE_2D, _TEXTURE_2D_ARRAY = 0x0DE1, 0x8C1A
_COMPRESSED = {"BC7_UNORM": 0x8E8C, "BC6H_UF16": 0x8E8F}
# Internal format, format and type of uncompressed texels.
_PLAIN = {
    "R8_UNORM": (0x8229, 0x1903, 0x1401),
    "R8G8_UNORM": (0x822B, 0x8227, 0x1401),
    "R32_UINT": (0x8236, 0x8D94, 0x1405),
    "R9G9B9E5_SHAREDEXP": (0x8C3D, 0x1907, 0x8C3E),
    "R32G32B32A32_FLOAT": (0x8814, 0x1908, 0x1406),
}
_FETCHED = ("R32_UINT", "R32G32B32A32_FLOAT")  # textures without a filter
_MIN_FILTER, _MAG_FILTER, _WRAP_S, _WRAP_T, _BASE_LEVEL, _MAX_LEVEL = 0x2801, 0x2800, 0x2802, 0x2803, 0x813C, 0x813D
_NEAREST, _LINEAR, _LINEAR_MIPS, _CLAMP = 0x2600, 0x2601, 0x2703, 0x812F
_EGL = "libEGL.so.1"
_LIBRARIES = ("libGL.so.1", "libOpenGL.so.0", "libGL.so")
_DEVICES = 9  # EGL devices that are tried
_SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "swrast")
_HEAD = "#version 430\n"
_GROUP = 8  # pixels along a side of a group of threads
_MAIN = f"""
layout(local_size_x = {_GROUP}, local_size_y = {_GROUP}) in;
layout(rgba16f, binding = 0) writeonly uniform image2D light;
void main()
{{
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    imageStore(light, pixel, shown(pixel));
}}
"""
_SAMPLE_NS = 1e6


class Screen:
    """An OpenGL 4.3 context without a display.

    Attributes:
        name: Name of the renderer that OpenGL states.
    """

    def __init__(self, hardware: bool) -> None:
        """Opens a context on the first EGL device that has one.

        Args:
            hardware: Whether only a GPU will do; else any renderer.

        Raises:
            WlmError: `moderngl` is missing, or no device fits; the line lists what each one answered.
        """
        try:
            import moderngl
        except ImportError as error:
            raise WlmError("shaders: moderngl is missing; needs the extra: pip install 'wlm[test]'") from error
        answers = []
        for library in _LIBRARIES:
            for device in range(_DEVICES):
                settings = {"libgl": library, "libegl": _EGL, "device_index": device}
                try:
                    context = moderngl.create_context(standalone=True, backend="egl", require=430, **settings)
                except Exception as error:  # moderngl has no class of its own for it
                    answers.append(f"{library} {device}: {error}")
                    continue
                self.name = context.info["GL_RENDERER"]
                if not hardware or not self.name.lower().startswith(_SOFTWARE):
                    self._context = context
                    self._get = ctypes.CDLL(_EGL).eglGetProcAddress
                    self._get.restype, self._get.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
                    return
                answers.append(f"{library} {device}: {self.name}")
                context.release()
        raise WlmError(f"shaders: found no OpenGL 4.3 on a GPU through EGL: {'; '.join(dict.fromkeys(answers))}")

    def texture(self, levels: list[np.ndarray], fmt: str, width: int, height: int, layers: int = 0) -> Any:
        """Uploads a texture with its mips.

        Args:
            levels: Texels or blocks of each level, in the layout of `wlm.bundle.Texture`.
            fmt: A format of `wlm.formats.dds.DXGI_FORMATS`.
            width, height: Size of the first level in texels.
            layers: Number of layers of an array; 0 for a plain texture.
        """
        with self._context:  # that of another library may be the thread's own by now
            return self._uploaded(levels, fmt, width, height, layers)

    def _uploaded(self, levels: list[np.ndarray], fmt: str, width: int, height: int, layers: int) -> Any:
        made = self._context.texture_array((4, 4, 1), 4) if layers else self._context.texture((4, 4), 4)
        made.use(0)
        target = _TEXTURE_2D_ARRAY if layers else _TEXTURE_2D
        for level, data in enumerate(levels):
            size = (max(width >> level, 1), max(height >> level, 1), *([layers] if layers else []))
            data = np.ascontiguousarray(data)
            ending = "3D" if layers else "2D"
            if fmt in _COMPRESSED:
                numbers = (target, level, _COMPRESSED[fmt], *size, 0, data.nbytes)
                self._call(f"glCompressedTexImage{ending}", *numbers, data.ctypes.data)
            else:
                internal, form, kind = _PLAIN[fmt]
                self._call("glPixelStorei", 0x0CF5, 1)  # rows without padding
                self._call(f"glTexImage{ending}", target, level, internal, *size, 0, form, kind, data.ctypes.data)
        mips = len(levels) > 1
        least = _NEAREST if fmt in _FETCHED else _LINEAR_MIPS if mips else _LINEAR
        settings = {_MIN_FILTER: least, _MAG_FILTER: _NEAREST if fmt in _FETCHED else _LINEAR}
        settings |= {_WRAP_S: _CLAMP, _WRAP_T: _CLAMP, _BASE_LEVEL: 0, _MAX_LEVEL: len(levels) - 1}
        for name, value in settings.items():
            self._call("glTexParameteri", target, name, value)
        self._check("texture")
        return made

    def picture(
        self,
        text: str,
        size: tuple[int, int],
        textures: Mapping[str, Any],
        buffers: Mapping[int, np.ndarray] | None = None,
        group: tuple[int, int] | None = None,
    ) -> "Picture":
        """Compiles a shader whose function `vec4 shown(ivec2 pixel)` gives the colour of each pixel.

        Args:
            text: GLSL 4.30 below `#version`.
            size: Rows and columns of the picture, half floats.
            textures: Results of `texture` by the names of uniforms.
            buffers: float32 [n, 4] by the numbers of bindings of storage buffers.
            group: Columns and rows of a group if the text is a whole compute shader, which writes to image 0.
        """
        with self._context:
            return self._compiled(
                f"{text}{'' if group else _MAIN}", size, textures, buffers or {}, group or (_GROUP, _GROUP)
            )

    def _compiled(
        self,
        text: str,
        size: tuple[int, int],
        textures: Mapping[str, Any],
        buffers: Mapping[int, np.ndarray],
        group: tuple[int, int],
    ) -> "Picture":
        context, (height, width) = self._context, size
        groups = -(-width // group[0]), -(-height // group[1])
        software = self.name.lower().startswith(_SOFTWARE)
        program = context.compute_shader(f"{_HEAD}{text}")
        for unit, name in enumerate(textures):
            if name in program:
                program[name].value = unit
        target = context.texture(size[::-1], 4, dtype="f2")
        stored = {place: context.buffer(np.ascontiguousarray(data).tobytes()) for place, data in buffers.items()}

        def draw(count: int) -> float:
            with context:
                target.bind_to_image(0, read=False, write=True)
                for unit, texture in enumerate(textures.values()):
                    texture.use(unit)
                for place, buffer in stored.items():
                    buffer.bind_to_storage_buffer(place)
                query, start = context.query(time=True), time.perf_counter()
                with query:
                    for _ in range(count):
                        program.run(*groups)
                context.finish()
                # Timer queries of software leave out compute shaders.
                return 1e9 * (time.perf_counter() - start) if software else float(query.elapsed)

        def read() -> np.ndarray:
            draw(1)
            with context:
                context.memory_barrier()
                self._check("draw")
                return np.frombuffer(target.read(), np.float16).reshape(*size, 4).astype(np.float32)

        return Picture(draw, read)

    def _call(self, name: str, *arguments: int) -> None:
        address = self._get(name.encode())
        if not address:
            raise WlmError(f"shaders: expected OpenGL with {name}")
        kinds = [
            ctypes.c_void_p if i == len(arguments) - 1 and name.endswith("D") else ctypes.c_int
            for i in range(len(arguments))
        ]
        ctypes.CFUNCTYPE(None, *kinds)(address)(*arguments)

    def _check(self, what: str) -> None:
        error = self._context.error
        if error != "GL_NO_ERROR":
            raise WlmError(f"shaders: {what}: expected no error of OpenGL, got {error}")


class Picture:
    """A picture that a shader draws."""

    def __init__(self, draw: Callable[[int], float], read: Callable[[], np.ndarray]) -> None:
        """Takes the functions that draw it some times and return nanoseconds, and that return it."""
        self._draw, self.read = draw, read

    def time(self, repeats: int) -> float:
        """Returns the median time of one draw on the device in ms, by timer queries of samples of at least 1 ms.

        In software it is the time of the host.
        """
        once = max(self._draw(1), self._draw(1), 1.0)
        count = max(1, min(1000, int(np.ceil(_SAMPLE_NS / once))))
        return float(np.median([self._draw(count) / count for _ in range(repeats)])) / 1e6
