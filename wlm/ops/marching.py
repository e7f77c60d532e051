"""Ray marching through a density grid: transmittance, single scattering and emission."""

import math

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.interop import to_warp
from wlm.ops.tapes import NoGradientError, takes_arrays
from wlm.ops.tensors import check, check_finite, dense, on_stream, optional_array, zeros_for
from wlm_kernels.smoke import single_scatter
from wlm_kernels.smoke.march import nodes_along

_UNIT = (0.999, 1.001)  # accepted range of a direction's length


@takes_arrays("density", "origin", "direction", "colour", "emission")
def march(
    density: torch.Tensor,
    origin: torch.Tensor,
    direction: torch.Tensor,
    *,
    toward: torch.Tensor | None = None,
    colour: torch.Tensor | None = None,
    emission: torch.Tensor | None = None,
    step: float = 1.0,
    g: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Marches rays through a density grid; the reference is `benchmarks.plain.march`.

    Single scattering at albedo 1 (neural-six-way-lightmaps, eq. 1 to 3; for another albedo, scale the colours):
    each sample of a ray scatters light from directional lights towards the ray's origin, by the phase function of
    Henyey and Greenstein, and emits light; this light is attenuated along the ray. The steps of a ray are equally long,
    and each is integrated exactly for the density at its middle. The optical depth to a light is marched from the nodes
    of a lattice, whose spacing is a step but at least a voxel, and interpolated trilinearly between the nodes.

    All lengths are in voxels: the grid fills the box from 0 to (X, Y, Z), the centre of voxel i is at i + 1/2, and
    density and emission are trilinear between centres, with zero outside the grid. Run time is proportional
    to rays times steps, plus voxels times steps for each light.

    The density, the lights' colours, the emission and the rays have gradients, exact for the discretised result; the
    number of a ray's steps is constant, and the three numbers of a direction count as independent. The directions to
    the lights have no gradient: to find directions of light, fit the colours of many lights. On CUDA the gradients of a
    voxel are summed in any order, so their last bits change from run to run.

    Args:
        density: float [X, Y, Z], the extinction coefficient per voxel edge, at least 0.
        origin: float [..., 3], origins of the rays in voxels, inside or outside the grid; of one camera or of many.
        direction: float [..., 3], of length 1.
        toward: float [L, 3], the directions to the lights, of length 1.
        colour: float [L, 3], the lights' irradiance divided by 4 pi: opaque isotropic smoke fully lit by a light of
            colour 1 scatters a radiance of 1.
        emission: float [X, Y, Z, 3], the radiance emitted per voxel edge.
        step: The longest step, in voxels; the error is proportional to its square where the density is smooth.
        g: The phase function's mean cosine, within -1 and 1; above 0 it scatters forward.

    Returns:
        The radiance that arrives at the origins, float [..., 3], and the transmittance, float [...]; composite over a
        background b as radiance + transmittance * b. A ray that misses the grid has radiance 0 and transmittance 1.

    Raises:
        ValueError: A tensor's shape, type or device doesn't fit, only one of `toward` and `colour` is given, `toward`
            requires a gradient, or a number isn't finite or in range. The check of numbers waits for the GPU and is
            skipped while a CUDA graph is captured.
    """
    if not (math.isfinite(step) and step > 0.0):
        raise ValueError(f"step: expected a number above 0, got {step}")
    if not -1.0 < g < 1.0:
        raise ValueError(f"g: expected a number between -1 and 1, got {g}")
    check("density", density, (None, None, None))
    if 0 in density.shape:
        raise ValueError(f"density: expected at least one voxel, got {tuple(density.shape)}")
    device = density.device
    if (toward is None) != (colour is None):
        raise ValueError("toward, colour: expected both arguments or neither, got one")
    if toward is None or colour is None:
        toward = colour = density.new_empty(0, 3)
    check("toward", toward, (None, 3), device)
    check("colour", colour, (len(toward), 3), device)
    if emission is not None:
        check("emission", emission, (*density.shape, 3), device)
    check("origin", origin, (..., 3), device)
    check("direction", direction, tuple(origin.shape), device)
    if toward.requires_grad:
        raise NoGradientError("toward", "march")
    lengths = {"length of direction": direction.detach().norm(dim=-1), "length of toward": toward.norm(dim=-1)}
    check_finite(
        {"density": (0.0, math.inf), **dict.fromkeys(lengths, _UNIT)},
        density=density,
        origin=origin,
        colour=colour,
        emission=emission,
        **lengths,
    )
    shape = origin.shape[:-1]
    origin, direction = origin.reshape(-1, 3), direction.reshape(-1, 3)
    scattered, emitted, depth = _March.apply(density, emission, toward, origin, direction, float(step))
    # Autocast would multiply in half precision.
    with torch.autocast(device.type, enabled=False):
        radiance = (scattered * _henyey_greenstein(g, direction @ toward.T)) @ colour + emitted
    return radiance.reshape(*shape, 3), torch.exp(-depth).reshape(shape)


class _March(torch.autograd.Function):
    """Computes per ray the scattered light of each light (colour 1, no phase function), emission and optical depth."""

    @staticmethod
    def forward(ctx, density, emission, toward, origin, direction, step):
        device, rays = density.device, len(origin)
        toward, origin, direction = dense(toward), dense(origin), dense(direction)
        if emission is not None:
            emission = dense(emission)
        nodes = density.new_empty(len(toward), *nodes_along(density.shape, step))
        scattered, emitted, depth = (density.new_empty(rays, *tail) for tail in ((len(toward),), (3,), ()))
        count = torch.empty(rays, dtype=torch.int32, device=device)
        with on_stream(device):
            single_scatter.depths(to_warp(density), to_warp(toward, wp.vec3), step, to_warp(nodes))
            results = to_warp(scattered), to_warp(emitted, wp.vec3), to_warp(depth), to_warp(count)
            single_scatter.march(*_arrays(density, emission, nodes, origin, direction), step, *results)
        ctx.save_for_backward(density, emission, toward, origin, direction, nodes, depth, count)
        ctx.step = step
        return scattered, emitted, depth

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_scattered, grad_emitted, grad_depth):
        density, emission, toward, origin, direction, nodes, depth, count = ctx.saved_tensors
        device, needed = density.device, ctx.needs_input_grad
        on_density = on_emission = on_origin = on_direction = None
        with on_stream(device):
            arrays = _arrays(density, emission, nodes, origin, direction)
            grads = to_warp(grad_scattered), to_warp(dense(grad_emitted), wp.vec3), to_warp(grad_depth)
            arguments = [*arrays, ctx.step, to_warp(depth), to_warp(count), *grads]
            if needed[0] or needed[1]:
                on_density, on_nodes = zeros_for(density), zeros_for(nodes)
                on_emission = zeros_for(emission) if needed[1] else None
                scene = to_warp(on_density), optional_array(on_emission, 3, wp.vec3, device), to_warp(on_nodes)
                single_scatter.march_backward(*arguments, scene=scene)
                lights = to_warp(toward, wp.vec3), ctx.step
                single_scatter.depths_backward(*lights, to_warp(on_nodes), to_warp(on_density))
            if needed[3] or needed[4]:
                on_origin, on_direction = torch.empty_like(origin), torch.empty_like(direction)
                rays = to_warp(on_origin, wp.vec3), to_warp(on_direction, wp.vec3)
                single_scatter.march_backward(*arguments, rays=rays)
        return on_density, on_emission, None, on_origin, on_direction, None


def _arrays(
    density: torch.Tensor, emission: torch.Tensor | None, nodes: torch.Tensor, *rays: torch.Tensor
) -> list[wp.array]:
    glow = optional_array(emission, 3, wp.vec3, density.device)
    return [to_warp(density), glow, to_warp(nodes), *(to_warp(each, wp.vec3) for each in rays)]


def _henyey_greenstein(g: float, cosine: torch.Tensor) -> torch.Tensor:
    """Returns the phase function times 4 pi; `cosine` is 1 for unscattered light."""
    return (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
