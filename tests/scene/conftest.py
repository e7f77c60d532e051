"""A scene that the tests of this folder read."""

import pytest
from builders import day_scenes

import wlm


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """Path of the scene's file."""
    return day_scenes.write_scene(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def scene(room):
    with wlm.scene.load(room) as scene:
        yield scene


@pytest.fixture
def changed(room):
    """Writes the scene's file with other keys beside it; None removes a key."""

    def write(**keys):
        return day_scenes.write_file(room.with_name("changed.yaml"), **keys)

    return write
