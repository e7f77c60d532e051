"""The kernels of a NAFBlock against torch in float64."""

import numpy as np
import pytest
import torch
import warp as wp

from kernels.compare import half_array, noise
from wlm_kernels.smoke.naf_block import STRIP, kernels, lanes


def _run(kernel, dim, inputs, shape, half, device) -> np.ndarray:
    wp.init()
    made = wp.zeros(shape, dtype=wp.float16 if half else float, device=device)
    wp.launch(kernel, dim, inputs=inputs, outputs=[made], device=device)
    return made.numpy().astype(np.float64)


@pytest.mark.parametrize("half, error", [(False, 1e-5), (True, 2e-3)])
@pytest.mark.parametrize("channels", [1, 17, 128])
def test_norm(device, half, error, channels):
    x, shift = 3 * noise(half, 10, channels), noise(False, 2, channels)
    x[4] = 0
    inputs = [half_array(x, half, device), half_array(shift, False, device), 5]
    cuda = device != "cpu"
    dim = 10 * lanes(channels, cuda)
    result = _run(kernels(channels, half, cuda).norm, dim, inputs, (10, channels), half, device)
    shifted = x.double() + shift.double().repeat_interleave(5, 0)
    expected = torch.nn.functional.layer_norm(shifted, (channels,), eps=1e-6).numpy()
    assert np.abs(result - expected).max() < error * max(np.abs(expected).max(), 1)


@pytest.mark.parametrize("half, error", [(False, 1e-5), (True, 2e-3)])
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (5, 4), (7, 9)])
def test_gate(device, half, error, size):
    channels = 3
    x, weight, bias = noise(half, *size, 6), noise(False, 9, 6), noise(False, 6)
    inputs = [half_array(x, half, device), half_array(weight, False, device), half_array(bias, False, device)]
    dim = (-(-size[0] // STRIP), size[1], channels)
    result = _run(kernels(channels, half, device != "cpu").gate, dim, inputs, (*size, channels), half, device)
    image = x.double().permute(2, 0, 1)[None]
    kernel = weight.double().t().reshape(6, 1, 3, 3)
    made = torch.nn.functional.conv2d(image, kernel, bias.double(), padding=1, groups=6)[0].permute(1, 2, 0)
    expected = (made[..., :3] * made[..., 3:]).numpy()
    assert np.abs(result - expected).max() < error * np.abs(expected).max()


@pytest.mark.parametrize("half, error", [(False, 1e-5), (True, 2e-3)])
@pytest.mark.parametrize("channels", [5, 40])
def test_attend(device, half, error, channels):
    cuda = device != "cpu"
    n = channels
    mean, weight, bias, product = (noise(False, *shape) for shape in ((2 * n,), (2, n, n), (2, n), (2, n, n)))
    inputs = [half_array(values, False, device) for values in (mean, weight, bias, product)]
    result = _run(kernels(n, half, cuda).attend, 2 * n * lanes(n, cuda), inputs, (2, n, n), half, device)
    factor = torch.einsum("gic,gc->gi", weight.double(), mean.double().view(2, n)) + bias.double()
    expected = (factor[:, :, None] * product.double()).numpy()
    assert np.abs(result - expected).max() < error * np.abs(expected).max()
