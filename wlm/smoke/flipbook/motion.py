"""Motion between the frames of a flip book: a texture of motion vectors, by which players interpolate frames.

A frame's cell stores its motion to the next frame, in shares of the frame's width and height: to the right in the first
channel, up in the second, each as 127/255 + motion / (2 scale), so that 8 bits represent 0 exactly. An interpolated
picture reads the earlier frame backwards along the motion and the later frame forwards, and blends both: moving smoke
stays sharp, where a cross-fade would show it twice.
"""

import os
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from wlm.errors import WlmError
from wlm.smoke.data import Frames, load_frames
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.motion import motion, read_velocity, velocity_file
from wlm.system import Meter, OnProgress

ZERO = 127.0 / 255.0
"""Value of zero motion in the texture."""

_TRACE = 1e-3  # weight of the surroundings of a pixel that has a motion
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
_BLUR = 0.75  # pixels of motion up to which resampling blurs more than a cross-fade
_ABOUT = 9  # edge in pixels of the squares for comparing frames and for smoothing
_FEW = 1e-4  # squared difference of light that is ignored
_STILL = 1e-6  # smallest scale


def open_motion(path: str | os.PathLike[str], device: str = "cpu") -> Frames:
    """Opens the frames and velocities of a simulation, for `frames_motion`.

    Raises:
        WlmError: As for `load_frames`, the path is not a folder, or a frame's velocity is missing.
    """
    if not os.path.isdir(path):
        raise WlmError(f"{path}: expected a folder of frames from simulate --velocity, found no folder")
    frames = load_frames(path, device=device)
    for number in frames.numbers:
        file = velocity_file(frames.path, number)
        if not file.is_file():
            raise WlmError(f"{file}: the velocity of the air is missing: simulate the frames with --velocity")
    return frames


def frames_motion(
    frames: Frames, numbers: Sequence[int], book: Sequence[SixWay], progress: OnProgress | None = None
) -> torch.Tensor:
    """Computes the motion of the smoke from each frame of a flip book to the next.

    Not everything in a picture moves with the air: the smoke's edge at an inlet stays, as do light and shadow. The
    motion of the air at each pixel is therefore multiplied by a factor from 0 to 1, the one for which the frame, moved
    by the product, is most similar to the next frame.

    Args:
        frames: Frames from `open_motion`.
        numbers: Numbers of the flip book's frames, increasing.
        book: Lightmaps of the flip book's frames, with transparency and orthographic cameras.
        progress: Called after each frame.

    Returns:
        float32 [N, 2, H, W] on the CPU: motion to the right and down, in shares of the frame's width and height. The
        last frame has the motion from the frame before. Pixels without smoke have the motion of the smoke around.

    Raises:
        WlmError: A frame or a velocity is missing or damaged.
    """
    found = []
    meter = Meter(progress, "motion", len(numbers))
    for i, (number, six) in enumerate(zip(numbers, book, strict=True)):
        if number not in frames.files:
            name = frames.file(number).name
            raise WlmError(f"{frames.path}: frame {i + 1} of the flip book needs {name}, which is missing: simulate it")
        later = numbers[i + 1] if i + 1 < len(numbers) else number
        between = range(number + 1, later + 1) if later > number else [number]
        apart = len(between) if later > number else (number - numbers[i - 1] if i else 1)
        mean = sum(read_velocity(velocity_file(frames.path, each)) for each in between) / len(between)
        volume = frames.load(number)
        carried = wp.array(mean, dtype=wp.vec3, device=wp.device_from_torch(volume.device))
        # Forward motion: from this frame to the next.
        moved = -motion(volume, carried, six.camera, reach=-float(apart)).cpu()
        moved = spread_out(moved, (moved != 0).any(0).float())
        moved /= torch.tensor([six.camera.width, six.camera.height])[:, None, None]
        found.append(_agreeing(moved, six, book[i + 1]) if i + 1 < len(book) else moved)
        meter.report(i + 1)
    return torch.stack(found)


def spread_out(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Replaces values [C, H, W] whose weight [H, W] is 0 by averages of the values around them."""
    sums, weights = [values[None] * weight], [weight[None, None]]
    while max(sums[-1].shape[2:]) > 1:
        for parts in (sums, weights):
            parts.append(F.avg_pool2d(parts[-1], 2, ceil_mode=True))
    filled = torch.zeros_like(sums[-1])
    for one, own in zip(reversed(sums), reversed(weights), strict=True):
        around = F.interpolate(filled, one.shape[2:], mode="bilinear", align_corners=False)
        filled = (one + _TRACE * around) / (own + _TRACE)
    return filled[0]


def _agreeing(moved: torch.Tensor, one: SixWay, other: SixWay) -> torch.Tensor:
    """Multiplies a motion [2, H, W] at each pixel by the factor with which it maps frame `one` best to `other`."""
    before, after = _planes(one).cpu(), _planes(other).cpu()
    off = []
    for share in _SHARES:
        difference = (_read(after, _places(moved) + share * moved) - before).square().sum(0)
        off.append(_smooth(difference) + _FEW * (1.0 - share))
    share = torch.tensor(_SHARES)[torch.stack(off).argmin(0)]
    pixels = moved * torch.tensor([before.shape[2], before.shape[1]])[:, None, None]
    share = share * ((pixels.norm(dim=0) - _BLUR) / _BLUR).clamp(0.0, 1.0)
    return moved * _smooth(share)


def _smooth(plane: torch.Tensor) -> torch.Tensor:
    """Returns the mean over 9 x 9 pixels around each pixel, [H, W]."""
    return F.avg_pool2d(plane[None], _ABOUT, 1, _ABOUT // 2, count_include_pad=False)[0]


def scale_of(motions: torch.Tensor) -> float:
    """Returns the largest motion of a flip book, which is the range of its motion texture."""
    return max(float(motions.abs().max()), _STILL)


def encoded(motions: torch.Tensor, scale: float) -> np.ndarray:
    """Returns the cells of a motion texture, float32 [N, H, W, 3]: encoded motion to the right, upwards, and 0."""
    way = motions.permute(0, 2, 3, 1).numpy() * np.float32([1.0, -1.0])
    cells = np.float32(ZERO) + way / np.float32(2.0 * scale)
    return np.concatenate([cells, np.zeros_like(cells[..., :1])], -1)


def _planes(six: SixWay) -> torch.Tensor:
    """Returns the six lightmaps, the opacity and the emission, [8, H, W]."""
    glow = torch.zeros_like(six.transparency) if six.emission is None else six.emission
    return torch.cat([six.lightmaps, torch.stack([1.0 - six.transparency, glow])])


def _places(moved: torch.Tensor) -> torch.Tensor:
    """Returns the pixel centres of an image as large as `moved`, [2, H, W]: to the right and down, 0 to 1."""
    axes = [(torch.arange(n, device=moved.device) + 0.5) / n for n in moved.shape[1:]]
    return torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1])


def _read(planes: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Samples planes [C, H, W] at positions [2, H, W] in 0 to 1; positions outside read the nearest edge."""
    grid = (2.0 * place - 1.0).permute(1, 2, 0)[None]
    return F.grid_sample(planes[None], grid, padding_mode="border", align_corners=False)[0]


def mip_padding(height: int, width: int, levels: int) -> int:
    """Returns the least padding in pixels with which `levels` mip levels do not mix neighbouring frames.

    A texel of the coarsest level must not span two cells, and the half texel that a filter reads beyond a frame's edge
    must be within its padding.

    Raises:
        WlmError: No padding makes both sides of a cell multiples of a texel of the coarsest level.
    """
    part = 2**levels
    for padding in range(part // 2, part // 2 + part):
        if (height + 2 * padding) % part == 0 == (width + 2 * padding) % part:
            return padding
    raise WlmError(
        f"mips: {levels} levels need cells with sides of a multiple of {part} pixels, which no padding gives for frames"
        f" of {width} x {height} pixels: use fewer levels"
    )


def mip_levels(height: int, width: int, padding: int) -> int:
    """Returns the index of the coarsest mip level that does not mix neighbouring padded frames; 0: no mips."""
    level = 0
    while 2**level <= padding and not any((n + 2 * padding) % 2 ** (level + 1) for n in (height, width)):
        level += 1
    return level
