"""Drawing for torch: a picture and its gradients end to end, against ray casts, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernels.compare import close, exact

from benchmarks import plain
from wlm import ops

SIZE = (30, 41)


def _mesh(device: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A bumpy sheet in perspective with UVs that go beyond the texture: clip [V, 4], triangles, UV [V, 2]."""
    random = np.random.default_rng(5)
    line = np.linspace(-0.8, 0.8, 5)
    x, y = (axis.reshape(-1) for axis in np.meshgrid(line, line))
    w = 1.0 + 0.5 * x + random.uniform(0.0, 0.3, x.shape)
    clip = np.stack([x * w, y * w, random.uniform(-1, 1, x.shape), w], 1)
    first = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1)
    triangle = np.concatenate([np.stack([first, first + 1, first + 6], 1), np.stack([first, first + 6, first + 5], 1)])
    uv = np.stack([0.7 * x + 0.4, 0.6 * y + 0.5], 1) + random.uniform(0.0, 0.02, (25, 2))
    put = [torch.tensor(values, dtype=torch.float32, device=device) for values in (clip, uv)]
    return put[0], torch.tensor(triangle, device=device), put[1]


@pytest.mark.parametrize("boundary", ["clamp", "wrap", "mirror"])
def test_gradients_end_to_end(device: str, boundary: str):
    """A textured picture's loss by corners, UVs and texels, against float64 autograd through the twins."""
    clip, triangle, uv = _mesh(device)
    random = np.random.default_rng(6)
    image = torch.tensor(random.normal(size=(9, 7, 3)), dtype=torch.float32, device=device)
    leaves = [clip.requires_grad_(), uv.requires_grad_(), image.requires_grad_()]
    clip64, uv64, image64 = (exact(leaf.detach().cpu(), grad=True) for leaf in leaves)
    raster, raster64 = ops.rasterize(clip, triangle, *SIZE), plain.rasterize(clip64, triangle.cpu(), *SIZE)
    # The twin leaves open which of two triangles has a pixel on their edge: a column of them, here.
    same = raster.triangle.cpu() == raster64.triangle
    assert same.double().mean() > 0.97
    close(raster.depth.cpu()[same], raster64.depth[same], 1e-5, "depth")
    toward = exact(random.normal(size=(*SIZE, 3)).astype(np.float32)) * (same & (raster64.triangle >= 0))[..., None]

    picture = ops.texture(image, ops.interpolate(uv, triangle, raster), boundary=boundary)
    picture.backward(toward.float().to(device))
    picture64 = plain.texture(image64, plain.interpolate(uv64, triangle.cpu(), raster64), boundary=boundary)
    picture64.backward(toward)
    close(picture.cpu()[same], picture64[same], 1e-5, "picture")
    for leaf, leaf64, name in zip(leaves, (clip64, uv64, image64), ("clip", "uv", "image"), strict=True):
        close(leaf.grad, leaf64.grad, 1e-4, name)


def test_uv_space(device: str):
    """Texels of a mesh's own layout: the gradient of what is interpolated there reaches UVs and attributes."""
    clip, triangle, uv = _mesh(device)
    uv.requires_grad_()
    attribute = clip.requires_grad_()
    raster = ops.rasterize_uv(uv, triangle, *SIZE, derivative=True, coverage=True)
    assert raster.coverage.dtype == torch.int32 and raster.coverage.max() == 1
    assert torch.equal(raster.coverage > 0, raster.triangle >= 0) and not raster.depth.any()
    # Interpolating the layout itself gives each texel's centre.
    centres = plain.pixel_centres(*SIZE) / torch.tensor([SIZE[1], SIZE[0]])
    hit = raster.triangle.cpu() >= 0
    assert 0.4 < hit.double().mean() < 1.0
    close(ops.interpolate(uv, triangle, raster)[hit.to(device)], centres[hit], 1e-6)
    ops.interpolate(attribute, triangle, raster).square().sum().backward()
    uv64, attribute64 = exact(uv.detach().cpu(), grad=True), exact(attribute.detach().cpu(), grad=True)
    raster64 = plain.rasterize_uv(uv64, triangle.cpu(), *SIZE)
    plain.interpolate(attribute64, triangle.cpu(), raster64).square().sum().backward()
    close(uv.grad, uv64.grad, 1e-4, "uv")
    close(attribute.grad, attribute64.grad, 1e-5, "attribute")


def test_only_what_is_asked_for(device: str):
    """Outputs that weren't asked for are None; those without a gradient say so."""
    clip, triangle, _ = _mesh(device)
    raster = ops.rasterize(clip.requires_grad_(), triangle, *SIZE)
    assert raster.derivative is None and raster.coverage is None
    assert raster.barycentric.requires_grad and not raster.depth.requires_grad
    assert raster.triangle.dtype == torch.int32 and raster.barycentric.shape == (*SIZE, 2)
    full = ops.rasterize(clip, triangle.int(), *SIZE, derivative=True, coverage=True, cull=True)
    assert full.derivative.shape == (*SIZE, 4) and torch.equal(full.triangle, raster.triangle)
    turned = ops.rasterize(clip, triangle.flip(1), *SIZE, cull=True)
    assert (turned.triangle == -1).all()


def test_any_strides(device: str):
    """Views and transposed tensors are read as they are."""
    clip, triangle, uv = _mesh(device)
    want = ops.interpolate(uv, triangle, ops.rasterize(clip, triangle, *SIZE))
    lists = triangle.T.contiguous().T
    raster = ops.rasterize(clip.T.contiguous().T, lists, *SIZE)
    wide = torch.cat([uv, uv], 1)
    assert torch.equal(ops.interpolate(wide[:, 2:], lists, raster), want)
    image = torch.rand(5, 6, 3, device=device)
    found = ops.texture(image.permute(2, 0, 1).contiguous().permute(1, 2, 0), want.transpose(0, 1))
    assert torch.equal(found, ops.texture(image, want).transpose(0, 1))


def test_nothing_to_draw(device: str):
    """No triangles, no corners, no points."""
    clip, triangle, uv = _mesh(device)
    for raster in (
        ops.rasterize(clip, triangle[:0], 3, 4, coverage=True),
        ops.rasterize(clip[:0].requires_grad_(), triangle[:0], 3, 4, coverage=True),
        ops.rasterize_uv(uv[:0], triangle[:0], 3, 4, coverage=True),
    ):
        assert (raster.triangle == -1).all() and not raster.coverage.any()
        assert not ops.interpolate(uv, triangle[:0], raster).any()
    empty = clip[:0].detach().requires_grad_()
    ops.rasterize(empty, triangle[:0], 3, 4).barycentric.sum().backward()
    assert empty.grad.shape == (0, 4)
    image = torch.rand(2, 2, 3, device=device, requires_grad=True)
    found = ops.texture(image, torch.zeros(0, 5, 2, device=device))
    found.sum().backward()
    assert found.shape == (0, 5, 3) and not image.grad.any()


def test_what_is_refused(device: str):
    clip, triangle, uv = _mesh(device)
    image = torch.rand(2, 2, 3, device=device)
    raster = ops.rasterize(clip, triangle, 3, 4)
    cut = replace(raster, triangle=raster.triangle[:2])
    low = triangle.clone()
    low[0, 1] = -1
    for call, message in (
        (lambda: ops.rasterize(clip, low, 3, 4), "triangle: expected numbers from 0 to 24, found -1"),
        (lambda: ops.interpolate(uv[:3], triangle, raster), "triangle: expected numbers from 0 to 2, found 24"),
        (lambda: ops.rasterize(clip, triangle, 0, 4), "height: expected 1 to 16384 pixels, got 0"),
        (lambda: ops.texture(image[:0], uv), r"image: expected at least one texel and one channel, got \(0, 2, 3\)"),
        (lambda: ops.rasterize(clip, triangle.to("meta"), 3, 4), "triangle: expected a tensor on .* meta"),
        (lambda: ops.interpolate(uv, triangle, cut), r"raster.triangle: expected int32 \[3, 4\], got .* \(2, 4\)"),
        (lambda: ops.interpolate(uv, triangle[:3], raster), "triangle: expected the 32 triangles that were drawn"),
        (lambda: ops.texture(image, uv, filter="cubic"), "filter: expected linear or nearest, got 'cubic'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
