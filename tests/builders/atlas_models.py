"""Atlas models of random numbers, for tests of what only writes or reads them; and groups of triangles."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from builders.resigned import GONE, rewrite

from wlm.atlas import codec
from wlm.atlas.cluster import Clusters, Stats
from wlm.atlas.colour import quantise
from wlm.atlas.corners import snapped
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import MOST_SIZE, AtlasModel, Profile, first_block_code, pack_entries, tile_counts

KINDS = ("tiles", "cascade", "plain", "plain with uv")
MIXED = "tiles mixed"
"""Tiles in two textures; it has no other colour."""
WIDE = "tiles wide"
"""Tiles in BC6H, in a texture with more texels along a side than an entry can name: it names blocks."""


def random_model(mesh: LightmappedMesh, kind: str, colour: str = "half", seed: int = 0, tile: int = 7) -> AtlasModel:
    """Makes a model of one of `KINDS`, `MIXED` or `WIDE`, for a mesh."""
    random = np.random.default_rng(seed)
    height, width = mesh.mask.shape
    method, colour = kind.split()[0], {MIXED: "mixed", WIDE: "bc6h"}.get(kind, colour)
    profile = Profile(name="random", method="tiles" if method == "tiles" else "cascade", tile=tile, colour=colour)
    shape = (16, MOST_SIZE + 4) if kind == WIDE else (18, 23)
    texels, lut = random.random((*shape, 3)) * 3.0, np.empty((0, 0, 2), np.uint16)
    second = {}
    if method == "tiles":
        counts = tile_counts(height, width, tile)
        size = random.integers(1, tile + 2, (*counts, 2))
        first, blocks = random.integers(0, np.array(shape[::-1]) - size + 1), False
        if kind == WIDE:
            whole = random.integers(1, 4, (*counts, 2))
            first, size, blocks = 4 * random.integers(0, np.array(shape[::-1]) // 4 - whole + 1), 4 * whole, True
        elif colour == "mixed":
            encoded = quantise(random.random((16, 20, 3)) * 3.0, "bc6h")
            second = {"blocks": encoded["blocks"], "block_texels": encoded["texels"]}
            blocks = random.random(counts) < 0.5
            whole = random.integers(1, 4, (*counts, 2))
            size = np.where(blocks[..., None], 4 * whole, size)
            first = np.where(blocks[..., None], 4 * random.integers(0, np.array([5, 4]) - whole + 1), first)
        lut = pack_entries(first, size, blocks, first_block_code(colour, shape))
    elif method == "cascade":
        lut = random.integers(0, 65536, (9, 13, 2)).astype(np.uint16)
    triangles = len(mesh.triangle) if method == "cascade" or kind.endswith("uv") else 0
    uv = snapped(random.random((triangles, 3, 2)))
    settings = (mesh.name, mesh.source, profile, method, colour, height, width)
    report = {"seconds": {"fit": 1.5}, "tiles": 4}
    textures = quantise(texels, "rgb9e5" if colour == "mixed" else colour) | second
    return AtlasModel(*settings, **textures, lut=lut, uv=uv, report=report)


def save_plainly(model: AtlasModel, path: Path) -> None:
    """As earlier versions did: no part is a stream, and corners are floats."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "deflated", lambda parts: (parts, {}))
        patch.setattr(codec, "encode_corners", lambda uv: {"uv": uv})
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
        Stats(0, 0),
    )
