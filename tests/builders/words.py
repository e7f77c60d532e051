"""Checks of files whose tiles are words, R10G10B10A2: video and levels."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from builders.checks import assert_same, error_of

import wlm
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.lightmap.evaluation import part_bytes
from wlm.lightmap.model import LightmapModel


def check_written(model: LightmapModel, path: Path) -> None:
    """Writes a model: what is read again is the same, and each byte is one of a part's."""
    size = model.save(path)
    found = wlm.load(path)
    assert_same(found, model)
    np.testing.assert_array_equal(found.words, model.words)
    assert sum(part_bytes(model, size).values()) == size
    assert (found.words >> 30 == 3).all()


def error_of_changed(model: LightmapModel, folder: Path, **tensors: Callable[[np.ndarray], np.ndarray]) -> str:
    """The line with which a file is refused of which some parts were changed."""
    model.save(folder / "a.wlm")
    artifact = read_artifact(folder / "a.wlm")
    parts = artifact.tensors | {name: value(artifact.tensors[name].copy()) for name, value in tensors.items()}
    write_artifact(folder / "b.wlm", "lightmap", artifact.settings, parts, artifact.source)
    return error_of(wlm.load, folder / "b.wlm")
