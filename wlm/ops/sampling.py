"""Linear sampling of feature grids (planes, triplanes and volumes), with gradients for their values and the points.

A coordinate is in [0, 1], the centre of cell i of n at (i + 1/2) / n. Beyond the outermost centres the value is clamped
to the border and has no slope; a periodic axis repeats instead.

On CUDA a cell's gradient is summed over points in any order, so that the last bits change from run to run.
"""

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.interop import to_warp
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, check_index, on_stream, optional_array, zeros_for
from wlm_kernels import interpolate

REDUCTIONS = ("sum", "product", "concatenate")


@takes_arrays("values", "points")
def plane(
    values: torch.Tensor, points: torch.Tensor, *, layer: torch.Tensor | None = None, periodic: bool = False
) -> torch.Tensor:
    """Samples a plane of features bilinearly; the reference is `benchmarks.plain.plane`.

    Args:
        values: float [H, W, C], or [L, H, W, C] with `layer`; with a gradient.
        points: float [..., 2], u along the width, v along the height (the time, in a lightmap's planes;
            neural-dynamic-gi, eq. 5). Has a gradient: the slope between the adjacent cells.
        layer: int32 or int64 [...], 0 to L - 1: the index of each point's plane.
        periodic: Whether v wraps round: row 0 is the neighbour of row H - 1.

    Returns:
        float [..., C].

    Raises:
        ValueError: A tensor's shape, type or device doesn't fit, or a number isn't finite or in range. The check
            of numbers waits for the GPU and is skipped while a CUDA graph is captured.
    """
    return sample(values, points, layer, periodic, axes=2)


@takes_arrays("values", "points")
def volume(
    values: torch.Tensor, points: torch.Tensor, *, layer: torch.Tensor | None = None, periodic: bool = False
) -> torch.Tensor:
    """Samples a volume of features trilinearly; the reference is `benchmarks.plain.volume`.

    Args:
        values: float [D, H, W, C], or [L, D, H, W, C] with `layer`; with a gradient.
        points: float [..., 3], u along the width, v along the height, w along the depth; with a gradient.
        layer: int32 or int64 [...], 0 to L - 1: the index of each point's volume.
        periodic: Whether w wraps round.

    Returns:
        float [..., C].

    Raises:
        ValueError: See `plane`.
    """
    return sample(values, points, layer, periodic, axes=3)


@takes_arrays("xy", "xz", "yz", "points")
def triplane(
    xy: torch.Tensor, xz: torch.Tensor, yz: torch.Tensor, points: torch.Tensor, *, reduce: str = "sum"
) -> torch.Tensor:
    """Samples three planes at the projections of points in space; the reference is `benchmarks.plain.triplane`.

    Args:
        xy: float [H, W, C], u is x and v is y (the tri-plane of Chan et al. 2022, "Efficient Geometry-aware 3D
            Generative Adversarial Networks"); has a gradient, like `xz`, `yz` and `points`.
        xz: float [H', W', C], u is x and v is z.
        yz: float [H'', W'', C], u is y and v is z.
        points: float [..., 3], x, y, z in [0, 1].
        reduce: Combination of the three samples: "sum"; "product" (Fridovich-Keil et al. 2023, "K-Planes"); or
            "concatenate", in the order of the arguments, where C may differ between the planes.

    Returns:
        float [..., C]; with "concatenate" the last size is the sum of the three C.

    Raises:
        ValueError: See `plane`; or there is no such reduction.
    """
    if reduce not in REDUCTIONS:
        raise ValueError(f"reduce: expected one of {', '.join(REDUCTIONS)}, got {reduce!r}")
    check("xy", xy, (None, None, None))
    channels = None if reduce == "concatenate" else xy.shape[2]
    check("xz", xz, (None, None, channels), xy.device)
    check("yz", yz, (None, None, channels), xy.device)
    check("points", points, (..., 3), xy.device)
    x, y, z = points.unbind(-1)
    # The backward pass of a stack of columns is cheaper than that of indexing.
    projections = {"xy": (xy, x, y), "xz": (xz, x, z), "yz": (yz, y, z)}
    parts = [
        sample(values, torch.stack(at, -1), axes=2, names=(name, "points"))
        for name, (values, *at) in projections.items()
    ]
    if reduce == "concatenate":
        return torch.cat(parts, -1)
    return parts[0] * parts[1] * parts[2] if reduce == "product" else parts[0] + parts[1] + parts[2]


def sample(
    values: torch.Tensor,
    points: torch.Tensor,
    layer: torch.Tensor | None = None,
    periodic: bool = False,
    *,
    axes: int,
    names: tuple[str, str] = ("values", "points"),
) -> torch.Tensor:
    """Interpolates a grid of 2 or 3 `axes` linearly at points, [..., C]; messages call values and points by `names`."""
    check(names[0], values, (None,) * (axes + 1 if layer is None else axes + 2))
    if 0 in values.shape:
        raise ValueError(f"{names[0]}: expected at least one cell and one channel, got {tuple(values.shape)}")
    check(names[1], points, (..., axes), values.device)
    check_finite(**dict(zip(names, (values, points), strict=True)))
    shape = points.shape[:-1]
    if layer is None:
        layer = torch.empty(0, dtype=torch.int32, device=values.device)
    else:
        check_index("layer", layer, len(values), tuple(shape), values.device)
    times, width, channels = values.shape[-axes - 1], values.shape[-2], values.shape[-1]
    height = values.shape[-3] if axes == 3 else 1
    # Warp arrays have at most four dimensions, so layers are concatenated along the first axis.
    joined = values.reshape(-1, height, width, channels)
    sampled = _Sample.apply(joined, times, layer.reshape(-1).to(torch.int32), points.reshape(-1, axes), periodic)
    return sampled.reshape(*shape, channels)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, times, layer, points, periodic):
        out = values.new_empty(len(points), values.shape[3])
        with on_stream(values.device):
            arrays = to_warp(values), times, to_warp(layer), to_warp(points)
            interpolate.sample(*arrays, to_warp(out), periodic)
        ctx.save_for_backward(values, layer, points)
        ctx.times, ctx.periodic = times, periodic
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        values, layer, points = ctx.saved_tensors
        on_values = zeros_for(values, ctx.needs_input_grad[0])
        on_points = zeros_for(points, ctx.needs_input_grad[3])
        with on_stream(values.device):
            interpolate.sample_backward(
                to_warp(values),
                ctx.times,
                to_warp(layer),
                to_warp(points),
                to_warp(grad_out),
                optional_array(on_values, 4, wp.float32, values.device),
                optional_array(on_points, 2, wp.float32, values.device),
                ctx.periodic,
            )
        return on_values, None, None, on_points, None
