"""The four systems as the contract's tests take them: a file each, what it decodes to, and a fit of a moment."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from builders import atlas_meshes, probe_sets, small_sets

import wlm
from wlm.export import export

FILES = Path(__file__).resolve().parents[1] / "files"


@dataclass(frozen=True)
class Subject:
    """One system.

    Attributes:
        name: Of its package.
        file: Written before the systems had a contract.
        decode: Turns a loaded model into arrays, by the names of `stored`.
        stored: What the file decoded to when it was written; None: nothing is kept of it.
        data: Makes a small input.
        compress: Fits it within seconds; takes the keywords of `compress`.
        evaluate: Scores a model of that data within a second.
        export: Exports a model into a folder.
        open_checkpoint: Opens a checkpoint of that fit: (data, output, resume) and `every`; None: nothing is fitted.
    """

    name: str
    file: Path
    decode: Callable[[Any], dict[str, np.ndarray]]
    stored: Path
    data: Callable[[], Any] | None = None
    compress: Callable[..., Any] | None = None
    evaluate: Callable[[Any, Any], Any] | None = None
    export: Callable[[Any, Any, Path], list[Path]] | None = None
    open_checkpoint: Callable[..., Any] | None = None


def _lightmap() -> Subject:
    profile = small_sets.tiny_profile(steps=40)

    def checkpoint(data: Any, output: Path, resume: bool, **options: Any) -> Any:
        from wlm.lightmap.fit import open_checkpoint

        return open_checkpoint(output, data, profile, resume=resume, **options)

    return Subject(
        "lightmap",
        FILES / "lightmap.wlm",
        lambda model: {"frame": model.decoder().frame(18.5)[::8, ::8]},
        FILES / "lightmap.npz",
        small_sets.moving_light,
        lambda data, **options: wlm.lightmap.compress(data, profile, **options),
        lambda model, data: wlm.lightmap.evaluate(model, data, metrics=("psnr", "seen")),
        lambda model, data, folder: wlm.export.export(model, folder),
        checkpoint,
    )


def _layers() -> Subject:
    def decode(model: Any) -> dict[str, np.ndarray]:
        return {
            f"{atlas}_{layer}": values[:24:2, :24:2]
            for atlas, layers in model.decoder().frames(18.5).items()
            for layer, values in layers.items()
        }

    return Subject("lightmap", FILES / "lightmap-layers.wlm", decode, FILES / "lightmap-layers.npz")


def _probe() -> Subject:
    profile = wlm.probe.Profile(name="tiny", method="gaussians", ratio=0.1, steps=60, hidden=16, latent=3)

    def checkpoint(data: Any, output: Path, resume: bool, **options: Any) -> Any:
        from wlm.probe.fit import open_checkpoint

        return open_checkpoint(output, data, profile, resume=resume, **options)

    return Subject(
        "probe",
        FILES / "probe.wlm",
        lambda model: {"values": model.decoder().decode_probes()},
        FILES / "probe.npz",
        lambda: probe_sets.synthetic(300, dead=5),
        lambda data, **options: wlm.probe.compress(data, profile, **options),
        lambda model, data: wlm.probe.evaluate(model, data),
        lambda model, data, folder: wlm.export.export(model, folder),
        checkpoint,
    )


def _probe_pca() -> Subject:
    return Subject(
        "probe",
        FILES / "probe-pca.wlm",
        lambda model: {"values": model.decoder().decode_probes()},
        FILES / "probe-pca.npz",
        lambda: probe_sets.synthetic(300, dead=5),
        lambda data, **options: wlm.probe.compress(data, "pca", positions=True, **options),
        lambda model, data: wlm.probe.evaluate(model, data),
        lambda model, data, folder: wlm.export.export(model, folder),
    )


def _atlas(kind: str) -> Subject:
    settings = {"method": "cascade", "steps": 40, "resolution": 32, "fallback": False} if kind == "cascade" else {}
    profile = wlm.atlas.Profile(name="tiny", views=4, **settings)

    def checkpoint(data: Any, output: Path, resume: bool, **options: Any) -> Any:
        from wlm.atlas.fit import open_checkpoint

        return open_checkpoint(output, data, profile, resume=resume, **options)

    def decode(model: Any) -> dict[str, np.ndarray]:
        with np.load(FILES / f"atlas-{kind}.npz") as stored:
            uv = stored["uv"]
        return {"uv": uv, "light": model.decoder().read(torch.from_numpy(uv)).numpy()}

    return Subject(
        "atlas",
        FILES / f"atlas-{kind}.wlm",
        decode,
        FILES / f"atlas-{kind}.npz",
        atlas_meshes.sheet,
        lambda data, **options: wlm.atlas.compress(data, profile, **options),
        lambda model, data: wlm.atlas.evaluate(model, data, views=2, resolution=32),
        lambda model, data, folder: export(model, folder),
        checkpoint,
    )


def _smoke() -> Subject:
    def decode(model: Any) -> dict[str, np.ndarray]:
        with np.load(FILES / "smoke.npz") as stored:
            guide = stored["guide"]
        decoder = model.decoder(height=guide.shape[1], width=guide.shape[2])
        return {"guide": guide, "planes": decoder(torch.from_numpy(guide)).numpy()}

    return Subject("smoke", FILES / "smoke.wlm", decode, FILES / "smoke.npz")


SUBJECTS: dict[str, Callable[[], Subject]] = {
    "lightmap": _lightmap,
    "lightmap-layers": _layers,
    "probe": _probe,
    "probe-pca": _probe_pca,
    **{f"atlas-{kind}": lambda kind=kind: _atlas(kind) for kind in ("tiles", "cascade", "bc6h", "plain")},
    "smoke": _smoke,
}
"""By name; made when asked for, since importing a system takes time."""
