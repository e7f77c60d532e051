"""Smoke that a page lights itself: by the march and the network, as Python does."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.contract import FILES
from builders.page_numbers import numbers
from builders.smoke_plumes import plume
from builders.smoke_samples import random_model
from test_browser import figure, picture

import wlm
from wlm.errors import WlmError
from wlm.export import write_page
from wlm.export.page import smoke as smoke_page
from wlm.fluid.volume import from_array, save_volume
from wlm.smoke.camera import Camera
from wlm.smoke.codec import open_network
from wlm.smoke.decode import Decoder
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.network.planes import GUIDES, decode_lightmaps, encode_lightmaps, render_guide
from wlm.smoke.network.prediction import SmokePredictor
from wlm.smoke.network.settings import DatasetSettings
from wlm.smoke.shading import Light

PLUME = Path(__file__).parents[3] / "demos" / "data" / "smoke" / "plume.npz"


def seen_by(page, size, turn=0.0, tilt=0.0):
    """Turns a page's smoke; returns the camera."""
    page.evaluate(f"wlm.then(({{kind}}) => {{ kind.resize({size}); kind.setTurn({turn}); kind.setTilt({tilt}); }})")
    view = page.evaluate("wlm.then(({kind}) => kind.view())")
    axes = [np.array(view[name]) for name in ("right", "up", "toward")]
    place = np.array(view["target"]) + 10.0 * view["extent"] * axes[2]
    return Camera(*map(tuple, (place, *axes)), view["extent"], size, size)


def encoded(page, camera, made, frame=0):
    """The lightmaps that a page makes, encoded as numbers from 0 to 1, [8, H, W]."""
    found = numbers(page, f"(Object.assign(kind, {{made: '{made}', stale: true}}), kind.read({frame}))").copy()
    first, second = torch.from_numpy(found).reshape(2, camera.height, camera.width, 4).permute(0, 3, 1, 2)
    six = SixWay(torch.cat([first, second[:2]]), 1.0 - second[2], second[3], camera)
    return encode_lightmaps(six)


def test_the_network_and_its_gate_are_those_of_python(tmp_path, show):
    """At the size of the demo; then the picture on the canvas, at all of its pixels."""
    write_page(tmp_path / "page.html", [PLUME], network="fast", volume={"extinction": 14.0})
    page = show(tmp_path / "page.html", width=340 + 384, height=384)
    smoke = wlm.smoke.load(PLUME, extinction=14.0)
    camera, model = seen_by(page, 96, 35, 25), open_network("fast")
    guide = render_guide(smoke, camera, "six", model.dataset.look(smoke.shape))
    pure = decode_lightmaps(Decoder(model, height=96, width=96)(guide).clone())
    blend = wlm.smoke.predict(smoke, camera, "fast")
    for made, expected in (("network", pure), ("blend", blend)):
        apart = (encoded(page, camera, made) - encode_lightmaps(expected)).abs()
        assert apart.max() < 0.5 / 255 and apart.mean() < 0.02 / 255
    assert (encode_lightmaps(pure) - encode_lightmaps(blend)).abs().max() > 10 / 255
    assert figure(page, "time for them").endswith(" ms") and figure(page, "lightmaps") == "96 × 96 texels"
    lamp = page.evaluate("wlm.then(({kind}) => kind.lamp)")
    screen = picture(page)
    edge = screen.shape[0] / 1.08  # pixels of the lightmaps' edge
    rows, columns = ((np.arange(n) + 0.5 - n / 2) * 2 / edge for n in screen.shape[:2])
    grid = torch.tensor(np.stack(np.meshgrid(columns, rows), -1), dtype=torch.float32)[None]
    roots = torch.cat([blend.lightmaps, blend.transparency[None] - 1.0, blend.emission[None]]).abs().sqrt()[None]
    maps = torch.nn.functional.grid_sample(roots, grid, align_corners=False, padding_mode="border")[0].square()
    drawn = dataclasses.replace(camera, height=screen.shape[0], width=screen.shape[1])
    glow = maps[7][..., None] * torch.tensor([1.0, 0.45, 0.12])
    light = SixWay(maps[:6], None, camera=drawn).shade([Light(tuple(lamp))]) + glow
    squares = ((grid[0] * 0.5 + 0.5) * 8).floor().sum(-1) % 2
    light += (1.0 - maps[6])[..., None] * (0.06 + 0.06 * squares)[..., None]
    expected = 255 * np.where(light > 0.0031308, 1.055 * light.clip(1e-5, 1) ** (1 / 2.4) - 0.055, 12.92 * light)
    inside = (grid[0].abs() < 0.99).all(-1).numpy()
    apart = np.abs(screen - expected)[inside].max(-1)
    assert inside.mean() > 0.5 and (apart <= 2).mean() > 0.99, (apart.max(), (apart <= 2).mean())


def test_smoke_without_a_network_is_marched_frame_by_frame(tmp_path, show):
    """Of one voxel, none, and half a plume at a place of its own."""
    rng = np.random.default_rng(0)
    frames = [
        from_array(np.ones((1, 1, 1), np.float32), extinction=3.0),
        from_array(np.zeros((8, 8, 8), np.float32)),
        from_array(rng.random((5, 9, 7), np.float32), voxel=0.2, origin=(0.3, -0.2, 0.1)),
    ]
    for number, smoke in enumerate(frames, 1):
        save_volume(tmp_path / f"cloud_{number}.npz", smoke)
    write_page(tmp_path / "page.html", [tmp_path], volume={"extinction": 3.0}, rate=8.0)
    page = show(tmp_path / "page.html")
    for number in range(3):
        smoke = wlm.smoke.load(tmp_path / f"cloud_{number + 1}.npz", extinction=3.0)
        camera = seen_by(page, 40, -100, -70)
        apart = (encoded(page, camera, "march", number) - encode_lightmaps(wlm.smoke.predict(smoke, camera))).abs()
        assert apart.max() < 1.5 / 255
    assert page.locator("button:text-is('network')").count() == 0
    # Dragging turns the view, or the light.
    box = page.locator("#view").bounding_box()
    for button, changed in (("view", "kind.turn"), ("light", "kind.lamp.join()")):
        page.get_by_role("button", name=button, exact=True).click()
        before = page.evaluate(f"wlm.then(({{kind}}) => {changed})")
        page.mouse.move(box["x"] + 200, box["y"] + 200)
        page.mouse.down()
        page.mouse.move(box["x"] + 260, box["y"] + 220, steps=3)
        page.mouse.up()
        assert page.evaluate(f"wlm.then(({{kind}}) => {changed})") != before


@pytest.mark.parametrize("settings", [{"stem": 1, "levels": 2, "adapters": True}, {"stem": 2, "adapters": True}])
def test_networks_of_other_shapes(settings, tmp_path, show):
    """They smooth the guide, so that the gate gives them a weight."""
    model = random_model(0.03, guide="six", **settings)
    with torch.no_grad():
        for number, name in enumerate(model.network.names):
            model.network.filter.weight[number, GUIDES["six"].index(name), 1:4, 1:4] += 1 / 9
    dataset = DatasetSettings(guide="six", guide_step=0.5, guide_spacing=0.1)
    model = dataclasses.replace(model, summary={"dataset": dataset.model_dump(mode="json")})
    model.save(tmp_path / "network.safetensors")
    model, smoke = open_network(tmp_path / "network.safetensors"), plume()
    save_volume(tmp_path / "plume.npz", smoke)
    options = {"network": tmp_path / "network.safetensors", "volume": {"extinction": smoke.extinction}}
    write_page(tmp_path / "page.html", [tmp_path / "plume.npz"], **options)
    page = show(tmp_path / "page.html")
    camera = seen_by(page, 37, 50, 10)
    guide = render_guide(smoke, camera, "six", dataset.look(smoke.shape))
    pure, predictor = decode_lightmaps(Decoder(model, height=37, width=37)(guide)), SmokePredictor(model)
    for made, expected in (("network", pure), ("blend", predictor(smoke, camera))):
        apart = (encoded(page, camera, made) - encode_lightmaps(expected)).abs()
        assert apart.max() < 2 / 255
    assert 0.1 < predictor.share < 0.9
    assert figure(page, "weight of the network") == f"{predictor.share:.0%}"


def test_a_browser_without_float_targets_or_a_lost_context_is_told(tmp_path, show):
    save_volume(tmp_path / "plume.npz", plume())
    write_page(tmp_path / "page.html", [tmp_path / "plume.npz"])
    page = show(tmp_path / "page.html")
    page.evaluate("wlm.then(({graphics}) => graphics.gl.getExtension('WEBGL_lose_context').loseContext())")
    page.locator("#message:has-text('took the GPU')").wait_for(timeout=5000)
    page.context.add_init_script("WebGL2RenderingContext.prototype.getExtension = () => null")
    page.reload()
    page.locator("#message:has-text('can not draw into float textures')").wait_for(timeout=5000)
    show.errors.clear()  # the page also throws it, for the console


def test_what_a_page_cannot_light(tmp_path, monkeypatch):
    save_volume(tmp_path / "plume.npz", plume())
    paper = dataclasses.replace(random_model(), summary={"dataset": DatasetSettings().model_dump(mode="json")})
    paper.save(tmp_path / "paper.safetensors")
    with pytest.raises(WlmError, match="guide: expected six"):
        write_page(tmp_path / "page.html", [tmp_path / "plume.npz"], network=tmp_path / "paper.safetensors")
    with pytest.raises(WlmError, match="--network has no meaning"):
        write_page(tmp_path / "page.html", [FILES / "lightmap.wlm"], network="fast")
    monkeypatch.setattr(smoke_page, "_MOST_BYTES", 1000)
    with pytest.raises(WlmError, match="plume.npz: expected at most"):
        write_page(tmp_path / "page.html", [tmp_path / "plume.npz"])
    assert not (tmp_path / "page.html").exists()
