"""`.npz` files: what is read, and what is refused before it is inflated."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from test_hostile import refused

from wlm.fluid.volume import load_volume
from wlm.formats.npz import read_npz
from wlm.probe import load as load_probes
from wlm.probe import load_positions

READERS = [(load_volume, "density"), (load_probes, "position"), (load_positions, "position")]


def header(shape: object, descr: str = "<f4", columns: bool = False) -> bytes:
    """An array's header as Python writes it, whatever the shape is."""
    text = f"{{'descr': {descr!r}, 'fortran_order': {columns}, 'shape': {shape}, }}"
    return plain_header(text)


def plain_header(text: str) -> bytes:
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def archive(path: Path, members: dict[str, bytes], suffix: str = ".npy") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name + suffix, content)
    return path


def test_arrays_come_as_they_were_written(tmp_path):
    generator = np.random.default_rng(0)
    arrays = {
        "a": generator.random((3, 4, 5)),
        "columns": np.asfortranarray(generator.random((300, 500)).astype(np.float32)),
        "large": generator.integers(0, 9, (3, 700_000), np.int16),
        "big_endian": np.arange(5, dtype=">f4"),
        "none": np.zeros((0, 3)),
        "one": np.float64(2.5),
        "text": np.array("naïve"),
    }
    for write in (np.savez, np.savez_compressed):
        write(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz", lambda names: names, numbers=10**7)
        assert list(found) == list(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == np.asarray(array).dtype
            np.testing.assert_array_equal(found[name], array)
    assert list(read_npz(tmp_path / "a.npz", lambda names: ["one"], numbers=1)) == ["one"]
    assert "b is missing; found a, columns" in refused(read_npz, tmp_path / "a.npz", lambda _: ["b"], numbers=9)


@pytest.mark.parametrize(("read", "name"), READERS)
@pytest.mark.parametrize(
    "content",
    [
        plain_header("((((("),
        plain_header("{'descr': '<f4',\n  'fortran_order': False,\n 'shape': (3, 3)}"),
        plain_header("[" * 9000),
        header((999_999_999_999,)),
        header((-1, 3)),
        header((3, 3)) + bytes(35),
        header((1, 3), "|O") + bytes(24),
        header((2**40,), "|V0"),
        header((3, 3)).replace(b"\x01\x00", b"\x09\x00", 1) + bytes(36),
        b"\x93NUMPY\x02\x00" + (2**32 - 1).to_bytes(4, "little") + b" " * 3_000_000,
        b"",
    ],
)
def test_members_that_are_no_arrays(tmp_path, read, name, content):
    path = archive(tmp_path / "a.npz", {name: content, "sh": header((3, 3)) + bytes(36)})
    assert str(path) in refused(read, path)


@pytest.mark.parametrize(("read", "name"), READERS)
def test_zip_files_that_lie(tmp_path, read, name):
    whole = archive(tmp_path / "a.npz", {name: header((3, 3)) + bytes(36)}).read_bytes()
    (tmp_path / "a.npz").write_bytes(b"")
    refused(read, tmp_path / "a.npz")
    place = whole.index(b"PK\x01\x02")
    for at, value in (
        (place + 8, b"\x01"),  # encrypted
        (place + 10, b"\x63"),  # an unknown compression
        (place + 24, b"\xff\xff\xff\x7f"),  # another size
        (place + 16, b"\0\0\0\0"),  # another checksum
        (place + 42, b"\xff\xff\xff\x7f"),  # another place
    ):
        (tmp_path / "a.npz").write_bytes(whole[:at] + value + whole[at + len(value) :])
        assert "a.npz" in refused(read, tmp_path / "a.npz")
    # The name of a member without .npy.
    refused(read, archive(tmp_path / "b.npz", {name: b"no"}, ""))


def bomb(path: Path, arrays: dict[str, tuple[tuple[int, ...], int]]) -> Path:
    """Writes zeros whose header states `shape`, although the member has fewer bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, (shape, there) in arrays.items():
            with file.open(f"{name}.npy", "w") as member:
                member.write(header(shape))
                for _ in range(there >> 20):
                    member.write(bytes(1 << 20))
    return path


def test_bombs(tmp_path, monkeypatch):
    zeros = bomb(tmp_path / "a.npz", {"density": ((1290, 1290, 1290), 1 << 20)})
    assert "density: expected an array of at most 1073741824 numbers, found the shape" in refused(load_volume, zeros)
    # 70 MB for 70 KB: more than the 64 MB that any array may have.
    content = {"position": ((6_116_694, 3), 70 << 20), "sh": ((6_116_694, 3), 70 << 20)}
    path = tmp_path / "b.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, (shape, size) in content.items():
            begin = header(shape)
            file.writestr(f"{name}.npy", begin + bytes(shape[0] * shape[1] * 4))
            assert size < shape[0] * shape[1] * 4 + (1 << 20)
    assert "b.npz: expected at most 67108864 bytes of arrays" in refused(load_probes, path)
    assert "b.npz: expected at most 67108864 bytes of arrays" in refused(load_positions, path)
    # The limit is for the sum of the arrays that are read, and small types count as float32.
    monkeypatch.setattr("wlm.fluid.volume.SURE_VOXELS", 1 << 17)
    np.savez_compressed(path, density=np.zeros((40, 50, 50), np.uint8), temperature=np.zeros((40, 50, 50), "f2"))
    assert "b.npz: expected at most 524288 bytes of arrays" in refused(load_volume, path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.parametrize(("read", "name"), READERS)
def test_methods_whose_output_zipfile_does_not_bound(tmp_path, method, read, name):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as file:
        for member in (name, "sh"):
            file.writestr(f"{member}.npy", header((3, 3)) + bytes(36))
    assert f"{name}: expected an array that is stored or deflated, found the method {method}" in refused(read, path)


@pytest.mark.parametrize(("read", "name"), READERS)
def test_a_long_list_of_members_is_not_read(tmp_path, read, name):
    path = archive(tmp_path / "a.npz", {f"{name}{i:060}": b"" for i in range(10_000)})
    assert "expected a list of members of at most 1048576 bytes" in refused(read, path)


def test_a_convention_of_no_characters(tmp_path):
    members = {"position": header((1, 3)) + bytes(12), "sh": header((1, 3)) + b"\0\0\x80\x3f" * 3}
    for descr, content in (("<U1", b"\xff\xff\xff\x7f"), ("<f4", bytes(4)), ("|S1", b"a")):
        path = archive(tmp_path / "a.npz", members | {"convention": header((), descr) + content})
        assert "a.npz" in refused(load_probes, path)


def test_empty_smoke_is_no_bomb(tmp_path):
    """A simulation's first frames: 64 MB of zeros in 64 KB."""
    np.savez_compressed(tmp_path / "a.npz", density=np.zeros((256, 256, 257), np.float32))
    assert load_volume(tmp_path / "a.npz").shape == (256, 256, 257)
