"""The model of a probe set: the settings of a fit, and the compressed light with its bounding box.

The method of compression is data: `ProbeModel.content` holds the light, either as Gaussians and a small network
(`wlm.probe.gaussian`) or as principal components (`wlm.probe.pca`). Everything else is the same for both methods.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pkgutil import resolve_name
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field

from wlm.errors import WlmError
from wlm.formats.parts import Part
from wlm.probe.hours import hour_factors
from wlm.system import Model, Settings

CODES = 65535
"""Largest 16-bit code of a stored coordinate."""


class Profile(Settings):
    """Settings of a fit. All except `method`, `target`, `max_bytes` and `error` are about the Gaussians."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    FILES: ClassVar[str] = "probe"

    method: Literal["auto", "gaussians", "pca"] = "auto"
    """Compression method: gaussians, pca, or auto, which takes PCA if it has less error in no more GPU memory."""
    target: float | None = Field(None, gt=0.0, lt=1.0)
    """Error to reach, in root mean square, with the fewest bytes of GPU memory; the first fit has `ratio`."""
    max_bytes: int | None = Field(None, ge=1)
    """Most bytes of GPU memory; Gaussians or components are as many as fit them, or as `target` needs."""
    ratio: float = Field(0.05, gt=0.0, le=1.0)
    """Number of Gaussians per live probe, that is, per probe that holds light; `target` and `max_bytes` override it."""
    latent: int = Field(9, ge=1, le=32)
    """Length of the latent vector of a Gaussian."""
    hidden: int = Field(64, ge=8, le=128, multiple_of=8)
    """Width of both hidden layers of the network."""
    error: Literal["relative", "absolute"] = "relative"
    """Error that counts: relative to each probe's light, or absolute (eq. 8), which neglects dark probes."""
    support: Literal["ellipsoid", "sphere"] = "ellipsoid"
    """Support of a Gaussian: ellipsoid, at three standard deviations, or sphere, of its longest half axis (eq. 6)."""
    optimiser: Literal["adam", "adan"] = "adam"
    """Optimiser of the Gaussians; the network is always trained by Adam."""
    region: int = Field(20_000, ge=2)
    """Most live probes of a region; Gaussians of larger sets are fitted in regions, each with a network of its own."""
    steps: int = Field(12000, ge=10)
    """Number of training steps; each step runs over all probes."""
    centre_rate: float = Field(1e-3, gt=0.0, lt=1.0)
    """Initial learning rate of the Gaussians' centres, with the longest side of the probes' box as the unit."""
    scale_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the logarithms of the Gaussians' scales."""
    rotation_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the quaternions that rotate the Gaussians."""
    latent_rate: float = Field(3e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the Gaussians' latent vectors."""
    net_rate: float = Field(2e-2, gt=0.0, lt=1.0)
    """Initial learning rate of the network."""
    detail: float = Field(1.0, ge=0.0, le=4.0)
    """Initial centres are denser where light varies, by this power of its local standard deviation; 0: uniform."""
    first_scale: float = Field(0.7, gt=0.0, le=4.0)
    """Initial scale of a Gaussian as a share of the distance to the nearest other centre."""
    gain: float = Field(3.0, gt=0.0, le=10.0)
    """Magnitude of the hidden layers' initial weights; 1: uniform random numbers of variance 1 / (3 * inputs)."""

    def columns(self, outputs: int, hours: int = 1) -> int:
        """Returns the number of outputs of the network for D numbers per probe at each hour: one more each if the error
        is relative."""
        return hours * (outputs + (self.error == "relative"))


class Content(ABC):
    """The compressed light of a model, in the form of one compression method.

    The last step of a decoder is a matrix: the last layer of the network, or the principal components. It has columns
    for the D numbers of a probe at each of T hours, so the light at any time is that of a matrix of D columns, the sum
    of the hours' columns with the time's factors. Everything before it is shared by all hours.

    Attributes:
        METHOD: Name of the method in files and reports.
        DECODER: Class of its decoder, a `wlm.probe.decode.Decoder`, as `module:name`.
        BUNDLE: Function that makes the part of a model's GPU bundle which depends on the method, as `module:name`. It
            takes the model and a decoder, which computes the reference; `wlm.probe.bundle` adds the rest.
    """

    METHOD: ClassVar[str]
    DECODER: ClassVar[str]
    BUNDLE: ClassVar[str]

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """The bytes of the content's GPU buffers, as `wlm.probe.bundle` makes them."""

    def check(self) -> None:
        """Reads and checks what a file still holds; raises a WlmError for what is damaged."""
        return

    @abstractmethod
    def at(self, factors: np.ndarray, scales: np.ndarray) -> Self:
        """Returns the content of one hour that is the mix of T hours, with factors, float64 [T], which add up to 1, and
        `scales` of their light, float64 [T]. The logarithms of magnitudes are mixed, where there are such."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Returns values that `wlm info` shows, as JSON values by name."""

    @abstractmethod
    def settings(self) -> dict[str, int]:
        """Returns entries of a file's header: `count` of Gaussians or components, `clusters`, `dropped` Gaussians."""

    @abstractmethod
    def parts(self) -> dict[str, np.ndarray]:
        """Returns the arrays that a file stores, by name. Raises a ValueError if the numbers have not been quantised
        for a file."""

    @classmethod
    @abstractmethod
    def table(cls, profile: Profile, outputs: int, hours: int, count: int, live: int, clusters: int) -> dict[str, Part]:
        """Returns the types and shapes of these arrays, by name, for `count` Gaussians, or components of each of
        `clusters`; `live` probes; and `outputs` numbers of a probe at each hour. Raises a ValueError if there are more
        components than numbers of a probe."""

    @classmethod
    @abstractmethod
    def from_parts(
        cls, profile: Profile, outputs: int, hours: int, stored: Mapping[str, np.ndarray], dropped: int
    ) -> Self:
        """Builds the content from a file's arrays, whose types and shapes have been checked; `outputs` as for `table`.
        Raises a ValueError if the numbers contradict each other, or exceed what a decoder can compute in float32."""


@dataclass(frozen=True, eq=False)
class ProbeModel(Model):
    """A compressed set of N probes of D numbers each, at one or several hours of the day.

    Attributes:
        name: Name of the set.
        source: Hash of the input, 16 hexadecimal digits; a file stores the first 8.
        profile: Settings of the fit, with the method that was used; PCA has no other settings.
        probes: Number of probes, N.
        outputs: Numbers per probe at one hour, D: 27 for second-order spherical harmonics in three colours.
        origin: float64 [3], lowest corner of the probes' bounding box, in the unit of the positions.
        extent: Longest side of the box; 1 if all probes coincide.
        size: float64 [3], sides of the box divided by `extent`, each in [0, 1].
        dead: bool [N], probes that decode to zero: all their numbers were zero, or one was not finite. Empty if
            there are none.
        positions: uint16 [N, 3], positions in 1/65535 of the box, if they are stored with the model; else empty.
        content: The compressed light, in the form of the method.
        choice: Sentence that says why the fit used this method. Files do not store it.
        warnings: Sentences about light that the fit lost, as in `wlm.probe.Report`. Files do not store them.
        times: float64 [T], increasing hours of the day in [0, 24), if there are several; else empty.
        scales: float64 [T], factor of the light of each hour of `content`, by which the fit divided it, so that the
            precision of an hour follows its own light; 1 where `content` has magnitudes for each hour.
    """

    SYSTEM: ClassVar[str] = "probe"

    name: str
    source: str
    profile: Profile
    probes: int
    outputs: int
    origin: np.ndarray
    extent: float
    size: np.ndarray
    dead: np.ndarray
    positions: np.ndarray
    content: Content
    choice: str = ""
    warnings: tuple[str, ...] = ()
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scales: np.ndarray = field(default_factory=lambda: np.ones(1))

    @property
    def method(self) -> str:
        """The name of the method, "gaussians" or "pca"."""
        return self.content.METHOD

    @property
    def live(self) -> np.ndarray:
        """Which probes hold light, bool [N]."""
        return ~self.dead if len(self.dead) else np.ones(self.probes, bool)

    def check(self) -> None:
        self.content.check()

    @property
    def has_positions(self) -> bool:
        """Whether the model stores the positions of its probes."""
        return len(self.positions) > 0

    def at(self, time: float | None = None) -> "ProbeModel":
        """Returns the model of the light at one time of the day, linear between two hours; None: the only hour.

        The result decodes and exports as any other model, but cannot be saved: `evaluate` needs its `file_bytes`. It is
        mixed in float64 and rounded to half floats; a decoder's `set_time` is quicker.

        Raises:
            WlmError: The model has several hours and no time is given, or the time is not finite.
        """
        factors = hour_factors(self.name, self.times, time)
        if factors is None:
            return self
        return replace(self, content=self.content.at(factors, self.scales), times=np.zeros(0), scales=np.ones(1))

    def decoder(self, device: str = "cpu", **options: Any) -> Any:
        """Loads the model onto a device and returns its decoder.

        Args:
            device: "cpu" or "cuda:N".
            options: Further arguments of the decoder, such as `position`.

        Raises:
            WlmError: The device does not exist, or the options do not fit the model.
        """
        return resolve_name(self.content.DECODER)(self, device, **options)

    def normalise(self, position: np.ndarray) -> np.ndarray:
        """Returns positions relative to the probes' box, float32 [M, 3] in [0, 1], clamped to the box. Positions [M, 3]
        are in the unit of the probes' positions. The difference is computed in float64, so that a box far from the
        origin loses nothing."""
        x = (np.asarray(position, np.float64) - self.origin) / self.extent
        return np.clip(x, 0.0, self.size).astype(np.float32)

    def stored_positions(self) -> np.ndarray:
        """Returns the positions stored with the model, float64 [N, 3], exact to 1/65535 of the box.

        Raises:
            WlmError: The model stores no positions.
        """
        if not self.has_positions:
            raise WlmError(
                f"{self.name}: the file stores no positions: name that of its probes, or compress with --positions"
            )
        return self.origin + self.extent * self.size * (self.positions / CODES)

    def has_probes_at(self, position: np.ndarray) -> bool:
        """Tests whether positions, float64 [M, 3], equal those of the model's own probes in number and bounding box."""
        if len(position) != self.probes:
            return False
        box = np.stack([self.origin, self.origin + self.extent * self.size])
        # An engine may have rounded them to float32.
        slack = 1e-6 * self.extent + np.finfo(np.float32).eps * np.abs(box).max()
        return bool((np.abs(np.stack([position.min(0), position.max(0)]) - box) <= slack).all())


def box_of(position: np.ndarray) -> dict[str, Any]:
    """Returns `origin`, `extent` and `size` of `ProbeModel` for probes at positions float64 [N, 3]."""
    low, high = position.min(0), position.max(0)
    # A single position has no extent: any unit will do.
    extent = float((high - low).max()) or 1.0
    return {"origin": low, "extent": extent, "size": np.minimum((high - low) / extent, 1.0)}


def check_points(position: np.ndarray) -> np.ndarray:
    """Checks points in space, [M, 3], and returns them as float64. Raises a WlmError if a position is not finite.
    Raises a ValueError if the shape is different."""
    position = np.asarray(position, np.float64)
    if position.ndim != 2 or position.shape[1] != 3:
        raise ValueError(f"position: expected [M, 3], got {position.shape}")
    bad = np.flatnonzero(~np.isfinite(position).all(1))
    if len(bad):
        raise WlmError(f"position {bad[0]}: expected finite numbers, got {position[bad[0]].tolist()}")
    return position
