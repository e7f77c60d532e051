"""Rasterization, and attributes and textures at the surface point visible in each pixel.

Row 0 of an image is its top row. Of a batch of B meshes or cameras, which share the triangles, all tensors but the
triangles have a first axis of length B; every image equals, bit for bit, that of a call for it alone.
`wlm_kernels.raster.rasterize` defines pixel centres and coverage, and `wlm_kernels.raster.texture` defines texture
reads. On CUDA the gradients of several pixels for one value are summed in any order, so that its last bits change from
run to run.
"""

from dataclasses import dataclass

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.interop import to_warp, torch_memory
from wlm.ops import mips
from wlm.ops.tapes import NoGradientError, takes_arrays
from wlm.ops.tensors import check, check_index, dense, on_stream, optional_array, zeros_for
from wlm_kernels.raster import gradient as raster_gradient
from wlm_kernels.raster import rasterize as kernels
from wlm_kernels.raster.texture import codes


@dataclass(frozen=True)
class Raster:
    """The visible triangle of each pixel and the barycentrics of the surface point; of a batch, [B, H, W].

    Attributes:
        triangle: int32 [H, W], index of the visible triangle, -1 for none.
        barycentric: float [H, W, 2], the weights, in [0, 1], of the triangle's corners 0 and 1 at the visible point;
            corner 2 has 1 minus their sum. Has a gradient. 0 in uncovered pixels, like all fields below.
        depth: float [H, W], z / w; 0 everywhere in UV space. Has no gradient.
        derivative: float [H, W, 4], derivatives of the weights per pixel: du/dx, du/dy, dv/dx, dv/dy, x to the right
            and y down; None if not requested. Has no gradient.
        coverage: int32 [H, W], number of triangles that cover the pixel's centre, including hidden ones; None if not
            requested.
        count: Number F of the triangles that were drawn; None: unknown.
    """

    triangle: torch.Tensor
    barycentric: torch.Tensor
    depth: torch.Tensor
    derivative: torch.Tensor | None
    coverage: torch.Tensor | None
    count: int | None = None


@takes_arrays("clip")
def rasterize(
    clip: torch.Tensor,
    triangle: torch.Tensor,
    height: int,
    width: int,
    *,
    cull: bool = False,
    derivative: bool = False,
    coverage: bool = False,
) -> Raster:
    """Draws triangles given in clip space; the one of least z / w in front of the viewer (w > 0) is visible.

    There is no near and no far plane, and a triangle may reach behind the viewer. The first of several triangles of
    equal depth is visible. A triangle with a non-finite corner or without area isn't drawn.

    The meshes of a batch are drawn one after the other.

    Args:
        clip: float [V, 4], or [B, V, 4] for a batch, x, y, z, w; the image shows x/w and y/w in [-1, 1], y up. The
            barycentrics' gradient reaches x, y and w of the visible triangle; changes of visibility have no gradient
            here, and `antialias` gives those of silhouettes.
        triangle: int32 or int64 [F, 3], indices of the corners in `clip`, in either winding.
        height, width: H and W in pixels, 1 to 16,384.
        cull: Whether to leave out triangles whose corners run clockwise on the screen.
        derivative, coverage: Whether to compute these fields of `Raster`.

    Raises:
        ValueError: A tensor's shape, type, device or size doesn't fit, or a triangle has a corner that isn't in
            `clip`. The check of corners waits for the GPU; while a CUDA graph is captured it is skipped, and such
            triangles aren't drawn.
    """
    return _rasterize(clip, triangle, height, width, "clip", cull, derivative, coverage)


@takes_arrays("uv")
def rasterize_uv(
    uv: torch.Tensor,
    triangle: torch.Tensor,
    height: int,
    width: int,
    *,
    cull: bool = False,
    derivative: bool = False,
    coverage: bool = False,
) -> Raster:
    """Draws triangles into the texels of a texture; the first of several overlapping triangles is visible.

    Args:
        uv: float [V, 2] or [B, V, 2], u right, v down (glTF): the texture is [0, 1] x [0, 1], row 0 is v = 0, and texel
            i of n has its centre at (i + 1/2) / n. Parts outside aren't drawn. The barycentrics pass gradients to `uv`.
        triangle: int32 or int64 [F, 3], indices of the corners in `uv`.
        height, width: H and W in texels, 1 to 16,384.
        cull: Whether to leave out triangles whose corners run clockwise where u points right and v up.
        derivative, coverage: Whether to compute these fields of `Raster`.

    Raises:
        ValueError: See `rasterize`.
    """
    return _rasterize(uv, triangle, height, width, "uv", cull, derivative, coverage)


@takes_arrays("attribute", "raster.barycentric")
def interpolate(
    attribute: torch.Tensor, triangle: torch.Tensor, raster: Raster, *, derivatives: bool = False
) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
    """Interpolates vertex attributes at the visible point of each pixel; the result is 0 in uncovered pixels.

    Args:
        attribute: float [V, C], has a gradient. For a batch, [V, C] for all images or [B, V, C].
        triangle: int32 or int64 [F, 3], indices of the corners in `attribute`, for the triangles that were drawn; the
            indices may differ from those used for drawing.
        raster: Result of the rasterization; its barycentrics have a gradient.
        derivatives: Whether to return the attributes' derivatives too; the raster must have its own.

    Returns:
        float [H, W, C], or [B, H, W, C]; and with `derivatives` float [..., C, 2], the derivatives of each attribute
        per pixel to the right and down, which pass gradients to `attribute` alone.

    Raises:
        ValueError: See `rasterize`; or there are not as many triangles as were drawn, or the raster lacks derivatives.
    """
    batched = getattr(attribute, "ndim", 2) == 3
    check("attribute", attribute, (None, None, None) if batched else (None, None))
    triangle = _checked_triangles(triangle, attribute.shape[-2], attribute.device)
    visible, barycentric = raster.triangle, raster.barycentric
    if raster.count not in (None, len(triangle)):
        raise ValueError(f"triangle: expected the {raster.count} triangles that were drawn, got {len(triangle)}")
    images = (len(attribute),) if batched else (None,) * (barycentric.ndim - 3)
    check("raster.barycentric", barycentric, (*images, None, None, 2), attribute.device)
    check("raster.triangle", visible, barycentric.shape[:-1], attribute.device, torch.int32)
    if derivatives and raster.derivative is None:
        raise ValueError("raster.derivative: expected derivatives, got None: use rasterize(..., derivative=True)")
    if batched:
        # One mesh of all, with the triangles of each image behind those of the one before.
        number = torch.arange(len(attribute), dtype=torch.int32, device=attribute.device)[:, None, None]
        visible = torch.where(visible < 0, visible, visible + number * len(triangle))
        triangle = (triangle + number * attribute.shape[1]).reshape(-1, 3)
        attribute = attribute.reshape(-1, attribute.shape[2])
    values = _Interpolate.apply(attribute, triangle, visible.flatten(0, -2), barycentric.flatten(0, -3))
    values = values.reshape(*barycentric.shape[:-1], attribute.shape[1])
    return (values, _slopes(attribute, triangle, visible, raster.derivative)) if derivatives else values


def _slopes(attribute: torch.Tensor, triangle: torch.Tensor, visible: torch.Tensor, derivative) -> torch.Tensor:
    """Returns the derivatives of attributes per pixel, [..., C, 2], from those of the barycentrics, [..., 4]."""
    if len(triangle) == 0:
        return attribute.new_zeros(*visible.shape, attribute.shape[1], 2)
    # Derivatives are 0 where nothing is visible.
    corners = attribute[triangle[visible.clamp(min=0)]]
    along_u, along_v = (corners[..., k, :, None] - corners[..., 2, :, None] for k in range(2))
    return along_u * derivative[..., None, 0:2] + along_v * derivative[..., None, 2:4]


@takes_arrays("image", "uv", "derivatives")
def texture(
    image: torch.Tensor,
    uv: torch.Tensor,
    *,
    filter: str = "linear",
    boundary: str = "clamp",
    derivatives: torch.Tensor | None = None,
) -> torch.Tensor:
    """Samples a texture at any coordinates, with the given filter and addressing.

    A coordinate that is NaN, or infinite and not clamped, reads NaN; it neither has nor passes on a gradient.

    Args:
        image: float [H, W, C], no size 0, has a gradient; for a batch, [B, H, W, C].
        uv: float [..., 2], u right, v down, texel i of n at (i + 1/2) / n; any value. With the filter "linear" it has a
            gradient: the slope between the adjacent texels. For a batch of images, [B, ..., 2].
        filter: "linear" or "nearest".
        boundary: Addressing outside [0, 1]: "clamp" to the border's texels, "wrap" (repeat) or "mirror" (mirrored
            repeat, a triangle wave; lightmap-uv-clustering-cascade, eq. 8).
        derivatives: float [..., 2, 2], derivatives of u (first row) and v per pixel to the right (first column) and
            down, a result of `interpolate`. With them, and the filter "linear", the texture is read trilinearly from
            its mip levels, of means of 2 x 2 texels: the level is log2 of the longest axis, in texels, of the ellipse
            that a circle of diameter 1 pixel covers. They have a gradient, by the slope between two levels.

    Returns:
        float [..., C].

    Raises:
        ValueError: No such filter or boundary, a tensor's shape, type or device doesn't fit, `uv` requires a gradient
            with the filter "nearest", or that filter has derivatives.
    """
    codes(filter, boundary)
    batched = getattr(image, "ndim", 3) == 4
    check("image", image, (None,) * (4 if batched else 3))
    if 0 in image.shape:
        raise ValueError(f"image: expected at least one texel and one channel, got {tuple(image.shape)}")
    check("uv", uv, (..., 2), image.device)
    if batched and (uv.ndim < 2 or len(uv) != len(image)):
        raise ValueError(f"uv: expected float32 [{len(image)}, ..., 2] for as many images, got {tuple(uv.shape)}")
    if filter == "nearest":
        if uv.requires_grad:
            raise NoGradientError("uv", "the filter nearest")
        if derivatives is not None:
            raise ValueError("filter: expected linear with derivatives, got 'nearest'")
    if derivatives is not None:
        check("derivatives", derivatives, (*uv.shape, 2), image.device)
    points = uv.reshape(-1, 2)
    if batched or derivatives is not None:
        images = image if batched else image[None]
        texels = mips.read(images, points, derivatives, filter, boundary)
    else:
        texels = mips.Read.apply(image, None, 1, points, None, filter, boundary)
    return texels.reshape(*uv.shape[:-1], image.shape[-1])


def _rasterize(position, triangle, height, width, space, cull, derivative, coverage) -> Raster:
    name, columns = ("uv", 2) if space == "uv" else ("clip", 4)
    batched = getattr(position, "ndim", 2) == 3
    check(name, position, (None, None, columns) if batched else (None, columns))
    if batched and len(position) == 0:
        raise ValueError(f"{name}: expected at least one mesh, got {tuple(position.shape)}")
    triangle = _checked_triangles(triangle, position.shape[-2], position.device)
    for name, pixels in (("height", height), ("width", width)):
        if not hasattr(pixels, "__index__"):
            raise ValueError(f"{name}: expected a whole number of pixels, got {pixels!r}")
    options = {"space": space, "cull": cull, "derivative": derivative, "coverage": coverage}
    return Raster(*_Rasterize.apply(position, triangle, height, width, options), len(triangle))


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, triangle, height, width, options):
        def draw(mesh: torch.Tensor) -> dict[str, torch.Tensor | None]:
            drawing = kernels.Rasterizer(
                to_warp(triangle), height, width, empty=torch_memory(position.device), **options
            )
            arrays = vars(drawing.run(to_warp(mesh)))
            return {name: None if array is None else wp.to_torch(array) for name, array in arrays.items()}

        with on_stream(position.device):
            if position.ndim == 2:
                tensors = draw(position)
            else:
                images = [draw(mesh) for mesh in position]
                tensors = {
                    name: None if first is None else torch.stack([image[name] for image in images])
                    for name, first in images[0].items()
                }
        ctx.save_for_backward(position, triangle, tensors["triangle"])
        ctx.space = options["space"]
        ctx.mark_non_differentiable(
            *(tensor for name, tensor in tensors.items() if name != "barycentric" and tensor is not None)
        )
        return tuple(tensors.values())

    @staticmethod
    @once_differentiable
    def backward(ctx, _triangle, grad_barycentric, *_others):
        position, triangle, visible = ctx.saved_tensors
        grad = zeros_for(position)
        images = position, visible, dense(grad_barycentric), grad
        with on_stream(position.device):
            for mesh, seen, on_seen, on_mesh in [images] if position.ndim == 2 else zip(*images, strict=True):
                raster_gradient.rasterize_backward(
                    to_warp(mesh),
                    to_warp(triangle),
                    to_warp(seen),
                    to_warp(on_seen, wp.vec2),
                    to_warp(on_mesh),
                    ctx.space,
                )
        return grad, None, None, None, None


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, attribute, triangle, visible, barycentric):
        barycentric = dense(barycentric)
        out = attribute.new_empty(*visible.shape, attribute.shape[1])
        with on_stream(attribute.device):
            pixels = to_warp(visible), to_warp(barycentric, wp.vec2)
            raster_gradient.interpolate(to_warp(attribute), to_warp(triangle), *pixels, to_warp(out))
        ctx.save_for_backward(attribute, triangle, visible, barycentric)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        attribute, triangle, visible, barycentric = ctx.saved_tensors
        on_attribute = zeros_for(attribute, ctx.needs_input_grad[0])
        on_barycentric = torch.empty_like(barycentric) if ctx.needs_input_grad[3] else None
        with on_stream(attribute.device):
            raster_gradient.interpolate_backward(
                to_warp(attribute),
                to_warp(triangle),
                to_warp(visible),
                to_warp(barycentric, wp.vec2),
                to_warp(dense(grad_out)),
                optional_array(on_attribute, 2, wp.float32, attribute.device),
                optional_array(on_barycentric, 2, wp.vec2, attribute.device),
            )
        return on_attribute, None, None, on_barycentric


def _checked_triangles(triangle: torch.Tensor, count: int, device: torch.device) -> torch.Tensor:
    check_index("triangle", triangle, count, (None, 3), device)
    return triangle.to(torch.int32)
