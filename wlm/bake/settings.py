"""Settings of a bake: a YAML file that names a glTF file, lights by the hour, resolution and sampling.

    geometry: room.gltf
    hours: [6, 9, 12, 15, 18, 21]
    period: 24
    daylight: {latitude: 50, day: 172, direct: false}
    lamps:
      - {material: Bulb, radiance: [40, 30, 20], lit: [18, 5.5]}
    lightmap: {resolution: 256, unwrap: true}
    probes: {spacing: 0.5}
    samples: 256

Lengths are in metres, as in the glTF file; +y is up. Light is linear RGB: daylight is in W/m2/nm, the unit of Mitsuba's
model (about 1.5 at a clear noon), times `scale`; other lights use the same unit or any other.
"""

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from wlm.system import Checked, Name

_MOST_LAMPS = 256
_MOST_HOURS = 10_000

_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Light = Annotated[float, Field(ge=0.0, le=1e9)]
Colour = tuple[_Light, _Light, _Light]
"""Linear RGB, not negative."""
_Vector = tuple[_Number, _Number, _Number]
_Hour = Annotated[float, Field(ge=-1e6, le=1e6)]


class Daylight(Checked):
    """Sun and sky by solar time, from Mitsuba's `sunsky` (Hosek and Wilkie 2012, 2013).

    Attributes:
        latitude: Latitude in degrees, north positive.
        day: Day of the year, 1 to 366.
        north: Degrees by which north is turned from -z towards -x.
        turbidity: Turbidity of the air: 1 is clear air, 10 is haze.
        albedo: Albedo of the ground, which affects the sky.
        scale: Factor of the sun and the sky.
        direct: Whether the result includes the sun's direct light; it always includes its indirect light.
        night: Radiance of the sky that is added at all hours, R, G, B.
    """

    latitude: float = Field(45.0, ge=-90.0, le=90.0)
    day: int = Field(172, ge=1, le=366)
    north: float = Field(0.0, ge=-360.0, le=360.0)
    turbidity: float = Field(3.0, ge=1.0, le=10.0)
    albedo: float = Field(0.3, ge=0.0, le=1.0)
    scale: float = Field(1.0, ge=0.0, le=1e6)
    direct: bool = True
    night: Colour = (0.0, 0.0, 0.0)


class Sky(Checked):
    """Environment light that is the same at all hours.

    Attributes:
        radiance: Radiance from all directions, or, with `file`, a factor of the environment map.
        file: An equirectangular environment map (`.exr`, `.hdr`, `.ktx2` or `.dds`), twice as wide as high: the top row
            is +y, the middle column -z, columns to the right of it turn towards +x; None for no map.
    """

    radiance: Colour = (1.0, 1.0, 1.0)
    file: str | None = None


class Lamp(Checked):
    """A point light, or a material whose emission replaces the glTF file's.

    Attributes:
        position: Position of a point light.
        intensity: Radiant intensity of a point light: the irradiance at a distance r is intensity / r^2.
        material: Name of the emissive material.
        radiance: Radiance of the fronts of the material's surfaces.
        lit: Hours at which it is switched on and off, the first included; may span midnight. None: always on.
    """

    position: _Vector | None = None
    intensity: Colour = (1.0, 1.0, 1.0)
    material: str | None = None
    radiance: Colour = (1.0, 1.0, 1.0)
    lit: tuple[_Hour, _Hour] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.position is None) == (self.material is None):
            raise ValueError("expected a lamp with either a position or a material")
        if ("radiance" if self.material is None else "intensity") in self.model_fields_set:
            raise ValueError("expected an intensity for a lamp with a position, a radiance for a lamp with a material")
        return self

    def is_lit(self, hour: float) -> bool:
        """Returns whether the lamp is on at an hour."""
        on, off = self.lit or (-math.inf, math.inf)
        return on <= hour < off if on <= off else hour >= on or hour < off


class LightmapSettings(Checked):
    """Layout of the lightmap.

    Attributes:
        resolution: Width and height in texels.
        uv_set: The number n of the lightmap's UV set `TEXCOORD_n`; None: 1 if it exists, else 0.
        unwrap: Whether to create new UVs, `TEXCOORD_1`, and write the mesh with them.
        padding: Distance between new charts, in texels.
        supersample: Number of sample positions along a texel's side; a texel is the mean over its samples.
    """

    resolution: int = Field(256, ge=8, le=4096)
    uv_set: int | None = Field(None, ge=0, le=9999)
    unwrap: bool = False
    padding: int = Field(4, ge=0, le=64)
    supersample: int = Field(4, ge=1, le=8)


class ProbeSettings(Checked):
    """Positions of the probes: a lattice in the geometry's bounding box, whose points are `spacing` metres apart."""

    spacing: float = Field(1.0, gt=0.0, le=1e9)


class BakeScene(Checked):
    """Settings of a baked scene.

    Attributes:
        geometry: A `.glb` or `.gltf` in the YAML file's folder.
        name: Name of the lightmap set.
        hours: Hours to bake.
        period: Length of the day in hours; None if the hours don't repeat.
        daylight, sky: Light from outside; at most one of them.
        lamps: Lights with times. Emissive materials of the glTF file are always on, unless a lamp names them.
        lightmap, probes: Settings of the lightmap and of the probes.
        samples: Paths per texel or per probe.
        bounces: Maximum number of reflections of a path.
        denoise: Whether Intel's Open Image Denoise filters the lightmaps.
        seed: Seed of the random numbers; equal seeds give equal results on one device.
    """

    geometry: str
    name: Name = "bake"
    hours: Annotated[list[_Hour], Field(min_length=1, max_length=_MOST_HOURS)] = [12.0]
    period: float | None = Field(None, gt=0.0, le=1e6)
    daylight: Daylight | None = None
    sky: Sky | None = None
    lamps: Annotated[list[Lamp], Field(max_length=_MOST_LAMPS)] = []
    lightmap: LightmapSettings = LightmapSettings()
    probes: ProbeSettings = ProbeSettings()
    samples: int = Field(256, ge=4, le=2**20)
    bounces: int = Field(6, ge=0, le=1024)
    denoise: bool = False
    seed: int = Field(0, ge=0, le=2**31 - 1)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.daylight is not None and self.sky is not None:
            raise ValueError("expected daylight or sky, found both")
        if len({f"{hour:.9g}" for hour in self.hours}) < len(self.hours):  # as files are named
            raise ValueError("hours: expected different hours, found two that are equal after rounding to nine digits")
        if self.period is not None and not all(0 <= hour < self.period for hour in self.hours):
            raise ValueError(f"hours: expected hours of at least 0 and below the period of {self.period:g}")
        lit = [hour for lamp in self.lamps for hour in lamp.lit or ()]
        if self.period is not None and not all(0 <= hour <= self.period for hour in lit):
            raise ValueError(f"lamps: lit: expected hours from 0 to the period of {self.period:g}")
        return self

    @property
    def sun_direct(self) -> bool:
        """Whether the result includes the sun's direct light."""
        return self.daylight is not None and self.daylight.direct
