"""Pools of samples in files."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.smoke.learn.dataset import DatasetSettings
from wlm.smoke.planes import Pool

__all__ = ["load_pool", "save_pool"]

_SYSTEM = "smoke-pool"


def save_pool(path: str | os.PathLike[str], pool: Pool, settings: DatasetSettings, source: str) -> int:
    """Writes a pool as an artifact, whole or not at all.

    Args:
        path: The file.
        pool: What is written.
        settings: What it was made with.
        source: One word that says which it is, "seed-0-round-3" for example.

    Returns:
        The size of the file, bytes.

    Raises:
        WlmError: The file can't be written.
    """
    tensors = {field.name: getattr(pool, field.name).cpu().numpy() for field in fields(Pool)}
    return write_artifact(path, _SYSTEM, settings.model_dump(mode="json"), tensors, source)


def load_pool(path: str | os.PathLike[str], device: str = "cpu") -> Pool:
    """Reads what `save_pool` wrote.

    Raises:
        WlmError: The file is missing, damaged or of another kind.
    """
    artifact = read_artifact(Path(path), _SYSTEM)
    try:
        # A mapped file is read-only, which a tensor can't be.
        parts = [torch.from_numpy(np.array(artifact.tensors[field.name])).to(device) for field in fields(Pool)]
        return Pool(*parts)
    except (KeyError, ValueError) as error:
        raise WlmError(f"{path}: expected the tensors of a pool: {error}") from error
