"""Functions for kernels of one's own, against the twins in float64 and the operations of the same names."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from builders import operation_cases
from builders.operation_cases import gaussians, network_of, normal, points_between, uniform
from kernels.compare import close

from benchmarks import plain
from wlm import ops
from wlm.ops import funcs

NETWORK = funcs.network(5, 17, 4)
TANH = funcs.network(5, 17, 4, "tanh")


@wp.kernel
def _plane(values: wp.array2d[wp.vec2], points: wp.array1d[wp.vec2], out: wp.array1d[wp.vec2]):
    i = wp.tid()
    out[i] = funcs.plane(values, points[i], False)


@wp.kernel
def _layers(values: wp.array3d[float], points: wp.array1d[wp.vec2], layer: wp.array1d[int], out: wp.array1d[float]):
    i = wp.tid()
    out[i] = funcs.plane(values[layer[i]], points[i], True)


@wp.kernel
def _volume(values: wp.array3d[wp.vec3], points: wp.array1d[wp.vec3], out: wp.array1d[wp.vec3]):
    i = wp.tid()
    out[i] = funcs.volume(values, points[i], True)


@wp.kernel
def _triplane(
    xy: wp.array2d[wp.vec3],
    xz: wp.array2d[wp.vec3],
    yz: wp.array2d[wp.vec3],
    points: wp.array1d[wp.vec3],
    out: wp.array1d[wp.vec3],
):
    i = wp.tid()
    out[i] = funcs.triplane(xy, xz, yz, points[i])


@wp.kernel
def _texels(endpoints: wp.array3d[wp.vec4], weights: wp.array2d[float], quantised: bool, out: wp.array2d[wp.vec4]):
    i, j = wp.tid()
    out[i, j] = funcs.bc7_texel(endpoints, weights, i, j, quantised)


@wp.kernel
def _mlp(
    x: wp.array2d[NETWORK.vec_in],
    hidden: wp.array2d[NETWORK.vec_hidden],
    output: wp.array2d[NETWORK.vec_out],
    out: wp.array2d[NETWORK.vec_out],
):
    n, i = wp.tid()
    out[n, i] = NETWORK.evaluate(hidden, output, n, x[n, i])


@wp.kernel
def _mlp_of_slices(
    x: wp.array2d[NETWORK.vec_in],
    hidden: wp.array3d[NETWORK.vec_hidden],
    output: wp.array3d[NETWORK.vec_out],
    out: wp.array2d[NETWORK.vec_out],
):
    n, i = wp.tid()
    # Two functions of one signature in one module.
    exact = NETWORK.evaluate(hidden[n], output[n], 0, x[n, i])
    out[n, i] = exact + TANH.evaluate(hidden[n], output[n], 0, x[n, i])


@wp.kernel
def _gaussian_sum(rows: wp.array2d[float], points: wp.array1d[wp.vec3], cut: float, sums: wp.array2d[float]):
    k, i = wp.tid()
    centre = wp.vec3(rows[k, 0], rows[k, 1], rows[k, 2])
    log_scale = wp.vec3(rows[k, 3], rows[k, 4], rows[k, 5])
    rotation = wp.vec4(rows[k, 6], rows[k, 7], rows[k, 8], rows[k, 9])
    weight = funcs.gaussian_weight(centre, log_scale, rotation, points[i], cut)
    for c in range(sums.shape[1]):
        wp.atomic_add(sums, i, c, weight * rows[k, 10 + c])


def _on_tape(
    kernel: Any, size: tuple[int, ...], arguments: dict[str, Any], result: wp.array, adjoint: np.ndarray
) -> dict[str, np.ndarray]:
    """Launches a kernel on a tape, and returns the gradients of the arguments that require one."""
    tape = wp.Tape()
    with tape:
        wp.launch(kernel, size, inputs=[*arguments.values()], outputs=[result], device=result.device)
    tape.backward(grads={result: wp.array(adjoint, dtype=result.dtype, device=result.device)})
    return {n: a.grad.numpy().copy() for n, a in arguments.items() if isinstance(a, wp.array) and a.requires_grad}


def _twin(run: Callable, leaves: dict[str, np.ndarray], adjoint: np.ndarray) -> tuple[np.ndarray, dict]:
    """The twin's values in float64, and per leaf a direction and the slope along it, by central differences."""
    exact = {name: torch.tensor(values, dtype=torch.float64) for name, values in leaves.items()}
    weights = torch.tensor(adjoint, dtype=torch.float64)
    slopes = {}
    for name, value in exact.items():
        along = torch.sign(torch.tensor(normal(*value.shape, seed=30), dtype=torch.float64))

        def at(step: float, name=name, value=value, along=along) -> float:
            return float((run(**exact | {name: value + step * along}) * weights).sum())

        slopes[name] = (along.numpy(), (at(1e-6) - at(-1e-6)) / 2e-6)
    return run(**exact).numpy(), slopes


CASES = {
    "plane": (_plane, {"values": normal(5, 7, 2), "points": points_between(60, 7, 5, outside=0.5)}, plain.plane),
    "volume": (
        _volume,
        {"values": normal(4, 5, 7, 3), "points": points_between(60, 7, 5, 4, outside=1.5)},
        lambda **leaves: plain.volume(**leaves, periodic=True),
    ),
    "triplane": (
        _triplane,
        {name: operation_cases.CASES["triplane"].leaves[name] for name in ("xy", "xz", "yz", "points")},
        plain.triplane,
    ),
    "mlp": (_mlp, network_of(5, 17, 4, 2), plain.mlp),
}


def _array(values: np.ndarray, device: str, grad: bool = True) -> wp.array:
    return wp.array(values, dtype=wp.types.vector(values.shape[-1], float), device=device, requires_grad=grad)


@pytest.mark.parametrize("name", CASES)
def test_against_differences(device: str, name: str):
    """Values and gradients, against the twin in float64 and its central differences."""
    kernel, leaves, twin = CASES[name]
    arrays = {leaf: _array(values, device) for leaf, values in leaves.items()}
    where = arrays["x" if name == "mlp" else "points"].shape
    result = wp.zeros(where, dtype=kernel.adj.args[-1].type.dtype, device=device, requires_grad=True)
    adjoint = normal(*where, result.dtype._length_, seed=20)
    grads = _on_tape(kernel, where, arrays, result, adjoint)
    values, slopes = _twin(twin, leaves, adjoint)
    close(result, values, 1e-5)
    for leaf, (along, slope) in slopes.items():
        assert grads[leaf].any()
        scale = max(abs(slope), 0.1 * float(np.linalg.norm(grads[leaf])))
        assert abs(float((grads[leaf] * along).sum()) - slope) < 1e-4 * scale, leaf


def test_layers_and_arrays_without_a_gradient(device: str):
    """A slice passes gradients on to the whole, and an array that requires none is left alone."""
    values, points = normal(3, 5, 7), points_between(60, 7, 5, outside=1.5)
    layer = np.arange(60, dtype=np.int32) % 3
    arguments = {
        "values": wp.array(values, dtype=float, device=device, requires_grad=True),
        "points": _array(points, device, grad=False),
        "layer": wp.array(layer, dtype=int, device=device),
    }
    result = wp.zeros(60, dtype=float, device=device, requires_grad=True)
    grads = _on_tape(_layers, (60,), arguments, result, normal(60, seed=20))
    assert [*grads] == ["values"]
    leaf = torch.tensor(values[..., None], device=device).requires_grad_()
    points, layer = torch.tensor(points, device=device), torch.tensor(layer, device=device)
    sampled = ops.plane(leaf, points, layer=layer, periodic=True)
    sampled[:, 0].backward(torch.tensor(normal(60, seed=20), device=device))
    close(result, sampled[:, 0], 1e-6)
    close(grads["values"], leaf.grad[..., 0], 1e-5)


def _texels_on_tape(leaves: dict, quantised: bool, adjoint: np.ndarray, device: str) -> tuple[wp.array, dict]:
    endpoints = _array(leaves["endpoints"], device)
    weights = wp.array(leaves["weights"], dtype=float, device=device, requires_grad=True)
    result = wp.zeros(weights.shape, dtype=wp.vec4, device=device, requires_grad=True)
    arguments = {"endpoints": endpoints, "weights": weights, "quantised": quantised}
    return result, _on_tape(_texels, weights.shape, arguments, result, adjoint)


@pytest.mark.parametrize("quantised", [False, True])
def test_texels(device: str, quantised: bool):
    """The texels and straight-through gradients of `bc7_texels`, inside [0, 1] and outside."""
    leaves = {"endpoints": uniform(-0.3, 1.3, 2, 3, 2, 4), "weights": uniform(-0.3, 1.3, 8, 12)}
    adjoint = normal(8, 12, 4)
    result, grads = _texels_on_tape(leaves, quantised, adjoint, device)
    exact = {name: torch.tensor(values, dtype=torch.float64).requires_grad_() for name, values in leaves.items()}
    texels = plain.bc7_texels(**exact, quantised=quantised)
    texels.backward(torch.tensor(adjoint, dtype=torch.float64))
    close(result, texels, 1e-6)
    for name, leaf in exact.items():
        close(grads[name], leaf.grad, 1e-5, name)


def test_networks_of_slices(device: str):
    """Weights in slices of arrays get their gradients, by two activations at once."""
    leaves = network_of(5, 17, 4, 3)
    arrays = {name: _array(values if name == "x" else values[:, None], device) for name, values in leaves.items()}
    result = wp.zeros((3, 37), dtype=NETWORK.vec_out, device=device, requires_grad=True)
    adjoint = normal(3, 37, 4)
    grads = _on_tape(_mlp_of_slices, (3, 37), arrays, result, adjoint)
    exact = {name: torch.tensor(values, dtype=torch.float64).requires_grad_() for name, values in leaves.items()}
    y = plain.mlp(**exact) + plain.mlp(**exact, gelu="tanh")
    y.backward(torch.tensor(adjoint, dtype=torch.float64))
    close(result, y, 1e-5)
    for name, leaf in exact.items():
        close(grads[name].reshape(leaf.shape), leaf.grad, 1e-5, name)


def test_gaussians_by_hand_and_by_the_tape(device: str):
    """Warp's own gradients of the twin are those of the operation by hand, and of differences in float64."""
    leaves = {"rows": gaussians(24, 5), "points": uniform(0.0, 1.0, 80, 3)}
    adjoint = normal(80, 5)
    rows = wp.array(leaves["rows"], dtype=float, device=device, requires_grad=True)
    points = wp.array(leaves["points"], dtype=wp.vec3, device=device, requires_grad=True)
    result = wp.zeros((80, 5), dtype=float, device=device, requires_grad=True)
    arguments = {"rows": rows, "points": points, "cut": 6.0}
    grads = _on_tape(_gaussian_sum, (24, 80), arguments, result, adjoint)
    values, slopes = _twin(lambda **of: plain.gaussian_sum(**of, cut=6.0), leaves, adjoint)
    close(result, values, 1e-5)
    for name, (along, slope) in slopes.items():
        assert abs(float((grads[name] * along).sum()) - slope) < 1e-4 * abs(slope), name
        arguments[name].grad.zero_()
    tape = wp.Tape()
    with tape:
        by_hand = ops.gaussian_sum(rows, points, cut=6.0)
    tape.backward(grads={by_hand: wp.array(adjoint, dtype=float, device=device)})
    close(result, by_hand, 1e-5)
    for name, grad in grads.items():
        close(grad, arguments[name].grad, 1e-5, name)


@pytest.mark.slow
def test_compiled_for_cuda(tmp_path: Path):
    """The functions and their gradients compile for a GPU on machines without one."""
    made = wp.compile_aot_module(_plane.module, arch=[90], module_dir=tmp_path, use_ptx=True)
    assert [path for path in made if path.suffix == ".ptx" and path.stat().st_size > 0]
