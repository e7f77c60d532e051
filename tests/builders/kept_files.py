"""A small file of each kind that wlm reads back: models, checkpoints, a pool of samples; each made once."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from builders import atlas_models, smoke_samples, synthetic
from builders.atlas_meshes import sheet
from builders.layered_sets import random_layers
from builders.light_groups import few_texels
from builders.probe_sets import synthetic as synthetic_probes
from builders.small_sets import moving_light, tiny_profile

import wlm
from wlm.fluid.lattice import Lattice
from wlm.fluid.obstacles import Sphere, Trajectory
from wlm.fluid.solver import Solver, Source
from wlm.formats.checkpoint import Checkpoint
from wlm.lightmap import trainer as lightmap_trainer
from wlm.lightmap.fit import SheetFit
from wlm.probe.gaussian import trainer as probe_trainer
from wlm.probe.model import box_of
from wlm.smoke.fit import train
from wlm.smoke.network.planes import Pool
from wlm.smoke.network.settings import NetworkSettings, Profile, TrainSettings


@dataclass(frozen=True)
class Kept:
    """A file, how it is read, and which missing, resized or out-of-range parts its reader accepts or refuses."""

    content: bytes
    read: Callable[[Path], Any]
    free: dict[str, str]
    ranges: dict[str, tuple[Any, float]]


def _written(write: Callable[[Path], Any]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "kept.wlm")
        write(path)
        return next(Path(folder).iterdir()).read_bytes()


def _lightmap() -> Kept:
    ranges = {"0.kind": (2, 7), "times": (3, 24.5), "0.constant": (0, -1.0), "0.affine": (0, -1.0)}
    return Kept(_written(synthetic.random_model(uvt_slices=1).save), wlm.load, {}, ranges)


def _frames() -> Kept:
    ranges = {"0.kind": (1, 7), "0.ranges": ((0, 0, 0), 3.0)}
    return Kept(_written(synthetic.random_model((4, 0), times=(0.0, 7.5)).save), wlm.load, {}, ranges)


def _layers() -> Kept:
    ranges = {"0.kind": (0, 7), "times": (3, 24.5), "2.constant": (0, -1.0), "1.ranges": ((0, 0, 0), 3.0)}
    return Kept(_written(random_layers(uvt_slices=1).save), wlm.load, {"0.mask": "missing size"}, ranges)


def _groups() -> Kept:
    ranges = {"0.kind": (0, 7), "1.times": (0, 24.5), "0.constant": (0, -1.0), "1.ranges": ((0, 0, 0), 3.0)}
    return Kept(_written(few_texels().save), wlm.load, {"0.mask": "missing size"}, ranges)


def _atlas(kind: str, colour: str) -> Kept:
    free = {"lut": "sizes" if kind == "cascade" else "", "mesh": "size"}
    free["uv"] = "size" if kind == "cascade" else "size missing"  # a plain model may keep the UVs of the mesh
    ranges = {"lut": (0, 65535)} if kind == "tiles" else {}
    ranges |= {"colour": (0, -1.0)} if colour == "half" else {}
    content = _written(lambda path: atlas_models.save_plainly(atlas_models.random_model(sheet(), kind, colour), path))
    return Kept(content, wlm.load, free, ranges)


def _smoke() -> Kept:
    return Kept(_written(smoke_samples.random_model(levels=2).save), wlm.load, {}, {})


def _samples() -> Any:
    random = torch.Generator().manual_seed(0)
    shapes = ((2, 2, 3, 16, 16), (2, 2, 8, 16, 16), (2, 2, 16, 16))
    return Pool(*(torch.rand(shape, generator=random).half() for shape in shapes), torch.arange(2))


def lightmap_fit() -> tuple[Any, Any]:
    """A fit of one dynamic tile, and a trainer of it after three steps."""
    fit = SheetFit(moving_light(40, 24).light, tiny_profile())
    (batch,) = fit.batches(0)
    trainer = lightmap_trainer.Trainer(fit.model.profile, fit.model.axis, fit.job(batch).targets(), 0, "cpu")
    trainer.run(3)
    return fit, trainer


def _opened(path: Path, system: str) -> Checkpoint:
    """The checkpoint in a file, whatever it is called."""
    return Checkpoint(str(path).removesuffix(".partial"), system, {}, "0f", resume=True)


def _lightmap_running() -> Kept:
    _, trainer = lightmap_fit()
    content = _written(lambda path: Checkpoint(path, "lightmap", {}, "0f").save({0: trainer.state()}))
    ranges = {"control": (0, 21), "adam_hidden.exp_avg_sq": (0, -1.0)}
    return Kept(
        content,
        lambda path: _opened(path, "lightmap").restore(0, trainer.load),
        {},
        {f"running.0.{name}": wrong for name, wrong in ranges.items()},
    )


def _lightmap_finished() -> Kept:
    fit, trainer = lightmap_fit()
    (batch,) = fit.batches(0)
    content = _written(lambda path: Checkpoint(path, "lightmap", {}, "0f").add_finished(0, trainer.quantised()))
    return Kept(content, lambda path: _opened(path, "lightmap").finished(0, fit.table(batch)), {}, {})


def _probe_running() -> Kept:
    probes = synthetic_probes(60)
    box = box_of(probes.position)
    profile = wlm.probe.Profile(name="small", ratio=0.1, latent=3, hidden=16, steps=60)
    x = ((probes.position - box["origin"]) / box["extent"]).astype(np.float32)
    trainer = probe_trainer.Trainer(x, probes.values, profile, 0, "cpu")
    trainer.run(52)
    content = _written(lambda path: Checkpoint(path, "probe", {}, "0f").save({0: trainer.state()}))
    ranges = {"control": (0, -1), "entered": ((), 2), "bounds": ((0, 0), 9.0)}
    return Kept(
        content,
        lambda path: _opened(path, "probe").restore(0, trainer.load),
        {},
        {f"running.0.{name}": wrong for name, wrong in ranges.items()},
    )


def _training() -> Kept:
    settings = TrainSettings(rounds=1, steps=4, batch=2, warmup=2, average=0.5)
    profile = Profile(name="tiny", network=NetworkSettings(width=8, levels=2), training=settings)
    made = dict.fromkeys(("make_pool", "make_validation"), lambda *a, **k: _samples())
    pools = functools.partial(mock.patch.multiple, "wlm.smoke.network.dataset", **made)

    def write(path: Path) -> None:
        # Out of time after the first two steps.
        with mock.patch("wlm.smoke.fit._CHUNK", 2), pools():
            train(profile, path, minutes=0.0)
        for other in (path, Path(f"{path}.csv")):
            other.unlink(missing_ok=True)

    def read(path: Path) -> Any:
        with mock.patch("wlm.smoke.fit._CHUNK", 2), pools():
            return train(profile, str(path).removesuffix(".partial"), resume=True, minutes=0.0)

    free = {"clock": "nan", "curve": "nan size"}
    ranges = {"step": ((), -1), "skipped": ((), 99.0), "counts": (0, -1), "adam.step.heads.0.bias": ((), -1.0)}
    return Kept(
        _written(write),
        read,
        {f"running.0.{name}": words for name, words in free.items()},
        {f"running.0.{name}": wrong for name, wrong in ranges.items()},
    )


def _simulation() -> Kept:
    ball = Sphere(Trajectory.of(np.array([[4.0, 4.0, 4.0]]), np.array([0.0])), 1.5)
    source = Source("box", (1, 1, 1), (1, 1, 1), 1.0)
    solver = Solver(Lattice((8, 8, 8), viscosity=0.1), refinement=2, obstacles=[ball], sources=[source])
    solver.step(2)

    def read(path: Path) -> Solver:
        solver.load(path)
        return solver

    ranges = {"lattice.steps": ((), -1), "density": ((0, 0, 0, 0), -1.0), "bricks": (0, 8)}
    return Kept(_written(solver.save), read, {}, ranges)


KEPT: dict[str, Callable[[], Kept]] = {
    name: functools.cache(make)
    for name, make in {
        "lightmap": _lightmap,
        "lightmap-frames": _frames,
        "lightmap-layers": _layers,
        "lightmap-groups": _groups,
        "atlas-tiles": lambda: _atlas("tiles", "half"),
        "atlas-cascade": lambda: _atlas("cascade", "half"),
        "atlas-bc6h": lambda: _atlas("plain with uv", "bc6h"),
        "smoke": _smoke,
        "lightmap-running": _lightmap_running,
        "lightmap-finished": _lightmap_finished,
        "probe-running": _probe_running,
        "training": _training,
        "simulation": _simulation,
    }.items()
}
"""The files by name; each is made when first asked for."""
