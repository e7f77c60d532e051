"""The model of a set of many probes: regions of space, each with Gaussians and a network of its own.

A region is a `ProbeModel` that was fitted to the probes in its cell of a k-d tree and to those in a margin around them:
where two regions meet, their lights differ by no more than the errors of both. Regions stay packed until they are
needed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Any, ClassVar, Self

import numpy as np

from wlm.errors import WlmError
from wlm.formats.parts import Part
from wlm.probe.gaussian.model import gaussian_bytes
from wlm.probe.model import Content, ProbeModel, Profile
from wlm.probe.regions.tree import Tree

_MOST = 1 << 20  # regions of a file
_SIZES = ("latent", "hidden", "error", "support")  # settings that all regions share


@dataclass(frozen=True, eq=False)
class Regions(Content):
    """R regions of one set.

    Attributes:
        tree: Which region holds a point.
        boxes: float64 [R, 7], `origin`, `extent` and `size` of each region's model.
        counts: int32 [R, 2], number of Gaussians of each region, and of those that its fit dropped.
        profile: Settings of the fit, of which all regions have the sizes.
        outputs: Numbers per probe at one hour, D.
        hours: T, number of hours.
        packed: Bytes of each region, from `wlm.probe.codec.pack`; those of a file are read when they are needed.
        name: Name of the set, for messages.
        mix: Arguments of `at` for the regions; None: none.
    """

    METHOD: ClassVar[str] = "gaussians"
    DECODER: ClassVar[str] = "wlm.probe.regions.decode:RegionDecoder"
    BUNDLE: ClassVar[str] = ""  # that of each region

    tree: Tree
    boxes: np.ndarray
    counts: np.ndarray
    profile: Profile
    outputs: int
    hours: int
    packed: Sequence[bytes] = ()
    name: str = ""
    mix: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def count(self) -> int:
        """The number of Gaussians of all regions."""
        return int(self.counts[:, 0].sum())

    @property
    def nbytes(self) -> int:
        return sum(self.bytes_of(number) for number in range(self.tree.count))

    def bytes_of(self, number: int) -> int:
        """Returns the bytes of the GPU buffers of a region."""
        profile, hours = self.profile, 1 if self.mix else self.hours
        columns = profile.columns(self.outputs)
        return gaussian_bytes(int(self.counts[number, 0]), profile.latent, profile.hidden, columns, hours)

    def region(self, number: int) -> ProbeModel:
        """Unpacks a region. Raises a WlmError if there is no such region, or its bytes are damaged or do not fit the
        others."""
        if not 0 <= number < self.tree.count:
            raise WlmError(f"{self.name}: region: expected 0 to {self.tree.count - 1}, got {number}")
        try:
            model = resolve_name("wlm.probe.codec:unpack")(self.packed[number], f"{self.name}-{number}")
            sizes = (self.outputs, self.hours, *(getattr(self.profile, name) for name in _SIZES))
            own = (model.outputs, max(len(model.times), 1), *(getattr(model.profile, name) for name in _SIZES))
            same = model.content.settings().get("count") == self.counts[number, 0] and own == sizes
            if not (same and model.method == self.METHOD and np.array_equal(box_row(model), self.boxes[number])):
                raise ValueError("expected Gaussians of the number, sizes, hours and box that the index states")
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise WlmError(f"{getattr(self.packed, 'path', self.name)}: region {number}: {error}") from error
        return model if self.mix is None else replace(model, content=model.content.at(*self.mix), times=np.zeros(0))

    def check(self) -> None:
        for number in range(self.tree.count):
            self.region(number)

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the region of each point, float64 [M, 3], int32 [M], and the points relative to their regions' boxes,
        float32 [M, 3] in [0, 1], moved to the nearest point of the box if they are outside."""
        region = self.tree.regions_of(points)
        origin, extent, size = np.split(self.boxes[region], [3, 4], axis=1)
        return region, np.clip((points - origin) / extent, 0.0, size).astype(np.float32)

    def at(self, factors: np.ndarray, scales: np.ndarray) -> Self:
        return replace(self, mix=(factors, scales))

    def facts(self) -> dict[str, Any]:
        sizes = {"latent": self.profile.latent, "hidden": self.profile.hidden}
        return {"regions": self.tree.count, "gaussians": self.count, "dropped": int(self.counts[:, 1].sum()), **sizes}

    def settings(self) -> dict[str, int]:
        return {"count": self.tree.count}

    @classmethod
    def table(cls, profile: Profile, outputs: int, hours: int, count: int, live: int, clusters: int) -> dict[str, Part]:
        if not 2 <= count <= _MOST:
            raise ValueError(f"setting count: expected 2 to {_MOST} regions, found {count}")
        return {
            "axis": Part(np.int32, (count - 1,), least=0, most=2),
            "plane": Part(np.float64, (count - 1,)),
            "child": Part(np.int32, (count - 1, 2)),
            "boxes": Part(np.float64, (count, 7)),
            "counts": Part(np.int32, (count, 2), least=0),
        }

    def parts(self) -> dict[str, np.ndarray]:
        return self.tree.parts() | {"boxes": self.boxes, "counts": self.counts}

    @classmethod
    def from_parts(
        cls, profile: Profile, outputs: int, hours: int, stored: Mapping[str, np.ndarray], dropped: int
    ) -> Self:
        tree = Tree(stored["axis"], stored["plane"], stored["child"])
        tree.check()
        return cls(tree, stored["boxes"], stored["counts"], profile, outputs, hours)


def box_row(model: ProbeModel) -> np.ndarray:
    """Returns the box of a model as a row of `Regions.boxes`, float64 [7]."""
    return np.array([*model.origin, model.extent, *model.size])
