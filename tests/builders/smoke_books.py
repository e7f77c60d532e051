"""Flip books of random light, and the pictures that an engine must show of them."""

import dataclasses

import numpy as np
import torch
from reference.flipbook import between

from wlm.smoke.camera import Camera
from wlm.smoke.flipbook.book import Book, Shot, pack_book
from wlm.smoke.flipbook.motion import ZERO
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light, Ramp

FIRE = Ramp((0.0, 0.4, 1.0), ((0.0, 0.0, 0.0), (0.9, 0.2, 0.0), (1.0, 0.8, 0.4)))
TOWARD, IRRADIANCE, SKY = (0.48, -0.6, 0.64), (3.0, 2.0, 1.0), (0.2, 0.3, 0.4)
"""A light's direction and irradiance in the billboard's axes, and the radiance of the sky."""


def random_frames(count: int = 5, size: tuple[int, int] = (12, 16), *, hot: bool = True, seed: int = 0) -> list[SixWay]:
    """Makes frames of light in steps of 1/255 that changes slowly over the image, also where there is no smoke."""
    random = np.random.default_rng(seed)
    coarse = torch.tensor(random.uniform(0.1, 0.9, (count, 8, 3, 3)), dtype=torch.float32)
    maps = torch.nn.functional.interpolate(coarse, size, mode="bilinear", align_corners=True)
    maps = torch.round(maps * 255.0) / 255.0
    maps[:, 6, :2, :2] = 1.0
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), extent=2.0, height=size[0], width=size[1])
    return [SixWay(each[:6], each[6], each[7] if hot else None, camera) for each in maps]


def random_book(frames: list[SixWay], *, moving: bool = False, ramp: Ramp | None = FIRE, padding: int = 2) -> Book:
    """Packs frames into a flip book; `moving`: with the constant motion `MOVED`."""
    book = pack_book([Shot(i, six) for i, six in enumerate(frames, 1)], padding=padding, gain=1.0, rate=10.0)
    book = dataclasses.replace(book, ramp=ramp if book.hot else None)
    if not moving:
        return book
    motion = np.full((*book.first.shape[:2], 3), ZERO, np.float32)
    motion[..., :2] += np.float32([MOVED[0], -MOVED[1]]) / (2.0 * SCALE)
    return dataclasses.replace(book, motion=np.round(motion * 255.0) / np.float32(255.0), scale=SCALE)


SCALE = 255.0 / 2.0 / 64.0 / 8.0
"""Scale of the motion: 64 steps of 255 are an eighth of a frame."""
MOVED = (0.125, -0.125)
"""The constant motion to the right and down, as a fraction of a frame."""


def shown(frames: list[SixWay], book: Book, time: float) -> np.ndarray:
    """Returns a billboard at a time in frames under the light and the sky: light and opacity, [H, W, 4]."""
    first = min(int(time), len(frames) - 1)
    one, other = frames[first], frames[min(first + 1, len(frames) - 1)]
    moved = torch.zeros((2, *book.size))
    if book.motion is not None:
        moved += torch.tensor(MOVED)[:, None, None]
    six = between(one, other, moved, time - first)
    # Mixed in light, as textures are, and coloured then.
    light = six.shade([Light(TOWARD, IRRADIANCE)], ramp=book.ramp)
    light += six.lightmaps.mean(0)[..., None] * torch.tensor(SKY)
    return np.concatenate([light.numpy(), 1.0 - six.transparency[..., None].numpy()], 2)
