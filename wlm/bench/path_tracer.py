"""Six-way lightmaps by Mitsuba's volumetric path tracer at one bounce, and Open Image Denoise: the extra `bake`.

Another's way to the same integral: it checks the march where there are many samples, and shows at few of them what a
path tracer makes of a frame's time. Mitsuba traces on the CPU, or on a GPU where the driver comes with OptiX, which
many that only compute lack; the denoiser is the CPU's.
"""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from typing import Any

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import VECTORS, Camera
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.scene import CameraSettings, make_camera

__all__ = ["GPU", "PathTracer", "choose_variant", "denoise", "has_denoiser", "has_tracer", "try_variant"]

GPU = "cuda_ad_rgb"
"""Mitsuba's variant for a GPU."""

_FILTER = "RTLightmap"  # of one image without normals or albedo, in linear light
_NEVER = 100  # bounces after which paths are ended at random
_LLVM = 19  # older ones can't translate what Mitsuba asks for, and end the process
_TRIAL = f"from wlm.bench.path_tracer import try_variant; try_variant({GPU!r})"
_PATIENCE = 180.0  # seconds of a trial, most of which are for the first kernels
_TOLD = 160  # characters of why it failed


def has_tracer() -> bool:
    """Whether Mitsuba is installed."""
    return importlib.util.find_spec("mitsuba") is not None


def has_denoiser() -> bool:
    """Whether Open Image Denoise is."""
    return importlib.util.find_spec("pyoidn") is not None


def choose_variant(device: str = "cpu") -> tuple[str, str]:
    """Finds Mitsuba's quickest variant for a device.

    Args:
        device: "cpu" or "cuda:0".

    Returns:
        The variant, and why it is the CPU's although a GPU was asked for; empty otherwise.

    Raises:
        WlmError: Mitsuba isn't installed.
    """
    if not has_tracer():
        raise WlmError("path tracing needs mitsuba: install wlm[bake]")
    import drjit

    reason = ""
    if device != "cpu":
        reason = _no_gpu(device, drjit.has_backend(drjit.JitBackend.CUDA))
        if not reason:
            return GPU, ""
    fast = drjit.has_backend(drjit.JitBackend.LLVM) and drjit.detail.llvm_version()[0] >= _LLVM
    return "llvm_ad_rgb" if fast else "scalar_rgb", reason


def _no_gpu(device: str, found: bool) -> str:
    """Why Mitsuba can't trace on a GPU; empty if it can."""
    if device != "cuda:0":
        return "Mitsuba takes the first GPU alone"
    if not found:
        return "Dr.Jit finds no CUDA"
    # By itself: without OptiX, or with one that is too old, it may end the process.
    try:
        trial = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, text=True, timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        return f"a first image took more than {_PATIENCE:g} s"
    except OSError as error:
        return f"a second process can't be started, {error.strerror}"
    if trial.returncode == 0:
        return ""
    said = trial.stderr.strip().splitlines()
    return one_line(said[-1] if said else f"a first image ended with {trial.returncode}", _TOLD)


def try_variant(variant: str) -> None:
    """Traces a small plume.

    Raises:
        WlmError: Mitsuba isn't installed, or the image is black or not finite.
        Exception: Whatever Mitsuba raises where the variant doesn't work.
    """
    volume = make_plume(8, hot=False, extinction=14.0)
    camera = make_camera(CameraSettings(resolution=8), volume.origin, (1.0, 1.0, 1.0))
    lightmaps, _ = PathTracer(volume, camera, variant=variant)(4)
    if not (np.isfinite(lightmaps).all() and lightmaps.any()):
        raise WlmError(f"path tracing: {variant}: expected light, found none, or numbers that aren't finite")


class PathTracer:
    """Smoke as seen by a camera, lit from one of the six directions at a time.

    Attributes:
        variant: Mitsuba's.
    """

    def __init__(self, volume: DensityVolume, camera: Camera, *, variant: str | None = None) -> None:
        """Hands smoke and camera over.

        Args:
            volume: The smoke; on a GPU it is copied from there.
            camera: Orthographic.
            variant: Mitsuba's, as `choose_variant` gives it; None: the quickest that there is on a CPU.

        Raises:
            ValueError: The camera is in perspective.
            WlmError: Mitsuba isn't installed.
        """
        if camera.perspective:
            raise ValueError("six-way lightmaps need an orthographic camera")
        if not has_tracer():
            raise WlmError("path tracing needs mitsuba: install wlm[bake]")
        import mitsuba

        self.variant = variant or choose_variant()[0]
        mitsuba.set_variant(self.variant)
        self._mitsuba, self._camera = mitsuba, camera
        self._smoke = self._load(volume)
        self._sensor = self._sight(volume)

    def __call__(self, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Traces all six lightmaps.

        Args:
            samples: Of each pixel of each.
            seed: Of the paths.

        Returns:
            Lightmaps float32 [6, H, W] as those of `SixWay`, and the transparency [H, W], which is noisy too.
        """
        # Each is a copy on the CPU, which waits for the device.
        images = np.stack([self.traced(way, samples, seed) for way in VECTORS])
        return images[..., 0], 1.0 - images[..., 3].mean(0)

    def traced(self, way: np.ndarray, samples: int, seed: int = 0) -> np.ndarray:
        """Traces the smoke under one light of irradiance 4 pi.

        Args:
            way: [3], to the light in the camera's axes.
            samples, seed: As above.

        Returns:
            RGBA float32 [H, W, 4].
        """
        light = {
            "type": "directional",
            "direction": [float(-w) for w in self._camera.axes.T @ way],
            "irradiance": {"type": "rgb", "value": 4 * math.pi},
        }
        integrator = {"type": "volpath", "max_depth": 2, "rr_depth": _NEVER, "hide_emitters": True}
        parts = {"integrator": integrator, "sensor": self._sensor, "light": light, "smoke": self._smoke}
        scene = self._mitsuba.load_dict({"type": "scene", **parts})
        return np.array(self._mitsuba.render(scene, spp=samples, seed=seed))

    def _load(self, volume: DensityVolume) -> Any:
        """The smoke, in voxels; a border of empty ones makes Mitsuba's clamped grid end as ours does."""
        turn = self._mitsuba.ScalarTransform4f
        size = np.array(volume.shape, np.float64)
        grid = np.pad(volume.density.float().cpu().numpy(), 1).transpose(2, 1, 0)[..., None]
        box = turn().translate([-1.0] * 3).scale([float(s + 2) for s in size])
        values = self._mitsuba.VolumeGrid(np.ascontiguousarray(grid))
        medium = {
            "type": "heterogeneous",
            "albedo": 1.0,
            "scale": volume.extinction * volume.voxel,
            "sigma_t": {"type": "gridvolume", "grid": values, "to_world": box},
            "phase": {"type": "isotropic"},
        }
        centre = [float(c) for c in size / 2]
        return self._mitsuba.load_dict(
            {
                "type": "cube",
                "to_world": turn().translate(centre).scale([float(0.5 * s + 0.999) for s in size]),
                "bsdf": {"type": "null"},
                "interior": medium,
            }
        )

    def _sight(self, volume: DensityVolume) -> Any:
        camera, turn = self._camera, self._mitsuba.ScalarTransform4f
        position = (np.asarray(camera.position) - np.asarray(volume.origin)) / volume.voxel
        half = 0.5 * camera.extent / volume.voxel
        target = position - np.asarray(camera.toward)
        way = {"origin": position.tolist(), "target": target.tolist(), "up": list(camera.up)}
        sight = turn().look_at(**way).scale([half * camera.width / camera.height, half, 1.0])
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film |= {"pixel_format": "rgba", "component_format": "float32"}
        sampler = {"type": "independent"}
        return self._mitsuba.load_dict({"type": "orthographic", "to_world": sight, "film": film, "sampler": sampler})


def denoise(lightmaps: np.ndarray) -> np.ndarray:
    """Takes the noise of lightmaps [N, H, W] away, of each by itself.

    Raises:
        WlmError: Open Image Denoise isn't installed.
    """
    if not has_denoiser():
        raise WlmError("denoising needs pyoidn: install wlm[bake]")
    import pyoidn

    grey = np.repeat(np.asarray(lightmaps, np.float32)[..., None], 3, axis=-1)
    return np.stack([pyoidn.denoise(image, filter_type=_FILTER)[..., 0] for image in grey])
