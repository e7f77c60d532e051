"""Flip books of random light, and the pictures that an engine must show of them."""

import dataclasses

import numpy as np
import torch

from wlm.smoke.camera import Camera
from wlm.smoke.flipbook.book import Book, Shot, pack_book
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


def random_book(frames: list[SixWay], *, ramp: Ramp | None = FIRE, padding: int = 2) -> Book:
    """Packs frames into a flip book of 10 frames a second."""
    book = pack_book([Shot(i, six) for i, six in enumerate(frames, 1)], padding=padding, gain=1.0, rate=10.0)
    return dataclasses.replace(book, ramp=ramp if book.hot else None)


def shown(frames: list[SixWay], book: Book, time: float) -> np.ndarray:
    """Returns a billboard at a time in frames under the light and the sky: light and opacity, [H, W, 4]."""
    first = min(int(time), len(frames) - 1)
    one, other = frames[first], frames[min(first + 1, len(frames) - 1)]
    share = time - first
    glow = None if one.emission is None else torch.lerp(one.emission, other.emission, share)
    maps = torch.lerp(one.lightmaps, other.lightmaps, share)
    six = SixWay(maps, torch.lerp(one.transparency, other.transparency, share), glow, one.camera)
    # Mixed in light, as textures are, and coloured then.
    light = six.shade([Light(TOWARD, IRRADIANCE)], ramp=book.ramp)
    light += six.lightmaps.mean(0)[..., None] * torch.tensor(SKY)
    return np.concatenate([light.numpy(), 1.0 - six.transparency[..., None].numpy()], 2)
