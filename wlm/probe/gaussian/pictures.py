"""The error of pictures in a fit (gaussian-probe-compression, section 6.2.2): of balls at the probes, and of a mesh.

A pixel's light is a linear combination of the probes' coefficients, and small errors of it change what is displayed in
proportion to the slope of the tone curve. The squared error of the pictures is thus a quadratic form in the errors of
the probes.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.probe.data import ProbeSet
from wlm.probe.places import ball_exposure, nearest_weights
from wlm.probe.relative import magnitudes
from wlm.probe.sphere import irradiance_weights, sh_count, unit_or_zero
from wlm.probe.views import NEIGHBOURS, look, separate
from wlm.texels import filmic, to_srgb

_PER_PROBE = 8  # pixels of balls for each probe, and at most as many of the mesh
_VIEWS, _RESOLUTION = 64, 128
_DOWN = 0.2  # downward part of the viewing direction
_STEP = 1e-3  # change of linear light over which the slope of the tone curve is taken
_WHOLE = 1e-6  # of a pixel's weights that may be of probes left out


class Pixels(NamedTuple):
    """Pixels of diffuse white surfaces under V live probes with C coefficients at T hours.

    Attributes:
        weights: float64 [P, V], sparse: the weights of the probes in each pixel's light.
        factors: float64 [P, C], from coefficients to the radiance that the pixel reflects.
        slopes: float64 [P, 3 T], change of the displayed colour, 0 to 1, for a change of that radiance.
    """

    weights: sparse.csr_array
    factors: np.ndarray
    slopes: np.ndarray

    def of(self, chosen: np.ndarray) -> "Pixels":
        """Returns the pixels that some of the probes light alone, in the order of these probes, int [W]."""
        weights = self.weights[:, chosen]
        whole = weights.sum(1) > 1.0 - _WHOLE
        return Pixels(weights[whole], self.factors[whole], self.slopes[whole])


def seen_pixels(probes: ProbeSet, geometry: Geometry, device: str = "cpu", seed: int = 0) -> Pixels:
    """Returns pixels of balls at all live probes, seen from everywhere, and pixels in which viewers at random probes
    see a mesh, lit by the nearest probes like those of `wlm.probe.views`. `seed` chooses viewers and pixels. Raises a
    WlmError if the probes' numbers are not spherical harmonics, or no viewer sees the mesh."""
    position, light = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
    count, hours = sh_count(probes.outputs), max(len(probes.times), 1)
    if count is None:
        raise WlmError(f"{probes.name}: mesh: expected spherical harmonics, found {probes.outputs} numbers per probe")
    many, random, tree = _PER_PROBE * len(position), np.random.default_rng(seed), cKDTree(position)
    near, share = [np.arange(many)[:, None] % len(position)], [np.ones((many, 1))]
    normals, mesh = [unit_or_zero(random.normal(size=(many, 3)))], separate(geometry)
    for eye in position[random.integers(len(position), size=_VIEWS)]:
        turn = random.uniform(0.0, 2.0 * math.pi)
        forward = np.array([math.cos(turn), -_DOWN, math.sin(turn)])
        seen, place, normal, _ = look(mesh, eye, forward, 1, _RESOLUTION, device)
        if seen.any():
            chosen = random.permutation(len(place))[: -(-many // _VIEWS)]
            for parts, part in zip((near, share), nearest_weights(tree, place[chosen], NEIGHBOURS), strict=True):
                parts.append(part)
            normals.append(normal[chosen])
    if len(near) == 1:
        raise WlmError(f"{probes.name}: mesh: expected a mesh around the probes, but none of {_VIEWS} views shows it")
    rows = [
        sparse.csr_array((w.ravel(), n.ravel(), np.arange(0, n.size + 1, n.shape[1])), shape=(len(n), len(position)))
        for w, n in zip(share, near, strict=True)
    ]
    weights, factors = sparse.vstack(rows, format="csr"), irradiance_weights(np.concatenate(normals), count) / math.pi
    slopes = []
    for own in np.split(light, hours, axis=1):
        exposure = ball_exposure(own.reshape(-1, count, 3))
        lit = exposure * np.einsum("pc,pcd->pd", factors, (weights @ own).reshape(-1, count, 3))
        above, below = (to_srgb(filmic(np.maximum(lit + step, 0.0))) for step in (_STEP, -_STEP))
        slopes.append(exposure * (above - below) / (2.0 * _STEP))
    return Pixels(weights, factors, np.concatenate(slopes, 1))


class PictureLoss:
    """The squared error of pixels, scaled so that it weighs as much as that of the probes: both are quadratic forms in
    the numbers that the network computes, and their matrices get equal traces."""

    def __init__(
        self, pixels: Pixels, values: np.ndarray, relative: bool, hours: int, unit: float, device: str
    ) -> None:
        """Uploads the pixels of live probes with the original numbers `values`, [V, T D]. If the error is relative, the
        network computes the numbers of `with_magnitude`; `unit` is that of the squared error of the probes."""
        scale = magnitudes(values, hours)
        self._hours, self._relative, self._gain = hours, relative, float(scale.max())
        # Light is in units of the brightest probe, so that no square exceeds float32.
        squares = pixels.weights.power(2) @ np.square(scale / self._gain if relative else np.ones_like(scale))
        value = np.square(pixels.slopes).reshape(len(squares), hours, 3)
        trace = float((value.sum(2) * squares * np.square(pixels.factors).sum(1, keepdims=True)).sum())
        # Probes that are all alike have no unit, and pictures of black ones no trace.
        even = trace > 0.0 and unit > np.finfo(np.float64).tiny
        share = (1.0 if relative else self._gain**2) / (trace * unit) if even else 0.0

        def put(numbers: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(numbers, np.float32)).to(device)

        self._wanted, self._factors, self._value = put(values / self._gain), put(pixels.factors), put(value * share)
        self._matrices = [
            [torch.from_numpy(m.indices).to(device), torch.from_numpy(m.indptr).to(device), put(m.data)]
            for m in (pixels.weights, pixels.weights.T.tocsr())
        ]

    def __call__(self, numbers: torch.Tensor) -> torch.Tensor:
        """Returns the error for numbers from the network, float32 [V, T D] or [V, T (D + 1)], with a gradient."""
        if self._relative:
            by_hour = numbers.view(len(numbers), self._hours, -1)
            light = (by_hour[..., :-1] * by_hour[..., -1:].exp()).view(len(numbers), -1)
        else:
            light = numbers / self._gain
        seen = _Product.apply(light - self._wanted, *self._matrices)
        off = torch.einsum("pc,ptcd->ptd", self._factors, seen.view(len(seen), self._hours, -1, 3))
        return (self._value * off.square()).sum()


class _Product(torch.autograd.Function):
    """The product of a sparse matrix and a dense one; the gradient is a product with the transposed matrix, whose sums
    do not depend on the order of threads, as those of torch's own gradient would."""

    @staticmethod
    def forward(ctx, x, rows, transposed):
        ctx.rows, ctx.transposed = rows, transposed
        column, start, weight = rows
        return embedding_bag(column, x, start, mode="sum", per_sample_weights=weight, include_last_offset=True)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        return _Product.forward(ctx, grad_out.contiguous(), ctx.transposed, ctx.rows), None, None
