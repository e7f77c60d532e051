"""Settings of ray marches through smoke, with their defaults and ranges."""

from dataclasses import dataclass

LEAST_STEP = 0.01
"""Shortest step in voxels; shorter steps would take far too long."""


@dataclass(frozen=True)
class March:
    """Settings of a march; lengths are in voxels.

    Attributes:
        step: Longest step along a ray.
        spacing: Largest distance between nodes, the points at which optical depths to the lights are computed; None:
            `step`. Only used by marches that compute them at nodes.
        jitter: Range of the random shift of a pixel's samples, in steps: 0 (samples in the middles of steps) to 1.
        seed: Seed of the jitter, any integer.
        threshold: Extinction per voxel above which smoke has a surface; the depth is the distance to it.
        g: Mean cosine of the Henyey-Greenstein phase function, between -1 and 1.
        cutoff: Transparency below which a ray ends.

    Raises:
        ValueError: A setting is out of its range.
    """

    step: float = 10.0
    spacing: float | None = None
    jitter: float = 1.0
    seed: int = 0
    threshold: float = 0.01
    g: float = 0.0
    cutoff: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("step", "spacing"):
            value = getattr(self, name)
            if value is not None and not LEAST_STEP <= value < float("inf"):
                raise ValueError(f"{name}: expected a finite length of at least {LEAST_STEP} voxels, got {value}")
        if not 0 <= self.jitter <= 1:
            raise ValueError(f"jitter: expected a share of a step, 0 to 1, got {self.jitter}")
        if not -1 < self.g < 1:
            raise ValueError(f"g: expected a mean cosine above -1 and below 1, got {self.g}")
        for name in ("threshold", "cutoff"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected a number of at least 0, got {getattr(self, name)}")
