"""Flip books: every layout and kind of file, written and read, the order of cells, and wrong files."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.smoke_axes import axis_faults
from builders.smoke_plumes import unit_grid
from PIL import Image

from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.formats.exr import read_exr, write_exr
from wlm.smoke.camera import DIRECTIONS, LAYOUTS, Camera
from wlm.smoke.flipbook.book import Book, Shot, is_straight, pack_book, read_flipbook, write_book
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.fine import bake

KINDS = {".exr": 6e-4, ".png": 0.51 / 255, ".tga": 0.51 / 255}


def _frames(count: int = 5, emission: bool = True, size: tuple = (6, 9)) -> list[SixWay]:
    random = np.random.default_rng(count)
    maps = torch.tensor(random.uniform(0, 1, (count, 8, *size)), dtype=torch.float32)
    return [SixWay(m[:6], m[6], m[7] if emission else None) for m in maps]


def _book(frames: list[SixWay], layout: str = "unity", gain: float | None = 1.0, **options) -> Book:
    return pack_book([Shot(n, frame) for n, frame in enumerate(frames, 1)], layout, gain=gain, **options)


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_written_frames_are_read(tmp_path: Path, layout: str, suffix: str):
    frames = _frames()
    paths, clipped = write_book(_book(frames, layout), tmp_path / f"a{suffix}")
    assert [path.name for path in paths] == [f"a_1{suffix}", f"a_2{suffix}"] and clipped == 0
    result = read_flipbook([*paths], layout, rows=2, columns=3)
    assert len(result) == 6 and not result[5].lightmaps.any() and (result[5].transparency == 1).all()
    for one, frame in zip(result, frames, strict=False):
        for field in ("lightmaps", "transparency", "emission"):
            np.testing.assert_allclose(getattr(one, field), getattr(frame, field), atol=KINDS[suffix], err_msg=field)


def test_channels_and_padding_of_unity():
    """Cells are in rows from the top left; each frame's border is repeated around it."""
    frames = _frames(5)
    book = _book(frames, padding=2)
    assert book.first.shape == book.second.shape == (2 * 10, 3 * 13, 4)
    cell = book.first[10:, 13:26], book.second[10:, 13:26]  # the fifth
    for page, names in zip(cell, (("right", "top", "back"), ("left", "bottom", "front")), strict=True):
        for c, name in enumerate(names):
            np.testing.assert_array_equal(page[2:-2, 2:-2, c], frames[4][name])
            assert (page[:3, :3, c] == page[2, 2, c]).all() and (page[4, 10:, c] == page[4, 10, c]).all()
    np.testing.assert_array_equal(cell[0][2:-2, 2:-2, 3], 1 - frames[4].transparency.numpy())
    np.testing.assert_array_equal(cell[1][2:-2, 2:-2, 3], frames[4].emission)
    assert not book.first[10:, 26:].any() and not book.second[10:, 26:].any()
    for pages in LAYOUTS.values():
        assert set(DIRECTIONS) < {*pages[0], *pages[1]} and len({*pages[0], *pages[1]}) == 8


def test_absent_channels_are_omitted(tmp_path: Path):
    frames = _frames(2, emission=False)
    paths, _ = write_book(_book(frames), tmp_path / "a.png")
    assert [Image.open(path).mode for path in paths] == ["RGBA", "RGB"]
    assert all(frame.emission is None for frame in read_flipbook([*paths], "unity", rows=1, columns=2))
    bare = _book([SixWay(frame.lightmaps, None) for frame in frames])
    assert bare.first.shape[2] == bare.second.shape[2] == 3
    paths, _ = write_book(bare, tmp_path / "b.exr")
    assert read_flipbook([*paths], "unity", rows=1, columns=2)[1].transparency is None


def test_default_cells_and_gain(tmp_path: Path):
    """The cells are nearest to a square; the gain is the largest without clipping; brighter values are counted."""
    shapes = [(book.rows, book.columns) for book in map(_book, map(_frames, (1, 3, 5, 64)))]
    assert shapes == [(1, 1), (2, 2), (2, 3), (8, 8)]
    assert [_book(_frames(5), columns=columns).rows for columns in (2, 9)] == [3, 1]
    frames = _frames(2)
    dim = [SixWay(0.1 * frame.lightmaps, None, frame.emission) for frame in frames]
    assert _book(dim, gain=None).gain == 1 / max(float(frame.emission.max()) for frame in frames)
    assert _book([SixWay(torch.zeros(6, 2, 2), None)], gain=None).gain == 1
    assert _book(dim).channels["second"] == ("left", "bottom", "front", "emission")
    cold = _frames(1, emission=False)
    _, clipped = write_book(_book(cold, gain=2.0), tmp_path / "a.png")
    assert clipped == int((cold[0].lightmaps > 0.5).sum())
    bright = [SixWay(70_000.0 * torch.ones(6, 2, 2), torch.zeros(2, 2))]
    _, clipped = write_book(_book(bright), tmp_path / "a.exr")
    assert clipped == 24 and read_exr(tmp_path / "a_1.exr")[0].max() == 65504.0


@pytest.mark.parametrize("suffix", KINDS)
def test_directions_survive(tmp_path: Path, suffix: str):
    """Our lightmaps pass the check of directions after a trip through files, and fail it under another layout."""
    x, y, z = unit_grid(24)
    ball = np.clip(5 - 7 * np.sqrt(x**2 + y**2 + (z - 0.05) ** 2), 0, 1).astype(np.float32)
    camera = Camera.look_at((12, 12, 60), (12, 12, 0), extent=24.0, height=24, width=24)
    frames = [bake(from_array(ball, extinction=0.6), camera, step=1.0, estimate=False)] * 2
    paths, _ = write_book(_book(frames), tmp_path / f"a{suffix}")
    for layout in LAYOUTS:
        maps = np.stack([frame.lightmaps for frame in read_flipbook([*paths], layout, rows=1, columns=2)])
        assert (axis_faults(maps) == ()) == (layout == "unity"), layout


def test_straight_alpha_in_a_third_texture(tmp_path: Path):
    frames = _frames(2, emission=False)
    paths, _ = write_book(_book([SixWay(frame.lightmaps, None) for frame in frames]), tmp_path / "a.png")
    opacity = np.concatenate([1.0 - frame.transparency.numpy() for frame in frames], 1)
    opacity[:, :9][:2] = 0.0
    Image.fromarray(np.uint8(np.rint(255 * opacity))).save(tmp_path / "opacity.png")
    book = [*paths, tmp_path / "opacity.png"]
    read, plain = (read_flipbook(book, "unity", rows=1, columns=2, straight=straight) for straight in (True, False))
    expected = frames[1].lightmaps * (1.0 - frames[1].transparency)
    np.testing.assert_allclose(read[1].lightmaps, expected, atol=0.01)
    np.testing.assert_allclose(read[1].transparency, frames[1].transparency, atol=0.003)
    assert not is_straight(read) and is_straight(plain)
    with pytest.raises(WlmError, match="expected an alpha channel or a third texture for straight alpha"):
        read_flipbook([*paths], "unity", rows=1, columns=2, straight=True)
    Image.new("L", (8, 8)).save(book[2])
    with pytest.raises(WlmError, match="expected textures of one size"):
        read_flipbook(book, "unity", rows=1, columns=2)


def test_wrong_files(tmp_path: Path):
    paths = tmp_path / "a_1.png", tmp_path / "a_2.png"

    def refused(message: str, layout: str = "unity", cells: int = 1) -> None:
        with pytest.raises(WlmError, match=message):
            read_flipbook(paths, layout, rows=cells, columns=cells)

    refused("a_1.png: cannot read the picture")
    write_book(_book(_frames(1)), tmp_path / "a.png")
    refused("expected sides that divide into 4 rows and 4 columns, found 9x6 pixels", cells=4)
    refused("expected sides that divide into 12 rows and 12 columns, found 9x6 pixels", cells=12)
    Image.new("RGB", (9, 5)).save(paths[1])
    refused("textures of one size")
    Image.new("L", (9, 6)).save(paths[1])
    refused("a_2.png: expected RGB or RGBA with 8 bits per channel, found L")
    whole = paths[0].read_bytes()
    paths[0].write_bytes(whole[: len(whole) // 2])
    refused("a_1.png: cannot read the picture")
    # The header alone states the size; the rest of the file is as before.
    header = b"IHDR" + struct.pack(">2I", 9400, 9400) + whole[24:29]
    paths[0].write_bytes(whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:])
    refused(f"a_1.png: expected at most 2048 times its {len(whole)} compressed bytes")
    for path in paths:
        Image.new("RGB", (9, 6)).save(path)
    refused("layout o3de-tlrb: expected channels for bottom", "o3de-tlrb")
    with pytest.raises(WlmError, match="expected two textures, or three with one of opacity, got 1"):
        read_flipbook(paths[:1], "unity", rows=1, columns=1)
    write_exr(tmp_path / "a.exr", np.full((2, 2, 3), np.nan, np.float32))
    with pytest.raises(WlmError, match="a.exr: expected finite light"):
        read_flipbook([tmp_path / "a.exr"] * 2, "unity", rows=1, columns=1)
    with pytest.raises(WlmError, match="a_1.png: cannot write: expected finite light"):
        write_book(_book([SixWay(torch.full((6, 2, 2), torch.nan), None)]), tmp_path / "a.png")
    with pytest.raises(WlmError, match=r"a_1\.jpg: expected a name that ends in \.exr, \.png, \.tga"):
        write_book(_book(_frames(1)), tmp_path / "a.jpg")
    assert Image.open(paths[0]).size == (9, 6)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"layout": "unreal"}, "layout: expected one of unity"), ({"gain": 0.0}, "gain"), ({"padding": -1}, "padding")],
)
def test_wrong_settings(options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        _book(_frames(3), **options)
    with pytest.raises(ValueError, match="shots: expected lightmaps of one size"):
        _book([*_frames(1), *_frames(1, size=(3, 3))])
