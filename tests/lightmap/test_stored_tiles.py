"""Tiles that are read from a file when they are needed: alone, together, by threads, and from files that change."""

import hashlib
import json
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from builders.checks import assert_same, error_of
from builders.layered_sets import random_layers
from builders.resigned import index_bytes
from builders.synthetic import random_model

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.lightmap.loading import TileLoader
from wlm.lightmap.model import PACKED
from wlm.lightmap.sheet import LIGHT

KINDS = (3, 3, 1, 0, 4, 3)
PACKED_TILES = [0, 1, 4, 5]


@pytest.fixture
def path(tmp_path) -> Path:
    """A file of six tiles of all kinds."""
    random_model(KINDS).save(tmp_path / "a.wlm")
    return tmp_path / "a.wlm"


@pytest.fixture
def reads(monkeypatch) -> list[int]:
    """The sizes of all reads beyond the index, as they happen."""
    sizes, pread = [], os.pread

    def counted(handle, size, place):
        sizes.append(size)
        return pread(handle, size, place)

    monkeypatch.setattr(os, "pread", counted)
    return sizes


def flip(path: Path, place: int) -> None:
    """Flips a bit of a file in place."""
    with open(path, "r+b") as file:
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 1]))


def start_of(path: Path, piece: int) -> int:
    """The first byte of a piece of the tiles by the documented rule."""
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    begin, end = header["0.tiles.pieces"]["data_offsets"]
    sizes = np.frombuffer(content[start + begin : start + end], "<u4").reshape(-1, 5)[:, 0]
    return start + header["0.tiles"]["data_offsets"][0] + int(sizes[:piece].sum())


def test_opening_reads_the_index_alone(path, reads):
    model = wlm.load(path)
    assert model.light.kind.tolist() == list(KINDS) and not reads and model.memory_bytes
    assert not {"mask", *PACKED} & set(vars(model.light))
    assert model.memory_bytes == random_model(KINDS).memory_bytes
    assert model.light.only([2, 3]).constant.shape == (1, 4, 3) and not reads, "a constant tile is in the index"


@pytest.mark.parametrize("chosen", [[0], [1], [4], [5, 0], [2], [3], [], list(range(6))])
def test_some_tiles_decode_to_what_all_do(path, reads, chosen):
    whole, model = random_model(KINDS), wlm.load(path)
    decoder = model.decoder(tiles=chosen)
    sizes = read_artifact(path).pieces["0.tiles"].sizes
    assert sorted(reads) == sorted(sizes[[PACKED_TILES.index(n) for n in chosen if n in PACKED_TILES]].tolist())
    for time in (0.0, 10.0):
        got = decoder.light.tiles(chosen, time)
        np.testing.assert_array_equal(got, whole.decoder().light.tiles(chosen, time))
    for left_out in set(PACKED_TILES) - set(chosen):
        line = error_of(decoder.light.tiles, [left_out], 0.0)
        assert f"tile {left_out}: expected one of the decoder's tiles" in line
    assert_same(model.light.only(chosen), whole.light.only(chosen))
    assert_same(model, whole)


def test_tiles_are_chosen_by_sheet(tmp_path, reads):
    random_layers().save(tmp_path / "a.wlm")
    model = wlm.load(tmp_path / "a.wlm")
    sheet = next(iter(model.sheets))
    decoder = model.decoder(tiles={sheet: np.flatnonzero(model.sheets[sheet].kind)})
    assert decoder.sheets[sheet].frame(0.0).any()
    assert list(decoder.sheets) == [sheet] and decoder.light is decoder.sheets[sheet]
    other = next(other for other in model.sheets if (other.atlas, other.layer) != (sheet.atlas, sheet.layer))
    assert "expected one of the decoder's sheets" in error_of(decoder.frame, 0.0, other.layer, other.atlas)
    assert "expected the tiles by sheet" in error_of(model.decoder, tiles=[0])
    assert "expected a sheet of the model" in error_of(model.decoder, tiles={LIGHT: [0]})
    assert "tiles: expected 0 to " in error_of(model.decoder, tiles={sheet: [99]})


def test_a_file_is_copied_without_unpacking(path, tmp_path):
    model = wlm.load(path)
    assert model.save(tmp_path / "b.wlm") == model.file_bytes() == path.stat().st_size
    assert (tmp_path / "b.wlm").read_bytes() == path.read_bytes() and "uv" not in vars(model.light)
    assert model.light.uv.any() and model.light.pieces is None
    model.light.uvt = np.zeros_like(model.light.uvt)
    assert "BC7 blocks of mode 6" in error_of(model.save, tmp_path / "b.wlm"), "what is changed is packed anew"


@pytest.mark.parametrize("piece", range(4))
def test_a_flipped_byte_is_an_error_of_its_tile(path, tmp_path, piece):
    number = PACKED_TILES[piece]
    flip(path, start_of(path, piece))
    model = wlm.load(path)
    message = f"{path}: sheet random: tile {number}: the file is damaged here: the bytes do not match their digest"
    assert error_of(model.decoder, tiles=[number]) == message
    assert error_of(model.check) == error_of(model.decoder) == error_of(lambda: model.light.uv) == message
    assert model.decoder(tiles=[n for n in range(6) if n != number]).light.frame(0.0).any()
    assert message in error_of(model.save, tmp_path / "b.wlm") and not (tmp_path / "b.wlm").exists()


def signed(path: Path, change) -> None:
    """Changes header and body of a file and gives it a right digest."""
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    header, body = json.loads(content[8:start]), bytearray(content[start:])
    change(header, body)
    words = header["__metadata__"]["wlm"].split(" ")

    def joined(digest):
        header["__metadata__"]["wlm"] = " ".join([*words[:3], digest])
        text = json.dumps(header, separators=(",", ":")).encode()
        return len(text).to_bytes(8, "little") + text + body

    whole = joined("0" * 32)
    path.write_bytes(joined(hashlib.blake2b(whole[: index_bytes(whole)], digest_size=16).hexdigest()))


def resized(*sizes: int):
    """A change of the first sizes in the index of pieces."""

    def change(header, body):
        begin, end = header["0.tiles.pieces"]["data_offsets"]
        index = np.frombuffer(bytes(body[begin:end]), "<u4").reshape(-1, 5).copy()
        index[: len(sizes), 0] = index[: len(sizes), 0] + np.array(sizes, np.int64).astype(np.uint32)
        body[begin:end] = index.tobytes()

    return change


def moved(header, body):
    """The tiles before the other parts."""
    end = header["0.tiles"]["data_offsets"][1]
    size = end - header["0.tiles"]["data_offsets"][0]
    for name, entry in header.items():
        if name not in ("__metadata__", "0.tiles"):
            entry["data_offsets"] = [at + size for at in entry["data_offsets"]]
    header["0.tiles"]["data_offsets"] = [0, size]
    body[:] = body[-size:] + body[:-size]


def entry(name: str, **values):
    """A change of a part's entry in the header."""
    return lambda header, body: header[name].update(values)


def renamed(old: str, new: str):
    """A change of a part's name."""
    return lambda header, body: header.update({new: header.pop(old)})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (resized(1), "part 0.tiles: expected pieces of "),
        (resized(2**32 - 1), "part 0.tiles: expected pieces of "),
        (resized(1, -1), None),
        (moved, "part 0.tiles: expected its pieces behind all parts that are not split"),
        (entry("0.tiles.pieces", shape=[20]), "expected bytes, and sizes and digests of its pieces"),
        (renamed("0.tiles", "0.more"), "part 0.tiles.pieces: expected a part in pieces, found none"),
        (renamed("0.tiles.pieces", "0.tiles.pieces.pieces"), "part 0.tiles.pieces.pieces: expected a part in pieces"),
        (renamed("0.tiles.pieces", "0.more"), "sheet 0: expected the tiles alone as a split part, found others"),
    ],
)
def test_pieces_that_overlap_or_exceed_their_part_are_refused(path, change, words):
    signed(path, change)
    if words is None:  # sizes that add up, whose bytes are not those of the digest
        line = error_of(wlm.load(path).check)
        assert line == f"{path}: sheet random: tile 0: the file is damaged here: the bytes do not match their digest"
    else:
        assert words in error_of(wlm.load, path)


def test_a_file_that_is_replaced_while_it_is_open_stays_readable(path):
    model, before = wlm.load(path), random_model(KINDS)
    random_model(KINDS, seed=1).save(path)
    assert_same(model, before)
    assert not np.array_equal(wlm.load(path).light.uv, before.light.uv)


def test_a_file_that_is_cut_or_written_over_while_it_is_open_is_one_line(path):
    model, content = wlm.load(path), path.read_bytes()
    with open(path, "r+b") as file:
        file.truncate(start_of(path, 2) + 5)
    assert model.decoder(tiles=[0, 1]).light.frame(0.0).any()
    line = error_of(model.decoder, tiles=[4])
    assert line.startswith(f"{path}: sheet random: tile 4: the file was cut short: expected ") and line.endswith(" 5")
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 8]))
    assert "tile 5: the file is damaged here" in error_of(model.check)


def test_a_closed_model_is_one_line(path):
    with wlm.load(path) as model:
        held = model.light.only([0])
    assert error_of(model.decoder, tiles=[0]) == f"{path}: sheet random: tile 0: the file was closed"
    assert held.uv.any() and held.mask.all() and model.light.scale.size
    model.close()
    with wlm.load(path) as other:
        assert other.light.uv.any()
    assert other.decoder().frame(0.0).any(), "what was read stays"


def test_a_file_is_closed_with_its_last_reference(path):
    def opened():
        return [link for link in Path("/proc/self/fd").iterdir() if link.exists() and link.samefile(path)]

    if not Path("/proc/self/fd").exists():
        pytest.skip("the system does not list open files")
    model = wlm.load(path)
    light = model.light
    assert len(opened()) == 1
    del model
    assert light.only([0]).uv.any() and len(opened()) == 1
    del light
    assert not opened()


def test_threads_read_at_once(path):
    model, whole, errors = wlm.load(path), random_model(KINDS), []

    def work(number):
        try:
            for _ in range(20):
                assert_same(model.light.only([number]), whole.light.only([number]))
                assert model.light.mask.all()
        except (AssertionError, WlmError) as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in (*range(6), 0, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors


def test_a_close_during_reads_is_an_error_and_no_other_file(path, tmp_path):
    """A closed number is given to the next file that is opened, which a reader must never see."""
    (tmp_path / "other").write_bytes(bytes(1 << 20))
    for _ in range(20):
        model, lines = wlm.load(path), []

        def work(model=model, lines=lines):
            try:
                while True:
                    model.light.only([0])
            except WlmError as error:
                lines.append(str(error))

        threads = [threading.Thread(target=work) for _ in range(2)]
        for thread in threads:
            thread.start()
        model.close()
        with open(tmp_path / "other", "rb"), open(tmp_path / "other", "rb"):
            for thread in threads:
                thread.join()
        assert [line.endswith("tile 0: the file was closed") for line in lines] == [True, True], lines


# ---- the loader ----


def test_the_loader_gives_the_tiles_that_were_asked_for(path):
    whole = random_model(KINDS)
    with wlm.load(path) as model, TileLoader(model) as loader:
        assert all(loader.request(LIGHT, number) for number in range(6))
        got = []
        while len(got) < 6:
            assert loader.wait(30.0)
            got += loader.take(2)
    assert [each.number for each in got] == list(range(6))
    for each in got:
        assert each.sheet == LIGHT and each.error is None
        assert_same(each.tile, whole.light.only([each.number]))


def test_a_damaged_tile_does_not_stop_the_loader(path):
    flip(path, start_of(path, 1))
    with wlm.load(path) as model, TileLoader(model) as loader:
        for number in (0, 1, 5):
            loader.request(LIGHT, number)
        got = []
        while len(got) < 3 and loader.wait(30.0):
            got += loader.take()
    assert [each.tile is None for each in got] == [False, True, False]
    said = "sheet random: tile 1: the file is damaged here: the bytes do not match their digest"
    assert str(got[1].error) == f"{path}: {said}"


class Held:
    """A model whose tiles are read only once `go` is set, in place of `SheetModel.only`."""

    def __init__(self, monkeypatch, model) -> None:
        self.go, self.begun, self.order = threading.Event(), threading.Semaphore(0), []
        only = type(model.light).only

        def waiting(sheet, numbers):
            self.order.append(numbers[0])
            self.begun.release()
            self.go.wait(30.0)
            return only(sheet, numbers)

        monkeypatch.setattr(type(model.light), "only", waiting)


def test_requests_are_bounded_ordered_and_can_be_cancelled(path, monkeypatch):
    model = wlm.load(path)
    held = Held(monkeypatch, model)
    with TileLoader(model, most=3) as loader:
        loader.request(LIGHT, 0)
        assert held.begun.acquire(timeout=30.0)
        assert loader.request(LIGHT, 0), "it is being read"
        assert [loader.request(LIGHT, number, priority) for number, priority in ((1, 1.0), (2, 3.0), (3, 2.0))]
        assert not loader.request(LIGHT, 4, 1.0), "three wait that are as important"
        assert loader.request(LIGHT, 4, 1.5), "which takes the place of tile 1"
        assert loader.request(LIGHT, 3, 9.0), "a new priority"
        assert loader.cancel(LIGHT, 2) == 1 and loader.cancel(LIGHT, 2) == 0
        assert loader.request(LIGHT, 5, 0.5)
        held.go.set()
        got = []
        while len(got) < 4 and loader.wait(30.0):
            got += loader.take()
        assert [each.number for each in got] == held.order == [0, 3, 4, 5]
        assert not loader.wait(0.0) and loader.take() == []
        while held.begun.acquire(blocking=False):
            continue
        held.go.clear()
        loader.request(LIGHT, 0)
        assert held.begun.acquire(timeout=30.0)
        loader.request(LIGHT, 1)
        assert loader.cancel() == 1
        held.go.set()


def test_results_that_nobody_takes_pause_the_loader(path):
    with wlm.load(path) as model, TileLoader(model, most=2) as loader:
        for number in (0, 1):
            loader.request(LIGHT, number)
        while len(loader._results) < 2:
            assert loader.wait(30.0)
        for number in (4, 5):
            loader.request(LIGHT, number)
        threading.Event().wait(0.05)
        assert len(loader._results) == 2 and len(loader._waiting) == 2
        got = []
        while len(got) < 4 and loader.wait(30.0):
            got += loader.take(1)
        assert sorted(each.number for each in got) == [0, 1, 4, 5]


def test_a_loader_that_is_closed_ends_and_says_so(path, monkeypatch):
    model = wlm.load(path)
    held = Held(monkeypatch, model)
    loader = TileLoader(model)
    loader.request(LIGHT, 0)
    assert held.begun.acquire(timeout=30.0)
    loader.request(LIGHT, 1)
    threading.Timer(0.05, held.go.set).start()
    loader.close()
    loader.close()
    assert not loader._thread.is_alive() and held.order == [0] and loader.take() == []
    assert "expected an open loader" in error_of(loader.request, LIGHT, 0)
    with TileLoader(model) as other:
        assert "expected a tile of one of its sheets, got tile 6" in error_of(other.request, LIGHT, 6)
    assert "most: expected at least 1, got 0" in error_of(TileLoader, model, 0)
