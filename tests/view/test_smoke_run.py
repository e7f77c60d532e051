"""Lighting in a CUDA graph: each frame equals the picture without a graph."""

import pytest
import torch
from builders.smoke_plumes import SPHERE, plume

from wlm.smoke.march.launch import VolumeGraph
from wlm.smoke.scene import CameraSettings, LightSettings, ObstacleSettings, make_camera
from wlm.smoke.shading import Ramp
from wlm.smoke.transport.orders import scatter
from wlm.view.smoke import Drawing
from wlm.view.smoke_run import Lighting


@pytest.mark.parametrize("lighting", [Lighting(None), Lighting((0.95, 0.9, 0.8))])
def test_a_graph_draws_each_frame(device, lighting):
    """The smoke changes and an obstacle moves, for more frames than the capture takes."""
    volumes = [plume(frame, hot=True, device=device) for frame in (1, 2, 3)]
    camera = make_camera(CameraSettings(resolution=24), volumes[0].origin, volumes[0].size)
    lights = [LightSettings(toward=toward).light() for toward in ((1, 1, 1), (-1, 0, 1))]
    parts = {"background": (0.1, 0.2, 0.3), "obstacles": [ObstacleSettings.model_validate(SPHERE)]}
    parts["ramp"] = Ramp((0.0, 2.0), ((0.0, 0.0, 0.0), (1.0, 0.5, 0.1)))
    drawing = Drawing(camera, lights, **parts, device=device)
    graph, seen = VolumeGraph(lambda volume: drawing(lighting(volume, camera, lights, drawing)), device), []
    for number, volume in enumerate([*volumes, volumes[0]]):
        drawing.move(0.1 * number)
        graph(volume)
        seen.append(drawing.image.clone())
        again = Drawing(camera, lights, **parts, device=device)
        again.move(0.1 * number)
        torch.testing.assert_close(seen[-1], again(lighting(volume, camera, lights, again)))
    assert not torch.equal(seen[0], seen[3]) and not torch.equal(seen[1], seen[2])


def test_a_graph_scatters_all_orders(device):
    """The result equals that without a graph; another extinction is refused."""
    volumes = [plume(frame, device=device) for frame in (1, 2, 3, 4)]
    camera = make_camera(CameraSettings(resolution=24), volumes[0].origin, volumes[0].size)
    lights = [LightSettings(toward=(1, 1, 1)).light()]
    graph = VolumeGraph(lambda volume: scatter(volume, camera, lights, (0.95, 0.9, 0.8)), device)
    for volume in volumes:
        made = graph(volume).shade(background=(0.1, 0.2, 0.3))
        expected = scatter(volume, camera, lights, (0.95, 0.9, 0.8)).shade(background=(0.1, 0.2, 0.3))
        torch.testing.assert_close(made, expected)
