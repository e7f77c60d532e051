"""Reference implementations of the operations in plain torch, for any float type and any device.

Each has the name, the arguments and the result of its counterpart in `wlm.ops`, without argument checks. They are
written for readability, take more time and memory, and use autograd; in float64 they are the reference in the tests.
"""

import torch
from torch.nn.functional import adaptive_avg_pool2d, grid_sample, pad
from torch.nn.functional import gelu as torch_gelu

from wlm.ops.raster import Raster

Tensor = torch.Tensor


# Maps in BC7 blocks (neural-dynamic-gi, eq. 7 and 8)


def straight_through(value: Tensor, used: Tensor) -> Tensor:
    """Returns `used` in the forward pass and passes the gradient on to `value` in the backward pass."""
    return value + (used - value).detach()


def bc7_map(endpoints, weights, uv, *, layer=None, quantised: bool = False) -> Tensor:
    """Samples a map of blocks bilinearly at `uv` [..., 2]; returns [..., 4]."""
    return plane(bc7_texels(endpoints, weights, quantised=quantised), uv, layer=layer)


def bc7_texels(endpoints: Tensor, weights: Tensor, *, quantised: bool = False) -> Tensor:
    """Decodes whole maps with endpoints [..., H/4, W/4, 2, 4] and weights [..., H, W] to [..., H, W, 4]."""
    e, w = endpoints.clamp(0.0, 1.0), weights.clamp(0.0, 1.0)
    if quantised:
        stored = _endpoint_bytes(e.detach())
        index = torch.floor(w.detach() * 15.0 + 0.5).long()
        level = (64 * index + 7) // 15  # of 64
        e, w = stored / 255.0, level / 64.0
    e, w = straight_through(endpoints, e), straight_through(weights, w)[..., None]
    mixed = (1.0 - w) * _per_texel(e[..., 0, :]) + w * _per_texel(e[..., 1, :])
    if not quantised:
        return mixed
    a, b, k = _per_texel(stored[..., 0, :]), _per_texel(stored[..., 1, :]), level[..., None]
    return straight_through(mixed, (((64 - k) * a + k * b + 32) >> 6).to(mixed.dtype) / 255.0)


def _endpoint_bytes(e: Tensor) -> Tensor:
    """Rounds colours e [..., 4] to the nearest bytes with equal lowest bits, int64 [..., 4]; ties go to even bytes."""
    v = e * 255.0
    even, odd = (torch.floor((v - bit) / 2.0 + 0.5).clamp(0.0, 127.0) * 2.0 + bit for bit in (0.0, 1.0))
    nearer = ((odd - v) ** 2).sum(-1, keepdim=True) < ((even - v) ** 2).sum(-1, keepdim=True)
    return torch.where(nearer, odd, even).long()


def _per_texel(blocks: Tensor) -> Tensor:
    """Repeats each block's value at its 4 x 4 texels: [..., h, w, C] becomes [..., 4 h, 4 w, C]."""
    return blocks.repeat_interleave(4, -3).repeat_interleave(4, -2)


# Feature grids, with torch's `grid_sample`


def plane(values, points, *, layer=None, periodic: bool = False) -> Tensor:
    """Samples a plane [H, W, C], or plane `layer` of [L, H, W, C], at points (u, v) [..., 2]; returns [..., C]."""
    return _sample(values, points, layer, periodic, 2)


def volume(values, points, *, layer=None, periodic: bool = False) -> Tensor:
    """Samples a volume [D, H, W, C], or volume `layer` of [L, D, H, W, C], at (u, v, w) [..., 3]; returns [..., C]."""
    return _sample(values, points, layer, periodic, 3)


def triplane(xy, xz, yz, points, *, reduce: str = "sum") -> Tensor:
    """Samples three planes at the projections of points (x, y, z) and combines the three results."""
    parts = [plane(values, points[..., axes]) for values, axes in ((xy, [0, 1]), (xz, [0, 2]), (yz, [1, 2]))]
    if reduce == "concatenate":
        return torch.cat(parts, -1)
    return parts[0] * parts[1] * parts[2] if reduce == "product" else parts[0] + parts[1] + parts[2]


def _sample(values: Tensor, points: Tensor, layer: Tensor | None, periodic: bool, axes: int) -> Tensor:
    shape = points.shape[:-1]
    points = points.reshape(-1, axes)
    if layer is None:
        values, layer = values[None], torch.zeros(len(points), dtype=torch.int64)
    layer = layer.reshape(-1).to(values.device)
    if periodic:
        # The last slice comes before the first, the first after the last; the coordinate moves by one cell.
        cells = values.shape[1]
        values = torch.cat([values[:, -1:], values, values[:, :1]], 1)
        last = points[:, -1:]
        last = ((last - last.detach().floor()) * cells + 1.0) / (cells + 2.0)
        points = torch.cat([points[:, :-1], last], 1)
    result = torch.zeros(len(points), values.shape[-1], dtype=values.dtype, device=values.device)
    for number in layer.unique():
        chosen = (layer == number).nonzero()[:, 0]
        grid = (2.0 * points[chosen] - 1.0).reshape(1, *[1] * (axes - 1), -1, axes)
        image = values[number].movedim(-1, 0)[None]
        sampled = grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
        result = result.index_copy(0, chosen, sampled.reshape(values.shape[-1], -1).T)
    return result.reshape(*shape, -1 if result.numel() else values.shape[-1])


# Small networks


def mlp(x: Tensor, hidden: Tensor, output: Tensor, *, gelu: str = "exact") -> Tensor:
    """Evaluates gelu(gelu(x W1 + b1) W2 + b2) W3 + b3 for x [..., B, I]; returns [..., B, O]."""
    form = "none" if gelu == "exact" else "tanh"
    first, bias_1, second, bias_2 = hidden.split([x.shape[-1], 1, hidden.shape[-1], 1], -2)
    third, bias_3 = output.split([hidden.shape[-1], 1], -2)
    h1 = torch_gelu(x @ first + bias_1, approximate=form)
    h2 = torch_gelu(h1 @ second + bias_2, approximate=form)
    return h2 @ third + bias_3


# 3D Gaussians (gaussian-probe-compression, eq. 2 to 6)


def gaussian_sum(rows: Tensor, points: Tensor, *, cut: float = 3.0, support: str = "ellipsoid") -> Tensor:
    """Sums K Gaussians, rows of centre, log scale, quaternion and latent, at points [..., 3]; returns [..., L]."""
    scale = rows[:, 3:6].exp()
    d = points[..., None, :] - rows[:, :3]
    u = torch.einsum("kij,...kj->...ki", rotations(rows[:, 6:10]).transpose(1, 2), d) / scale
    d2 = u.square().sum(-1)
    reached = d.detach().norm(dim=-1) < cut * scale.detach().amax(1) if support == "sphere" else d2.detach() < cut * cut
    return torch.where(reached, torch.exp(-0.5 * d2), 0.0) @ rows[:, 10:]


def rotations(q: Tensor) -> Tensor:
    """Converts quaternions w x y z [K, 4] of any length to matrices [K, 3, 3]; below 1e-12 to the identity."""
    n = q.norm(dim=1, keepdim=True)
    turns = n >= 1e-12
    still = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=q.dtype, device=q.device)
    w, x, y, z = torch.where(turns, q / torch.where(turns, n, 1.0), still).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


# Triangles to pixels
#
# With P the pixel centre as (x, y, 1) and the corners (x, y, w) as columns of M, b = M^-1 P has no negative entry where
# a pixel is covered from the front, b / sum(b) are the barycentrics, and b . z is z / w.


def pixel_centres(height: int, width: int) -> Tensor:
    """Returns pixel centres (column, row) in pixels: float64 [H, W, 2]."""
    axes = [torch.arange(size, dtype=torch.float64) + 0.5 for size in (height, width)]
    row, column = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([column, row], -1)


def corner_weights(position: Tensor, triangle: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Computes barycentrics [..., 3] of triangles [..., 3] at pixel positions [..., 2], with broadcasting.

    `position` is [V, 4] in clip space or [V, 2] in UV space.
    """
    x, y = pixels[..., 0] / width, pixels[..., 1] / height
    if position.shape[1] == 4:
        x, y = 2.0 * x - 1.0, 1.0 - 2.0 * y
        corners = position[triangle][..., [0, 1, 3]]
    else:
        corners = torch.cat([position, torch.ones_like(position[:, :1])], 1)[triangle]
    p = torch.stack([x, y, torch.ones_like(x)], -1)
    return torch.linalg.solve(corners.transpose(-1, -2), p.unsqueeze(-1)).squeeze(-1)


def rasterize(clip: Tensor, triangle: Tensor, height: int, width: int) -> Raster:
    """Tests all triangles at all pixels and selects the nearest.

    Degenerate triangles are not allowed. A pixel centre on an edge is covered by both triangles, while
    `wlm.ops.rasterize` assigns it to one of them.
    """
    pixels = pixel_centres(height, width).to(clip)
    with torch.no_grad():
        b = corner_weights(clip, triangle[:, None, None], pixels, height, width)
        z = (b * clip[triangle][:, None, None, :, 2]).sum(-1) if clip.shape[1] == 4 else torch.zeros_like(b[..., 0])
        depth, nearest = torch.where((b >= 0).all(-1), z, torch.inf).min(0)
    visible = torch.where(depth.isfinite(), nearest, -1)
    b = corner_weights(clip, triangle[visible.clamp(min=0)], pixels, height, width)
    hit = visible >= 0
    barycentric = torch.where(hit[..., None], (b / b.sum(-1, keepdim=True))[..., :2], 0.0)
    return Raster(visible, barycentric, torch.where(hit, depth, 0.0), None, None)


def rasterize_uv(uv: Tensor, triangle: Tensor, height: int, width: int) -> Raster:
    """Rasterizes like `rasterize`, for corners [V, 2] in UV space; the first of overlapping triangles is visible."""
    return rasterize(uv, triangle, height, width)


def interpolate(attribute: Tensor, triangle: Tensor, raster: Raster, *, derivatives: bool = False):
    """Interpolates vertex attributes [V, C] at each pixel's surface point, 0 in uncovered pixels: [H, W, C].

    With `derivatives` it also returns their derivatives to the right and down, [H, W, C, 2], by the chain rule from
    the raster's derivatives of barycentrics.
    """
    at_corners = attribute[triangle[raster.triangle.clamp(min=0)]]
    share = torch.cat([raster.barycentric, 1.0 - raster.barycentric.sum(-1, keepdim=True)], -1)
    mixed = (share[..., None] * at_corners).sum(-2)
    values = torch.where((raster.triangle >= 0)[..., None], mixed, 0.0)
    if not derivatives:
        return values
    of_corners = torch.stack([raster.derivative[..., :2], raster.derivative[..., 2:]], -2)  # of weights 0 and 1
    of_corners = torch.cat([of_corners, -of_corners.sum(-2, keepdim=True)], -2)
    return values, torch.einsum("hwkc,hwkd->hwcd", at_corners, of_corners)


def texture(image: Tensor, uv: Tensor, *, filter: str = "linear", boundary: str = "clamp", derivatives=None) -> Tensor:
    """Samples an image [H, W, C] at uv [..., 2]; returns [..., C]. With derivatives [..., 2, 2], from mip levels."""
    if derivatives is not None:
        return _between_levels(image, uv, boundary, derivatives)
    padding = "reflection" if boundary == "mirror" else "border"
    if boundary == "wrap":
        # Each side is padded with a texel of the opposite side, and coordinates are rescaled accordingly.
        size = torch.tensor([image.shape[1], image.shape[0]], dtype=uv.dtype, device=uv.device)
        image = torch.cat([image[-1:], image, image[:1]], 0)
        image = torch.cat([image[:, -1:], image, image[:, :1]], 1)
        uv = ((uv - uv.detach().floor()) * size + 1.0) / (size + 2.0)
    grid = (2.0 * uv - 1.0).reshape(1, 1, -1, 2)
    mode = "bilinear" if filter == "linear" else "nearest"
    texels = grid_sample(image.movedim(-1, 0)[None], grid, mode=mode, padding_mode=padding, align_corners=False)
    return texels[0, :, 0].T.reshape(*uv.shape[:-1], -1)


def _between_levels(image: Tensor, uv: Tensor, boundary: str, derivatives: Tensor) -> Tensor:
    """Reads all mip levels; each counts by its distance from the level of the footprint, 0 from a distance of 1 on."""
    size = torch.tensor([image.shape[1], image.shape[0]], dtype=uv.dtype, device=uv.device)
    longest = torch.linalg.svdvals(size[:, None] * derivatives)[..., 0]
    last = max(image.shape[:2]).bit_length() - 1
    level = torch.log2(longest.clamp(min=1.0)).clamp(max=float(last))[..., None]
    result = 0.0
    for at in range(last + 1):
        result = result + (1.0 - (level - at).abs()).clamp(min=0.0) * texture(image, uv, boundary=boundary)
        size = [max(n // 2, 1) for n in image.shape[:2]]
        image = adaptive_avg_pool2d(image.movedim(-1, 0), size).movedim(0, -1)
    return result


def antialias(colour: Tensor, raster: Raster, clip: Tensor, triangle: Tensor) -> Tensor:
    """Blends neighbouring pixels of colour [H, W, C] at silhouettes; all corners must be in front of the viewer."""
    height, width = raster.triangle.shape
    ndc = clip[:, :2] / clip[:, 3:]
    places = 0.5 * torch.stack([(1.0 + ndc[:, 0]) * width, (1.0 - ndc[:, 1]) * height], 1)  # in pixels
    mesh, corner = _Mesh(places.detach(), triangle), triangle.reshape(-1)
    result = colour
    for axis in range(2):
        # Pixels p and their neighbours q: to the right for axis 0, below for axis 1.
        rows, columns = height - axis, width - 1 + axis
        first, second = (slice(0, rows), slice(0, columns)), (slice(axis, height), slice(1 - axis, width))
        (t, z), (other, other_z) = ((raster.triangle[at], raster.depth[at]) for at in (first, second))
        backwards = (t < 0) | ((other >= 0) & (other_z < z))
        centre = pixel_centres(height, width).to(places)[first]
        edge = torch.full_like(t, -1)
        for row, column in (t != other).nonzero().tolist():
            start, sign = centre[row, column].tolist(), 1.0
            if backwards[row, column]:
                start[axis], sign = start[axis] + 1.0, -1.0
            nearer = (other if sign < 0.0 else t)[row, column]
            edge[row, column] = mesh.silhouette(int(nearer), start, axis, sign)
        at = edge.clamp(min=0)
        u, v = (places[corner[at - at % 3 + (at + i) % 3]] for i in (1, 2))
        across = torch.where(edge >= 0, (v - u)[..., 1 - axis], 1.0)
        share = (centre - u)[..., 1 - axis] / across
        s = (u + share[..., None] * (v - u) - centre)[..., axis]  # the crossing's distance from p
        offset = torch.where(edge >= 0, s - 0.5, 0.0)
        step = colour[first] - colour[second]
        change = torch.zeros_like(colour)
        change[second] = offset.clamp(min=0.0)[..., None] * step
        result = result + change
        change = torch.zeros_like(colour)
        change[first] = (-offset).clamp(min=0.0)[..., None] * step
        result = result - change
    return result


class _Mesh:
    """Triangles [F, 3] with corners at places [V, 2] on the screen, in pixels, and which of them share an edge."""

    def __init__(self, places: Tensor, triangle: Tensor) -> None:
        self._places, self._corners = places.tolist(), triangle.tolist()
        self._edges: dict[frozenset, list[int]] = {}
        for edge in range(triangle.numel()):
            self._edges.setdefault(frozenset(self._ends(edge)[:2]), []).append(edge)

    def silhouette(self, t: int, start: list[float], axis: int, sign: float) -> int:
        """Walks a pixel along an axis, from a place in triangle t; returns the edge of the silhouette on the way, or
        -1."""
        entered = -1
        for _ in range(32):
            left = None
            for edge in range(3 * t, 3 * t + 3):
                u, v, w = (self._places[corner] for corner in self._ends(edge))
                leaves = sign * (v[1 - axis] - u[1 - axis]) * (1 if axis else -1) * _turn(u, v, w) < 0.0
                if (
                    edge != entered
                    and leaves
                    and (u[1 - axis] - start[1 - axis]) * (v[1 - axis] - start[1 - axis]) <= 0
                ):
                    share = (start[1 - axis] - u[1 - axis]) / (v[1 - axis] - u[1 - axis])
                    left, way = edge, sign * (u[axis] + share * (v[axis] - u[axis]) - start[axis])
                    steep = abs(v[1] - u[1]) >= abs(v[0] - u[0])
            if left is None or way > 1.0:
                return -1
            entered = self._beyond(left)
            if entered < 0:
                return left if steep == (axis == 0) else -1
            t = entered // 3
        return -1

    def _ends(self, edge: int) -> list[int]:
        """Returns the corners of an edge and the corner opposite."""
        corners = self._corners[edge // 3]
        return [corners[(edge + i) % 3] for i in (1, 2, 0)]

    def _beyond(self, edge: int) -> int:
        """Returns the same edge in a triangle that lies on its other side, or -1."""
        ends = self._ends(edge)
        u, v, w = (self._places[corner] for corner in ends)
        for other in self._edges[frozenset(ends[:2])]:
            if other != edge and _turn(u, v, self._places[self._ends(other)[2]]) * _turn(u, v, w) < 0.0:
                return other
        return -1


def _turn(a: list[float], b: list[float], c: list[float]) -> float:
    """Returns twice the signed area of a triangle of three places."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


# Ray marching through a density grid (neural-six-way-lightmaps, eq. 1 to 3)

_SLACK = 1.0001  # tolerance on the step length, so that rounding adds no extra step to a whole number of steps


def march(
    density, origin, direction, *, toward=None, colour=None, emission=None, step: float = 1.0, g: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Computes radiance [..., 3] and transmittance [...] along rays through a grid [X, Y, Z]; lengths in voxels."""
    size = torch.tensor(density.shape, dtype=density.dtype, device=density.device)
    if toward is None:
        toward = colour = density.new_zeros(0, 3)
    # The first and last nodes of the lattice lie half a voxel outside the grid.
    counts = torch.ceil((size + 1.0) / max(step, 1.0)) + 1.0
    axes = [torch.linspace(-0.5, n + 0.5, int(c)).to(size) for n, c in zip(size.tolist(), counts, strict=True)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    depths = [_optical_depth(density, nodes, light, step) for light in toward]
    phase = henyey_greenstein(g, direction @ toward.T)

    first, length, count = _steps(size, origin, direction, step)
    radiance, depth = torch.zeros_like(origin), torch.zeros_like(first)
    for n in range(int(count.max()) if count.numel() else 0):
        p = origin + (first + (n + 0.5) * length)[..., None] * direction
        x = torch.where(n < count, _trilinear(density, p) * length, 0.0)
        t, absorbed = torch.exp(-depth), -torch.expm1(-x)
        for light, at_nodes in enumerate(depths):
            at_p = _trilinear(at_nodes, (p + 0.5) * (counts - 1.0) / (size + 1.0) + 0.5)
            source = phase[..., light] * torch.exp(-at_p)
            radiance = radiance + (t * absorbed * source)[..., None] * colour[light]
        if emission is not None:
            share = torch.where(x > 0.0, absorbed / torch.where(x > 0.0, x, 1.0), 1.0 - 0.5 * x)
            emitted = torch.where((n < count)[..., None], _trilinear(emission, p), 0.0)
            radiance = radiance + (t * share * length)[..., None] * emitted
        depth = depth + x
    return radiance, torch.exp(-depth)


def henyey_greenstein(g: float, cosine: Tensor) -> Tensor:
    """Returns the phase function times 4 pi; `cosine` is 1 for unscattered light."""
    return (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5


def _steps(size: Tensor, origin: Tensor, direction: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor]:
    """Returns equal steps through the box of non-zero density: their start, length and number, [...] each."""
    flat = direction.abs() <= 1e-9
    way = torch.where(flat, 1.0, direction)
    low, high = (-0.5 - origin) / way, (size + 0.5 - origin) / way
    outside = (flat & ((origin < -0.5) | (origin > size + 0.5))).any(-1)
    first = torch.where(flat, -torch.inf, torch.minimum(low, high)).amax(-1).clamp(min=0.0)
    last = torch.where(flat, torch.inf, torch.maximum(low, high)).amin(-1)
    way = torch.where(outside, 0.0, (last - first).clamp(min=0.0))
    count = torch.ceil(way / (step * _SLACK))
    return first, way / count.clamp(min=1.0), count


def _optical_depth(density: Tensor, p: Tensor, toward: Tensor, step: float) -> Tensor:
    """Integrates from points [..., 3] to the grid's boundary in equal steps, each sampled at its middle."""
    size = torch.tensor(density.shape, dtype=density.dtype, device=density.device)
    first, length, count = _steps(size, p, toward.expand_as(p), step)
    total = torch.zeros_like(first)
    for n in range(int(count.max())):
        q = p + (first + (n + 0.5) * length)[..., None] * toward
        total = total + torch.where(n < count, _trilinear(density, q), 0.0)
    return total * length


def _trilinear(grid: Tensor, p: Tensor) -> Tensor:
    """Samples a grid [X, Y, Z] or [X, Y, Z, C] at points [..., 3] in voxels; the centre of voxel i is at i + 1/2."""
    values = pad(grid.reshape(*grid.shape[:3], -1), (0, 0, 1, 1, 1, 1, 1, 1))
    shape = values.shape[:3]
    q = p + 0.5
    low = torch.floor(q)
    f = q - low
    result = 0.0
    for corner in range(8):
        far = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=p.device)
        i = (low.long() + far).unbind(-1)
        inside = [(at >= 0) & (at < n) for at, n in zip(i, shape, strict=True)]
        i = [at.clamp(0, n - 1) for at, n in zip(i, shape, strict=True)]
        weight = torch.where(far == 1, f, 1.0 - f).prod(-1)
        weight = torch.where(inside[0] & inside[1] & inside[2], weight, 0.0)
        result = result + weight[..., None] * values[i[0], i[1], i[2]]
    return result[..., 0] if grid.ndim == 3 else result
