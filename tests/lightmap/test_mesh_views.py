"""Views of a set's mesh: the shown error, by hand, and meshes that can't be drawn."""

import dataclasses
import json
import math

import numpy as np
import pytest
from builders.checks import error_of
from builders.small_sets import moving_light, tiny_profile

from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.formats.geometry import Geometry
from wlm.lightmap.data import from_arrays, load
from wlm.lightmap.evaluation import evaluate
from wlm.lightmap.fit import compress
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.view_scores import NO_VIEWS, Views, views_of

UPWARD = """v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
vt 0 1
vt 1 1
vt 1 0
vt 0 0
f 4/4 3/3 2/2 1/1
"""
"""A floor, seen from above alone."""


def floor() -> Geometry:
    position = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Geometry(position, np.array([[3, 2, 1], [3, 1, 0]], np.uint32), uv)


def grey(level=0.5, times=(6.0, 12.0, 18.0)):
    return from_arrays(np.full((len(times), 8, 8, 3), level), times, period=24.0, name="grey").light


def shown(light: float) -> float:
    """Light on the display: an exposure that takes 0.5 to 0.8, Reinhard's curve, sRGB."""
    x = 1.6 * light
    x = x * (1.0 + x / 16.0) / (1.0 + x)
    return 1.055 * x ** (1 / 2.4) - 0.055


def test_the_error_is_that_of_the_display():
    day = grey()
    views = Views(day, floor(), 8)
    decoded = [day.frames[0], 0.5 * day.frames[1], day.frames[2]]
    for i in range(3):
        views.add(i, day.frames[i], decoded[i])
    score = views.score()
    # Cameras 0 to 3 of 8 look from above, 1 of them at 12 h.
    assert score.views == 4
    off = shown(0.5) - shown(0.25)
    worst = score.worst_view
    assert worst["view"] == 1 and worst["time"] == 12.0 and 0.0 < score.view_flip < worst["flip"] < 1.0
    assert worst["psnr"] == pytest.approx(-20.0 * math.log10(off), abs=1e-3)
    # One of four views of about equal areas.
    assert score.view_psnr == pytest.approx(-10.0 * math.log10(off**2 / 4.0), abs=1.5)
    right = Views(day, floor(), 8)
    for i in range(3):
        right.add(i, day.frames[i], day.frames[i])
    assert (right.score().view_psnr, right.score().view_flip) == (120.0, 0.0)


def test_all_times_take_turns_and_views_from_behind_show_nothing():
    day = grey()
    views = Views(day, floor(), 2, indices=[2])
    views.add(2, day.frames[2], 0.5 * day.frames[2])
    assert views.score().views == 1 and views.score().worst_view["time"] == 18.0
    below = Views(day, dataclasses.replace(floor(), triangle=floor().triangle[:, ::-1].copy()), 1)
    for i in range(3):
        below.add(i, day.frames[i], day.frames[i])
    assert below.score() == NO_VIEWS
    with pytest.raises(WlmError, match="expected a mesh with a size"):
        Views(day, dataclasses.replace(floor(), position=np.zeros((4, 3), np.float32)), 1)


def with_mesh(day, path):
    return dataclasses.replace(day, sheets={LIGHT: dataclasses.replace(day.light, mesh=path)})


def test_a_set_that_names_its_mesh_has_views_in_its_report(tmp_path):
    day = moving_light(hours=(0.0, 12.0))
    model = compress(day, tiny_profile(steps=20))
    named = with_mesh(day, tmp_path / "floor.obj")
    (tmp_path / "floor.obj").write_text(UPWARD)
    report = evaluate(model, named, metrics=("seen",), views=4)
    light = report.light
    assert light.views == 2 and 5.0 < light.view_psnr < 60.0 and 0.0 < light.view_flip < 1.0
    assert light.worst_view["psnr"] <= light.view_psnr and not any("views" in line for line in report.warnings)
    assert report.to_json()["sheets"][0]["worst_view"]["time"] in (0.0, 12.0)
    assert evaluate(model, named, metrics=("seen",), views=0).light.views == 0
    assert views_of(day.light, 4) == (None, [])
    (tmp_path / "empty.obj").write_text("v 0 0 0")
    for name, says in (("empty.obj", "expected triangles"), ("absent.obj", "absent.obj")):
        named = with_mesh(day, tmp_path / name)
        report = evaluate(model, named, metrics=("seen",), views=4)
        light = report.light
        assert light.views == 0 and math.isnan(light.view_psnr) and light.worst_view is None
        assert report.warnings[0].startswith("moving: no views are scored: ") and says in report.warnings[0]


def test_the_mesh_of_a_set_lies_in_its_folder(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32))
    content = {"width": 4, "height": 4, "lightmaps": [{"time_hours": 1, "file": "a.exr"}]}

    def stored(**more):
        (tmp_path / "set.json").write_text(json.dumps(content | more))
        return tmp_path

    assert load(stored()).light.mesh is None and load(stored(mesh=None)).light.mesh is None
    # It need not be there: evaluate alone reads it.
    assert load(stored(mesh="scene.glb")).light.mesh == tmp_path / "scene.glb"
    assert "mesh: expected a file within" in error_of(load, stored(mesh="../scene.glb"))
    assert load(stored(mesh="../scene.glb"), trust=True).light.mesh == tmp_path / "../scene.glb"
    assert "mesh: expected the name of a mesh, got 3" in error_of(load, stored(mesh=3))
