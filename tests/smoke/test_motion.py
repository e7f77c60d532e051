"""Motion across the image: closed forms, a loop in NumPy, and the warped earlier frame."""

import numpy as np
import pytest
import torch
import warp as wp
from builders.smoke_plumes import facing, rays
from reference.marching import span as clip
from reference.marching import trilinear

from wlm.fluid.volume import from_array
from wlm.smoke.march.motion import motion
from wlm.smoke.march.six_way import bake

SIZE = 24


def _velocity(values: np.ndarray, device: str) -> wp.array:
    return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)


def _ball(at: tuple = (12.0, 12.0, 12.0), radius: float = 6.0, n: int = SIZE) -> np.ndarray:
    grid = np.stack(np.meshgrid(*[np.arange(n) + 0.5] * 3, indexing="ij"), -1)
    return np.clip(radius - np.linalg.norm(grid - np.array(at), axis=-1), 0, 1)


def _warped(earlier: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
    """Reads an earlier picture [H, W] at the places that the motion names."""
    height, width = earlier.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = torch.stack([(x - moved[0].cpu()) / width * 2 - 1, (y - moved[1].cpu()) / height * 2 - 1], -1)
    return torch.nn.functional.grid_sample(earlier.cpu()[None, None], grid[None], align_corners=False)[0, 0]


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.6, 0.4, -1.0), (0.0, 1.0, 0.0)])
def test_uniform_motion(device: str, way: tuple):
    """The motion of a moving ball is its velocity in the image, and warps the earlier picture into the later one."""
    shift = np.array([2.0, -3.0, 1.0])
    before, after = (from_array(_ball(12 + k * shift), voxel=0.5, device=device) for k in (-0.5, 0.5))
    camera = facing(after, way, 48)
    # 0.25 of the world's lengths a step, 2 steps: the shift, in voxels of half a length.
    velocity = _velocity(np.broadcast_to(shift, (6, 6, 6, 3)), device)
    moved = motion(after, velocity, camera, reach=0.5, step=0.5)
    opacity = 1.0 - bake(after, camera, estimate=False).transparency
    right, up, _ = camera.axes @ (0.5 * shift) / camera.pitch
    smoke = opacity > 0.01
    for plane, expected in zip(moved, (right, -up), strict=True):
        np.testing.assert_allclose(plane[smoke].cpu(), expected, atol=1e-4)
        assert (plane[opacity == 0] == 0).all() and smoke.any() and not smoke.all()
    # What the smoke has left behind has no motion: it shows none any more.
    earlier = 1.0 - bake(before, camera, estimate=False).transparency
    pictures = (_warped(earlier, moved), earlier.cpu())
    error, still = (float((each - opacity.cpu())[smoke.cpu()].square().mean()) for each in pictures)
    assert error < 0.02 * still


def test_against_a_loop(device: str):
    """An oblique view, air with other cells than the smoke, and a step that divides no length."""
    random = np.random.default_rng(5)
    density = np.maximum(random.normal(0.1, 0.5, (9, 14, 11)), 0).astype(np.float16)
    density[:, :5, :4] = 0
    air = random.normal(size=(3, 5, 4, 3)).astype(np.float32)
    place = {"extinction": 0.4, "voxel": 0.5, "origin": (1.0, -2.0, 3.0), "device": device}
    half, whole = from_array(density, **place), from_array(density.astype(np.float32), **place)
    assert (half.density.dtype, whole.density.dtype) == (torch.float16, torch.float32)
    camera = facing(half, (0.7, 0.3, 1.0), 7)
    expected, opacity = _loop(density.astype(np.float64), 0.2, air, 1.2, camera, half, 1.37)
    assert (opacity > 0.01).sum() > 20 and np.abs(expected).max() > 0.5
    for volume in (half, whole):
        moved = motion(volume, _velocity(air, device), camera, reach=0.6, step=1.37).cpu().numpy()
        np.testing.assert_allclose(moved, expected, atol=2e-4)


def _loop(density, extinction, air, reach, camera, volume, h):
    """Computes the motion and the opacity pixel by pixel in float64."""
    size = np.array(density.shape)
    share = np.array(air.shape[:3]) / size

    def blown(p):
        q = np.clip(p * share - 0.5, 0, np.array(air.shape[:3]) - 1)
        padded = np.stack([trilinear(np.pad(air[..., c], 1, mode="edge"), q + 1.5) for c in range(3)])
        return reach * padded

    out, opacity = np.zeros((2, camera.height, camera.width)), np.zeros((camera.height, camera.width))
    origins, ways = rays(camera)
    for row, column in np.ndindex(camera.height, camera.width):
        o, d = (origins[row, column] - volume.origin) / volume.voxel, ways[row, column]
        near, far = clip(density.shape, o, d)
        moved, seen, t = np.zeros(3), 0.0, 1.0
        steps = int(np.ceil(max(far - near, 0) / h))
        for n in range(steps):
            dt = (far - near) / steps
            p = o + (near + (n + 0.5) * dt) * d
            x = extinction * float(trilinear(density, p)) * dt
            begin = p - blown(p - 0.5 * blown(p))
            begin = np.minimum(np.maximum(begin, np.minimum(p, 1)), np.maximum(p, size - 1))
            moved += t * (1 - np.exp(-x)) * (p - begin)
            seen += t * (1 - np.exp(-x))
            t *= np.exp(-x)
        opacity[row, column] = seen
        if seen > 1e-3:
            across, up, _ = camera.axes @ (moved / seen) * volume.voxel / camera.pitch
            out[:, row, column] = across, -up
    return out, opacity


def test_hard_cases(device: str):
    wind = _velocity(np.ones((2, 2, 2, 3)), device)
    for density in (np.zeros((6, 6, 6)), np.full((6, 6, 6), 1e-6)):
        volume = from_array(density, device=device)
        assert not motion(volume, wind, facing(volume, size=20), reach=1.0).any()
    one = from_array(np.ones((1, 1, 1)), extinction=3.0, device=device)
    moved = motion(one, _velocity(np.ones((1, 1, 1, 3)), device), facing(one, size=20), reach=0.1)
    assert torch.isfinite(moved).all() and moved.any()
    ball = from_array(_ball(), device=device)
    camera = facing(ball, (1.0, 0.2, 0.4), 20)
    first, second = (motion(ball, wind, camera, reach=1.0) for _ in range(2))
    assert torch.equal(first, second)
