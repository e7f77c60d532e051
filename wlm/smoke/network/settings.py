"""Settings of the network, of its training samples and of the optimisation, and the units of random scenes."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.smoke.network.planes import GUIDES
from wlm.system import Checked, Settings
from wlm_kernels.smoke.settings import LEAST_STEP, March

EDGE, SPEED, LATTICE_SPEED = 1.0, 1.0, 0.1
"""Edge of the box in metres; speed of the fastest air in metres per second, and the same speed in cells per air
step."""

PERIOD = 2
"""Solver steps in one CUDA graph: after two steps the solver's buffers have swapped back."""

GuideKind = Literal["paper", "six"]
"""Keys of `planes.GUIDES`."""

_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Positive = Annotated[float, Field(gt=0.0)]
_Range = tuple[_Positive, _Positive]


class NetworkSettings(Checked):
    """Settings of the network's layers and of its input."""

    width: int = Field(16, ge=8, le=64, multiple_of=8)
    """Channels of the U-Net's first level. Each further level has twice the channels at half the resolution."""
    levels: int = Field(5, ge=2, le=6)
    """Levels of the U-Net, the lowest included."""
    adapters: bool = True
    """Whether each of the four groups of planes has its own NAFBlock; otherwise all planes share one."""
    guide: GuideKind = "paper"
    """Kind of the guiding map that the network reads: `paper` or `six`, see `planes.GUIDES`."""
    stem: Literal[1, 2] = 1
    """Edge in pixels of the squares that the first convolution takes as one pixel: 1 as in the paper, or 2, for a
    network at half the resolution with a quarter of the work."""

    @property
    def channels(self) -> int:
        """Number of planes of the guiding map that the network reads."""
        return len(GUIDES[self.guide])

    @property
    def multiple(self) -> int:
        """Images are padded with zeros to a height and width that are multiples of this number of pixels."""
        return self.stem * 2 ** (self.levels - 1)


class DatasetSettings(Checked):
    """Settings of the samples. Lengths are shares of the box's edge; times are multiples of the box's crossing time."""

    cells: int = Field(50, ge=16, le=512)
    """Velocity cells along each edge of the box."""
    least_cells: int | None = Field(None, ge=16, le=512)
    """Fewest velocity cells along an edge in training. Each sequence draws its number log-uniformly between this and
    `cells`: coarse grids give smooth smoke, in which guiding maps have less noise. None: always `cells`."""
    refine: int = Field(4, ge=1, le=16)
    """Density voxels along the edge of a cell."""
    substeps: int = Field(4, ge=2, le=16, multiple_of=2)
    """Number of air steps per smoke step; even, since a CUDA graph of the solver needs an even number."""
    resolution: int = Field(256, ge=8, le=4096)
    """Pixels along an image's edges."""
    frames: int = Field(8, ge=1, le=1000)
    """Number of pairs of frames taken from a sequence."""
    views: int = Field(9, ge=1, le=360)
    """Number of fixed views in validation, spread evenly over `arc` degrees; the paper has 9 views over 90 degrees."""
    arc: float = Field(90.0, gt=0.0, le=360.0)
    """Angle over which the fixed views are spread, degrees."""
    views_a_frame: int = Field(3, ge=1, le=64)
    """Number of random views of each pair of frames in training."""
    elevation: float = Field(20.0, ge=0.0, le=89.0)
    """Largest angle of a random view above or below the horizontal, degrees."""
    zoom: _Range = (0.65, 1.2)
    """Smallest and largest edge of the region that a random view shows, in edges of the box."""
    guide: GuideKind = "paper"
    """Kind of the guiding maps: `paper` or `six`, see `planes.GUIDES`."""
    guide_step: _Positive = 1.0 / 40.0
    """Step along the rays of a guiding map, in edges of the box; the paper's is 10 of 400 voxels."""
    guide_spacing: _Positive | None = None
    """Distance between nodes of the lattice that stores optical depths to the lights, for guide `six`; None:
    `guide_step`."""
    jitter: _Share = 1.0
    """Range of the random shift of a ray's samples, as a share of the step."""
    surface: float = Field(4.0, ge=0.0)
    """Density at which smoke counts as a surface, given as the optical depth of this density across the box."""
    reference_step: _Positive = 1.0
    """Step of the march that renders the target lightmaps, in voxels."""
    extinction: _Positive = 25.0
    """Optical depth of density 1 across the box."""
    density_scales: _Range = (0.5, 2.0)
    """Smallest and largest random factor by which the extinction is multiplied."""
    sequences: int = Field(14, ge=1, le=10000)
    """Number of simulated sequences per round."""
    hot: _Share = 0.25
    """Share of sequences whose smoke emits light."""
    moving: _Share = 0.1
    """Share of the sequences with obstacles in which one obstacle moves; these are simulated more slowly."""
    warmup: float = Field(1.3, ge=0.0, le=100.0)
    """Mean simulated time before the first pair of frames of a sequence."""
    interval: _Positive = 0.01
    """Time between the two frames of a pair, rounded to an even number of smoke steps."""
    apart: float = Field(0.12, ge=0.0, le=100.0)
    """Time between two pairs of frames of a sequence."""
    least_coverage: _Share = 0.02
    """Share of the image that must show smoke; a frame with less counts as almost empty."""
    kept_empty: _Share = 0.05
    """Share of the almost empty frames that are kept as samples."""
    validation_sequences: int = Field(4, ge=1, le=1000)
    """Number of sequences of the validation set, which selects the best network."""
    validation_seed: int = Field(2026, ge=0)
    """Seed of the validation set."""
    test_seed: int = Field(2027, ge=0)
    """Seed of the test set, which is as large as the validation set and never used to choose a network."""

    @model_validator(mode="after")
    def _check(self) -> "DatasetSettings":
        if self.least_cells is not None and self.least_cells > self.cells:
            raise PydanticCustomError("range", "least_cells: expected at most cells")
        for name in ("zoom", "density_scales"):
            low, high = getattr(self, name)
            if low > high:
                raise PydanticCustomError("range", "{name}: expected the smaller number first", {"name": name})
        if self.test_seed == self.validation_seed:
            raise PydanticCustomError("seed", "test_seed: expected another number than validation_seed")
        if self.guide == "paper" and self.guide_spacing is not None:
            raise PydanticCustomError("spacing", "guide_spacing: expected null with guide paper, found a number")
        return self

    @property
    def steps(self) -> int:
        """Number of air steps between the two frames of a pair, at least those of one CUDA graph of the solver."""
        return max(self.lattice_steps(self.interval), PERIOD * self.substeps)

    @property
    def pixels(self) -> tuple[float, float]:
        """Smallest and largest number of pixels along the box's edge in training images."""
        low, high = self.zoom
        return self.resolution / high, self.resolution / low

    def lattice_steps(self, crossings: float) -> int:
        """Converts a time in crossings of the box to air steps, rounded to whole CUDA graphs of the solver."""
        graph = PERIOD * self.substeps
        return round(crossings * self.cells / (LATTICE_SPEED * graph)) * graph

    def look(self, shape: Sequence[int], seed: int = 0) -> March:
        """Returns march settings for the guiding map of a volume of `shape` voxels, with a seed for the jitter."""
        longest = max(shape)
        spacing = None if self.guide_spacing is None else max(self.guide_spacing * longest, LEAST_STEP)
        threshold = self.surface / longest
        step = max(self.guide_step * longest, LEAST_STEP)
        return March(step, spacing, jitter=self.jitter, seed=seed, threshold=threshold)


class TrainSettings(Checked):
    """Settings of the optimisation: its length, batches, learning rate and losses."""

    rounds: int = Field(20, ge=1)
    """Number of rounds; each simulates new samples and trains on them."""
    steps: int = Field(1000, ge=1)
    """Optimisation steps per round."""
    batch: int = Field(12, ge=2, multiple_of=2)
    """Number of frames per step; with a temporal loss these are half as many pairs of frames."""
    rate: float = Field(1e-3, gt=0.0, le=1.0)
    """Adam's highest learning rate; the paper's is 1e-3."""
    floor: float = Field(0.01, ge=0.0, le=1.0)
    """Learning rate at the end, as a share of `rate`; it falls along half a cosine."""
    warmup: int = Field(100, ge=0)
    """Number of steps over which the learning rate rises from 0."""
    average: float = Field(0.999, ge=0.0, lt=1.0)
    """Decay per step of the running mean of the weights; this mean is validated and saved."""
    half: bool = True
    """Whether CUDA computes in bfloat16 where that is safe; the CPU always uses float32."""
    crop: int | None = Field(None, ge=16, multiple_of=16)
    """Edge in pixels of the random crop, which contains smoke, that a step trains on; None: whole images."""
    validate_every: int = Field(1, ge=1)
    """Number of rounds between validations; there is always one after the last round."""
    temporal: float = Field(0.0, ge=0.0)
    """Weight of the temporal loss relative to the reconstruction loss (eq. 10, for which the paper gives no numbers);
    0: no temporal loss."""

    @property
    def total(self) -> int:
        """Number of steps in all rounds."""
        return self.rounds * self.steps

    @property
    def losses(self) -> tuple[str, ...]:
        """Names of the losses that are computed."""
        return ("mse", "temporal") if self.temporal > 0 else ("mse",)

    def rate_at(self, step: int) -> float:
        """Returns the learning rate of a step; steps count from 0."""
        rise = min(1.0, (step + 1) / (self.warmup + 1))
        return rise * self.rate * (self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * step / self.total)))


class Profile(Settings):
    """All settings of a training, as in the files `configs/smoke-network-*.yaml`."""

    FILES: ClassVar[str] = "smoke-network"

    network: NetworkSettings = NetworkSettings()
    """Settings of the network's layers and of its input."""
    training: TrainSettings = TrainSettings()
    """Settings of the optimisation."""
    dataset: DatasetSettings = DatasetSettings()
    """Settings of the samples."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.network.guide != self.dataset.guide:
            kinds = {"network": self.network.guide, "dataset": self.dataset.guide}
            message = "dataset.guide: expected {network} like network.guide, found {dataset}"
            raise PydanticCustomError("guide", message, kinds)
        if (self.training.crop or 0) > self.dataset.resolution:
            sizes = {"most": self.dataset.resolution, "crop": self.training.crop}
            message = "training.crop: expected at most dataset.resolution, {most} pixels, found {crop}"
            raise PydanticCustomError("crop", message, sizes)
        return self

    def override(self, values: Mapping[str, Any], prefix: str = "") -> Self:
        """Returns the profile with settings replaced: `{"training": {"steps": 500}}` keeps the other training settings.

        Raises:
            WlmError: A setting is unknown or out of range.
        """
        return super().override(_merged(self.model_dump(), values), prefix) if values else self


def _merged(settings: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    def value_of(name: str) -> Any:
        old, new = settings.get(name), values[name]
        return _merged(old, new) if isinstance(old, Mapping) and isinstance(new, Mapping) else new

    return {**settings, **{name: value_of(name) for name in values}}
