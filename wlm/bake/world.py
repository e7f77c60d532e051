"""Builds the Mitsuba scene: surfaces and the lights of an hour."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import numpy as np

from wlm.bake.daylight import sun_direction
from wlm.bake.geometry import Geometry, Surface
from wlm.bake.paths import SUN_ANGLE, Sun, Tracing
from wlm.bake.settings import BakeScene, Daylight

with suppress(ImportError):  # `wlm.bake.backend.start`, which runs first, reports a missing package
    import drjit as dr
    import mitsuba as mi

_SKY_ROWS = 128
_DISC_SAMPLES = 1 << 12
_DAY = 24.0


def make_hour(scene: BakeScene, geometry: Geometry, picture: np.ndarray | None, hour: float) -> tuple[Any, Tracing]:
    """Builds Mitsuba's scene with the lights of one hour of `scene.hours`, except the sun and uniform ambient light,
    and settings that include these two; `picture` is the environment map, float32 [H, W, 3], or None."""
    content: dict[str, Any] = {"type": "scene"}
    glowing: dict[str | None, Any] = {}
    for lamp in scene.lamps:  # a material may have several, each with its hours
        glowing[lamp.material] = lamp.is_lit(hour) * np.array(lamp.radiance) + glowing.get(lamp.material, 0.0)
    for i, surface in enumerate(geometry.surfaces):
        emission = glowing.get(surface.material.name, surface.material.emission)
        content[f"surface{i}"] = _mesh(surface, emission, f"surface{i}")
    for i, lamp in enumerate(scene.lamps):
        if lamp.position is not None and lamp.is_lit(hour):
            colour = {"type": "rgb", "value": list(lamp.intensity)}
            content[f"lamp{i}"] = {"type": "point", "position": list(lamp.position), "intensity": colour}
    sun, sky, ambient = None, None, (0.0, 0.0, 0.0)
    if scene.daylight is not None:
        sun, sky = daylight(scene.daylight, hour, scene.period or _DAY)
        ambient = scene.daylight.night
    elif scene.sky is not None and picture is not None:
        sky = picture * np.array(scene.sky.radiance, np.float32)
    elif scene.sky is not None:
        ambient = scene.sky.radiance
    if sky is not None and sky.any():
        # Mitsuba's middle column is +z, and columns to the right of it turn towards -x.
        turned = np.roll(sky, sky.shape[1] // 2, axis=1)
        content["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(turned, np.float32))}
    tracing = Tracing(sun, ambient, scene.sun_direct, scene.samples, scene.bounces, scene.seed)
    return mi.load_dict(content), tracing


def daylight(settings: Daylight, hour: float, period: float) -> tuple[Sun | None, np.ndarray]:
    """Computes the sun and an environment map of the sky, float32 [H, W, 3]: top row up, middle column -z."""
    toward = sun_direction(hour, settings.latitude, settings.day, settings.north, period)
    rows, columns = _SKY_ROWS, 2 * _SKY_ROWS
    sky = np.zeros((rows, columns, 3), np.float32)
    sun = None
    if toward[1] > 0:
        # Mitsuba's sky model has z up; its x and y are our x and -z.
        local = [float(toward[0]), float(-toward[2]), float(toward[1])]
        common = {
            "type": "sunsky",
            "sun_direction": local,
            "turbidity": settings.turbidity,
            "albedo": {"type": "rgb", "value": [settings.albedo] * 3},
        }
        polar = (np.arange(rows) + 0.5) / rows * math.pi
        around = ((np.arange(columns) + 0.5) / columns - 0.5) * 2.0 * math.pi  # 0 at -z, rising towards +x
        up = np.repeat(np.cos(polar), columns)
        level = np.repeat(np.sin(polar), columns)
        d = np.stack([level * np.tile(np.sin(around), rows), level * np.tile(np.cos(around), rows), up])
        above = _eval(common | {"sun_scale": 0.0}, d).reshape(rows, columns, 3)
        sky = np.where((np.cos(polar) > 0)[:, None, None], np.maximum(above, 0.0), 0.0) * np.float32(settings.scale)
        # The disc is darker towards its edge, so its mean radiance is used.
        generator = np.random.default_rng(0)
        cosine = 1.0 - generator.random(_DISC_SAMPLES) * (1.0 - math.cos(SUN_ANGLE))
        turn = generator.random(_DISC_SAMPLES) * 2.0 * math.pi
        sine = np.sqrt(1.0 - cosine**2)
        axis = np.array(local)
        across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        along = np.cross(axis, across)
        disc = axis[:, None] * cosine + (across[:, None] * np.cos(turn) + along[:, None] * np.sin(turn)) * sine
        mean = np.maximum(_eval(common | {"sky_scale": 0.0}, disc), 0.0).mean(0)
        solid = 2.0 * math.pi * (1.0 - math.cos(SUN_ANGLE))
        sun = Sun(tuple(toward.tolist()), tuple((mean.astype(float) * solid * settings.scale).tolist()))
    return sun, sky


def _eval(emitter: dict[str, Any], directions: np.ndarray) -> np.ndarray:
    si = dr.zeros(mi.SurfaceInteraction3f, directions.shape[1])
    si.wi = -mi.Vector3f(directions.astype(np.float32))
    return np.asarray(mi.load_dict(emitter).eval(si)).T


def _mesh(surface: Surface, emission: tuple[float, float, float], name: str) -> Any:
    """Builds a mesh without vertex normals (flat shading), with one texture UV per vertex."""
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": _reflectance(surface)}
    if surface.material.double:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    if any(emission):
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": list(emission)}})
    has_uv = surface.texture_uv is not None
    mesh = mi.Mesh(name, len(surface.position), len(surface.triangle), props=properties, has_vertex_texcoords=has_uv)
    numbers = mi.traverse(mesh)
    numbers["vertex_positions"] = surface.position.astype(np.float32).ravel()
    numbers["faces"] = surface.triangle.astype(np.uint32).ravel()
    if has_uv:
        # The top row of a bitmap is v = 0, as in glTF.
        numbers["vertex_texcoords"] = surface.texture_uv.astype(np.float32).ravel()
    numbers.update()
    return mesh


def _reflectance(surface: Surface) -> dict[str, Any]:
    material = surface.material
    if material.texture is None or surface.texture_uv is None:
        return {"type": "rgb", "value": list(material.colour)}
    pixels = material.texture * np.float32(material.colour)
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)), "raw": True}
