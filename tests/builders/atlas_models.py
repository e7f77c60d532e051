"""Atlas models of random numbers: as good as fitted ones for whoever only writes or reads them."""

import numpy as np

from wlm.atlas import colour as blocks_of
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import AtlasModel, Profile, pack_entries
from wlm.atlas.tiles import tile_counts

KINDS = ("tiles", "cascade", "plain", "plain with uv")


def random_model(mesh: LightmappedMesh, kind: str, colour: str = "half", seed: int = 0, tile: int = 7) -> AtlasModel:
    """Makes a model of one of ``KINDS`` for a mesh."""
    random = np.random.default_rng(seed)
    height, width = mesh.mask.shape
    method = kind.split()[0]
    profile = Profile(name="random", method="tiles" if method == "tiles" else "cascade", tile=tile, colour=colour)
    texels, lut = random.random((18, 23, 3)) * 3.0, np.empty((0, 0, 2), np.uint16)
    if method == "tiles":
        counts = tile_counts(height, width, tile)
        size = random.integers(1, tile + 2, (*counts, 2))
        lut = pack_entries(random.integers(0, np.array([23, 18]) - size + 1), size)
    elif method == "cascade":
        lut = random.integers(0, 65536, (9, 13, 2)).astype(np.uint16)
    own = method == "cascade" or kind.endswith("uv")
    uv = random.random((len(mesh.triangle), 3, 2)).astype(np.float32) if own else np.empty((0, 3, 2), np.float32)
    blocks = np.empty((0, 16), np.uint8)
    if colour != "half":
        blocks, texels = blocks_of.encode(texels, colour)
    texels = texels.astype(np.float16)
    report = {"seconds": {"fit": 1.5}, "tiles": 4}
    return AtlasModel(mesh.name, mesh.source, profile, method, colour, height, width, texels, blocks, lut, uv, report)
