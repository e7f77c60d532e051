"""Files made to do harm are refused in one line, within two seconds of the processor and a gigabyte."""

import pytest

from .campaign import Worker
from .hostile import HOSTILE
from .limits import Limits


@pytest.fixture(scope="module")
def worker():
    with Worker(Limits(seconds=2.0, wait=30.0, memory=1 << 30)) as worker:
        yield worker


@pytest.mark.parametrize(
    ("name", "reader"), [(name, reader) for name, (readers, _) in HOSTILE.items() for reader in readers]
)
def test_a_hostile_file_is_refused_in_one_line(worker, tmp_path, name, reader):
    path = tmp_path / "inside" / name
    path.parent.mkdir(parents=True)
    HOSTILE[name][1](path)
    outcome = worker.read(reader, path)
    assert outcome.kind == "refused", f"{outcome.kind}: {outcome.detail}"
