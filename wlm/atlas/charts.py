"""Charts of a mesh: triangles that are connected in UV space."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def welded(position: np.ndarray, uv: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Numbers the corners of the triangles, int32 [F, 3] from 0: corners with the same position [V, 3] and UV [V, 2]
    get the same number. A file also splits vertices where another attribute differs, such as a normal, though the
    lightmap has no seam there."""
    # Adding 0 turns -0 into 0, which has other bits.
    values = np.ascontiguousarray(np.concatenate([position, uv], 1, dtype=np.float64) + 0.0)
    row = values.view([("", np.float64)] * values.shape[1])[:, 0]
    return np.unique(row, return_inverse=True)[1].astype(np.int32)[triangle]


def charts(corner: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
    """Numbers the charts, int32 [F] from 0, in the order of their first triangles; -1 for a triangle that isn't active.
    `corner`, int [F, 3], is the result of `welded`. Triangles that share an edge are in one chart; sharing a corner is
    not enough."""
    corner = np.asarray(corner)
    count = len(corner)
    out = np.full(count, -1, np.int32)
    triangle = np.arange(count) if active is None else np.flatnonzero(active)
    if not len(triangle):
        return out
    edge = np.sort(np.stack([corner[triangle], np.roll(corner[triangle], -1, 1)], -1).reshape(-1, 2), 1)
    # A bipartite graph: each triangle is joined to its three edges.
    edge = np.unique(edge, axis=0, return_inverse=True)[1].reshape(-1)
    links = np.repeat(np.arange(len(triangle)), 3), len(triangle) + edge
    nodes = len(triangle) + int(edge.max()) + 1
    graph = coo_array((np.ones(len(edge), bool), links), (nodes, nodes))
    label = connected_components(graph, directed=False)[1][: len(triangle)]
    _, first, number = np.unique(label, return_index=True, return_inverse=True)
    out[triangle] = np.argsort(np.argsort(first))[number]
    return out
