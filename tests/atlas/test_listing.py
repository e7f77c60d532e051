"""Lists of a scene's lightmaps that nobody wrote: a folder of pictures, beside their mesh or not."""

import json

import numpy as np
import pytest
from builders.rooms import write_room

from wlm.atlas.listing import read_listing
from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.inspection import inspect


def picture(path, size):
    values = np.random.default_rng(size).random((size, size, 3)).astype(np.float32)
    values[:, size // 2 :] = 0
    write_exr(path, values)


def test_each_picture_of_a_folder_is_a_sheet(tmp_path):
    with pytest.raises(WlmError, match=f"{tmp_path}: expected lightmaps"):
        read_listing(tmp_path)
    for name, size in (("wall.exr", 16), ("box.exr", 32)):
        picture(tmp_path / name, size)
    (tmp_path / "notes.txt").write_text("none")
    scene = read_listing(tmp_path)
    assert [scene.file(each.files[0], False).name for each in scene.sheets] == ["box.exr", "wall.exr"]
    assert all(scene.file(each.files[0], False).is_file() for each in scene.sheets) and scene.objects is None
    write_room(tmp_path / "room.glb")
    (found,) = inspect(tmp_path)
    assert found.command == f"wlm compress {tmp_path / 'room.glb'} {tmp_path} -o OUT.wlm"


def test_the_list_in_a_folder_is_read(tmp_path):
    picture(tmp_path / "noon.exr", 16)
    entries = [{"time_hours": 12, "file": "noon.exr"}]
    (tmp_path / "set.json").write_text(json.dumps({"width": 16, "height": 16, "lightmaps": entries}))
    assert read_listing(tmp_path).states == ("12 h",)
