"""The virtual texture against the decoders of whole maps and a NumPy twin: pages, tables, time, damage and loading."""

from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of
from builders.light_groups import DARK, random_groups
from builders.synthetic import random_model, random_sheet

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.sheet import LIGHT, Sheet
from wlm.lightmap.tiles import TileKind
from wlm.lightmap.virtual.clock import Clock
from wlm.lightmap.virtual.texture import VirtualTexture
from wlm.texels import OFFSETS, nearest_valid
from wlm_kernels.lightmap.pages import AFTER, BEFORE, FAR, PARTS, SHARE, WAITING

KINDS = (3, 4, 3, 1, 0, 3)
SWITCH = 18.0 + 55.0 / 60.0
TIMES = (0.0, 7.5, 13.0, 18.75, SWITCH)
SMALL = {"side": 8, "border": 1, "gelu": "tanh"}


def gappy() -> np.ndarray:
    """A mask of 236 x 375 texels with gaps inside and between tiles."""
    mask = np.zeros((236, 375), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[40:200, 126:150] = mask[130:200, 200:340] = True
    mask[::7, 270:300] = True
    return mask


def view(own, level=0.0, pixels=96, window=(0.0, 0.0, 1.0, 1.0)):
    """Sheet numbers, texture coordinates and derivatives of an image of a window of a map, drawn at a mip level."""
    y, x = (np.mgrid[:pixels, :pixels] + 0.5) / pixels
    left, top, right, bottom = window
    uv = np.stack([left + x * (right - left), top + y * (bottom - top)], 2).astype(np.float32)
    derivative = np.zeros((pixels, pixels, 4), np.float32)
    derivative[..., 0], derivative[..., 3] = 2.0**level / own.width, 2.0**level / own.height
    return np.zeros((pixels, pixels), np.int32), uv, derivative


def settle(virtual, time, at, most=400):
    """Draws frames until no page is missing or stale."""
    for _ in range(most):
        virtual.frame(time, *at)
        virtual.wait(5.0)
        report = virtual.report()
        # A quarter of the pixels takes a turn in 16 frames.
        if not (report["missing"] + report["stale"] + report["decoded"]) and _ >= 64:
            return
    raise AssertionError(report)


def level_twin(light, valid, level):
    """Light of a mip level by its definition, and which texels have a valid one below them: means of all valid texels,
    and gaps filled from the nearest texel, or with coarse texels."""
    step, (height, width) = 1 << level, valid.shape
    shape = -(-height // step), -(-width // step)
    padding = [(0, n * step - size) for n, size in zip(shape, valid.shape, strict=True)]
    blocks = (shape[0], step, shape[1], step)
    count = np.pad(valid, padding).reshape(blocks).sum((1, 3))
    total = np.pad(light * valid[..., None], (*padding, (0, 0))).reshape(*blocks, 3).sum((1, 3))
    mean, covered = total / np.maximum(count, 1)[..., None], count > 0
    if level >= 4:
        return mean[nearest_valid(covered)] if covered.any() else mean, covered
    coarse = level_twin(light, valid, 4)[0]
    filled, found = coarse[np.ix_(*(np.arange(n) * step // 16 for n in shape))], covered.copy()
    filled[covered] = mean[covered]
    reach = range(-FAR, FAR + 1)
    far = sorted(
        ((y, x) for y in reach for x in reach if y * y + x * x <= FAR**2), key=lambda a: (a[0] ** 2 + a[1] ** 2, a)
    )
    for y, x in OFFSETS if level else far:
        at = np.argwhere(~found) + (y, x)
        at = at[((at >= 0) & (at < shape)).all(1)]
        at = at[covered[tuple(at.T)]]
        filled[tuple((at - (y, x)).T)] = mean[tuple(at.T)]
        found[tuple((at - (y, x)).T)] = True
    return filled, covered


def stored_texels(own):
    """The valid texels of tiles that are not empty."""
    return own.mask & own.grid.texels_of((own.kind != TileKind.EMPTY).reshape(own.grid.rows, own.grid.cols))


def shown_level(virtual, own, level, sheet=0):
    """Puts the decoded pages of a level together, float32 [h, w, 3]; NaN where no page is."""
    layout, state = virtual.layout, virtual.state()
    side, border = layout.side, layout.border
    height, width = -(-own.height // (1 << level)), -(-own.width // (1 << level))
    image = np.full((-(-height // side) * side, -(-width // side) * side, 3), np.nan, np.float32)
    for page in np.flatnonzero((layout.place[:, 0] == sheet) & (layout.place[:, 1] == level) & (state.slot >= 0)):
        _, _, row, column = layout.place[page]
        inner = state.texture[state.slot[page]][border : border + side, border : border + side]
        image[row * side : (row + 1) * side, column * side : (column + 1) * side] = unpack_rgb9e5(inner)
    return image[:height, :width]


def assert_near(got, expected, steps=1.02):
    """Compares RGB9E5 texels with exact values, in steps of the format: those in gaps are rounded twice."""
    step = expected.max(-1, keepdims=True) / 256 + 1e-6
    assert (np.abs(got - expected) <= steps * step).all(), np.abs((got - expected) / step).max()


def test_pages_of_all_kinds_continue_across_tiles(device):
    model = random_model(KINDS, columns=3, mask=gappy())
    own, edge = model.light, 136
    with VirtualTexture(model, device, gelu="tanh") as virtual:
        settle(virtual, 9.0, view(own))
        expected = level_twin(SheetDecoder(own, device).frame(9.0).astype(np.float64), stored_texels(own), 0)[0]
        state, layout = virtual.state(), virtual.layout
        pages = np.flatnonzero((layout.place[:, 1] == 0) & (state.slot >= 0))
        assert len(pages) == 6
        for page in pages:
            row, column = layout.place[page, 2:] * 128 - 4
            y = np.clip(row + np.arange(edge), 0, own.height - 1)
            x = np.clip(column + np.arange(edge), 0, own.width - 1)
            # The other decoder rounds each of the two stored times, too.
            assert_near(unpack_rgb9e5(state.texture[state.slot[page]]), expected[np.ix_(y, x)])


@pytest.mark.parametrize("time", [13.0, 10.1])
def test_mips_are_means_of_all_texels(time, device):
    model = random_model(KINDS, columns=3, mask=gappy())
    own = model.light
    valid, light = stored_texels(own), SheetDecoder(own, device).frame(time).astype(np.float64)
    with VirtualTexture(model, device, **SMALL, decodes=64, tolerance=1e-6) as virtual:
        for level in range(1, 4):
            settle(virtual, time, view(own, level))
            assert_near(shown_level(virtual, own, level), level_twin(light, valid, level)[0])
        for level in (4, 5):
            settle(virtual, time, view(own, level))
            twin, covered = level_twin(light, valid, level)
            assert_near(shown_level(virtual, own, level)[covered], twin[covered])


def test_values_that_are_not_light_have_their_own_gamma(device):
    directions = random_sheet((3, 4), gamma=1.0, seed=1)
    sheets = {LIGHT: random_sheet((3, 3)), Sheet("0", "dir", encoding="signed"): directions}
    model = LightmapModel("two", "0123456789abcdef", sheets[LIGHT].profile, sheets)
    with VirtualTexture(model, device, **SMALL, decodes=64) as virtual:
        for s, own in enumerate(sheets.values()):
            at = view(own, 2.0)
            settle(virtual, 7.5, (at[0] + s, *at[1:]))
            twin = level_twin(SheetDecoder(own, device).frame(7.5).astype(np.float64), stored_texels(own), 2)[0]
            assert_near(shown_level(virtual, own, 2, s), twin)
    assert virtual.layout.whole.tolist() == [i for i, parent in enumerate(virtual.layout.parent) if parent < 0]
    assert len(virtual.layout.whole) == 2


def is_shown(virtual, state, page):
    """Whether all parts of a page are decoded."""
    parts = PARTS if virtual.layout.place[page, 1] == 3 else 1
    return state.slot[page] >= 0 and (state.parts[state.slot[page]] >= parts or state.parent[page] < 0)


def read_twin(virtual, own, uv, level):
    """Reads one level bilinearly at a point, from the finest resident page, in float64."""
    layout, state = virtual.layout, virtual.state()
    side, border = layout.side, layout.border

    def page_at(level):
        at = np.clip(uv, 0.0, 1.0) * [own.width, own.height] / 2.0**level
        most = np.ceil(np.array([own.width, own.height]) / (side << level)).astype(int) - 1
        column, row = np.minimum((at // side).astype(int), most)
        return at, int(layout.first[0, level] + row * layout.columns[0, level] + column)

    at, page = page_at(level)
    while not is_shown(virtual, state, page):
        level += 1
        at, page = page_at(level)
    x, y = at - layout.place[page, [3, 2]] * side + border - 0.5
    texels = unpack_rgb9e5(state.texture[state.slot[page]]).astype(np.float64)
    j, i = int(x), int(y)
    weight = np.outer([i + 1 - y, y - i], [j + 1 - x, x - j])
    return (weight[..., None] * texels[i : i + 2, j : j + 2]).sum((0, 1)), level


def test_sampling_is_trilinear_and_falls_back_to_coarser_pages(device):
    model = random_model(KINDS, columns=3)
    own, random = model.light, np.random.default_rng(0)
    with VirtualTexture(model, device, **SMALL, decodes=16) as virtual:
        settle(virtual, 7.5, view(own, 1.5, window=(0.0, 0.0, 0.5, 0.5)))
        uv = random.uniform(-0.1, 1.1, (200, 2)).astype(np.float32)
        levels = random.uniform(-1.0, 7.0, 200)
        derivative = np.zeros((200, 4), np.float32)
        derivative[:, 1], derivative[:, 2] = 0.5 * 2.0**levels / own.width, 2.0**levels / own.height
        reading = virtual.sample(np.zeros(200, np.int32), uv, derivative)
        clamped = np.clip(levels, 0.0, virtual.layout.levels[0] - 1)
        for i, (point, level) in enumerate(zip(uv.astype(np.float64), clamped, strict=True)):
            fine, share = int(level), level - int(level)
            light, found = read_twin(virtual, own, point, fine)
            if share > 0.0:
                light = (1.0 - share) * light + share * read_twin(virtual, own, point, fine + 1)[0]
            np.testing.assert_allclose(reading.light[i], light, rtol=2e-3, atol=2e-3)
            assert reading.coarser[i] == found - fine
        assert len(set(reading.coarser.tolist())) > 2, "some pages are there, and some are missing"


def test_points_without_light(device):
    model = random_model((3, 1), columns=2)
    with VirtualTexture(model, device, **SMALL) as virtual:
        sheet, uv, derivative = view(model.light)
        sheet[:] = -1
        sheet[0, :4] = 0, 0, 0, 7
        uv[0, 0, 1], uv[0, 1, 0], derivative[0, 2, 3] = np.nan, np.inf, np.nan
        for _ in range(70):
            virtual.frame(3.0, sheet, uv, derivative)
        assert virtual.report()["visible"] == 1, "only the page that always stays"
        reading = virtual.sample(sheet, uv, derivative)
        assert not reading.light.any() and (reading.coarser == -1).all() and not reading.change.any()
        assert "finite" in error_of(virtual.frame, np.nan, sheet, uv, derivative)


@pytest.mark.parametrize("kinds", [(1,), (1, 1, 1, 1), (0,), (3,)])
def test_simple_models(kinds, device):
    model = random_model(kinds, columns=1 if len(kinds) == 1 else 2)
    own = model.light
    with VirtualTexture(model, device, **SMALL, decodes=8) as virtual:
        at = view(own, 3.0)
        settle(virtual, 10.0, at)
        twin = level_twin(SheetDecoder(own, device).frame(10.0).astype(np.float64), stored_texels(own), 3)[0]
        assert_near(shown_level(virtual, own, 3), twin)
    with VirtualTexture(model, device) as virtual:
        assert len(virtual.layout.parent) == (1 if len(kinds) == 1 else 5)


def check_tables(virtual):
    """Checks that slots and pages refer to each other, and that the table has the finest resident page of each page."""
    state, layout = virtual.state(), virtual.layout
    held = [(page, slot) for slots in (state.slot, state.ahead) for page, slot in enumerate(slots) if slot >= 0]
    assert len({slot for _, slot in held}) == len(held) and all(state.owner[slot] == page for page, slot in held)
    assert np.count_nonzero(state.owner >= 0) == len(held)
    assert (state.slot[layout.whole] >= 0).all() and (state.stamp[state.owner < 0] == -1).all()
    for page, entry in enumerate(state.table):
        shown = page
        while not is_shown(virtual, state, shown):
            shown = state.parent[shown]
        assert entry == 16 * state.slot[shown] + layout.place[shown, 1]


@pytest.mark.parametrize("frames", [150, pytest.param(10_000, marks=pytest.mark.slow)])
def test_random_cameras_and_times_leave_the_tables_consistent(frames, device):
    model = random_model(KINDS, columns=3, times=TIMES)
    own, random = model.light, np.random.default_rng(1)
    with VirtualTexture(model, device, **SMALL, budget=60 * 400, decodes=6) as virtual:
        size, clock, used = sum(virtual.report()["memory"].values()), 17.9, set()
        for frame in range(frames):
            clock = random.uniform(0.0, 24.0) if random.random() < 0.02 else clock + random.uniform(-0.02, 0.06)
            centre, reach, level = random.uniform(0.0, 1.0, 2), random.uniform(0.0, 0.1), random.uniform(0.0, 6.0)
            window = (*(centre - reach), *(centre + reach))
            virtual.frame(clock, *view(own, level, 16, window))
            if frame % 10 == 0:
                check_tables(virtual)
                used |= set(virtual.state().ahead.tolist())
        assert len(used) > 1, "pages were decoded ahead of the switch"
        assert sum(virtual.report()["memory"].values()) == size and virtual.report()["slots"] == 60
        at = view(own, 3.5, window=(0.2, 0.2, 0.5, 0.5))
        settle(virtual, clock, at)
        check_tables(virtual)
        reading = virtual.sample(*at)
        assert (reading.coarser == 0).all() and reading.change.max() <= virtual.tolerance


def test_a_lamp_is_on_in_the_first_frame_after_its_switch(device):
    model = random_model((3, 3, 4, 3), times=TIMES)
    own, decoder = model.light, SheetDecoder(model.light, device)
    at = view(own, 3.0)
    valid = stored_texels(own)

    def error(time):
        twin = level_twin(decoder.frame(time).astype(np.float64), valid, 3)[0]
        return np.abs(shown_level(virtual, own, 3) - twin).max() / twin.max()

    with VirtualTexture(model, device, **SMALL, decodes=2) as virtual:
        settle(virtual, 18.0, at, 2000)
        for clock in np.linspace(18.0, 18.8, 400):
            virtual.frame(clock, *at)
        assert virtual.report()["ahead"] == 0, "all visible pages are ready"
        # Within the switch the lamp is still off.
        virtual.frame(SWITCH - 1e-6, *at)
        assert error(18.75) < 0.05 < error(SWITCH)
        virtual.frame(SWITCH, *at)
        assert error(SWITCH) < 0.01
        check_tables(virtual)
        # Back again: what was decoded ahead is dropped, and pages are decoded one after another.
        virtual.frame(18.8, *at)
        assert error(SWITCH) < 0.2 and virtual.report()["stale"] > 2
        virtual.frame(12.0, *at)
        assert (virtual.state().ahead < 0).all()


def test_pages_are_decoded_again_when_their_light_has_changed(device):
    model = random_model((1, 1, 1, 1))
    # One tile changes by 10% an hour until 7.5 h, the others are constant.
    light = model.light.constant
    light[1:] = light[1:, :1]
    light[0] = 1.0
    light[0, 1] = 1.0 / 0.25
    at = view(model.light, 1.0)
    with VirtualTexture(model, device, side=64, border=1, decodes=64, tolerance=0.05) as virtual:
        settle(virtual, 0.0, at)
        # RMS 1 to 4 by 7.5 h: 75% of the brighter time, 10% an hour. Pages are decoded when they are 1.5% or 0.15 h
        # late, for a time at which they are as early; the page of the sheet, a second mip, when it is 5% late.
        for hour, expected in ((0.1, 0), (0.14, 0), (0.16, 1), (0.3, 0), (0.45, 0), (0.47, 1), (0.62, 1)):
            virtual.frame(hour, *at)
            assert virtual.report()["decoded"] == expected, hour
        reading = virtual.sample(*at)
        inside = (at[1] < 0.45).all(2)
        np.testing.assert_allclose(reading.light[inside], 1.0 + 3.0 * 0.62 / 7.5, rtol=0.004)
        assert reading.change.max() < 1e-4
        # A clock that stands still, or jumps, has light of its own time.
        for hour in (5.0, 5.0):
            virtual.frame(hour, *at)
        reading = virtual.sample(*at)
        np.testing.assert_allclose(reading.light[inside], 3.0, rtol=0.004)
        assert reading.change.max() < 1e-4


def test_what_is_refused():
    model = random_model((3, 1), columns=2)
    whole = 3 * 4 * 136 * 136
    assert error_of(VirtualTexture, model, budget=whole - 1, decodes=2) == (
        f"budget: expected at least {whole} bytes, for 1 pages that always stay and the 2 that a frame decodes, got "
        f"{whole - 1}"
    )
    assert "decodes: expected 1 to" in error_of(VirtualTexture, model, decodes=0)
    assert "tolerance: expected" in error_of(VirtualTexture, model, tolerance=0.0)
    assert "side: expected" in error_of(VirtualTexture, model, side=100)
    assert "border: expected" in error_of(VirtualTexture, model, border=0)
    assert "tiles: expected at least" in error_of(VirtualTexture, random_model((3, 3), columns=2), side=64, tiles=10)


def test_groups_are_added_by_their_weights(device):
    model = random_groups()
    weights = {"sky": (1.0, 1.0, 1.0), "sun": (0.25, 1.5, 0.0), "lamp": (0.0, 0.0, 0.0), DARK: (1.0, 1.0, 1.0)}
    at = view(model.light, 3.0, 32)

    def expected(hour):
        own = model.light
        total = np.zeros((-(-own.height // 8), -(-own.width // 8), 3))
        for sheet, own in model.sheets.items():
            light = SheetDecoder(own, device).frame(hour).astype(np.float64)
            total += np.array(weights[sheet.group]) * level_twin(light, stored_texels(own), 3)[0]
        centre = (np.stack(np.mgrid[: total.shape[0], : total.shape[1]][::-1], 2) + 0.5) * 8.0
        return total, (centre / [own.width, own.height]).astype(np.float32)

    with VirtualTexture(model, device, **SMALL, decodes=32) as virtual:
        virtual.set_weights(weights)
        settle(virtual, 9.0, at)
        for hour in (9.0, 15.0):
            virtual.set_weights({"lamp": (2.0, 1.0, 0.5)} if hour == 9.0 else {"lamp": 0.0})
            weights["lamp"] = tuple(virtual.weights["lamp"].tolist())
            if hour != 9.0:
                settle(virtual, hour, at)
            # The lamp is there without a further frame.
            total, uv = expected(hour)
            derivative = np.zeros((*uv.shape[:2], 4), np.float32)
            derivative[..., 0], derivative[..., 3] = 8.0 / model.light.width, 8.0 / model.light.height
            reading = virtual.sample(np.zeros(uv.shape[:2], np.int32), uv, derivative)
            assert (reading.coarser == 0).all() and reading.change.max() <= virtual.tolerance
            # The last texel of a row reaches past the map's end: its centre is clamped.
            assert_near(reading.light[:-1, :-1], total[:-1, :-1], 4.0)
        check_tables(virtual)
        assert "expected a group among sky, sun, lamp" in error_of(virtual.set_weights, {"moon": 1.0})
    sheets = {replace(LIGHT, group=str(i)): model.light for i in range(9)}
    nine = LightmapModel("nine", "0" * 16, model.profile, sheets)
    assert error_of(VirtualTexture, nine) == "nine: expected at most 8 light groups, got 9"


def test_tiles_are_loaded_when_they_are_needed(tmp_path, device):
    random_model((3, 3, 4) * 8, columns=6).save(tmp_path / "a.wlm")
    with wlm.load(tmp_path / "a.wlm") as model:
        own = model.light
        with VirtualTexture(model, device, **SMALL, decodes=64, tiles=550_000) as virtual:
            assert virtual.report()["memory"]["tiles"] <= 550_000 < model.memory_bytes
            for window in ((0.0, 0.0, 0.3, 1.0), (0.7, 0.0, 1.0, 1.0), (0.0, 0.0, 0.3, 1.0)):
                at = view(own, 1.0, window=window)
                settle(virtual, 13.0, at)
                assert (virtual.sample(*at).coarser == 0).all()
            twin = level_twin(SheetDecoder(own, device).frame(13.0).astype(np.float64), stored_texels(own), 1)[0]
            got = shown_level(virtual, own, 1)
            there = np.isfinite(got).all(2)
            assert there.mean() > 0.3
            assert_near(got[there], twin[there])
            check_tables(virtual)
            virtual.close()


def test_a_damaged_tile_shows_its_parent_page(tmp_path, device):
    random_model((3, 3, 3, 3), columns=2).save(tmp_path / "a.wlm")
    content = bytearray((tmp_path / "a.wlm").read_bytes())
    content[-1 - int(read_artifact(tmp_path / "a.wlm").pieces["0.tiles"].sizes[2:].sum())] ^= 1
    (tmp_path / "a.wlm").write_bytes(content)
    with wlm.load(tmp_path / "a.wlm") as model, VirtualTexture(model, device, decodes=4) as virtual:
        assert len(virtual.warnings) == 1 and "tile 1: " in virtual.warnings[0]
        assert virtual.warnings[0].endswith("the light around it is shown instead")
        at = view(model.light)
        for _ in range(80):
            virtual.frame(7.5, *at)
        reading = virtual.sample(*at)
        damaged = (at[1][..., 0] * model.light.width >= 128) & (at[1][..., 1] * model.light.height < 128)
        assert (reading.coarser[damaged] == 1).all() and (reading.coarser[~damaged] == 0).all()
        assert np.isfinite(reading.light).all() and (reading.light[damaged].sum(1) > 0.0).all()
        assert virtual.report()["warnings"] == virtual.warnings
        with pytest.raises(WlmError):
            model.decoder(tiles=[1])


def test_a_tile_that_is_damaged_later_is_one_line(tmp_path, device):
    random_model((3, 3, 4) * 8, columns=6).save(tmp_path / "a.wlm")
    with wlm.load(tmp_path / "a.wlm") as model:
        own = model.light
        with VirtualTexture(model, device, **SMALL, tiles=550_000) as virtual:
            tile = int(np.flatnonzero(virtual._stores[0].slot == WAITING)[0])
            sizes = read_artifact(tmp_path / "a.wlm").pieces["0.tiles"].sizes
            with open(tmp_path / "a.wlm", "r+b") as file:
                file.seek(-int(sizes[tile:].sum()), 2)
                file.write(bytes(sizes[tile]))
            row, column = np.array(divmod(tile, 6)) * 128
            # Inside the tile, farther from its border than a page reads.
            window = np.array([column + 32, row + 32, column + 96, row + 96]) / ([own.width, own.height] * 2)
            at = view(own, 0.0, 32, window)
            for _ in range(120):
                virtual.frame(7.5, *at)
                virtual.wait(1.0)
            assert len(virtual.warnings) == 1 and f"tile {tile}: " in virtual.warnings[0]
            reading = virtual.sample(*at)
            assert (reading.coarser == 1).all() and reading.light.any()
            check_tables(virtual)


def test_a_view_without_pixels(device):
    model = random_model((1,), columns=1)
    nothing = np.zeros((0, 0), np.int32), np.zeros((0, 0, 2), np.float32), np.zeros((0, 0, 4), np.float32)
    with VirtualTexture(model, device, **SMALL) as virtual:
        virtual.frame(1.0, *nothing)
        assert virtual.sample(*nothing).light.shape == (0, 0, 3) and virtual.report()["visible"] == 1


@pytest.mark.parametrize(
    ("times", "period", "moves"),
    [
        # Each move: a time, the stored times around it, and whether pages are adopted, dropped and prepared.
        ((0.0, 6.0, 12.0, 18.0, 18.1), 24.0, [(17.5, (2, 3), 1), (18.05, (3, 4), 1), (18.1, (4, 0), "adopt")]),
        ((0.0, 6.0, 12.0, 18.0, 18.1), 24.0, [(17.5, (2, 3), 1), (3.0, (0, 1), "adopt"), (17.9, (2, 3), 1)]),
        ((0.0, 6.0, 12.0, 18.0, 18.1), 24.0, [(17.5, (2, 3), 1), (17.0, (2, 3), "drop"), (16.0, (2, 3), 0)]),
        # Over midnight.
        ((0.0, 6.0, 12.0, 18.0, 23.9), 24.0, [(23.0, (3, 4), 1), (23.95, (4, 0), 1), (24.01, (0, 1), "adopt")]),
        (
            (0.0, 10.0, 10.5, 20.0),
            None,
            [(9.9, (0, 1), 1), (10.5, (2, 3), "adopt"), (99.0, (3, 3), 0), (9.0, (0, 1), 0)],
        ),
        ((5.0,), 24.0, [(4.0, (0, 0), 0), (6.0, (0, 0), 0)]),
        ((5.0,), None, [(4.0, (0, 0), 0), (6.0, (0, 0), 0)]),
        ((5.0, 5.1), None, [(5.05, (0, 1), 0), (5.1, (1, 1), 0)]),
    ],
)
def test_the_clock_passes_switches(times, period, moves):
    clock = Clock(TimeAxis(np.array(times), period, "frames"))
    for time, around, wanted in moves:
        rows, (adopt, drop, prepare, _) = clock.frame(time)
        assert (adopt, drop) == (int(wanted == "adopt"), int(wanted == "drop")), time
        assert wanted in ("adopt", "drop") or prepare == wanted, time
        assert rows[0, [BEFORE, AFTER]].tolist() == list(around)
        held = around[0] in clock.switches
        assert rows[0, SHARE] == (0.0 if held else np.float32(clock.axis.neighbours(time)[2]))
