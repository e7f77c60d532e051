"""A scene's parts: the lightmap of each object and state by itself, as `standard` of one lightmap compresses it.

What a scene costs without `wlm.atlas.scene`: each part has tiles, a table and textures of its own, and its share of
the bits by its texels. Tiles are fitted in all parts at once, with the scene's own weights: views of the whole scene,
which none of them knows by itself, and in which they are scored.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.atlas.data import LightmappedMesh
from wlm.atlas.decode import Decoder
from wlm.atlas.fit import with_fallback
from wlm.atlas.layout import Layout, Size, layout, sizes_of
from wlm.atlas.model import LUT_BITS, SOURCE_BITS, AtlasModel, Profile, compression_ratio, tile_counts
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.stages import one_thread
from wlm.atlas.tiles import Tiles, composed_model, curves, cut, least_gain, solved
from wlm.atlas.weights import FineGrid

_TRIES, _CLOSE = 8, 1.005  # of finding the share whose bits are those that are asked for, and how close is enough


@dataclass(frozen=True, eq=False)
class _Part:
    """A sheet's lightmap in one state, and its tiles among those of all parts."""

    mesh: LightmappedMesh
    sheet: int
    tiles: slice

    @property
    def texels(self) -> int:
        return self.mesh.mask.size


class SceneParts:
    """Models of all parts.

    Attributes:
        models: By sheet and state.
        share: Of each lightmap's bits at 48 a texel, the budget of each part.
    """

    def __init__(self, models: list[list[AtlasModel]], share: float, device: str) -> None:
        self.models, self.share = models, share
        self._decoders = [[Decoder(model, device) for model in of_sheet] for of_sheet in models]

    @property
    def bits(self) -> float:
        """Of all textures and tables."""
        models = (model for of_sheet in self.models for model in of_sheet)
        return sum(SOURCE_BITS * model.height * model.width * (1.0 - model.compression_ratio) for model in models)

    def read(self, uv: torch.Tensor, sheet: torch.Tensor, state: int) -> torch.Tensor:
        """A `SceneSampler`."""
        light = torch.zeros((len(uv), 3), dtype=torch.float32, device=uv.device)
        for number in torch.unique(sheet).tolist():
            at = sheet == number
            light[at] = self._decoders[number][state].read(uv[at].contiguous())
        return light


def scene_parts(
    scene: LightmappedScene,
    weights: Sequence[np.ndarray],
    bits: float,
    colour: str = "mixed",
    device: str = "cpu",
) -> SceneParts:
    """Compresses each part by itself.

    Args:
        scene: The scene.
        weights: For each sheet [2 H, 2 W], how much each quarter of a texel counts, `scene_weights`.
        bits: Of all parts, which have that many at least, but for plain ones, and as few more as their sizes allow.
        colour: Instead of that of `standard`.
        device: "cpu" or "cuda:N".

    Returns:
        The parts; one of them is a plain smaller lightmap where that is no worse, or where tiles don't fit its share.
    """
    with one_thread(device):
        return _compressed(scene, weights, bits, Profile.load("standard").override({"colour": colour}), device)


def _compressed(
    scene: LightmappedScene, weights: Sequence[np.ndarray], bits: float, profile: Profile, device: str
) -> SceneParts:
    tiles, parts = _cut(scene, weights, profile, device)
    sizes = sizes_of(profile)
    error = torch.from_numpy(curves(tiles, sizes))
    share, tries = bits / scene.source_bits, []
    for _ in range(_TRIES):
        placed = [_placed(error[:, part.tiles], sizes, part, share, profile) for part in parts]
        taken = sum(_bits(each, part, share, profile) for each, part in zip(placed, parts, strict=True))
        tries.append((taken < bits, abs(taken - bits), share, placed))
        if bits <= taken <= _CLOSE * bits:
            break
        share *= (1.0 + 0.5 * (_CLOSE - 1.0)) * bits / taken
    *_, share, placed = min(tries, key=lambda each: each[:2])
    chosen = np.zeros(len(tiles.index), int)
    for each, part in zip(placed, parts, strict=True):
        if each is not None:
            chosen[part.tiles] = each.chosen
    samples = _by_part(solved(tiles, sizes, chosen), parts)
    models: list[list[AtlasModel]] = [[] for _ in scene.sheets]
    settings = profile.model_copy(update={"budget": share})
    for number, (part, each) in enumerate(zip(parts, placed, strict=True)):
        grid, model = FineGrid(part.mesh, device), None
        if each is not None:
            index = tiles.index[part.tiles].cpu().numpy()
            model = composed_model(part.mesh, settings, samples[number], sizes, each, index, device)
        weight = torch.from_numpy(weights[part.sheet]).to(device)
        models[part.sheet].append(with_fallback(grid, model, settings, weight))
    return SceneParts(models, share, device)


def _cut(
    scene: LightmappedScene, weights: Sequence[np.ndarray], profile: Profile, device: str
) -> tuple[Tiles, list[_Part]]:
    """The tiles of all parts, of which each has weights that add up to 1; and the parts, sheet by sheet."""
    pieces, parts, first = [], [], 0
    for number, (sheet, weight) in enumerate(zip(scene.sheets, weights, strict=True)):
        for frame in sheet.frames:
            piece = cut(frame, weight, profile.tile, device)
            after = first + len(piece.index)
            parts.append(_Part(replace(sheet.mesh, lightmap=frame), number, slice(first, after)))
            pieces.append(piece)
            first = after
    together = (torch.cat([getattr(piece, name) for piece in pieces]) for name in ("index", "light", "weight"))
    return Tiles(*together, profile.tile), parts


def _placed(error: torch.Tensor, sizes: list[Size], part: _Part, share: float, profile: Profile) -> Layout | None:
    room = share * part.texels * SOURCE_BITS - math.prod(tile_counts(*part.mesh.mask.shape, profile.tile)) * LUT_BITS
    if room < error.shape[1] * min(size.bits for size in sizes):
        return None
    return layout(error, sizes, room, least_gain(part.mesh))


def _bits(placed: Layout | None, part: _Part, share: float, profile: Profile) -> float:
    """Of a part's textures and table; about, where it becomes a smaller lightmap."""
    size = part.mesh.mask.shape
    if placed is None:
        return share * part.texels * SOURCE_BITS
    table = tile_counts(*size, profile.tile)
    second = placed.shapes[1:] or ((0, 0),)
    return part.texels * SOURCE_BITS * (1.0 - compression_ratio(placed.shapes[0], table, size, profile.colour, *second))


def _by_part(
    samples: list[tuple[np.ndarray, torch.Tensor, torch.Tensor]], parts: list[_Part]
) -> list[list[tuple[np.ndarray, torch.Tensor, torch.Tensor]]]:
    """What `solved` has of all tiles, for each part with its own numbers of tiles."""
    ends = np.array([part.tiles.stop for part in parts])
    result: list[list[tuple[np.ndarray, torch.Tensor, torch.Tensor]]] = [[] for _ in parts]
    for members, values, weight in samples:
        owner = np.searchsorted(ends, members, side="right")
        for number in np.unique(owner).tolist():
            at = np.flatnonzero(owner == number)
            rows = torch.from_numpy(at).to(values.device)
            result[number].append((members[at] - parts[number].tiles.start, values[rows], weight[rows]))
    return result
