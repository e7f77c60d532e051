"""Measures the differentiable operations: their errors against float64, and their times beside the references in torch.

The references, `benchmarks.plain`, are what a reader would write in torch; they use as many threads as torch does, and
a call of an operation on a CPU one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from benchmarks import plain
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, check_only
from wlm import ops
from wlm.ops.views import View, clip_positions, normalised

_FEW = 2  # samples of a call of a reference


@dataclass(frozen=True, eq=False)
class Work:
    """A call of an operation.

    Attributes:
        op: Name of the operation.
        text: Sizes, for a reader.
        leaves: Arguments with a gradient.
        constants: Other arrays.
        options: Other arguments.
        call: Calls the operation of a module with tensors by name; returns its results, of which all floats have
            gradients.
    """

    op: str
    text: str
    leaves: Mapping[str, np.ndarray]
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    call: Callable[..., Any] | None = None

    def tensors(self, device: str, dtype: torch.dtype) -> dict[str, torch.Tensor]:
        """Returns all arrays as tensors, floats of one type."""
        made = {name: torch.tensor(values, device=device) for name, values in {**self.leaves, **self.constants}.items()}
        made = {name: each.to(dtype) if each.is_floating_point() else each for name, each in made.items()}
        return {name: each.requires_grad_(name in self.leaves) for name, each in made.items()}

    def run(self, module: Any, tensors: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns the results by `wlm.ops` or `benchmarks.plain`."""
        call = self.call or getattr(module, self.op)
        results = call(module, **tensors) if self.call else call(**tensors, **self.options)
        return results if isinstance(results, tuple) else (results,)


def _normal(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def _uniform(*shape: int, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def make_sphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns a closed, bumpy sphere of 4 rings^2 triangles before a camera: clip [V, 4], triangles [F, 3]."""
    sectors = 2 * rings
    height, turn = np.meshgrid(np.linspace(0.0, np.pi, rings + 2)[1:-1], np.arange(sectors) / sectors * 2.0 * np.pi)
    place = np.stack([np.sin(height) * np.cos(turn), np.cos(height), np.sin(height) * np.sin(turn)], -1).reshape(-1, 3)
    place = np.concatenate([place * (1.0 + 0.1 * _uniform(len(place), 1)), [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    i, j = (each.reshape(-1) for each in np.meshgrid(np.arange(sectors), np.arange(rings - 1), indexing="ij"))
    a, b = i * rings + j, (i + 1) % sectors * rings + j
    first, after = np.arange(sectors) * rings, (np.arange(sectors) + 1) % sectors * rings
    top, bottom = np.full(sectors, len(place) - 2), np.full(sectors, len(place) - 1)
    faces = [(a, b, a + 1), (b, b + 1, a + 1), (top, after, first), (bottom, first + rings - 1, after + rings - 1)]
    triangle = np.concatenate([np.stack(face, 1) for face in faces])
    return clip_positions(normalised(place, triangle), View.of([1.0, 0.4, 0.7])), triangle


def _drawn(rings: int, size: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    clip, triangle = make_sphere(rings)
    raster = ops.rasterize(torch.tensor(clip), torch.tensor(triangle), size, size)
    fields = {"visible": raster.triangle, "barycentric": raster.barycentric, "depth": raster.depth}
    return clip, triangle, {name: tensor.numpy() for name, tensor in fields.items()}


def _raster(visible: torch.Tensor, barycentric: torch.Tensor, depth: torch.Tensor) -> ops.Raster:
    return ops.Raster(visible, barycentric, depth, None, None)


def _rasterize(module: Any, clip: torch.Tensor, triangle: torch.Tensor) -> torch.Tensor:
    return module.rasterize(clip, triangle, 64, 64).barycentric


def _interpolate(module: Any, attribute, triangle, **pixels) -> torch.Tensor:
    return module.interpolate(attribute, triangle, _raster(**pixels))


def _antialias(module: Any, colour, clip, triangle, **pixels) -> torch.Tensor:
    return module.antialias(colour, _raster(**pixels), clip, triangle)


def works() -> dict[str, Work]:
    """Returns the measured calls by name: the operation's, or with a word behind it."""
    rows = _normal(256, 18)
    rows[:, :3], rows[:, 3:6] = _uniform(256, 3), -2.5 + 0.3 * rows[:, 3:6]
    direction = np.float32([0.36, 0.48, 0.8]) + 0.1 * _normal(1024, 3)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    march = {
        "density": 0.2 * _uniform(24, 24, 24),
        "colour": _uniform(2, 3),
    }
    rays = {"origin": np.float32([12.0, 12.0, 12.0]) + 4.0 * _normal(1024, 3, seed=3) - 30.0 * direction}
    rays["direction"] = direction
    toward = {"toward": np.float32([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])}
    clip, triangle = make_sphere(8)
    fine, faces, pixels = _drawn(8, 256)
    image, uv = _normal(512, 512, 4), _uniform(65536, 2)
    made = [
        Work("bc7_texels", "512 x 512 texels", {"endpoints": _uniform(128, 128, 2, 4), "weights": _uniform(512, 512)}),
        Work(
            "bc7_map",
            "256 x 256 texels, 65,536 points",
            {"endpoints": _uniform(64, 64, 2, 4), "weights": _uniform(256, 256), "uv": _uniform(65536, 2)},
        ),
        Work("plane", "256 x 256 x 16, 65,536 points", {"values": _normal(256, 256, 16), "points": _uniform(65536, 2)}),
        Work(
            "volume",
            "32 x 32 x 32 x 8, 65,536 points",
            {"values": _normal(32, 32, 32, 8), "points": _uniform(65536, 3)},
        ),
        Work(
            "triplane",
            "three of 128 x 128 x 8, 65,536 points",
            {**{name: _normal(128, 128, 8) for name in ("xy", "xz", "yz")}, "points": _uniform(65536, 3)},
        ),
        Work(
            "mlp",
            "16 of 16-32-32-3, 4,096 points each",
            {
                "x": _normal(16, 4096, 16),
                "hidden": _normal(16, 50, 32) / 32**0.5,
                "output": _normal(16, 33, 3) / 32**0.5,
            },
            options={"gelu": "tanh"},
        ),
        Work("gaussian_sum", "256 of 8 numbers, 8,192 points", {"rows": rows, "points": _uniform(8192, 3)}),
        Work(
            "rasterize", f"{len(triangle)} triangles, 64 x 64", {"clip": clip}, {"triangle": triangle}, call=_rasterize
        ),
        Work(
            "interpolate",
            "256 x 256 x 8",
            {"attribute": _normal(len(fine), 8), "barycentric": pixels["barycentric"]},
            {"triangle": faces, "visible": pixels["visible"], "depth": pixels["depth"]},
            call=_interpolate,
        ),
        Work("texture", "512 x 512 x 4, 65,536 points", {"image": image, "uv": uv}),
        Work(
            "texture",
            "the same, from mip levels",
            {"image": image, "uv": uv, "derivatives": 0.01 * _normal(65536, 2, 2)},
        ),
        Work(
            "antialias",
            f"{len(faces)} triangles, 256 x 256 x 3",
            {"colour": _uniform(256, 256, 3), "clip": fine},
            {"triangle": faces, **pixels},
            call=_antialias,
        ),
        Work("march", "24 x 24 x 24, 1,024 rays, 2 lights", march, {**toward, **rays}, {"g": 0.4}),
        Work("march", "the same, with gradients of rays", {**march, **rays}, toward, {"g": 0.4}),
    ]
    twice = [work.op for work in made]
    return {work.op + (" more" if work.op in twice[:i] else ""): work for i, work in enumerate(made)}


def run(*, device: str, only: Sequence[str] | None = None, progress: Note | None = None) -> list[Row]:
    """Measures operations.

    Args:
        device: "cpu" or "cuda:0".
        only: Names of `works`; None: all.
        progress: Called with a line before each part of the work.

    Returns:
        A row for each call: the largest error of its values and of its gradients, as a share of the largest number of
        the tensor; and the times forward and backward, beside those of the reference in torch.

    Raises:
        WlmError: There is no such call.
    """
    chosen = works()
    check_only(only or [], list(chosen))
    bench = Bench("ops", device, progress, scene="operations", few=_FEW)
    return [_measured(bench, chosen[name]) for name in (only or chosen)]


def _measured(bench: Bench, work: Work) -> Row:
    bench.note(f"{work.op}, {work.text}")
    own, adjoints = _calls(work, ops, bench.device)
    reference, _ = _calls(work, plain, bench.device)
    row = bench.row(work.op, work.text, **_errors(work, bench.device, adjoints))
    times = {**bench.time(own), **bench.time({f"torch_{name}": call for name, call in reference.items()}, few=True)}
    for name, timing in times.items():
        row = row.with_timing(replace(timing, n=1), f"{name}_ms")
    return row


def _adjoints(results: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    return [torch.from_numpy(_normal(*each.shape, seed=20 + i)).to(each) for i, each in enumerate(results)]


def _calls(work: Work, module: Any, device: str) -> tuple[dict[str, Callable[[], object]], list[torch.Tensor]]:
    tensors = work.tensors(device, torch.float32)
    leaves = [tensors[name] for name in work.leaves]
    results = work.run(module, tensors)
    adjoints = _adjoints(results)

    def backward() -> object:
        return torch.autograd.grad(results, leaves, adjoints, retain_graph=True)

    return {"forward": lambda: work.run(module, tensors), "backward": backward}, adjoints


def _errors(work: Work, device: str, adjoints: Sequence[torch.Tensor]) -> dict[str, float]:
    found = []
    for module, place, dtype in ((ops, device, torch.float32), (plain, "cpu", torch.float64)):
        tensors = work.tensors(place, dtype)
        results = work.run(module, tensors)
        towards = [each.to(result) for each, result in zip(adjoints, results, strict=True)]
        grads = torch.autograd.grad(results, [tensors[name] for name in work.leaves], towards)
        found.append(([each.detach() for each in results], grads))
    (values, grads), (values64, grads64) = found
    return {"value_error": _largest(values, values64), "gradient_error": _largest(grads, grads64)}


def _largest(found: Sequence[torch.Tensor], exact: Sequence[torch.Tensor]) -> float:
    """Returns the largest error of tensors, each as a share of the tensor's largest number."""
    pairs = [(a.detach().cpu().double(), b) for a, b in zip(found, exact, strict=True)]
    return max(float((a - b).abs().max() / b.abs().max()) for a, b in pairs)
