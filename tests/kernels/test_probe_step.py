"""The launches of a training step but the network: masks, sums, levels and optimisers."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
import warp as wp
from reference import gaussians as reference

from benchmarks import plain
from kernels.compare import array, close
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe import step as probe_step
from wlm_kernels.probe.gaussians import SHAPE_NUMBERS, Shape
from wlm_kernels.probe.step import GROUP, SPLITS

CUT = 3.0
LATENTS = [9, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 12, 32))]
CENTRE, LATENT = slice(0, 3), slice(10, None)
SUMS = {"centre": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 9), "latent": slice(9, None)}


def _rows(count: int, latent: int = 9, longest: float = 0.15, seed: int = 1) -> np.ndarray:
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, 10 + latent)).astype(np.float32)
    rows[:, :3] = random.random((count, 3)) * 1.4 - 0.2
    rows[:, 3:6] = np.log(longest) - random.random((count, 3)) * 2.5
    return rows


def _x(count: int, seed: int = 2) -> np.ndarray:
    """Points in cells of 1/4, so that groups of neighbours have small boxes."""
    x = np.random.default_rng(seed).random((count, 3)).astype(np.float32)
    return x[np.lexsort(np.floor(x * 4).T)]


@dataclass
class Step:
    """Probes and Gaussians on a device, with all that the launches write."""

    x: np.ndarray
    rows: np.ndarray
    device: str
    cut: float = CUT
    sphere: int = 0

    def __post_init__(self):
        count, channels = self.rows.shape
        self.padded = -(-len(self.x) // GROUP) * GROUP
        latent, device = channels - 10, self.device
        filled = np.concatenate([self.x, np.repeat(self.x[-1:], self.padded - len(self.x), 0)])
        boxes = filled.reshape(-1, GROUP, 3)
        self.low, self.high = boxes.min(1).astype(np.float64), boxes.max(1).astype(np.float64)
        self.groups = probe_step.Groups()
        self.groups.x = array(filled, wp.vec3, device)
        self.groups.middle = array((self.low + self.high) / 2, wp.vec3, device)
        self.groups.half = array((self.high - self.low) / 2 + 1e-6, wp.vec3, device)
        self.groups.count = len(self.x)
        self.launches = probe_step.step_kernels(latent, "cpu" if device == "cpu" else "cuda")

        def nan(*shape: int) -> wp.array:
            return wp.full(shape, np.nan, dtype=float, device=device)

        self.values = array(self.rows, float, device)
        self.bounds = wp.zeros((2, channels), dtype=float, device=device)
        self.levels = wp.zeros(channels, dtype=float, device=device)
        self.used, self.shapes = nan(count, channels), wp.zeros(count, dtype=Shape, device=device)
        self.by_group = wp.full((len(boxes), -(-count // 32)), 7, dtype=wp.uint32, device=device)
        self.by_gaussian = wp.full((count, -(-len(boxes) // 32)), 7, dtype=wp.uint32, device=device)
        self.f = nan(1 if device == "cpu" else SPLITS, latent, self.padded)
        self.sums = nan(count * (1 if device == "cpu" else probe_step.PARTS), SHAPE_NUMBERS + latent)

    def prepare(self, quantised: int = 0) -> None:
        self.launches.shapes(
            self.values, self.bounds, quantised, self.levels, self.cut, self.sphere, self.used, self.shapes
        )
        probe_step.touch(self.groups, self.shapes, self.by_group, self.by_gaussian)

    def features(self, *lane: int) -> np.ndarray:
        """[L, N], the padding included."""
        self.launches.features(self.groups, self.shapes, self.used, self.by_group, self.cut, self.f, *lane)
        return self.f.numpy().sum(0)

    def collect(self, grad_f: np.ndarray, *lane: int) -> np.ndarray:
        """[K, 9 + L], of a gradient [L, N] that has no padding."""
        whole = np.zeros((len(grad_f), self.padded), np.float32)
        whole[:, : grad_f.shape[1]] = grad_f
        grad = array(whole, float, self.device)
        self.launches.collect(self.groups, self.shapes, self.used, self.by_gaussian, grad, self.cut, self.sums, *lane)
        return self.sums.numpy().reshape(len(self.used), -1, self.sums.shape[1]).sum(1)


def _bits(words: wp.array, count: int) -> np.ndarray:
    """The first `count` bits of each row of words; what lies behind them must be 0."""
    bits = np.unpackbits(words.numpy().view(np.uint8), axis=1, bitorder="little").astype(bool)
    assert not bits[:, count:].any()
    return bits[:, :count]


@pytest.mark.parametrize("sphere", [0, 1])
def test_touch(device: str, sphere: int):
    """Both masks against the boxes in float64, with numbers that are no multiples of 32."""
    step = Step(_x(40 * GROUP + 5), _rows(75), device, sphere=sphere)
    step.prepare()
    met = _bits(step.by_group, 75)
    np.testing.assert_array_equal(met, _bits(step.by_gaussian, 41).T)
    reach = reference.reach(step.rows, CUT, "sphere" if sphere else "ellipsoid")
    centre = step.rows[:, :3].astype(np.float64)
    gap = np.maximum(step.low[:, None] - centre, centre - step.high[:, None])
    assert met[(gap <= reach).all(2)].all()
    assert not met[(gap > reach * (1 + 1e-5) + 3e-6).any(2)].any()
    assert 0.02 < met.mean() < 0.9


@pytest.mark.parametrize("bit", range(32))
def test_one_bit_of_a_mask(device: str, bit: int):
    """Each of the 32 Gaussians of a word is found again."""
    rows = _rows(32)
    rows[:, :3] = 50.0
    rows[bit, :3] = 0.5
    step = Step(_x(GROUP), rows, device)
    step.prepare()
    assert step.by_group.numpy().tolist() == [[1 << bit]]
    np.testing.assert_allclose(step.features(), reference.gradients(rows, step.x, step.f.numpy()[0], CUT)[0], atol=1e-5)


@pytest.mark.parametrize("sphere", [0, 1])
@pytest.mark.parametrize("latent", LATENTS)
def test_features_and_collect(device: str, latent: int, sphere: int):
    """The sums over masks are those over all Gaussians and all points."""
    step = Step(_x(10 * GROUP - 7), _rows(70, latent), device, sphere=sphere)
    step.prepare()
    np.testing.assert_array_equal(step.used.numpy(), step.rows)
    rows, x = array(step.rows, float, device), array(step.x, wp.vec3, device)
    shapes = gaussian_sum.shapes(rows, CUT, "sphere" if sphere else "ellipsoid")
    f = wp.zeros((latent, len(step.x)), dtype=float, device=device)
    gaussian_sum.sum(rows, shapes, None, x, f, CUT)
    close(step.features()[:, : len(step.x)], f, 2e-6, "sum")
    grad_f = np.random.default_rng(3).normal(size=f.shape).astype(np.float32)
    grad = wp.zeros(rows.shape, dtype=float, device=device)
    gaussian_sum.backward(rows, shapes, None, x, array(grad_f, float, device), grad, CUT)
    got, want = step.collect(grad_f), grad.numpy()
    # The centre's gradient is W^T of its sums.
    centre = np.einsum("kab,ka->kb", shapes.numpy()["whiten"].reshape(-1, 3, 3), got[:, SUMS["centre"]])
    close(centre, want[:, CENTRE], 2e-6, "centre")
    close(got[:, SUMS["scale"]], want[:, 3:6], 2e-6, "scale")
    close(got[:, SUMS["latent"]], want[:, LATENT], 2e-6, "latent")
    # And a turn's, about each of its own axes, is off the diagonal of the sum of a w u u^T.
    u = np.einsum("kab,nkb->nka", shapes.numpy()["whiten"].reshape(-1, 3, 3), step.x[:, None] - step.rows[:, :3])
    d2 = (u.astype(np.float64) ** 2).sum(-1)
    distance = np.linalg.norm(step.x[:, None] - step.rows[:, :3], axis=2)
    reached = distance < CUT * np.exp(step.rows[:, 3:6].max(1)) if sphere else d2 < CUT * CUT
    a = np.where(reached, np.exp(-0.5 * d2), 0.0) * (grad_f.T @ step.rows[:, LATENT].T)
    off = [np.einsum("nk,nk,nk->k", a, u[:, :, i], u[:, :, j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    close(got[:, SUMS["rotation"]], np.stack(off, 1), 1e-5, "rotation")


def test_two_lanes_equal_one():
    """On the CPU two threads take halves of the probes, or of the Gaussians."""
    grad_f = np.random.default_rng(3).normal(size=(9, 300)).astype(np.float32)
    one, two = (Step(_x(300), _rows(71), "cpu") for _ in range(2))
    one.prepare()
    two.prepare()
    assert np.isnan(two.features(0, 100)[:, 100:]).all()
    np.testing.assert_array_equal(two.features(100, two.padded - 100), one.features())
    assert np.isnan(two.collect(grad_f, 0, 30)[30:]).all()
    np.testing.assert_array_equal(two.collect(grad_f, 30, 41), one.collect(grad_f))


def test_kernels_that_are_loaded_ahead_are_those_that_are_launched():
    """A module is compiled anew for each size of blocks; on the CPU every launch has blocks of one thread."""
    launches = probe_step.step_kernels(9, "cpu")
    launches.load("cpu")
    for kernel in (launches._shapes, launches._features, launches._collect, launches._update):
        assert {threads for _, threads in kernel.module.execs} == {1}


def test_levels(device: str):
    """Rows as the file holds them (eq. 13 and 14): rounded, held within the range, and no range at all."""
    step = Step(_x(GROUP), _rows(200), device)
    random = np.random.default_rng(4)
    low = step.rows.min(0) + random.random(19).astype(np.float32) * 0.3
    high = step.rows.max(0) - random.random(19).astype(np.float32) * 0.3
    high[[4, 12]] = low[[4, 12]]
    levels = np.full(19, 2.0**10 - 1, np.float32)
    levels[:3] = 2**16 - 1
    step.bounds, step.levels = (array(v, float, device) for v in (np.stack([low, high]), levels))
    step.prepare(quantised=1)
    used = step.used.numpy()
    want = reference.quantised(*(np.float64(v) for v in (step.rows, low, high, levels)))
    # What lies between two levels, within rounding, may go to either.
    size = np.where(high > low, high - low, 1.0) / levels
    off = np.abs(used - want) / size
    assert (used[:, [4, 12]] == low[[4, 12]]).all()
    assert (off > 0.02).mean() < 1e-3 and off.max() < 1.02
    assert len(np.unique(used[:, 5])) < len(np.unique(step.rows[:, 5]))
    assert (used >= low).all() and (used <= high + 1e-6).all()
    # Shapes are made of what is used.
    rows = gaussian_sum.shapes(step.used, CUT).numpy()
    np.testing.assert_array_equal(step.shapes.numpy(), rows)
    step.values = array(used, float, device)
    step.prepare(quantised=1)
    np.testing.assert_allclose(step.used.numpy(), used, atol=1e-6 * np.abs(used).max())


RATES = np.concatenate([np.full(3, 1e-3), np.full(3, 1e-2), np.full(4, 1e-2), np.full(9, 3e-2)]).astype(np.float32)
NET_RATE, NET, PARTS, STEPS = 2e-2, 50, 19, 20
SCHEDULE = np.linspace(1.0, 0.2, STEPS).astype(np.float32)


class Training:
    """Steps of Gaussians along a fixed gradient of their sum, and of a network along random gradients."""

    def __init__(self, device: str, adan: int = 0, **settings: object):
        # Far enough that what crosses the border of a reach is nothing.
        self.step = Step(_x(300), _rows(20), device, cut=6.0)
        random = np.random.default_rng(7)
        self.grad_f = random.normal(size=(9, 300)).astype(np.float32)
        self.first_net = random.normal(size=NET).astype(np.float32)
        self.net_grads = random.normal(size=(STEPS, PARTS, NET)).astype(np.float32)
        self.net = array(self.first_net, float, device)
        self.control = wp.zeros(1, dtype=int, device=device)
        self._moments = wp.zeros((4, *self.step.rows.shape), dtype=float, device=device)
        self._net_moments = wp.zeros((2, NET), dtype=float, device=device)
        o = self.optimiser = probe_step.Optimiser()
        o.control, o.net_rate, o.adan, o.move, o.keep = self.control, NET_RATE, adan, 1, 0
        o.schedule, o.rates = array(SCHEDULE, float, device), array(RATES, float, device)
        o.bounds = self.step.bounds
        for name, value in settings.items():
            setattr(o, name, value)

    def run(self, steps: int = STEPS) -> tuple[np.ndarray, np.ndarray]:
        """Rows and network after some steps."""
        s = self.step
        for step, partial in enumerate(self.net_grads[:steps]):
            self.control.fill_(step + 1)
            s.prepare()
            s.collect(self.grad_f)
            rows = s.values, s.used, s.shapes, s.sums, self._moments
            net = self.net, self._net_moments, array(partial, float, s.device)
            s.launches.update(self.optimiser, *rows, *net)
        return s.values.numpy(), self.net.numpy()

    def expected(self, kind) -> tuple[np.ndarray, np.ndarray]:
        """The same by optimisers of torch in float64."""
        rows = torch.tensor(self.step.rows, dtype=torch.float64)
        groups = [torch.nn.Parameter(rows[:, i : i + 1].clone()) for i in range(rows.shape[1])]
        net = torch.nn.Parameter(torch.tensor(self.first_net, dtype=torch.float64))
        gaussians = kind([{"params": [g], "lr": r} for g, r in zip(groups, RATES, strict=True)])
        network = torch.optim.Adam([net], lr=NET_RATE)
        x, grad_f = (torch.tensor(v, dtype=torch.float64) for v in (self.step.x, self.grad_f))
        for factor, partial in zip(SCHEDULE, self.net_grads, strict=True):
            f = plain.gaussian_sum(torch.cat(groups, 1), x, cut=self.step.cut).T
            gaussians.zero_grad()
            (f * grad_f).sum().backward()
            net.grad = torch.tensor(partial.astype(np.float64).sum(0))
            for group, rate in zip(gaussians.param_groups, RATES, strict=True):
                group["lr"] = float(rate * factor)
            network.param_groups[0]["lr"] = NET_RATE * float(factor)
            gaussians.step()
            network.step()
        return torch.cat(groups, 1).detach().numpy(), net.detach().numpy()


def _hold(training: Training, kind) -> None:
    rows, net = training.run()
    want_rows, want_net = training.expected(kind)
    first = training.step.rows
    for group, part in {"centre": CENTRE, "scale": slice(3, 6), "rotation": slice(6, 10), "latent": LATENT}.items():
        close(rows[:, part] - first[:, part], want_rows[:, part] - first[:, part], 2e-4, group)
    close(net - training.first_net, want_net - training.first_net, 1e-4, "network")


def test_adam(device: str):
    """Gaussians and network against torch's Adam."""
    _hold(Training(device), torch.optim.Adam)


def test_adan(device: str):
    """Gaussians against pytorch-optimizer's Adan, the network still by Adam."""
    optimisers = pytest.importorskip("pytorch_optimizer")
    _hold(Training(device, adan=1), optimisers.Adan)


def test_limits_of_scales(device: str):
    """However far a step would go, scales stay in [1e-4, 4]."""
    training = Training(device)
    rates = RATES.copy()
    rates[3:6] = 100.0
    training.optimiser.rates = array(rates, float, device)
    rows = training.run(1)[0]
    low, high = np.log(1e-4), np.log(4.0)
    ends = rows[:, 3:6]
    moved = (ends != training.step.rows[:, 3:6]).any(1)  # some Gaussians are out of the probes' sight
    assert (np.isclose(ends, low, atol=0.01) | np.isclose(ends, high, atol=0.01))[moved].all()
    assert 0.5 < moved.mean() < 1
    assert ends.min() >= low and np.exp(ends.max()) <= 4.02
    assert np.ptp(ends) > 10


def test_bounds(device: str):
    """Once the levels have a range, rows stay in it, and where it is one value at that."""
    training = Training(device, keep=1)
    rows = training.step.rows
    low, high = rows.min(0), rows.max(0)
    low[11] = high[11] = 0.25
    training.step.bounds.assign(np.stack([low, high]))
    after = training.run()[0]
    assert (after >= low).all() and (after <= high).all()
    assert ((after == low) | (after == high)).any(0).sum() > 10 and (after[:, 11] == 0.25).all()
    assert (after != rows)[(after > low) & (after < high)].mean() > 0.8


def test_fixed_gaussians(device: str):
    """Without `move` the network goes on alone."""
    free, fixed = Training(device), Training(device, move=0)
    rows, net = fixed.run()
    np.testing.assert_array_equal(rows, fixed.step.rows)
    np.testing.assert_array_equal(net, free.run()[1])
    assert (net != fixed.first_net).all()
