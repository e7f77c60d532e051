"""The light of frames by a graph: on every device the picture of each."""

import torch
from builders.smoke_plumes import SPHERE, plume

from wlm.smoke.scene import CameraSettings, LightSettings, ObstacleSettings, make_camera
from wlm.view.smoke import picture
from wlm.view.smoke_drawing import Drawing
from wlm.view.smoke_run import FrameGraph, Lighting


def test_a_graph_draws_each_frame(device):
    """Smoke that lies elsewhere each time, and an obstacle that moves; more often than it takes to be captured."""
    volumes = [plume(frame, hot=True, device=device) for frame in (1, 2, 3)]
    camera = make_camera(CameraSettings(resolution=24), volumes[0].origin, volumes[0].size)
    lights = [LightSettings(toward=toward).light() for toward in ((1, 1, 1), (-1, 0, 1))]
    parts = {"background": (0.1, 0.2, 0.3), "obstacles": [ObstacleSettings.model_validate(SPHERE)]}
    drawing, lighting = Drawing(camera, lights, **parts, device=device), Lighting(step=1.0)
    graph, seen = FrameGraph(lighting, camera, drawing, device), []
    for number, volume in enumerate(volumes + volumes):
        drawing.move(0.1 * number)
        graph(volume)
        seen.append(drawing.image.clone())
        expected = picture(lighting(volume, camera, True), lights, **parts, time=0.1 * number)
        torch.testing.assert_close(seen[-1], expected)
    assert not torch.equal(seen[0], seen[3]) and not torch.equal(seen[1], seen[2])
