"""Arguments of every operation of `wlm.ops` with gradients, apart from drawing."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch


@dataclass
class Case:
    """Arguments of an operation.

    Attributes:
        op: Its name in `wlm.ops` and in `plain`.
        leaves: Tensors with a gradient, by argument.
        constants: Other tensors, by argument.
        options: Other arguments.
    """

    op: str
    leaves: dict[str, np.ndarray]
    constants: dict[str, np.ndarray] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def tensors(self, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
        """All tensors, of one float type; the leaves require a gradient."""
        tensors = {name: torch.tensor(values, device=device) for name, values in (self.leaves | self.constants).items()}
        tensors = {name: t.to(dtype) if t.is_floating_point() else t for name, t in tensors.items()}
        return {name: t.requires_grad_(name in self.leaves) for name, t in tensors.items()}

    def call(self, module: Any, tensors: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """The results."""
        results = getattr(module, self.op)(**tensors, **self.options)
        return results if isinstance(results, tuple) else (results,)


def points_between(count: int, *cells: int, seed: int = 1, outside: float = 0.0) -> np.ndarray:
    """Points between cell centres, none within a tenth of a cell of one: there a slope changes."""
    random = np.random.default_rng(seed)
    size = np.array(cells)
    low, high = (-outside * size).astype(int) - 1, ((1.0 + outside) * size).astype(int)
    cell = random.integers(low, high, (count, len(cells)))
    return ((cell + 0.5 + random.uniform(0.1, 0.9, cell.shape)) / size).astype(np.float32)


def normal(*shape: int, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def uniform(low: float, high: float, *shape: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def _layers(count: int, layers: int) -> np.ndarray:
    return np.random.default_rng(4).integers(0, layers, count)


def _units(*shape: int, seed: int = 5) -> np.ndarray:
    d = normal(*shape, 3, seed=seed)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def network_of(inputs: int, width: int, outputs: int, *networks: int) -> dict[str, np.ndarray]:
    return {
        "x": normal(*networks, 37, inputs),
        "hidden": normal(*networks, inputs + width + 2, width, seed=6) / width**0.5,
        "output": normal(*networks, width + 1, outputs, seed=7) / width**0.5,
    }


def gaussians(count: int, latent: int) -> np.ndarray:
    rows = normal(count, 10 + latent)
    rows[:, :3] = uniform(0.0, 1.0, count, 3)
    rows[:, 3:6] = -2.0 + 0.5 * rows[:, 3:6]
    return rows


def _rays(count: int, middle: tuple[float, ...], radius: float, distance: float) -> dict[str, np.ndarray]:
    """Rays that begin `distance` before random points round the middle."""
    direction = _units(count)
    origin = np.array(middle, np.float32) + radius * normal(count, 3) - distance * direction
    return {"origin": origin, "direction": direction}


def _smoke(density: np.ndarray, lights: int = 2, emitting: bool = True, distance: float = 12.0, **options) -> Case:
    """A march through a grid."""
    middle = tuple(n / 2 for n in density.shape)
    leaves, constants = {"density": density, **_rays(40, middle, 2.0, distance)}, {}
    if lights:
        leaves["colour"], constants["toward"] = uniform(0.2, 1.0, lights, 3), _units(lights, seed=8)
    if emitting:
        leaves["emission"] = uniform(0.0, 1.0, *density.shape, 3)
    return Case("march", leaves, constants, options)


_BLOCKS = {"endpoints": uniform(0.1, 0.9, 2, 3, 2, 4), "weights": uniform(0.1, 0.9, 8, 12)}
_BEYOND = {"endpoints": uniform(-0.3, 1.3, 2, 3, 2, 4), "weights": uniform(-0.3, 1.3, 8, 12)}
_FEW, _ANYWHERE, _SPHERE = points_between(50, 8, 4), uniform(0.0, 1.0, 80, 3), {"support": "sphere"}
_THIN = uniform(0.05, 0.3, 6, 7, 8)
_THIRDS = {"xy": normal(4, 5, 3), "xz": normal(6, 5, 3, seed=9), "yz": normal(6, 4, 3, seed=10)}
_SPACE = {"points": points_between(60, 60, 60, 60)}

CASES = {
    "bc7_map": Case("bc7_map", {**_BLOCKS, "uv": points_between(50, 12, 8)}),
    "bc7_map-beyond": Case("bc7_map", {**_BEYOND, "uv": points_between(50, 12, 8, outside=0.5)}),
    "bc7_map-quantised": Case("bc7_map", {**_BEYOND, "uv": points_between(50, 12, 8)}, options={"quantised": True}),
    "bc7_map-layers": Case(
        "bc7_map",
        {"endpoints": uniform(0.1, 0.9, 3, 1, 2, 2, 4), "weights": uniform(0.1, 0.9, 3, 4, 8), "uv": _FEW},
        {"layer": _layers(50, 3)},
    ),
    "bc7_texels": Case("bc7_texels", _BLOCKS),
    "plane": Case("plane", {"values": normal(5, 7, 3), "points": points_between(60, 7, 5, outside=0.5)}),
    "plane-periodic-layers": Case(
        "plane",
        {"values": normal(3, 5, 7, 2), "points": points_between(60, 7, 5, outside=1.5)},
        {"layer": _layers(60, 3).astype(np.int32)},
        {"periodic": True},
    ),
    "plane-one-cell": Case("plane", {"values": normal(1, 1, 17), "points": points_between(9, 1, 1)}),
    "volume": Case("volume", {"values": normal(4, 5, 7, 3), "points": points_between(60, 7, 5, 4, outside=0.5)}),
    "volume-periodic-layers": Case(
        "volume",
        {"values": normal(3, 4, 1, 6, 2), "points": points_between(60, 6, 1, 4, outside=1.5)},
        {"layer": _layers(60, 3)},
        {"periodic": True},
    ),
    "triplane": Case("triplane", _THIRDS | _SPACE),
    "triplane-product": Case("triplane", _THIRDS | _SPACE, {}, {"reduce": "product"}),
    "triplane-concatenate": Case("triplane", _THIRDS | _SPACE, {}, {"reduce": "concatenate"}),
    **{f"mlp-{width}": Case("mlp", network_of(16, width, 3, 3)) for width in (8, 16, 17, 32, 64)},
    "mlp-tanh": Case("mlp", network_of(5, 16, 4, 2), options={"gelu": "tanh"}),
    "mlp-fast": Case("mlp", network_of(5, 17, 1), options={"gelu": "fast"}),
    "gaussian_sum": Case("gaussian_sum", {"rows": gaussians(24, 5), "points": _ANYWHERE}, options={"cut": 6.0}),
    "gaussian_sum-sphere": Case("gaussian_sum", {"rows": gaussians(9, 17), "points": _ANYWHERE}, options=_SPHERE),
    "gaussian_sum-lists": Case(
        "gaussian_sum",
        {"rows": gaussians(300, 1), "points": uniform(0.0, 1.0, 500, 3)},
    ),
    "march": _smoke(_THIN, step=0.8, g=0.4),
    "march-inside": _smoke(_THIN, distance=1.0, step=2.5, g=-0.6),
    "march-transmittance": _smoke(_THIN, lights=0, emitting=False),
    "march-emission": _smoke(_THIN, lights=0),
    "march-thin": _smoke(0.12 * _THIN, lights=0),
    "march-light": _smoke(_THIN, lights=1, emitting=False),
    "march-opaque": _smoke(300.0 * _THIN, step=0.8),
    "march-no-smoke": _smoke(0.0 * _THIN),
    "march-one-voxel": _smoke(uniform(0.5, 1.0, 1, 1, 1), step=0.3),
}
FIRST = {case.op: name for name, case in reversed(CASES.items())}  # one of each operation
