"""The probe fit in plain torch: the reference for the speed and the quality of the kernels' fit.

It fits the model of `wlm.probe` (gaussian-probe-compression, eq. 2 to 10), but every Gaussian counts at every probe
(eq. 5 without eq. 6). It uses autograd on dense matrices of probes times Gaussians. It starts as in the paper, with
centres by k-means and scales from the nearest centre. It writes no file, and the network stays in float32.
"""

import itertools
import math
import time

import numpy as np
import torch
from scipy.spatial import cKDTree

_ROUNDS = 20  # rounds of k-means
_SMALLEST = 1e-4  # smallest first scale, over the size of the box
_FIRST_LATENT = 0.1  # spread of the first latents
_CENTRE_BITS = 16
_QUANTISE_FROM = 5 / 6  # share of the steps after which the Gaussians are used on the levels of a file


class DenseFit:
    """The fit of N probes of D numbers by K Gaussians with L numbers each.

    Attributes:
        parameters: The optimised tensors: centres [K, 3], logs of the scales [K, 3], quaternions
            w x y z [K, 4], latents [K, L], then the network's weights and biases, layer by layer.
        steps_done: Number of steps done so far.
        seconds: Time spent in `run` so far, including waiting for the device.
    """

    def __init__(
        self,
        x: np.ndarray,
        values: np.ndarray,
        *,
        count: int,
        latent: int,
        hidden: int,
        steps: int,
        rates: tuple[float, float, float, float, float],
        final: float,
        bits: int,
        seed: int,
        device: str,
    ):
        """Initialises the parameters.

        Args:
            x: [N, 3], positions in the unit cube.
            values: [N, D], the numbers of each probe, which are fitted.
            count: Requested number of Gaussians; limited to the number of distinct positions.
            latent: L, the size of each Gaussian's latent vector.
            hidden: Width of both hidden layers.
            steps: Steps of the whole fit, which define the schedule.
            rates: Initial learning rates: centre, log of the scale, rotation, latent, network.
            final: Last learning rates as a share of the initial ones; they fall along half a cosine.
            bits: Bits to which Gaussians are quantised in the last sixth of the steps (eq. 13, 14); centres have 16.
            seed: Seed of all random numbers.
            device: "cpu" or "cuda:0".

        Raises:
            ValueError: Wrong shapes, no probe, no Gaussian or no step.
        """
        x, values = np.asarray(x, np.float32), np.asarray(values, np.float32)
        if values.ndim != 2 or 0 in values.shape or x.shape != (len(values), 3):
            raise ValueError(f"expected positions [N, 3] and values [N, D], got {x.shape} and {values.shape}")
        if min(count, steps, latent, hidden) < 1:
            raise ValueError(f"expected numbers of at least 1, got {count=}, {steps=}, {latent=}, {hidden=}")
        self.steps_done, self.seconds = 0, 0.0
        self._steps, self._device = steps, device
        random = np.random.default_rng(seed)
        centre, scale = _first_gaussians(x.astype(np.float64), count, random)
        rotation = np.zeros((len(centre), 4))
        rotation[:, 0] = 1.0
        start = (
            centre,
            np.log(scale)[:, None].repeat(3, 1),
            rotation,
            _FIRST_LATENT * random.standard_normal((len(centre), latent)),
        )
        net = []
        for inputs, outputs in itertools.pairwise([latent + 3, hidden, hidden, values.shape[1]]):
            # Initialised like torch's linear layers.
            net += [random.uniform(-1, 1, shape) / math.sqrt(inputs) for shape in ((inputs, outputs), outputs)]
        self.parameters = [self._put(array).requires_grad_() for array in (*start, *net)]
        self._levels = [2.0**_CENTRE_BITS - 1.0] + [2.0**bits - 1.0] * 3

        exact = values.astype(np.float64)
        spread = exact.std(0)
        self._mean, self._spread = self._put(exact.mean(0)), self._put(spread)
        self._x = self._put(x)
        # A constant number has weight 0 and decodes to its mean.
        self._target = self._put((exact - exact.mean(0)) / np.where(spread > 0, spread, 1.0))
        # The squared error of the numbers themselves, in units of the most varied channel's variance (eq. 8).
        self._weight = self._put((spread / (spread.max() or 1.0)) ** 2)

        parts = [*([p] for p in self.parameters[:4]), self.parameters[4:]]
        groups = [{"params": part, "lr": rate} for part, rate in zip(parts, rates, strict=True)]
        self._adam = torch.optim.Adam(groups, fused=True)
        self._schedule = torch.optim.lr_scheduler.LambdaLR(
            self._adam, lambda s: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(s / max(steps - 1, 1), 1)))
        )

    def step(self) -> torch.Tensor:
        """Does one step; returns its loss, the weighted mean over probes and numbers, still on the device."""
        error = self._answer(self.steps_done >= round(_QUANTISE_FROM * self._steps)) - self._target
        loss = (self._weight * error * error).mean()
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        self._schedule.step()
        self.steps_done += 1
        return loss.detach()

    def run(self, steps: int) -> None:
        """Does `steps` steps, waits for the device, and adds the elapsed time to `seconds`."""
        self._wait()
        start = time.perf_counter()
        for _ in range(steps):
            self.step()
        self._wait()
        self.seconds += time.perf_counter() - start

    @torch.no_grad()
    def decoded(self) -> np.ndarray:
        """Decodes the probes from Gaussians quantised as in a file, float32 [N, D]."""
        return (self._answer(quantised=True) * self._spread + self._mean).cpu().numpy()

    def _put(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._device)

    def _wait(self) -> None:
        if self._device != "cpu":
            torch.cuda.synchronize(self._device)

    def _answer(self, quantised: bool) -> torch.Tensor:  # [N, D], normalised
        gaussians, net = self.parameters[:4], self.parameters[4:]
        if quantised:
            gaussians = [_on_levels(p, levels) for p, levels in zip(gaussians, self._levels, strict=True)]
        h = torch.cat([_features(self._x, *gaussians), self._x], 1)
        h = torch.sigmoid(torch.addmm(net[1], h, net[0]))
        h = torch.sigmoid(torch.addmm(net[3], h, net[2]))
        return torch.addmm(net[5], h, net[4])


def _features(x, centre, log_scale, rotation, latent):  # [N, 3], [K, 3], [K, 3], [K, 4], [K, L] -> [N, L]
    """Evaluates eq. 2 to 5 of the paper: features [N, L] of N probes, as sums over the latents of all K Gaussians."""
    whiten = _matrices(rotation).transpose(1, 2) * torch.exp(-log_scale)[:, :, None]  # [K, 3, 3], S^-1 R^T
    u = torch.einsum("kij,nj->nki", whiten, x) - torch.einsum("kij,kj->ki", whiten, centre)
    return torch.exp(-0.5 * (u * u).sum(-1)) @ latent


def _matrices(rotation):  # [K, 4] -> [K, 3, 3]
    w, x, y, z = torch.nn.functional.normalize(rotation, dim=1).unbind(1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def _on_levels(values, levels):  # [K, C] -> [K, C]
    """Quantises values to evenly spaced levels (eq. 13 and 14), with a straight-through gradient."""
    with torch.no_grad():
        low, high = values.amin(0), values.amax(0)
        size = torch.where(high > low, (high - low) / levels, 1.0)
        moved = low + torch.round((values - low) / size) * size - values
    return values + moved


def _first_gaussians(x: np.ndarray, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns K centres [K, 3] by k-means, and as scales [K] the distances to the nearest centre (section 3.2)."""
    distinct = np.unique(x, axis=0)
    centre = distinct[random.choice(len(distinct), min(count, len(distinct)), replace=False)]
    for _ in range(_ROUNDS):
        label = cKDTree(centre).query(x)[1]
        size = np.bincount(label, minlength=len(centre))
        total = np.stack([np.bincount(label, x[:, axis], len(centre)) for axis in range(3)], 1)
        # One that no probe is nearest to stays where it is.
        centre = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], centre)
    if len(centre) == 1:
        return centre, np.array([max(np.linalg.norm(x - centre, axis=1).max(), _SMALLEST)])
    return centre, np.maximum(cKDTree(centre).query(centre, k=2)[0][:, 1], _SMALLEST)
