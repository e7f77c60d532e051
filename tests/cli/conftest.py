"""A volume of smoke that the tests of several commands read."""

import pytest
from builders.smoke_plumes import plume

from wlm.fluid.volume import save_volume


@pytest.fixture(scope="session")
def volume(tmp_path_factory):
    path = tmp_path_factory.mktemp("volume") / "plume.npz"
    save_volume(path, plume(hot=True))
    return path
