"""Flip books: every layout and kind of file there and back, the order of cells, what is refused."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.smoke_plumes import unit_grid
from PIL import Image

from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.formats.exr import read_exr, write_exr
from wlm.smoke.camera import DIRECTIONS, LAYOUTS, Camera, axis_faults
from wlm.smoke.flipbook.textures import brightest_gain, cells, channels, pack, read_flipbook, unpack, write_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.fine import bake

KINDS = {".exr": 6e-4, ".png": 0.51 / 255, ".tga": 0.51 / 255}


def _frames(count: int = 5, emission: bool = True, size: tuple = (6, 9)) -> list[SixWay]:
    random = np.random.default_rng(count)
    maps = torch.tensor(random.uniform(0, 1, (count, 8, *size)), dtype=torch.float32)
    return [SixWay(m[:6], m[6], m[7] if emission else None) for m in maps]


def _paths(folder: Path, suffix: str) -> tuple[Path, Path]:
    return folder / f"a{suffix}", folder / f"b{suffix}"


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_there_and_back(tmp_path: Path, layout: str, suffix: str):
    paths, frames = _paths(tmp_path, suffix), _frames()
    assert write_flipbook(paths, frames, layout, rows=2, columns=3) == 0
    result = read_flipbook(paths, layout, rows=2, columns=3, count=5)
    assert len(result) == 5
    for one, frame in zip(result, frames, strict=True):
        for field in ("lightmaps", "transparency", "emission"):
            np.testing.assert_allclose(getattr(one, field), getattr(frame, field), atol=KINDS[suffix], err_msg=field)


def test_padding():
    """Each frame's border is repeated around it, and is cut off again."""
    frames = _frames(5)
    first, _ = pages = pack(frames, rows=2, columns=3, padding=2)
    assert first.shape == (2 * 10, 3 * 13, 4)
    cell = first[10:, 13:26, 0]  # the fifth
    np.testing.assert_array_equal(cell[2:-2, 2:-2], frames[4]["right"])
    assert (cell[:3, :3] == cell[2, 2]).all() and (cell[4, 10:] == cell[4, 10]).all()
    for one, frame in zip(unpack(*pages, rows=2, columns=3, count=5, padding=2), frames, strict=True):
        torch.testing.assert_close(one.lightmaps, frame.lightmaps)
    with pytest.raises(ValueError, match="padding: expected at least 0"):
        pack(frames, rows=2, columns=3, padding=-1)
    with pytest.raises(ValueError, match="padding: expected cells of more than twice 5"):
        unpack(*pages, rows=2, columns=3, padding=5)


def test_channels_of_unity():
    """A is right, top, back and opacity; B is left, bottom, front and the glow; cells in rows from the top left."""
    frames = _frames(5)
    first, second = pack(frames, "unity", rows=2, columns=3)
    assert first.shape == second.shape == (12, 27, 4)
    cell = first[6:12, 9:18], second[6:12, 9:18]  # the fifth
    for page, names in zip(cell, (("right", "top", "back"), ("left", "bottom", "front")), strict=True):
        for c, name in enumerate(names):
            np.testing.assert_array_equal(page[..., c], frames[4][name])
    np.testing.assert_array_equal(cell[0][..., 3], 1 - frames[4].transparency.numpy())
    np.testing.assert_array_equal(cell[1][..., 3], frames[4].emission)
    assert not first[6:, 18:].any() and not second[6:, 18:].any()


def test_cold_smoke_has_no_emission(tmp_path: Path):
    """The channel is left out, in the file too."""
    paths = _paths(tmp_path, ".png")
    frames = _frames(2, emission=False)
    write_flipbook(paths, frames, rows=1, columns=2)
    assert [Image.open(path).mode for path in paths] == ["RGBA", "RGB"]
    assert all(frame.emission is None for frame in read_flipbook(paths, rows=1, columns=2))
    bare = [SixWay(frame.lightmaps, None) for frame in frames]
    first, second = pack(bare, rows=1, columns=2)
    assert first.shape[2] == second.shape[2] == 3
    assert unpack(first, second, rows=1, columns=2)[1].transparency is None


def test_defaults():
    """Cells as near to a square as can be, and the gain that just doesn't clip."""
    assert [cells(*words) for words in ((1,), (3,), (5,), (64,), (5, 2), (2, 9))] == [
        (1, 1),
        (2, 2),
        (2, 3),
        (8, 8),
        (3, 2),
        (1, 2),
    ]
    frames = _frames(2)
    largest = max(float(frame.emission.max()) for frame in frames)
    dim = [SixWay(0.1 * frame.lightmaps, None, frame.emission) for frame in frames]
    assert brightest_gain(dim) == 1 / largest and brightest_gain([SixWay(torch.zeros(6, 2, 2), None)]) == 1
    assert channels(dim, "unity") == (("right", "top", "back"), ("left", "bottom", "front", "emission"))


def test_gain_and_clipping(tmp_path: Path):
    """8 bits end at 1: what is brighter is counted; a gain is undone by the reader."""
    frames = _frames(1, emission=False)
    dim = [SixWay(0.1 * frames[0].lightmaps, frames[0].transparency)]
    paths = _paths(tmp_path, ".png")
    assert write_flipbook(paths, dim, rows=1, columns=1, gain=10.0) == 0
    result = read_flipbook(paths, rows=1, columns=1, gain=10.0)[0]
    np.testing.assert_allclose(result.lightmaps, dim[0].lightmaps, atol=0.051 / 255)
    np.testing.assert_allclose(result.transparency, dim[0].transparency, atol=0.51 / 255)
    assert write_flipbook(paths, frames, rows=1, columns=1, gain=2.0) == int((frames[0].lightmaps > 0.5).sum())
    bright = [SixWay(70_000.0 * torch.ones(6, 2, 2), torch.zeros(2, 2))]
    assert write_flipbook(_paths(tmp_path, ".exr"), bright, rows=1, columns=1) == 24
    assert read_exr(tmp_path / "a.exr")[0].max() == 65504.0


@pytest.mark.parametrize("suffix", KINDS)
def test_axes_survive(tmp_path: Path, suffix: str):
    """Lightmaps of ours pass the check of the axes after a trip through files, and fail it under another layout."""
    x, y, z = unit_grid(24)
    ball = np.clip(5 - 7 * np.sqrt(x**2 + y**2 + (z - 0.05) ** 2), 0, 1).astype(np.float32)
    volume = from_array(ball, extinction=0.6)
    camera = Camera.look_at((12, 12, 60), (12, 12, 0), extent=24.0, height=24, width=24)
    frames = [bake(volume, camera, step=1.0, estimate=False)] * 2
    paths = _paths(tmp_path, suffix)
    write_flipbook(paths, frames, "unity", rows=1, columns=2)
    for layout in LAYOUTS:
        maps = np.stack([frame.lightmaps for frame in read_flipbook(paths, layout, rows=1, columns=2)])
        assert (axis_faults(maps) == ()) == (layout == "unity"), layout


def test_wrong_files(tmp_path: Path):
    paths = _paths(tmp_path, ".png")
    with pytest.raises(WlmError, match="a.png: cannot read the picture"):
        read_flipbook(paths, rows=1, columns=1)
    with pytest.raises(WlmError, match=r"a\.jpg: expected a name that ends in \.exr, \.png, \.tga"):
        write_flipbook((tmp_path / "a.jpg", paths[1]), _frames(1), rows=1, columns=1)
    write_flipbook(paths, _frames(1), rows=1, columns=1)
    with pytest.raises(WlmError, match="expected 4 x 4 cells of whole pixels, got 6 x 9"):
        read_flipbook(paths, rows=4, columns=4)
    Image.new("RGB", (9, 5)).save(paths[1])
    with pytest.raises(WlmError, match="two textures of one size"):
        read_flipbook(paths, rows=1, columns=1)
    Image.new("L", (9, 6)).save(paths[1])
    with pytest.raises(WlmError, match="b.png: expected RGB or RGBA of 8 bits, found L"):
        read_flipbook(paths, rows=1, columns=1)
    whole = paths[0].read_bytes()
    paths[0].write_bytes(whole[: len(whole) // 2])
    with pytest.raises(WlmError, match="a.png: cannot read the picture"):
        read_flipbook(paths, rows=1, columns=1)
    # The header alone says how large it is; the rest of it is as before.
    header = b"IHDR" + struct.pack(">2I", 9400, 9400) + whole[24:29]
    paths[0].write_bytes(whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:])
    with pytest.raises(WlmError, match=f"a.png: expected at most 2048 times its {len(whole)} bytes once unpacked"):
        read_flipbook(paths, rows=1, columns=1)
    Image.new("RGB", (9, 6)).save(paths[0])
    Image.new("RGB", (9, 6)).save(paths[1])
    with pytest.raises(WlmError, match="layout o3de-tlrb: expected channels for bottom"):
        read_flipbook(paths, "o3de-tlrb", rows=1, columns=1)
    exr = _paths(tmp_path, ".exr")
    for path in exr:
        write_exr(path, np.full((2, 2, 3), np.nan, np.float32))
    with pytest.raises(WlmError, match="a.exr: expected finite light"):
        read_flipbook(exr, rows=1, columns=1)
    with pytest.raises(WlmError, match="a.png: cannot write: expected finite light"):
        write_flipbook(paths, [SixWay(torch.full((6, 2, 2), torch.nan), None)], rows=1, columns=1)
    assert Image.open(paths[0]).size == (9, 6)


def test_wrong_settings():
    frames = _frames(3)
    for options, message in (
        ({"rows": 1, "columns": 2}, "expected 1 to 2 frames, got 3"),
        ({"rows": 0, "columns": 2}, "at least one row"),
        ({"rows": 2, "columns": 2, "layout": "unreal"}, "layout: expected one of unity"),
        ({"rows": 2, "columns": 2, "gain": 0.0}, "gain"),
    ):
        with pytest.raises(ValueError, match=message):
            pack(frames, **options)
    with pytest.raises(ValueError, match="frame 1: expected 6 x 9"):
        pack([frames[0], _frames(1, size=(3, 3))[0]], rows=1, columns=2)
    with pytest.raises(ValueError, match="count"):
        unpack(np.ones((2, 2, 4)), np.ones((2, 2, 4)), rows=1, columns=1, count=2)
    for pages in LAYOUTS.values():
        assert set(DIRECTIONS) < {*pages[0], *pages[1]} and len({*pages[0], *pages[1]}) == 8
