"""RGB9E5 in kernels, against the same in NumPy."""

import numpy as np
import warp as wp

from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5, unpack_rgb9e5
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel


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
    words, back = (
        wp.empty(len(light), dtype=wp.uint32, device=device),
        wp.empty(len(light), dtype=wp.vec3, device=device),
    )
    wp.launch(_both_ways, len(light), [wp.array(light, dtype=wp.vec3, device=device), words, back], device=device)
    np.testing.assert_array_equal(back.numpy(), unpack_rgb9e5(words.numpy()))
    # A half is rounded up here and to even there.
    expected = unpack_rgb9e5(pack_rgb9e5(light))
    step = np.maximum(light.max(1, keepdims=True), 2.0**-16).clip(max=LARGEST) / 256
    assert (np.abs(back.numpy() - expected) <= step).all() and (back.numpy() == expected).mean() > 0.999
