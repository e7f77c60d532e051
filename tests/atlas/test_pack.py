"""Packing: rigid charts, texels of their own, corners in their order, and the lightmap under the new UVs."""

import re
import sys

import numpy as np
import pytest
from builders.atlas_models import grouped
from builders.checks import error_of

from wlm.atlas.cascade import pack as packing
from wlm.atlas.cascade.pack import Packed
from wlm.atlas.data import LightmappedScene, from_arrays
from wlm.atlas.fit import compress
from wlm.errors import WlmError
from wlm_kernels.atlas.patches import ORDERS

pytest.importorskip("uvunwrap")

SIZE = (40, 64)  # H, W


def pack(scene: LightmappedScene, *rest) -> Packed:
    return packing.pack(scene.sheets[0], *rest)


def regenerate(scene: LightmappedScene, *rest) -> tuple[np.ndarray, np.ndarray]:
    return packing.regenerate(scene.sheets[0], *rest)


def _mesh(triangles: list, lightmap: np.ndarray | None = None, position: np.ndarray | None = None) -> LightmappedScene:
    """A mesh of triangles given by their corners in texels; corners at one place of one sheet are one."""
    flat = np.array(triangles, np.float64).reshape(-1, 2)
    uv, index = np.unique(flat, axis=0, return_inverse=True)
    place = np.concatenate([uv, np.zeros((len(uv), 1))], 1)
    triangle = index.reshape(-1, 3)
    if position is not None:
        uv, triangle, place = flat, np.arange(len(flat)).reshape(-1, 3), position
    if lightmap is None:
        lightmap = np.random.default_rng(0).uniform(0.1, 1.0, (*SIZE, 3)).astype(np.float32)
    height, width = lightmap.shape[:2]
    return from_arrays(place, triangle, uv / [width, height], lightmap)


def _quad(x: float, y: float, w: float, h: float) -> list:
    a, b, c, d = [x, y], [x + w, y], [x + w, y + h], [x, y + h]
    return [[a, b, c], [a, c, d]]


def _edges(corner: np.ndarray) -> np.ndarray:
    return np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1)


def _texels(mesh: LightmappedScene) -> np.ndarray:
    return (mesh.sheets[0].uv * mesh.sheets[0].mask.shape[::-1])[mesh.sheets[0].triangle]


def _read_by(packed: Packed) -> dict[tuple[int, int], set[int]]:
    """The charts that read each texel, by bilinear reads at many points of each triangle."""
    random, out = np.random.default_rng(1), {}
    weights = random.dirichlet([0.5, 0.5, 0.5], 300)
    weights = np.concatenate([weights, np.eye(3)])
    for t in np.flatnonzero(packed.source == np.arange(len(packed.source))):
        low = np.floor(weights @ packed.corner[t] - 0.5).astype(int)
        for x, y in np.unique((low[:, None] + [[0, 0], [1, 0], [0, 1], [1, 1]]).reshape(-1, 2), axis=0):
            out.setdefault((int(x), int(y)), set()).add(int(packed.chart[t]))
    return out


def _many(seed: int) -> list:
    """Triangles of all sizes with gaps between, some wound the other way, and strips of several."""
    random, out = np.random.default_rng(seed), []
    for y in range(0, 40, 10):
        for x in range(0, 60, 10):
            corner = np.array([x, y]) + random.uniform(0.0, 9.0, (4, 2)) * random.choice([0.05, 0.5, 1.0])
            kind = random.integers(3)
            out.append(corner[[0, 2, 1]] if kind == 0 else corner[:3])
            if kind == 2:
                out.append(np.stack([corner[1], corner[0], corner[0] + corner[1] - corner[2]]).clip(0, 63))
    return out


@pytest.mark.parametrize(("scale", "few"), [(0.5, 3), (1.0, 4096), (0.3, 4096)])
def test_rigid_and_apart(scale: float, few: int, monkeypatch: pytest.MonkeyPatch):
    """Edges keep their length, no chart is mirrored, no texel is read by two charts, all is in the atlas; also of more
    than a few charts, which are packed by their boxes."""
    monkeypatch.setattr(packing, "_FEW", few)
    mesh = _mesh(_many(2))
    packed = pack(mesh, None, scale)
    active = mesh.sheets[0].active
    np.testing.assert_allclose(_edges(packed.corner)[active], scale * _edges(_texels(mesh))[active], atol=1e-4)
    area = packing._signed_area
    np.testing.assert_allclose(area(packed.corner)[active], scale**2 * area(_texels(mesh))[active], atol=1e-3)
    readers = _read_by(packed)
    assert max(len(charts) for charts in readers.values()) == 1
    assert len(np.unique(packed.chart[active])) > 10
    x, y = np.array(list(readers)).T
    assert x.min() >= 0 and x.max() < packed.width and y.min() >= 0 and y.max() < packed.height
    np.testing.assert_allclose(packed.uv * [packed.width, packed.height], packed.corner, atol=1e-3)
    chart = packed.chart[active][:, None]
    moved = packed.rotation[chart] * packing._complex(_texels(mesh)[active]) + packed.shift[chart]
    np.testing.assert_allclose(packing._real(moved), packed.corner[active], atol=1e-6)


def test_charts_stay_whole():
    """Neighbours keep their shared edge, to the bit; charts that only touch don't."""
    left, right = _quad(5, 5, 8, 6), _quad(13, 5, 8, 6)
    triangles = np.array(left + right)
    position = np.concatenate([triangles, np.repeat([0, 0, 1, 1], 3).reshape(4, 3, 1)], 2).reshape(-1, 3)
    packed = pack(_mesh(triangles, position=position), None, 1.0)
    np.testing.assert_array_equal(packed.chart[:2], packed.chart[0])
    assert packed.chart[0] != packed.chart[2]
    np.testing.assert_array_equal(packed.corner[0, [0, 2]], packed.corner[1, [0, 1]])
    assert np.abs(packed.corner[0, 1] - packed.corner[2, 0]).max() > 1.0
    assert max(len(charts) for charts in _read_by(packed).values()) == 1


@pytest.mark.parametrize("order", [0, 1, 3])
def test_members_take_their_representatives_corners(order: int):
    """Vertex k goes to vertex p[k]; the member's own texels are gone, and so is its chart."""
    triangles = [[[2, 2], [20, 3], [4, 15]], [[30, 2], [50, 3], [32, 15]], [[2, 20], [30, 22], [4, 38]]]
    mesh = _mesh(triangles)
    packed = pack(mesh, grouped([2, 1, 2], [order, 0, 0]), 0.5)
    np.testing.assert_array_equal(packed.source, [2, 1, 2])
    assert packed.chart[0] == packed.chart[2] != packed.chart[1] and len(packed.rotation) == 2
    for k in range(3):
        np.testing.assert_array_equal(packed.uv[0, k], packed.uv[2, ORDERS[order][k]])
    alone = pack(mesh, None, 0.5)
    assert packed.width * packed.height < alone.width * alone.height


def test_neighbours_of_which_one_is_a_member():
    """A chart of which a triangle went elsewhere keeps the rest; split in the middle it is two."""
    strip = [_quad(4 + 8 * i, 5, 8, 8) for i in range(3)]
    mesh = _mesh(sum(strip, []))
    assert len(pack(mesh, None, 1.0).rotation) == 1
    split = pack(mesh, grouped([0, 1, 0, 1, 4, 5]), 1.0)
    assert len(split.rotation) == 2
    np.testing.assert_array_equal(split.corner[[2, 3]], split.corner[[0, 1]])


def test_what_is_not_active():
    """It has no texels; it reads one place that a neighbour reads, or the first."""
    triangles = [*_quad(5, 5, 8, 6), [[5, 5], [9, 5], [13, 5]], [[30, 30], [31, 31], [32, 32]]]
    mesh = _mesh(triangles)
    np.testing.assert_array_equal(mesh.sheets[0].active, [True, True, False, False])
    packed = pack(mesh, None, 1.0)
    np.testing.assert_array_equal(packed.source, [0, 1, -1, -1])
    assert (packed.uv[2] == packed.uv[2, 0]).all() and (packed.uv[3] == 0).all()
    assert (packed.uv[2, 0] == packed.uv[:2].reshape(-1, 2)).all(1).any()


def test_one_triangle_and_a_smaller_one_than_a_texel():
    for size in (20.0, 0.3, 1e-3):
        mesh = _mesh([[[8.2, 8.3], [8.2 + size, 8.3], [8.2, 8.3 + size]]])
        packed = pack(mesh, None, 0.5)
        np.testing.assert_allclose(_edges(packed.corner), 0.5 * _edges(_texels(mesh)), atol=1e-5)
        lightmap, mask = regenerate(mesh, packed)
        assert lightmap.shape == (packed.height, packed.width, 3) and mask.any()
        assert packed.width <= np.ceil(0.75 * size) + 3


def test_thin_triangles_get_a_place(monkeypatch: pytest.MonkeyPatch):
    """Thinner than the packer takes: alone, and at a chart's border."""
    asked, thickened = [], packing._thickened
    monkeypatch.setattr(packing, "_thickened", lambda *args: asked.append(len(args[0])) or thickened(*args))
    thin = [[[2, 2], [60, 2.0005], [30, 2.0002]], [[2, 6], [60, 6], [30, 6.0001]], [[5, 30], [25, 30], [15, 29.99999]]]
    mesh = _mesh([*thin, *_quad(5, 30, 20, 8)])
    assert mesh.sheets[0].active.all()
    packed = pack(mesh, None, 0.5)
    assert sum(asked) >= 1
    np.testing.assert_allclose(_edges(packed.corner), 0.5 * _edges(_texels(mesh)), atol=1e-4)
    assert max(len(charts) for charts in _read_by(packed).values()) == 1


def test_folded_and_doubled():
    """Triangles over each other under the old UVs have texels of their own under the new ones."""
    fold = [[[4, 4], [24, 4], [14, 16]], [[4, 4], [24, 4], [14, 10]], [[4, 4], [24, 4], [14, 16]]]
    packed = pack(_mesh(fold), None, 1.0)
    assert len(np.unique(packed.chart)) == 3
    assert max(len(charts) for charts in _read_by(packed).values()) == 1


def test_regenerated_colours():
    """A lightmap that is linear in x and y is the same under the new UVs, up to the charts' borders and beyond."""
    y, x = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5, indexing="ij")
    lightmap = np.stack([x, y, x + 2 * y], -1).astype(np.float32) / 100
    (own,) = _mesh(_many(4)).sheets
    mesh = from_arrays(own.position, own.triangle, own.uv, lightmap, np.ones(SIZE, bool))
    packed = pack(mesh, None, 0.7)
    rendered, mask = regenerate(mesh, packed)
    readers = _read_by(packed)
    assert all(mask[y, x] for x, y in readers), "every texel that a bilinear read meets is filled"
    assert not rendered[~mask].any() and not mask.all()
    for (column, row), charts in list(readers.items())[::7]:
        chart = charts.pop()
        at = (complex(column + 0.5, row + 0.5) - packed.shift[chart]) / packed.rotation[chart]
        px, py = packing._real(at).clip(0.5, np.array(SIZE[::-1]) - 0.5)
        np.testing.assert_allclose(rendered[row, column], np.array([px, py, px + 2 * py]) / 100, atol=1e-5)


def test_the_packer_is_missing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "uvunwrap", None)
    mesh = _mesh(_quad(5, 5, 8, 6))
    line = r"atlas: uvunwrap is missing; needs the extra: pip install 'wlm\[atlas\]'"
    assert re.search(line, error_of(pack, mesh, None, 0.5))
    begun = []
    assert re.search(line, error_of(compress, mesh, "cascade", progress=begun.append))
    assert not begun


def test_a_packer_that_fails(monkeypatch: pytest.MonkeyPatch):
    """It says so, or leaves a triangle out twice."""
    import uvunwrap

    monkeypatch.setattr(packing, "_thickened", lambda points, height: points)
    with pytest.raises(WlmError, match="array: the UV packer uvunwrap left out 1 triangles"):
        pack(_mesh([[[2, 2], [60, 2.0005], [30, 2.0002]]]), None, 0.5)

    def fails(*args, **options):
        raise uvunwrap.UnwrapError("no room")

    monkeypatch.setattr(uvunwrap, "generate", fails)
    assert "array: the UV packer uvunwrap failed: no room" in error_of(pack, _mesh(_quad(5, 5, 8, 6)), None, 0.5)


def test_too_large():
    mesh = _mesh(_quad(5, 5, 50, 30))
    assert re.search("array: scale: too large: .* expected at most 16384 a side", error_of(pack, mesh, None, 400.0))
