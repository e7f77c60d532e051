"""Atlas models of random numbers, for tests that only write or read them; and groups of triangles."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from builders.resigned import GONE, rewrite

from wlm.atlas import codec
from wlm.atlas.cascade.cluster import Clusters
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import (
    AtlasModel,
    Profile,
    SheetPlace,
    first_block_code,
    pack_entries,
    pack_tiles,
    snapped,
    tile_counts,
)
from wlm.atlas.stored import store

KINDS = ("tiles", "cascade", "plain", "plain with uv")
MIXED = "tiles mixed"
"""Tiles in two textures; it has no other colour."""


def random_model(scene: LightmappedScene, kind: str, colour: str = "half", seed: int = 0, tile: int = 7) -> AtlasModel:
    """Makes a model of one of `KINDS` or `MIXED`, for a scene of one sheet."""
    random = np.random.default_rng(seed)
    (sheet,) = scene.sheets
    size = sheet.mask.shape
    method, colour = kind.split(maxsplit=1)[0], "mixed" if kind == MIXED else colour
    profile = Profile(name="random", method="tiles" if method == "tiles" else "cascade", tile=tile, colour=colour)
    shape = (18, 23)
    texels, lut = random.random((*shape, 3)) * 3.0, np.empty((0, 0, 2), np.uint16)
    second = {}
    if method == "tiles":
        counts = tile_counts(*size, tile)
        side = random.integers(1, tile + 2, (*counts, 2))
        first, blocks = random.integers(0, np.array(shape[::-1]) - side + 1), False
        if colour in ("bc6h", "astc"):
            whole = random.integers(1, 4, (*counts, 2))
            first, side, blocks = 4 * random.integers(0, np.array(shape[::-1]) // 4 - whole + 1), 4 * whole, True
        elif colour == "mixed":
            encoded = quantise(random.random((16, 20, 3)) * 3.0, "bc6h")
            second = {"blocks": encoded["blocks"], "block_texels": encoded["texels"]}
            blocks = random.random(counts) < 0.5
            whole = random.integers(1, 4, (*counts, 2))
            side = np.where(blocks[..., None], 4 * whole, side)
            first = np.where(blocks[..., None], 4 * random.integers(0, np.array([5, 4]) - whole + 1), first)
        lut = pack_entries(first, side, blocks, first_block_code(colour))
    elif method == "cascade":
        lut = random.integers(0, 65536, (9, 13, 2)).astype(np.uint16)
    triangles = len(sheet.triangle) if method == "cascade" or kind.endswith("uv") else 0
    uv = snapped(random.random((triangles, 3, 2)))
    place = SheetPlace(sheet.name, *size, 0, 0, *(tile_counts(*size, tile) if method == "tiles" else (0, 0)))
    settings = (scene.name, scene.source, profile, method, colour, scene.states, (place,))
    report = {"seconds": {"fit": 1.5}, "tiles": 4}
    textures = quantise(texels, "rgb9e5" if colour == "mixed" else colour) | second
    textures = {name: texture[None] for name, texture in textures.items()}
    return AtlasModel(*settings, **textures, lut=lut, uv=uv, stored=store(scene), report=report)


def off_borders(model: AtlasModel, uv: np.ndarray) -> np.ndarray:
    """Returns those of UVs [N, 2] that are on no border of tiles, where either tile may be read."""
    if model.method != "tiles":
        return uv
    place = (uv * model.sheets[0].size[::-1] - 0.5) / model.profile.tile
    return uv[np.abs(place - np.rint(place)).min(1) > 1e-4]


def shared_model(scene: LightmappedScene, seed: int = 0, separate: bool = False) -> AtlasModel:
    """Makes a model of shared or separate tiles in RGB9E5, for a scene of any sheets and states."""
    random, tile = np.random.default_rng(seed), 7
    states, places, row = len(scene.states), [], 0
    for _ in range(states if separate else 1):
        for sheet in scene.sheets:
            counts = tile_counts(*sheet.mask.shape, tile)
            places.append(SheetPlace(sheet.name, *sheet.mask.shape, row, 0, *counts))
            row += counts[0]
    shape = row, max(place.columns for place in places)
    count = np.ones(shape, int) if separate else random.integers(0, 4, shape)
    size = random.integers(1, tile + 2, (*shape, 2))
    first = random.integers(0, 8, (*shape, 2))
    lut = pack_tiles(first, size, 4 * random.integers(0, 2, shape), count, random.integers(0, 2, shape))
    texels = quantise(random.random((32, 40, 3)) * 3.0, "rgb9e5")["texels"].reshape(2, 16, 40, 3)
    profile = Profile(name="random", colour="rgb9e5", tile=tile)
    sheets = len(scene.sheets)
    return AtlasModel(
        scene.name,
        scene.source,
        profile,
        "shared",
        "rgb9e5",
        scene.states,
        tuple(places[:sheets]),
        texels,
        lut,
        factor=(random.random((states, 8, 3)) - 0.3).astype(np.float32),
        later=tuple(places[sheets:]),
        stored=store(scene),
    )


def save_plainly(model: AtlasModel, path: Path) -> None:
    """Saves a model with no part as a frame, so that tests can change its numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "pack_parts", lambda parts: (parts, {}))
        model.save(path)
    rewrite(path, {"parts": GONE})


def grouped(representative: Sequence[int], order: Sequence[int] | None = None) -> Clusters:
    """Groups by each triangle's representative and, if not all 0, its order."""
    heads, group = np.unique(representative, return_inverse=True)
    count = len(representative)
    return Clusters(
        group.astype(np.int32),
        heads.astype(np.int32),
        np.zeros(count, np.int8) if order is None else np.array(order, np.int8),
        np.zeros(count),
        np.zeros(count, bool),
    )
