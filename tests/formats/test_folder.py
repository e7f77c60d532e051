"""Folders claimed, staged beside their place and moved in whole; and the JSON of their index."""

import json
import os

import numpy as np
import pytest
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats.folder import UNFINISHED, claim, compact_json, read_index, rounded, staged, write_index

INDEX, FORMAT = "index.json", "wlm-test"


def write(folder, *names: str) -> None:
    """Writes an output of these files, which hold their names."""
    with staged(folder, INDEX, FORMAT) as temporary:
        for name in names:
            (temporary / name).write_text(name)
        write_index(temporary / INDEX, {"format": FORMAT, "files": names})


@pytest.mark.parametrize("old", [False, True])
def test_a_stop_while_files_are_moved_loses_nothing(old, tmp_path, monkeypatch):
    """Wherever it stops, the index says so, and writing again makes the folder whole; other files stay."""
    folder, move = tmp_path / "out", os.replace
    for steps in range(4):  # the marker, a, b and the index
        if old:
            write(folder, "a", "c")
            (folder / "mine.txt").write_text("x")
        moves = iter(range(4))

        def stopped(source, target, steps=steps, moves=moves):
            if os.path.dirname(target) == str(folder) and next(moves) == steps:
                raise KeyboardInterrupt
            move(source, target)

        monkeypatch.setattr(os, "replace", stopped)
        with pytest.raises(KeyboardInterrupt):
            write(folder, "a", "b")
        monkeypatch.setattr(os, "replace", move)
        assert os.listdir(tmp_path) == ["out"]
        index = read_index(folder / INDEX)
        assert (UNFINISHED in index) == (steps > 0)
        assert steps or index.get("files") == (["a", "c"] if old else None), "nothing was moved yet"
        write(folder, "a", "b")
        assert set(os.listdir(folder)) == {INDEX, "a", "b"} | ({"mine.txt"} if old else set())
        assert read_index(folder / INDEX)["files"] == ["a", "b"]
        for path in folder.iterdir():
            path.unlink()


def test_nothing_half_written_is_left(tmp_path):
    """A full disk, named by the real folder, and Ctrl-C leave what was there."""
    write(tmp_path / "old", "a")
    before = {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()}
    errors = (
        (lambda path: WlmError(f"{path}: cannot write: No space left on device"), "cannot write: No space left"),
        (lambda path: OSError(28, "No space left on device"), "cannot write there: No space left"),
        (lambda path: KeyboardInterrupt(), ""),
    )
    for name in ("old", "new"):
        for error, words in errors:
            with pytest.raises((WlmError, KeyboardInterrupt)) as caught:  # noqa: SIM117
                with staged(tmp_path / name, INDEX, FORMAT) as temporary:
                    (temporary / "b").write_text("b")
                    raise error(temporary / "b")
            assert words in str(caught.value) and ".tmp" not in str(caught.value)
            assert not words or str(tmp_path / name) in str(caught.value)
    assert os.listdir(tmp_path) == ["old"]
    assert {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()} == before


def test_files_in_subfolders_are_replaced(tmp_path):
    """Files that the old index lists go; other files, and files elsewhere, stay."""
    folder = tmp_path / "out"

    def put(*names):
        with staged(folder, INDEX, FORMAT) as made:
            for name in names:
                (made / name).parent.mkdir(exist_ok=True)
                (made / name).write_text(name)
            write_index(made / INDEX, {"format": FORMAT})

    put("a", "sheet/b", "sheet/c")
    assert read_index(folder / INDEX)["files"] == ["a", "sheet/b", "sheet/c"]
    (folder / "mine.txt").write_text("x")
    put("sheet/c", "d")
    left = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert left == {INDEX, "d", "sheet/c", "mine.txt"}
    put("d")
    assert not (folder / "sheet").exists()
    (tmp_path / "victim").write_text("x")
    (folder / "link").symlink_to(tmp_path)
    hostile = ["../victim", "link/victim", str(tmp_path / "victim"), "mine.txt/../mine.txt", 3, None, "d"]
    write_index(folder / INDEX, {"format": FORMAT, "files": hostile})
    put("a")
    assert (tmp_path / "victim").exists() and (folder / "mine.txt").exists() and not (folder / "d").exists()


def test_folders_of_others_are_refused(tmp_path):
    folder = tmp_path / "full"
    folder.mkdir()
    claim(folder, INDEX, FORMAT)
    (folder / "a.txt").write_text("x")
    for content in (None, "[]", "{", '{"format": "wlm-other"}'):
        if content is not None:
            (folder / INDEX).write_text(content)
        with pytest.raises(WlmError, match="full: expected an empty folder or an earlier output, found other"):
            claim(folder, INDEX, FORMAT)
    assert "a.txt: cannot write there: Not a directory" in error_of(claim, folder / "a.txt", INDEX, FORMAT)
    with pytest.raises(WlmError, match="out: cannot write: the folder .*none does not exist"):
        claim(tmp_path / "none" / "out", INDEX, FORMAT)
    (folder / INDEX).write_text(json.dumps({"format": FORMAT}))
    claim(folder, INDEX, FORMAT)
    claim(tmp_path / "new", INDEX, FORMAT)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(WlmError, match="out: cannot write: the folder .* is read-only"):
        claim(tmp_path / "out", INDEX, FORMAT)
    tmp_path.chmod(0o700)


def test_the_index_has_a_list_of_numbers_on_a_line(tmp_path):
    values = np.array([[0.1, 1 / 3], [1e-8, 3e8]], np.float32)
    content = {"name": "[1,\n2]", "rows": rounded(values), "none": [], "texts": ["a", "b"]}
    text = compact_json(content)
    assert json.loads(text) == content and "[0.100000001, 0.333333343]" in text and '"[1,\\n2]"' in text
    np.testing.assert_array_equal(np.array(content["rows"], np.float32), values)
    assert write_index(tmp_path / INDEX, content) == len(text) and read_index(tmp_path / INDEX) == content
    assert read_index(tmp_path / "none.json") == {}
