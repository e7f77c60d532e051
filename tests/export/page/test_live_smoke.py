"""Smoke that a page, or three.js with the kit of a network, lights itself as Python does."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.contract import FILES
from builders.page_numbers import numbers
from builders.smoke_plumes import plume
from builders.smoke_samples import random_model
from test_browser import figure

from wlm.cli.smoke_network import export_three
from wlm.errors import WlmError
from wlm.export import export, write_page
from wlm.export.page import smoke as smoke_page
from wlm.fluid.volume import from_array, load_volume, save_volume
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.network.planes import encode_lightmaps
from wlm.smoke.network.prediction import predict
from wlm.smoke.network.settings import DatasetSettings
from wlm.smoke.shading import Light

PLUME = FILES.parents[1] / "demos" / "data" / "smoke" / "plume.npz"


def seen_by(page, size, turn, tilt):
    page.evaluate(f"wlm.then(({{kind}}) => {{ kind.resize({size}); kind.setTurn({turn}); kind.setTilt({tilt}); }})")
    view = page.evaluate("wlm.then(({kind}) => kind.view())")
    return camera_of([view[name] for name in ("right", "up", "toward")], view["target"], view["extent"], size)


def camera_of(axes, target, extent, size):
    return Camera(tuple(np.add(target, 10.0 * extent * np.array(axes[2]))), *map(tuple, axes), extent, size, size)


def check(page, camera, made, expected, bound, frame=0):
    found = numbers(page, f"(Object.assign(kind, {{made: '{made}', stale: true}}), kind.read({frame}))").copy()
    first, second = torch.from_numpy(found).reshape(2, camera.height, camera.width, 4).permute(0, 3, 1, 2)
    six = SixWay(torch.cat([first, second[:2]]), 1.0 - second[2], second[3], camera)
    assert (encode_lightmaps(six) - encode_lightmaps(expected)).abs().max() < bound / 255


@pytest.mark.parametrize("settings", [None, {"stem": 1, "levels": 2}, {"stem": 2}])
def test_the_network_is_that_of_python(settings, tmp_path, show):
    """Of the network that ships at the size of the demo, and of others."""
    network, smoke, size = "fast", load_volume(PLUME, extinction=14.0), 96
    if settings is not None:
        model, smoke, size, network = random_model(0.03, guide="six", **settings), plume(), 37, tmp_path / "net.wlm"
        dataset = DatasetSettings(guide="six", guide_step=0.5, guide_spacing=0.1)
        dataclasses.replace(model, summary={"dataset": dataset.model_dump(mode="json")}).save(network)
    save_volume(tmp_path / "plume.npz", smoke)
    options = {"network": network, "volume": {"extinction": smoke.extinction}}
    write_page(tmp_path / "page.html", [tmp_path / "plume.npz"], **options)
    page = show(tmp_path / "page.html")
    camera = seen_by(page, size, 35, 25)
    check(page, camera, "network", predict(smoke, camera, network), 0.5)
    assert "ms" in figure(page, "time for them")


def test_smoke_is_marched_frame_by_frame(tmp_path, show):
    noise = np.random.default_rng(0).random((5, 9, 7), np.float32)
    for number, density in enumerate((np.ones((1, 1, 1)), np.zeros((8, 8, 8)), noise)):
        save_volume(tmp_path / f"cloud_{number}.npz", from_array(density, voxel=0.2, origin=(0.1 * number, -0.2, 0.1)))
    write_page(tmp_path / "page.html", [tmp_path], volume={"extinction": 3.0})
    page = show(tmp_path / "page.html")
    camera = seen_by(page, 40, -100, -70)
    for number in range(3):
        smoke = load_volume(tmp_path / f"cloud_{number}.npz", extinction=3.0)
        check(page, camera, "march", predict(smoke, camera), 1.5, number)
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 200)
    assert page.evaluate("wlm.then(({kind}) => [kind.turn, kind.tilt])") == [-121, -70]
    page.evaluate("wlm.then(({graphics}) => graphics.gl.getExtension('WEBGL_lose_context').loseContext())")
    page.locator("#message:has-text('took the GPU')").wait_for(timeout=5000)
    page.context.add_init_script("WebGL2RenderingContext.prototype.getExtension = () => null")
    page.reload()
    page.locator("#message:has-text('can not draw into float textures')").wait_for(timeout=5000)
    show.errors.clear()  # the page also throws it, for the console


def test_what_no_script_lights(tmp_path, monkeypatch):
    save_volume(tmp_path / "plume.npz", plume())
    paper = dataclasses.replace(random_model(), summary={"dataset": DatasetSettings().model_dump(mode="json")})
    paper.save(tmp_path / "paper.wlm")
    monkeypatch.setattr(smoke_page, "_MOST_BYTES", 1000)
    for network, said in ((tmp_path / "paper.wlm", "paper.wlm: network.guide: "), ("fast", "plume.npz: expected at")):
        with pytest.raises(WlmError, match=said):
            write_page(tmp_path / "page.html", [tmp_path / "plume.npz"], network=network)
    with pytest.raises(WlmError, match="expected the engine three and a network with the guide six"):
        export(paper, tmp_path / "kit", "three")


def test_three_lights_smoke_as_python_does(tmp_path, visit):
    export_three(tmp_path / "kit")
    shutil.copy(Path(__file__).with_name("three_live.html"), tmp_path / "kit" / "index.html")
    page, smoke, size = visit(tmp_path / "kit"), plume(), 48
    given = {"shape": smoke.shape, "voxel": smoke.voxel, "extinction": smoke.extinction}
    given["density"] = smoke.density.flatten().tolist()
    extent = float(np.linalg.norm(smoke.size))
    pixels, axes, toward, error = page.evaluate("(given) => draw(...given)", [given, 0.5 * extent, size])
    six = predict(smoke, camera_of(axes, smoke.centre, extent, size), "fast")
    expected = six.shade([Light(tuple(toward), (9.0,) * 3)])[..., 0]
    found = torch.tensor(pixels).reshape(size, size, 4).flip(0)[..., 0]
    assert not error and expected.max() > 0.3 and (found - expected).abs().max() < 2 / 255
