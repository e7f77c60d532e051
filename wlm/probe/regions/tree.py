"""Splits positions into regions by a k-d tree."""

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True, eq=False)
class Tree:
    """A k-d tree whose leaves are R regions; node 0 is its root. A node splits space along `axis`, int32 [R - 1], at
    the coordinate `plane`, float64 [R - 1], whose points belong to the upper half. `child`, int32 [R - 1, 2], is for
    the lower and the upper half the number of a later node, or -1 - r of region r."""

    axis: np.ndarray
    plane: np.ndarray
    child: np.ndarray

    @classmethod
    def split(cls, position: np.ndarray, most: int) -> Self:
        """Halves points, float64 [N, 3], along the longest side of their box at the median, and again each half, until
        a region has at most `most` of them or all of its points coincide."""
        axes, planes, children = [], [], []
        regions, stack = 0, [(np.arange(len(position)), -1, 0)]
        while stack:
            own, parent, side = stack.pop()
            low, high = position[own].min(0), position[own].max(0)
            axis = int((high - low).argmax())
            if len(own) <= most or low[axis] == high[axis]:
                number, regions = -1 - regions, regions + 1
            else:
                along, number = position[own, axis], len(planes)
                middle = np.partition(along, len(own) // 2)[len(own) // 2]
                # Half of the points may coincide: the plane then lies above them.
                middle = middle if middle > low[axis] else along[along > low[axis]].min()
                below = along[along < middle].max()
                plane = below + 0.5 * (middle - below)
                plane = plane if plane > below else middle
                axes.append(axis)
                planes.append(plane)
                children.append([0, 0])
                upper = along >= plane
                stack += [(own[upper], number, 1), (own[~upper], number, 0)]
            if parent >= 0:
                children[parent][side] = number
        child = np.array(children, np.int32).reshape(-1, 2)
        return cls(np.array(axes, np.int32), np.array(planes, np.float64), child)

    @property
    def count(self) -> int:
        """The number of regions, R."""
        return len(self.plane) + 1

    def parts(self) -> dict[str, np.ndarray]:
        """Returns the arrays by name."""
        return {"axis": self.axis, "plane": self.plane, "child": self.child}

    def check(self) -> None:
        """Raises a ValueError unless every node and region is the child of exactly one earlier node."""
        expected, number = np.arange(-self.count, len(self.plane)), np.arange(len(self.plane))[:, None]
        once = np.array_equal(np.sort(self.child, axis=None), expected[expected != 0])
        if len(number) and not (once and ((self.child < 0) | (self.child > number)).all()):
            raise ValueError("part child: expected each node and each region below one earlier node")

    def regions_of(self, points: np.ndarray) -> np.ndarray:
        """Returns the region of each point, float64 [M, 3], int32 [M]."""
        node = np.full(len(points), 0 if len(self.plane) else -1, np.int32)
        while (inner := np.flatnonzero(node >= 0)).size:
            at = node[inner]
            node[inner] = self.child[at, (points[inner, self.axis[at]] >= self.plane[at]).astype(np.int32)]
        return -1 - node
