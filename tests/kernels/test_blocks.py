"""Maps as BC7 blocks and light as RGB9E5: the integers that are stored, and what is trained with them."""

import numpy as np
import torch
import warp as wp
from reference import blocks as reference

from benchmarks import plain
from kernels.compare import array
from wlm import ops
from wlm.formats.bc7 import decode_image
from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5, unpack_rgb9e5
from wlm_kernels.lightmap import blocks
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel


def _edge_endpoints() -> np.ndarray:
    """Random endpoints [B, 2, 4], and those where rounding is delicate: 0, 1, ties, outside, equal, NaN-free."""
    random = np.random.default_rng(11)
    cases = [random.uniform(-0.2, 1.2, (400, 2, 4))]
    corners = np.array([0.0, 1.0, -3.0, 4.0, 0.5, 1 / 255, 254 / 255, 127.5 / 255, 0.5 / 255, 254.5 / 255])
    cases.append(random.choice(corners, (400, 2, 4)))
    cases.append(np.repeat(random.uniform(0, 1, (100, 1, 4)), 2, 1))  # equal endpoints
    cases.append(np.broadcast_to(corners[:, None, None], (len(corners), 2, 4)))
    cases.append(np.arange(256)[:, None, None] / 255.0 * np.ones((1, 2, 4)))  # every byte
    return np.concatenate(cases).astype(np.float32)


def _blocks_in_a_row(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One slice of edge endpoints with random and edge weights: [1, 1, B, 2, 4] and [1, 4, 4 B]."""
    endpoints = _edge_endpoints()[None, None]
    random = np.random.default_rng(seed)
    weights = random.uniform(-0.1, 1.1, (1, 4, 4 * endpoints.shape[2])).astype(np.float32)
    special = random.random(weights.shape) < 0.3
    weights[special] = random.choice([0.0, 1.0, 0.5, 7.5 / 15, -2.0, 3.0], special.sum())
    return endpoints, weights


def _quantise(endpoints: np.ndarray, weights: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    bytes_out = wp.zeros(endpoints.shape[:-1], dtype=wp.vec4ub, device=device)
    index_out = wp.zeros(weights.shape, dtype=wp.uint8, device=device)
    blocks.quantise(array(endpoints, wp.vec4, device), array(weights, float, device), bytes_out, index_out)
    return bytes_out.numpy(), index_out.numpy()


def test_quantised_texels_are_the_decoded_file(device: str):
    """What is trained on is what the file decodes to, bit for bit; alone and in layers."""
    leaves = [torch.tensor(values).to(device) for values in _blocks_in_a_row(12)]
    for maps in (leaves, [values[0] for values in leaves]):
        packed = ops.bc7_blocks(*maps)
        decoded = decode_image(packed[0] if packed.ndim == 4 else packed).astype(np.float32) / np.float32(255.0)
        texels = ops.bc7_texels(*maps, quantised=True).cpu().numpy()
        np.testing.assert_array_equal(texels.reshape(decoded.shape), decoded)


def test_quantised_endpoints_are_the_nearest(device: str):
    """No storable endpoint is nearer, beyond float32's say in a tie; indices are the nearest of sixteen."""
    endpoints, weights = _blocks_in_a_row(13)
    stored, index = _quantise(endpoints, weights, device)
    assert np.all(stored & 1 == (stored & 1)[..., :1])
    best, margin = reference.endpoint_bytes(torch.tensor(endpoints))
    wanted = np.clip(endpoints.astype(np.float64), 0, 1) * 255

    def distance(chosen: np.ndarray) -> np.ndarray:
        return ((chosen.astype(np.float64) - wanted) ** 2).sum(-1)

    np.testing.assert_array_less(distance(stored), distance(best.numpy()) + 1e-3)
    clear = margin.numpy() > 1e-3
    assert clear.mean() > 0.5
    # A channel half-way between two bytes of one parity may go either way; its distance is checked above.
    near_tie = np.abs(wanted - best.numpy()) > 0.999
    same = (stored == best.numpy()) | near_tie
    assert same[clear].all()
    position = np.clip(weights.astype(np.float64), 0, 1) * 15
    assert np.abs(index - position).max() <= 0.5 + 1e-5
    assert set(np.unique(index)) == set(range(16))


def test_twin_decodes_the_file_too():
    """The twin's float64 texels are the file's, where no endpoint is as near to two of its bytes."""
    random = np.random.default_rng(14)
    endpoints, weights = (torch.tensor(random.uniform(size=shape)).float() for shape in ((3, 50, 2, 4), (12, 200)))
    texels = plain.bc7_texels(endpoints.double(), weights.double(), quantised=True)
    np.testing.assert_allclose(texels.numpy() * 255.0, decode_image(ops.bc7_blocks(endpoints, weights)))


def test_no_blocks():
    assert ops.bc7_blocks(torch.zeros(0, 2, 2, 4), torch.zeros(0, 8)).shape == (0, 2, 16)
    assert ops.bc7_blocks(torch.zeros(0, 1, 2, 2, 4), torch.zeros(0, 4, 8)).shape == (0, 1, 2, 16)


@wp.kernel
def _both_ways(light: wp.array1d[wp.vec3], words: wp.array1d[wp.uint32], back: wp.array1d[wp.vec3]):
    i = wp.tid()
    words[i] = pack_kernel(light[i])
    back[i] = unpack_kernel(words[i])


def test_texels_are_packed_as_on_the_host(device):
    random = np.random.default_rng(0)
    light = random.random((4000, 3)) * 2.0 ** random.integers(-26, 17, (4000, 1))
    powers = 2.0 ** np.arange(-25, 17)
    edges = np.concatenate([powers, np.nextafter(powers, 0), powers * (1 - 1 / 1024)])[:, None] * [1.0, 0.5, 0.0]
    light = np.concatenate([light, edges, [[0, 0, 0], [LARGEST, 1e9, 0], [-1, 0.5, 0]]]).astype(np.float32)
    words = wp.empty(len(light), dtype=wp.uint32, device=device)
    back = wp.empty(len(light), dtype=wp.vec3, device=device)
    wp.launch(_both_ways, len(light), [wp.array(light, dtype=wp.vec3, device=device), words, back], device=device)
    np.testing.assert_array_equal(back.numpy(), unpack_rgb9e5(words.numpy()))
    # A half is rounded up here and to even there.
    expected = unpack_rgb9e5(pack_rgb9e5(light))
    step = np.maximum(light.max(1, keepdims=True), 2.0**-16).clip(max=LARGEST) / 256
    assert (np.abs(back.numpy() - expected) <= step).all() and (back.numpy() == expected).mean() > 0.999
