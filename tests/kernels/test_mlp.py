"""The MLP: forward, backward by hand, and the path that a tape records, at the widths that the settings allow."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import network as reference

from kernels.compare import array, close, exact
from wlm_kernels import mlp

INPUTS, NETWORKS, BATCH = 16, 3, 37
WIDTHS = (8, 16, 17, 32, 64)  # a loop above 16 is no longer unrolled; 17 is no multiple of anything
# The GPU's tanh instruction is within 2^-11 relative; x (1 - tanh) and x (1 - tanh^2) carry that to the gradients.
FAST = {"value": 2e-3, "gradient": 5e-3}
EXACT = {"value": 5e-6, "gradient": 1e-5}  # float32 gives 5e-7; a slope that is 0.1% off shows


def _network(width: int, inputs: int = INPUTS, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Weights and biases of networks whose answers are of the order of 1."""
    random = np.random.default_rng(seed)
    hidden = random.normal(0, 1, (NETWORKS, inputs + width + 2, width))
    hidden[:, :inputs] /= inputs**0.5
    hidden[:, inputs + 1 : -1] /= width**0.5
    output = random.normal(0, 1, (NETWORKS, width + 1, 3)) / width**0.5
    return hidden.astype(np.float32), output.astype(np.float32)


def _tolerances(gelu: str, device: str) -> dict[str, float]:
    return FAST if gelu == "fast" and device != "cpu" else EXACT


def _by_hand(net: mlp.MlpKernels, device: str, hidden, output, x, toward) -> list[wp.array]:
    """y and the gradients of x, hidden and output, by the hand-written kernels."""
    w, o = array(hidden, net.vec_hidden, device), array(output, wp.vec3, device)
    inputs = array(x, net.vec_in, device)
    y = wp.zeros(inputs.shape, dtype=wp.vec3, device=device)
    net.forward(w, o, inputs, y)
    grads = [wp.zeros_like(inputs), wp.zeros_like(w), wp.zeros_like(o)]
    net.backward(w, o, inputs, array(toward, wp.vec3, device), *grads)
    return [y, *grads]


def _by_autograd(gelu: str, hidden, output, x, toward) -> list[torch.Tensor]:
    w, o, inputs = exact(hidden, grad=True), exact(output, grad=True), exact(x, grad=True)
    y = reference.mlp(w, o, inputs, gelu)
    y.backward(exact(toward))
    return [y, inputs.grad, w.grad, o.grad]


def _hold(got, want, tolerances: dict[str, float]) -> None:
    close(got[0], want[0], tolerances["value"], "y")
    for name, a, b in zip(("x", "hidden", "output"), got[1:], want[1:], strict=True):
        close(a, b, tolerances["gradient"], f"gradient of {name}")


def _inputs(width_in: int = INPUTS, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x = random.normal(size=(NETWORKS, BATCH, width_in)).astype(np.float32)
    return x, random.normal(size=(NETWORKS, BATCH, 3)).astype(np.float32)


@pytest.mark.parametrize("width", WIDTHS)
def test_exact_against_autograd(device: str, width: int):
    """Values and every gradient, by hand, with the exact GELU."""
    problem = (*_network(width), *_inputs())
    got = _by_hand(mlp.kernels(INPUTS, width, "exact"), device, *problem)
    _hold(got, _by_autograd("exact", *problem), EXACT)


CHEAP = [
    pytest.param(gelu, width, marks=[] if width in (16, 17) else pytest.mark.slow)
    for gelu in ("tanh", "fast")
    for width in WIDTHS
]


@pytest.mark.parametrize(("gelu", "width"), CHEAP)
def test_tanh_forms_against_autograd(device: str, gelu: str, width: int):
    """The cheaper GELUs; "fast" is exact on the CPU, and within its stated error on a GPU."""
    problem = (*_network(width), *_inputs())
    got = _by_hand(mlp.kernels(INPUTS, width, gelu), device, *problem)
    _hold(got, _by_autograd(gelu, *problem), _tolerances(gelu, device))


def test_static_shape(device: str):
    """A tile without temporal maps has 4 inputs."""
    problem = (*_network(16, inputs=4), *_inputs(4))
    got = _by_hand(mlp.kernels(4, 16, "exact"), device, *problem)
    _hold(got, _by_autograd("exact", *problem), EXACT)


@pytest.mark.parametrize("width", [16, 17])
def test_by_hand_against_differences(device: str, width: int):
    """The derivative along a random direction of all parameters and inputs, by central differences."""
    hidden, output = _network(width)
    x, toward = _inputs()
    net = mlp.kernels(INPUTS, width, "exact")
    _, grad_x, grad_w, grad_o = _by_hand(net, device, hidden, output, x, toward)
    random = np.random.default_rng(3)
    values = (hidden, output, x)
    step = [0.02 * random.normal(size=v.shape).astype(np.float32) for v in values]

    def objective(sign: float) -> float:
        moved = [v + np.float32(sign) * d for v, d in zip(values, step, strict=True)]
        y = _by_hand(net, device, *moved, toward)[0].numpy()
        return float((y.astype(np.float64) * toward).sum())

    # Two step lengths together leave an error of the fifth order.
    slope = (8.0 * (objective(0.5) - objective(-0.5)) - (objective(1.0) - objective(-1.0))) / 6.0
    pairs = zip((grad_w, grad_o, grad_x), step, strict=True)
    along = sum(float((g.numpy().astype(np.float64) * d).sum()) for g, d in pairs)
    assert slope == pytest.approx(along, rel=1e-3)


@pytest.mark.parametrize("width", WIDTHS)
def test_tape_against_autograd(device: str, width: int):
    """``linear`` and ``activate`` under a tape: no width loses its gradient to a loop that isn't replayed."""
    hidden, output = _network(width)
    x, toward = _inputs()
    w = array(hidden.reshape(NETWORKS, -1), float, device, grad=True)
    o = array(output.reshape(NETWORKS, -1), float, device, grad=True)
    rows = NETWORKS * BATCH
    inputs = array(x.reshape(rows, INPUTS), float, device, grad=True)
    groups = array(np.repeat(np.arange(NETWORKS), BATCH).astype(np.int32), int, device)

    def layer(weights, first: int, bias: int, x: wp.array, size: int) -> wp.array:
        y = wp.zeros((rows, size), dtype=float, device=device, requires_grad=True)
        mlp.linear(weights, first, bias, x, groups, y)
        return y

    def gelu(x: wp.array) -> wp.array:
        y = wp.zeros_like(x)
        mlp.activate(x, y)
        return y

    with wp.Tape() as tape:
        h1 = gelu(layer(w, 0, INPUTS, inputs, width))
        h2 = gelu(layer(w, INPUTS + 1, INPUTS + 1 + width, h1, width))
        y = layer(o, 0, width, h2, 3)
    tape.backward(grads={y: array(toward.reshape(rows, 3), float, device)})
    shapes = (toward.shape, x.shape, hidden.shape, output.shape)
    got = [a.numpy().reshape(s) for a, s in zip((y, inputs.grad, w.grad, o.grad), shapes, strict=True)]
    _hold(got, _by_autograd("exact", hidden, output, x, toward), EXACT)


@pytest.mark.parametrize("gelu", mlp.GELUS)
def test_large_inputs(device: str, gelu: str):
    """Far out GELU is 0 or x and its slope 0 or 1: finite, and still the reference's."""
    hidden, output = _network(16)
    x, toward = _inputs()
    x = np.where(x > 0, np.float32(30.0), np.float32(-30.0))
    problem = (hidden, output, x, toward)
    got = _by_hand(mlp.kernels(INPUTS, 16, gelu), device, *problem)
    _hold(got, _by_autograd(gelu, *problem), _tolerances(gelu, device))


def test_zero_weights(device: str):
    """A network of zeros answers 0, moves only its last bias, and divides by nothing."""
    hidden, output = (np.zeros_like(values) for values in _network(17))
    x, toward = _inputs()
    y, grad_x, grad_w, grad_o = _by_hand(mlp.kernels(INPUTS, 17, "exact"), device, hidden, output, x, toward)
    for values in (y, grad_x, grad_w, grad_o.numpy()[:, :-1]):
        values = values if isinstance(values, np.ndarray) else values.numpy()
        np.testing.assert_array_equal(values, 0.0)
    np.testing.assert_allclose(grad_o.numpy()[:, -1], toward.sum(1), rtol=1e-4, atol=1e-4)


def test_gradients_repeat(device: str):
    """Sums run in a fixed order: the same gradients, bit for bit."""
    problem = (*_network(32), *_inputs())
    net = mlp.kernels(INPUTS, 32, "exact")
    first, second = (_by_hand(net, device, *problem) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())


def test_tanh_form_is_near_the_exact_one():
    """The stated distance of the tanh form, 4.8e-4, in float64; its kernels are held to it above."""
    x = torch.linspace(-8, 8, 100001, dtype=torch.float64)
    forms = [torch.nn.functional.gelu(x, approximate=name) for name in ("none", "tanh")]
    assert float((forms[0] - forms[1]).abs().max()) < 4.8e-4


def test_shapes_are_checked():
    """A width below 1 or an unknown GELU is an error, and a shape is built once."""
    assert mlp.parameter_count(16, 16) == 16 * 16 + 16 + 16 * 16 + 16 + 16 * 3 + 3
    assert mlp.kernels(16, 8) is mlp.kernels(16, 8)
    for wrong in ((0, 8, "exact"), (4, 0, "exact"), (4, 8, "relu")):
        with pytest.raises(ValueError, match="no MLP"):
            mlp.kernels(*wrong)
