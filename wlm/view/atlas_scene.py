"""A mesh's lightmap in a window: what was compressed of it, the lightmap itself, or both."""

from dataclasses import dataclass

import numpy as np

from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import AtlasModel, unpack_entries
from wlm.formats.geometry import Geometry
from wlm.texels import exposure, fill_gaps
from wlm.view.display import heat
from wlm.view.scene import State
from wlm.view.surface import SurfaceScene, compared, flat_geometry


def atlas_scene(
    model: AtlasModel, original: np.ndarray | None, *, title: str, flat: bool = False, up: int = 1
) -> SurfaceScene:
    """Makes the scene of a compression, with the lightmap that was compressed beside it.

    Args:
        model: The model; its first sheet is shown in the first state.
        original: [H, W, 3], the lightmap, of the model's size; None: not shown.
        title: Of the window.
        flat: Whether the lightmap is shown unwrapped, not on its mesh.
        up: The axis that points up.

    Raises:
        WlmError: The folder's mesh is damaged.
    """
    mask = model.scene.sheets[0].mask
    lights = {"decoded": fill_gaps(model.decoder().lightmap(), mask)}
    if original is not None:
        lights["original"] = fill_gaps(np.nan_to_num(original[..., :3], posinf=65504.0), mask)
    views = ("light", "tiles") if model.method == "tiles" else ("light",)
    size = f"textures {100 * (1.0 - model.compression_ratio):.1f}% of half floats"
    return _scene(title, model.scene, lights, flat, up, views, model, size)


def input_scene(scene: LightmappedScene, *, title: str, flat: bool = False, up: int = 1) -> SurfaceScene:
    """Makes the scene of a mesh under its lightmap; arguments as for `atlas_scene`."""
    return _scene(title, scene, {"original": scene.sheets[0].lightmap}, flat, up, ("light",), None, "input")


def _scene(
    title: str,
    scene: LightmappedScene,
    lights: dict[str, np.ndarray],
    flat: bool,
    up: int,
    views: tuple[str, ...],
    model: AtlasModel | None,
    note: str,
) -> SurfaceScene:
    mesh = scene.sheets[0]
    height, width = mesh.mask.shape
    shape = Geometry(mesh.position.astype(np.float32), mesh.triangle[mesh.active].astype(np.uint32), mesh.uv)
    return _AtlasScene(
        title,
        compared("decoded" in lights, "original" in lights),
        views=views,
        flat=flat,
        up=up,
        room=not flat and shape.is_room,
        geometry=flat_geometry(height, width) if flat else shape,
        brightness=exposure(lights.get("original", next(iter(lights.values())))[mesh.mask]),
        height=height,
        width=width,
        model=model,
        light=lights,
        mask=mesh.mask,
        note=note,
    )


@dataclass(kw_only=True)
class _AtlasScene(SurfaceScene):
    model: AtlasModel | None
    light: dict[str, np.ndarray]
    note: str

    def lights(self, state: State) -> dict[str, np.ndarray]:
        return self.light

    def tile_colours(self) -> np.ndarray:
        _, size, _ = unpack_entries(self.model.lut, self.model.first_block_code)
        side = self.model.profile.tile
        share = size.prod(-1) / (side + 1) ** 2
        rows, columns = (
            np.minimum(np.arange(n) // side, count - 1) for n, count in zip(self.mask.shape, share.shape, strict=True)
        )
        colours = heat(share)[rows][:, columns] / 255.0
        colours[::side] *= 0.7
        colours[:, ::side] *= 0.7
        return colours

    def tell_texel(self, row: int, column: int, state: State) -> str:
        outside = "" if self.mask[row, column] else "outside of the charts"
        if self.model is None or self.model.method != "tiles":
            return outside
        side = self.model.profile.tile
        y, x = (
            min(place // side, count - 1) for place, count in zip((row, column), self.model.lut.shape, strict=False)
        )
        entries = unpack_entries(self.model.lut, self.model.first_block_code)
        (left, top), (wide, high), (blocks, _) = (part[y, x] for part in entries)
        text = f"tile {x}, {y}: {wide} × {high} texels{' of blocks' * bool(blocks)} at {left}, {top}"
        return text + f"   {outside}" * bool(outside)

    def caption(self, state: State) -> str:
        text = f"{self.width} × {self.height}, {self.note}"
        if self.model is None:
            return text
        text += f", method {self.model.method}"
        if state.view == "tiles":
            text += f"; a tile's texels: 1 is black, {(self.model.profile.tile + 1) ** 2} is white"
        return text
