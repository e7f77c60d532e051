"""BC7 against two other decoders, bit for bit, and against the format's interpolation."""

import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder
from builders.synthetic import any_blocks

from wlm.errors import WlmError
from wlm.formats.bc7 import SHARES, decode_image, encode_image, pack_mode6

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
