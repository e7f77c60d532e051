"""Decoding tiles that are stored as images, one at each time: what frames and video share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.lightmap.decode import bytes_over
from wlm_kernels.shared_exponent import pack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.func
def power(colour: wp.vec3, exponent: float) -> wp.vec3:
    return wp.vec3(wp.pow(colour[0], exponent), wp.pow(colour[1], exponent), wp.pow(colour[2], exponent))


@dataclass(frozen=True)
class ImageKernels:
    """The kernels of one kind of images; in each of them an image is of time t of a tile n at n T + t."""

    radiance: wp.Kernel
    bytes: wp.Kernel
    shared: wp.Kernel

    def decode_radiance(self, stored, early: int, late: int, share: float, tiles, out) -> None:
        """Decodes tiles to linear radiance.

        Args:
            stored: The struct that the kernels were made for.
            early, late, share: The two images around the time, and the share of the second in [0, 1).
            tiles: int [n], the tiles to decode.
            out: vec3 [n, 128, 128], written.
        """
        inputs = [stored, early, late, share, tiles]
        wp.launch(self.radiance, out.shape, inputs=inputs, outputs=[out], device=out.device)

    def decode_bytes(self, stored, early: int, late: int, share: float, tiles, inverse_peak, out) -> None:
        """Decodes tiles to 8-bit colour in gamma space over a bound.

        Args:
            stored, early, late, share, tiles: As for `decode_radiance`.
            inverse_peak: float [N], 1 / the bound of each tile; 0 for a black one.
            out: uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255, written.
        """
        inputs = [stored, early, late, share, tiles, inverse_peak]
        wp.launch(self.bytes, out.shape, inputs=inputs, outputs=[out], device=out.device)

    def decode_shared(self, stored, early: int, late: int, share: float, tiles, out) -> None:
        """Decodes tiles to linear radiance as RGB9E5.

        Args:
            stored, early, late, share, tiles: As for `decode_radiance`.
            out: uint32 [n, 128, 128], written.
        """
        inputs = [stored, early, late, share, tiles]
        wp.launch(self.shared, out.shape, inputs=inputs, outputs=[out], device=out.device)


def image_kernels(stored_type: Any, colour_of: Callable[..., Any]) -> ImageKernels:
    """Makes the kernels of one kind of images.

    Args:
        stored_type: A `wp.struct` with `times`, T, and `gamma`.
        colour_of: `wp.func` of it, an image's number, y and x: the colour of a texel in gamma space.
    """

    @wp.func
    def radiance(stored: stored_type, early: int, late: int, share: float, n: int, y: int, x: int) -> wp.vec3:
        """Between two images (eq. 2)."""
        light = power(colour_of(stored, n * stored.times + early, y, x), stored.gamma)
        if share > 0.0:
            other = power(colour_of(stored, n * stored.times + late, y, x), stored.gamma)
            light = (1.0 - share) * light + share * other
        return light

    @wp.kernel(module="unique", enable_backward=False)
    def decode_radiance(
        # in:
        stored: stored_type,
        early: int,
        late: int,
        share: float,
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.vec3],
    ):
        i, y, x = wp.tid()
        out[i, y, x] = radiance(stored, early, late, share, tiles[i], y, x)

    @wp.kernel(module="unique", enable_backward=False)
    def decode_bytes(
        # in:
        stored: stored_type,
        early: int,
        late: int,
        share: float,
        tiles: wp.array1d[int],
        inverse_peak: wp.array1d[float],
        # out:
        out: wp.array3d[wp.uint32],
    ):
        i, y, x = wp.tid()
        n = tiles[i]
        if share > 0.0:
            colour = power(radiance(stored, early, late, share, n, y, x), 1.0 / stored.gamma)
        else:
            colour = colour_of(stored, n * stored.times + early, y, x)
        out[i, y, x] = bytes_over(colour, inverse_peak[n])

    @wp.kernel(module="unique", enable_backward=False)
    def decode_shared(
        # in:
        stored: stored_type,
        early: int,
        late: int,
        share: float,
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.uint32],
    ):
        i, y, x = wp.tid()
        out[i, y, x] = pack_rgb9e5(radiance(stored, early, late, share, tiles[i], y, x))

    return ImageKernels(decode_radiance, decode_bytes, decode_shared)
