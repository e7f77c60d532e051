"""Pages in a browser: the light that they decode is that of Python, and their controls change the picture."""

import base64
import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from builders import atlas_meshes, atlas_models, day_scenes, probe_sets, rooms, small_sets
from builders.light_groups import random_groups
from builders.page_numbers import numbers
from builders.synthetic import random_model
from PIL import Image

import wlm
from wlm.atlas.model import unpack_entries
from wlm.export import write_page
from wlm.formats.gltf import document_from_meshes
from wlm.formats.gltf_writer import write_glb
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tiles import TileKind
from wlm.scene.frame import Renderer
from wlm.smoke.camera import Camera
from wlm.smoke.data import write_six_way
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light

TIMES = (0.0, 6.25, 12.0, 18.5, 23.9)


def picture(page) -> np.ndarray:
    """What is on the canvas, after the next frame."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return np.asarray(Image.open(io.BytesIO(page.locator("#view").screenshot())).convert("RGB")).astype(int)


def told(page) -> str:
    """What the panel says of the pointer's place, after the next frame."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return "   ".join(page.locator("#panel .told span").all_inner_texts())


def light_of(text: str, name: str) -> np.ndarray:
    """A light that the panel tells."""
    return np.array([float(x) for x in re.search(rf"{name} (\S+) (\S+) (\S+)", text).groups()])


def texel_of(text: str) -> tuple[int, int]:
    return tuple(map(int, re.match(r"texel (\d+), (\d+)   UV ", text).groups()))


def figure(page, name: str) -> str:
    """What the panel's table says beside a name."""
    return page.locator(f"#panel > table tr:has(td:text-is('{name}')) td:last-child").inner_text()


@pytest.fixture(scope="module")
def lightmaps():
    holes = np.zeros((256, 256), bool)
    holes[50:60, 90:200] = holes[::16, ::8] = True
    return small_sets.four_tiles(holes)


@pytest.fixture(scope="module")
def model(lightmaps):
    return wlm.lightmap.compress(lightmaps, small_sets.tiny_profile())


def _long(*values: object) -> object:
    """Of the long run alone: a page takes seconds."""
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("unpacked", "interpolation"), [(False, "radiance"), (True, "radiance"), _long(False, "network")]
)
def test_lightmaps_decode_as_in_python(model, tmp_path, show, unpacked, interpolation):
    sheet = model.sheets[LIGHT]
    assert sorted(sheet.kind.tolist()) == [0, 1, 3, 3]
    profile = model.profile.override({"interpolation": interpolation})
    sheet = dataclasses.replace(sheet, profile=profile.for_sheet(LIGHT))
    model = dataclasses.replace(model, profile=profile, sheets={LIGHT: sheet})
    model.save(tmp_path / "four.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "four.wlm"])
    page = show(tmp_path / "page.html", unpacked=unpacked)
    decoder, gamma = model.decoder().light, sheet.profile.gamma
    for time in TIMES:
        expected = decoder.frame(time)
        seen = numbers(page, f"kind.read({time})").reshape(256, 256, 4)[..., :3]
        bound = expected.max() ** (1 / gamma)
        apart = np.abs(np.maximum(seen, 0.0) ** (1 / gamma) - expected ** (1 / gamma)) / bound
        assert apart.max() < 2 / 255
    if unpacked:
        return
    # The hour, the exposure and the tone change the picture.
    page.evaluate("wlm.then(({kind}) => kind.read(5))")
    before = picture(page)
    assert before.max() > 100
    page.evaluate("wlm.then(({kind}) => kind.read(11))")
    assert np.abs(picture(page) - before).max() > 20
    page.keyboard.press("]")
    brighter = picture(page)
    assert brighter.mean() > before.mean()
    page.keyboard.press("t")
    assert np.abs(picture(page) - brighter).max() > 5
    page.keyboard.press("h")
    assert page.locator("#panel.folded").count() == 1
    fold = page.locator("header button")
    assert fold.get_attribute("aria-label") == "unfold the panel (H)" and fold.inner_text() == "+"


@pytest.mark.parametrize(
    ("unpacked", "interpolation"), [_long(False, "radiance"), (True, "radiance"), _long(True, "network")]
)
def test_frames_of_all_modes_decode_as_in_python(tmp_path, show, unpacked, interpolation):
    model = random_model((4, 4, 1, 4, 1, 4), times=(0.0, 7.5, 19.0), interpolation=interpolation)
    model.save(tmp_path / "frames.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "frames.wlm"])
    page = show(tmp_path / "page.html", unpacked=unpacked)
    decoder = model.decoder().light
    for time in (7.5, 21.0):
        expected = decoder.frame(time)
        seen = numbers(page, f"kind.read({time})").reshape(*expected.shape[:2], 4)[..., :3]
        # The map is of half floats.
        assert np.abs(seen - expected).max() < 2**-10 * expected.max()


def test_the_original_its_error_and_the_wipe(tmp_path, show):
    lightmaps = small_sets.moving_light(hours=(0.0, 1.0, 2.0), period=None)
    model = wlm.lightmap.compress(lightmaps, small_sets.tiny_profile())
    model.save(tmp_path / "one.wlm")
    small_sets.write_set(tmp_path / "set", lightmaps)
    write_page(tmp_path / "page.html", [tmp_path / "one.wlm"], original=tmp_path / "set")
    page = show(tmp_path / "page.html")
    page.evaluate("wlm.then(({kind}) => kind.read(1))")
    decoded = picture(page)
    page.get_by_role("button", name="original", exact=True).click()
    original = picture(page)
    middle = decoded.shape[1] // 2
    assert np.abs(decoded - original).mean() > 1
    page.get_by_role("button", name="split").click()
    page.evaluate("document.getElementById('wipe').style.visibility = 'hidden'")
    split = picture(page)
    np.testing.assert_array_equal(split[:, : middle - 2], original[:, : middle - 2])
    np.testing.assert_array_equal(split[:, middle + 2 :], decoded[:, middle + 2 :])
    page.get_by_role("button", name="error", exact=True).click()
    assert np.abs(picture(page) - decoded).max() > 50


@pytest.mark.parametrize("touch", [_long(False), True])
def test_a_texel_tells_its_tile_and_its_light(model, lightmaps, tmp_path, show, touch):
    model.save(tmp_path / "four.wlm")
    small_sets.write_set(tmp_path / "set", lightmaps)
    write_page(tmp_path / "page.html", [tmp_path / "four.wlm"], original=tmp_path / "set", hours=5)
    page = show(tmp_path / "page.html", touch=touch)
    point = page.touchscreen.tap if touch else page.mouse.move
    box, hour, decoder = page.locator("#view").bounding_box(), lightmaps.times[2], model.decoder().light
    page.evaluate(f"wlm.then(({{kind}}) => kind.read({hour}))")
    assert told(page) == "point at the picture to read a texel"
    middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
    for x, y, kind in ((-100, -60, "dynamic"), (60, -100, "dynamic"), (-100, 60, "constant"), (60, 60, "empty")):
        point(*(middle + [x, y]))
        text = told(page)
        column, row = texel_of(text)
        # The picture's 256 texels are square, and fill the shorter side but for a margin.
        expected = 128 + np.array([x, y]) * 256 * 1.08 / min(box["width"], box["height"])
        assert np.abs([column + 0.5, row + 0.5] - expected).max() < 1
        u, v = map(float, re.search(r"UV (\S+) (\S+)", text).groups())
        assert np.abs(np.array([u, v]) * 256 - expected).max() < 0.1
        number = row // 128 * 2 + column // 128
        assert f"tile {number} ({kind})" in text and TileKind(model.light.kind[number]).name.lower() == kind
        gamma, radiance = model.profile.gamma, decoder.frame(hour)
        apart = light_of(text, "decoded") ** (1 / gamma) - radiance[row, column] ** (1 / gamma)
        assert np.abs(apart).max() < 2 / 255 * radiance.max() ** (1 / gamma)
        if kind != "empty":
            original = lightmaps.light.frames[2][row, column]
            assert np.abs(light_of(text, "original") - original).max() <= original.max() / 400
    if not touch:
        # What is outside of the mask has no error, though the original was filled there and the decoded light is 0.
        page.get_by_role("button", name="error", exact=True).click()
        seen = picture(page)
        rows, columns = (size // 2 + np.arange(5, 100) for size in seen.shape[:2])
        assert np.abs(seen[rows][:, columns] - 76.5).max() < 1 and seen[rows - 105][:, columns - 105].max() > 50
        page.get_by_role("button", name="decoded", exact=True).click()
    point(*(middle - 100))
    before = told(page)
    page.evaluate(f"wlm.then(({{kind}}) => kind.read({hour + 1}))")
    after = told(page)
    assert after.startswith(before.split("decoded")[0]) and after != before and "original" not in after
    point(box["x"] + 2, middle[1])
    assert told(page) == "point at the picture to read a texel"


@pytest.mark.parametrize("kind", ["tiles", "plain with uv", _long("plain"), _long("cascade")])
def test_a_texel_of_an_atlas(kind, tmp_path, show):
    """A cube of six charts, and one inside that is never seen."""
    mesh = atlas_meshes.charts()
    model = atlas_models.random_model(mesh, kind)
    model.save(tmp_path / "cube.wlm")
    _, light = atlas_meshes.write_files(tmp_path, mesh)
    write_page(tmp_path / "page.html", [tmp_path / "cube.wlm"], original=light)
    page = show(tmp_path / "page.html")
    box, exposure = page.locator("#view").bounding_box(), page.evaluate("wlm.then(({manifest}) => manifest.exposure)")
    shown, decoder, seen = picture(page), model.decoder(), set()
    for x, y in ((0.5, 0.35), (0.4, 0.6), (0.6, 0.6), (0.45, 0.4), (0.55, 0.7)):
        x, y = int(x * box["width"]), int(y * box["height"])
        page.mouse.move(box["x"] + x + 0.5, box["y"] + y + 0.5)
        text = told(page)
        column, row = texel_of(text)
        seen.add((row // 24, column // 16))
        decoded = light_of(text, "decoded")
        if len(model.uv):
            # Read where the pixel reads it; elsewhere it is that of the texel.
            code = np.clip(decoded * exposure, 0, 1)
            code = np.where(code <= 0.0031308, 12.92 * code, 1.055 * code ** (1 / 2.4) - 0.055)
            assert np.abs(shown[y, x] - 255 * code).max() <= 4
        else:
            place = torch.tensor([[(column + 0.5) / 64, (row + 0.5) / 48]], dtype=torch.float32)
            assert np.abs(decoded - decoder.read(place).numpy()[0]).max() < 2 / 255 * 3
        original = mesh.sheets[0].lightmap[row, column]
        assert np.abs(light_of(text, "original") - original).max() <= original.max() / 400
        if kind == "tiles":
            wide, high, left, top = map(int, re.search(r"(\d+) × (\d+) texels at (\d+), (\d+)", text).groups())
            entry = model.lut[min(row // 7, len(model.lut) - 1), min(column // 7, len(model.lut[0]) - 1)]
            first, size, _ = unpack_entries(entry, model.first_block_code)
            assert [left, top] == first.tolist() and [wide, high] == size.tolist()
        assert ("tile" in text) == (kind == "tiles")
    assert len(seen) == 3 and (1, 2) not in seen, "three sides of the cube, and nothing of what is inside"


def test_materials_dim_the_light_of_an_atlas(tmp_path, show):
    mesh = atlas_meshes.sheet(atlas_meshes.constant(0.5, 0.4, 0.3))
    pixels = np.full((16, 16, 3), [255, 128, 0], np.uint8)
    pixels[:, 8:] = 64
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    content = mesh.document.content
    content["images"] = [{"uri": f"data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}"}]
    moved = {"KHR_texture_transform": {"offset": [0.5, 0.0]}}
    surface = {"baseColorFactor": [1.0, 0.5, 1.0, 1.0], "baseColorTexture": {"index": 0, "extensions": moved}}
    content |= {"textures": [{"source": 0}], "materials": [{"pbrMetallicRoughness": surface}]}
    content["meshes"][0]["primitives"][0]["material"] = 0
    wlm.atlas.compress(mesh, wlm.atlas.Profile(name="tiny", views=2)).save(tmp_path / "sheet.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "sheet.wlm"])
    page = show(tmp_path / "page.html")
    box = page.locator("#view").bounding_box()
    exposure = page.evaluate("wlm.then(({manifest}) => [manifest.exposure, manifest.bare])")
    coloured, sides = picture(page), set()
    page.keyboard.press("m")
    bare = picture(page)
    for x, y in ((0.4, 0.5), (0.45, 0.4), (0.55, 0.55), (0.6, 0.5)):
        x, y = int(x * box["width"]), int(y * box["height"])
        page.mouse.move(box["x"] + x + 0.5, box["y"] + y + 0.5)
        text = told(page)
        right = texel_of(text)[0] >= 24
        sides.add(right)
        # The picture is moved by half its width.
        code = np.array([255, 128, 0] if right else [64, 64, 64]) / 255
        base = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4) * [1.0, 0.5, 1.0]
        for shown, colour in ((coloured, base * exposure[0]), (bare, exposure[1])):
            light = np.clip(light_of(text, "decoded") * colour, 0, 1)
            light = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
            assert np.abs(shown[y, x] - 255 * light).max() <= 3
    assert len(sides) == 2
    assert figure(page, "materials") == "base colours of the file"
    # A picture that the file lacks leaves the light as it is, and the page says so.
    content["images"] = [{"uri": "wood.png"}]
    wlm.atlas.compress(mesh, wlm.atlas.Profile(name="tiny", views=2)).save(tmp_path / "sheet.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "sheet.wlm"])
    assert "wood.png" in figure(show(tmp_path / "page.html"), "materials")


@pytest.fixture
def compared(tmp_path, show):
    """A page of a day with its original at 0, 8 and 16 h, of which the lower half belongs to no chart."""
    mask = np.ones((128, 128), bool)
    mask[64:] = False
    lightmaps = small_sets.moving_light(hours=(0.0, 8.0, 16.0), mask=mask)
    wlm.lightmap.compress(lightmaps, small_sets.tiny_profile()).save(tmp_path / "day.wlm")
    small_sets.write_set(tmp_path / "set", lightmaps)
    Image.fromarray(mask).save(tmp_path / "set" / "mask.png")
    write_page(tmp_path / "page.html", [tmp_path / "day.wlm"], original=tmp_path / "set")
    return show(tmp_path / "page.html")


def wait_for(page, condition: str) -> None:
    """Waits until a script says yes of `kind`, for ten seconds."""
    page.evaluate(f"""wlm.then(async ({{kind}}) => {{
        const end = performance.now() + 10000;
        while (!({condition})) {{
            if (performance.now() > end) throw new Error('expected {condition}, found ' + [kind.time, kind.shown]);
            await new Promise(requestAnimationFrame);
        }}
    }})""")


def wait_for_hour(page, hour: float) -> None:
    wait_for(page, f"kind.shown === {hour} && kind.time === {hour}")


def test_arrows_go_from_original_to_original_where_one_is_seen(compared):
    wait_for_hour(compared, 8.0)
    compared.keyboard.press("ArrowRight")
    wait_for_hour(compared, 8.25)
    assert figure(compared, "PSNR at this hour") == "–"
    compared.keyboard.press("4")
    wait_for_hour(compared, 8.0)
    seen = picture(compared)
    height, middle = seen.shape[0], seen.shape[1] // 2
    upper, lower = seen[height // 10 : height // 2 - 5, middle], seen[height // 2 + 5 : height - height // 10, middle]
    assert (lower == 76).all() or (lower == 77).all(), "texels of no chart have no error"
    assert np.abs(upper - 76).max() > 50
    for key, hour in (("", 8.0), ("ArrowRight", 16.0), ("ArrowRight", 0.0), ("ArrowLeft", 16.0)):
        if key:
            compared.keyboard.press(key)
        wait_for_hour(compared, hour)
        assert figure(compared, "PSNR at this hour").endswith(" dB")
    assert figure(compared, "originals at") == "0:00, 8:00, 16:00"
    # A slider that has the focus moves by the same steps.
    compared.locator("input").first.focus()
    compared.keyboard.press("ArrowRight")
    wait_for_hour(compared, 0.0)


def test_a_played_day_is_compared_at_the_originals_hours(compared):
    wait_for_hour(compared, 8.0)
    compared.keyboard.press("3")
    compared.evaluate("""wlm.then(({kind}) => {
        window.seen = [];
        const draw = kind.surface.draw.bind(kind.surface);
        kind.surface.draw = (...all) => { window.seen.push(kind.shown); draw(...all); };
    })""")
    compared.get_by_role("button", name="play").click()
    wait_for(compared, "new Set(window.seen).size > 1")
    # After a click on the button the space bar still plays and pauses.
    compared.keyboard.press(" ")
    assert compared.get_by_role("button", name="play").count() == 1
    assert set(compared.evaluate("window.seen")) <= {0.0, 8.0, 16.0}
    compared.keyboard.press("1")
    compared.keyboard.press(" ")
    wait_for(compared, "kind.shown % 8 !== 0")
    text = help_of(compared)
    for words in ("the hour", "play, pause", "decoded, original, split, error", "error factor", "fold this panel"):
        assert words in text


def help_of(page) -> str:
    """What the page says that it can do."""
    page.locator("summary").click()
    return page.locator("details").inner_text()


def test_the_walls_of_a_room_are_seen_from_inside_alone(model, tmp_path, show):
    model.save(tmp_path / "four.wlm")
    rooms.write_room(tmp_path / "room.glb")
    write_page(tmp_path / "page.html", [tmp_path / "four.wlm"], mesh=tmp_path / "room.glb")
    page = show(tmp_path / "page.html")
    page.evaluate("wlm.then(({kind}) => kind.read(5))")
    inside = picture(page)
    page.keyboard.press("b")
    outside = picture(page)
    assert np.abs(inside - outside).max() > 20
    page.keyboard.press("b")
    np.testing.assert_array_equal(picture(page), inside)
    # The whole box is in the picture, and fills it in one direction.
    lit = np.argwhere((outside != outside[0, 0]).any(-1))
    room = np.array(outside.shape[:2])
    assert (lit.min(0) > 0).all() and (lit.max(0) < room - 1).all()
    assert ((lit.max(0) - lit.min(0)) / room).max() > 0.8


def test_principal_components_and_light_between_probes_decode_as_in_python(tmp_path, show):
    probes = probe_sets.synthetic(60, dead=5)
    model = wlm.probe.compress(probes)
    model.save(tmp_path / "probe.wlm")
    wlm.probe.save_probes(tmp_path / "probes.npz", probes.position, probes.values)
    corners = probes.position[probes.live][:3]
    corners[2] += 0.3
    document, _ = document_from_meshes([("triangle", corners, np.array([[0, 1, 2]]), np.zeros((3, 2)))], "triangle")
    write_glb(tmp_path / "triangle.glb", document, [], 0)
    files = {"mesh": tmp_path / "triangle.glb", "original": tmp_path / "probes.npz"}
    write_page(tmp_path / "page.html", [tmp_path / "probe.wlm"], **files)
    page = show(tmp_path / "page.html")
    decoded = model.decoder(position=probes.position).decode_probes()[probes.live]
    # Between probes the page weights those within four times the least distance by 1 / distance^4.
    square = np.square(corners[:, None].astype(np.float64) - probes.position[probes.live]).sum(-1)
    weight = np.where(square > 16 * square.min(1, keepdims=True), 0.0, np.maximum(square * square, 1e-30) ** -1.0)
    for group, expected in enumerate([decoded, weight @ decoded / weight.sum(1, keepdims=True)]):
        seen = numbers(page, f"kind.read({group})").reshape(-1, 27)
        # The page has half floats of them.
        assert np.abs(seen - expected).max() < 2**-10 * np.abs(expected).max()
    assert picture(page).max() > 100


def test_smoke_is_shaded_as_in_python(tmp_path, show):
    rows, columns = np.mgrid[:32, :32] / 32.0
    maps = np.stack([0.1 + 0.1 * i + 0.2 * rows * columns for i in range(6)]).astype(np.float32)
    camera = Camera.look_at((0.0, 0.0, 1.0), np.zeros(3), extent=1.0, height=32, width=32)
    six = SixWay(torch.from_numpy(maps), torch.full((32, 32), 0.0), camera=camera)
    write_six_way(tmp_path / "0.exr", six)
    write_page(tmp_path / "page.html", [tmp_path / "0.exr"])
    page = show(tmp_path / "page.html", width=700, height=400)
    for toward in ((1.0, 0.0, 0.0), (-0.6, 0.0, 0.8), (0.0, 0.6, -0.8)):
        page.evaluate(f"wlm.then(({{kind}}) => {{ kind.toward = {list(toward)}; kind.camera.changed(); }})")
        exposure = page.evaluate("wlm.then(({manifest}) => manifest.exposure)")
        light = six.shade([Light(toward)]).numpy()[16, 16] * exposure
        expected = 255 * (1.055 * min(light[0], 1.0) ** (1 / 2.4) - 0.055)
        seen = picture(page)
        assert np.abs(seen[seen.shape[0] // 2, seen.shape[1] // 2] - expected).max() <= 4
    before, box = picture(page), page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 20, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 60, box["y"] + 220)
    assert np.abs(picture(page) - before).max() > 5


def test_a_damaged_page_says_so(model, tmp_path, show):
    model.save(tmp_path / "four.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "four.wlm"])
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    middle = text.index('id="content"') + 3000
    letter = "A" if text[middle] != "A" else "B"
    (tmp_path / "page.html").write_text(text[:middle] + letter + text[middle + 1 :], encoding="utf-8")
    page = show(tmp_path / "page.html")
    assert "damaged" in page.locator("#message").inner_text()
    show.errors.clear()  # the page also throws it, for the console


def test_light_groups_are_added_by_their_sliders(tmp_path, show):
    model = random_groups(np.random.default_rng(6).random((236, 247)) < 0.8)
    model.save(tmp_path / "groups.wlm")
    write_page(tmp_path / "page.html", [tmp_path / "groups.wlm"])
    page = show(tmp_path / "page.html")
    decoder = model.decoder()

    def check(time: float) -> None:
        expected = decoder.frame(time)
        seen = numbers(page, f"kind.read({time})").reshape(*expected.shape[:2], 4)[..., :3]
        # Each of the four additions rounds to half floats, and so did each map.
        assert np.abs(seen - expected).max() < 5 * 2**-11 * expected.max() + 2 / 255 * 0.1

    for time in (13.0, 3.0):
        check(time)
    before = picture(page)
    decodes = "wlm.then(({kind}) => kind.groups.map((group) => group.maps.map((map) => map.key)).join(' '))"
    maps = page.evaluate(decodes)
    page.get_by_label("lamp", exact=True).evaluate("(input) => { input.value = 0; input.oninput(); }")
    page.get_by_label("colour of sun").evaluate("(input) => { input.value = '#ff0080'; input.oninput(); }")
    decoder.set_weights({"lamp": 0.0, "sun": (1.0, 0.0, ((128 / 255 + 0.055) / 1.055) ** 2.4)})
    assert np.abs(picture(page) - before).max() > 20, "in the next picture"
    check(3.0)
    assert page.evaluate(decodes) == maps, "nothing is decoded again"
    assert "off" in page.locator("#panel label:has-text('lamp') output").inner_text()
    page.close()


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A scene of known light with a moving square and smoke, and its page."""
    path = day_scenes.write_scene(tmp_path_factory.mktemp("room"))
    write_page(path.with_suffix(".html"), [path])
    return path


def check_scene(page, path, times, share):
    """Compares a scene's page with Python's pictures at hours and seconds: all pixels, those of edges included."""
    page.keyboard.press("m")  # nothing moves by itself
    page.evaluate("wlm.then(({kind}) => { kind.samples = 0; })")  # one sample a pixel, at its middle, as here
    height, width = picture(page).shape[:2]
    with wlm.scene.load(path) as scene, Renderer(scene, height, width, samples=1) as renderer:
        for hour, second in times:
            expected = renderer.draw(second, hour=hour, complete=True).picture().astype(int)
            page.evaluate(f"wlm.then(({{kind}}) => kind.show({hour}, {second}))")
            seen = picture(page)
            # Edges may fall on a pixel's middle.
            assert (np.abs(seen - expected).max(-1) <= 2).mean() > share
            assert np.unique(seen.reshape(-1, 3), axis=0).shape[0] > 20


def test_a_scene_is_drawn_as_in_python(room, show):
    page = show(room.with_suffix(".html"), width=340 + 320, height=240)
    # In daylight, within the switch of a lamp, and at night; smoke is over the wall, beside the moving square.
    check_scene(page, room, ((9.0, 0.3), (18.5, 1.7), (23.0, 3.1)), 0.997)


@pytest.mark.slow
def test_the_street_is_drawn_as_in_python_from_8_megabytes(tmp_path, show):
    path = Path(__file__).parents[3] / "demos" / "data" / "street" / "street.yaml"
    assert write_page(tmp_path / "street.html", [path]) <= 8_000_000
    page = show(tmp_path / "street.html", width=340 + 480, height=320)
    check_scene(page, path, ((7.0, 2.0), (12.0, 7.0), (22.0, 17.0)), 0.98)


def test_a_person_moves_around_in_a_scene(room, show):
    page = show(room.with_suffix(".html"), touch=True)
    page.keyboard.press("m")
    page.evaluate("wlm.then(({kind}) => kind.show(12, 0))")
    still = picture(page)
    np.testing.assert_array_equal(picture(page), still)
    page.get_by_label("sun", exact=True).evaluate("(input) => { input.value = 0; input.oninput(); }")
    dim = picture(page)
    assert dim.mean() < still.mean() - 1
    # In the error view the same picture of the original is compared, which has the sun.
    page.get_by_role("button", name="original", exact=True).click()
    assert np.abs(picture(page) - still).mean() < 1
    page.get_by_role("button", name="decoded", exact=True).click()
    camera = "wlm.then(({kind}) => [kind.view, ...kind.flight.eye, kind.flight.yaw])"
    start = page.evaluate(camera)
    assert start[0] == "path"
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 200)
    page.mouse.up()
    turned = page.evaluate(camera)
    assert turned[0] == "fly" and turned[1:4] == start[1:4] and turned[4] > start[4]
    page.keyboard.down("w")
    wait_for(page, f"kind.flight.eye[2] < {start[3] - 0.01}")  # the camera looks along -z
    page.keyboard.up("w")
    page.keyboard.press("o")
    assert page.evaluate(camera)[0] == "orbit" and np.abs(picture(page) - dim).max() > 20
    page.keyboard.press("c")
    page.evaluate("document.activeElement.blur()")  # the picture has a line around it while it has the focus
    np.testing.assert_array_equal(picture(page), dim)
    # A played day is the film: its second follows from the hour, and all moves.
    page.keyboard.press(" ")
    wait_for(page, "kind.time > 13 && Math.abs(kind.second - (kind.shown - 5) / 6) < 0.2")
    page.keyboard.press(" ")
    page.keyboard.press("m")
    wait_for(page, "!kind.waiting.length")
    second = page.evaluate("wlm.then(({kind}) => kind.second)")
    wait_for(page, f"kind.second > {second}")
    text = help_of(page)
    for words in ("the hour", "play, pause", "fly", "follow the path", "orbit"):
        assert words in text


def test_a_scene_fits_a_phone(room, show):
    page = show(room.with_suffix(".html"), width=330, height=640, touch=True)
    page.keyboard.press("m")
    page.evaluate("wlm.then(({kind}) => kind.show(12, 0))")
    box = page.locator("#view").bounding_box()
    assert box["width"] == 330 and box["height"] >= 320
    assert page.evaluate("document.documentElement.scrollWidth") <= 330
    for control in page.locator("#panel button, #panel input").all():
        each = control.bounding_box()
        assert each["x"] >= 0 and each["x"] + each["width"] <= 330
    before = picture(page)
    page.evaluate("""() => {
        const view = document.getElementById('view');
        const touch = (kind, id, x, y) => view.dispatchEvent(new PointerEvent(
            kind, {pointerId: id, clientX: x, clientY: y, pointerType: 'touch', bubbles: true}));
        view.setPointerCapture = () => {};
        for (const [id, x] of [[5, 150], [6, 180]]) touch('pointerdown', id, x, 100);
        touch('pointermove', 6, 280, 100);
        for (const id of [5, 6]) touch('pointerup', id, 200, 100);
    }""")
    assert np.abs(picture(page) - before).max() > 20, "two fingers move the camera"
