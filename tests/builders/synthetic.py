"""Lightmap models of random maps and networks, for tests that only decode."""

import numpy as np

from wlm.formats.bc7 import pack_mode6
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm_kernels import mlp


def random_model(*args, **options) -> LightmapModel:
    """Makes a model with one sheet, see `random_sheet`."""
    sheet = random_sheet(*args, **options)
    return LightmapModel("random", "0123456789abcdef", sheet.profile, {LIGHT: sheet})


def random_sheet(
    kinds=(3, 3, 1, 0), columns=2, times=(0.0, 7.5, 13.0, 19.0), period=24.0, seed=0, mask=None, **settings
) -> SheetModel:
    """Makes a sheet with tiles of these kinds, `columns` in a row; without a `mask` it has no gaps."""
    rng = np.random.default_rng(seed)
    sizes = {"hidden": 8, "uvt_resolution": 8, "uvt_slices": 3}
    profile = Profile(name="random", **sizes | settings).for_times(len(times))
    kind = np.array(kinds, np.uint8)
    rows = len(kind) // columns
    dynamic, constant = (int((kind == k).sum()) for k in (3, 1))
    r = profile.uvt_resolution // 4
    # The map ends inside its last row and column of tiles.
    height, width = rows * 128 - 20, columns * 128 - 9
    assert TileGrid.of(height, width).count == len(kind) and max(kinds) <= max(TileKind)

    def blocks(*shape):
        lowest = rng.integers(0, 2, (*shape, 2, 1))
        ends = (rng.integers(0, 128, (*shape, 2, 4)) * 2 + lowest).astype(np.uint8)
        return pack_mode6(ends, rng.integers(0, 16, (*shape, 16), np.uint8))

    plane = (dynamic, profile.plane_rows, profile.plane_columns, 2)
    affine = np.stack([rng.uniform(0.8, 1.2, (dynamic, 3)), rng.uniform(0.1, 0.3, (dynamic, 3))], axis=1)
    net = rng.standard_normal((dynamic, mlp.parameter_count(16, profile.hidden))) * profile.hidden**-0.5
    # A channel's code 0 is black at that time; the bound, 255, is far above every mean.
    scale = rng.integers(86, 161, (dynamic, len(times), 3), np.uint8)
    scale[:1, -1, 2] = 0
    mask = np.ones((height, width), bool) if mask is None else mask
    framed = np.flatnonzero(kind == TileKind.FRAMES)
    frames = any_blocks(len(framed), len(times), 32, 32, seed=seed)
    ranges = np.sort(rng.uniform(0.0, 1.5, (len(framed), len(times), 2, 3)), axis=2)
    return SheetModel(
        name="random",
        width=width,
        height=height,
        times=np.array(times, np.float64),
        period=period,
        profile=profile,
        mask=mask,
        kind=kind,
        uv=blocks(dynamic, 32, 32),
        uvt=blocks(dynamic, profile.uvt_slices, r, r),
        ut=rng.integers(0, 256, plane, np.uint8),
        vt=rng.integers(0, 256, plane, np.uint8),
        net=net.astype(np.float16),
        scale=scale,
        peak=rng.integers(161, 191, (dynamic, len(times)), np.uint8),
        affine=affine.astype(np.float16),
        constant=rng.uniform(0.0, 3.0, (constant, len(times), 3)).astype(np.float16),
        frames=frames,
        ranges=ranges.astype(np.float16),
    )


def any_blocks(*shape, seed=0) -> np.ndarray:
    """Random BC7 blocks uint8 [*shape, 16], as many of each mode: any bits are a block once the mode's are set."""
    blocks = np.random.default_rng(seed).integers(0, 256, (*shape, 16), np.uint8)
    mode = (np.arange(blocks[..., 0].size) % 8).reshape(shape)
    blocks[..., 0] = (blocks[..., 0] & ~((2 << mode) - 1) & 255) | 1 << mode
    return blocks
