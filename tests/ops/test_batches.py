"""Batches of meshes, cameras and textures have the bytes of single calls; and mip levels."""

import numpy as np
import pytest
import torch
from kernels.compare import close

from benchmarks import plain
from wlm import ops

TRIANGLE = torch.tensor([[0, 1, 2], [0, 2, 3], [3, 1, 4]])


def _numbers(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape).astype(np.float32))


def _meshes(device: str, count: int = 3) -> torch.Tensor:
    clip = 0.8 * _numbers(count, 5, 4)
    clip[..., 3] = 1.0 + clip[..., 3].abs()
    return clip.to(device)


def _equal(together: list[torch.Tensor], alone: list[list[torch.Tensor]], device: str, exact: int) -> None:
    """Every result of a batch, and its gradients behind the first `exact` results, are those of single calls."""
    for number, whole in enumerate(together):
        one = torch.stack([each[number] for each in alone])
        # On CUDA gradients are summed in any order.
        assert torch.equal(whole, one) or (
            device != "cpu" and number >= exact and torch.allclose(whole, one, atol=1e-4)
        )


@pytest.mark.parametrize("name", ["clip", "uv"])
def test_a_batch_of_meshes(device: str, name: str):
    """Drawn, and with attributes of each mesh or of all: all fields, and gradients."""
    meshes, attributes = _meshes(device), _numbers(3, 5, 2, seed=2).to(device)
    if name == "uv":
        meshes = 0.5 + 0.3 * meshes[..., :2]
    draw, triangle = ops.rasterize if name == "clip" else ops.rasterize_uv, TRIANGLE.to(device)

    def results(mesh: torch.Tensor, attribute: torch.Tensor) -> list[torch.Tensor]:
        leaves = [mesh.clone().requires_grad_(), attribute.clone().requires_grad_()]
        raster = draw(leaves[0], triangle, 19, 23, derivative=True, coverage=True)
        values, slopes = ops.interpolate(leaves[1], triangle, raster, derivatives=True)
        shared = ops.interpolate(attributes[0], triangle, raster)
        grads = torch.autograd.grad(values.square().sum() + slopes.square().sum() + shared.square().sum(), leaves)
        fields = (raster.triangle, raster.barycentric, raster.depth, raster.derivative, raster.coverage)
        return [each.detach() for each in (*fields, values, slopes, shared)] + list(grads)

    together = results(meshes, attributes)
    assert (together[0] >= 0).any((1, 2)).all() and together[-1].any() and together[-2].any()
    _equal(together, [results(*pair) for pair in zip(meshes, attributes, strict=True)], device, 8)


@pytest.mark.parametrize("mode", [{}, {"filter": "nearest"}, {"boundary": "wrap"}, {"derivatives": True}])
def test_a_batch_of_textures(device: str, mode: dict):
    images, uv = _numbers(3, 6, 5, 2).to(device), _numbers(3, 4, 7, 2, seed=2).to(device)
    slopes = 0.5 * _numbers(3, 4, 7, 2, 2, seed=3).to(device)

    def results(image: torch.Tensor, uv: torch.Tensor, slopes: torch.Tensor) -> list[torch.Tensor]:
        leaves = [image.clone().requires_grad_(), uv.clone().requires_grad_("filter" not in mode)]
        options = {**mode, "derivatives": slopes.clone().requires_grad_()} if "derivatives" in mode else mode
        values = ops.texture(*leaves, **options)
        wanted = [each for each in (*leaves, options.get("derivatives")) if each is not None and each.requires_grad]
        return [values.detach(), *torch.autograd.grad(values.square().sum(), wanted)]

    together = results(images, uv, slopes)
    assert all(each.any() for each in together)
    _equal(together, [results(*each) for each in zip(images, uv, slopes, strict=True)], device, 1)


@pytest.mark.parametrize("boundary", ["clamp", "wrap", "mirror"])
@pytest.mark.parametrize("size", [(8, 16), (5, 7), (1, 6)])
def test_mip_levels_against_float64(device: str, size: tuple[int, int], boundary: str):
    """Values and gradients by texels, coordinates and their derivatives, from magnified to beyond the last level."""
    random = np.random.default_rng(5)
    slopes = _numbers(200, 2, 2) * torch.from_numpy(10.0 ** random.uniform(-2.5, 1.0, (200, 1, 1)).astype(np.float32))
    # A read of level k between centres, not on them, where slopes change.
    leaves = [_numbers(*size, 3), torch.from_numpy(random.uniform(0.0, 1.0, (200, 2)).astype(np.float32)), slopes]
    leaves64 = [leaf.double().requires_grad_() for leaf in leaves]
    leaves = [leaf.to(device).requires_grad_() for leaf in leaves]
    found = ops.texture(leaves[0], leaves[1], boundary=boundary, derivatives=leaves[2])
    expected = plain.texture(leaves64[0], leaves64[1], boundary=boundary, derivatives=leaves64[2])
    close(found, expected, 1e-5)
    toward = _numbers(200, 3, seed=3)
    found.backward(toward.to(device))
    expected.backward(toward.double())
    for leaf, leaf64, name in zip(leaves, leaves64, ("image", "uv", "derivatives"), strict=True):
        close(leaf.grad, leaf64.grad, 1e-4, name)
        assert leaf.grad.any()


def test_derivatives_of_a_footprint(device: str):
    """Of a wall in perspective: those of coordinates are their differences from pixel to pixel."""
    clip = torch.tensor([[-1.0, -1, 0, 1], [2.0, -2, 0, 2], [2.0, 2, 0, 2], [-1.0, 1, 0, 1]], device=device)
    triangle, uv = TRIANGLE[:2].to(device), torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]], device=device)
    raster = ops.rasterize(clip, triangle, 64, 64, derivative=True)
    at, slopes = ops.interpolate(uv, triangle, raster, derivatives=True)
    right, down = at[1:-1, 2:] - at[1:-1, :-2], at[2:, 1:-1] - at[:-2, 1:-1]
    # The two triangles, which differ in their slopes, meet on the diagonal.
    drawn = raster.triangle
    same = (drawn[1:-1, 2:] == drawn[1:-1, :-2]) & (drawn[2:, 1:-1] == drawn[:-2, 1:-1])
    assert same.float().mean() > 0.9
    close(slopes[1:-1, 1:-1][same], 0.5 * torch.stack([right, down], -1)[same].cpu(), 2e-3)


def test_what_a_level_reads(device: str):
    """Magnified, the texels themselves; over the whole texture, their mean; and what isn't a number."""
    image, uv = _numbers(8, 8, 2).to(device), torch.rand(50, 2, device=device)
    small, whole = (scale * torch.eye(2, device=device).expand(50, 2, 2) for scale in (0.125, 1e30))
    assert torch.equal(ops.texture(image, uv, derivatives=small), ops.texture(image, uv))
    assert torch.equal(ops.texture(image, uv, derivatives=0.0 * small), ops.texture(image, uv))
    close(ops.texture(image, uv, derivatives=whole), image.mean((0, 1)).cpu().expand(50, 2), 1e-6)
    for bad in ("uv", "derivatives"):
        leaves = {"image": image.clone(), "uv": uv.clone(), "derivatives": 3.0 * small}
        leaves[bad][0] = float("nan")
        leaves = {name: leaf.requires_grad_() for name, leaf in leaves.items()}
        found = ops.texture(**leaves)
        assert found[0].isnan().all() and found[1:].isfinite().all()
        found[1:].sum().backward()
        assert leaves["image"].grad.isfinite().all() and leaves["uv"].grad.isfinite().all()
        assert leaves["derivatives"].grad[1:].isfinite().all()
    empty = ops.texture(image, uv[:0], derivatives=small[:0])
    assert empty.shape == (0, 2)
