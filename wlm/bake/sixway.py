"""Bakes six-way lightmaps of smoke with multiple scattering, using the path tracer of `wlm.smoke.transport`.

The settings are a YAML file such as

    smoke: jet.nvdb
    camera: {toward: [0, 0, 1], resolution: 256}
    samples: 256
"""

import math
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from wlm.config import load_settings
from wlm.fluid.volume import DensityVolume
from wlm.formats.reading import named_file
from wlm.smoke.camera import VECTORS, Camera
from wlm.smoke.data import Frames, load_frames
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake
from wlm.smoke.scene import CameraSettings
from wlm.smoke.shading import Light
from wlm.smoke.transport import trace

_Positive = Annotated[float, Field(gt=0.0, le=1e9)]


class SixWayScene(BaseModel):
    """Settings of a six-way bake.

    Attributes:
        smoke: A `.npz`, `.nvdb` or `.vdb` volume, or a folder of frames, beside the YAML file.
        camera: An orthographic camera, with the settings of a `wlm smoke` scene.
        extinction, emission: Factors of the smoke's density and temperature. None: from the smoke's `scene.json`, or 1.
        up: Axis that points up in volumes of other programs, "y" or "z"; None: y.
        albedo: Single-scattering albedo.
        g: Mean cosine of the Henyey-Greenstein phase function.
        samples: Paths per pixel.
        highest: Maximum number of scattering events of a path; None for no limit.
        step: Step in voxels of the march that computes the transparency.
        seed: Random seed; one seed gives one result on one kind of device.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    smoke: str
    camera: CameraSettings = CameraSettings()
    extinction: _Positive | None = None
    emission: _Positive | None = None
    up: Literal["y", "z"] | None = None
    albedo: float = Field(1.0, ge=0.0, le=1.0)
    g: float = Field(0.0, ge=-0.99, le=0.99)
    samples: int = Field(256, ge=2, le=2**20)
    highest: int | None = Field(None, ge=1, le=100_000)
    step: float = Field(0.5, ge=0.01, le=1000.0)
    seed: int = Field(0, ge=0, le=2**31 - 1)


def load_sixway(
    path: str | os.PathLike[str], *, device: str = "cpu", trust: bool = False
) -> tuple[SixWayScene, Frames]:
    """Reads a scene from its YAML file and opens its smoke on a device.

    With `trust` it may refer to files outside its folder, and volumes may exceed the size limits.

    Raises:
        WlmError: A file can't be read, or a setting is wrong.
    """
    settings = load_settings(SixWayScene, path)
    smoke = named_file(path, settings.smoke, f"{path}: smoke", trust)
    options = {"up": settings.up, "trust": trust or None}
    factors = {"extinction": settings.extinction, "emission": settings.emission}
    return settings, load_frames(Path(smoke), **factors, device=device, **options)


def bake_sixway(volume: DensityVolume, camera: Camera, settings: SixWayScene) -> tuple[SixWay, float]:
    """Traces light from six directions; ray marching computes emission and transparency.

    Returns:
        The lightmaps, with `settings.albedo`, and the RMS of their noise divided by the RMS of their light.

    Raises:
        WlmError: The smoke is so dense that paths would become extremely long, or it doesn't fit into memory.
    """
    marched = bake(volume, camera, step=settings.step, g=settings.g, estimate=False)
    # All six lightmaps share their paths. The lightmaps of emissive smoke exclude its emission.
    lights = [Light(tuple(map(float, direction @ camera.axes)), (4.0 * math.pi,) * 3) for direction in VECTORS]
    options = {} if settings.highest is None else {"highest": settings.highest}
    traced = trace(
        volume,
        camera,
        lights,
        albedo=(settings.albedo,) * 3,
        g=settings.g,
        samples=settings.samples,
        orders=0,
        seed=settings.seed,
        **options,
    )
    # Light and smoke are white, so all channels are equal.
    light = traced.planes[: len(lights)].sum(1)[..., 0]
    power = float(light.double().square().mean())
    noise = traced.noise[: len(lights), ..., 0]
    error = math.sqrt(float(noise.double().square().mean()) / power) if power > 0 else 0.0
    return SixWay(light.contiguous(), marched.transparency, marched.emission, camera), error
