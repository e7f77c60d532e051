"""Silhouettes: their gradients against supersampled pictures and the float64 twin, and where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from kernels.compare import close

from benchmarks import plain
from wlm import ops

QUAD = [[-0.7, -0.6, 0.1, 1.0], [1.2, -0.9, 0.2, 1.5], [1.0, 1.1, 0.0, 1.4], [-0.5, 0.6, 0.0, 0.8]]
SHAPES = {
    "quad": (QUAD, [[0, 1, 2], [0, 2, 3]]),
    "behind the viewer": ([[-0.7, -0.6, 0.1, 1.0], [0.6, -0.5, 0.2, 1.0], [0.2, 1.5, 0.0, -0.3]], [[0, 1, 2]]),
    # Front and back faces share the edges of its outline.
    "octahedron": (
        [
            [0.7, 0.1, 0, 1],
            [-0.6, 0.2, 0, 1.1],
            [0.1, 0.8, 0, 1],
            [0, -0.7, 0.1, 0.9],
            [0.2, 0.1, 0.8, 1],
            [0, 0, -1, 1],
        ],
        [[i, j, k] for i in (0, 1) for j in (2, 3) for k in (4, 5)],
    ),
}


def _shape(name: str, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    clip, triangle = SHAPES[name]
    return torch.tensor(clip, dtype=torch.float32, device=device), torch.tensor(triangle, device=device)


def _weights(height: int, width: int) -> torch.Tensor:
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    return torch.sin(3.0 * x + 1.0) + y * y


@pytest.mark.parametrize("name", SHAPES)
def test_gradients_are_those_of_a_supersampled_silhouette(device: str, name: str):
    """By every corner, of a sum of the covered area with smooth weights: within 5% of differences of 6 x 6 samples."""
    clip, triangle = _shape(name, device)
    height, width, finer, step = 96, 80, 6, 0.01

    def area(clip: torch.Tensor) -> float:
        seen = ops.rasterize(clip, triangle, finer * height, finer * width).triangle.cpu() >= 0
        covered = seen.double().reshape(height, finer, width, finer).mean((1, 3))
        return float((covered * _weights(height, width)).sum())

    leaf = clip.clone().requires_grad_()
    raster = ops.rasterize(leaf, triangle, height, width)
    drawn = ops.antialias((raster.triangle >= 0).float()[..., None], raster, leaf, triangle)[..., 0]
    total = (drawn * _weights(height, width).to(device)).sum()
    assert abs(float(total.detach()) / area(clip) - 1.0) < 0.003
    total.backward()
    expected = torch.zeros(clip.shape)
    for corner in range(len(clip)):
        for axis in (0, 1, 3):
            moved = [clip.clone() for _ in range(2)]
            moved[0][corner, axis] += step
            moved[1][corner, axis] -= step
            expected[corner, axis] = (area(moved[0]) - area(moved[1])) / (2.0 * step)
    assert float((leaf.grad.cpu() - expected).norm()) <= 0.05 * float(expected.norm())
    assert not leaf.grad[:, 2].any()


def test_triangles_thinner_than_a_pixel(device: str):
    """The silhouette of a fine sphere is found over several triangles: its area, and slopes by place and size."""
    sphere = trimesh.creation.icosphere(3)
    place = torch.tensor(sphere.vertices, dtype=torch.float32, device=device)
    triangle, size = torch.tensor(sphere.faces, device=device), 40
    weights = _weights(size, size).to(device)

    def clip(scale: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        x, y, z = (scale * place).unbind(1)
        return torch.stack([x + shift, y - 0.4 * shift, z, 2.0 + 0.3 * z], 1)

    def area(scale: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        seen = ops.rasterize(clip(scale, shift), triangle, 8 * size, 8 * size).triangle >= 0
        return torch.nn.functional.avg_pool2d(seen[None].float(), 8)[0]

    leaves = [torch.tensor(value, device=device, requires_grad=True) for value in (1.3, 0.1)]
    raster = ops.rasterize(clip(*leaves), triangle, size, size)
    drawn = ops.antialias((raster.triangle >= 0).float()[..., None], raster, clip(*leaves), triangle)[..., 0]
    true = [value.detach() for value in leaves]
    assert (drawn - area(*true)).abs().max() < 0.2
    grads = torch.autograd.grad((drawn * weights).sum(), leaves)
    for at, grad in enumerate(grads):
        found = []
        for step in (0.02, -0.02):
            moved = [*true]
            moved[at] = moved[at] + step
            found.append((area(*moved) * weights).sum())
        assert abs(float(grad / ((found[0] - found[1]) / 0.04)) - 1.0) < 0.05


def _scene(seed: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """A torn, bumpy sheet in perspective that a large triangle cuts."""
    random = np.random.default_rng(seed)
    line = np.linspace(-0.75, 0.75, 5)
    x, y = (axis.reshape(-1) + random.uniform(-0.1, 0.1, 25) for axis in np.meshgrid(line, line))
    w = 1.0 + 0.4 * x + random.uniform(0.0, 0.3, 25)
    clip = np.stack([x * w, y * w, random.uniform(-0.5, 0.5, 25) * w, w], 1)
    clip = np.concatenate([clip, [[-0.6, -0.9, 0.2, 1.0], [0.9, 0.1, 0.1, 1.0], [-0.3, 0.8, -0.1, 1.0]]])
    first = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1)
    sheet = np.concatenate([np.stack([first, first + 1, first + 6], 1), np.stack([first, first + 6, first + 5], 1)])
    triangle = np.concatenate([sheet[random.random(len(sheet)) < 0.7], [[25, 26, 27]]])
    return torch.tensor(clip, dtype=torch.float32, device=device), torch.tensor(triangle, device=device)


def _colour(*shape: int, device: str = "cpu") -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(7).normal(size=shape).astype(np.float32)).to(device)


@pytest.mark.parametrize("seed", range(2))
def test_against_float64(device: str, seed: int):
    """Values and gradients are those of the twin, which intersects lines on the screen."""
    clip, triangle = _scene(seed, device)
    raster = ops.rasterize(clip, triangle, 37, 29)
    leaves = [_colour(37, 29, 3, device=device).requires_grad_(), clip.requires_grad_()]
    leaves64 = [leaf.detach().cpu().double().requires_grad_() for leaf in leaves]
    fields = {name: getattr(raster, name).detach().cpu().double() for name in ("barycentric", "depth")}
    raster64 = replace(raster, triangle=raster.triangle.cpu().long(), **fields)
    drawn = ops.antialias(leaves[0], raster, leaves[1], triangle)
    drawn64 = plain.antialias(leaves64[0], raster64, leaves64[1], triangle.cpu())
    assert (drawn != leaves[0]).any(-1).float().mean() > 0.1
    close(drawn, drawn64, 1e-6)
    toward = _colour(37, 29, 3)
    drawn.backward(toward.to(device))
    drawn64.backward(toward.double())
    for leaf, leaf64 in zip(leaves, leaves64, strict=True):
        close(leaf.grad, leaf64.grad, 1e-5)


def test_a_batch_has_the_bytes_of_single_calls(device: str):
    clips, triangle = torch.stack([_scene(0, device)[0], _scene(1, device)[0]]), _scene(0, device)[1]
    colours = _colour(2, 37, 29, 3, device=device)

    def results(clip: torch.Tensor, colour: torch.Tensor) -> list[torch.Tensor]:
        leaves = [clip.clone().requires_grad_(), colour.clone().requires_grad_()]
        drawn = ops.antialias(leaves[1], ops.rasterize(leaves[0], triangle, 37, 29), leaves[0], triangle)
        return [drawn.detach(), *torch.autograd.grad(drawn.square().sum(), leaves)]

    together = results(clips, colours)
    for i in range(2):
        for whole, one in zip(together, results(clips[i], colours[i]), strict=True):
            # On CUDA the gradients of corners are summed in any order.
            assert torch.equal(whole[i], one) or (device != "cpu" and torch.allclose(whole[i], one, atol=1e-4))


def test_an_inner_edge_is_no_silhouette(device: str):
    """Between triangles with common vertices nothing is blended; where each has its own vertices, the seam is."""
    clip, triangle = _shape("quad", device)
    raster = ops.rasterize(clip, triangle, 32, 32)
    # Each triangle has a colour of its own, and the outside has that of the nearest one.
    inside = (raster.triangle >= 0).cpu()
    colour = torch.where(inside, raster.triangle.cpu(), 0)[..., None].float().to(device)
    pairs = (raster.triangle[:, 1:] + raster.triangle[:, :-1] == 1) & (raster.triangle[:, 1:] >= 0)
    assert pairs.any()
    inner = torch.zeros(32, 32, dtype=torch.bool, device=device)
    inner[1:-1, 1:-1] = torch.nn.functional.avg_pool2d(inside.float()[None], 3, 1)[0].to(device) == 1.0
    drawn = ops.antialias(colour, raster, clip, triangle)
    assert torch.equal(drawn[inner], colour[inner])
    apart = clip[triangle.reshape(-1)]
    drawn = ops.antialias(colour, raster, apart, torch.arange(6, device=device).reshape(2, 3))
    assert not torch.equal(drawn[inner], colour[inner])


def test_degenerate_triangles_change_nothing(device: str):
    """Without area, with equal corners, or with a corner that isn't finite: they are not drawn and continue nothing."""
    clip, triangle = _shape("quad", device)
    more = torch.cat([clip, torch.full((1, 4), float("nan"), device=device)])
    bad = torch.tensor([[0, 1, 1], [2, 2, 2], [0, 1, 4], [3, 0, 3]], device=device)
    results = []
    for corners, faces in ((clip, triangle), (more, torch.cat([triangle, bad]))):
        leaf = corners.clone().requires_grad_()
        raster = ops.rasterize(leaf, faces, 20, 24)
        drawn = ops.antialias((raster.triangle >= 0).float()[..., None], raster, leaf, faces)
        drawn.square().sum().backward()
        results.append((drawn.detach(), leaf.grad[:4]))
    # On CUDA the gradients of corners are summed in any order.
    assert torch.equal(results[0][0], results[1][0]) and torch.allclose(results[0][1], results[1][1], atol=1e-5)
    assert results[0][1].any()


def test_nothing_to_draw(device: str):
    """No triangles, no corners, a picture of one pixel or one row, and no channels: the picture is as it was."""
    clip, triangle = _shape("quad", device)
    for corners, faces, height, width, channels in (
        (clip, triangle[:0], 3, 4, 2),
        (clip[:0], triangle[:0], 3, 4, 2),
        (clip, triangle, 1, 1, 2),
        (clip, triangle, 5, 5, 0),
        (-clip, triangle, 5, 5, 1),
    ):
        leaf, colour = corners.clone().requires_grad_(), _colour(height, width, channels, device=device)
        raster = ops.rasterize(leaf, faces, height, width)
        drawn = ops.antialias(colour, raster, leaf, faces)
        drawn.sum().backward()
        assert torch.equal(drawn, colour) and leaf.grad.shape == corners.shape and not leaf.grad.any()
    clip = torch.tensor([[-0.61, -2, 0, 1], [0.63, -2, 0, 1], [0.63, 2, 0, 1], [-0.61, 2, 0, 1]], device=device)
    raster = ops.rasterize(clip, triangle, 1, 32)
    row = ops.antialias((raster.triangle >= 0).float()[..., None], raster, clip, triangle)
    assert row.shape == (1, 32, 1) and ((row > 0.0) & (row < 1.0)).sum() == 2


def test_what_is_refused(device: str):
    clip, triangle = _shape("quad", device)
    raster, colour = ops.rasterize(clip, triangle, 8, 9), torch.zeros(8, 9, 3, device=device)
    for arguments, message in (
        ((colour / 0.0, raster, clip, triangle), "colour: expected finite numbers, found nan"),
        ((colour, raster, clip[None], triangle), r"raster.depth: expected float32 \[1, any, any\], got .* \(8, 9\)"),
        ((colour, replace(raster, triangle=raster.depth), clip, triangle), r"raster.triangle: expected int32 \[8, 9\]"),
        ((colour, raster, clip, triangle[:1]), "triangle: expected the 2 triangles that were drawn, got 1"),
        ((colour, raster, clip[:3], triangle), "triangle: expected numbers from 0 to 2, found 3"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            ops.antialias(*arguments)
