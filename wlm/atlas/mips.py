"""Mips of an atlas of tiles: a small lightmap for what is far away.

Tiles that are neighbours in the lightmap aren't in T_p, so that its own mips would mix what doesn't belong together. In
place of them the tail is the lightmap at a quarter of its resolution with all smaller levels, one texture of BC6H under
the mesh's own UVs. With `lod` the octaves of the lightmap's texels along a pixel, light is

    mix(tiles, tail, clamp(lod - 1, 0, 1)),    the tail read at its own level lod - 2,

which has no step: up to 1, where a bilinear read still meets all texels, it is the tiles', from 2 on the tail's. The
tail takes 1.4% of the lightmap's bits.
"""

import numpy as np
import torch

from wlm.atlas import colour
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import BLOCKS, TAIL_OCTAVES, tail_blocks, tail_shapes
from wlm.atlas.resize import box
from wlm.ops.raster import texture
from wlm.texels import fill_gaps


def make_tail(mesh: LightmappedMesh, device: str = "cpu") -> np.ndarray:
    """Makes the tail of a lightmap.

    A texel is the mean of those of the mask that it covers; one that covers none has the nearest's.

    Args:
        mesh: The mesh.
        device: "cpu" or "cuda:N".

    Returns:
        uint8 [B, 16], blocks of BC6H, level by level.
    """
    share = torch.from_numpy(mesh.mask).double()[..., None]
    sums = torch.cat([torch.from_numpy(mesh.lightmap).double() * share, share], 2).to(device)
    blocks = []
    for shape in tail_shapes(*mesh.mask.shape):
        sums = box(sums, *shape)
        values = sums.cpu().numpy()
        weight = values[..., 3]
        light = fill_gaps(values[..., :3] / np.maximum(weight, 1e-9)[..., None], weight > 1e-9)
        blocks.append(colour.encode(light, BLOCKS, weight, device)[0])
    return np.concatenate(blocks)


class Tail:
    """A tail on a device."""

    def __init__(self, blocks: np.ndarray, height: int, width: int, device: str) -> None:
        """Decodes a tail.

        Args:
            blocks: As of `make_tail`.
            height, width: Of the lightmap.
            device: "cpu" or "cuda:N".
        """
        self._levels, begin = [], 0
        for shape in tail_shapes(height, width):
            end = begin + tail_blocks(*shape)
            light = colour.decode(blocks[begin:end], *shape, BLOCKS)
            self._levels.append(torch.from_numpy(light).to(device))
            begin = end

    def read(self, uv: torch.Tensor, lod: torch.Tensor) -> torch.Tensor:
        """Reads light between two levels.

        Args:
            uv: float32 [N, 2].
            lod: float32 [N], octaves of the lightmap; up to 2 the tail's first level.

        Returns:
            float32 [N, 3].
        """
        place = (lod - TAIL_OCTAVES).clamp(0, len(self._levels) - 1)
        low = place.floor().long()
        light = torch.zeros((len(uv), 3), device=uv.device)
        for number, level in enumerate(self._levels):
            # Of its weight, that of the level above or below is the rest.
            weight = torch.where(low == number, 1.0 - (place - low), torch.where(low + 1 == number, place - low, 0.0))
            at = torch.nonzero(weight)[:, 0]
            if len(at):
                light[at] += weight[at, None] * texture(level, uv[at].contiguous())
        return light
