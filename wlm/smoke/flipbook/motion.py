"""Motion between a flip book's frames: a texture of motion vectors, by which frames are interpolated.

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
    """Opens a simulation's frames, for `frames_motion`.

    Raises:
        WlmError: As for `load_frames`, the path is not a folder, or a frame's velocity is missing.
    """
    if not os.path.isdir(path):
        raise WlmError(f"{path}: expected a folder of frames, with the air's velocity, found none")
    frames = load_frames(path, device=device)
    for number in frames.numbers:
        file = velocity_file(frames.path, number)
        if not file.is_file():
            raise WlmError(f"{file}: expected the air's velocity, found none: simulate with --velocity keeps it")
    return frames


def frames_motion(
    frames: Frames, numbers: Sequence[int], book: Sequence[SixWay], progress: OnProgress | None = None
) -> torch.Tensor:
    """Computes the motion of the smoke from each frame of a flip book to the next.

    Not everything in a picture moves with the air: the smoke's edge at an inlet stays, as do light and shadow. The
    air's motion at each pixel is therefore multiplied by the factor, 0 to 1, with which it maps the frame to the most
    similar part of the next.

    Args:
        frames: Frames from `open_motion`.
        numbers: Numbers of the flip book's frames, increasing.
        book: These frames, with transparency and orthographic cameras.
        progress: Called after each frame.

    Returns:
        float32 [N, 2, H, W] on the CPU: to the right and down, in shares of the frame's width and height. The last
        frame repeats the motion before it. Where there is no smoke, the motion is filled from the smoke around.

    Raises:
        WlmError: A frame or a velocity is missing or damaged.
    """
    found = []
    meter = Meter(progress, "motion", len(numbers))
    for i, (number, six) in enumerate(zip(numbers, book, strict=True)):
        if number not in frames.files:
            raise WlmError(f"{frames.path}: expected {frames.file(number).name}, of the flip book's frame {i + 1}")
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
    """Fills [C, H, W] where its weight [H, W] is 0 from the surroundings, by means over ever larger squares."""
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
    """Multiplies a motion [2, H, W], at each pixel, by the factor with which it maps one frame best to the other."""
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
    """Returns the mean over a square around each pixel, [H, W]."""
    return F.avg_pool2d(plane[None], _ABOUT, 1, _ABOUT // 2, count_include_pad=False)[0]


def scale_of(motions: torch.Tensor) -> float:
    """Returns the range of a texture of motion: the largest motion of the flip book."""
    return max(float(motions.abs().max()), _STILL)


def encoded(motions: torch.Tensor, scale: float) -> np.ndarray:
    """Returns a texture's cells, float32 [N, H, W, 3]: motion to the right, motion up, 0."""
    way = motions.permute(0, 2, 3, 1).numpy() * np.float32([1.0, -1.0])
    cells = np.float32(ZERO) + way / np.float32(2.0 * scale)
    return np.concatenate([cells, np.zeros_like(cells[..., :1])], -1)


def _planes(six: SixWay) -> torch.Tensor:
    """Returns light, opacity and emission, [8, H, W]."""
    glow = torch.zeros_like(six.transparency) if six.emission is None else six.emission
    return torch.cat([six.lightmaps, torch.stack([1.0 - six.transparency, glow])])


def _places(moved: torch.Tensor) -> torch.Tensor:
    """Returns the positions of the pixels, to the right and down, [2, H, W] in 0 to 1."""
    axes = [(torch.arange(n, device=moved.device) + 0.5) / n for n in moved.shape[1:]]
    return torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1])


def _read(planes: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Samples planes [C, H, W] at positions [2, H, W] in 0 to 1; constant beyond the border."""
    grid = (2.0 * place - 1.0).permute(1, 2, 0)[None]
    return F.grid_sample(planes[None], grid, padding_mode="border", align_corners=False)[0]


def mip_padding(height: int, width: int, levels: int) -> int:
    """Returns the least padding in pixels with which frames do not show their neighbours in mips down to a level.

    A texel of a level must not span two cells, and the half texel beyond a frame's border that a filter reads must be
    within the frame's padding.

    Raises:
        WlmError: No padding suffices for such frames.
    """
    part = 2**levels
    for padding in range(part // 2, part // 2 + part):
        if (height + 2 * padding) % part == 0 == (width + 2 * padding) % part:
            return padding
    raise WlmError(f"mips: {levels} need sides that a padding takes to multiples of {part}, got {width} x {height}")


def mip_levels(height: int, width: int, padding: int) -> int:
    """Returns the index of the coarsest mip level at which padded frames do not show their neighbours; 0: no mips."""
    level = 0
    while 2**level <= padding and not any((n + 2 * padding) % 2 ** (level + 1) for n in (height, width)):
        level += 1
    return level
