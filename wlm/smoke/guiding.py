"""Guiding maps: a rough image of smoke, which a network turns into six-way lightmaps (section 4.2)."""

from dataclasses import dataclass

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.marching import run
from wlm_kernels.smoke import march_guide
from wlm_kernels.smoke.settings import March


@dataclass(frozen=True, eq=False)
class Guide:
    """A guiding map of H x W pixels (algorithm 1).

    Attributes:
        maps: float32 tensor [3, H, W] on the smoke's device: light, transparency, depth.
        camera: The view.
    """

    maps: torch.Tensor
    camera: Camera

    @property
    def light(self) -> torch.Tensor:
        """[H, W], light scattered to the camera under lights from the front, top and bottom of irradiance 4 pi."""
        return self.maps[0]

    @property
    def transparency(self) -> torch.Tensor:
        """[H, W], in [0, 1]: 1 where there is no smoke."""
        return self.maps[1]

    @property
    def depth(self) -> torch.Tensor:
        """[H, W], distance along the ray to the smoke in the world's unit, 0 where there is none."""
        return self.maps[2]


def guide(volume: DensityVolume, camera: Camera, march: March = March(), *, shared: bool = True) -> Guide:
    """Marches through smoke in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective; inside the smoke it sees what is in front of it, lit from the front by a
            light in its own place.
        march: Without `spacing` and `light_step`: nodes and steps to the lights are those of the rays.
        shared: Whether pixels share marches to the lights, on a lattice with a node each step. Far quicker; the light
            between nodes is then interpolated.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: The march has a spacing or a light_step.
    """
    for name in ("spacing", "light_step"):
        if getattr(march, name) is not None:
            raise ValueError(f"{name}: expected none for the paper's guiding map, got {getattr(march, name)}")
    return Guide(run(march_guide.guide, volume, camera, (3,), march, shared=shared), camera)
