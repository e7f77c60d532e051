"""Motion of a flip book in torch, in the way of the shader that `wlm.smoke.flipbook.shader` writes."""

import torch

from wlm.smoke.flipbook import motion
from wlm.smoke.lightmaps import SixWay


def between(one: SixWay, other: SixWay, moved: torch.Tensor, share: float) -> SixWay:
    """Interpolates lightmaps between a frame and the next, in the way of the shader.

    Args:
        one, other: The frames, with transparency.
        moved: float32 [2, H, W], motion of the first frame, see `frames_motion`.
        share: 0 is the first frame, 1 the next.
    """
    place = motion._places(moved)
    # Motion of the smoke that is at a pixel at this time, which was elsewhere in the first frame.
    way = motion._read(moved, place - share * motion._read(moved, place))
    ends = (one, place - share * way), (other, place + (1.0 - share) * way)
    mixed = torch.lerp(*(motion._read(motion._planes(six), at) for six, at in ends), share)
    hot = one.emission is not None or other.emission is not None
    return SixWay(mixed[:6], 1.0 - mixed[6], mixed[7] if hot else None, one.camera)
