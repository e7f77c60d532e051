"""Which mesh of a scene a lightmap belongs to, which way up, and texels that are no light."""

import math

import numpy as np
import pytest
from builders.checks import error_of
from builders.gltf_scene import Thing, box, write_scene

from wlm.atlas import matching
from wlm.atlas.data import from_arrays, load
from wlm.atlas.evaluation import compare
from wlm.formats.exr import write_exr

SIDE = 96


def baked(uv: np.ndarray, dilated: bool = False) -> np.ndarray:
    """A smooth light in each of a box's charts, by UV; the gaps are black, or hold the nearest."""
    mesh = from_arrays(*box((0, 0, 0), (1, 1, 1))[:2], uv, np.ones((SIDE, SIDE, 3)))
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    level = 1.0 + np.floor(3 * column) + 3 * np.floor(2 * row)  # of the chart's cell
    light = (level * (1.0 + 0.2 * np.sin(9 * column) * np.cos(7 * row)))[..., None] * [1.0, 0.8, 0.6]
    return light if dilated else light * mesh.sheets[0].mask[..., None]


def shifted(uv: np.ndarray) -> np.ndarray:
    """Another layout of the charts."""
    return 0.5 * uv + [0.31, 0.17]


def test_a_lightmap_goes_to_the_mesh_that_it_fits(tmp_path):
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    things = [Thing("crate", position, triangle, [uv]), Thing("lamp", position, triangle, [shifted(uv)], (3, 0, 0))]
    scene = write_scene(tmp_path / "a.gltf", things)
    write_exr(tmp_path / "a.exr", baked(uv))
    mesh = load(scene, tmp_path / "a.exr")
    assert [part.primitive.label for part in mesh.sheets[0].parts] == ["crate"]
    assert mesh.warnings == (
        "a: 2 meshes lie on each other in TEXCOORD_0: the lightmap fits crate best; the others are left out",
    )
    for name in ("lamp", "lamp-mesh", "1"):
        assert [part.primitive.node for part in load(scene, tmp_path / "a.exr", node=name).sheets[0].parts] == [1]
    assert "node: expected one of crate, lamp, found 'wall'" in error_of(load, scene, tmp_path / "a.exr", node="wall")
    write_exr(tmp_path / "grey.exr", np.ones((SIDE, SIDE, 3)))
    assert "fits none clearly better: expected the name of one as the node (--node): crate, lamp" in error_of(
        load, scene, tmp_path / "grey.exr"
    )
    # Side by side in one atlas they share it, and so does a second node with the same mesh.
    side = [Thing("a", position, triangle, [uv * [0.5, 1]]), Thing("b", position, triangle, [uv * [0.5, 1] + [0.5, 0]])]
    write_scene(scene, [*side, Thing("c", like=0)])
    assert len(load(scene, tmp_path / "grey.exr").sheets[0].parts) == 3


@pytest.mark.parametrize("band", [None, 8])
def test_an_upside_down_lightmap_is_noticed(tmp_path, monkeypatch, band):
    """By all of its texels, and as a large one by bands of rows."""
    if band is not None:
        monkeypatch.setattr(matching, "_LOOKED_AT", 0)
        monkeypatch.setattr(matching, "_BAND", band)
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    uv = shifted(uv)
    light = baked(uv)
    scene = write_scene(tmp_path / "a.gltf", [Thing("a", position, triangle, [uv])])
    for flip in (False, True):
        write_exr(tmp_path / "a.exr", light[:: -1 if flip else 1])
        warnings = load(scene, tmp_path / "a.exr").warnings
        assert any("better upside down: see flip (--flip)" in line for line in warnings) == flip
        (sheet,) = load(scene, tmp_path / "a.exr", flip=flip).sheets
        np.testing.assert_allclose(sheet.lightmap[sheet.mask], light[sheet.mask], rtol=1e-3)


def test_strays_in_gutters_change_nothing():
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv, dilated=True)
    clean = from_arrays(position, triangle, uv, light)
    inside = from_arrays(position, triangle, uv, baked(uv)).sheets[0].mask  # charts without their fringe
    gap = np.argwhere(~inside)
    for value in (math.inf, 65024.0, math.nan):
        dirty = light.copy()
        dirty[tuple(gap[::5].T)] = value
        mesh = from_arrays(position, triangle, uv, dirty)
        np.testing.assert_array_equal(mesh.sheets[0].lightmap[inside], clean.sheets[0].lightmap[inside])
        assert mesh.sheets[0].lightmap.max() <= clean.sheets[0].lightmap.max() and mesh.warnings == ()


def test_specks_in_a_chart_are_replaced_and_lamps_are_not():
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv)
    light[20, 10:14] = 60000.0  # thin
    light[60:63, 12:15] = 500.0  # a lamp
    mesh = from_arrays(position, triangle, uv, light)
    assert mesh.sheets[0].lightmap[20, 10:14].max() < 8.0 and mesh.sheets[0].lightmap[61, 13].min() == 500.0
    assert mesh.warnings == ("array: lightmap: 4 texels in specks far above all other light: replaced",)


def test_the_peak_is_not_one_bright_texel():
    """It is said, beside the brightest; as long as the brightest is below twice nearly all, it is the range."""
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv, dilated=True)
    plain = from_arrays(position, triangle, uv, light)
    light[70, 80] *= 12.0
    lit = from_arrays(position, triangle, uv, light)
    black = {"black": lambda points, state: points.uv.new_zeros((len(points.uv), 3))}
    first, second = (compare(mesh, black, views=8, resolution=64)["black"] for mesh in (plain, lit))
    darkest = plain.sheets[0].lightmap.min()
    assert first.brightest < 8.0 and first.peak == pytest.approx(first.brightest - darkest, rel=0.05)
    assert second.brightest > 30.0 and second.peak < 16.0
