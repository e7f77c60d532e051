"""Six-way lightmaps by a coarse march: against the fine march, the guiding map, and what is known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from smoke_plumes import plume

from wlm.smoke.axes import Camera
from wlm.smoke.coarse import coarse_six_way
from wlm.smoke.guide import guide
from wlm.smoke.reference import six_way
from wlm.smoke.volume import DensityVolume, from_array


def _camera(volume: DensityVolume, size: int = 24) -> Camera:
    toward = np.array([0.5, 0.3, 1.0])
    reach = 3.0 * max(volume.shape) * volume.voxel
    return Camera.look_at(volume.centre + reach * toward, volume.centre, extent=0.4 * reach, height=size, width=size)


def test_small_steps_give_the_fine_march(device: str):
    """All planes, of hot smoke with a phase function that isn't even."""
    volume = plume(hot=True, device=device)
    camera = _camera(volume)
    exact = six_way(volume, camera, step=0.25, g=0.4, estimate=False)
    errors = []
    for step in (1.0, 0.5):
        found = coarse_six_way(volume, camera, step=step, jitter=0.0, g=0.4).six
        pairs = [(found.lightmaps, exact.lightmaps), (found.transparency, exact.transparency)]
        pairs += [(found.emission, exact.emission)]
        errors.append(max(float((a - b).abs().max() / b.abs().max()) for a, b in pairs))
    assert errors[1] < 0.02
    assert errors[1] < 0.7 * errors[0]


def test_sums_are_the_guiding_map(device: str):
    """Front, top and bottom together are the guide's light, sample by sample, and the depth is its depth."""
    volume = plume(device=device)
    camera = _camera(volume)
    settings = {"step": 2.5, "jitter": 1.0, "seed": 7, "threshold": 0.05, "g": -0.2}
    found, known = coarse_six_way(volume, camera, **settings), guide(volume, camera, **settings)
    light = found.six["front"] + found.six["top"] + found.six["bottom"]
    torch.testing.assert_close(light, known.light, rtol=0, atol=3e-4)
    torch.testing.assert_close(found.six.transparency, known.transparency, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.depth, known.depth, rtol=0, atol=1e-5)


def test_front_and_back_follow_from_the_transparency(device: str):
    """(1 - T^2) / 2 and -T ln T, which the fine march finds too."""
    volume = plume(device=device)
    exact = six_way(volume, _camera(volume), step=0.25, estimate=False)
    t = exact.transparency.double()
    torch.testing.assert_close(exact["front"].double(), 0.5 * (1 - t * t), rtol=0, atol=2e-4)
    back = torch.where(t > 0, -t * t.clamp(min=1e-30).log(), 0.0)
    torch.testing.assert_close(exact["back"].double(), back, rtol=0, atol=2e-4)
    found = coarse_six_way(volume, _camera(volume), step=4.0).six
    t = found.transparency.double()
    torch.testing.assert_close(found["front"].double(), 0.5 * (1 - t * t), rtol=0, atol=1e-6)


@pytest.mark.parametrize("extinction", [0.0, 1e4])
def test_none_and_opaque(device: str, extinction: float):
    """No smoke is black and clear, smoke like stone is finite."""
    volume = replace(plume(device=device), extinction=extinction)
    planes = coarse_six_way(volume, _camera(volume), step=3.0).planes
    assert torch.isfinite(planes).all()
    if not extinction:
        assert float(planes[:6].abs().max()) == 0.0 and bool((planes[6] == 1.0).all())
        assert float(planes[8].max()) == 0.0
    else:
        assert float(planes[6].min()) < 1e-4 and float(planes[4].max()) == pytest.approx(0.5, abs=1e-3)


def test_one_voxel(device: str):
    """A grid of one voxel, seen by one pixel."""
    volume = from_array(np.ones((1, 1, 1), np.float32), extinction=1.0, device=device)
    camera = Camera.look_at((0.5, 0.5, 5.0), (0.5, 0.5, 0.5), extent=1.0, height=1, width=1)
    planes = coarse_six_way(volume, camera, step=0.1, jitter=0.0).planes.flatten()
    # Trilinear falls off to 0 half a voxel beyond: one voxel's worth in all.
    assert float(planes[6]) == pytest.approx(np.exp(-1.0), rel=0.02)


def test_wrong_settings(device: str):
    volume = from_array(np.ones((4, 4, 4), np.float32), device=device)
    camera = _camera(volume, 4)
    for settings in ({"step": 0.0}, {"step": float("nan")}, {"jitter": 1.5}, {"g": 1.0}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            coarse_six_way(volume, camera, **settings)
    eye = Camera.look_at((2.0, 2.0, 30.0), (2.0, 2.0, 2.0), extent=0.4, height=4, width=4, perspective=True)
    with pytest.raises(ValueError, match="orthographic"):
        coarse_six_way(volume, eye)
