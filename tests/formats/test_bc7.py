import imagecodecs
import numpy as np
import pytest
import texture2ddecoder

from wlm.errors import WlmError
from wlm.formats.bc7 import WEIGHTS, decode_image, decode_mode6, pack_mode6, unpack_mode6

ROWS, COLUMNS = 64, 80


def _parameters(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Random endpoints, each with a P bit of its own, and random indices."""
    rng = np.random.default_rng(5)
    upper = rng.integers(0, 128, (*shape, 2, 4), np.uint8)
    parity = rng.integers(0, 2, (*shape, 2, 1), np.uint8)
    return upper << 1 | parity, rng.integers(0, 16, (*shape, 16), np.uint8)


def _random_blocks(*shape: int) -> np.ndarray:
    """Any 128 bits are a valid block once the mode's 7 are set."""
    blocks = np.random.default_rng(6).integers(0, 256, (*shape, 16), np.uint8)
    blocks[..., 0] = blocks[..., 0] & 0x80 | 0x40
    return blocks


def _mix(endpoints: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """The format's interpolation in Python integers."""
    texels = np.empty((*indices.shape, 4), np.uint8)
    for place in np.ndindex(*indices.shape):
        weight = int(WEIGHTS[indices[place]])
        for channel in range(4):
            first, second = (int(endpoints[(*place[:-1], end, channel)]) for end in range(2))
            texels[(*place, channel)] = ((64 - weight) * first + weight * second + 32) >> 6
    return texels


@pytest.mark.parametrize("blocks", [_random_blocks(ROWS, COLUMNS), pack_mode6(*_parameters(ROWS, COLUMNS))])
def test_two_other_decoders_agree_bit_for_bit(blocks):
    ours = decode_image(blocks)
    shape = (4 * ROWS, 4 * COLUMNS, 4)
    assert np.array_equal(ours, imagecodecs.bcn_decode(blocks.tobytes(), 7, shape=shape))
    bgra = texture2ddecoder.decode_bc7(blocks.tobytes(), 4 * COLUMNS, 4 * ROWS)
    assert np.array_equal(ours, np.frombuffer(bgra, np.uint8).reshape(shape)[..., [2, 1, 0, 3]])


def test_packing_keeps_the_texels():
    endpoints, indices = _parameters(4, 5)
    assert np.any(indices[..., 0] >= 8) and np.any(indices[..., 0] < 8)
    blocks = pack_mode6(endpoints, indices)
    assert blocks.shape == (4, 5, 16) and blocks.dtype == np.uint8
    assert np.array_equal(decode_mode6(blocks), _mix(endpoints, indices))


def test_unpacking_gives_back_what_was_packed():
    endpoints, indices = _parameters(1000)
    indices[:, 0] &= 7
    found = unpack_mode6(pack_mode6(endpoints, indices))
    assert np.array_equal(found[0], endpoints) and np.array_equal(found[1], indices)
    blocks = _random_blocks(1000)
    assert np.array_equal(pack_mode6(*unpack_mode6(blocks)), blocks)


def test_a_view_and_no_blocks_at_all_work():
    blocks = _random_blocks(6, 4)
    assert np.array_equal(decode_mode6(blocks[::2, ::-1]), decode_mode6(blocks)[::2, ::-1])
    assert decode_mode6(np.empty((0, 16), np.uint8)).shape == (0, 16, 4)
    assert pack_mode6(np.empty((0, 2, 4), np.uint8), np.empty((0, 16), np.uint8)).shape == (0, 16)


@pytest.mark.parametrize("mode", [0, 1, 2, 3, 4, 5, 7])
def test_another_mode_is_named(mode):
    blocks = _random_blocks(3, 4)
    blocks[1, 2, 0] = 0xFF << mode & 0xFF
    with pytest.raises(WlmError, match=f"^BC7 block 6: expected mode 6, found mode {mode}$"):
        decode_image(blocks)
    blocks[1, 2, 0] = 0
    with pytest.raises(WlmError, match="block 6: expected mode 6, found a reserved mode"):
        unpack_mode6(blocks)


def test_wrong_arguments_are_value_errors():
    endpoints, indices = _parameters(3)
    with pytest.raises(ValueError, match="uint8"):
        pack_mode6(endpoints.astype(np.int32), indices)
    with pytest.raises(ValueError, match="expected endpoints"):
        pack_mode6(endpoints, indices[:2])
    with pytest.raises(ValueError, match="0..15, got 16"):
        pack_mode6(endpoints, np.full_like(indices, 16))
    endpoints[1, 0, 2] ^= 1
    with pytest.raises(ValueError, match="share their lowest bit"):
        pack_mode6(endpoints, indices)
    with pytest.raises(ValueError, match="expected blocks uint8"):
        unpack_mode6(np.zeros((3, 15), np.uint8))
    with pytest.raises(ValueError, match="expected blocks uint8"):
        unpack_mode6(np.zeros((3, 16), np.int8))
    with pytest.raises(ValueError, match="H/4"):
        decode_image(np.zeros((3, 16), np.uint8))
