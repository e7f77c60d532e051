"""The scene of a day in a window: the mesh under its lightmaps, and the moving objects; without smoke."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from wlm.formats.hours import DAY
from wlm.interop import check_device
from wlm.lightmap.decode import Decoder
from wlm.lightmap.groups import Weight, changed_weights
from wlm.ops.raster import interpolate, rasterize_uv
from wlm.scene.content import Scene as Content
from wlm.scene.probes import DayProbes
from wlm.texels import fill_gaps
from wlm.view.canvas import Canvas
from wlm.view.scene import Scene, Slider, State

_MOST = 4.0  # of the slider of a light group


def day_scene(content: Content, weights: Mapping[str, Weight] | None = None, device: str = "cpu") -> Scene:
    """Makes the scene of a window, of content that must stay open: a slider for the hour, and one for each light group
    that multiplies its weight; `device` decodes the lightmaps and the probes."""
    model, device = content.light, check_device(device)
    factors = changed_weights(model.name, {group: np.ones(3, np.float32) for group in model.groups}, weights or {})
    hour = Slider("hour", 0.0, DAY, content.day.first % DAY, 0.25, wraps=True, clock=True)
    sliders = (hour, *(Slider(_label(group), 0.0, _MOST, 1.0, 0.1) for group in model.groups))
    mesh, own = content.mesh, model.light
    uv, triangle = torch.tensor(mesh.uv), torch.tensor(mesh.triangle)
    raster = rasterize_uv(uv, triangle, own.height, own.width)
    colours = interpolate(torch.tensor(mesh.colour), triangle, raster).numpy()
    return _DayScene(
        content.title,
        ("scene",),
        sliders=sliders,
        content=content,
        factors=factors,
        decoder=model.decoder(device),
        probes=DayProbes(content, device) if content.moving else None,
        base=fill_gaps(colours, raster.triangle.numpy() >= 0),
    )


def _label(group: str) -> str:
    return f"{group} weight"


@dataclass(kw_only=True)
class _DayScene(Scene):
    content: Content
    factors: dict[str, np.ndarray]
    decoder: Decoder
    probes: DayProbes | None
    base: np.ndarray

    def draw(self, canvas: Canvas, state: State) -> None:
        content, hour = self.content, state.values["hour"]
        second = content.second_at(hour)
        colour, exposure = content.sky_at(hour)
        display = state.display(2.0**exposure)
        self.decoder.set_weights({name: own * state.values[_label(name)] for name, own in self.factors.items()})
        picture = display.picture(self.base / math.pi * self.decoder.frame(hour))
        canvas.background(0, display.screen(colour))
        canvas.textured(0, "mesh", content.mesh.position, content.mesh.triangle, content.mesh.uv, picture)
        if self.probes is None:
            return
        poses = [each.pose(second) for each in content.moving]
        centres = [each.centre(pose) for each, pose in zip(content.moving, poses, strict=True)]
        light = self.probes.at(np.stack(centres), hour, content.camera_at(second)[0], complete=True)
        for i, (each, pose, own) in enumerate(zip(content.moving, poses, light, strict=True)):
            position, radiance = each.lit(pose, own)
            canvas.coloured(0, f"moving {i}", position, each.mesh.triangle, display.picture(radiance))

    def caption(self, state: State) -> str:
        size = f"{self.content.light.light.width} × {self.content.light.light.height} texels"
        return f"{size}, {len(self.content.mesh.triangle):,} triangles, {len(self.content.moving)} moving objects"
