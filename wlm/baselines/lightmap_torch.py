"""The temporal lightmap fit in plain torch: the peer that the fused kernels are timed and checked against.

The same model, samples a step, optimiser and schedule as `wlm.lightmap`, written with batched matrix products,
`grid_sample` and autograd as neural-dynamic-gi, section 4, describes it. It stops short of the file: its maps stay
continuous, so its loss compares with ours before quantisation.
"""

import math

import numpy as np
import torch
from torch.nn import functional

TILE = 128


class PlainFit:
    """N dynamic tiles being fitted.

    Attributes:
        parameters: The tensors that the optimiser moves, maps first.
    """

    def __init__(self, *, tau, encoding, colour, texels, count, weight, sizes, rates, seed: int, device: str):
        """Draws the first parameters.

        Args:
            tau: float [T], place of each time on the features' axis.
            encoding: float [T, 4], gamma(t) of eq. 4.
            colour: float [N, T, 128 * 128, 3], what to fit.
            texels, count: int [N, K] valid texels, and int [N] how many of them count.
            weight: float [N, T, 3], weight of the squared error.
            sizes: (hidden width, resolution of F_uvt, its slices, columns and rows of the planes).
            rates: (samples a step, steps, learning rate of maps, of the network, final share).
            seed: Of everything random.
            device: "cpu" or "cuda:0".
        """
        self._random = torch.Generator(device).manual_seed(seed)
        self._device = device
        hidden, r, slices, columns, rows = sizes
        self._samples, steps, map_rate, net_rate, final = rates

        def put(values, dtype=torch.float32):
            return torch.as_tensor(np.ascontiguousarray(values), device=device).to(dtype)

        self._tau, self._encoding = put(tau), put(encoding)
        self._colour, self._weight = put(colour), put(weight)
        self._texels, self._count = put(texels, torch.long), put(count)
        n = self._colour.shape[0]
        self._row = torch.arange(n, device=device)[:, None]

        def map_(*shape):
            return (0.25 + 0.5 * self._rand(*shape)).requires_grad_()

        def layer(inputs, outputs):
            return ((2.0 * self._rand(n, outputs, inputs) - 1.0) / math.sqrt(inputs)).requires_grad_()

        def bias(outputs):
            return torch.zeros(n, outputs, 1, device=device, requires_grad=True)

        self._uv = map_(n, 2, 4, TILE // 4, TILE // 4), map_(n, 1, TILE, TILE)
        self._uvt = map_(n, 2, 4, slices, r // 4, r // 4), map_(n, 1, slices, r, r)
        self._ut, self._vt = map_(n, 2, rows, columns), map_(n, 2, rows, columns)
        self._layers = [
            (layer(16, hidden), bias(hidden)),
            (layer(hidden, hidden), bias(hidden)),
            (layer(hidden, 3), bias(3)),
        ]
        maps = [*self._uv, *self._uvt, self._ut, self._vt]
        net = [value for pair in self._layers for value in pair]
        self.parameters = maps + net
        groups = [{"params": maps, "lr": map_rate}, {"params": net, "lr": net_rate}]
        self._adam = torch.optim.Adam(groups, fused=True)
        self._schedule = torch.optim.lr_scheduler.LambdaLR(
            self._adam, lambda s: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(s / max(steps - 1, 1), 1)))
        )

    def _rand(self, *shape):
        return torch.rand(*shape, device=self._device, generator=self._random)

    def step(self) -> torch.Tensor:
        """Does one step; returns its loss, the mean over tiles, samples and channels, still on the device."""
        n, t = self._colour.shape[:2]
        place = (self._rand(n, self._samples) * self._count[:, None]).long()
        flat = self._texels.gather(1, place)
        k = (self._rand(n, self._samples) * t).long()
        u, v = (flat % TILE + 0.5) / TILE, (flat // TILE + 0.5) / TILE
        error = self._answer(u, v, k, noise=True) - self._colour[self._row, k, flat]
        loss = (self._weight[self._row, k] * error * error).mean()
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        self._schedule.step()
        return loss.detach()

    def _answer(self, u, v, k, noise: bool):  # [N, B] each -> [N, B, 3]
        def sample(plane, x, y):
            grid = torch.stack([2 * x - 1, 2 * y - 1], -1)[:, None]
            return functional.grid_sample(plane, grid, padding_mode="border", align_corners=False)[:, :, 0]

        def blend(endpoints, weights):
            e = endpoints.clamp(0, 1).repeat_interleave(4, -1).repeat_interleave(4, -2)
            w = weights.clamp(0, 1)
            return e[:, 0] * (1 - w) + e[:, 1] * w

        tau = self._tau[k]
        grid = torch.stack([2 * u - 1, 2 * v - 1, 2 * tau - 1], -1)[:, None, None]
        volume = functional.grid_sample(blend(*self._uvt), grid, padding_mode="border", align_corners=False)[:, :, 0, 0]
        features = torch.cat(
            [
                sample(blend(*self._uv), u, v),
                volume,
                sample(self._ut.clamp(0, 1), u, tau),
                sample(self._vt.clamp(0, 1), v, tau),
            ],
            1,
        )
        if noise:
            features = features + (self._rand(*features.shape) - 0.5) / 256
        x = torch.cat([(features - 0.5) * math.sqrt(12), self._encoding[k].transpose(1, 2)], 1)
        for i, (w, b) in enumerate(self._layers):
            x = w @ x + b
            x = functional.gelu(x) if i < 2 else x
        return x.transpose(1, 2)
