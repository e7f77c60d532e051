"""Operations on Warp arrays under `wp.Tape`, against the same operations on torch tensors under autograd."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from builders.operation_cases import normal
from builders.operation_subjects import WITHOUT, Subject, drawing, subjects
from kernels.compare import close

from wlm import ops
from wlm.errors import WlmError


def _array(values: np.ndarray, device: str, grad: bool = False, vectors: bool = True) -> wp.array:
    """An array, of vectors along the last axis where Warp has no other way to have five axes, or if asked to."""
    dtype: Any = {np.dtype(np.float32): float, np.dtype(np.int32): int, np.dtype(np.int64): wp.int64}[values.dtype]
    if values.ndim > 4 or (vectors and dtype is float and values.ndim > 1 and values.shape[-1] > 1):
        dtype = wp.types.vector(values.shape[-1], float)
    return wp.array(values, dtype=dtype, device=device, requires_grad=grad)


def _by_torch(subject: Subject, device: str) -> tuple[list, dict]:
    """Values, and gradients by leaf for random adjoints."""
    leaves = {name: torch.tensor(values, device=device).requires_grad_() for name, values in subject.leaves.items()}
    constants = {name: torch.tensor(values, device=device) for name, values in subject.constants.items()}
    values = subject.run(**leaves, **constants)
    adjoints = [torch.from_numpy(normal(*v.shape, seed=20 + i)).to(v) for i, v in enumerate(values)]
    pairs = [pair for pair in zip(values, adjoints, strict=True) if pair[0].requires_grad]
    torch.autograd.backward(*zip(*pairs, strict=True))
    return [v.detach().cpu().numpy() for v in values], {n: leaf.grad.cpu().numpy() for n, leaf in leaves.items()}


def _by_tape(subject: Subject, device: str, vectors: bool = True) -> tuple[list, dict]:
    leaves = {name: _array(values, device, True, vectors) for name, values in subject.leaves.items()}
    constants = {name: _array(values, device, False, vectors) for name, values in subject.constants.items()}
    tape = wp.Tape()
    with tape:
        values = subject.run(**leaves, **constants)
    assert len(tape.launches) == 1, "one function, and none of the launches inside"
    random = [normal(*v.numpy().shape, seed=20 + i) for i, v in enumerate(values)]
    adjoints = [wp.array(each, dtype=v.dtype, device=device) for each, v in zip(random, values, strict=True)]
    tape.backward(grads={v: a for v, a in zip(values, adjoints, strict=True) if v.requires_grad})
    grads = {name: leaf.grad.numpy().reshape(subject.leaves[name].shape) for name, leaf in leaves.items()}
    return [v.numpy() for v in values], grads


@pytest.mark.parametrize("name", ops.__all__)
def test_gradients_are_those_of_torch(device: str, name: str):
    if name in WITHOUT:
        return
    calls = subjects(name)
    assert calls, f"{name}: expected a case"
    for subject in calls:
        values, grads = _by_torch(subject, device)
        for vectors in (True, False):
            found, on_tape = _by_tape(subject, device, vectors)
            for value, other in zip(values, found, strict=True):
                assert np.array_equal(value, other)
            for leaf, grad in grads.items():
                close(on_tape[leaf], grad, 1e-5, f"{name}: {leaf}")


@wp.kernel
def _halve(x: wp.array2d[float], y: wp.array2d[float]):
    i, j = wp.tid()
    y[i, j] = 0.5 * x[i, j]


@wp.kernel
def _sum_squares(x: wp.array2d[float], total: wp.array1d[float]):
    i, j = wp.tid()
    wp.atomic_add(total, 0, x[i, j] * x[i, j])


def _chain(device: str) -> tuple[wp.Tape, wp.array, wp.array, wp.array]:
    """A kernel, two reads of one plane and a network's product of them, and a kernel: tape, leaves and loss."""
    values = _array(normal(5, 7, 2), device, True, False)
    points = _array(np.random.default_rng(1).uniform(0.0, 2.0, (20, 2)).astype(np.float32), device, True, False)
    halved = wp.zeros((20, 2), dtype=float, device=device, requires_grad=True)
    loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
    tape = wp.Tape()
    with tape:
        wp.launch(_halve, (20, 2), inputs=[points], outputs=[halved], device=device)
        once = ops.plane(values, halved)
        again = ops.plane(values, once, periodic=True)
        wp.launch(_sum_squares, (20, 2), inputs=[again], outputs=[loss], device=device)
    return tape, values, points, loss


def test_between_kernels(device: str):
    """Gradients pass from kernel to operation to kernel, of an array that is read twice; and they accumulate."""
    tape, values, points, loss = _chain(device)
    tensors = (wp.to_torch(a, requires_grad=False).clone().requires_grad_() for a in (values, points))
    torch_values, torch_points = tensors
    again = ops.plane(torch_values, ops.plane(torch_values, 0.5 * torch_points), periodic=True)
    again.square().sum().backward()
    tape.backward(loss)
    for count in (1, 2):
        close(values.grad, count * torch_values.grad, 1e-5, "values")
        close(points.grad, count * torch_points.grad, 1e-5, "points")
        if count == 1:
            tape.backward(loss)
    tape.zero()
    assert not values.grad.numpy().any() and not points.grad.numpy().any()
    tape.backward(loss)
    close(values.grad, torch_values.grad, 1e-5, "values after zero()")
    tape.reset()
    assert not tape.launches and not values.grad.numpy().any()


def test_one_array_for_two_arguments(device: str):
    grid, points = _array(normal(4, 4, 2), device, True), _array(normal(9, 3, seed=3) ** 2, device, True)
    tape = wp.Tape()
    with tape:
        result = ops.triplane(grid, grid, grid, points)
    tape.backward(grads={result: wp.ones_like(result)})
    twin = wp.to_torch(grid, requires_grad=False).clone().requires_grad_()
    ops.triplane(twin, twin, twin, wp.to_torch(points, requires_grad=False)).sum().backward()
    close(grid.grad, twin.grad, 1e-5)
    assert not result.grad.numpy().any(), "a result's gradient is used up, as after a launch"


def test_memory_is_shared(device: str):
    """A result is not copied, and neither is an argument: the same bits at the same place."""
    values = _array(normal(5, 7, 2), device)
    seen = []
    original = ops.plane.__wrapped__

    def spy(values, points):
        seen.extend([values.data_ptr(), original(values, points)])
        return seen[1]

    from wlm.ops.tapes import takes_arrays

    result = takes_arrays("values")(spy)(values, _array(normal(6, 2), device))
    assert seen[0] == values.ptr and seen[1].data_ptr() == result.ptr and not result.requires_grad


def test_without_a_tape_or_a_gradient(device: str):
    """Nothing is recorded, and results require no gradient."""
    for grad, tape in ((True, None), (False, wp.Tape())):
        values = _array(normal(5, 7, 2), device, grad)
        points = _array(normal(6, 2), device)
        if tape is None:
            assert not ops.plane(values, points).requires_grad
            continue
        with tape:
            assert not ops.plane(values, points).requires_grad
        assert not tape.launches


def test_views(device: str):
    """Slices and transposed arrays are read as they are, and their gradients are those of the whole."""
    whole = _array(normal(10, 14, 2), device, True, False)
    points = _array(np.random.default_rng(2).uniform(0, 1, (2, 6)).astype(np.float32), device, True, False)
    tape = wp.Tape()
    with tape:
        result = ops.plane(whole[::2, 3:10], points.transpose())
    tape.backward(grads={result: wp.ones_like(result)})
    twin, at = (wp.to_torch(a, requires_grad=False).clone().requires_grad_() for a in (whole, points))
    ops.plane(twin[::2, 3:10], at.T).sum().backward()
    close(whole.grad, twin.grad, 1e-5)
    close(points.grad, at.grad, 1e-5)


def test_drawing_to_the_end(device: str):
    """A `Raster` of arrays goes from one operation to the next."""
    clip = np.array([[-0.8, -0.7, 0.1, 1.0], [0.9, -0.8, 0.2, 1.5], [0.7, 0.9, 0.3, 1.2]], np.float32)
    triangle, image = np.array([[0, 1, 2]], np.int32), normal(6, 7, 3)
    uv = 0.5 + 0.5 * clip[:, :2]

    def picture(clip, uv, image, triangle):
        raster = ops.rasterize(clip, triangle, 9, 11, derivative=True)
        return raster, ops.texture(image, ops.interpolate(uv, triangle, raster))

    leaves = [torch.tensor(values, device=device).requires_grad_() for values in (clip, uv, image)]
    picture(*leaves, torch.tensor(triangle, device=device))[1].sum().backward()
    arrays = [_array(values, device, True) for values in (clip, uv, image)]
    tape = wp.Tape()
    with tape:
        raster, drawn = picture(*arrays, _array(triangle, device, vectors=False))
    assert isinstance(raster.triangle, wp.array) and raster.coverage is None and raster.count == 1
    assert raster.barycentric.requires_grad and not raster.depth.requires_grad and len(tape.launches) == 3
    tape.backward(grads={drawn: wp.ones_like(drawn)})
    for array, leaf in zip(arrays, leaves, strict=True):
        close(array.grad, leaf.grad, 1e-5)


def test_what_has_no_gradient_is_refused(device: str):
    """One line and never a gradient of zero, though only where a gradient is wanted."""
    march = next(s for s in subjects("march") if {"colour", "emission"} <= {*s.leaves})
    texture = drawing()["texture"][0].leaves
    layers = {"values": normal(3, 5, 7, 2), "points": normal(6, 2)}
    blocks = {"endpoints": normal(2, 3, 2, 4) ** 2, "weights": normal(8, 12) ** 2}
    calls = [
        (
            lambda name: march.run(
                **{key: _array(v, device, key == name) for key, v in (march.leaves | march.constants).items()}
            ),
            ("toward",),
        ),
        (
            lambda name: ops.texture(**{k: _array(v, device, k == name) for k, v in texture.items()}, filter="nearest"),
            ("uv",),
        ),
        (lambda name: ops.bc7_blocks(**{k: _array(v, device, k == name) for k, v in blocks.items()}), tuple(blocks)),
        (
            lambda name: ops.plane(
                **{k: _array(v, device) for k, v in layers.items()},
                layer=wp.zeros(6, dtype=int, device=device, requires_grad=name == "layer"),
            ),
            ("layer",),
        ),
    ]
    for call, names in calls:
        call("none")
        for name in names:
            tape = wp.Tape()
            with (
                pytest.raises(WlmError, match=f"^{name}: expected an argument that requires no gradient; ") as error,
                tape,
            ):
                call(name)
            assert "\n" not in str(error.value) and not tape.launches
    with pytest.raises(WlmError, match="^uv: expected an argument that requires no gradient; "):
        ops.texture(*(torch.tensor(v, device=device).requires_grad_() for v in texture.values()), filter="nearest")


def test_a_capture_by_warp_alone_is_refused():
    """Torch's memory isn't Warp's: a graph that Warp alone captures would write to memory that others use."""
    values, points = _array(normal(4, 5, 1), "cpu"), _array(normal(6, 2), "cpu")
    with pytest.raises(ValueError, match=r"^wlm.ops: expected a capture by torch\.cuda\.graph"):
        wp.capture_begin("cpu")
        try:
            ops.plane(values, points)
        finally:
            wp.capture_end("cpu")
