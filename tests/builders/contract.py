"""The four systems as the contract's tests take them: a stored file, what it decodes to, and a fit of a few seconds."""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
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
    """A system under the tests of the contract."""

    name: str
    kind: str
    decode: Callable[[Any], dict[str, np.ndarray]]
    data: Callable[[], Any] | None = None
    profile: Any = None
    scores: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The stored file."""
        return FILES / f"{self.kind}.wlm"

    @property
    def stored(self) -> Path:
        """The path of the arrays that the file decoded to when it was written."""
        return FILES / f"{self.kind}.npz"

    def compress(self, data: Any, **options: Any) -> Any:
        """Fits a model within seconds."""
        return getattr(wlm, self.name).compress(data, self.profile, **self.options, **options)

    def evaluate(self, model: Any, data: Any) -> Any:
        """Scores a model of that data."""
        return getattr(wlm, self.name).evaluate(model, data, **self.scores)

    def export(self, model: Any, folder: Path) -> list[Path]:
        """Exports a model into a folder."""
        return export(model, folder)

    def open_checkpoint(self, data: Any, output: Path, resume: bool, **options: Any) -> Any:
        """Opens a checkpoint of that fit."""
        fit = import_module(f"wlm.{self.name}.fit")
        return fit.open_checkpoint(output, data, self.profile, resume=resume, **options)


def _groups(model: Any) -> dict[str, np.ndarray]:
    decoder = model.decoder()
    decoder.set_weights({"lamp": (0.5, 2.0, 0.0)})
    return {"frame": decoder.frame(18.5)[6:10, 98:142]}


def _layers(model: Any) -> dict[str, np.ndarray]:
    atlases = model.decoder().frames(18.5).items()
    return {f"{atlas}_{name}": light[:24:2, :24:2] for atlas, layers in atlases for name, light in layers.items()}


def _probes(model: Any) -> dict[str, np.ndarray]:
    return {"values": model.decoder().decode_probes()}


def _smoke(model: Any) -> dict[str, np.ndarray]:
    with np.load(FILES / "smoke.npz") as stored:
        guide = stored["guide"]
    decoder = model.decoder(height=guide.shape[1], width=guide.shape[2])
    return {"guide": guide, "planes": decoder(torch.from_numpy(guide)).numpy()}


def _atlas(kind: str) -> Subject:
    cascade = {"method": "cascade", "steps": 40, "resolution": 32, "fallback": False}

    def decode(model: Any) -> dict[str, np.ndarray]:
        with np.load(FILES / f"atlas-{kind}.npz") as stored:
            uv = stored["uv"]
        return {"uv": uv, "light": model.decoder().read(torch.from_numpy(uv)).numpy()}

    profile = wlm.atlas.Profile(name="tiny", views=2, **(cascade if kind == "cascade" else {"tile": 4}))
    return Subject("atlas", f"atlas-{kind}", decode, atlas_meshes.sheet, profile, {"views": 2, "resolution": 32})


def _room() -> Any:
    return probe_sets.synthetic(300, dead=5)


_GAUSSIANS = {"name": "tiny", "method": "gaussians", "ratio": 0.1, "steps": 60, "hidden": 16, "latent": 3}

SUBJECTS: dict[str, Callable[[], Subject]] = {
    "lightmap": lambda: Subject(
        "lightmap",
        "lightmap",
        lambda model: {"frame": model.decoder().frame(18.5)[::8, ::8]},
        small_sets.moving_light,
        small_sets.tiny_profile(steps=40),
        {"metrics": ("psnr", "seen")},
    ),
    "lightmap-layers": lambda: Subject("lightmap", "lightmap-layers", _layers),
    "lightmap-groups": lambda: Subject("lightmap", "lightmap-groups", _groups),
    "probe": lambda: Subject("probe", "probe", _probes, _room, wlm.probe.Profile(**_GAUSSIANS)),
    "probe-pca": lambda: Subject("probe", "probe-pca", _probes, _room, "pca", options={"positions": True}),
    **{f"atlas-{kind}": lambda kind=kind: _atlas(kind) for kind in ("tiles", "cascade", "bc6h", "plain")},
    "smoke": lambda: Subject("smoke", "smoke", _smoke),
}
"""The subjects by name; each is made when asked for, since importing a system takes time."""
