"""The model of a probe set: its settings and its arrays, as stored and as used.

The light at a position p is a small network of the Gaussians' sum and the position (gaussian-probe-compression,
eq. 2 to 7):

    x = (p - origin) / extent                        in [0, 1]^3
    F(x) = sum_j F_j exp(-d_j^2 / 2),  d_j = |S_j^-1 R_j^T (x - mu_j)|,  over the Gaussians j that reach x
    sh(p) = gain * MLP([F(x), x])
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from wlm.errors import WlmError
from wlm.probe.packed import Packed
from wlm.system import Model, Settings
from wlm_kernels.probe.network import most_outputs

# Channels of a Gaussian, in the order of `ProbeModel.bounds`; the last three groups share `Profile.bits`.
CENTRE = slice(0, 3)
SCALE = slice(3, 6)
ROTATION = slice(6, 10)
LATENT = slice(10, None)
CENTRE_BITS = 16


class Profile(Settings):
    """Settings of a fit.

    Attributes:
        name: Shown in reports.
        method: "gaussians", which all settings but the next three are about, or "transform".
        target_psnr: Of a transform, dB over all numbers of all probes: what to reach, with as few bytes as that takes.
            None: 50, or fewer where the set's own noise is more, or as many as `max_bytes` allows.
        max_bytes: Of a transform, the most that its file may have, which comes before the PSNR; None: any.
        region: Of a transform, live probes up to which a set is one region; more are divided.
        ratio: Gaussians as a share of the live probes.
        bits: Bits of each number of a Gaussian's scale, rotation and latent.
        latent: Numbers in a Gaussian's latent.
        hidden: Width of both hidden layers.
        support: What a Gaussian reaches: its own "ellipsoid" out to `cut`, or the "sphere" of its longest axis
            (eq. 6).
        cut: How far it reaches, in standard deviations.
        optimiser: Of the Gaussians: "adam" or "adan". The network's is Adam.
        steps: Of the whole fit.
        centre_rate, scale_rate, rotation_rate, latent_rate, net_rate: First learning rates; centres and the log of
            the scales in the normalised frame.
        final_rate: All rates end here, on half a cosine, as a share of the first.
        detail: The first centres are drawn from the probes with odds of their local spread to this power, so that
            Gaussians begin where the light varies; 0: from all alike, as k-means does.
        first_scale: The first scales, as a share of the distance to the nearest other centre.
        first_latent: Spread of the first latents.
        gain: Of the first weights of the network, over those of a uniform draw of variance 1 / (3 inputs).
        quantise_from: Share of the steps after which the Gaussians are used on the levels of the file (section 3.3).
        freeze_from: Share of the steps after which they stand still and the network alone is tuned.
        prune: Bound on what dropping useless Gaussians may change, as a share of the range of the probes' numbers.
    """

    FILES: ClassVar[str] = "probe"

    method: Literal["gaussians", "transform"] = "gaussians"
    target_psnr: float | None = Field(None, gt=0.0, le=120.0)
    max_bytes: int | None = Field(None, ge=1)
    region: int = Field(32768, ge=256)
    ratio: float = Field(0.05, gt=0.0, le=1.0)
    bits: int = Field(10, ge=4, le=16)
    latent: int = Field(9, ge=1, le=32)
    hidden: int = Field(64, ge=8, le=128, multiple_of=8)
    support: Literal["ellipsoid", "sphere"] = "ellipsoid"
    cut: float = Field(3.0, ge=1.0, le=6.0)
    optimiser: Literal["adam", "adan"] = "adam"
    steps: int = Field(12000, ge=10)
    centre_rate: float = Field(1e-3, gt=0.0, lt=1.0)
    scale_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    rotation_rate: float = Field(1e-2, gt=0.0, lt=1.0)
    latent_rate: float = Field(3e-2, gt=0.0, lt=1.0)
    net_rate: float = Field(2e-2, gt=0.0, lt=1.0)
    final_rate: float = Field(1e-3, ge=0.0, le=1.0)
    detail: float = Field(1.0, ge=0.0, le=4.0)
    first_scale: float = Field(0.7, gt=0.0, le=4.0)
    first_latent: float = Field(0.1, gt=0.0, le=4.0)
    gain: float = Field(3.0, gt=0.0, le=10.0)
    quantise_from: float = Field(5 / 6, ge=0.0, le=1.0)
    freeze_from: float = Field(11 / 12, ge=0.0, le=1.0)
    prune: float = Field(1e-4, ge=0.0, le=0.1)

    @model_validator(mode="after")
    def _stages_in_order(self) -> "Profile":
        if self.quantise_from > self.freeze_from:
            raise ValueError("quantise_from must not be later than freeze_from")
        return self

    def code_bits(self) -> np.ndarray:
        """Bits of each number of a Gaussian in the file, int [10 + L]."""
        return np.array([CENTRE_BITS] * 3 + [self.bits] * (7 + self.latent))


def check_outputs(name: str, profile: Profile, outputs: int, device: str) -> None:
    """Checks that a device's kernels can be made for so many numbers a probe; those of the CPU can for any.

    Raises:
        WlmError: They can't.
    """
    most = most_outputs(profile.latent, profile.hidden)
    if device != "cpu" and outputs > most:
        raise WlmError(
            f"{name}: expected at most {most} numbers a probe on CUDA with latent {profile.latent} and hidden "
            f"{profile.hidden}, found {outputs}; the CPU takes more"
        )


def layer_shapes(latent: int, hidden: int, outputs: int) -> list[tuple[int, int]]:
    """Shapes of the network's layers: a row of weights for each input, then one of biases; a column for each output."""
    return [(latent + 4, hidden), (hidden + 1, hidden), (hidden + 1, outputs)]


@dataclass(frozen=True, eq=False)
class ProbeModel(Model):
    """A compressed probe set; N probes of D numbers, K Gaussians with latents of L.

    Attributes:
        name: The set's name.
        source: Hash of the input.
        profile: The settings.
        probes: N.
        outputs: D, 27 for L2 in RGB.
        origin: float64 [3], in the unit of the positions.
        extent: Of the box of the probes along its longest axis; positive.
        size: float64 [3], of the box of the probes, normalised: each in [0, 1].
        gain: Factor behind the network.
        centre: uint16 [K, 3].
        code: uint16 [K, 7 + L], up to `levels`: log of the scale, rotation, latent.
        bounds: float32 [2, 10 + L], lowest and highest value of each channel.
        net: float16 [P], the network: for each layer a row of weights for every input, then the biases.
        dead: bool [N], probes that decode to zero: all their numbers were zero, or one was not finite. Empty if there
            are none.
        positions: uint16 [N, 3] over the box, where they are stored with the model; else empty.
        dropped: Gaussians that no probe felt and that are not stored.
        packed: The whole numbers that `centre`, `code`, `bounds` and `net` follow from, of a packed file; else None.
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
    gain: float
    centre: np.ndarray
    code: np.ndarray
    bounds: np.ndarray
    net: np.ndarray
    dead: np.ndarray
    positions: np.ndarray
    dropped: int
    packed: Packed | None = None

    @property
    def count(self) -> int:
        """K, Gaussians that are stored."""
        return len(self.centre)

    @property
    def has_positions(self) -> bool:
        """Whether the probes' positions are stored."""
        return len(self.positions) > 0

    @property
    def codes(self) -> np.ndarray:
        """All codes of each Gaussian, uint16 [K, 10 + L], in the order of `bounds`."""
        return np.concatenate([self.centre, self.code], 1)

    @property
    def levels(self) -> np.ndarray:
        """The largest code of each channel, int64 [10 + L]."""
        return 2 ** self.profile.code_bits() - 1 if self.packed is None else self.packed.levels()

    @property
    def steps(self) -> np.ndarray:
        """What one unit of each code is worth, float32 [10 + L]."""
        low, high = self.bounds
        return (high - low) / np.maximum(self.levels, 1).astype(np.float32)

    def rows(self) -> np.ndarray:
        """The Gaussians' numbers restored from their codes (eq. 14), float32 [K, 10 + L].

        Scales are logarithms; quaternions w, x, y, z have any length, and one of length zero stands for no rotation.
        """
        return self.bounds[0] + self.codes.astype(np.float32) * self.steps

    def layers(self) -> list[np.ndarray]:
        """The three layers of `net`, float16, as `layer_shapes` has them."""
        shapes = layer_shapes(self.profile.latent, self.profile.hidden, self.outputs)
        parts = np.split(self.net, np.cumsum([rows * columns for rows, columns in shapes])[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def normalise(self, position: np.ndarray) -> np.ndarray:
        """Positions in the normalised frame, moved to the nearest point of the probes' box.

        Args:
            position: [M, 3], in the unit of the probes' positions.

        Returns:
            float32 [M, 3]. The difference is taken in float64, so that a box far from the origin loses nothing.
        """
        x = (np.asarray(position, np.float64) - self.origin) / self.extent
        return np.clip(x, 0.0, self.size).astype(np.float32)

    def stored_positions(self) -> np.ndarray:
        """The positions stored with the model, float64 [N, 3], to 1/65535 of the box.

        Raises:
            WlmError: None are stored.
        """
        if not len(self.positions):
            raise WlmError(f"{self.name}: holds no positions; expected those of its probes, or a fit that stores them")
        return self.origin + self.extent * self.size * (self.positions / 65535.0)

    def has_probes_at(self, position: np.ndarray) -> bool:
        """Whether positions, float64 [M, 3], are taken for the model's own probes: as many, and in the same box."""
        if len(position) != self.probes:
            return False
        box = np.stack([self.origin, self.origin + self.extent * self.size])
        # An engine may have rounded them to float32.
        slack = 1e-6 * self.extent + np.finfo(np.float32).eps * np.abs(box).max()
        return bool((np.abs(np.stack([position.min(0), position.max(0)]) - box) <= slack).all())


def live_probes(dead: np.ndarray, count: int) -> np.ndarray:
    """Which of `count` probes have light, bool [N]; `dead` is bool [N], or empty where none is."""
    return ~dead if len(dead) else np.ones(count, bool)


def check_points(position: np.ndarray, letter: str = "M") -> np.ndarray:
    """Checks points in space.

    Args:
        position: [M, 3].
        letter: What an error calls their number.

    Returns:
        float64 [M, 3].

    Raises:
        WlmError: A position that isn't finite.
        ValueError: Another shape.
    """
    position = np.asarray(position, np.float64)
    if position.ndim != 2 or position.shape[1] != 3:
        raise ValueError(f"position: expected [{letter}, 3], got {position.shape}")
    bad = np.flatnonzero(~np.isfinite(position).all(1))
    if len(bad):
        raise WlmError(f"position {bad[0]}: expected finite numbers, got {position[bad[0]].tolist()}")
    return position
