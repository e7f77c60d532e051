"""Scores of shaded pictures: each way to come by light of all orders, under random lights, against path tracing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.metrics.flip import flip_display
from wlm.smoke.planes import to_srgb
from wlm.smoke.transport.features import COARSE
from wlm.smoke.transport.filtering import OrdersModel
from wlm.smoke.transport.learning import Lesson, make_lessons, psnr
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.samples import ALBEDOS, Sample

OCTAVES = (0.5, 0.25)
"""Light and extinction towards lights of the second and third octave over the first's (Wrenninge et al. 2013)."""


@dataclass(frozen=True)
class PictureScores:
    """Of one method over all pictures.

    Attributes:
        psnr: dB in sRGB with a peak of 1, of each picture.
        flip: Mean FLIP of each picture.
    """

    psnr: tuple[float, ...]
    flip: tuple[float, ...]


def best_gain(lessons: Sequence[Lesson], albedo: float) -> float:
    """The factor on light scattered once that is nearest to all light, by least squares."""
    node = ALBEDOS.index(albedo)
    both = sum(float((lesson.inputs.single * lesson.light[node]).sum()) for lesson in lessons)
    return both / max(sum(float(lesson.inputs.single.square().sum()) for lesson in lessons), 1e-30)


def compare(
    samples: Sequence[Sample], model: OrdersModel, gains: Mapping[float, float], *, lights: int = 3, seed: int = 0
) -> dict[str, PictureScores]:
    """Scores pictures of each sample at each albedo of `gains`, under some of its lights in colours drawn at random.

    Args:
        samples: Unseen ones, with little noise.
        model: Of the filter and the network.
        gains: Of `best_gain`, by albedo, one of `ALBEDOS`.
        lights: In each picture, at most as many as a sample has.
        seed: Of the colours.

    Returns:
        By method: "single", "gain", "octaves", "filter", "network".
    """
    random = np.random.default_rng(seed)
    found: dict[str, list[tuple[float, float]]] = {}
    for sample in samples:
        lessons = make_lessons(sample)
        octaves = [light_smoke(sample.volume, sample.camera, sample.lights, COARSE, shadow=s).planes for s in OCTAVES]
        for albedo, gain in gains.items():
            node = ALBEDOS.index(albedo)
            colours = torch.tensor(random.dirichlet(np.ones(3), lights) * 3.0 / lights).to(sample.light)

            def shaded(planes: list[torch.Tensor], colours: torch.Tensor = colours) -> torch.Tensor:
                return torch.einsum("lhw,lc->hwc", torch.stack(planes[: len(colours)]), colours)

            single = [albedo * lesson.inputs.single for lesson in lessons]
            more = [sum(s * octave[n] for s, octave in zip(OCTAVES, octaves, strict=True)) for n in range(len(lessons))]
            methods = {
                "single": single,
                "gain": [gain * lesson.inputs.single for lesson in lessons],
                "octaves": [one + albedo * rest for one, rest in zip(single, more, strict=True)],
            }
            for name, network in (("filter", False), ("network", True)):
                methods[name] = [
                    model.light(lesson.inputs, (albedo,) * 3, network=network)[..., 0] for lesson in lessons
                ]
            reference = shaded([lesson.light[node] for lesson in lessons])
            seen = to_srgb(reference).clamp(max=1.0).cpu().numpy()
            for name, planes in methods.items():
                picture = shaded(planes)
                error = flip_display(seen, to_srgb(picture).clamp(max=1.0).cpu().numpy())
                found.setdefault(name, []).append((psnr(picture, reference), float(error.mean())))
    return {name: PictureScores(*zip(*values, strict=True)) for name, values in found.items()}
