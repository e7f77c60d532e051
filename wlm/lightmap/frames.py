"""Tiles stored as frames: the lightmap of each time as plain BC7, where a network would not be smaller.

A frame holds levels between the least and the greatest colour of its tile, channel and time, in gamma space:

    colour = least + level (greatest - least),     radiance = colour ** gamma

as an engine's own BC7 does, so that a set of few times is never worse than that. Unlike a network's maps it costs the
same for each time more.
"""

import importlib.util
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from wlm.formats.bc7 import blocks_image
from wlm.formats.bc7_modes import decode_blocks, encode_image
from wlm.formats.block_reuse import by_block, reuse_in_order
from wlm.lightmap.frame_packing import BLOCKS, clear_unneeded, needed_blocks
from wlm.lightmap.model import Profile
from wlm.lightmap.tiles import TILE, TileKind

EXTRA = "frames"
"""The extra with the encoder."""

_ENCODER = "ispc_texcomp"
# Some bilinear reads reach the texels next to a chart.
_RING_WEIGHT = 0.25
_WINDOW = 1024  # blocks that one may repeat: a tile's


def missing_encoder(count: int) -> str | None:
    """What to tell of `count` tiles that would be stored as frames; None where the encoder is there."""
    if importlib.util.find_spec(_ENCODER) is not None:
        return None
    tiles = "1 tile" if count == 1 else f"{count} tiles"
    return (
        f"{tiles} would be smaller and better as BC7 frames, but {_ENCODER} is missing, so networks are fitted "
        f"to them; needs the extra: pip install 'wlm[{EXTRA}]'"
    )


def choose_frames(
    kinds: np.ndarray, numbers: Sequence[int] | np.ndarray, mask: np.ndarray, times: int, profile: Profile
) -> np.ndarray:
    """Says which tiles are stored as frames or video, see `Profile.frames`.

    Args:
        kinds: int [N], from `wlm.lightmap.tiles.classify`.
        numbers: Of the N tiles in the grid.
        mask: bool [H, W], the map's valid texels.
        times: T.
        profile: The settings.

    Returns:
        bool [N].
    """
    chosen = np.isin(kinds, (TileKind.STATIC, TileKind.DYNAMIC))
    if profile.frames == "auto":
        for i in np.flatnonzero(chosen):
            share = needed_blocks(mask, int(numbers[i])).mean()
            network = profile.tile_bytes(bool(kinds[i] == TileKind.DYNAMIC)) - (1.0 - share) * TILE * TILE
            chosen[i] = profile.frames_bytes(times, share) <= network
    return chosen & (profile.frames != "never")


def encode_frames(
    colour: np.ndarray, valid: np.ndarray, needed: np.ndarray, loss: float
) -> tuple[np.ndarray, np.ndarray]:
    """Encodes the frames of a tile.

    Args:
        colour: float32 [T, 128, 128, 3], in gamma space, gaps filled.
        valid: bool [128, 128].
        needed: bool [32, 32], from `needed_blocks`.
        loss: Of rate-distortion optimisation (`wlm.formats.block_reuse`): what the root mean square error of a block's
            seen texels may grow by, in squares, in levels of 255; 0 for none.

    Returns:
        Blocks uint8 [T, 32, 32, 16], and ranges half [T, 2, 3], least and greatest.

    Raises:
        WlmError: The encoder is missing.
    """
    texels = colour[:, valid]
    ranges = np.stack([round_half(texels.min(1), -np.inf), round_half(texels.max(1), np.inf)], 1)
    least, greatest = ranges.astype(np.float32).swapaxes(0, 1)[:, :, None, None]
    span = np.where(greatest > least, greatest - least, np.float32(1.0))
    levels = np.clip((colour - least) / span, 0.0, 1.0).reshape(-1, TILE, 3)
    blocks = encode_image((levels * 255.0 + 0.5).astype(np.uint8), EXTRA)
    if loss > 0.0:
        ring = binary_dilation(valid, np.ones((3, 3), bool))
        weight = np.where(valid, 1.0, np.where(ring, _RING_WEIGHT, 0.0)).astype(np.float32)
        weight = np.tile(np.repeat(weight[..., None], 3, axis=2), (len(colour), 1, 1))
        decoded = blocks_image(decode_blocks(blocks))[..., :3] / np.float32(255.0)
        kept = np.tile(needed, (len(colour), 1))
        images = decoded, levels, weight, weight * np.float32(loss / 255.0) ** 2
        values = (by_block(image)[kept.ravel()] for image in images)
        blocks[kept] = reuse_in_order(blocks[kept], *values, _WINDOW)
    return clear_unneeded(blocks.reshape(len(colour), BLOCKS, BLOCKS, -1), needed), ranges


def round_half(values: np.ndarray, toward: float) -> np.ndarray:
    """Rounds to half floats that are not past the values on the wrong side.

    Args:
        values: Any shape.
        toward: Infinity for bounds from above, minus infinity for bounds from below.
    """
    nearest = values.astype(np.float16)
    wrong = nearest > values if toward < 0 else nearest < values
    return np.where(wrong, np.nextafter(nearest, np.float16(toward)), nearest)
