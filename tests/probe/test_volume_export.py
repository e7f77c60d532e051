"""The export of a volume: the buffers have the blocks of its windows."""

import numpy as np
import pytest
from builders.exported import read_export

from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.volume.bundle import volume_bundle
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight


@pytest.fixture(scope="module")
def volume() -> Volume:
    """Half done, so that there are holes, far from the origin, on both sides of a block's number 0."""
    random = np.random.default_rng(0)
    position = random.uniform(-1, 1, (400, 3)) * [9.0, 1.0, 9.0] + [4000.0, -30.0, 0.0]
    made = Volume(position, StoredLight(random.normal(size=(400, 27))), side=8, budget=40)
    for _ in range(6):
        made.update([4000.3, -29.0, 0.2])
    return made


def test_export_of_nothing_and_over_another(volume, tmp_path):
    nothing = Volume(volume.position, volume.light, side=8)
    with pytest.raises(ValueError, match="viewpoint"):
        _ = nothing.viewpoint
    with pytest.raises(WlmError, match="no block"):
        export(volume_bundle(nothing), tmp_path / "none")
    assert not (tmp_path / "none").exists()
    paths = export(volume_bundle(volume), tmp_path / "out")
    assert [path.exists() for path in paths] == [True] * 8 and export(volume_bundle(volume), tmp_path / "out") == paths
    document, arrays = read_export(tmp_path / "out")
    pages, pool = arrays["pages"].reshape(4, 8, 8, 8), arrays["pool"].reshape(-1, 27)
    values, valid = volume.unscroll()
    for level, described in enumerate(document["levels"]):
        place = np.argwhere(valid[level])
        block = place + np.array(described["base"]) - np.array(described["start"], int)
        np.testing.assert_array_equal(pool[pages[level][tuple((block % 8).T)]], values[level][tuple(place.T)])
    assert (pages >= 0).sum() == valid.sum() == len(pool)
    (tmp_path / "out" / "bundle.json").write_text("{}")
    with pytest.raises(WlmError):
        export(volume_bundle(volume), tmp_path / "out")
