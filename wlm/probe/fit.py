"""Compresses a checked probe set to a model."""

import hashlib
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from wlm.dispatch import Place, Task, run
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.geometry import Geometry
from wlm.formats.parts import Part
from wlm.probe.codec import pack
from wlm.probe.data import ProbeSet
from wlm.probe.gaussian.fitter import Fitter, Region
from wlm.probe.gaussian.model import gaussian_count
from wlm.probe.gaussian.pictures import Pixels, seen_pixels
from wlm.probe.model import CODES, ProbeModel, Profile, box_of
from wlm.probe.regions.model import Regions, box_row
from wlm.probe.regions.tree import Tree
from wlm.probe.selection import Candidates
from wlm.system import Meter, OnProgress

_MOST_LATENT, _MOST_HIDDEN = 32, 128  # of a fit of several hours
_AT_ONCE = {"cpu": 1, "cuda": 4}  # regions trained together: one alone leaves parts of a GPU idle
_BATCHES = 1_000_000  # numbers in the checkpoint for the regions of a fit; those below are of fits without regions
_FINISHED = {"packed": Part(np.uint8, (None,)), "box": Part(np.float64, (7,)), "count": Part(np.int32, (2,), least=0)}


def open_checkpoint(
    output: str | os.PathLike[str],
    probes: ProbeSet,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    geometry: Geometry | None = None,
    resume: bool = False,
    every: float = EVERY,
) -> Checkpoint:
    """Opens the checkpoint of a fit, the file `OUTPUT.partial`.

    Args:
        output: The model's file, which is written when the fit is finished.
        probes, profile, seed, geometry: The arguments of `compress`; the checkpoint is only valid for them.
        device: Only its kind matters: a fit can continue on another GPU.
        resume: Whether to continue from the file, if it exists.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged or of another fit; the message names the difference.
    """
    mesh = b"" if geometry is None else geometry.position.tobytes() + geometry.triangle.tobytes()
    fit = {
        "input": probes.source,
        "mesh": hashlib.blake2b(mesh, digest_size=8).hexdigest(),
        "profile": Profile.load(profile).model_dump(mode="json"),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, ProbeModel.SYSTEM, fit, probes.source, resume=resume, every=every)


def compress(
    probes: ProbeSet,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    workers: int | None = None,
    cluster: str | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    positions: bool = False,
    geometry: Geometry | None = None,
    **overrides: Any,
) -> ProbeModel:
    """Compresses a probe set.

    A profile of the method "auto", as all shipped Gaussian profiles are, yields Gaussians unless principal components
    have less error in no more GPU memory, which is the case for a few hundred probes; `ProbeModel.choice` says why.
    With `target` the result is the smallest model found that reaches it, after up to seven fits; with `max_bytes` the
    one with the least error within them.
    More live probes than the setting `region` are fitted in regions, a few at once, by Gaussians unless the profile
    asks for principal components. Dead probes take no part in the fit: the model stores one bit per probe if any
    probe is dead.

    Several hours are fitted as one, with probes that have the numbers of all hours; those of each hour are divided by
    their root mean square.

    Args:
        probes: The set.
        profile: The settings: a name, a YAML file, or a `Profile`.
        seed: Seed of the fit; the same seed gives the same result on one kind of device.
        device: "cpu", "cuda" or "cuda:N".
        workers, cluster: Where regions are fitted side by side, with the same result: see
            `wlm.dispatch.Place`. A cluster also fits a set of one region.
        progress: Called about twice a second, with the live probes' relative error, "error", or with the PSNR over all
            numbers of all probes if the profile asks for the absolute error.
        checkpoint: From `open_checkpoint` for the same settings, or None. A running fit is saved there, and an
            interrupted one is resumed from there.
        positions: Whether the model stores the probes' positions, 16 bits per axis; not needed if the engine has them.
        geometry: A mesh that the probes light, for the method "gaussians": the fit also minimises the error of pictures
            of it and of balls at the probes. None: only that of the probes.
        overrides: Settings that replace the profile's, such as `steps=500`.

    Returns:
        The model; its `warnings` say whether many probes are off, and which most.

    Raises:
        WlmError: The profile, a setting or the device does not exist, there are too many numbers per probe, the
            checkpoint is of another fit, the mesh cannot be seen or used, or the fit diverged.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    profile = Profile.load(profile).override(overrides)
    place = Place(device, workers, cluster)
    here = place.here
    if geometry is not None and profile.method != "gaussians":
        raise WlmError(f"mesh: expected the method gaussians, which alone is fitted to pictures, got {profile.method}")
    if not probes.live.any():
        raise WlmError(f"{probes.name}: every probe is dark: there is nothing to fit")
    hours = max(len(probes.times), 1)
    values, scales = probes.values, np.ones(hours)
    if hours > 1:
        by_hour = np.split(values, hours, axis=1)
        scales = np.sqrt([np.einsum("nd,nd->", light, light, dtype=np.float64) for light in by_hour])
        scales /= scales.max()
        even = [light / np.float32(scale or 1.0) for light, scale in zip(by_hour, scales, strict=True)]
        values = np.concatenate(even, 1)
        latent = min(_MOST_LATENT, round(profile.latent * (1.0 + 0.5 * math.log2(hours))))
        hidden = min(_MOST_HIDDEN, 8 * round(profile.hidden * (1.0 + 0.25 * math.log2(hours)) / 8))
        profile = profile.model_copy(update={"latent": latent, "hidden": hidden})
    box = box_of(probes.position)
    stored = np.zeros((0, 3), np.uint16)
    if positions:
        size = box["extent"] * np.where(box["size"] > 0, box["size"], 1.0)
        stored = np.clip(np.rint((probes.position - box["origin"]) / size * CODES), 0, CODES).astype(np.uint16)

    make = partial(
        ProbeModel,
        name=probes.name,
        source=probes.source,
        probes=probes.probes,
        outputs=probes.outputs,
        dead=np.zeros(0, bool) if probes.live.all() else ~probes.live,
        positions=stored,
        times=probes.times,
        scales=scales,
        **box,
    )
    even = replace(probes, values=values)
    tree = Tree.split(probes.position[probes.live], profile.region)
    # Magnitudes follow each probe at each hour by themselves, and half floats would round a scale's logarithm.
    of_fit = (partial(make, scales=np.ones(hours)), probes) if profile.error == "relative" else (make, even)
    pixels = None if geometry is None else seen_pixels(of_fit[1], geometry, here)
    shared = {"seed": seed, "place": place, "progress": progress, "checkpoint": checkpoint}
    trained = partial(_fit_regions, *of_fit, tree=tree, pixels=pixels, **shared)
    candidates = Candidates(make, probes, values[probes.live], profile, here, trained, checkpoint, tree.count)
    return candidates.selected() if profile.target or profile.max_bytes else candidates.usual()


def _fit_regions(
    make: Callable[..., ProbeModel],
    probes: ProbeSet,
    profile: Profile,
    *,
    tree: Tree,
    checkpoint: Checkpoint | None,
    progress: OnProgress | None,
    pixels: Pixels | None,
    seed: int,
    place: Place,
    number: int = 0,
) -> ProbeModel:
    """Fits the Gaussians of each region, or of the set if it is one region. `number` is that of the fit in the
    checkpoint."""
    hours, live = max(len(probes.times), 1), probes.live
    profile = profile.model_copy(update={"method": "gaussians"})
    meter = Meter(progress, "fit", profile.steps * tree.count)

    fit = partial(run, (Fitter, seed), meter=meter, place=place, checkpoint=checkpoint)
    if tree.count == 1:
        task = Task((number,), profile.steps, lambda: [Region(make, probes, profile, pixels)])
        ((_, (model,)),) = fit([task])
        return model
    position = probes.position[live]
    owner = tree.regions_of(position)
    # All regions together have as many Gaussians as one fit would have.
    share = np.cumsum(np.bincount(owner)) / len(owner) * gaussian_count(profile.ratio, len(owner))
    wanted = np.maximum(np.diff(np.rint(share), prepend=0.0), 1.0)
    results: dict[int, Mapping[str, np.ndarray]] = {}
    batches = (number + 1) * _BATCHES
    at_once = _AT_ONCE["cpu" if place.device == "cpu" or pixels is not None else "cuda"]

    def region(index: int) -> Region:
        own = position[owner == index]
        # The spacing of as many probes in a cube; on surfaces it is several times that of the probes.
        margin = np.ptp(own, axis=0).max() / np.cbrt(len(own))
        near = np.arange(len(position))
        for column, low, high in zip(position.T, own.min(0) - margin, own.max(0) + margin, strict=True):
            near = near[(column[near] >= low) & (column[near] <= high)]
        chosen = np.flatnonzero(live)[near]
        part = {"position": probes.position[chosen], "live": np.ones(len(chosen), bool), "normal": None}
        near_set = replace(probes, values=probes.values[chosen], **part)
        sized = profile.model_copy(update={"ratio": min(wanted[index] / len(chosen), 1.0)})
        bare = {"probes": len(chosen), "dead": np.zeros(0, bool), "positions": np.zeros((0, 3), np.uint16)}
        of_region = partial(make, **bare, **box_of(near_set.position))
        return Region(of_region, near_set, sized, None if pixels is None else pixels.of(near))

    tasks = []
    for first in range(0, tree.count, at_once):
        group: list[int] = []
        for index in range(first, min(first + at_once, tree.count)):
            if kept := checkpoint and checkpoint.finished(batches + index, _FINISHED):
                results[index] = kept
            else:
                group.append(index)
        if group:
            numbers, job = (
                tuple(batches + index for index in group),
                partial(lambda each: list(map(region, each)), group),
            )
            tasks.append(Task(numbers, profile.steps * len(group), job, "Gaussians"))
    for task, models in fit(tasks, done=profile.steps * len(results)):
        for batch, model in zip(task.numbers, models, strict=True):
            count = np.array([model.content.settings()[name] for name in ("count", "dropped")], np.int32)
            result = {"packed": np.frombuffer(pack(model), np.uint8), "box": box_row(model), "count": count}
            results[batch - batches] = result
            if checkpoint is not None:
                checkpoint.add_finished(batch, result)
    ordered = [results[region] for region in range(tree.count)]
    boxes, counts = (np.stack([result[name] for result in ordered]) for name in ("box", "count"))
    packed = [result["packed"].tobytes() for result in ordered]
    content = Regions(tree, boxes, counts, profile, probes.outputs, hours, packed, probes.name)
    choice = f"Gaussians, in {tree.count} regions of at most {profile.region:,} live probes"
    return make(profile=profile, content=content, choice=choice)
