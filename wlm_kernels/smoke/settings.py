"""How smoke is marched through: the settings of all marches, with their defaults and ranges here alone."""

from dataclasses import dataclass

_LEAST_STEP = 0.01  # voxels: a march in shorter steps would hardly end


@dataclass(frozen=True)
class March:
    """Settings of a march; lengths are in voxels.

    Attributes:
        step: h, the longest step along a ray.
        spacing: The largest distance between the nodes at which optical depths to the lights are known; None: as
            `step`. For the coarse march of six lights, as `light_step` is.
        light_step: The longest step between two nodes; None: as `spacing`.
        jitter: Share of a step by which the samples of a pixel are shifted, 0 (each in its step's middle) to 1.
        seed: Of the jitter, any whole number.
        threshold: tau, the extinction per voxel above which smoke has a surface, whose distance is the depth.
        g: Mean cosine of the Henyey-Greenstein phase function, within -1 and 1.
        cutoff: A ray ends where less than this is left of its transparency.

    Raises:
        ValueError: A setting is out of its range.
    """

    step: float = 10.0
    spacing: float | None = None
    light_step: float | None = None
    jitter: float = 1.0
    seed: int = 0
    threshold: float = 0.01
    g: float = 0.0
    cutoff: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("step", "spacing", "light_step"):
            value = getattr(self, name)
            if value is not None and not _LEAST_STEP <= value < float("inf"):
                raise ValueError(f"{name}: expected at least {_LEAST_STEP} voxels, got {value}")
        if not 0 <= self.jitter <= 1:
            raise ValueError(f"jitter: expected 0 to 1, got {self.jitter}")
        if not -1 < self.g < 1:
            raise ValueError(f"g: expected a number within -1 and 1, got {self.g}")
        for name in ("threshold", "cutoff"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
