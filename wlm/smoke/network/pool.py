"""Samples on a device, and in files."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields

import numpy as np
import torch

from wlm.formats.artifact import Artifact, read_artifact, write_artifact
from wlm.formats.parts import Part, check_parts
from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, VISIBLE
from wlm.smoke.network.settings import DatasetSettings
from wlm.system import decode

_SYSTEM = "smoke-pool"

# `Pool` holds how their shapes fit each other.
_PARTS = {
    "guides": Part(np.float16, (None, 2, None, None, None)),
    "targets": Part(np.float16, (None, 2, len(PLANES), None, None)),
    "motion": Part(np.float16, (None, 2, None, None)),
    "sequence": Part(np.int64, (None,)),
}


@dataclass(frozen=True, eq=False)
class Pool:
    """N samples on one device, each of two successive frames, the earlier first; floats are half precision.

    Attributes:
        guides: [N, 2, C, H, W], encoded guiding maps of one of `GUIDES`.
        targets: [N, 2, 8, H, W], encoded lightmaps, `PLANES`.
        motion: [N, 2, H, W], pixels, x to the right and y down, by which the smoke that the later frame shows has moved
            since the earlier one.
        sequence: int [N], the sequence that a sample is of; sets are split by sequences, never by frames.
    """

    guides: torch.Tensor
    targets: torch.Tensor
    motion: torch.Tensor
    sequence: torch.Tensor

    def __post_init__(self) -> None:
        count, size = len(self.guides), tuple(self.guides.shape[-2:])
        channels = self.guides.shape[2] if self.guides.ndim == 5 else 0
        if channels not in map(len, GUIDES.values()):
            raise ValueError(f"guides: expected [N, 2, C, H, W] of one of GUIDES, got {list(self.guides.shape)}")
        shapes = {
            "guides": (count, 2, channels, *size),
            "targets": (count, 2, len(PLANES), *size),
            "motion": (count, 2, *size),
            "sequence": (count,),
        }
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name}: expected {list(shape)}, got {list(getattr(self, name).shape)}")

    def __len__(self) -> int:
        return len(self.guides)

    @property
    def device(self) -> torch.device:
        """Where the samples are."""
        return self.guides.device

    def covered(self) -> torch.Tensor:
        """[N], share of the image that shows smoke, the smaller of the two frames'."""
        return (self.targets[:, :, OPACITY_PLANE] > VISIBLE).float().mean((-2, -1)).amin(1)

    def take(self, which: torch.Tensor) -> Pool:
        """Some of the samples, by an index or a mask."""
        return Pool(*(getattr(self, field.name)[which] for field in fields(self)))

    def to(self, device: str | torch.device) -> Pool:
        """The same samples on another device."""
        return Pool(*(getattr(self, field.name).to(device) for field in fields(self)))


def save_pool(path: str | os.PathLike[str], pool: Pool, settings: DatasetSettings, source: str) -> int:
    """Writes a pool, whole or not at all.

    Args:
        path: The file.
        pool: The samples.
        settings: What they were made with.
        source: One word that identifies them, "seed-0-round-3" for example.

    Returns:
        The size of the file, bytes.

    Raises:
        WlmError: The file can't be written.
    """
    tensors = {field.name: getattr(pool, field.name).cpu().numpy() for field in fields(Pool)}
    return write_artifact(path, _SYSTEM, settings.model_dump(mode="json"), tensors, source)


def load_pool(path: str | os.PathLike[str], device: str = "cpu") -> Pool:
    """Reads a file of `save_pool`.

    Raises:
        WlmError: The file is missing, damaged or of another kind, or a part is of another type, or not finite.
    """

    def make(artifact: Artifact) -> Pool:
        parts = check_parts(artifact.tensors, _PARTS)
        # Copied: a mapped file is read-only, which a tensor can't be.
        return Pool(*(torch.from_numpy(np.array(parts[field.name])) for field in fields(Pool))).to(device)

    return decode(path, read_artifact(path, _SYSTEM), make)
