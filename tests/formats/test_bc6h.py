"""BC6H: our encoder as an independent decoder reads it, and against another."""

import imagecodecs
import numpy as np
import pytest
import torch

from benchmarks.rivals.lightmap_blocks import ispc_bc6h
from wlm.formats.bc6h import MODES
from wlm.ops.bc6h import bc6h_blocks


def _other(blocks: np.ndarray) -> np.ndarray:
    return imagecodecs.bcn_decode(blocks.tobytes(), 6, shape=(4 * len(blocks), 4, 3)).reshape(-1, 16, 3)


def _pictures() -> np.ndarray:
    """Blocks of smooth light, of an edge through them, of two colours, of noise, and of one colour; [N, 16, 3]."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[:4, :4] / 3.0
    angle = random.uniform(0, 6.3, (600, 1, 1))
    ramp = x * np.cos(angle) + y * np.sin(angle)
    edge = (ramp > random.uniform(-0.5, 1.0, (600, 1, 1))).astype(float)
    colours = 10.0 ** random.uniform(-3, 3, (600, 1, 1, 1, 1)) * random.random((600, 2, 1, 1, 3))
    share = np.concatenate([0.3 + 0.2 * ramp[:200], edge[200:400], 0.6 * edge[400:] + 0.2 * ramp[400:]])[..., None]
    light = colours[:, 0] * (1 - share) + colours[:, 1] * share
    light[::3] *= 1 + 0.05 * random.random((200, 4, 4, 3))
    light[::7] = light[::7, :1, :1]
    return light.clip(0.0).reshape(600, 16, 3).astype(np.float32)


def test_the_encoder_says_what_its_blocks_hold_and_is_better_than_another(device):
    light = _pictures()
    blocks, decoded = (part.cpu().numpy() for part in bc6h_blocks(torch.from_numpy(light).to(device)))
    np.testing.assert_array_equal(_other(blocks).astype(np.float32), decoded)
    assert len({int(number) & 31 for number in blocks[:, 0]}) > len(MODES)  # of most modes
    row = light.astype(np.float16).reshape(-1, 4, 4, 3).transpose(1, 0, 2, 3).reshape(4, -1, 3)
    data = np.frombuffer(ispc_bc6h(row), np.uint8).reshape(-1, 16)
    theirs = _other(data).astype(np.float32)

    def decibels(found: np.ndarray) -> float:
        """Returns the PSNR of errors relative to the brightest value of each block."""
        return float(-10 * np.log10(np.mean(np.square((found - light) / light.max((1, 2), keepdims=True)))))

    assert decibels(decoded) > decibels(theirs) + 1.0


def test_weights_choose_the_texels_that_count(device):
    random = np.random.default_rng(2)
    light = torch.from_numpy(random.random((50, 16, 3)).astype(np.float32)).to(device)
    weight = torch.from_numpy((random.random((50, 16)) < 0.3).astype(np.float32)).to(device)
    errors = [(bc6h_blocks(light, each)[1] - light).square().sum(2) for each in (weight, None)]
    weighted, plain = (float((error * weight).sum()) for error in errors)
    assert weighted < 0.5 * plain


@pytest.mark.parametrize("value", [0.0, 2.0**-24, 1e-5, 1.0, 65504.0, 1e9])
def test_one_colour_is_kept(value, device):
    _, decoded = bc6h_blocks(torch.full((1, 16, 3), value, device=device))
    expected = min(value, 65504.0)
    assert torch.allclose(decoded.cpu(), torch.tensor(expected), rtol=1e-3, atol=2.0**-24)
