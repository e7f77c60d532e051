"""The window: every kind of file has a picture that follows its controls, and what has none is said in one line."""

import re
import sys

import numpy as np
import pytest
from builders import atlas_meshes, atlas_models, day_scenes, probe_models, probe_sets, rooms, small_sets
from builders.checks import error_of
from builders.contract import FILES
from PIL import Image
from typer.testing import CliRunner

import wlm
from wlm.cli.app import app
from wlm.errors import WlmError
from wlm.formats.gltf import document_from_meshes
from wlm.formats.gltf_writer import write_glb
from wlm.probe.data import save_probes
from wlm.probe.sphere import basis
from wlm.view import rendering
from wlm.view.display import Display, heat
from wlm.view.opening import open_scene
from wlm.view.scene_window import day_scene
from wlm.view.window import Window

SIZE = (480, 300)
STRIP = 108


@pytest.fixture
def show():
    """Opens files in a window that is never shown."""
    pytest.importorskip("pyvista")
    try:
        rendering.require_opengl()
    except WlmError as error:
        pytest.skip(str(error))
    windows = []

    def opened(file, **options):
        windows.append(Window(open_scene(file, **options), size=SIZE))
        return windows[-1]

    yield opened
    for window in windows:
        window.close()


def scene_of(window) -> np.ndarray:
    """The panels without the strip of controls, int [H, W, 3]."""
    return window.picture()[:-STRIP].astype(int)


def changed(window, before: np.ndarray) -> bool:
    return np.abs(scene_of(window) - before).max() > 12


def label(window, name: str) -> str:
    """Returns the text beside a slider."""
    return window._widgets[name][1].GetInput()


def caption(window) -> str:
    return window._texts["caption"].GetInput()


def drag(window, name: str, value: float) -> None:
    """Moves a slider as a mouse does."""
    widget = window._widgets[name][0]
    widget.GetRepresentation().SetValue(value)
    widget.InvokeEvent("InteractionEvent")


@pytest.fixture(scope="module")
def lightmaps(tmp_path_factory):
    """A model of two dynamic tiles, a constant and an empty one as `four.wlm`; its set; a quad with lightmap UVs."""
    folder = tmp_path_factory.mktemp("lightmaps")
    given = small_sets.four_tiles()
    wlm.lightmap.compress(given, small_sets.tiny_profile(steps=20)).save(folder / "four.wlm")
    small_sets.write_set(folder / "set", given)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    document, _ = document_from_meshes([("quad", corners, np.array([[0, 1, 2], [0, 2, 3]]), uv)], "quad")
    write_glb(folder / "quad.glb", document, [], 0)
    return folder


def test_lightmaps_follow_the_hour_the_exposure_and_the_tone(lightmaps, show):
    window = show(lightmaps / "four.wlm")
    assert set(window.sliders) == {"hour", "exposure"}
    before = scene_of(window)
    assert np.ptp(before) > 100
    drag(window, "hour", 18.5)
    assert window.state.values["hour"] == 18.5 and changed(window, before)
    assert label(window, "hour") == "hour 18.50 (18:30)"
    assert caption(window).startswith("view: [1 light]   2 tiles   ")
    before = scene_of(window)
    window.press("bracketright")
    assert scene_of(window).mean() > before.mean()
    before = scene_of(window)
    assert label(window, "exposure") == "exposure +0.5 EV, clamped"
    window.press("t")
    assert window.state.tone == "filmic" and changed(window, before)
    assert label(window, "exposure") == "exposure +0.5 EV, filmic"
    window.press("Right")
    assert window.state.values["hour"] == 18.75
    window.set("hour", 25.0)
    assert window.state.values["hour"] == 1.0  # the day wraps round
    window.press("space")
    assert window.playing
    window.advance(3.0)  # a quarter of the twelve seconds that a day takes
    assert window.state.values["hour"] == pytest.approx(7.0)


def test_panels_show_decoded_original_and_error(lightmaps, show):
    window = show(lightmaps / "four.wlm", original=lightmaps / "set", mesh=lightmaps / "quad.glb")
    decoded, original, error = np.split(scene_of(window)[40:], 3, axis=1)
    assert np.abs(decoded - original).max() > 5 and np.abs(error - original).max() > 100
    # The last quarter is outside the mask, where the window's colour is seen, and grey.
    flat = np.split(scene_of(show(lightmaps / "four.wlm", original=lightmaps / "set"))[40:], 3, axis=1)
    quarter = [part[part.shape[0] // 2 + 5 :, part.shape[1] // 2 + 2 :][:15, :15] for part in flat]
    assert all((part == (27, 27, 31)).all() for part in quarter[:2]) and (quarter[2] == 77).all()
    drag(window, "error", 64)
    assert np.split(scene_of(window)[40:], 3, axis=1)[2].mean() > error.mean()
    window.turn(180.0)
    turned = np.split(scene_of(window)[40:], 3, axis=1)
    assert np.abs(turned[0] - decoded).max() > 20 and np.abs(turned[1] - original).max() > 20  # one camera for all


def test_tiles_have_the_colours_of_their_kinds(lightmaps, show):
    window = show(lightmaps / "four.wlm")
    window.press("2")
    picture = scene_of(window)
    height, width = picture.shape[:2]
    places = ("dynamic", -40, -40), ("constant", -40, 40), ("empty", 40, 40)
    at = {kind: picture[height // 2 + y, width // 2 + x] for kind, x, y in places}
    assert at["dynamic"].argmax() == 0 and at["constant"].argmax() == 2
    assert np.ptp(at["empty"]) < 3
    assert "2 dynamic (orange)" in window._texts["caption"].GetInput()
    assert "--view: expected light or tiles, got balls" in error_of(window.choose, "balls")


def test_a_lightmap_is_upright_and_not_mirrored(tmp_path, show):
    light = np.zeros((64, 64, 3), np.float32)
    light[:16, :16] = [1, 0, 0]
    light[-16:, :16] = [0, 1, 0]
    profile = small_sets.tiny_profile(frames="always")
    wlm.lightmap.compress(wlm.lightmap.from_arrays(light[None], [0.0]), profile).save(tmp_path / "corner.wlm")
    picture = scene_of(show(tmp_path / "corner.wlm"))
    red, green = (np.argwhere(picture[..., channel] > 150 + picture[..., 2]).mean(0) for channel in (0, 1))
    height, width = picture.shape[:2]
    assert red[0] < height / 2 and red[1] < width / 2 and green[0] > height / 2 and green[1] < width / 2


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_atlases_of_each_method(kind, tmp_path, show):
    mesh = atlas_meshes.sheet()
    model = atlas_models.random_model(mesh, kind)
    model.save(tmp_path / "sheet.wlm")
    _, light = atlas_meshes.write_files(tmp_path, mesh)
    window = show(tmp_path / "sheet.wlm", original=light)
    decoded, original, _ = np.split(scene_of(window)[40:], 3, axis=1)
    assert np.ptp(decoded) > 100 and np.abs(decoded - original).max() > 20
    if kind == "cascade":
        assert window.scene.views == ("light",)
        return
    title = window.canvas.renderers[0].actors["title"]
    assert title.GetText(title.UpperEdge) == "decoded"
    window.choose("tiles")
    assert title.GetText(title.UpperEdge) == "tiles"
    assert np.abs(np.split(scene_of(window)[40:], 3, axis=1)[0] - decoded).max() > 20


def test_probes_as_balls_and_gaussians(tmp_path, show):
    model = probe_models.whole_model(probes=60, positions=True)
    model.save(tmp_path / "room.wlm")
    places = model.stored_positions()
    save_probes(tmp_path / "room.npz", places, probe_sets.synthetic(60).values)
    low, high = places.min(0), places.max(0)
    floor = np.array([low, [high[0], low[1], low[2]], [low[0], low[1], high[2]]])
    document, _ = document_from_meshes([("floor", floor, np.array([[0, 2, 1]]), np.zeros((3, 2)))], "floor")
    write_glb(tmp_path / "floor.glb", document, [], 0)
    window = show(tmp_path / "room.wlm", original=tmp_path / "room.npz", mesh=tmp_path / "floor.glb")
    assert window.scene.views == ("balls", "gaussians")
    views = {}
    for key, name in enumerate(window.scene.views, 1):
        window.press(str(key))
        assert window.state.view == name
        views[name] = scene_of(window)[40:, : SIZE[0] // 3]
        shown = [s.name for s in window.sliders.values()]
        shown = {name for name in shown if window._widgets[name][0].GetRepresentation().GetVisibility()}
        assert shown - {"exposure", "error"} == {"balls": set(), "gaussians": {"sigma"}}[name]
    assert np.abs(views["balls"] - views["gaussians"]).max() > 40
    before = scene_of(window)
    drag(window, "sigma", 0.3)
    assert changed(window, before)


def lit_from(direction):
    """A probe [27] under a far white light."""
    return (basis(np.asarray(direction, np.float64)[None], 9)[0][:, None] * np.ones(3)).ravel()


def write_probes(path, position, values):
    """Writes a model of a few probes, which it stores almost exactly, with their positions."""
    wlm.probe.compress(wlm.probe.from_arrays(position, values), "pca", positions=True).save(path)


@pytest.mark.parametrize(("up", "above"), [("y", (0, 1, 0)), ("z", (0, 0, 1))])
def test_a_ball_is_bright_on_the_side_of_its_light(up, above, tmp_path, show):
    for sign in (1, -1):
        values = lit_from(sign * np.array(above))[None]
        write_probes(tmp_path / "one.wlm", np.zeros((1, 3)), values)
        ball = scene_of(show(tmp_path / "one.wlm", up=up)).mean(2)
        inside = np.abs(ball - ball[0, 0]) > 3
        rows = np.flatnonzero(inside.any(1))
        upper, lower = (part[here].mean() for part, here in ((ball[r], inside[r]) for r in np.array_split(rows, 2)))
        # The camera looks down on it.
        assert sign * (upper - lower) > 30


@pytest.mark.parametrize(("up", "axes"), [("y", np.eye(3)), ("z", np.eye(3)[[0, 2, 1]])])
def test_balls_are_where_their_probes_are(up, axes, tmp_path, show):
    """Four probes are white, red, green and blue: the green one is above, the others to the sides and nearer."""
    colours = np.array([[1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    values = np.zeros((4, 9, 3))
    values[:, 0] = colours * np.sqrt(4 * np.pi)
    write_probes(tmp_path / "four.wlm", np.concatenate([np.zeros((1, 3)), 4 * axes]), values.reshape(4, 27))
    picture = scene_of(show(tmp_path / "four.wlm", up=up))
    near = [np.argwhere((np.abs(picture - 255 * colour) < 40).all(2)) for colour in colours]
    origin, right, above, other = (each.mean(0) for each in near)
    assert above[0] < origin[0] - 20 and abs(above[1] - origin[1]) < 5  # upright lines converge a little
    assert right[1] > origin[1] + 20 and right[0] > origin[0] + 5
    # Right-handed axes: z points to the viewer's left with y up, y away from the viewer with z up.
    assert other[1] < origin[1] - 20 if up == "y" else other[1] > origin[1] + 20


@pytest.mark.parametrize("trial", ["import os; os.abort()", "raise SystemExit(1)", "import time; time.sleep(9)"])
def test_a_machine_without_opengl_is_one_line_and_no_crash(trial, tmp_path, monkeypatch):
    pytest.importorskip("pyvista")
    monkeypatch.setattr(rendering, "_TRIAL", trial)
    monkeypatch.setattr(rendering, "_TRIAL_SECONDS", 1.0)
    rendering.require_opengl.cache_clear()
    write_probes(tmp_path / "one.wlm", np.zeros((1, 3)), lit_from((0, 1, 0))[None])
    with pytest.raises(WlmError, match="found no OpenGL that works") as error:
        Window(open_scene(tmp_path / "one.wlm"))
    rendering.require_opengl.cache_clear()
    assert "\n" not in str(error.value)


def test_the_error_is_that_of_the_charts_and_has_the_score_of_evaluate(lightmaps, tmp_path, show):
    given = wlm.lightmap.load(lightmaps / "set")
    mask = given.light.mask.copy()
    mask[40:80, 30:90] = False
    small_sets.write_set(tmp_path / "set", given)
    Image.fromarray(mask).save(tmp_path / "set" / "mask.png")
    window = show(lightmaps / "four.wlm", original=tmp_path / "set")
    model, masked = wlm.load(lightmaps / "four.wlm"), wlm.lightmap.load(tmp_path / "set")
    report = wlm.lightmap.evaluate(model, masked, metrics=("psnr",))
    for hour, score in zip(report.times, report.light.psnr_by_time, strict=True):
        window.set("hour", hour)
        assert f"PSNR {score:.2f} dB" in caption(window)
    before, after = report.times[1:3]
    window.set("hour", 0.5 * (before + after))
    assert f"original interpolated from {before:g} and {after:g}" in caption(window)
    texture = window.canvas._drawn[2, "mesh"][0].texture
    pixels = np.asarray(texture.to_array()).reshape(256, 256, 3)
    grey = (pixels == 77).all(-1)
    assert grey[mask].sum() == 0 and grey[~mask].all()


def test_the_walls_of_a_room_are_left_out_from_outside(lightmaps, tmp_path, show):
    rooms.write_room(tmp_path / "room.glb")
    window = show(lightmaps / "four.wlm", mesh=tmp_path / "room.glb")
    assert window.scene.room
    inside = scene_of(window)
    window.scene.room = False
    window.draw()
    assert changed(window, inside)


def test_the_command_writes_a_picture(lightmaps, tmp_path, show):
    del show  # only for its check of OpenGL
    out = tmp_path / "out.png"
    options = ["--set", "hour=18.5", "--set", "exposure=1", "--view", "tiles", "--size", "400x300", "--tone", "filmic"]
    outputs = ["--screenshot", str(out)]
    result = CliRunner().invoke(app, ["view", str(lightmaps / "four.wlm"), *options, *outputs])
    assert result.exit_code == 0, result.output
    with Image.open(out) as picture:
        assert picture.size == (400, 300) and np.ptp(np.asarray(picture)) > 100


def test_what_has_no_picture_is_said_in_one_line(lightmaps, tmp_path):
    probe_models.whole_model(positions=False).save(tmp_path / "probe.wlm")
    probe_models.whole_model(outputs=5, positions=True).save(tmp_path / "five.wlm")
    small_sets.write_set(tmp_path / "half", small_sets.moving_light(height=64))
    four = lightmaps / "four.wlm"
    for file, options, said in (
        (FILES / "smoke.wlm", {}, "no picture of its own"),
        (four, {"key": "sh"}, "--key has no meaning"),
        (four, {"mesh": tmp_path / "absent.glb"}, "absent.glb"),
        (four, {"original": tmp_path / "half"}, "half: expected a lightmap of 256x256, found 128x64"),
        (tmp_path / "probe.wlm", {}, "--original"),
        (tmp_path / "five.wlm", {}, "spherical harmonics"),
        (lightmaps / "quad.glb", {}, "quad.glb: expected an artifact"),
        (tmp_path / "none.wlm", {}, "none.wlm"),
    ):
        with pytest.raises(WlmError, match=re.escape(said)) as caught:
            open_scene(file, **options)
        assert "\n" not in str(caught.value)


def test_the_command_refuses_in_one_line(lightmaps, tmp_path, monkeypatch, show):
    del show  # only for its check of OpenGL
    out = ["--screenshot", str(tmp_path / "out.png")]
    monkeypatch.delenv("DISPLAY", raising=False)
    for options, said in (
        ([], "expected a display"),
        (["--set", "sigma=2", *out], "sigma has no meaning"),
        (["--mesh", str(lightmaps / "quad.glb"), "--set", "turn=inf", *out], "turn: expected a finite number"),
        (["--view", "balls", *out], "--view: expected light or tiles"),
    ):
        result = CliRunner().invoke(app, ["view", str(lightmaps / "four.wlm"), *options])
        assert result.exit_code == 2 and said in result.stderr and result.stderr.count("\n") == 1, result.output
    monkeypatch.setitem(sys.modules, "pyvista", None)
    result = CliRunner().invoke(app, ["view", str(lightmaps / "four.wlm"), *out])
    assert result.exit_code == 2 and "view: pyvista is missing" in result.stderr
    assert not list(tmp_path.iterdir())


def test_light_on_the_screen():
    light = np.array([0.0, 0.0031308, 0.18, 1.0, 4.0])
    clamped, filmic = Display().picture(light), Display(tone="filmic").picture(light)
    assert clamped.tolist() == [0, 10, 118, 255, 255] and filmic[-1] == 255 and filmic[3] < 255
    assert (Display(2.0).screen(light / 2.0) == Display().screen(light)).all()
    assert heat(np.array([-1.0, 0.0, 1.0, 2.0])).tolist() == [[0] * 3, [0] * 3, [255] * 3, [255] * 3]
    one = np.full((2, 3), 0.5)
    assert Display().error(one, one).max() == 0


def test_run_opens_a_window_only_on_a_display(tmp_path, monkeypatch, show):
    del show  # only for its check of OpenGL
    monkeypatch.delenv("DISPLAY", raising=False)
    result = CliRunner().invoke(app, ["run", str(day_scenes.write_scene(tmp_path)), "--window"])
    assert result.exit_code == 2 and "expected a display" in result.stderr and result.stderr.count("\n") == 1


def test_a_scene_of_a_day_follows_its_hour_and_light_groups(show, tmp_path):
    path = day_scenes.write_scene(tmp_path)
    with wlm.scene.load(path) as content:
        window = Window(day_scene(content), size=SIZE)
        try:
            assert list(window.sliders) == ["hour", "sky weight", "sun weight", "exposure"]
            assert "3 moving" not in caption(window) and "1 moving object" in caption(window)
            window.tone("filmic")
            window.set("hour", 12.0)
            noon = scene_of(window)
            window.set("sun weight", 0.0)
            assert changed(window, noon)
            window.set("sun weight", 1.0)
            assert not changed(window, noon)
            window.set("hour", 20.0)
            assert changed(window, noon)
            # The background is the sky's colour.
            colour, exposure = content.sky_at(20.0)
            expected = Display(2.0**exposure, "filmic").picture(colour)
            assert np.abs(scene_of(window)[2, 2] - expected).max() <= 1
        finally:
            window.close()
