"""What a compressed lightmap of a mesh is compared with (lightmap-uv-clustering-cascade, sections 4.3 and 4.4).

A budget is a share of the lightmap's bits at 48 a texel, 1 - CR of eq. 9. Each method gives the best that it has within
the share; its `bytes` are those of all that a decoder needs but the UVs, which cost nothing in eq. 9, and `decoded`
is a `Sampler` of `wlm.atlas.evaluation`. Charts are dilated from the nearest texel before anything is resized.

Our tiles leave out the gaps between charts, so a texture of a rival costs no more than the texels or blocks that its
charts read: as if a packer had put them side by side without any loss.

The paper's DownSampling is "bilinear", and in half floats. RGB9E5 has half their bits on a GPU and little more error.
The smaller texture that has the least squares where it is read at the charts'
texels takes a few tenths of a second more, and on 18 lightmaps of 512² at a share of 0.17 it is 1.7 dB above bilinear
reading, 1.5 dB above Lanczos and 2.0 dB above a box filter; so it is `downsampling` unless told otherwise.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from benchmarks.rivals.atlas_carving import carving
from benchmarks.rivals.atlas_colours import single_colour
from benchmarks.rivals.atlas_share import budget_bits, read_blocks
from benchmarks.rivals.rival import Rival
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.evaluation import Score, compare
from wlm.atlas.model import COLOUR_BITS, SOURCE_BITS, TEXELS, AtlasModel
from wlm.atlas.resize import FILTERS, resize
from wlm.formats import hdr_blocks
from wlm.ops import raster

_BLOCK_BITS = 128
_BC6H = (4, 4)
_EXTRA = "baselines"


def share_of(rival: Rival, mesh: LightmappedMesh) -> float:
    """The bits of a rival over the lightmap's at 48 a texel."""
    return rival.bytes * 8 / (mesh.mask.size * SOURCE_BITS)


def evaluate_rivals(
    model: AtlasModel, mesh: LightmappedMesh, names: Sequence[str] = ("downsampling",), **options: Any
) -> list[tuple[Rival, Score]]:
    """Scores rivals of as many bits as a model.

    Args:
        model: It says how many bits.
        mesh: The mesh with its original lightmap.
        names: Keys of `RIVALS`.
        options: As for `wlm.atlas.evaluation.compare`.

    Raises:
        WlmError, ValueError: As `compare` or the rival.
    """
    bits = round((1.0 - model.compression_ratio) * mesh.mask.size * SOURCE_BITS)
    # Half a bit more, so that rounding takes none away.
    rivals = [RIVALS[name](mesh, (bits + 0.5) / (mesh.mask.size * SOURCE_BITS)) for name in names]
    scores = compare(mesh, {rival.name: rival.decoded for rival in rivals}, **options)
    return [(rival, scores[rival.name]) for rival in rivals]


def downsampling(mesh: LightmappedMesh, share: float, filter: str = "fit") -> Rival:
    """The lightmap at a lower resolution in RGB9E5, read bilinearly.

    Args:
        mesh: The mesh and its lightmap.
        share: The budget; at 2/3 and above the lightmap keeps its size, and is exact but for rounding to 9 bits.
        filter: "fit", "bilinear", "box" or "lanczos", see `wlm.atlas.resize`.

    Raises:
        ValueError: No such filter, or a share that has no room for one texel.
    """
    start = time.perf_counter()
    (height, width), count = _fitting_size(mesh, share, (1, 1), COLOUR_BITS[TEXELS])
    texels = quantise(resize(mesh.lightmap, mesh.mask, height, width, filter), TEXELS)["texels"]
    name = "downsampling" if filter == "fit" else f"downsampling {filter}"
    return _texture(name, texels, count * COLOUR_BITS[TEXELS] // 8, start)


def block_codec(mesh: LightmappedMesh, share: float, codec: str) -> Rival:
    """The lightmap in blocks of 16 bytes, at the highest resolution, up to its own, whose blocks are within the budget.

    Args:
        mesh: The mesh and its lightmap.
        share: The budget.
        codec: "bc6h", by Intel's encoder at its second best setting; "bc6h own", by ours; or "astcWxH" with one of
            `hdr_blocks.ASTC_BLOCKS`, "astc6x5" for example.

    Raises:
        ValueError: No such codec, or a share that has no room for one block.
        WlmError: A package is missing; the line names the extra.
    """
    sides = {f"astc{w}x{h}": (w, h) for w, h in hdr_blocks.ASTC_BLOCKS} | {"bc6h": _BC6H, "bc6h own": _BC6H}
    if codec not in sides:
        raise ValueError(f"codec: expected bc6h, bc6h own or astc with a block such as astc6x5, got {codec!r}")
    start, block = time.perf_counter(), sides[codec]
    (height, width), count = _fitting_size(mesh, share, block, _BLOCK_BITS)
    half = resize(mesh.lightmap, mesh.mask, height, width).astype(np.float16)
    if codec == "bc6h own":
        decoded = quantise(half.astype(np.float32), "bc6h")["texels"]
    elif codec == "bc6h":
        padded = np.pad(half, ((0, -height % block[1]), (0, -width % block[0]), (0, 0)), mode="edge")
        data = hdr_blocks.encode_bc6h(padded, "slow", _EXTRA)
        decoded = hdr_blocks.decode_bc6h(data, *padded.shape[:2], _EXTRA)[:height, :width]
    else:
        coder = hdr_blocks.astc(block, hdr_blocks.ASTC_MEDIUM, _EXTRA)
        data = coder.encode(half)
        decoded = coder.decode(data, height, width)
    return _texture(codec, decoded, count * _BLOCK_BITS // 8, start)


def best_astc(mesh: LightmappedMesh, share: float) -> Rival:
    """ASTC with the smallest blocks that hold the lightmap at its own size within the budget, else `astc12x12`.

    Resizing a lightmap by little costs more than larger blocks do.
    """
    most = share * mesh.mask.size * SOURCE_BITS / _BLOCK_BITS
    fitting = ((w, h) for w, h in hdr_blocks.ASTC_BLOCKS if _read_blocks(mesh, mesh.mask.shape, (w, h)) <= most)
    w, h = next(fitting, hdr_blocks.ASTC_BLOCKS[-1])
    return block_codec(mesh, share, f"astc{w}x{h}")


def _fitting_size(
    mesh: LightmappedMesh, share: float, block: tuple[int, int], bits: int
) -> tuple[tuple[int, int], int]:
    """A large size of the lightmap's shape, up to its own, whose blocks (width, height) that charts read are within the
    budget; and the number of these blocks."""
    most = budget_bits(mesh, share) // bits
    longest = max(mesh.mask.shape)

    def size(side: int) -> tuple[int, int]:
        rows, columns = (max(1, round(side * texels / longest)) for texels in mesh.mask.shape)
        return rows, columns

    # From there on by halves: hardly any size needs more blocks than a larger one.
    low, high = 0, longest
    while low < high:
        middle = (low + high + 1) // 2
        if _read_blocks(mesh, size(middle), block) <= most:
            low = middle
        else:
            high = middle - 1
    if low == 0:
        raise ValueError(f"share: {share} of {mesh.mask.shape} texels has no room for {bits} bits")
    return size(low), _read_blocks(mesh, size(low), block)


def _read_blocks(mesh: LightmappedMesh, size: tuple[int, int], block: tuple[int, int]) -> int:
    """How many blocks (width, height) of a texture of a size are read at the centres of the charts' texels."""
    place = np.argwhere(mesh.mask) + 0.5
    return read_blocks(place * (np.array(size) / mesh.mask.shape) - 0.5, size, block)


def _texture(name: str, texels: np.ndarray, bytes: int, start: float) -> Rival:
    """A rival that is a texture under the lightmap's UVs."""
    image = np.ascontiguousarray(texels, np.float32)

    def sample(uv: torch.Tensor, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
        return raster.texture(torch.tensor(image, device=uv.device), uv)

    return Rival(name, bytes, time.perf_counter() - start, None, sample, size=texels.shape[:2])


RIVALS: dict[str, Callable[[LightmappedMesh, float], Rival]] = {
    "downsampling": downsampling,
    **{f"downsampling {name}": functools.partial(downsampling, filter=name) for name in FILTERS if name != "fit"},
    **{
        name: functools.partial(block_codec, codec=name)
        for name in ("bc6h", "bc6h own", "astc4x4", "astc6x6", "astc8x8")
    },
    "astc": best_astc,
    "carving": carving,
}
"""By name: a mesh and a share to the rival."""

OWN_SIZE: dict[str, Callable[[LightmappedMesh], Rival]] = {"single colour": single_colour}
"""By name, those that have no budget: a mesh to the rival."""
