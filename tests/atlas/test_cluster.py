"""Clusters of triangles against the naive algorithm, in hard cases, and charts of connected triangles."""

import numpy as np
import pytest
from reference import patches as reference

from wlm.atlas.cascade import cluster as clustering
from wlm.atlas.cascade.cluster import Clusters, cluster
from wlm.atlas.charts import charts, welded
from wlm.errors import WlmError
from wlm_kernels.atlas import patches as kernels
from wlm_kernels.atlas.patches import ORDERS, SIZES

SIDE = (48, 64)  # rows, columns


def _lightmap(seed: int = 0) -> np.ndarray:
    """Blobs of light, float32 [H, W, 3], brightest about 1.5."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[: SIDE[0], : SIDE[1]]
    image = np.full((*SIDE, 3), 0.05)
    for _ in range(8):
        at, wide = random.random(2) * SIDE, random.uniform(4, 15)
        blob = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * wide**2))
        image += blob[..., None] * random.random(3) * 0.6
    return image.astype(np.float32)


def _mesh(count: int, seed: int = 0, longest: float = 9.0) -> tuple[np.ndarray, np.ndarray]:
    """Triangles at random, each with vertices of its own: UVs [3 F, 2] and vertices [F, 3]."""
    random = np.random.default_rng(seed)
    corners = random.random((count, 1, 2)) + random.normal(size=(count, 3, 2)) * longest / 3 / SIDE[1]
    return np.clip(corners.reshape(-1, 2), 0, 1), np.arange(3 * count).reshape(-1, 3)


def _uv(texels: list | np.ndarray) -> np.ndarray:
    """Places in texels, from the first one's centre, as UVs [N, 2]."""
    return (np.reshape(texels, (-1, 2)) + 0.5) / [SIDE[1], SIDE[0]]


def _naive(uv, triangle, lightmap, threshold: float, colour_threshold: float, maximum: float, active) -> list:
    """The groups with their representatives, from eq. 1 on, but for the samples, which have a test of their own."""
    at = uv * [SIDE[1], SIDE[0]] - 0.5
    corners = at[triangle]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    level = np.array([next(k for k, n in enumerate(SIZES) if n >= np.ceil(r)) for r in longest], np.int32)
    texels = np.zeros((*SIDE, 4), np.uint16)
    texels[..., :3] = np.rint(np.clip(lightmap.astype(float) / maximum, 0, 1) * 65535)
    samples, _, _ = kernels.sample(texels, np.rint(corners * 65536).astype(np.int64), level, "cpu")
    packed = samples.numpy()
    colours = np.stack([packed & 255, packed >> 8 & 255, packed >> 16], -1)
    patches = np.split(colours, np.cumsum(kernels.samples_of(np.array(SIZES)[level]))[:-1])
    patches = [patch[:3] if (patch == patch[0]).all() else patch for patch in patches]
    edges = np.zeros((len(triangle),) * 2, bool)
    among = np.flatnonzero(active)
    edges[np.ix_(among, among)] = reference.adjacency([patches[t] for t in among], threshold, colour_threshold)
    return patches, edges, reference.greedy(edges)


def _sound(clusters: Clusters, count: int) -> None:
    """Checks invariants of any result."""
    groups = len(clusters.representative)
    for values in (clusters.group, clusters.order, clusters.distance, clusters.excluded):
        assert values.shape == (count,)
    assert sorted(set(clusters.group.tolist())) == list(range(groups))
    np.testing.assert_array_equal(clusters.group[clusters.representative], np.arange(groups))
    np.testing.assert_array_equal(clusters.order[clusters.representative], 0)
    np.testing.assert_array_equal(clusters.distance[clusters.representative], 0)
    sizes = np.bincount(clusters.group, minlength=groups)
    assert (sizes[clusters.group[clusters.excluded]] == 1).all()


@pytest.mark.parametrize(("threshold", "colour_threshold"), [(0.03, 0.09), (0.01, 0.09), (0.05, 2.0), (0.05, 0.0)])
def test_against_naive(device: str, threshold: float, colour_threshold: float):
    """The same groups, representatives, edges, orders and distances."""
    count = 50
    (uv, triangle), lightmap = _mesh(count), _lightmap()
    active = np.arange(count) % 7 != 0
    reports = []
    clusters = cluster(
        uv,
        triangle,
        lightmap,
        threshold=threshold,
        colour_threshold=colour_threshold,
        active=active,
        patch_size=65,
        device=device,
        progress=reports.append,
    )
    patches, edges, groups = _naive(uv, triangle, lightmap, threshold, colour_threshold, 2.0, active)
    _sound(clusters, count)
    assert edges.sum() // 2 > 5
    members = [np.flatnonzero(clusters.group == group).tolist() for group in range(len(clusters.representative))]
    assert list(zip(clusters.representative.tolist(), members, strict=True)) == groups
    np.testing.assert_array_equal(clusters.excluded, ~active)
    for t in range(count):
        expected = reference.distances(patches[clusters.representative[clusters.group[t]]], patches[t])
        assert clusters.distance[t] == pytest.approx(expected.min(), abs=1e-12)
        assert clusters.order[t] == int((expected < expected.min() + 1e-12).argmax())
    assert [report.stage for report in reports] == ["compare patches", "cluster"]
    assert all(report.done == report.total == active.sum() for report in reports)


def test_many_triangles_are_grouped_by_samples(device: str, monkeypatch: pytest.MonkeyPatch):
    """Each is like its representative, no two representatives are alike, and there are few more of them."""
    count = 100
    (uv, triangle), lightmap = _mesh(count), _lightmap()
    exact = cluster(uv, triangle, lightmap, patch_size=65, device=device)
    monkeypatch.setattr(clustering, "SAMPLE", 20)
    reports = []
    clusters = cluster(uv, triangle, lightmap, patch_size=65, device=device, progress=reports.append)
    _sound(clusters, count)
    assert clusters.distance.max() < 0.03
    patches, edges, _ = _naive(uv, triangle, lightmap, 0.03, 0.09, 2.0, np.ones(count, bool))
    assert not edges[np.ix_(clusters.representative, clusters.representative)].any()
    assert len(clusters.representative) <= 1.2 * len(exact.representative) < 0.8 * count
    assert {report.stage for report in reports} == {"compare patches", "cluster"}
    assert reports[-1].done == reports[-1].total == count


def test_permuted_copies(device: str):
    """Vertex k of a copy goes to vertex p[k] of the representative: where its twin is, whatever the order."""
    lightmap = np.zeros((*SIDE, 3), np.float32)
    lightmap[:24, :32] = np.random.default_rng(0).random((24, 32, 3))
    lightmap[24:, 32:] = lightmap[:24, :32]
    corners = np.array([[3.0, 4.0], [15.0, 5.0], [6.0, 17.0]])
    uv = [_uv(corners)]
    for p in ORDERS:
        copy = np.empty_like(corners)
        for k in range(3):
            copy[k] = corners[p[k]] + [32, 24]
        uv.append(_uv(copy))
    clusters = cluster(np.concatenate(uv), np.arange(21).reshape(-1, 3), lightmap, threshold=0.001, device=device)
    _sound(clusters, 7)
    assert clusters.representative.tolist() == [0]
    assert [ORDERS[o] for o in clusters.order[1:]] == list(ORDERS)
    np.testing.assert_array_equal(clusters.distance, 0)


@pytest.mark.parametrize(("count", "active"), [(0, True), (1, True), (5, False)])
def test_no_triangle_and_one_and_none_that_is_active(device: str, count: int, active: bool):
    clusters = cluster(*_mesh(count), _lightmap(), active=np.full(count, active), device=device)
    _sound(clusters, count)
    assert clusters.representative.tolist() == list(range(count)) and (clusters.excluded != active).all()


@pytest.mark.parametrize("colour", [-5.0, 0.3, 2.0])
def test_one_colour(device: str, colour: float):
    """All are alike: one group, of the first; negative radiance is black."""
    count, lightmap = 500, np.full((*SIDE, 3), colour)
    lightmap[:, 32:] = max(colour, 0.0)
    clusters = cluster(*_mesh(count, longest=20), lightmap, device=device)
    _sound(clusters, count)
    assert clusters.representative.tolist() == [0] and clusters.distance.max() == 0


def test_degenerate_triangles(device: str):
    """A point, a line and less than a texel are patches like any other, where their colour is."""
    lightmap = np.zeros((*SIDE, 3), np.float32)
    lightmap[:, 32:] = 1.0
    shapes = np.array([[[0, 0], [0, 0], [0, 0]], [[0, 0], [4, 4], [8, 8]], [[0, 0], [0.2, 0], [0, 0.3]]])
    uv = _uv(np.concatenate([shapes + 10.0, shapes + 40.0]))
    clusters = cluster(uv, np.arange(18).reshape(-1, 3), lightmap, device=device)
    _sound(clusters, 6)
    assert clusters.group.tolist() == [0, 0, 0, 1, 1, 1]


def test_outside_is_the_border(device: str):
    """UVs outside [0, 1] read the outermost texels."""
    lightmap = np.zeros((*SIDE, 3), np.float32)
    lightmap[:, -1] = 0.5
    uv = np.array([[1.5, 0.2], [1.6, 0.2], [1.5, 0.4], [-3.0, 0.2], [-2.0, 0.2], [-3.0, 0.4]])
    uv = np.concatenate([uv, _uv([[63, 3], [63, 9], [63, 5]]), _uv([[2, 3], [3, 9], [4, 5]])])
    clusters = cluster(uv, np.arange(12).reshape(-1, 3), lightmap, device=device)
    assert clusters.group.tolist() == [0, 1, 0, 1]


def test_bright_triangles(device: str):
    """Radiance of exactly 2 takes part; above it, in any channel that a sample reads, the triangle stays alone."""
    lightmap = np.full((*SIDE, 3), 2.0, np.float32)
    lightmap[10, 20, 1] = np.nextafter(np.float32(2), np.float32(3))
    away, on, beside = ([[x, 10], [x + 2, 10], [x, 12]] for x in (40, 20, 21))
    clusters = cluster(_uv([away, on, beside, away]), np.arange(12).reshape(-1, 3), lightmap, device=device)
    _sound(clusters, 4)
    assert clusters.excluded.tolist() == [False, True, False, False]
    assert clusters.group.tolist() == [0, 1, 0, 0]
    clusters = cluster(_uv([away, on]), np.arange(6).reshape(-1, 3), lightmap, max_radiance=2.1, device=device)
    assert not clusters.excluded.any()


@pytest.mark.parametrize("patch_size", [17, None])
def test_stripes_in_a_large_triangle(device: str, patch_size: int | None):
    """Stripes of 15 texels in a triangle of 480 are 1/4 away from one of their colours; 17 samples miss one."""
    lightmap = np.full((512, 1024, 3), 1.5, np.float32)
    lightmap[:, :512] = np.where(np.arange(512) // 15 % 2, 0.5, 1.5)[None, :, None]
    corners = np.array([[8.0, 8], [488, 8], [8, 488]])
    uv = (np.concatenate([corners, corners + [512, 0]]) + 0.5) / [1024, 512]
    arguments = uv, np.arange(6).reshape(2, 3), lightmap
    clusters = cluster(*arguments, threshold=0.5, colour_threshold=2.0, patch_size=patch_size, device=device)
    y, x = np.mgrid[8:489, 8:489]
    inside = (x + y <= 496)[..., None]
    true = (np.abs(lightmap[8:489, 8:489] - 1.5) / 2.0).mean(where=inside, dtype=np.float64)
    assert true == pytest.approx(0.25, abs=1e-3)
    assert (abs(clusters.distance.max() - true) < 0.1 * true) == (patch_size is None)
    alone = cluster(*arguments, colour_threshold=2.0, device=device)
    assert alone.representative.tolist() == [0, 1]


def test_a_few_bright_texels_of_a_large_triangle(device: str):
    """Four texels in a row that no sample reads exclude the triangle that contains them, and no other."""
    lightmap = np.zeros((512, 512, 3), np.float32)
    lightmap[103, 210:214] = 5.0
    inside, outside = ([[8, 8], [488, 8], [8, 488]], [[488, 488], [488, 15], [15, 488]])
    uv = (np.array([inside, outside], float).reshape(-1, 2) + 0.5) / 512
    for turned in ([0, 1, 2], [2, 1, 0]):
        clusters = cluster(uv, np.array([turned, [3, 4, 5]]), lightmap, patch_size=17, device=device)
        assert clusters.excluded.tolist() == [True, False]


def test_too_many_samples():
    """Slivers as long as a lightmap have R_s^2 / 2 samples each: refused in one line beyond 2^31."""
    uv = np.tile([[0.0, 0.0], [1.0, 1.0], [1.0, 0.999]], (300, 1))
    with pytest.raises(WlmError, match="patch_size: expected fewer than 2"):
        cluster(uv, np.arange(900).reshape(-1, 3), np.zeros((4096, 4096, 3), np.float32))


@pytest.mark.slow
def test_many_triangles_of_one_colour():
    """132,000 triangles, all alike, with patches of 65: within 8 GB."""
    import resource

    count = 132_000
    clusters = cluster(*_mesh(count, longest=64), np.full((*SIDE, 3), 0.25, np.float32), patch_size=65)
    assert len(clusters.representative) == 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 8e6  # KiB


def test_welded():
    """One place and one UV is one corner; -0 is 0; another place or another UV is another corner."""
    position = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 0, 0], [0, 0, 1]])
    uv = np.array([[0, 0], [1, 0], [0, 1], [0, -0.0], [0.5, 0], [0, 0]])
    corner = welded(position, uv, np.array([[0, 1, 2], [3, 4, 5]]))
    assert corner.dtype == np.int32 and corner.shape == (2, 3)
    assert corner[0, 0] == corner[1, 0]
    assert len(np.unique(corner)) == 5


STRIP = [[0, 1, 2], [2, 1, 3], [2, 3, 4]]
CHARTS = {
    "two that touch by a corner, one that shares an edge turned over": (
        [[4, 5, 6], [0, 1, 2], [2, 1, 3], [3, 7, 8], [5, 4, 9]],
        None,
        [0, 1, 1, 2, 0],
    ),
    "strip": (STRIP, None, [0, 0, 0]),
    "a bridge that takes no part": (STRIP, [True, False, True], [0, -1, 1]),
    "none takes part": (STRIP, [False] * 3, [-1] * 3),
    "three at an edge, and one twice": ([[0, 1, 2], [0, 1, 3], [1, 0, 4], [0, 1, 2]], None, [0, 0, 0, 0]),
    "one": ([[7, 8, 9]], None, [0]),
    "none": (np.zeros((0, 3), np.int32), None, []),
}


@pytest.mark.parametrize("case", CHARTS)
def test_charts(case: str):
    corner, active, expected = CHARTS[case]
    np.testing.assert_array_equal(charts(np.array(corner), active and np.array(active)), expected)
