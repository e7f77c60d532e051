"""Patches: samples, dominant colours, orders, distances and bounds against float64 NumPy."""

import numpy as np
import pytest
import warp as wp
from reference import patches as reference

from wlm_kernels.atlas import patch_graph as graphs
from wlm_kernels.atlas import patches as kernels
from wlm_kernels.atlas.patches import ORDERS, SIZES

SIDE = (24, 40)


def _image(seed: int = 0, contrast: float = 1.0) -> np.ndarray:
    """Smooth colours with a step, float [H, W, 3] in [0, 1]."""
    y, x = np.mgrid[: SIDE[0], : SIDE[1]] / SIDE[1]
    image = np.stack([0.5 + 0.4 * np.sin(7 * x + seed), x * y * 2, np.where(x > 0.4, 0.8, 0.1)], -1)
    return np.clip(0.3 + contrast * (image - 0.3), 0.0, 1.0)


def _texels(image: np.ndarray) -> np.ndarray:
    return np.concatenate([np.rint(image * 65535), np.zeros((*SIDE, 1))], -1).astype(np.uint16)


def _triangles(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Corners in texels, some outside the image, and levels; the first have no area."""
    random = np.random.default_rng(seed)
    centre = random.uniform(-2, 1, (count, 1, 2)) + random.random((count, 1, 2)) * [SIDE[1], SIDE[0]]
    level = random.integers(0, 4, count).astype(np.int32)
    corners = centre + random.normal(size=(count, 3, 2)) * (2.0**level)[:, None, None] * 0.6
    corners[0] = corners[0, :1]
    corners[1, 2] = corners[1, 1]
    corners[2] = corners[2, :1] + [[0, 0], [1, 2], [2, 4]]
    return np.rint(corners * 65536) / 65536, level


def _sampled(image: np.ndarray, corners: np.ndarray, level: np.ndarray, device: str):
    fixed = np.rint(corners * 65536).astype(np.int64)
    samples, patches, bright = kernels.sample(_texels(image), fixed, level, device)
    kernels.dominant(samples, patches)
    return samples, patches, bright


def _unpacked(samples: wp.array, level: np.ndarray) -> list[np.ndarray]:
    packed = samples.numpy()
    colours = np.stack([packed & 255, packed >> 8 & 255, packed >> 16], -1)
    return np.split(colours, np.cumsum(kernels.samples_of(np.array(SIZES)[level]))[:-1])


def test_samples(device: str):
    """Within rounding of bilinear samples at the lattice's barycentrics; and the patch's range and dominant colour."""
    image, (corners, level) = _image(), _triangles(40)
    samples, patches, _ = _sampled(image, corners, level, device)
    patch = patches.numpy()
    for t, got in enumerate(_unpacked(samples, level)):
        want = reference.patch(image, corners[t], SIZES[level[t]]) * 255
        # Half a level, and 1/512 of a texel on each axis at the steepest step of 0.7.
        assert np.abs(got - want).max() <= 0.5 + 2 * 255 * 0.7 / 512 + 0.01
        for name, values in (("low", got.min(0)), ("high", got.max(0)), ("colour", reference.dominant(got))):
            assert patch[name][t] == values[0] + 256 * values[1] + 65536 * values[2], name
        assert patch["level"][t] == (0 if (got == got[0]).all() else level[t])
    assert 0 < (patch["level"] == 0).sum() < len(level)


def test_orders_are_those_of_permuted_vertices(device: str):
    """A patch reordered equals, exactly, the patch of the triangle with its vertices permuted."""
    image, (corners, level) = _image(), _triangles(12)
    plain = _unpacked(_sampled(image, corners, level, device)[0], level)
    for p in ORDERS:
        permuted = np.empty_like(corners)
        permuted[:, list(p)] = corners
        for t, got in enumerate(_unpacked(_sampled(image, permuted, level, device)[0], level)):
            np.testing.assert_array_equal(got, reference.reordered(plain[t], SIZES[level[t]], p))


def test_distances(device: str):
    """Of patches of all pairs of sizes, the least Dist, exact, and the first order that has it; the same both ways."""
    image, (corners, level) = _image(), _triangles(20)
    samples, patches, _ = _sampled(image, corners, level, device)
    split = _unpacked(samples, level)
    a, b = (x.ravel() for x in np.meshgrid(np.arange(20), np.arange(20)))
    order, distance = kernels.compare(samples, patches, _ints(a, device), _ints(b, device))
    sizes = set()
    for k in range(len(a)):
        # One colour everywhere is a patch of any size.
        want = reference.distances(*(_smallest(split[t]) for t in (b[k], a[k])))
        assert distance[k] == pytest.approx(want.min(), abs=1e-12)
        assert order[k] == int((want < want.min() + 1e-12).argmax())
        sizes.add((level[a[k]], level[b[k]]))
    assert len(sizes) == 16
    np.testing.assert_array_equal(distance.reshape(20, 20), distance.reshape(20, 20).T)
    assert distance.max() > 0.1


def _smallest(patch: np.ndarray) -> np.ndarray:
    return patch[:3] if (patch == patch[0]).all() else patch


def _ints(values: np.ndarray, device: str) -> wp.array:
    return wp.array(np.asarray(values, np.int32), dtype=int, device=device)


def _graph(samples, patches, threshold: float, colour_threshold: float, device: str):
    """The graph, and the number that each of its nodes had."""
    levels = int(patches.numpy()["level"].max()) + 1
    bounds = graphs.bounds(samples, patches, levels)
    return graphs.graph(samples, patches, bounds, levels, graphs.rule(threshold, colour_threshold, device))


@pytest.mark.parametrize(("threshold", "contrast"), [(0.003, 0.02), (0.003, 0.2), (0.03, 0.2), (0.03, 1.0), (0.1, 1.0)])
def test_neighbours(device: str, threshold: float, contrast: float):
    """Degrees, rows and remaining degrees of the naive matrix; some pairs need samples, for others bounds do."""
    count = 44
    image, (corners, level) = _image(contrast=contrast), _triangles(count, seed=3)
    samples, patches, _ = _sampled(image, corners, level, device)
    graph, number = _graph(samples, patches, threshold, 0.09, device)
    split = [_smallest(patch) for patch in _unpacked(samples, level)]
    want = reference.adjacency([split[t] for t in number], threshold, 0.09)

    edge = wp.zeros((count, count), dtype=wp.uint8, device=device)
    for begin in range(0, count, 32):
        graphs.find_edges(graph, begin, min(begin + 32, count), edge)
    np.testing.assert_array_equal(edge.numpy() != 0, want)
    few = np.arange(5, count, 3)
    part, edge = graphs.part(graph, few), wp.zeros((len(few), len(few)), dtype=wp.uint8, device=device)
    graphs.find_edges(part, 0, len(few), edge)
    np.testing.assert_array_equal(edge.numpy() != 0, want[np.ix_(few, few)])

    heads = np.array([5, 40])
    joined = wp.empty(count, dtype=int, device=device)
    low = wp.array(graph.means[heads], dtype=float, device=device)
    nodes = _ints(np.arange(count), device)
    graphs.join(graph, nodes, 0, count, _ints(heads, device), low, _ints(np.array([1, 0]), device), joined)
    like = want[heads] | (heads[:, None] == np.arange(count))
    np.testing.assert_array_equal(joined.numpy(), np.where(like[1], 0, np.where(like[0], 1, 2)))


@pytest.mark.parametrize("threshold", [0.02, 0.1])
def test_neighbours_without_bounds(device: str, threshold: float):
    """Patches of up to 129 samples, larger than those with bounds, beside small ones: the edges of the naive matrix."""
    image, level = _image(contrast=0.3), np.array([7, 0, 7, 2, 5, 7], np.int32)
    corners = _triangles(len(level), seed=5)[0]
    corners[:3] = [[4, 4], [20, 4], [4, 20]] + np.array([0.0, 0.5, 0.1])[:, None, None]
    samples, patches, _ = _sampled(image, corners, level, device)
    graph, number = _graph(samples, patches, threshold, 2.0, device)
    split = [_smallest(patch) for patch in _unpacked(samples, level)]
    want = reference.adjacency([split[t] for t in number], threshold, 2.0)
    assert 0 < want.sum() < want.size - len(level)
    edge = wp.zeros(want.shape, dtype=wp.uint8, device=device)
    for begin in range(0, len(level), 4):
        graphs.find_edges(graph, begin, min(begin + 4, len(level)), edge)
    np.testing.assert_array_equal(edge.numpy() != 0, want)
    heads, joined = np.arange(len(level)), wp.empty(len(level), dtype=int, device=device)
    low = wp.array(graph.means, dtype=float, device=device)
    rank = np.array([3, 1, 0, 5, 4, 2])
    graphs.join(graph, _ints(heads, device), 0, 6, _ints(heads, device), low, _ints(rank, device), joined)
    like = want | np.eye(len(level), dtype=bool)
    np.testing.assert_array_equal(joined.numpy(), np.where(like, rank, len(level)).min(1))
    means = [reference.upsampled(split[t], SIZES[level[t]] if len(split[t]) > 3 else 2, 129) for t in number]
    means = [np.nanmean(colours, (0, 1)).sum() for colours in means]
    low, high = graph.nodes.low.numpy(), graph.nodes.high.numpy()
    assert (low <= np.array(means) + 1e-3).all() and (high >= np.array(means) - 1e-3).all()


@pytest.mark.parametrize(("step", "alike"), [(50, True), (51, False)])
@pytest.mark.parametrize("size", [2, 9])
def test_the_threshold_itself_is_not_alike(device: str, step: int, alike: bool, size: int):
    """At lambda = 0.2 = 51 / 255, which no float holds, patches 51 levels apart are dissimilar, 50 are alike."""
    level = np.full(2, SIZES.index(size), np.int32)
    image = np.broadcast_to(np.linspace(0, 0.3, SIDE[1])[None, :, None], (*SIDE, 3))
    samples, patches, _ = _sampled(image, np.array([[[2, 2], [18, 2], [2, 18]]] * 2, float), level, device)
    grey = samples.numpy()
    half = len(grey) // 2
    grey[half:] = grey[:half] + step * 0x010101
    patch = patches.numpy()
    for name in ("low", "high"):
        patch[name][1] = patch[name][0] + step * 0x010101
    samples = wp.array(grey, dtype=int, device=device)
    graph, _ = _graph(samples, wp.array(patch, dtype=kernels.Patch, device=device), 0.2, 2.0, device)
    edge = wp.zeros((2, 2), dtype=wp.uint8, device=device)
    graphs.find_edges(graph, 0, 2, edge)
    assert edge.numpy().tolist() == [[0, int(alike)], [int(alike), 0]]
