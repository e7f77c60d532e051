"""The encoding of the guide of six lights and the decoding of the network's planes, against torch in float64."""

import numpy as np
import pytest
import torch
import warp as wp

from kernels.compare import half_array, noise
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.planes import LIGHTS, PLANES, decode, encode_six


def _srgb(linear: torch.Tensor) -> torch.Tensor:
    return torch.where(linear <= 0.0031308, 12.92 * linear.clamp(min=0), 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("hot", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (7, 40)])
def test_the_guide_of_six_lights(device, size, hot):
    planes = 2 * noise(False, 9, *size)
    values = (0.0, 0.003, 0.0031308, 0.0032, 1.0, 1e4, 1e-30, -0.0, torch.nan)
    if size[1] > len(values):
        planes[:, 3, : len(values)] = torch.tensor(values)
    near, far = -0.5, 1.75
    out = wp.full(planes.shape, -1.0, dtype=float, device=device)
    encode_six(half_array(planes, False, device), near, far, hot, out)
    result = torch.from_numpy(out.numpy()).double()
    of = dict(zip(marches.PLANES, planes.double(), strict=True))
    glow = of["emission"].clamp(min=0) if hot else torch.zeros(size, dtype=torch.float64)
    depth = ((far - of["depth"]) / (far - near)).clamp(0, 1) * (of["depth"] > 0)
    lights = [_srgb(of[name]) for name in ("right", "left", "top", "bottom", "front", "back")]
    expected = torch.stack([*lights, _srgb(glow / (1 + glow)), 1 - of["transparency"], depth])
    torch.testing.assert_close(result, expected, rtol=1e-6, atol=1e-6, equal_nan=True)
    assert hot or (result[LIGHTS] == 0).all()


def test_decode(device):
    planes = 1.5 * noise(False, PLANES, 5, 7) + 0.5
    for i, value in enumerate((0.0, 0.04045, 0.0404, 1.0, 1.00001, 0.999999, -1e30, 1e30, np.nan)):
        planes[:, i // 7, i % 7] = value
    out = wp.full(planes.shape, -1.0, dtype=float, device=device)
    decode(half_array(planes, False, device), out)
    result, code = torch.from_numpy(out.numpy()).double(), planes.double()
    light = torch.where(code <= 0.04045, code.clamp(min=0) / 12.92, ((code.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)
    torch.testing.assert_close(result[:LIGHTS], light[:LIGHTS].float().double(), rtol=3e-6, atol=0, equal_nan=True)
    torch.testing.assert_close(result[LIGHTS], 1 - code[LIGHTS].clamp(0, 1), rtol=0, atol=1e-7, equal_nan=True)
    share = light[LIGHTS + 1].clamp(max=1)
    glow = (share / (1 - share)).clamp(max=65504.0)
    # Near 1 what is left of it has few digits.
    near = share > 0.99
    torch.testing.assert_close(result[LIGHTS + 1][~near], glow[~near], rtol=1e-4, atol=1e-7, equal_nan=True)
    assert (result[LIGHTS + 1][near] > 90).all() and result[LIGHTS + 1][share == 1].eq(65504.0).all()
