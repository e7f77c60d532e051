"""Scores of decoded lightmaps, and the views that they are drawn from: cameras, surface points, visibility."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from builders.atlas_meshes import sheet
from builders.atlas_models import random_model
from builders.checks import error_of
from builders.lit_cube import DIRECTIONS, HEIGHT, WIDTH, lit_cube, waves

from wlm import metrics
from wlm.atlas.data import from_arrays, join
from wlm.atlas.evaluation import compare, evaluate
from wlm.atlas.views import sheet_charts, visibility, visible_uv
from wlm.ops import raster
from wlm.ops.views import View, clip_positions, normalised, sphere_views

FACES = [View.of(direction) for direction in DIRECTIONS]
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], np.float64)
TWO = np.array([[0, 1, 2], [2, 1, 3]])
SQUARE_UV = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float64)


def _reader(mesh, change=lambda colour, uv, triangle: colour):
    """Decodes what the reference holds, with a change."""
    image = torch.tensor(mesh.sheets[0].lightmap)

    def sample(points, state=0):
        return change(raster.texture(image.to(points.uv.device), points.uv), points.uv, points.triangle)

    return sample


def _offset(amount):
    return lambda colour, uv, triangle: colour + amount


def _one(mesh, decoder, **options):
    return compare(mesh, {"it": decoder}, **({"views": FACES, "resolution": 64} | options))["it"]


def test_the_reference_is_exact(device):
    mesh = lit_cube()
    report = _one(mesh, _reader(mesh), views=12, device=device)
    assert report.views == 12 and report.pixels > 4000 and report.name == "cube"
    assert report.psnr == report.psnr_worst == report.texel_psnr == metrics.PSNR_CAP_DB
    assert report.one_minus_ssim == report.seam_error == report.rest_error == 0.0 and math.isnan(report.seam_ratio)
    values = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert values["psnr"] == 120.0 and values["seam_ratio"] is None and values["one_minus_ssim"] == 0.0
    upside_down = torch.tensor(mesh.sheets[0].lightmap, device=device).flip(0).contiguous()
    report = _one(mesh, lambda points, state: raster.texture(upside_down, points.uv), views=12, device=device)
    assert report.psnr < 12.0 and report.texel_psnr < 12.0 and report.one_minus_ssim > 0.5


def test_a_known_error(device):
    mesh = lit_cube()
    report = _one(mesh, _reader(mesh, _offset(0.01)), device=device)
    colours = []
    for visible, _, uv in visible_uv(mesh, FACES, 64, "cpu"):
        colours.append(raster.texture(torch.tensor(mesh.sheets[0].lightmap), uv[visible >= 0]))
    peak = float(torch.cat(colours).max() - torch.cat(colours).min())
    expected = 20.0 * math.log10(peak / 0.01)
    assert report.peak == pytest.approx(peak, rel=1e-6) and 1.5 < peak < 2.1
    assert [report.psnr, report.psnr_worst, report.texel_psnr] == pytest.approx([expected] * 3, abs=1e-3)
    assert report.rest_error == pytest.approx(0.01, rel=1e-4)


@pytest.mark.parametrize("resolution", [40, 90])
def test_against_the_metrics_of_pictures(device, resolution):
    """A blurred lightmap in views that cut nothing off; each view by `wlm.metrics` on its whole pictures."""
    mesh, views = lit_cube(3), sphere_views(4, seed=3)
    small = torch.tensor(waves(12, 18))

    def blurred(points, state):
        return raster.texture(small.to(points.uv.device), points.uv)

    report = _one(mesh, blurred, views=views, resolution=resolution, device=device)
    psnr, ssim = [], []
    for visible, _, uv in visible_uv(mesh, views, resolution, "cpu"):
        images = torch.tensor(mesh.sheets[0].lightmap), small
        pictures = [raster.texture(image, uv).numpy() for image in images]
        seen = visible.numpy() >= 0
        error = np.square(pictures[0][seen].astype(np.float64) - pictures[1][seen]).mean()
        psnr.append(metrics.psnr_from_mse(error, report.peak))
        ssim.append(metrics.ssim(*pictures, seen, report.peak))
    assert report.psnr == pytest.approx(np.mean(psnr), abs=1e-4)
    assert report.psnr_worst == pytest.approx(min(psnr), abs=1e-4) and report.worst_view == np.argmin(psnr)
    assert 0.01 < report.one_minus_ssim == pytest.approx(1.0 - np.mean(ssim), abs=1e-4)


def test_pictures_smaller_than_the_window_of_ssim():
    mesh = lit_cube()
    assert math.isnan(_one(mesh, _reader(mesh, _offset(0.1)), resolution=8).one_minus_ssim)
    assert _one(mesh, _reader(mesh, _offset(0.1)), resolution=8).psnr > 20.0
    assert _one(mesh, _reader(mesh, _offset(0.1)), resolution=12).one_minus_ssim > 0.0


def test_charts():
    mesh = lit_cube(2)
    number = sheet_charts(mesh.sheets[0])
    assert number.shape == (48,) and len(set(number)) == 6
    assert (number.reshape(6, 8) == number[::8, None]).all()
    # Vertices of their own at equal places make no border; one place in UV with another in space does, and the reverse.
    six = np.arange(6).reshape(2, 3)
    for position, uv, count in (
        (SQUARE[TWO].reshape(6, 3), SQUARE_UV[TWO].reshape(6, 2), 1),
        (SQUARE[TWO].reshape(6, 3) + np.repeat([[0], [1.0]], 3, 0), SQUARE_UV[TWO].reshape(6, 2), 2),
        (SQUARE[TWO].reshape(6, 3), SQUARE_UV[TWO].reshape(6, 2) * np.repeat([[1], [0.5]], 3, 0), 2),
    ):
        assert len(set(sheet_charts(from_arrays(position, six, uv, waves()).sheets[0]))) == count
    # A shared corner alone doesn't join; a triangle without area is in none.
    fan = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], np.float64)
    mesh = from_arrays(fan, np.array([[0, 1, 2], [1, 2, 2], [0, 3, 4]]), fan[:, :2] * 0.5 + 0.5, waves())
    assert sheet_charts(mesh.sheets[0]).tolist() == [0, -1, 1]


def test_errors_beside_seams_stand_out():
    """An error in a frame of each chart. A cube's outline is no seam: its other side isn't on the screen."""
    mesh = lit_cube()

    def frame(width):
        def change(colour, uv, triangle):
            cell = (uv * torch.tensor([3.0, 2.0])) % 1.0  # charts reach from 0.05 to 0.95
            return torch.where(((cell - 0.5).abs().amax(dim=1) > 0.45 - width)[:, None], colour + 0.5, colour)

        return change

    decoders = {f"{width}": _reader(mesh, frame(width)) for width in (0.006, 0.05)}
    reports = compare(mesh, decoders | {"even": _reader(mesh, _offset(0.1))}, views=6, resolution=112)
    # A hundredth of a face is less than a pixel, so that it lies within one of the border; a tenth is about three.
    assert 0.1 < reports["0.006"].seam_error < 0.3 and reports["0.006"].seam_ratio > 10.0
    assert 0.4 < reports["0.05"].seam_error < 0.5 and 4.0 < reports["0.05"].seam_ratio < 6.0
    assert reports["even"].seam_ratio == pytest.approx(1.0, rel=1e-4)
    one_face = _one(mesh, decoders["0.05"])
    assert math.isnan(one_face.seam_error) and math.isnan(one_face.seam_ratio) and one_face.rest_error > 0.0


def test_seams_of_tiles_by_labels(device):
    """A sheet of one chart in tiles of a quarter: an error beside u = 1/2 is at a seam of the tiles only."""
    mesh = from_arrays(SQUARE, TWO, SQUARE_UV, waves())
    decoder = _reader(mesh, lambda colour, uv, t: torch.where((uv[:, :1] - 0.5).abs() < 0.02, colour + 1.0, colour))

    def tiles(points):
        return (points.uv[:, 0] * 4).int()

    options = {"views": [View.of([0, 0, 1])], "resolution": 96, "device": device}
    plain = compare(mesh, {"a": decoder, "b": decoder}, labels={"b": tiles}, **options)
    assert math.isnan(plain["a"].seam_ratio) and plain["b"].seam_ratio == math.inf
    # Three borders, four pixels wide and as high as the sheet; all that is wrong is at one of them.
    pixels = plain["b"].pixels
    assert plain["b"].rest_error == 0.0 and plain["a"].rest_error > 0.0
    assert plain["a"].rest_error * pixels == pytest.approx(plain["b"].seam_error * 12 * pixels**0.5)


def test_two_sheets_apart_have_no_seam_where_one_ends_before_the_other():
    position = np.concatenate([SQUARE * [0.5, 0.5, 1] + [0, 0, 0.5], SQUARE - [0, 0, 0.5]])
    uv = np.concatenate([SQUARE_UV * [0.4, 1], SQUARE_UV * [0.4, 1] + [0.6, 0]])
    mesh = from_arrays(position, np.concatenate([TWO, TWO + 4]), uv, waves())
    ((visible, _, _),) = visible_uv(mesh, [View.of([0, 0, 1])], 64, "cpu")
    assert {0, 1, 2, 3} <= set(visible.unique().tolist())
    assert math.isnan(_one(mesh, _reader(mesh, _offset(0.1)), views=[View.of([0, 0, 1])]).seam_error)


def test_views_that_see_nothing_are_left_out():
    mesh = from_arrays(SQUARE, TWO, SQUARE_UV, waves())
    edge, front = View.of([1, 0, 0]), View.of([0, 0, 1])
    report = _one(mesh, _reader(mesh, _offset(0.1)), views=[edge, front, edge])
    assert report.views == 1 and report.worst_view == 1
    assert report.psnr == report.psnr_worst == _one(mesh, _reader(mesh, _offset(0.1)), views=[front]).psnr
    nothing = _one(mesh, _reader(mesh), views=[edge])
    assert nothing.views == nothing.pixels == 0 and nothing.worst_view == -1
    numbers = [nothing.peak, nothing.psnr, nothing.psnr_worst, nothing.one_minus_ssim, nothing.rest_error]
    assert all(math.isnan(number) for number in numbers)
    assert json.dumps(nothing.to_json(), allow_nan=False)


def test_a_light_of_one_colour_has_no_scale():
    mesh = lit_cube(1, np.full((HEIGHT, WIDTH, 3), 0.7, np.float32))
    report = _one(mesh, _reader(mesh, _offset(0.1)), views=4)
    assert report.peak == 0.0 and report.worst_view == -1
    assert all(math.isnan(x) for x in (report.psnr, report.psnr_worst, report.one_minus_ssim, report.texel_psnr))
    assert report.rest_error == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize("kind", ["tiles", "plain with uv"])
def test_a_models_report_is_its_score_and_its_size(device, kind):
    """Seams are the borders of the new UVs' charts where there are any; one chart without them has none."""
    mesh = sheet()
    model, options = random_model(mesh, kind), {"views": 3, "resolution": 64, "device": device}
    report = evaluate(model, mesh, **options)
    labels = {} if kind == "tiles" else {"it": lambda points: points.triangle}  # a chart per triangle
    score = compare(mesh, {"it": model.decoder(device)}, labels=labels, **options)["it"]
    assert {name: report.to_json()[name] for name in score.to_json()} == score.to_json()
    assert math.isnan(report.seam_ratio) == (kind == "tiles")
    assert (report.method, report.profile, report.gpu_bytes) == (model.method, "random", -(-model.bits // 8))
    assert report.bytes == model.file_bytes()
    assert report.cr == model.compression_ratio


def test_texels_in_the_mask_count(device):
    """Of a half masked sheet the wrong half isn't counted; the decoder gets the texels' own centres."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = True
    mesh = from_arrays(SQUARE, TWO, SQUARE_UV, waves(), mask=mask)
    image = torch.tensor(mesh.sheets[0].lightmap)
    calls = []

    def decoder(points, state):
        calls.append((points.uv.cpu(), points.triangle.cpu(), points.weight.cpu()))
        return raster.texture(image.to(points.uv.device), points.uv) + 0.1 * (points.uv[:, :1] > 0.5)

    report = _one(mesh, decoder, views=[View.of([0, 0, 1])], device=device)
    assert report.texel_psnr == metrics.PSNR_CAP_DB and report.psnr < 40.0
    uv, triangle, barycentric = calls[-1]
    row, column = np.nonzero(mask)
    np.testing.assert_allclose(uv, np.stack([(column + 0.5) / WIDTH, (row + 0.5) / HEIGHT], 1), rtol=1e-6)
    assert triangle.dtype == torch.int64 and barycentric.shape == (len(uv), 3)
    (own,) = mesh.sheets
    weighted = (torch.tensor(own.uv)[own.triangle[triangle]] * barycentric[..., None]).sum(1)
    np.testing.assert_allclose(weighted, uv, atol=1e-6)


def test_what_is_refused():
    mesh = lit_cube(1)
    broken = _reader(mesh, lambda c, uv, t: torch.where((uv[:, :1] < 0.2), torch.nan, c))
    assert "cube: decoder it gives NaN or infinity at" in error_of(_one, mesh, broken)
    assert "gpu" in error_of(_one, mesh, _reader(mesh), device="gpu")


def test_states_are_scored_one_by_one(device):
    """Each has its own peak, and an error in one of them is an error of that one alone."""
    mesh = lit_cube()
    own = mesh.sheets[0]
    scene = from_arrays(own.position, own.triangle, own.uv, np.stack([own.lightmap, 0.5 * own.lightmap]), own.mask)
    images = torch.tensor(scene.sheets[0].lightmaps, device=device)

    def decoder(points, state):
        return raster.texture(images[state], points.uv) + 0.01 * state

    report = compare(scene, {"it": decoder}, views=FACES, resolution=64, device=device)["it"]
    assert report.peaks[1] == pytest.approx(0.5 * report.peaks[0], rel=1e-5) and report.views == 6
    assert report.psnr_by_state[0] == metrics.PSNR_CAP_DB
    assert report.psnr_by_state[1] == pytest.approx(20.0 * math.log10(report.peaks[1] / 0.01), abs=1e-3)
    assert report.psnr == pytest.approx(np.mean(report.psnr_by_state))


def test_sheets_are_scored_together():
    """Triangles of a second sheet have its light, and hide what is behind them."""
    near = from_arrays(SQUARE + [0, 0, 1.0], TWO, SQUARE_UV, waves(), name="near")
    far = from_arrays(SQUARE * 0.5, TWO, SQUARE_UV, 2.0 * waves(), name="far")
    scene = join([near, far])
    images = [torch.tensor(each.lightmap) for each in scene.sheets]

    def decoder(points, state):
        assert set(points.sheet.tolist()) <= {0, 1}
        light = torch.empty(len(points), 3)
        for number, image in enumerate(images):
            at = points.sheet == number
            light[at] = raster.texture(image, points.uv[at].contiguous())
        return light

    report = compare(scene, {"it": decoder}, views=[View.of([0, 0, 1]), View.of([0, 0, -1])], resolution=64)["it"]
    assert report.psnr == report.texel_psnr == metrics.PSNR_CAP_DB and report.views == 2
    ((visible, _, _),) = visible_uv(scene, [View.of([0, 0, 1])], 64, "cpu")
    assert set(visible.unique().tolist()) == {-1, 0, 1}


def _drawn(mesh, direction, resolution=48, device="cpu"):
    (drawn,) = visible_uv(mesh, [View.of(direction)], resolution, device)
    return [tensor.cpu().numpy() for tensor in drawn]


def test_even_views_are_spread_all_around():
    views = sphere_views(50)
    eyes = np.stack([view.axes[2] for view in views])
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 1.0, rtol=1e-12)
    assert np.abs(eyes.mean(axis=0)).max() < 0.02
    cosine = eyes @ eyes.T - 2.0 * np.eye(50)
    nearest = np.degrees(np.arccos(cosine.max(axis=1)))
    assert nearest.min() > 20.0 and nearest.max() < 33.0  # 50 circles that just touch would be 31 degrees apart
    assert sphere_views(0) == [] and len(sphere_views(1)) == 1


def test_axes_also_at_the_poles():
    for direction in ([0, 1, 0], [0, -1, 0], [1e-9, 1, 1e-9], [1, 2, 3], [0, 0, -1e-200], [1e300, 0, 0]):
        axes = View.of(direction).axes
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        unit = np.array(direction) / np.abs(direction).max()
        np.testing.assert_allclose(axes[2], unit / np.linalg.norm(unit), atol=1e-12)


def test_the_picture_just_holds_the_sphere():
    """A tangent from the camera touches the sphere of radius sqrt 3 where p . d = 1: at corners of the cube."""
    mesh = lit_cube(1)
    position = normalised(mesh.sheets[0].position, mesh.sheets[0].triangle)
    clip = clip_positions(position, View.of([1, 0, 0]))
    assert clip.shape == (24, 4) and clip.dtype == np.float32
    touching = mesh.sheets[0].position[:, 0] == 1.0
    radius = np.hypot(clip[:, 0], clip[:, 1]) / clip[:, 3]
    np.testing.assert_allclose(radius[touching], 1.0, rtol=1e-6)
    assert (radius[~touching] < 0.9).all()
    for view in sphere_views(40):
        x, y, z, w = clip_positions(position, view).T
        assert (np.hypot(x, y) <= w * (1 + 1e-6)).all() and (np.abs(z) <= w * (1 + 1e-6)).all()
    z, w = clip_positions(position, View.of([1, 1, 1]))[:, 2:].T
    assert (z / w).min() == pytest.approx(-1.0, abs=1e-6) and (z / w).max() == pytest.approx(1.0, abs=1e-6)


def test_each_face_from_its_own_side(device):
    mesh = lit_cube(2)
    for number, direction in enumerate(DIRECTIONS):
        visible, barycentric, uv = _drawn(mesh, direction, 48, device)
        hit = visible >= 0
        assert visible.dtype == np.int32 and barycentric.shape == (48, 48, 2) and uv.shape == (48, 48, 2)
        assert set(np.unique(visible[hit])) == set(range(8 * number, 8 * number + 8))
        weight = np.concatenate([barycentric, 1.0 - barycentric.sum(-1, keepdims=True)], -1)[hit][..., None]
        corner = mesh.sheets[0].triangle[visible[hit]]
        np.testing.assert_allclose(uv[hit], (mesh.sheets[0].uv[corner] * weight).sum(1), atol=1e-6)
        place = (mesh.sheets[0].position[corner] * weight).sum(1)
        np.testing.assert_allclose(place @ direction, 1.0, atol=1e-5)
        # Seen upright: rows go down, columns to the right.
        row, column = np.nonzero(hit)
        right, up, _ = View.of(direction).axes
        half = 48 / 2 * np.sqrt(2.0) / 2.0  # pixels a unit at the face, which is 2 from the camera
        np.testing.assert_allclose(place @ right, (column - 23.5) / half, atol=1e-4)
        np.testing.assert_allclose(place @ up, (23.5 - row) / half, atol=1e-4)
        assert not uv[~hit].any() and not barycentric[~hit].any()


def test_inactive_triangles_hide_and_are_not_seen():
    """Two sheets one behind the other; half of the front one has no area in UV."""
    position = np.concatenate([SQUARE + [0, 0, 0.5], SQUARE - [0, 0, 0.5]])
    uv = np.concatenate([SQUARE_UV, SQUARE_UV])
    uv[3] = 0.5
    mesh = from_arrays(position, np.concatenate([TWO, TWO + 4]), uv, waves())
    assert mesh.sheets[0].active.tolist() == [True, False, True, True]
    visible, barycentric, at = _drawn(mesh, [0, 0, 1])
    assert set(np.unique(visible)) == {-1, 0}
    assert not barycentric[visible < 0].any() and not at[visible < 0].any()
    whole = dataclasses.replace(mesh.sheets[0], active=np.array([True, True, True, True]))
    flat = dataclasses.replace(mesh, sheets=(whole,))
    assert set(np.unique(_drawn(flat, [0, 0, 1])[0])) == {-1, 0, 1}
    assert set(np.unique(_drawn(mesh, [0, 0, -1])[0])) == {-1, 2, 3}


def test_visibility_counts_every_covered_pixel_once(device):
    mesh, views = lit_cube(2), sphere_views(9, seed=1)
    pixels = sum(int((visible >= 0).sum()) for visible, _, _ in visible_uv(mesh, views, 64, device))
    count = visibility(mesh, views, 64, HEIGHT, WIDTH, device).cpu().numpy()
    assert count.dtype == np.float64 and count.shape == (HEIGHT, WIDTH) and count.sum() == pixels > 5000
    np.testing.assert_array_equal(count, visibility(mesh, views, 64, HEIGHT, WIDTH, device).cpu())
    fine = visibility(mesh, views, 64, 2 * HEIGHT, 2 * WIDTH, device).cpu().numpy()
    np.testing.assert_array_equal(fine.reshape(HEIGHT, 2, WIDTH, 2).sum(axis=(1, 3)), count)
    assert (count[mesh.sheets[0].mask] > 0).mean() > 0.7 and not count[~mesh.sheets[0].mask].any()
