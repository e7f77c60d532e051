"""Flip books: every layout and kind of file, the order of cells, wrong files, and mip levels that mix no frames."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.checks import error_of
from builders.smoke_plumes import unit_grid
from PIL import Image

from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.formats.exr import read_exr, write_exr, write_planes
from wlm.smoke.camera import DIRECTIONS, LAYOUTS, Camera
from wlm.smoke.data import is_six_way, read_shaded
from wlm.smoke.flipbook.book import Book, Shot, lay_out, mip_levels, mip_padding, pack_book, write_book
from wlm.smoke.flipbook.naming import second_names
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.smoke.lightmaps import SixWay, axis_faults
from wlm.smoke.march.six_way import bake

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
    assert len(result) == 5  # the empty cell is none of the frames
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
        notes: list[str] = []
        read = read_flipbook([*paths], layout, rows=1, columns=2, notes=notes)
        doubted = any("the light contradicts" in line and "it fits --from unity better" in line for line in notes)
        assert doubted == (layout != "unity"), layout
    swapped = "left,top,back,alpha:right,bottom,front"
    read_flipbook([*paths], swapped, rows=1, columns=2, notes=notes)
    assert "--from unity better" in notes[-1]
    read_flipbook([*paths][::-1], rows=1, columns=2, notes=notes)
    assert "it fits --from left,bottom,front,emission:right,top,back,alpha better" in notes[-1]
    # Files of other programs state nothing: layout, cells and alpha are seen in the light.
    if suffix != ".exr":
        for path in paths:
            Image.fromarray(np.asarray(Image.open(path))).save(path)
    else:
        for path in paths:
            write_exr(path, read_exr(path)[0])
    notes.clear()
    read = read_flipbook([*paths], notes=notes)
    assert "layout unity, by its light" in notes[0] and "1 x 2 cells, by its dark borders" in notes[0]
    assert "alpha premultiplied, by its light" in notes[0] and len(notes) == 1
    assert axis_faults(torch.stack([frame.lightmaps for frame in read])) == ()
    straight = read_flipbook([*paths], straight=True, notes=notes)
    assert "the light suggests premultiplied alpha" in notes[-1] and len(straight) == 2


def test_the_gain_and_the_padding_are_read(tmp_path: Path):
    """What wlm wrote is read as it was, without options; a given gain replaces the stated one."""
    frames = [SixWay(0.2 * frame.lightmaps, frame.transparency, 0.2 * frame.emission) for frame in _frames(5)]
    for suffix, error in KINDS.items():
        paths, _ = write_book(_book(frames, "embergen", gain=None, padding=2), tmp_path / f"a{suffix}")
        notes: list[str] = []
        read = read_flipbook([*paths], notes=notes)
        assert len(read) == 5 and "layout embergen" in notes[0] and "gain 5.0" in notes[0]
        for one, frame in zip(read, frames, strict=True):
            np.testing.assert_allclose(one.lightmaps, frame.lightmaps, atol=error)
            np.testing.assert_allclose(one.emission, frame.emission, atol=error)
        raw = read_flipbook([*paths], gain=1.0)
        assert float(raw[0].lightmaps.max()) > 4.9 * float(frames[0].lightmaps.max())


LAYERED = {"channels": "{0}", "layers": "C_{0}.R C_{0}.G C_{0}.B", "pair": ""}
LAYERED["short"] = "light{1}.R light{1}.G light{1}.B"


@pytest.mark.parametrize("kind", LAYERED)
def test_layers_of_one_file(tmp_path: Path, kind: str):
    """EXR files with a channel or a layer per light, or with both textures as layers."""
    (frame,) = _frames(1, emission=False)
    planes = {"A": 1.0 - frame.transparency.numpy()}
    if kind == "pair":
        for layer, names in zip(("lightmapA", "lightmapB"), LAYOUTS["unity"], strict=True):
            planes |= {f"{layer}.{letter}": frame[name].numpy() for letter, name in zip("RGB", names, strict=False)}
    short = {"right": "Rgt", "left": "Lft", "top": "Up", "bottom": "Down", "front": "Front", "back": "Behind"}
    for name in DIRECTIONS if kind != "pair" else ():
        planes |= dict.fromkeys(LAYERED[kind].format(name, short[name]).split(), frame[name].numpy())
    path = tmp_path / "smoke_0001.exr"
    write_planes(path, planes)
    notes: list[str] = []
    six, looks = read_shaded(path, notes=notes)
    assert looks is None and "alpha premultiplied, as EXR defines it" in notes[0] and is_six_way(path)
    np.testing.assert_allclose(six.lightmaps, frame.lightmaps, atol=6e-4)
    np.testing.assert_allclose(six.transparency, frame.transparency, atol=6e-4)
    write_planes(path, planes | {"N_left": planes["A"]})
    if kind != "pair":
        assert "expected one layer for left, found " in error_of(read_shaded, path)


def test_names_of_pairs():
    for first, second, layout in (
        ("puff_RLT_8x8", "puff_BBF_8x8", "o3de"),
        ("six_point_1_tlr", "six_point_2_bbf", "embergen"),
        ("smokeP", "smokeN", "unity"),
        ("a_1", "a_2", ""),
    ):
        assert (second.lower(), layout) in [(name.lower(), known) for name, known in second_names(first)]
    assert second_names("wall") == []


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
    with pytest.raises(WlmError, match="expected an alpha channel or a texture of opacity for straight alpha"):
        read_flipbook([*paths], "unity", rows=1, columns=2, straight=True)
    Image.new("L", (8, 8)).save(book[2])
    assert "expected textures of one size" in error_of(read_flipbook, book, "unity", rows=1, columns=2)


def test_wrong_files(tmp_path: Path):
    paths = tmp_path / "a_1.png", tmp_path / "a_2.png"

    def refused(message: str, layout: str = "unity", cells: int = 1) -> None:
        with pytest.raises(WlmError, match=message):
            read_flipbook(paths, layout, rows=cells, columns=cells)

    refused("a_1.png: cannot read the PNG")
    write_book(_book(_frames(1)), tmp_path / "a.png")
    for cells in (4, 12):
        refused(f"{cells} rows and {cells} columns of cells, found a height of 6 and a width of 9", cells=cells)
    Image.new("L", (9, 6)).save(paths[1])
    refused("a_2.png: expected a texture of RGB or RGBA, found one of L")
    # The header alone states the size; the rest of the file is as before.
    whole = paths[0].read_bytes()
    header = b"IHDR" + struct.pack(">2I", 9400, 9400) + whole[24:29]
    paths[0].write_bytes(whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:])
    refused(f"a_1.png: expected at most 2048 times its {len(whole)} compressed bytes")
    for path in paths:
        Image.new("RGB", (9, 6)).save(path)
    refused("layout o3de-tlrb: expected channels for bottom", "o3de-tlrb")
    write_exr(tmp_path / "a.exr", np.full((2, 2, 3), np.nan, np.float32))
    with pytest.raises(WlmError, match="a.exr: expected finite light"):
        read_flipbook([tmp_path / "a.exr"] * 2, "unity", rows=1, columns=1)
    with pytest.raises(WlmError, match="a_1.png: cannot write: expected finite light"):
        write_book(_book([SixWay(torch.full((6, 2, 2), torch.nan), None)]), tmp_path / "a.png")
    assert Image.open(paths[0]).size == (9, 6)


@pytest.mark.parametrize(("height", "width", "levels"), [(24, 40, 3), (16, 16, 1), (50, 30, 2)])
def test_smaller_textures_show_no_neighbours(height: int, width: int, levels: int):
    """Mip levels within a frame do not depend on the neighbouring frames."""
    padding = mip_padding(height, width, levels)
    assert mip_levels(height, width, padding) >= levels
    random = np.random.default_rng(3)
    frame = random.random((height, width, 1), np.float32)

    def shown(neighbours: float, level: int) -> torch.Tensor:
        cells = np.full((9, height, width, 1), neighbours, np.float32)
        cells[4] = frame
        page = torch.from_numpy(lay_out(cells, 3, 3, padding))[None].permute(0, 3, 1, 2)
        # As engines make them, one from the other.
        for _ in range(level):
            page = torch.nn.functional.avg_pool2d(page, 2)
        edges = [(n + padding) / (n + 2 * padding) for n in (height, width)]
        axes = [torch.linspace(1 + 1 - edge, 1 + edge, 60) / 3 for edge in edges]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)[None]
        return torch.nn.functional.grid_sample(page, 2 * grid - 1, align_corners=False, padding_mode="border")

    for level in range(levels + 1):
        assert torch.equal(shown(0.0, level), shown(1000.0, level))
    assert not torch.equal(shown(0.0, levels + 2), shown(1000.0, levels + 2))


def test_what_no_padding_helps():
    with pytest.raises(WlmError, match="mips: 3 levels need .* a multiple of 8 pixels, .* frames of 33 x 32 pixels"):
        mip_padding(32, 33, 3)
    assert mip_levels(33, 32, 16) == 0 and mip_levels(32, 32, 0) == 0
