"""The scene of `demos/data/street` is complete and small, and its parts fit together."""

from pathlib import Path

import numpy as np
import pytest

import wlm
from wlm.formats.light import read_light

FOLDER = Path(__file__).resolve().parents[2] / "demos" / "data" / "street"
MOST_BYTES = 6_000_000


@pytest.fixture(scope="module")
def street():
    with wlm.scene.load(FOLDER / "street.yaml") as scene:
        yield scene


def test_no_file_is_missing_or_left_over(street):
    files = {file for file in FOLDER.rglob("*") if file.is_file()}
    used = {street.path, *street.originals.values(), FOLDER / "README.md"}
    used |= {FOLDER / name for name in ("street.wlm", "probes.wlm", "street.glb", "car.glb", "van.glb")}
    used |= {file for puff in street.smoke for file in puff.files}
    assert files == used
    assert len(street.probe_hours) == 10
    assert sum(file.stat().st_size for file in files) <= MOST_BYTES


@pytest.mark.parametrize("hour", [12.0, 22.0])
def test_the_sum_of_the_groups_is_the_original(street, hour):
    assert street.light.groups == ("sky", "sun")
    mask = street.light.light.mask
    original = read_light(street.originals[hour])[0][mask]
    error = street.light.decoder().frame(hour)[mask] - original
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.ptp(original)


def test_vehicles_stay_on_the_road(street):
    """Roads are the lines x = 0, x = 3, z = 0 and z = 3, 0.66 m wide; a vehicle is at most 0.21 m wide."""
    for moving in street.moving:
        assert moving.mesh.position[:, 1].min() == pytest.approx(0.0, abs=1e-3)
        assert np.ptp(moving.mesh.position[:, 0]) < 0.21
        for second in np.linspace(0.0, moving.seconds, 50):
            x, y, z = moving.pose(second)[:3, 3]
            assert y == 0.0
            assert min(abs(each - road) for each in (x, z) for road in (0.0, 3.0)) <= 0.33 - 0.105
