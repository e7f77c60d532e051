"""Training samples: random scenes, simulated and rendered, repeatable to the bit."""

import dataclasses

import numpy as np
import pytest
import torch
from builders.smoke_axes import from_srgb
from builders.smoke_samples import small_pool

from wlm.errors import WlmError
from wlm.fluid.solver import LEAST_HALF_LOSS
from wlm.smoke import scene as scene_settings
from wlm.smoke.lightmaps import axis_faults
from wlm.smoke.march.six_way import bake
from wlm.smoke.network import dataset
from wlm.smoke.network.dataset import ATTEMPTS, make_pool, make_validation
from wlm.smoke.network.planes import EMISSION_PLANE, GUIDES, OPACITY_PLANE, Pool
from wlm.smoke.network.scenes import draw_scene, tilted
from wlm.smoke.network.settings import DatasetSettings
from wlm.smoke.scene import ObstacleSettings, obstacle_mesh
from wlm_kernels.smoke.settings import March

SMALL = DatasetSettings(cells=16, refine=2, resolution=32, frames=2, views_a_frame=2, sequences=3)
SMALL = SMALL.model_copy(update={"warmup": 0.7, "hot": 0.4, "moving": 0.0})
few = {"refine": 1, "sequences": 1, "frames": 1, "resolution": 24, "warmup": 0.6}
FEW = SMALL.model_copy(update=few | {"validation_sequences": 1, "views": 4})
NAMES = tuple(field.name for field in dataclasses.fields(Pool))


@pytest.fixture(scope="module")
def few():
    """The smallest round."""
    return make_pool(FEW, seed=5)


@pytest.fixture(scope="module")
def validation():
    return make_validation(FEW)


@pytest.fixture(scope="module")
def pool():
    """A round on the CPU, and its progress reports."""
    reports = []
    return make_pool(SMALL, seed=5, progress=reports.append), reports


def test_storage_of_fine_grids():
    """Half floats are used except where they would round away the cooling in a short step."""
    fine = DatasetSettings(cells=256)
    smokes = [(scene.smoke, scene.step) for scene in (draw_scene(fine, 0, index) for index in range(60))]
    kinds = {(smoke.hot, smoke.storage) for smoke, _ in smokes}
    assert kinds == {(False, "float16"), (True, "float16"), (True, "float32")}
    for smoke, step in smokes:
        lost = 1.0 - np.exp(-smoke.cooling * step * smoke.substeps)
        assert smoke.storage == ("float32" if 0.0 < lost < LEAST_HALF_LOSS else "float16")
    assert all(draw_scene(DatasetSettings(), 0, index).smoke.storage == "float16" for index in range(60))


@pytest.mark.parametrize("axis", [(0.001, 1.0, 0.0), (1.0, 0.0, 0.001), (0.0, -2.0, 0.001), (0.3, -0.5, 0.8)])
def test_tilted_bodies(axis: tuple):
    """A tilted cylinder is a rotation of the upright one, not a mirror image."""
    path = ((0.0, 0.5, 0.5, 0.5),)
    body = ObstacleSettings(shape="cylinder", radius=(0.1, 0.4, 0.1), path=path, turn=tilted(np.array(axis)))
    points, triangles, _ = obstacle_mesh([body], 0.0)
    points = points.astype(np.float64) - 0.5
    along = points @ (np.array(axis) / np.linalg.norm(axis))
    across = np.sqrt((points**2).sum(1) - along**2)
    np.testing.assert_allclose([np.abs(along).max(), across.max()], [0.4, 0.1], atol=1e-6)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(np.pi * 0.1**2 * 0.8, rel=0.01)


def test_pools_share_no_sequence(few, validation):
    next_round = make_pool(FEW, seed=5, round=1)
    assert not torch.equal(few.targets, next_round.targets)
    sequences = [set(part.sequence.tolist()) for part in (few, next_round, validation)]
    assert all(sequences) and sum(map(len, sequences)) == len(set.union(*sequences))
    assert max(sequences[2]) < 0 <= min(set.union(*sequences[:2]))


def test_sequences_with_their_own_cells(monkeypatch):
    """Numbers of cells lie within the range; validation uses the largest; steps are the same share of the box."""
    marches = []
    render_guide = dataset.render_guide

    def record(volume, camera, kind, march):
        marches.append((volume.shape, march))
        return render_guide(volume, camera, kind, march)

    monkeypatch.setattr(dataset, "render_guide", record)
    changes = {"cells": 20, "least_cells": 16, "sequences": 3, "views_a_frame": 1, "warmup": 0.4}
    settings = FEW.model_copy(update=changes)
    samples = make_pool(settings, seed=5)
    shapes = {shape[0] for shape, _ in marches}
    assert len(samples) and len(shapes) > 1 and shapes <= {settings.refine * cells for cells in range(16, 21)}
    assert all(march.step == pytest.approx(shape[0] * settings.guide_step) for shape, march in marches)
    marches.clear()
    make_validation(settings.model_copy(update={"views": 1}))
    assert {shape[0] for shape, _ in marches} == {20 * settings.refine}


def test_guides_of_six_lights(few):
    """The kind of guide changes only the guide, which then has less error for each light."""
    six = make_pool(FEW.model_copy(update={"guide": "six", "jitter": 0.0}), seed=5)
    assert six.guides.shape == (len(few), 2, 9, 24, 24) and six.guides.dtype == torch.float16
    assert all(torch.equal(getattr(six, name), getattr(few, name)) for name in NAMES[1:])
    off = (six.guides[:, :, :6].float() - six.targets[:, :, :6].float()).square().mean((0, 1, 3, 4))
    worse = (few.guides[:, :, :1].float() - six.targets[:, :, :6].float()).square().mean((0, 1, 3, 4))
    assert (off < 0.2 * worse).all()


def test_same_bits(device: str, few):
    first = few if device == "cpu" else make_pool(FEW, seed=5, device=device)
    again = make_pool(FEW, seed=5, device=device)
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in NAMES)


def test_a_gpu_sees_the_same(device: str, pool):
    """Random numbers do not depend on the device; images differ by rounding, which the simulation amplifies."""
    if device == "cpu":
        pytest.skip("the CPU's is what it is compared with")
    samples = make_pool(SMALL, seed=5, device=device)
    assert str(samples.device).startswith(device.split(":", maxsplit=1)[0])
    assert torch.equal(samples.sequence.cpu(), pool[0].sequence)
    assert float((samples.targets.cpu().float() - pool[0].targets.float()).square().mean()) < 1e-3


def test_what_a_pool_holds(pool):
    """Half floats within their ranges, a plausible amount of smoke, and right directions."""
    samples, reports = pool
    assert (reports[-1].done, reports[-1].total) == (3, 3)
    assert len(samples) == 12 and all(getattr(samples, name).dtype == torch.float16 for name in NAMES[:3])
    for name in NAMES[:3]:
        assert torch.isfinite(getattr(samples, name)).all()
    light, opacity, depth = samples.guides.float().unbind(2)
    assert light.min() >= 0 and 0.5 < light.max() <= 1.6
    assert opacity.min() >= 0 and 0.8 < opacity.max() <= 1
    assert depth.min() >= 0 and depth.max() <= 1 and ((depth > 0) <= (opacity > 0)).all()
    targets = samples.targets.float()
    assert targets.min() >= 0 and targets.max() <= 1
    covered = (targets[:, 1, OPACITY_PLANE] > 0.05).float().mean((1, 2))
    assert covered.min() > 0.02 and 0.08 < covered.mean() < 0.8
    # The guide is a rough picture of the same smoke.
    off = (opacity - targets[:, :, OPACITY_PLANE]).square().mean() / targets[:, :, OPACITY_PLANE].square().mean()
    assert off < 0.15
    assert axis_faults(from_srgb(targets[:, 1, :6])) == ()
    hot = [draw_scene(SMALL, 5, int(number)).smoke.emission > 0 for number in samples.sequence]
    glow = samples.targets[:, 1, EMISSION_PLANE].float().amax((1, 2)) > 0
    assert glow.tolist() == hot and 0 < sum(hot) < len(hot)


def test_motion_finds_the_earlier_frame():
    """The earlier frame, warped by the motion, is nearer to the later one than with any other motion."""
    # Without bursts, whose smoke comes from nowhere.
    samples = make_pool(SMALL.model_copy(update={"hot": 0.0, "warmup": 0.9, "sequences": 2}), seed=5)
    height, width = samples.guides.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    smoke = (samples.targets[:, 1, OPACITY_PLANE] > 0.05)[:, None]

    def errors(right: float, down: float) -> torch.Tensor:
        """Returns the error of each sample and plane."""
        moved = samples.motion.float() * torch.tensor([right, down])[:, None, None]
        grid = torch.stack([(x - moved[:, 0]) / width * 2 - 1, (y - moved[:, 1]) / height * 2 - 1], -1)
        # What came in over the image's edge is taken to look like the edge.
        options = {"align_corners": False, "padding_mode": "border"}
        read = torch.nn.functional.grid_sample(samples.targets[:, 0].float(), grid, **options)
        # What the smoke has left has no motion, and still differs.
        return ((read - samples.targets[:, 1].float()) * smoke).square().mean((2, 3))[:, :EMISSION_PLANE]

    assert len(samples) == 8 and samples.motion.abs().max() > 1.0
    still, moved = errors(0.0, 0.0), errors(1.0, 1.0)
    # Under a light from below an inlet's foot is lit the same whatever goes through it.
    assert (moved.sum(0) < torch.tensor([0.5, 0.5, 0.5, 0.9, 0.5, 0.5, 0.5]) * still.sum(0)).all()
    assert (moved.sum(1) < 0.7 * still.sum(1)).all()
    for right, down in ((-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (0.0, 1.0), (1.0, 0.0), (0.4, 0.4), (1.8, 1.8)):
        assert moved.sum() < 0.85 * errors(right, down).sum()


def test_validation(validation, monkeypatch):
    """Each pair has all fixed views; the test set has another seed."""
    seeds = []
    draw = lambda settings, seed, *rest, **options: seeds.append(seed) or draw_scene(settings, seed, *rest, **options)  # noqa: E731
    monkeypatch.setattr(dataset, "draw_scene", draw)
    again, test = make_validation(FEW), make_validation(FEW, test=True)
    assert seeds == [FEW.validation_seed, FEW.test_seed]
    assert len(test) != len(validation) or not torch.equal(test.targets, validation.targets)
    assert len(validation) == FEW.views * FEW.frames * FEW.validation_sequences
    assert torch.equal(validation.targets, again.targets) and torch.equal(validation.sequence, again.sequence)
    assert all((a != b).any() for a, b in zip(validation.targets, validation.targets[1:], strict=False))


def _unstable(settings: DatasetSettings, seed: int, index: int, *, validation: bool = False):
    """Makes the first scene of each sequence unstable: its smoke falls faster and faster."""
    scene = draw_scene(settings, seed, index, validation=validation)
    if index % ATTEMPTS:
        return scene
    return scene.model_copy(update={"smoke": scene.smoke.model_copy(update={"weight": 1e4})})


def test_an_unstable_scene(monkeypatch: pytest.MonkeyPatch):
    """An unstable scene is skipped, and the next one is used."""
    settings = FEW.model_copy(update={"hot": 0.0, "warmup": 1.5})
    monkeypatch.setattr(dataset, "draw_scene", _unstable)
    monkeypatch.setattr(scene_settings, "_ACCELERATION", 1e9)  # without the shorter steps that it would get
    # A round whose first scene is a jet, whose speed is fixed.
    number = next(k for k in range(99) if draw_scene(settings, 2, k * ATTEMPTS).name.startswith("jet"))
    samples = make_pool(settings, seed=2, round=number)
    assert torch.isfinite(samples.targets).all()
    assert set(samples.sequence.tolist()) == {number * ATTEMPTS + 1}


def test_nan_never_enters(monkeypatch: pytest.MonkeyPatch):
    """A scene whose images have NaN is skipped; several in a row are an error."""
    calls = []

    def broken(*args, **kwargs):
        six = bake(*args, **kwargs)
        calls.append(1)
        if len(calls) == 1:
            six.lightmaps[2, 3, 4] = float("nan")
        return six

    monkeypatch.setattr(dataset, "bake", broken)
    samples = make_pool(FEW, seed=5)
    assert torch.isfinite(samples.targets).all() and samples.sequence[0] == 1
    monkeypatch.setattr(dataset, "ATTEMPTS", 2)
    nan = torch.full((24, 24), float("nan"))
    monkeypatch.setattr(dataset, "bake", lambda *a, **k: dataclasses.replace(bake(*a, **k), transparency=nan))
    with pytest.raises(WlmError, match=r"2 random scenes .* NaN"):
        make_pool(FEW, seed=5)


def test_frames_without_smoke():
    """Almost empty frames are dropped except for the requested share; an empty pool is valid."""
    nothing = FEW.model_copy(update={"least_coverage": 1.0, "kept_empty": 0.0})
    samples = make_pool(nothing, seed=5)
    assert len(samples) == 0 and samples.guides.shape[1:] == (2, 3, 24, 24)
    start = make_pool(nothing.model_copy(update={"warmup": 0.0, "hot": 0.0, "kept_empty": 1.0}), seed=5)
    assert len(start) == 2 and torch.isfinite(start.targets).all()


def test_look():
    """The paper's numbers on the paper's grid, and the same shares of the box on other grids."""
    assert SMALL.look((400, 400, 400)) == March(10.0, jitter=1.0, threshold=0.01)
    assert SMALL.look((100, 200, 60), seed=3) == March(5.0, seed=3, threshold=0.02)
    assert DatasetSettings(resolution=240, zoom=(0.5, 1.2)).pixels == (200.0, 480.0)
    apart = DatasetSettings(guide="six", guide_spacing=1 / 80)
    assert apart.look((400, 400, 400)) == March(10.0, 5.0, jitter=1.0, threshold=0.01)


def test_pools_are_checked_and_taken_apart():
    pool = small_pool()
    six = dataclasses.replace(pool, guides=pool.guides.repeat(1, 1, 3, 1, 1))
    assert six.guides.shape[2] == len(GUIDES["six"]) and len(pool.to("cpu")) == len(pool) == 6
    odd = pool.take(torch.arange(len(pool)) % 2 == 1)
    assert odd.sequence.tolist() == [1, 3, 5] and torch.equal(odd.guides, pool.guides[1::2])
    assert pool.take(torch.tensor([4, 0])).sequence.tolist() == [4, 0]
