"""Reconstructs density and wind from three views of smoke, with `wlm.ops.march` and `volume`, and checks the result.

The pictures are orthographic views of a plume under a warm and a cool light, with its transmittance. The density
begins as a thin haze and goes down the gradient of the squared error through the march; a fourth view, from between two
of the three, has no part in it and shows how much of the volume has been found. Then three pictures of the next frame,
to which a constant wind has carried the smoke, show the wind.

    python demos/ops_march.py
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from demo_command import run_demo

from wlm import ops, smoke
from wlm.errors import WlmError
from wlm.view.pictures import contact_sheet, to_bytes

HERE = Path(__file__).resolve().parent
VIEWS, HELD_OUT = (0.0, 60.0, 120.0), 90.0  # degrees round the plume
PIXELS, MARGIN = 48, 1.1  # along an edge; of what they show, in grids
LIGHTS = {(1.0, 1.0, 0.6): (1.0, 0.8, 0.6), (-1.0, 0.3, 0.5): (0.2, 0.35, 0.6)}  # where from, and the colour
BACKGROUND = (0.05, 0.07, 0.1)
HAZE = 0.02  # the density to begin with
STEPS, RATE = 80, 0.1
WIND = (2.0, 0.6, -1.2)  # between two frames, in voxels
WIND_STEPS, WIND_RATE = 40, 0.2
ZOOM = 3  # of the pictures in the sheet

# Measured on the CPU: 38.4 and 31.9 dB; the haze that it begins from has 10.3 dB in the held-out view.
LEAST_VIEWS, LEAST_HELD_OUT = 37.0, 30.5
MOST_WIND = 0.3  # error in voxels; measured: 0.19, of 2.4


def rays(degrees: float, size: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the origins and the directions, [PIXELS, PIXELS, 3] each, of the rays of an orthographic view of a grid.

    Args:
        degrees: Angle of the view about the vertical axis y.
        size: Voxels along an edge of the grid; a voxel is the unit of length.
        device: "cpu" or "cuda:N".
    """
    angle = math.radians(degrees)
    forward = torch.tensor([-math.sin(angle), 0.0, -math.cos(angle)], device=device)
    up = torch.tensor([0.0, 1.0, 0.0], device=device)
    right = torch.linalg.cross(forward, up)
    across = ((torch.arange(PIXELS, device=device) + 0.5) / PIXELS - 0.5) * MARGIN * size
    origin = 0.5 * size - 1.5 * size * forward + across[:, None] * right - across[:, None, None] * up
    return origin, forward.expand_as(origin)


def look(density: torch.Tensor, angles: tuple[float, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """Renders a density [size, size, size] from V angles in degrees. Returns radiance [V, PIXELS, PIXELS, 3] and
    transmittance [V, PIXELS, PIXELS]."""
    device = str(density.device)
    views = [rays(angle, len(density), device) for angle in angles]
    toward = torch.nn.functional.normalize(torch.tensor([*LIGHTS], device=device), dim=1)
    colour = torch.tensor([*LIGHTS.values()], device=device)
    return ops.march(density, *map(torch.stack, zip(*views, strict=True)), toward=toward, colour=colour)


def picture(radiance: torch.Tensor, transmittance: torch.Tensor) -> np.ndarray:
    """Returns a view over the background, `ZOOM` times as wide and high, for a screen: uint8 [H, W, 3]."""
    light = radiance + transmittance[..., None] * torch.tensor(BACKGROUND, device=radiance.device)
    enlarged = torch.nn.functional.interpolate(light.movedim(-1, 0)[None], scale_factor=ZOOM, mode="bilinear")
    return to_bytes(enlarged[0].movedim(0, -1))


def psnr(first: Sequence[torch.Tensor], second: Sequence[torch.Tensor]) -> float:
    """Returns the PSNR in dB over all numbers of two sequences of tensors, with a peak of 1."""
    error = torch.cat([(a - b).detach().flatten() for a, b in zip(first, second, strict=True)])
    return -10.0 * math.log10(float(error.square().mean()))


def reconstruct(pictures: tuple[torch.Tensor, torch.Tensor], size: int) -> torch.Tensor:
    """Fits a density [size, size, size] to radiance and transmittance as seen from the angles `VIEWS`; returns it."""
    density = torch.full((size,) * 3, HAZE, device=pictures[0].device, requires_grad=True)
    optimizer = torch.optim.Adam([density], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        optimizer.zero_grad()
        radiance, transmittance = look(density, VIEWS)
        loss = (radiance - pictures[0]).square().mean() + (transmittance - pictures[1]).square().mean()
        loss.backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            density.clamp_(min=0.0)
    return density.detach()


def moved(density: torch.Tensor, wind: torch.Tensor) -> torch.Tensor:
    """Returns a density [X, Y, Z] as a wind [3], in voxels, carries it."""
    voxel = torch.stack(torch.meshgrid(*(torch.arange(n) + 0.5 for n in density.shape), indexing="ij"), -1)
    points = (voxel.to(density) - wind) / torch.tensor(density.shape, device=density.device)
    return ops.volume(density[..., None], points.flip(-1))[..., 0]


def find_wind(pictures: tuple[torch.Tensor, torch.Tensor], density: torch.Tensor) -> torch.Tensor:
    """Fits the wind [3] that carries a density to the next frame's pictures from the angles `VIEWS`; returns it."""
    wind = torch.zeros(3, device=density.device, requires_grad=True)
    optimizer = torch.optim.Adam([wind], lr=WIND_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, WIND_STEPS)
    for _ in range(WIND_STEPS):
        optimizer.zero_grad()
        radiance, transmittance = look(moved(density, wind), VIEWS)
        loss = (radiance - pictures[0]).square().mean() + (transmittance - pictures[1]).square().mean()
        loss.backward()
        optimizer.step()
        schedule.step()
    return wind.detach()


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo, writes its picture and returns its figures."""
    volume = smoke.load(HERE / "data" / "smoke" / "plume.npz", extinction=14.0, device=device)
    # Half the resolution, and the extinction of a voxel of that.
    density = torch.nn.functional.avg_pool3d(volume.density[None], 2)[0] * volume.extinction * 2.0 * volume.voxel
    angles, fitted = (*VIEWS, HELD_OUT), len(VIEWS)
    target = look(density, angles)
    clock = time.perf_counter()
    reconstructed = reconstruct((target[0][:fitted], target[1][:fitted]), len(density))
    true_wind = torch.tensor(WIND, device=device)
    wind = find_wind(look(moved(density, true_wind), VIEWS), reconstructed)
    seconds = time.perf_counter() - clock
    result, initial = look(reconstructed, angles), look(torch.full_like(density, HAZE), angles)
    rows = {"target": target, "reconstructed": result, "initial": initial}
    pictures = {name: [picture(*view) for view in zip(*parts, strict=True)] for name, parts in rows.items()}
    contact_sheet(out / "ops_march.png", pictures, [*(f"{a:g}°" for a in VIEWS), f"{HELD_OUT:g}°, held out"])
    three, held_out = ([[part[at] for part in parts] for parts in (result, target)] for at in (slice(fitted), -1))
    figures = {
        "PSNR dB of the three views": psnr(*three),
        "PSNR dB of the held-out view": psnr(*held_out),
        "PSNR dB of the initial haze in it": psnr([part[-1] for part in initial], held_out[1]),
        "relative error of the density": float((reconstructed - density).norm() / density.norm()),
        "error of the wind in voxels": float((wind - true_wind).norm()),
        "seconds": seconds,
    }
    for name, least in (("the three views", LEAST_VIEWS), ("the held-out view", LEAST_HELD_OUT)):
        decibels = figures[f"PSNR dB of {name}"]
        if not decibels >= least:
            raise WlmError(f"demo: {name}: expected at least {least} dB, got {decibels:.4g}")
    found = figures["error of the wind in voxels"]
    if not found <= MOST_WIND:
        raise WlmError(f"demo: the wind: expected an error of at most {MOST_WIND} voxels, got {found:.4g}")
    return figures


if __name__ == "__main__":
    run_demo(__doc__, run, lambda out: str(out / "ops_march.png"))
