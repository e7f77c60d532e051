"""Container of the samples of a training round, a validation set or a test set."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, VISIBLE


@dataclass(frozen=True, eq=False)
class Pool:
    """N samples on one device, each with two successive frames, the earlier first; all floats are half floats.

    Attributes:
        guides: [N, 2, C, H, W], encoded guiding maps with the C planes of their kind in `GUIDES`.
        targets: [N, 2, 8, H, W], encoded reference lightmaps, in the order of `PLANES`.
        motion: [N, 2, H, W], pixels to the right and down by which the smoke in the later frame has moved since the
            earlier frame.
        sequence: int [N], number of the simulated sequence that each sample is from; sets share no sequence.
    """

    guides: torch.Tensor
    targets: torch.Tensor
    motion: torch.Tensor
    sequence: torch.Tensor

    def __post_init__(self) -> None:
        count, size = len(self.guides), tuple(self.guides.shape[-2:])
        channels = self.guides.shape[2] if self.guides.ndim == 5 else 0
        if channels not in map(len, GUIDES.values()):
            raise ValueError(
                f"guides: expected shape [N, 2, C, H, W] with C planes of a kind in GUIDES, got {[*self.guides.shape]}"
            )
        shapes = {
            "guides": (count, 2, channels, *size),
            "targets": (count, 2, len(PLANES), *size),
            "motion": (count, 2, *size),
            "sequence": (count,),
        }
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name}: expected shape {list(shape)}, got {list(getattr(self, name).shape)}")

    def __len__(self) -> int:
        return len(self.guides)

    @property
    def device(self) -> torch.device:
        """Device of the samples."""
        return self.guides.device

    def covered(self) -> torch.Tensor:
        """Returns the share of pixels that show smoke, 0 to 1, [N]: of a sample's two frames the smaller share."""
        return (self.targets[:, :, OPACITY_PLANE] > VISIBLE).float().mean((-2, -1)).amin(1)

    def take(self, which: torch.Tensor) -> Pool:
        """Returns the samples that an index tensor or a mask [N] selects."""
        return Pool(*(getattr(self, field.name)[which] for field in fields(self)))

    def to(self, device: str | torch.device) -> Pool:
        """Returns the same samples on another device."""
        return Pool(*(getattr(self, field.name).to(device) for field in fields(self)))
