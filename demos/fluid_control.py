"""Finds an inlet and sources by which smoke forms a heart at a given frame, through the gradients of `wlm.fluid`.

Air rises from an inlet at the floor around a cylinder and carries smoke from a row of nozzles. The unknowns are the
strength of each nozzle at each step and the inlet's sideways velocity over time. They begin as a weak, even emission
into straight air, and go down the gradient of the squared error between the smoke of the last frame and the heart.

    python demos/fluid_control.py
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from demo_command import run_demo

from wlm import fluid
from wlm.errors import WlmError
from wlm.view.pictures import contact_sheet

HERE = Path(__file__).resolve().parent
SHAPE, REFINEMENT = (24, 32, 1), 2
CYLINDER, RADIUS = (5.0, 10.0), 2.5  # cells of the air
NOZZLES, WIDTH, FLOOR = 9, 2.0, 2.0  # in a row; their width and their height
RISE, SIDEWAYS = 0.15, 0.05  # velocity of the inlet and the bound of its sideways part, cells per step
HEART, SIZE = (13.0, 23.0), 6.0  # its centre, and half its width
FRAME = 90  # the step of the solver at which the smoke is a heart
KNOTS = 10  # of the sideways velocity over time
ITERATIONS, RATE = 24, 0.4
STRONGEST = 0.4  # density that a nozzle adds in a step of the air
ZOOM = 8  # of the pictures

# Measured on the CPU: 0.060, from 0.92.
MOST_ERROR, LEAST_GAIN = 0.08, 8.0


@dataclass(frozen=True)
class Unknowns:
    """The unknowns as raw numbers, which `controls` bounds.

    Attributes:
        strength: [frame, NOZZLES].
        wind: [KNOTS].
    """

    strength: torch.Tensor
    wind: torch.Tensor

    def controls(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the velocity of the inlet [T, 1, 3] and density and temperature of the sources [T, NOZZLES, 2]."""
        steps = len(self.strength)
        wind = torch.nn.functional.interpolate(self.wind[None, None], steps, mode="linear", align_corners=True)[0, 0]
        sideways = SIDEWAYS * torch.tanh(wind)
        inlet = torch.stack([sideways, torch.full_like(sideways, RISE), torch.zeros_like(sideways)], 1)[:, None]
        density = STRONGEST * torch.sigmoid(self.strength)
        return inlet, torch.stack([density, torch.zeros_like(density)], 2)


def scene(device: str) -> fluid.DifferentiableSolver:
    """Makes the air with its inlet, outlet, side walls and cylinder, and the nozzles."""
    air = fluid.Lattice(SHAPE, lattice="D2Q9", viscosity=0.01, device=device)
    air.set_inlet("-y", (0.0, RISE, 0.0))
    air.set_outlet("+y")
    for face in ("-x", "+x"):
        air.set_wall(face, slip=True)
    air.set_flow((0.0, RISE, 0.0))
    places = HEART[0] + WIDTH * (np.arange(NOZZLES) - (NOZZLES - 1) / 2)
    nozzles = [fluid.Source("box", (x, FLOOR, 0.5), (0.5 * WIDTH, 0.5, 1.0), 0.1) for x in places.tolist()]
    cylinder = fluid.Sphere(fluid.Trajectory.of([[*CYLINDER, 0.5]]), RADIUS)
    return fluid.DifferentiableSolver(fluid.Solver(air, refinement=REFINEMENT, sources=nozzles, obstacles=[cylinder]))


def heart(device: str) -> torch.Tensor:
    """Returns the density that the smoke is to have, 1 in the heart, [X r, Y r, Z r]."""
    x, y, z = (REFINEMENT * size for size in SHAPE)
    fine = 4  # samples along an edge of a cell, for smooth edges
    across, up = (
        ((torch.arange(size * fine, device=device) + 0.5) / (fine * REFINEMENT) - centre) / (0.85 * SIZE)
        for size, centre in zip((x, y), HEART, strict=True)
    )
    a, b = across[:, None], up[None, :]
    inside = ((a**2 + b**2 - 1.0) ** 3 - a**2 * b**3 <= 0.0).float()
    return torch.nn.functional.avg_pool2d(inside[None], fine)[0][..., None].repeat(1, 1, z)


def find(
    model: fluid.DifferentiableSolver, target: torch.Tensor, frame: int, iterations: int
) -> tuple[torch.Tensor, torch.Tensor, list[float]]:
    """Finds controls for a density at a frame.

    Args:
        model: The scene.
        target: The density, [X r, Y r, Z r].
        frame: The step of the solver at which it is wanted.
        iterations: Steps of the optimiser.

    Returns:
        The density at the frame before and after, and the error in each iteration: the squared error over that of no
        smoke at all.
    """
    start, device = model.state(), target.device
    unknowns = Unknowns(torch.full((frame, NOZZLES), -2.0, device=device), torch.zeros(KNOTS, device=device))
    parameters = [unknowns.strength.requires_grad_(), unknowns.wind.requires_grad_()]
    optimizer = torch.optim.Adam(parameters, lr=RATE, betas=(0.8, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    errors, first = [], None
    for number in range(iterations + 1):
        inlet, sources = unknowns.controls()
        # The states of so small a scene are all stored.
        density = model.advance(start, frame, inlet=inlet, sources=sources, states=frame).density
        first = density.detach() if first is None else first
        loss = (density - target).square().sum() / target.square().sum()
        errors.append(loss.item())
        if number < iterations:
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return first, density.detach(), errors


def picture(density: torch.Tensor) -> np.ndarray:
    """Returns smoke as a picture, white for a density of 1, with the cylinder in brown: uint8 [H, W, 3]."""
    grey = density[..., 0].clamp(0.0, 1.0).T.flip(0)
    image = torch.stack([0.05 + 0.95 * grey, 0.08 + 0.92 * grey, 0.15 + 0.85 * grey], 2).cpu().numpy()
    image = image.repeat(ZOOM, 0).repeat(ZOOM, 1)
    rows, columns = ((np.arange(size) + 0.5) / (ZOOM * REFINEMENT) for size in image.shape[:2])
    away = np.hypot(columns[None] - CYLINDER[0], SHAPE[1] - rows[:, None] - CYLINDER[1])
    image[away < RADIUS] = (0.45, 0.3, 0.2)
    return (255.0 * image + 0.5).astype(np.uint8)


def run(out: Path, device: str) -> dict[str, float]:
    """Runs the demo, writes its picture and returns its figures."""
    model, target = scene(device), heart(device)
    clock = time.perf_counter()
    first, last, errors = find(model, target, FRAME, ITERATIONS)
    seconds = time.perf_counter() - clock
    pictures = [picture(density) for density in (target, first, last)]
    contact_sheet(out / "fluid_control.png", {f"frame {FRAME}": pictures}, ["wanted", "at the start", "found"])
    figures = {"error at the start": errors[0], "error found": errors[-1], "seconds": seconds}
    if not (errors[-1] <= MOST_ERROR and errors[0] >= LEAST_GAIN * errors[-1]):
        raise WlmError(f"demo: expected an error of at most {MOST_ERROR}, got {errors[-1]:.4g}, from {errors[0]:.4g}")
    return figures


if __name__ == "__main__":
    run_demo(__doc__, run, lambda out: str(out / "fluid_control.png"))
