"""The encoding of the guide of six lights and the planes after the network's heads, against torch in float64."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import warp as wp

from kernels.compare import half_array, noise
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.planes import LIGHTS, PLANES, STRIP, Taps, decode, encode_six, kernels

_EVERY = [(plane % 2, 5 * plane) for plane in range(PLANES)]  # a group and a first output for each plane


def _near(guide: torch.Tensor, reach: int, half: bool, device: str) -> np.ndarray:
    made = kernels(5, reach, half, device != "cpu")
    blocks = [-(-size // reach) for size in guide.shape[1:]]
    smoke = wp.full(blocks, -1, dtype=int, device=device)
    dim = blocks[0] * blocks[1] * made.lanes
    wp.launch(made.near, dim, inputs=[half_array(guide, half, device)], outputs=[smoke], device=device)
    return smoke.numpy()


def _compose(heads, guide, filters, places, stem, smoke, *, reach=8, half=False, device="cpu") -> torch.Tensor:
    """`heads`: [G, N, h, w]; `filters`: [PLANES, c, edge, edge]; `smoke`: [blocks]."""
    edge = filters.shape[-1]
    weights = filters.permute(1, 3, 2, 0).reshape(-1, PLANES).contiguous()
    height, width = guide.shape[1:]
    inputs = [
        half_array(heads.permute(0, 2, 3, 1).contiguous(), half, device),
        half_array(guide, half, device),
        wp.array(weights.numpy(), dtype=Taps, device=device),
        wp.array(np.array(places), dtype=int, ndim=2, device=device),
        stem,
        wp.array(np.array(smoke), dtype=int, ndim=2, device=device),
    ]
    out = wp.full((PLANES, height, width), -1.0, dtype=float, device=device)
    kernel = kernels(edge, reach, half, device != "cpu").compose
    wp.launch(kernel, (-(-height // STRIP), width), inputs=inputs, outputs=[out], device=device)
    return torch.from_numpy(out.numpy()).double()


def _wanted(heads, guide, filters, places, stem, smoke, reach=8) -> torch.Tensor:
    heads, guide, filters = heads.double(), guide.double(), filters.double()
    height, width = guide.shape[1:]
    if filters.shape[1]:
        planes = F.conv2d(guide[None, : filters.shape[1]], filters, padding=filters.shape[-1] // 2)[0]
    else:
        planes = torch.zeros(PLANES, height, width, dtype=torch.float64)
    for plane, (group, first) in enumerate(places):
        shuffled = F.pixel_shuffle(heads[group, first : first + stem**2], stem)
        planes[plane] += shuffled[0, :height, :width]
    near = F.max_pool2d(torch.tensor(smoke)[None].double(), 3, stride=1, padding=1)
    near = near.repeat_interleave(reach, 1)[:, :height].repeat_interleave(reach, 2)[:, :, :width]
    planes = (planes * near).clamp(min=0)
    planes[LIGHTS:] = planes[LIGHTS:].clamp(max=1)
    return planes


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("stem", [1, 2, 3])
@pytest.mark.parametrize("size", [(1, 1), (4, 8), (17, 23), (41, 50)])
def test_planes_of_heads_and_a_filter(device, size, stem, half):
    """Sums are float32 also for half floats. The image of the heads may be larger, and the filter may omit planes."""
    heads = noise(half, 2, 5 * PLANES + 4, *(-(-extent // stem) + 1 for extent in size))
    guide, filters = noise(half, 4, *size), noise(False, PLANES, 3, 5, 5)
    smoke = [[int(i == j == 0) for j in range(-(-size[1] // 8))] for i in range(-(-size[0] // 8))]
    result = _compose(heads, guide, filters, _EVERY, stem, smoke, half=half, device=device)
    expected = _wanted(heads, guide, filters, _EVERY, stem, smoke)
    # Two blocks in each direction are near the one with smoke, all others not.
    assert (result[:, 16:] == 0).all() and (result[:, :, 16:] == 0).all() and expected.max() > 0.5
    assert result[LIGHTS:].max() <= 1 and (result - expected).abs().max() < 1e-5 * expected.max()


@pytest.mark.parametrize("edge, planes, reach", [(5, 0, 8), pytest.param(3, 1, 32, marks=pytest.mark.slow)])
def test_other_filters_and_reaches(device, edge, planes, reach):
    heads, guide = noise(False, 2, 40, 41, 50), noise(False, 3, 41, 50)
    filters = noise(False, PLANES, 2, edge, edge)[:, :planes].contiguous()
    smoke = np.zeros([-(-41 // reach), -(-50 // reach)], dtype=np.int32)
    smoke[-1, -1] = 1
    arguments = (heads, guide, filters, _EVERY, 1, smoke.tolist())
    result = _compose(*arguments, reach=reach, device=device)
    expected = _wanted(*arguments, reach=reach)
    assert expected.max() > 1 and (result - expected).abs().max() < 1e-5 * expected.max()


def test_a_nan_stays_where_smoke_is_near_and_only_there(device):
    heads, guide, filters = noise(False, 2, 40, 32, 32), noise(False, 3, 32, 32), noise(False, PLANES, 2, 5, 5)
    heads[:, :, 2, 2] = heads[:, :, 20, 20] = guide[:, 9, 30] = torch.nan
    smoke = [[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    result = _compose(heads, guide, filters, _EVERY, 1, smoke, device=device)
    assert result[:, 2, 2].isnan().all() and int(result.isnan().sum()) == PLANES


@pytest.mark.parametrize(
    "half, reach", [(False, 8), (True, 8)] + [pytest.param(False, reach, marks=pytest.mark.slow) for reach in (4, 32)]
)
@pytest.mark.parametrize("size", [(1, 1), (8, 5), (17, 70), (100, 33)])
def test_blocks_with_smoke(device, size, reach, half):
    """A single pixel counts, also the last of a block; 0, negative values and NaN do not."""
    guide = noise(half, 4, *size)
    some = torch.rand(size, generator=torch.Generator().manual_seed(1))
    guide[2] = torch.where(some < 0.01, 1e-3, torch.where(some < 0.5, torch.nan, -(some > 0.9).float()))
    guide[2, -1, -1] = 1e-6
    result = _near(guide, reach, half, device)
    has = (guide[2] > 0).numpy()
    expected = [
        [int(has[i : i + reach, j : j + reach].any()) for j in range(0, size[1], reach)]
        for i in range(0, size[0], reach)
    ]
    assert result.tolist() == expected and result[-1, -1] == 1


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
