"""BC7, BC6H and ASTC: our encoders and decoders against others, bit for bit, and the formats' interpolation."""

import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder
import torch
from builders.synthetic import any_blocks

from benchmarks.rivals import astcenc
from benchmarks.rivals.lightmap_blocks import ispc_bc6h
from wlm.errors import WlmError
from wlm.formats.bc7 import SHARES, decode_image, encode_image, pack_mode6
from wlm.ops.hdr_blocks import encoded_blocks

ROWS, COLUMNS = 64, 96


def _parameters(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Random endpoints, each with a P bit of its own, and random indices."""
    rng = np.random.default_rng(5)
    upper = rng.integers(0, 128, (*shape, 2, 4), np.uint8)
    parity = rng.integers(0, 2, (*shape, 2, 1), np.uint8)
    return upper << 1 | parity, rng.integers(0, 16, (*shape, 16), np.uint8)


@pytest.mark.parametrize("blocks", [any_blocks(ROWS, COLUMNS, seed=3), pack_mode6(*_parameters(ROWS, COLUMNS))])
def test_two_other_decoders_agree_bit_for_bit(blocks):
    ours = decode_image(blocks)
    shape = (4 * ROWS, 4 * COLUMNS, 4)
    assert np.array_equal(ours, imagecodecs.bcn_decode(blocks.tobytes(), 7, shape=shape))
    bgra = texture2ddecoder.decode_bc7(blocks.tobytes(), 4 * COLUMNS, 4 * ROWS)
    assert np.array_equal(ours, np.frombuffer(bgra, np.uint8).reshape(shape)[..., [2, 1, 0, 3]])


def test_every_partition_is_read():
    """The number of a partition is in the bits above those of the mode."""
    for mode in (0, 1, 2, 3, 7):
        count = 16 if mode == 0 else 64
        blocks = np.random.default_rng(mode).integers(0, 256, (count, 64, 16), np.uint8)
        low = blocks[..., :2].copy().view("<u2")[..., 0] & ~np.uint16((2 * count << mode) - 1)
        low |= np.arange(count, dtype=np.uint16)[:, None] << mode + 1 | np.uint16(1 << mode)
        blocks[..., :2] = low.astype("<u2")[..., None].view(np.uint8)
        other = imagecodecs.bcn_decode(blocks.tobytes(), 7, shape=(4 * count, 256, 4))
        assert np.array_equal(decode_image(blocks), other), mode


def test_packing_keeps_the_texels():
    endpoints, indices = _parameters(4, 5)
    assert np.any(indices[..., 0] >= 8) and np.any(indices[..., 0] < 8)
    blocks = pack_mode6(endpoints, indices)
    assert blocks.shape == (4, 5, 16) and blocks.dtype == np.uint8
    share, ends = SHARES[2][indices][..., None], endpoints.astype(int)[..., None, :, :]
    mixed = ((64 - share) * ends[..., 0, :] + share * ends[..., 1, :] + 32) >> 6  # [4, 5, 16, 4]
    image = mixed.reshape(4, 5, 4, 4, 4).swapaxes(1, 2).reshape(16, 20, 4)
    assert np.array_equal(decode_image(blocks), image)


def test_views_several_images_and_no_blocks_at_all_work():
    blocks = any_blocks(2, 6, 4)
    images = decode_image(blocks[:, ::2, ::-1])
    assert images.shape == (2, 12, 16, 4)
    assert np.array_equal(images[1], decode_image(np.ascontiguousarray(blocks[1, ::2, ::-1])))
    assert decode_image(np.empty((0, 3, 16), np.uint8)).shape == (0, 12, 4)
    assert pack_mode6(np.empty((0, 2, 4), np.uint8), np.empty((0, 16), np.uint8)).shape == (0, 16)


def test_an_encoded_picture_is_near(monkeypatch):
    v, u = np.mgrid[:64, :32] / 64.0
    picture = (255 * np.stack([u, v, u * v], 2)).astype(np.uint8)
    blocks = encode_image(picture, "frames")
    assert blocks.shape == (16, 8, 16)
    assert np.abs(decode_image(blocks).astype(int)[..., :3] - picture).max() <= 3 and blocks[..., 0].all()
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    message = r"^frames: ispc_texcomp is missing; needs the extra: pip install 'wlm.frames.'$"
    with pytest.raises(WlmError, match=message):
        encode_image(picture, "frames")


ASTC = astcenc.astc((4, 4), astcenc.MEDIUM, "atlas")
CODECS = pytest.mark.parametrize("codec", ["bc6h", "astc"])


def _other(codec: str, blocks: np.ndarray) -> np.ndarray:
    """Decodes blocks, uint8 [N, 16], with imagecodecs or astcenc to [N, 16, 3]."""
    if codec == "bc6h":
        return imagecodecs.bcn_decode(blocks.tobytes(), 6, shape=(4 * len(blocks), 4, 3)).reshape(-1, 16, 3)
    return ASTC.decode(blocks.tobytes(), 4 * len(blocks), 4).reshape(-1, 16, 3)


def _theirs(codec: str, light: np.ndarray) -> np.ndarray:
    """Encodes blocks with Intel's encoder or astcenc, and decodes them."""
    half = light.astype(np.float16).reshape(-1, 4, 4, 3)
    if codec == "astc":
        return ASTC.decode(ASTC.encode(half.reshape(-1, 4, 3)), 4 * len(light), 4).reshape(-1, 16, 3)
    data = ispc_bc6h(half.transpose(1, 0, 2, 3).reshape(4, -1, 3))
    return _other(codec, np.frombuffer(data, np.uint8).reshape(-1, 16))


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


@CODECS
def test_the_encoder_says_what_its_blocks_hold_and_is_better_than_another(codec, device):
    light = _pictures()
    blocks, decoded = (part.cpu().numpy() for part in encoded_blocks(codec, torch.from_numpy(light).to(device)))
    np.testing.assert_array_equal(_other(codec, blocks).astype(np.float32), decoded)
    np.testing.assert_array_equal(blocks, encoded_blocks(codec, torch.from_numpy(light))[0])  # those of the CPU
    kinds = blocks[:, 0] & 31 if codec == "bc6h" else blocks[:, :2].copy().view(np.uint16)[:, 0] & 0x1FFF
    assert len(set(kinds.tolist())) >= {"bc6h": 15, "astc": 8}[codec]  # most modes

    def decibels(found: np.ndarray) -> float:
        """Returns the PSNR of errors relative to the brightest value of each block."""
        return float(-10 * np.log10(np.mean(np.square((found - light) / light.max((1, 2), keepdims=True)))))

    assert decibels(decoded) > decibels(_theirs(codec, light).astype(np.float32)) + 1.0


@CODECS
def test_weights_choose_the_texels_that_count(codec, device):
    random = np.random.default_rng(2)
    light = torch.from_numpy(random.random((50, 16, 3)).astype(np.float32)).to(device)
    weight = torch.from_numpy((random.random((50, 16)) < 0.3).astype(np.float32)).to(device)
    errors = [(encoded_blocks(codec, light, each)[1] - light).square().sum(2) for each in (weight, None)]
    weighted, plain = (float((error * weight).sum()) for error in errors)
    assert weighted < 0.5 * plain


@CODECS
@pytest.mark.parametrize("value", [0.0, 2.0**-24, 1e-5, 1.0, 65504.0, 1e9])
def test_one_colour_is_kept(codec, value, device):
    _, decoded = encoded_blocks(codec, torch.full((1, 16, 3), value, device=device))
    expected = min(value, 65504.0)
    assert torch.allclose(decoded.cpu(), torch.tensor(expected), rtol=1e-3, atol=2.0**-24)


@CODECS
def test_extreme_blocks_stay_finite_and_near_their_light(codec, device):
    """One texel at the largest light, in black or in the least light; one black texel; primary colours; the least
    light in some texels."""
    light = np.zeros((5, 16, 3), np.float32)
    light[0, 5] = light[1, 5] = light[2] = 65504.0
    light[1, 6:] = 2.0**-24
    light[2, 5] = 0.0
    light[3] = np.eye(3, dtype=np.float32)[np.arange(16) % 3]
    light[4, ::3] = 2.0**-24
    blocks, decoded = (part.cpu().numpy() for part in encoded_blocks(codec, torch.from_numpy(light).to(device)))
    np.testing.assert_array_equal(_other(codec, blocks).astype(np.float32), decoded)
    worst = np.abs(decoded - light).max((1, 2)) / light.max((1, 2))
    assert (worst < (0.01, 0.01, 0.01, 1.1, 1.1)).all()


def test_threads_give_the_same_blocks(monkeypatch):
    light, codec = torch.from_numpy(_pictures()), "astc"
    one = encoded_blocks(codec, light[:200])
    monkeypatch.setattr("wlm.ops.hdr_blocks._BLOCKS_A_THREAD", 7)
    monkeypatch.setattr("wlm.ops.hdr_blocks.cores", lambda: 9)
    for found, expected in zip(encoded_blocks(codec, light[:200]), one, strict=True):
        assert torch.equal(found, expected)
    assert [len(part) for part in encoded_blocks(codec, light[:0])] == [0, 0]
