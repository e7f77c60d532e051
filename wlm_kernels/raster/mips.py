"""Reads of textures, also between their mip levels, and their backward pass.

A stack has all levels of a texture [H, W, C] one below the other: level l has max(H >> l, 1) rows and max(W >> l, 1)
columns, at the left. The stacks of several textures lie one below the other. A level between two integers reads both
levels and mixes them linearly; a level outside reads the first or the last one.

Addressing is that of `wlm_kernels.raster.texture`. A point whose coordinate or level reads NaN has no gradient and adds
none to the texture.

Read `benchmarks/plain.py` first (`texture`), which reads all levels at all points.
"""

import warp as wp

from wlm_kernels.raster.texture import NEAREST, Axis, add, axis_at, codes, read, read_slope

wp.set_module_options({"enable_backward": False})


@wp.struct
class _Stacks:
    """Sizes of the first level, number of levels, rows of a stack, and number of points that read each stack."""

    height: int
    width: int
    levels: int
    rows: int
    points: int


@wp.func
def _first_row(stacks: _Stacks, level: int) -> int:
    row = int(0)
    for each in range(level):
        row += wp.max(stacks.height >> each, 1)
    return row


@wp.func
def _columns(stacks: _Stacks, level: int, u: float, filter: int, boundary: int) -> Axis:
    return axis_at(u, wp.max(stacks.width >> level, 1), filter, boundary)


@wp.func
def _rows(stacks: _Stacks, i: int, level: int, v: float, filter: int, boundary: int) -> Axis:
    """Returns the rows, in all stacks, of point i."""
    y = axis_at(v, wp.max(stacks.height >> level, 1), filter, boundary)
    first = (i // stacks.points) * stacks.rows + _first_row(stacks, level)
    y.low += first
    y.high += first
    return y


@wp.func
def _between(stacks: _Stacks, level: wp.array1d[float], i: int):
    """Returns the two levels that point i reads, and the weight of the second: NaN if the point's level is."""
    if level.shape[0] == 0:
        return 0, 0, 0.0
    if wp.isnan(level[i]):
        return 0, 0, level[i]
    place = wp.clamp(level[i], 0.0, float(stacks.levels - 1))
    low = int(place)
    return low, wp.min(low + 1, stacks.levels - 1), place - float(low)


@wp.kernel
def _sample_one(
    # in:
    texture: wp.array3d[float],
    uv: wp.array1d[wp.vec2],
    filter: int,
    boundary: int,
    # out:
    out: wp.array2d[float],
):
    i = wp.tid()
    x = axis_at(uv[i][0], texture.shape[1], filter, boundary)
    y = axis_at(uv[i][1], texture.shape[0], filter, boundary)
    for c in range(texture.shape[2]):
        out[i, c] = read(texture, x, y, c)


@wp.kernel
def _sample(
    # in:
    texture: wp.array3d[float],
    stacks: _Stacks,
    uv: wp.array1d[wp.vec2],
    level: wp.array1d[float],
    filter: int,
    boundary: int,
    # out:
    out: wp.array2d[float],
):
    i = wp.tid()
    low, high, weight = _between(stacks, level, i)
    x = _columns(stacks, low, uv[i][0], filter, boundary)
    y = _rows(stacks, i, low, uv[i][1], filter, boundary)
    for c in range(texture.shape[2]):
        out[i, c] = read(texture, x, y, c)
    if weight != 0.0:
        x = _columns(stacks, high, uv[i][0], filter, boundary)
        y = _rows(stacks, i, high, uv[i][1], filter, boundary)
        for c in range(texture.shape[2]):
            out[i, c] = (1.0 - weight) * out[i, c] + weight * read(texture, x, y, c)


@wp.kernel
def _sample_backward(
    # in:
    texture: wp.array3d[float],
    stacks: _Stacks,
    uv: wp.array1d[wp.vec2],
    level: wp.array1d[float],
    filter: int,
    boundary: int,
    grad_out: wp.array2d[float],
    # out:
    grad_texture: wp.array3d[float],
    grad_uv: wp.array1d[wp.vec2],
    grad_level: wp.array1d[float],
):
    i = wp.tid()
    on_uv = wp.vec2()
    on_level = float(0.0)
    copies = grad_texture.shape[2] // texture.shape[2]
    low, high, weight = _between(stacks, level, i)
    if not wp.isnan(weight):
        for side in range(wp.where(high > low, 2, 1)):
            at = wp.where(side == 0, low, high)
            share = wp.where(side == 0, 1.0 - weight, weight)
            x = _columns(stacks, at, uv[i][0], filter, boundary)
            y = _rows(stacks, i, at, uv[i][1], filter, boundary)
            # At an integer the level counts as just above it, so that its slope is that towards the next level.
            moves = bool(False)
            if high > low:
                moves = level[i] >= 0.0 and not wp.isnan(x.weight) and not wp.isnan(y.weight)
            for c in range(texture.shape[2]):
                g = grad_out[i, c]
                if share != 0.0:
                    if grad_texture.shape[0] > 0:
                        add(grad_texture, x, y, c * copies + i % copies, share * g)
                    if filter != NEAREST:
                        on_uv += share * g * read_slope(texture, x, y, c)
                if moves:
                    on_level += wp.where(side == 0, -g, g) * read(texture, x, y, c)
    if grad_uv.shape[0] > 0:
        grad_uv[i] = on_uv
    if grad_level.shape[0] > 0:
        grad_level[i] = on_level


def _stacks(texture, size: tuple[int, int] | None, levels: int, uv) -> _Stacks:
    out = _Stacks()
    out.height, out.width = texture.shape[:2] if size is None else size
    out.levels = levels
    out.rows = sum(max(out.height >> level, 1) for level in range(levels))
    out.points = max(uv.shape[0] * out.rows // max(texture.shape[0], 1), 1)
    return out


def sample(
    texture, uv, out, *, size=None, levels: int = 1, level=None, filter: str = "linear", boundary: str = "clamp"
) -> None:
    """Reads textures at N points each, also between levels.

    Args:
        texture: float [B R, W, C], the stacks of B textures, R rows each.
        uv: vec2 [B N], any coordinates (u, v); the first N read the first texture, and so on.
        out: float [B N, C], written.
        size: H and W of the first level; None: of `texture`, which is one texture without further levels.
        levels: Number of levels.
        level: float [B N]; None: the first one.
        filter, boundary: Names, see `texture.codes`.
    """
    if size is None:
        # A quarter faster than by `_sample`.
        inputs = [texture, uv, *codes(filter, boundary)]
        wp.launch(_sample_one, uv.shape, inputs=inputs, outputs=[out], device=texture.device)
        return
    level = wp.empty(0, dtype=float, device=texture.device) if level is None else level
    inputs = [texture, _stacks(texture, size, levels, uv), uv, level, *codes(filter, boundary)]
    wp.launch(_sample, uv.shape, inputs=inputs, outputs=[out], device=texture.device)


def sample_backward(
    texture,
    uv,
    grad_out,
    grad_texture,
    grad_uv,
    grad_level=None,
    *,
    size=None,
    levels: int = 1,
    level=None,
    filter: str = "linear",
    boundary: str = "clamp",
) -> None:
    """Computes the gradients of textures, coordinates and levels from the gradient of a result of `sample`.

    The gradient of a coordinate is the slope between the texels that it reads, 0 at a clamped border and with the
    filter "nearest". A level has the slope between the two levels that it reads; 0 outside of the levels. On CUDA
    samples are added to `grad_texture` in any order, so that the last bits change from run to run.

    Args:
        texture, uv, size, levels, level, filter, boundary: Arguments of `sample`.
        grad_out: float [B N, C], gradient of the result.
        grad_texture: float [B R, W, C * K], to which the gradient is added; of shape [0, 0, 0] if it is not wanted. A
            channel has K sums, which the caller adds up: sample i adds to number i % K. With K = 32 the threads of a
            warp do not wait for one another where many samples read few texels.
        grad_uv: vec2 [B N], written; of shape [0] if it is not wanted.
        grad_level: float [B N], written; None or of shape [0] if it is not wanted.
    """
    none = wp.empty(0, dtype=float, device=texture.device)
    level, grad_level = (none if each is None else each for each in (level, grad_level))
    inputs = [texture, _stacks(texture, size, levels, uv), uv, level, *codes(filter, boundary), grad_out]
    outputs = [grad_texture, grad_uv, grad_level]
    wp.launch(_sample_backward, uv.shape, inputs=inputs, outputs=outputs, device=texture.device)
