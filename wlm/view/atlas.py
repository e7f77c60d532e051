"""Draws a scene under its original or its decoded lightmaps."""

from collections.abc import Mapping

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.evaluation import Sampler
from wlm.atlas.views import points_at, visible_uv
from wlm.ops.views import View


def draw(
    scene: LightmappedScene,
    samplers: Mapping[str, Sampler],
    view: View,
    resolution: int = 512,
    device: str = "cpu",
    state: int = 0,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draws a scene from one camera, as `wlm.atlas.evaluation` does, in one state, by decoders on `device`.

    Returns for each decoder float32 [resolution, resolution, 3], linear light, 0 where no lightmap is visible; and bool
    [resolution, resolution], true where one is visible.
    """
    hit, points = points_at(scene, *next(iter(visible_uv(scene, [view], resolution, device))))
    pictures = {}
    for name, sampler in samplers.items():
        picture = torch.zeros((*hit.shape, 3), dtype=torch.float32, device=hit.device)
        picture[hit] = sampler(points, state).float()
        pictures[name] = picture.cpu().numpy()
    return pictures, hit.cpu().numpy()
