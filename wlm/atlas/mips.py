"""Mips of one lightmap, the tail: a small lightmap for surfaces that are far away.

Neighbours in the lightmap are not neighbours in T_p, so mip levels of T_p would mix unrelated texels. Instead, the tail
is the lightmap at a quarter of its resolution with all smaller levels, one texture under the mesh's own UVs, in BC6H
blocks, or in ASTC blocks if T_p is ASTC. With `lod`, the base-2 logarithm of lightmap texels per pixel, light is

    mix(tiles, tail, clamp(lod - 1, 0, 1)),    the tail read at its own level lod - 2,

which is continuous: up to lod 1, where a bilinear read still reaches all texels, light comes from the tiles, and from
lod 2 on from the tail. The tail takes 1.4% of the lightmap's bits.
"""

import numpy as np
import torch
from torch.nn.functional import pad

from wlm.atlas import colour
from wlm.atlas.data import Sheet
from wlm.atlas.model import TAIL_OCTAVES, tail_blocks, tail_shapes, tail_share
from wlm.atlas.resize import box
from wlm.ops.raster import texture
from wlm.texels import fill_gaps


def make_tail(sheet: Sheet, codec: str, device: str = "cpu") -> np.ndarray:
    """Makes the tail of a lightmap.

    Args:
        sheet: The sheet, of one state.
        codec: `tail_codec`.
        device: "cpu" or "cuda:N".

    Returns:
        uint8 [B, 16], blocks, level by level.

    Raises:
        WlmError: A package for ASTC is missing.
    """
    levels = tail_light(sheet.lightmap, sheet.mask, device)
    return np.concatenate([colour.encode(light, codec, weight, device)[0] for light, weight in levels])


def tail_light(light: np.ndarray, mask: np.ndarray, device: str = "cpu") -> list[tuple[np.ndarray, np.ndarray]]:
    """Computes the levels of a tail before they are stored.

    A texel is the mean of the mask texels that it covers; a texel that covers none takes the nearest one.

    Args:
        light: [H, W, 3].
        mask: bool [H, W].
        device: "cpu" or "cuda:N".

    Returns:
        For each of `tail_shapes` its light [h, w, 3] and the weights of its texels [h, w], float64.
    """
    shapes, levels = tail_shapes(*mask.shape), []
    share = torch.from_numpy(mask).double()[..., None]
    sums = torch.cat([torch.from_numpy(light).double() * share, share], 2)
    margin = [(size << TAIL_OCTAVES) - side for size, side in zip(shapes[0], mask.shape, strict=True)]
    sums = pad(sums, (0, 0, 0, margin[1], 0, margin[0])).to(device)
    for shape in shapes:
        sums = box(sums, *shape)
        values = sums.cpu().numpy()
        weight = values[..., 3]
        levels.append((fill_gaps(values[..., :3] / np.maximum(weight, 1e-9)[..., None], weight > 1e-9), weight))
    return levels


class Tail:
    """A tail on a device."""

    def __init__(self, blocks: np.ndarray, height: int, width: int, codec: str, device: str) -> None:
        """Decodes a tail.

        Args:
            blocks: uint8 [B, 16], from `make_tail`.
            height, width: Size of the lightmap.
            codec: `tail_codec`.
            device: "cpu" or "cuda:N".

        Raises:
            WlmError: A block isn't one of the format, or a package for ASTC is missing.
        """
        self._levels, begin = [], 0
        self._share = torch.tensor(tail_share(height, width)[::-1], device=device)
        for shape in tail_shapes(height, width):
            end = begin + tail_blocks(*shape)
            light = colour.decode(blocks[begin:end], *shape, codec)
            self._levels.append(torch.from_numpy(light).to(device))
            begin = end

    def read(self, uv: torch.Tensor, lod: torch.Tensor) -> torch.Tensor:
        """Reads light between two levels.

        Args:
            uv: float32 [N, 2], the mesh's original UVs.
            lod: float32 [N], mip level relative to the lightmap; values up to 2 read the tail's first level.

        Returns:
            float32 [N, 3].
        """
        uv = uv * self._share
        place = (lod - TAIL_OCTAVES).clamp(0, len(self._levels) - 1)
        low = place.floor().long()
        light = torch.zeros((len(uv), 3), device=uv.device)
        for number, level in enumerate(self._levels):
            # The adjacent level has the rest of the weight.
            weight = torch.where(low == number, 1.0 - (place - low), torch.where(low + 1 == number, place - low, 0.0))
            at = torch.nonzero(weight)[:, 0]
            if len(at):
                light[at] += weight[at, None] * texture(level, uv[at].contiguous())
        return light
