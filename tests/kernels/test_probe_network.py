"""The probes' network, forward and backward: loss and every gradient against autograd in float64."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import probe_network as reference

from kernels.compare import array, close, exact
from wlm_kernels.probe import network as probe_network
from wlm_kernels.probe import step as probe_step
from wlm_kernels.probe.step import GROUP

TOLERANCE = 1e-4  # of an array's largest gradient; float32 gives 3e-6 on the CPU, the GPU's own exp a little more
# Latent, units, outputs: the standard profile, the least of each, and what no multiple of 4 or 8 fits.
SHAPES = [(9, 64, 27), (1, 8, 3)]
# The paper's alternatives, and the largest.
OTHER_SHAPES = [(12, 48, 12), (9, 128, 75), (1, 128, 27), (12, 64, 3)]
BEHIND = 1e3  # what the padding holds: it must not matter


def _layers(net: np.ndarray, shape: tuple[int, int, int]) -> list[np.ndarray]:
    latent, hidden, outputs = shape
    return [layer.numpy() for layer in reference.layers(torch.as_tensor(net), latent + 3, hidden, outputs)]


class Pass:
    """Probes, weights and targets on a device, and what a launch writes."""

    def __init__(self, shape: tuple[int, int, int], count: int, device: str, parts: int = 1, seed: int = 1):
        latent, hidden, outputs = self.shape = shape
        self.count, self.device = count, device
        self.padded = -(-count // GROUP) * GROUP
        random = np.random.default_rng(seed)
        self.launches = probe_network.network_kernels(latent, hidden, outputs, "cpu" if device == "cpu" else "cuda")
        size = (latent + 4) * hidden + (hidden + 1) * (hidden + probe_network.padded(outputs))
        self.net = random.normal(size=size).astype(np.float32)
        for layer in _layers(self.net, shape):
            layer[:-1] *= 1.5 / np.sqrt(len(layer) - 1)
        # The last layer's unused columns hold no weights.
        _layers(self.net, shape)[2][:, outputs:] = 0.0
        self.x = random.random((self.padded, 3)).astype(np.float32)
        self.f = random.normal(size=(parts, latent, self.padded)).astype(np.float32)
        self.target = random.normal(size=(outputs, self.padded)).astype(np.float32)
        self.target[:, count:] = BEHIND
        self.f[:, :, count:] = BEHIND
        self.weight = random.random(outputs).astype(np.float32)
        groups = self.groups = probe_step.Groups()
        groups.x, groups.count = array(self.x, wp.vec3, device), count
        self.arrays = [array(v, float, device) for v in (self.f, self.target, self.weight, self.net)]
        lanes = self.launches.parts(self.padded)
        self.grad_f = wp.full((latent, self.padded), np.nan, dtype=float, device=device)
        self.partial = wp.zeros((lanes, len(self.net)), dtype=float, device=device)
        self.loss = wp.zeros(lanes, dtype=float, device=device)

    def launch(self, *lane: int) -> None:
        self.launches.launch(self.groups, *self.arrays, self.grad_f, self.partial, self.loss, *lane)

    def results(self) -> tuple[float, np.ndarray, np.ndarray]:
        """The loss, the gradient of f [L, N] with the padding, and that of the weights."""
        return self.loss.numpy().sum(dtype=np.float64), self.grad_f.numpy(), self.partial.numpy().sum(0, np.float64)

    def expected(self) -> tuple[float, np.ndarray, np.ndarray]:
        """The same over the probes alone."""
        net, f = exact(self.net, grad=True), exact(self.f.astype(np.float64).sum(0)[:, : self.count], grad=True)
        x, target = exact(self.x[: self.count]), exact(self.target[:, : self.count])
        loss = reference.loss(net, f, x, target, exact(self.weight), self.shape[1])
        loss.backward()
        return float(loss.detach()), f.grad.numpy(), net.grad.numpy()


def _hold(run: Pass) -> None:
    (loss, grad_f, grad), (want_loss, want_f, want) = run.results(), run.expected()
    assert loss == pytest.approx(want_loss, rel=1e-5)
    close(grad_f[:, : run.count], want_f, TOLERANCE, "gradient of the sums")
    assert not grad_f[:, run.count :].any(), "probes behind the last one give nothing"
    for i, (got_layer, want_layer) in enumerate(zip(_layers(grad, run.shape), _layers(want, run.shape), strict=True)):
        assert np.abs(want_layer[:-1]).max() > 0 and np.abs(want_layer[-1]).max() > 0
        close(got_layer[:-1], want_layer[:-1], TOLERANCE, f"weights of layer {i + 1}")
        close(got_layer[-1], want_layer[-1], TOLERANCE, f"biases of layer {i + 1}")
    assert not _layers(grad, run.shape)[2][:, run.shape[2] :].any(), "unused columns stay as they are"


@pytest.mark.parametrize(
    ("shape", "count"),
    [
        *((shape, 5 * GROUP + 29) for shape in SHAPES),
        *((SHAPES[0], count) for count in (1, GROUP - 1, GROUP)),
        *(pytest.param(shape, 2 * GROUP, marks=pytest.mark.slow) for shape in OTHER_SHAPES),
    ],
)
def test_against_autograd(device: str, shape: tuple[int, int, int], count: int):
    """Loss, gradient of the sums and of all weights; one probe, and groups of which all, or all but one, are filled."""
    run = Pass(shape, count, device)
    run.launch()
    _hold(run)


def test_sums_in_parts(device: str):
    """On CUDA the Gaussians' sum comes in parts."""
    if device == "cpu":
        pytest.skip("the CPU takes the sum whole")
    run = Pass((9, 64, 27), 2 * GROUP, device, parts=probe_step.SPLITS)
    run.launch()
    _hold(run)


def test_two_lanes_equal_one():
    """On the CPU two threads add halves of the probes in buffers of their own."""
    one, two = (Pass((9, 64, 27), 3 * GROUP - 5, "cpu") for _ in range(2))
    one.launch()
    assert not one.partial.numpy()[1].any() and one.loss.numpy()[1] == 0.0
    two.launch(0, 70)
    assert not two.partial.numpy()[1].any() and np.isnan(two.grad_f.numpy()[:, 70:]).all()
    two.launch(70, two.padded - 70)
    assert two.partial.numpy().any(1).all() and two.loss.numpy().all()
    np.testing.assert_array_equal(two.grad_f.numpy(), one.grad_f.numpy())
    close(two.partial.numpy().sum(0), one.partial.numpy().sum(0), 1e-6, "weights")
    close(two.loss.numpy().sum(), one.loss.numpy().sum(), 1e-6, "loss")
