"""The march's radiance and transmittance: closed forms, the smoke system's own marches, and what nothing passes."""

import math

import numpy as np
import pytest
import torch
import warp as wp
from kernels.compare import array, close
from reference.single_light import march_lit

from wlm import ops
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.march import Medium, make_view
from wlm_kernels.smoke.settings import March

AHEAD = torch.tensor([0.0, 0.0, 1.0])


def _rays(device: str, count: int = 3) -> dict[str, torch.Tensor]:
    """Along the third axis, through the middle of a grid of 8 x 8."""
    origin = torch.tensor([4.0, 4.0, -5.0], device=device).repeat(count, 1)
    return {"origin": origin, "direction": AHEAD.to(device).repeat(count, 1)}


@pytest.mark.parametrize("step", [1.0, 0.3, 4.0])
def test_uniform_smoke(device: str, step: float):
    """Beer and Lambert's law; and back-scattered light, of which (1 - exp(-2 tau)) / 2 comes back."""
    density = torch.full((8, 8, 16), 0.1, device=device)
    toward, colour = -AHEAD[None].to(device), torch.tensor([[1.0, 0.5, 0.0]], device=device)
    radiance, transmittance = ops.march(density, **_rays(device), toward=toward, colour=colour, step=step)
    # Steps of a voxel's length meet its density's corners, others cut them.
    close(transmittance, torch.full((3,), math.exp(-1.6)), {0.3: 2e-3, 1.0: 1e-6, 4.0: 0.1}[step])
    reflected = 0.5 * (1.0 - math.exp(-3.2))
    close(radiance, torch.tensor([[reflected, 0.5 * reflected, 0.0]] * 3), {0.3: 2e-3, 1.0: 5e-3, 4.0: 0.06}[step])


def test_uniform_glow(device: str):
    """Emission e of uniform smoke of extinction s comes as e / s (1 - exp(-tau)); without smoke, as e times the way."""
    emission = torch.full((8, 8, 16, 3), 0.2, device=device)
    for s, want in ((0.1, 2.0 * (1.0 - math.exp(-1.6))), (0.0, 3.2)):
        density = torch.full((8, 8, 16), s, device=device)
        radiance, _ = ops.march(density, **_rays(device), emission=emission, step=0.1)
        close(radiance, torch.full((3, 3), want), 2e-3)


@pytest.mark.parametrize("g", [0.0, 0.7, -0.4])
def test_phase_function(device: str, g: float):
    """Light from behind, from the side and from the front, in smoke so thin that all of it gets through."""
    density = torch.full((8, 8, 8), 1e-5, device=device)
    toward = torch.stack([AHEAD, AHEAD.roll(1), -AHEAD]).to(device)
    light = torch.cat(
        [
            ops.march(density, **_rays(device, 1), toward=t[None], colour=torch.ones(1, 3, device=device), g=g)[0][:, 0]
            for t in toward
        ]
    )
    cosine = torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64)
    want = 8e-5 * (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
    close(light, want, 1e-3)


def _cloud(seed: int = 3) -> np.ndarray:
    """A smooth density."""
    random = np.random.default_rng(seed)
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n) for n in (14, 12, 16)], indexing="ij"), -1)
    blobs = [np.exp(-6.0 * ((x - c) ** 2).sum(-1)) for c in random.uniform(-0.5, 0.5, (4, 3))]
    return (0.25 * sum(blobs)).astype(np.float32)


def test_against_the_smoke_systems_marches(device: str):
    """A march to the light from every sample, and the transparency of the guiding map."""
    density = _cloud()
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    right, up, forward = turn * np.linalg.det(turn)
    middle = np.array(density.shape) / 2
    view = make_view(middle - 20.0 * forward, right, up, forward, 1.0, 20, 18)
    toward = np.array([0.5, 0.7, -0.51]) / np.linalg.norm([0.5, 0.7, -0.51])
    lit = wp.zeros((18, 20), dtype=float, device=device)
    medium = Medium(array(density, float, device), 1.0)
    march_lit(medium, view, toward, March(0.5, g=0.3), lit)

    u, v = np.meshgrid(np.arange(20) + 0.5 - 10.0, 9.0 - np.arange(18) - 0.5)
    origin = middle - 20.0 * forward + u[..., None] * right + v[..., None] * up
    rays = [torch.tensor(r.astype(np.float32), device=device) for r in (origin, np.broadcast_to(forward, origin.shape))]
    light = torch.tensor(toward[None].astype(np.float32), device=device)
    colour = torch.ones(1, 3, device=device)
    grid = torch.tensor(density, device=device)
    radiance, transmittance = ops.march(grid, *rays, toward=light, colour=colour, step=0.5, g=0.3)
    assert lit.numpy().max() > 0.1
    # What the lattice of optical depths, a voxel wide, leaves.
    close(radiance[..., 0], lit, 0.012)
    maps = wp.zeros((3, 18, 20), dtype=float, device=device)
    marches.guide(medium, view, March(0.5, jitter=0.0, cutoff=0.0), maps)
    close(transmittance, maps.numpy()[1], 1e-5)


def test_rays_that_miss(device: str):
    """Past the grid, and away from it: nothing is seen, and nothing has a gradient."""
    density = torch.ones(8, 8, 8, device=device, requires_grad=True)
    origin = torch.tensor([[20.0, 4.0, -5.0], [4.0, 4.0, -5.0]], device=device)
    direction = torch.stack([AHEAD, -AHEAD]).to(device)
    radiance, transmittance = ops.march(
        density, origin, direction, toward=AHEAD[None].to(device), colour=torch.ones(1, 3, device=device)
    )
    (radiance.sum() + transmittance.sum()).backward()
    assert not radiance.any() and (transmittance == 1.0).all() and not density.grad.any()


def test_behind_a_wall(device: str):
    """Where nothing gets through the gradient is 0 and not NaN, however opaque, and in front of it right."""
    density = torch.full((8, 8, 16), 0.05, device=device)
    density[:, :, 8:] = 1e6
    density.requires_grad_()
    emission = torch.full((8, 8, 16, 3), 0.1, device=device, requires_grad=True)
    radiance, transmittance = ops.march(density, **_rays(device, 1), emission=emission)
    assert transmittance == 0.0
    radiance.sum().backward()
    assert density.grad.isfinite().all() and emission.grad.isfinite().all()
    assert not density.grad[:, :, 9:].any() and not emission.grad[:, :, 9:].any()
    # The ray runs between four rows of voxels, and each has a quarter of what it passes.
    passed = torch.exp(torch.tensor([-0.025 - 0.05 * k for k in range(6)]))
    close(emission.grad[3, 3, :6, 0], 0.25 * passed, 0.01)


def test_same_bits_every_time():
    """On the CPU nothing is added in an order that changes."""
    results = []
    for _ in range(2):
        density = torch.tensor(_cloud(), requires_grad=True)
        lights = {"toward": AHEAD[None], "colour": torch.ones(1, 3)}
        radiance, transmittance = ops.march(density, **_rays("cpu"), **lights)
        (radiance.sum() + transmittance.sum()).backward()
        results.append((radiance, transmittance, density.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
