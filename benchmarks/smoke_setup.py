"""What the parts of the smoke benchmark share: sizes, and the bandwidth of a copy."""

import math
from dataclasses import dataclass

from benchmarks.runner import Bench, Note


@dataclass(frozen=True)
class Sizes:
    """Grids, steps and repeats."""

    lattice: int  # cells along an edge of the large lattice
    small: int  # and of the small one
    chunk: int  # steps of a lattice that are timed as one
    compared: tuple[int, ...]  # steps after which velocities of 16 and 32 bits are compared
    drift: int  # steps after which the drift of the mass is measured
    fills: tuple[float, ...]  # shares of the domain in which there is smoke
    coarse: int  # cells of velocity along an edge, each four voxels of smoke along its edge
    cloud: int  # voxels along an edge of the cloud
    resolution: int  # pixels along an edge of its image
    exact: float  # step in voxels of the march that guiding maps are compared with
    guide_shared: tuple[float, ...]  # steps of guiding maps whose pixels share marches to the lights
    guide_alone: tuple[float, ...]  # and of those with one for each pixel
    six: tuple[float, ...]  # steps of the six-way march; the shortest is last
    plume: int  # pixels along an edge of the image of the plume
    scale: float  # of the scene's cells
    frames: int  # of the scene before the one that is timed
    warmup: int  # calls before the first that is timed
    repeats: int  # samples of a time
    few: int  # samples of a time that is long
    every: bool  # include slow-to-compile cases of minor interest


FULL = Sizes(
    lattice=256,
    small=100,
    chunk=48,
    compared=(500, 1000),
    drift=5000,
    fills=(0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0),
    coarse=100,
    cloud=400,
    resolution=512,
    exact=0.5,
    guide_shared=(2, 3, 5, 10, 15, 20),
    guide_alone=(1, 2, 3, 5, 10, 15, 20),
    six=(20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0, 0.5, 0.25),
    plume=64,
    scale=1.0,
    frames=40,
    warmup=3,
    repeats=12,
    few=3,
    every=True,
)
"""The paper's grids: for a GPU."""

QUICK = Sizes(
    lattice=48,
    small=24,
    chunk=8,
    compared=(100, 200),
    drift=300,
    fills=(0.0, 0.25, 1.0),
    coarse=12,
    cloud=48,
    resolution=48,
    exact=0.5,
    guide_shared=(2, 3, 5, 10, 15, 20),
    guide_alone=(2, 5, 10, 20),
    six=(1.0, 0.5, 0.25),
    plume=24,
    scale=0.12,
    frames=12,
    warmup=1,
    repeats=5,
    few=1,
    every=False,
)
"""For a CPU."""


class SmokeBench(Bench):
    """A device and sizes.

    Attributes:
        bandwidth: Bytes a second that a copy reads and writes; NaN until it is measured.
    """

    def __init__(self, device: str, sizes: Sizes, progress: Note | None = None) -> None:
        timing = {"warmup": sizes.warmup, "repeats": sizes.repeats, "few": sizes.few}
        super().__init__("smoke", device, progress, clock="time_ms", **timing)
        self.sizes, self.bandwidth = sizes, math.nan

    def of_copy(self, bytes_moved: float, ms: float) -> float:
        """The share of a copy's bandwidth that so many bytes in so many milliseconds are."""
        return bytes_moved / (1e-3 * ms) / self.bandwidth
