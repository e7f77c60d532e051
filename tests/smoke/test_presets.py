"""The shipped scenes, simulated and drawn small on the CPU."""

import numpy as np
import pytest
import torch

from wlm.config import profile_names
from wlm.smoke.scene import load_scene, make_camera
from wlm.smoke.simulation import advance, make_solver, volume_of, warnings_of
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import orders_march
from wlm.view.smoke import Drawing

PRESETS = [name for name in profile_names("smoke") if not name.startswith("network")]


def test_presets_do_what_they_say():
    for name in PRESETS:
        assert warnings_of(load_scene(name)) == []
    assert {"candle", "chimney", "explosion", "fan", "rabbit"} <= set(PRESETS)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_small(name: str):
    """Twelve cells or more along each axis: finite air, smoke that is seen, and obstacles where it is not."""
    scene = load_scene(name)
    scene = scene.scaled(12 / min(scene.grid.cells))
    solver, pictures = make_solver(scene), []
    view = scene.camera.model_copy(update={"resolution": 48})
    camera, lights = make_camera(view, scene.grid.origin, scene.grid.size), [light.light() for light in scene.lights]
    for frame in range(13):
        if frame:
            advance(scene, solver, frame)
        if frame in (0, 12):
            volume, looks = volume_of(scene, solver), scene.looks(frame)
            how = {"background": looks.background, "ramp": looks.ramp, "obstacles": looks.obstacles}
            drawing = Drawing(camera, lights, **how)
            drawing.move(looks.time)
            lit = light_smoke(drawing.among(volume), camera, lights, orders_march(volume, 0.0))
            pictures.append(drawing(lit))
    before, after = pictures
    assert torch.isfinite(after).all() and np.isfinite(solver.velocity.numpy()).all()
    assert ((after - before).abs().amax(-1) > 0.02).float().mean() > 0.001
    background = torch.tensor(scene.background)
    assert ((before - background).abs().amax(-1) > 0.02).any() == bool(scene.obstacles)
