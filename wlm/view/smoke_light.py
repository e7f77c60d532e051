"""Pictures of smoke under its own lights, with a scene's obstacles, which are drawn and cast shadows."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from wlm.smoke.scene import ObstacleSettings, obstacle_mesh
from wlm.smoke.shading import Light, Ramp, obstacle_visibility
from wlm.smoke.transport.filtering import ScatteredSmoke
from wlm.smoke.transport.lighting import LitSmoke
from wlm.view.smoke import draw_obstacles


def light_picture(
    smoke: LitSmoke | ScatteredSmoke,
    *,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    ramp: Ramp | None = None,
    obstacles: Sequence[ObstacleSettings] = (),
    time: float = 0.0,
) -> torch.Tensor:
    """Puts lit smoke and a scene's obstacles into one picture.

    At a pixel an obstacle is before all of the smoke or behind all of it, by the depth of the smoke's surface; it keeps
    directional lights off this surface, and no point lights.

    Args:
        smoke: Light scattered once, or of all orders, which has its albedo already.
        albedo: R, G, B of light scattered once.
        background: A linear colour.
        ramp: Colour of the emission.
        obstacles: The scene's.
        time: Of the obstacles, seconds.

    Returns:
        float32 [H, W, 3], linear.
    """
    lit = smoke if isinstance(smoke, LitSmoke) else smoke.lit
    behind = torch.tensor(background, dtype=torch.float32, device=lit.transparency.device)
    drawn = away = None
    if len(obstacles):
        device = str(lit.transparency.device)
        points, triangles, _ = (torch.from_numpy(a).to(device) for a in obstacle_mesh(obstacles, time))
        directional = [light for light in lit.lights if isinstance(light, Light)]
        drawn, away = draw_obstacles(obstacles, time, lit.camera, directional, device)
        behind = torch.where(torch.isfinite(away)[..., None], drawn, behind)
        lights = []
        for light in lit.lights:
            if isinstance(light, Light):
                seen = obstacle_visibility(lit.depth, lit.camera, light.toward, points, triangles)
                light = replace(light, visibility=seen)
            lights.append(light)
        lit = replace(lit, lights=tuple(lights))
    if isinstance(smoke, LitSmoke):
        image = lit.shade(albedo=albedo, background=behind, ramp=ramp)
    else:
        image = lit.compose(smoke.planes, background=behind, ramp=ramp)
    if drawn is None or away is None:
        return image
    return torch.where((away < lit.depth)[..., None], drawn, image)
