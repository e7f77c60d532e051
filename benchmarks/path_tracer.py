"""Six-way lightmaps by Mitsuba's volumetric path tracer, denoised by Open Image Denoise; both need the extra `bake`.

Path tracing estimates the same integral as ray marching, independently: many samples check the ray march, few samples
show the quality that a path tracer reaches in the time of a frame. Mitsuba traces on the CPU here; the path tracer
that is measured on a GPU is `benchmarks.smoke_tracing`.
"""

import functools
import importlib.util
import math
from typing import Any

import numpy as np
import torch

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import VECTORS, Camera

_FILTER = "RTLightmap"  # filter for one image in linear light without normals or albedo
_NEVER = 100  # bounces after which Russian roulette begins
_LLVM = 19  # older versions can't compile Mitsuba's kernels, and end the process


def has_tracer() -> bool:
    """Returns whether Mitsuba is installed."""
    return importlib.util.find_spec("mitsuba") is not None


def has_denoiser() -> bool:
    """Returns whether Open Image Denoise is installed."""
    return importlib.util.find_spec("pyoidn") is not None


def choose_variant() -> str:
    """Chooses Mitsuba's fastest variant on the CPU.

    Raises:
        WlmError: Mitsuba is not installed.
    """
    if not has_tracer():
        raise WlmError("path tracing needs the package mitsuba: install wlm[bake]")
    import drjit

    fast = drjit.has_backend(drjit.JitBackend.LLVM) and drjit.detail.llvm_version()[0] >= _LLVM
    return "llvm_ad_rgb" if fast else "scalar_rgb"


class PathTracer:
    """Renders images of smoke under one of the six lights at a time.

    Attributes:
        variant: Name of the Mitsuba variant, such as "llvm_ad_rgb".
    """

    def __init__(
        self,
        volume: DensityVolume,
        camera: Camera,
        *,
        variant: str | None = None,
        albedo: float = 1.0,
        g: float = 0.0,
        order: int = 1,
    ) -> None:
        """Loads smoke and camera into Mitsuba.

        Args:
            volume: The smoke, on any device.
            camera: An orthographic camera.
            variant: Name of a Mitsuba variant; None: the fastest on the CPU.
            albedo: Single-scattering albedo.
            g: Mean cosine of the Henyey-Greenstein phase function.
            order: Maximum number of scattering events of a path.

        Raises:
            ValueError: The camera is not orthographic.
            WlmError: Mitsuba isn't installed.
        """
        if camera.perspective:
            raise ValueError("six-way lightmaps need an orthographic camera")
        self.variant = variant or choose_variant()
        import mitsuba

        mitsuba.set_variant(self.variant)
        self._mitsuba, self._camera, self._order = mitsuba, camera, order
        self._smoke = self._load_smoke(volume, albedo, g)
        self._sensor = self._load_sensor(volume)

    def __call__(self, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Traces all six lightmaps.

        Args:
            samples: Paths for each pixel of each lightmap.
            seed: Seed of the random paths.

        Returns:
            Lightmaps float32 [6, H, W] in the order of `SixWay`, and the transparency [H, W], which is noisy too.
        """
        # Each is a copy on the CPU, which waits for the device.
        images = np.stack([self.trace(direction, samples, seed) for direction in VECTORS])
        return images[..., 0], 1.0 - images[..., 3].mean(0)

    def trace(self, direction: np.ndarray, samples: int, seed: int = 0) -> np.ndarray:
        """Traces RGBA float32 [H, W, 4] under one light of irradiance 4 pi, from `direction` [3] in camera axes."""
        light = {
            "type": "directional",
            "direction": [float(-w) for w in self._camera.axes.T @ direction],
            "irradiance": {"type": "rgb", "value": 4 * math.pi},
        }
        integrator = {"type": "volpath", "max_depth": self._order + 1, "rr_depth": _NEVER, "hide_emitters": True}
        parts = {"integrator": integrator, "sensor": self._sensor, "light": light, "smoke": self._smoke}
        scene = self._mitsuba.load_dict({"type": "scene", **parts})
        return np.array(self._mitsuba.render(scene, spp=samples, seed=seed))

    def _load_smoke(self, volume: DensityVolume, albedo: float, g: float) -> Any:
        """Loads the smoke into Mitsuba in units of voxels, with a border of empty voxels as Mitsuba clamps its grid."""
        transform = self._mitsuba.ScalarTransform4f
        size = np.array(volume.shape, np.float64)
        grid = np.pad(volume.density.float().cpu().numpy(), 1).transpose(2, 1, 0)[..., None]
        box = transform().translate([-1.0] * 3).scale([float(s + 2) for s in size])
        values = self._mitsuba.VolumeGrid(np.ascontiguousarray(grid))
        medium = {
            "type": "heterogeneous",
            "albedo": albedo,
            "scale": volume.extinction * volume.voxel,
            "sigma_t": {"type": "gridvolume", "grid": values, "to_world": box},
            "phase": {"type": "hg", "g": g} if g else {"type": "isotropic"},
        }
        centre = [float(c) for c in size / 2]
        return self._mitsuba.load_dict(
            {
                "type": "cube",
                "to_world": transform().translate(centre).scale([float(0.5 * s + 0.999) for s in size]),
                "bsdf": {"type": "null"},
                "interior": medium,
            }
        )

    def _load_sensor(self, volume: DensityVolume) -> Any:
        camera, transform = self._camera, self._mitsuba.ScalarTransform4f
        position = (np.asarray(camera.position) - np.asarray(volume.origin)) / volume.voxel
        half = 0.5 * camera.extent / volume.voxel
        target = position - np.asarray(camera.toward)
        view = {"origin": position.tolist(), "target": target.tolist(), "up": list(camera.up)}
        to_world = transform().look_at(**view).scale([half * camera.width / camera.height, half, 1.0])
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film |= {"pixel_format": "rgba", "component_format": "float32"}
        sampler = {"type": "independent"}
        return self._mitsuba.load_dict({"type": "orthographic", "to_world": to_world, "film": film, "sampler": sampler})


def denoise(lightmaps: np.ndarray) -> np.ndarray:
    """Denoises N lightmaps [N, H, W] one by one with Open Image Denoise.

    Raises:
        WlmError: Open Image Denoise isn't installed.
    """
    if not has_denoiser():
        raise WlmError("denoising needs the package pyoidn: install wlm[bake]")
    import pyoidn

    grey = np.repeat(np.asarray(lightmaps, np.float32)[..., None], 3, axis=-1)
    return np.stack([pyoidn.denoise(image, filter_type=_FILTER)[..., 0] for image in grey])


@functools.cache
def denoiser_device(device: str) -> str:
    """Returns `device` if Open Image Denoise runs there, else "cpu"."""
    import pyoidn

    try:
        pyoidn.denoise(torch.zeros(16, 16, 3, device=device), filter_type="RT", hdr=True)
    except (RuntimeError, ImportError, OSError):
        return "cpu"
    return device


def denoised_picture(picture: torch.Tensor) -> torch.Tensor:
    """Denoises a picture [H, W, 3] of linear light with Open Image Denoise, on the device of the picture if possible.

    Raises:
        WlmError: Open Image Denoise isn't installed.
    """
    if not has_denoiser():
        raise WlmError("denoising needs the package pyoidn: install wlm[bake]")
    import pyoidn

    there = picture.float().contiguous().to(denoiser_device(str(picture.device)))
    return pyoidn.denoise(there, filter_type="RT", hdr=True).to(picture.device)
