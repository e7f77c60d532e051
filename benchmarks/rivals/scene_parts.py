"""Compresses each object of a scene in each lighting state alone, with the profile `standard`.

These lightmaps, called parts, are the rival of one model whose tiles all objects share: each part has its own tiles and
textures, and a share of the bits in proportion to its texels. All parts are fitted at once, and errors are weighted for
views of the whole scene.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.decode import Decoder
from wlm.atlas.fit import with_fallback
from wlm.atlas.model import BLOCKS, COLOUR_BITS, LUT_BITS, SOURCE_BITS, TEXELS, AtlasModel, Profile, tile_counts
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.fit import Tiles, composed_model, curves, cut, least_gain, solved
from wlm.atlas.tiles.layout import Layout, Size, layout, sizes_of
from wlm.atlas.views import Points
from wlm.atlas.weights import FineGrid
from wlm.interop import one_thread

_FORMATS = (TEXELS, BLOCKS)  # of the textures of the colours that scenes have
_TRIES, _CLOSE = 8, 1.005  # attempts to find the share that has the requested bits, and the ratio that is close enough


@dataclass(frozen=True, eq=False)
class _Part:
    """One object's lightmap in one lighting state, as a scene of its own, and the range of its tiles among all."""

    scene: LightmappedScene
    sheet: int
    tiles: slice


class SceneParts:
    """The compressed models of all parts of a scene.

    Attributes:
        models: The model of each part, by sheet and lighting state.
        share: The budget of each part, as a fraction of its lightmap's bits at 48 per texel.
    """

    def __init__(self, models: list[list[AtlasModel]], share: float, device: str) -> None:
        self.models, self.share = models, share
        self._decoders = [[Decoder(model, device) for model in of_sheet] for of_sheet in models]

    @property
    def bits(self) -> float:
        """The total number of bits of all textures."""
        models = (model for of_sheet in self.models for model in of_sheet)
        return sum(model.bits for model in models)

    def __call__(self, points: Points, state: int) -> torch.Tensor:
        """Returns the decoded light at surface points in one lighting state, as a `Sampler` does."""
        light = torch.zeros((len(points), 3), dtype=torch.float32, device=points.uv.device)
        for number in torch.unique(points.sheet).tolist():
            at = points.sheet == number
            light[at] = self._decoders[number][state].read(points.uv[at].contiguous())
        return light


def scene_parts(
    scene: LightmappedScene, weights: Sequence[np.ndarray], bits: float, colour: str = "mixed", device: str = "cpu"
) -> SceneParts:
    """Compresses each lightmap of a scene alone, with a share of the given bits.

    Args:
        scene: The scene.
        weights: Weights of the quarters of all texels, [2 H, 2 W] for each sheet, from `scene_weights`.
        bits: Total bits of all parts. The result has as many or a few more, as texture sizes allow, unless some parts
            become plain smaller lightmaps.
        colour: How colours are stored, in place of the setting of the profile `standard`.
        device: "cpu" or "cuda:N".

    Returns:
        The parts. A part is a plain smaller lightmap if that is no worse, or if tiles don't fit its share of the bits.
    """
    with one_thread(device):
        return _compressed(scene, weights, bits, Profile.load("standard").override({"colour": colour}), device)


def _compressed(
    scene: LightmappedScene, weights: Sequence[np.ndarray], bits: float, profile: Profile, device: str
) -> SceneParts:
    tiles, parts = _cut(scene, weights, profile, device)
    sizes = sizes_of(profile)
    error = curves(tiles, sizes, Stages(device))
    share, tries = bits / (scene.texels * SOURCE_BITS), []
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
        grid, model = FineGrid(part.scene.sheets[0], device), None
        if each is not None:
            index = tiles.index[part.tiles].cpu().numpy()
            model = composed_model(part.scene, settings, samples[number], sizes, each, index, device)
        weight = torch.from_numpy(weights[part.sheet]).to(device)
        models[part.sheet].append(with_fallback(part.scene, grid, model, settings, weight))
    return SceneParts(models, share, device)


def _cut(
    scene: LightmappedScene, weights: Sequence[np.ndarray], profile: Profile, device: str
) -> tuple[Tiles, list[_Part]]:
    """Cuts all parts into tiles. The weights of each part add up to 1. Returns tiles and parts, sheet by sheet."""
    pieces, parts, first = [], [], 0
    for number, (sheet, weight) in enumerate(zip(scene.sheets, weights, strict=True)):
        for state, lightmap in zip(scene.states, sheet.lightmaps, strict=True):
            piece = cut(lightmap, weight, profile.tile, device)
            after = first + len(piece.index)
            alone = replace(scene, states=(state,), sheets=(replace(sheet, lightmaps=lightmap[None]),))
            parts.append(_Part(alone, number, slice(first, after)))
            pieces.append(piece)
            first = after
    together = (torch.cat([getattr(piece, name) for piece in pieces]) for name in ("index", "light", "weight"))
    return Tiles(*together, profile.tile), parts


def _placed(error: torch.Tensor, sizes: list[Size], part: _Part, share: float, profile: Profile) -> Layout | None:
    room = (
        share * part.scene.texels * SOURCE_BITS
        - math.prod(tile_counts(*part.scene.sheets[0].mask.shape, profile.tile)) * LUT_BITS
    )
    if room < error.shape[1] * min(size.bits for size in sizes):
        return None
    return layout(error, sizes, room, least_gain(FineGrid(part.scene.sheets[0], str(error.device))))


def _bits(placed: Layout | None, part: _Part, share: float, profile: Profile) -> float:
    """Returns the bits of a part's textures, or an estimate if the part becomes a plain smaller lightmap."""
    size = part.scene.sheets[0].mask.shape
    if placed is None:
        return share * part.scene.texels * SOURCE_BITS
    bits = math.prod(tile_counts(*size, profile.tile)) * LUT_BITS
    return bits + sum(
        math.prod(shape) * COLOUR_BITS[each] for shape, each in zip(placed.shapes, _FORMATS, strict=False)
    )


def _by_part(
    samples: list[tuple[np.ndarray, torch.Tensor, torch.Tensor]], parts: list[_Part]
) -> list[list[tuple[np.ndarray, torch.Tensor, torch.Tensor]]]:
    """Splits groups of tiles (their numbers, samples and weights) by parts; numbers the tiles of each part from 0."""
    ends = np.array([part.tiles.stop for part in parts])
    result: list[list[tuple[np.ndarray, torch.Tensor, torch.Tensor]]] = [[] for _ in parts]
    for members, values, weight in samples:
        owner = np.searchsorted(ends, members, side="right")
        for number in np.unique(owner).tolist():
            at = np.flatnonzero(owner == number)
            rows = torch.from_numpy(at).to(values.device)
            result[number].append((members[at] - parts[number].tiles.start, values[rows], weight[rows]))
    return result
