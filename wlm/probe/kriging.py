"""Light between places that are known: weights of the nearest ones, by kriging with a variogram that grows linearly.

Ordinary kriging is the best linear unbiased estimate of a field from samples of it (Cressie, Statistics for Spatial
Data, section 3.2): it takes from each side alike, and gives samples that stand together the weight of one. The weights
of the nearest K sum to 1; at a sample they are that sample alone. So that light moves without a jump where the K
nearest change, a sample counts as more uncertain the nearer it is to the first one left out (Gribov and Krivoruchko,
Geostatistical mapping with continuous moving neighborhood, 2004):

    t_i = |x - x_i| / r,  r the distance of the first left out
    (4 - |x_i - x_j| / r + [i = j] (e_i + 1e-6)) w = 4 - t + lambda,  sum of w = 1,  e_i = 0.1 t_i^4 / (1 - t_i^2)
"""

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 12
"""Places that light between them is made of, if there are so many."""

SILL = 4.0
TAPER = 0.1
SLIGHT = 1e-6
FEW = 2.0  # r over the farthest distance, where no place is left out
_PIECE = 16384  # points at once: some 50 MB of matrices


class Kriging:
    """Places to take light from.

    Attributes:
        place: float64 [N, 3].
        count: K, how many are taken for a point.
    """

    def __init__(self, place: np.ndarray, count: int = NEIGHBOURS):
        self.place, self.count = place, min(count, len(place))
        self._tree = cKDTree(place)

    def weights(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest places of points, and how much of each to take.

        Args:
            point: float64 [M, 3].

        Returns:
            int64 [M, K] and float64 [M, K], each row's sum 1.
        """
        index = np.empty((len(point), self.count), np.int64)
        weight = np.empty((len(point), self.count))
        for start in range(0, len(point), _PIECE):
            piece = slice(start, start + _PIECE)
            index[piece], weight[piece] = self._weights(point[piece])
        return index, weight

    def nearest(self, point: np.ndarray, asked: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances and numbers of the nearest places, float64 and int64 [M, asked], the nearest first."""
        distance, index = self._tree.query(point, k=asked)
        return distance.reshape(len(point), asked), index.reshape(len(point), asked)

    def _weights(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count, asked = self.count, min(self.count + 1, len(self.place))
        distance, index = self.nearest(point, asked)
        weight = np.zeros((len(point), count))
        weight[:, 0] = 1.0  # where a place is itself
        between = distance[:, 0] > 0.0
        reach = distance[between, -1] * (1.0 if asked > count else FEW)
        near = distance[between, :count] / reach[:, None]
        place = self.place[index[between, :count]]
        apart = np.sqrt(np.square(place[:, :, None] - place[:, None]).sum(-1)) / reach[:, None, None]
        matrix = SILL - apart
        diagonal = np.arange(count)
        # The farthest taken may be as far as the first left out.
        matrix[:, diagonal, diagonal] += TAPER * near**4 / np.maximum(1.0 - near**2, SLIGHT) + SLIGHT
        sides = np.stack([SILL - near, np.ones_like(near)], 2)
        light, one = np.moveaxis(np.linalg.solve(matrix, sides), 2, 0)
        weight[between] = light + one * ((1.0 - light.sum(1)) / one.sum(1))[:, None]
        return index[:, :count], weight
