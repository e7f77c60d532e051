"""The scene of a bake: a YAML file that names a glTF file, its lights by hour, and how finely to compute.

    geometry: room.gltf
    hours: [6, 9, 12, 15, 18, 21]
    period: 24
    daylight: {latitude: 50, day: 172, direct: false}
    lamps:
      - {material: Bulb, radiance: [40, 30, 20], lit: [18, 5.5]}
    lightmap: {resolution: 256, unwrap: true}
    probes: {spacing: 0.5}
    samples: 256

Lengths are the glTF file's, metres; +y is up, as in glTF. Light is linear RGB: daylight comes in W/m2/nm, as Mitsuba's
model of it does (a clear noon has about 1.5), times `scale`; all else in the same unit or any other.
"""

import os
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from wlm.config import load_settings
from wlm.formats.reading import named_file
from wlm.system import Name

_MOST_LAMPS = 256
_MOST_HOURS = 10_000

_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Light = Annotated[float, Field(ge=0.0, le=1e9)]
Colour = tuple[_Light, _Light, _Light]
"""Linear RGB, not negative."""
_Vector = tuple[_Number, _Number, _Number]
_Hour = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Daylight(_Settings):
    """Sun and sky by the hour, as Mitsuba's `sunsky` has them (Hosek and Wilkie 2012, 2013); the hour is the sun's own.

    Attributes:
        latitude: Degrees, north positive.
        day: Of the year, 1 to 366.
        north: Degrees by which north is turned from -z towards -x.
        turbidity: 1 is air alone, 10 is haze.
        albedo: Of the ground, which the sky reflects.
        scale: A factor for both.
        direct: Whether what the sun lights directly is in the result; its bounces are in any case.
        night: Radiance of the sky added at any hour.
    """

    latitude: float = Field(45.0, ge=-90.0, le=90.0)
    day: int = Field(172, ge=1, le=366)
    north: float = Field(0.0, ge=-360.0, le=360.0)
    turbidity: float = Field(3.0, ge=1.0, le=10.0)
    albedo: float = Field(0.3, ge=0.0, le=1.0)
    scale: float = Field(1.0, ge=0.0, le=1e6)
    direct: bool = True
    night: Colour = (0.0, 0.0, 0.0)


class Sky(_Settings):
    """Light from all around that is the same at all hours.

    Attributes:
        radiance: Of all directions, or a factor for the picture.
        file: A picture of all directions in a `.exr`, `.hdr`, `.ktx2` or `.dds`, twice as wide as high: the top row is
            +y, the middle column -z, columns to the right of it turn towards +x; None: none.
    """

    radiance: Colour = (1.0, 1.0, 1.0)
    file: str | None = None


class Lamp(_Settings):
    """A point light, or a material that glows in place of what the glTF file says of it.

    Attributes:
        position: Of a point.
        intensity: Of a point, per solid angle: the irradiance at a distance r is intensity / r^2.
        material: A material's name.
        radiance: Of the material's surfaces, on their front.
        lit: Hours between which it is lit, the first included; past midnight where the second is less. None: always.
    """

    position: _Vector | None = None
    intensity: Colour = (1.0, 1.0, 1.0)
    material: str | None = None
    radiance: Colour = (1.0, 1.0, 1.0)
    lit: tuple[_Hour, _Hour] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.position is None) == (self.material is None):
            raise ValueError("expected a lamp of a position or of a material")
        given = self.model_fields_set
        if ("radiance" in given and self.material is None) or ("intensity" in given and self.position is None):
            raise ValueError("expected intensity with a position, radiance with a material")
        return self

    def is_lit(self, hour: float) -> bool:
        """Whether it is lit at an hour."""
        if self.lit is None:
            return True
        on, off = self.lit
        return on <= hour < off if on <= off else hour >= on or hour < off


class LightmapSettings(_Settings):
    """How the lightmap is laid out.

    Attributes:
        resolution: Texels along a side.
        uv_set: n of `TEXCOORD_n`; None: 1 where there is one, else 0.
        unwrap: Whether to make new UVs, `TEXCOORD_1`, and write the mesh with them.
        padding: Texels between new charts.
        supersample: Places along a texel's side that its light is the mean of.
        directional: Whether to bake where the light comes from, too.
    """

    resolution: int = Field(256, ge=8, le=4096)
    uv_set: int | None = Field(None, ge=0, le=9999)
    unwrap: bool = False
    padding: int = Field(4, ge=0, le=64)
    supersample: int = Field(4, ge=1, le=8)
    directional: bool = False


class ProbeSettings(_Settings):
    """Where the probes are.

    Attributes:
        spacing: Between neighbours.
        surfaces: Whether they lie on surfaces, at random, one for each square of `spacing`; otherwise in a lattice in
            the geometry's box.
        lift: Of those on surfaces, how far off.
    """

    spacing: float = Field(1.0, gt=0.0, le=1e9)
    surfaces: bool = False
    lift: float = Field(0.05, ge=0.0, le=1e9)


class BakeScene(_Settings):
    """A scene.

    Attributes:
        geometry: A `.glb` or `.gltf` beside the YAML file.
        name: Of the set.
        hours: To bake at.
        period: Length of the day, None where the hours aren't of a day.
        daylight, sky: Light from outside; one of both at most.
        lamps: Lights with times. Materials that glow in the glTF file glow always, unless a lamp names them.
        lightmap, probes: What is baked.
        samples: Paths of a texel, or of a probe.
        bounces: Surfaces that reflect the light on its way, at most.
        denoise: Whether Intel's Open Image Denoise filters the lightmaps.
        seed: One seed gives one result on one device.
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
            raise ValueError("hours: expected each once, to nine digits")
        if self.period is not None and not all(0 <= hour < self.period for hour in self.hours):
            raise ValueError(f"hours: expected 0 to below the period of {self.period:g}")
        return self

    @property
    def sun_direct(self) -> bool:
        """Whether the sun's own light is in the result."""
        return self.daylight is not None and self.daylight.direct


def load_scene(path: str | os.PathLike[str], trust: bool = False) -> tuple[BakeScene, Path, Path | None]:
    """Reads a scene.

    Args:
        path: The YAML file.
        trust: Whether it may name files outside its folder.

    Returns:
        The settings, the glTF file, and the sky's picture or None.

    Raises:
        WlmError: The file can't be read, or a setting is wrong.
    """
    scene = load_settings(BakeScene, path)
    geometry = named_file(path, scene.geometry, f"{path}: geometry", trust)
    picture = None
    if scene.sky is not None and scene.sky.file is not None:
        picture = named_file(path, scene.sky.file, f"{path}: sky.file", trust)
    return scene, geometry, picture
