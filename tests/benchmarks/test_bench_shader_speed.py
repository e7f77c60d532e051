"""The benchmark of exported shaders: textures hold what was uploaded, and every way shows what Python decodes."""

import numpy as np
import pytest
import texture2ddecoder
from builders.bench_rows import keys
from builders.shader_runs import gl

from benchmarks import shader_speed as bench
from benchmarks.rivals.gl_run import Screen
from wlm.errors import WlmError
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5

FETCH = "uniform {kind} u_texels;\nvec4 shown(ivec2 pixel) {{ return vec4(texelFetch(u_texels, {at})){scale}; }}\n"


@pytest.fixture(scope="module")
def screen():
    gl()  # skips where there is no OpenGL
    return Screen(hardware=False)


def texels_of(fmt: str):
    """Random texels of a format as they are uploaded, and as a shader reads them, [8, 12, channels]."""
    random = np.random.default_rng(0)
    if fmt == "BC7_UNORM":
        blocks = random.integers(0, 256, (6, 16), np.uint8)
        blocks[:, 0] = 64  # mode 6
        bgra = np.frombuffer(texture2ddecoder.decode_bc7(blocks.tobytes(), 12, 8), np.uint8).reshape(8, 12, 4)
        return blocks, bgra[..., [2, 1, 0, 3]] / 255.0
    if fmt == "R9G9B9E5_SHAREDEXP":
        words = pack_rgb9e5(random.uniform(0.0, 3.0, (8, 12, 3)).astype(np.float32))
        return words, unpack_rgb9e5(words)
    if fmt == "R32_UINT":
        numbers = random.integers(0, 2000, (8, 12, 1), np.uint32)
        return numbers, numbers / 1000.0
    if fmt == "R32G32B32A32_FLOAT":
        numbers = random.random((8, 12, 4), np.float32)
        return numbers, numbers
    levels = random.integers(0, 256, (8, 12, 2 if fmt == "R8G8_UNORM" else 1), np.uint8)
    return levels, levels / 255.0


@pytest.mark.parametrize("layers", [0, 1])
@pytest.mark.parametrize("fmt", "BC7_UNORM R9G9B9E5_SHAREDEXP R32_UINT R32G32B32A32_FLOAT R8G8_UNORM R8_UNORM".split())
def test_a_texture_holds_its_texels(screen, fmt, layers):
    data, expected = texels_of(fmt)
    unsigned = fmt == "R32_UINT"
    kind = f"{'u' * unsigned}sampler2D{'Array' * layers}"
    at = "ivec3(pixel, 0), 0" if layers else "pixel, 0"
    text = FETCH.format(kind=kind, at=at, scale=" / 1000.0" * unsigned)
    picture = screen.picture(text, (8, 12), {"u_texels": screen.texture([data], fmt, 12, 8, layers)})
    np.testing.assert_allclose(picture.read()[..., : expected.shape[2]], expected, rtol=1e-3, atol=1e-3)


def test_software_is_no_gpu(screen):
    if not screen.name.startswith("llvmpipe"):
        pytest.skip(f"OpenGL has a GPU here: {screen.name}")
    with pytest.raises(WlmError, match="found no OpenGL 4.3 on a GPU through EGL: .*llvmpipe"):
        Screen(hardware=True)


@pytest.fixture(scope="module")
def rows(screen):
    return bench.run(quick=True, device="cpu")


def test_every_way_shows_what_python_decodes(rows):
    places = ("numbers in textures", "numbers in buffers", "groups share a network")
    shaders = [(language, f"M, {place}") for language in ("GLSL", "WGSL") for place in places]
    page = [("ours", "M"), ("Chromium", "M")]
    reads = ["nothing", "virtual texture", "two hours of RGB9E5", "two hours of BC7", "two hours of BC6H"]
    assert keys(rows) == [("ours", "M"), *shaders, ("ours", "M, all pages"), *page, *(("read", name) for name in reads)]
    for row in rows[1:7]:
        # The texture filter has 8 bits for a position.
        assert 0.0 < row["max_error"] < 5e-3 and row["times_ours"] == row["decode_ms"] / rows[0]["decode_ms"]
    assert all(row["time_ms"] > 0.0 for row in rows[10:]) and rows[11]["max_error"] < 5e-3
    assert 0.0 < rows[7]["max_error"] < 5e-3 and rows[7]["pages_decoded"] >= 1
