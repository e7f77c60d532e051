"""Arrays that lie in a file without a name."""

import resource
import tempfile

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.formats import scratch


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The folder for temporary files, and a bound above which arrays lie there."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(scratch, "IN_MEMORY", 1000)
    return tmp_path


def test_a_large_array_is_in_a_file_and_a_small_one_in_memory(folder):
    small, large = (scratch.room((n, 5), np.float32, "test") for n in (50, 51))
    assert small.base is None and large.base is not None
    for array in (small, large):
        assert type(array) is np.ndarray and not array.any()
        array[3] = 7.0
        assert array.sum() == 35.0 and array[2:4].max() == 7.0
    assert list(folder.iterdir()) == [], "the file has no name"


@pytest.mark.parametrize("portable", [False, True])
def test_a_full_disk_is_one_line(folder, portable, monkeypatch):
    if portable:
        monkeypatch.delattr("os.posix_fallocate")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(WlmError, match=r"^set.json: needs 8,000 bytes in .+ \(TMPDIR\): File too large$") as error:
            scratch.room((2000,), np.float32, "set.json")
        assert str(folder) in str(error.value)
        assert len(scratch.room((1000,), np.float32, "set.json")) == 1000
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
