"""Guiding maps and six-way lightmaps: against float64 references, closed forms and each other."""

import numpy as np
import pytest
import warp as wp
from reference import marching as reference
from reference.marching import Scene
from reference.single_light import march_lit

from kernels.compare import array, close
from wlm_kernels.smoke import march_six, marches
from wlm_kernels.smoke.march import Medium, make_view, occupied
from wlm_kernels.smoke.settings import March

TYPES = {"float": wp.float32, "half": wp.float16}
LOOSE = 2e-5  # of the largest value: what float32 leaves of sums over 100 samples


def _scene(turned: bool, perspective: bool = False, inside: bool = False, seed: int = 3) -> Scene:
    """Makes smoke in random blobs, in a box of three different sizes, seen along an axis or at an angle."""
    random = np.random.default_rng(seed)
    density = np.maximum(random.normal(0.2, 0.6, (9, 12, 10)), 0).astype(np.float16).astype(np.float32)
    density[:3, :5] = 0
    axes = np.eye(3)
    if turned:
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
        axes *= np.sign(np.linalg.det(axes))
    centre = np.array(density.shape) / 2
    origin = centre + axes[2] * (0.5 if inside else 20.0)
    pitch = 0.06 if perspective else 1.1
    return Scene(density, 0.3, origin, *axes, pitch, 14, 11, perspective)


def _run(launch, planes: tuple, scene: Scene, device: str, *arguments, dtype=wp.float32, hot=None, **options):
    """Returns the result of a march; `hot`: temperature and emission."""
    heat = () if hot is None else (array(hot[0], dtype, device), hot[1])
    medium = Medium(array(scene.density, dtype, device), scene.extinction, *heat)
    out = wp.full((*planes, scene.height, scene.width), np.nan, dtype=float, device=device)
    s = scene
    view = make_view(s.origin, s.right, s.up, -s.toward, s.pitch, s.width, s.height, s.perspective)
    launch(medium, view, *arguments, out, **options)
    return out.numpy()


def _guide(scene: Scene, device: str, dtype=wp.float32, shared: bool = True, **march) -> np.ndarray:
    return _run(marches.guide, (3,), scene, device, March(**march), dtype=dtype, shared=shared)


def _six(scene: Scene, device: str, dtype=wp.float32, hot=None, **march) -> np.ndarray:
    return _run(march_six.six_way, (8,), scene, device, March(**march), dtype=dtype, hot=hot)


@pytest.mark.parametrize(
    ("turned", "perspective", "kind"),
    [(False, False, "float"), (True, False, "half"), (False, True, "half"), (True, True, "float")],
)
def test_guide_against_reference(device: str, turned: bool, perspective: bool, kind: str):
    """Algorithm 1 with a march from each sample, at a step that divides no length."""
    scene = _scene(turned, perspective)
    result = _guide(scene, device, TYPES[kind], step=2.37, jitter=0.0, g=0.3, threshold=0.1, cutoff=0.0, shared=False)
    expected = reference.guide(scene, 2.37, 0.3, 0.1)
    for plane in range(3):
        close(result[plane], expected[plane], LOOSE, f"plane {plane}")


def test_shared_lights(device: str):
    """With nodes a voxel apart the map is near that without a lattice."""
    scene = _scene(True)
    marched, coarse, fine = (
        _guide(scene, device, step=step, jitter=0.0, shared=shared)[0]
        for step, shared in ((0.1, False), (2.0, True), (0.1, True))
    )
    error = [np.sqrt(np.square(result - marched).mean() / np.square(marched).mean()) for result in (coarse, fine)]
    # Of noise from voxel to voxel, the worst that a lattice can meet.
    assert error[1] < 0.012 < error[0] < 0.2


def test_jitter(device: str):
    """Another seed gives another map with the same mean; the same seed gives the same bits."""
    scene = _scene(True)
    scene.height = scene.width = 64
    scene.pitch = 0.15
    first, again, other = (_guide(scene, device, step=3.0, seed=seed) for seed in (1, 1, 2))
    still = _guide(scene, device, step=0.2, jitter=0.0)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(0).mean() > 0.3
    for result in (first, other):
        np.testing.assert_allclose(result[1].mean(), still[1].mean(), rtol=0.02)


def test_cutoff(device: str):
    """The light that a ray omits when it ends early is within the stated bound."""
    scene = _scene(False)
    scene.extinction = 3.0
    whole = _guide(scene, device, step=0.5, jitter=0.0, cutoff=0.0)
    for cutoff in (1e-1, 1e-3):
        cut = _guide(scene, device, step=0.5, jitter=0.0, cutoff=cutoff)
        error = np.abs(cut - whole)
        assert 0 < error[0].max() < 2.5 * cutoff and 0 < error[1].max() < cutoff
        np.testing.assert_array_equal(cut[2], whole[2])


@pytest.mark.parametrize("voxel", [False, True])
@pytest.mark.parametrize(
    ("turned", "inside", "kind", "extinction"),
    [(False, False, "half", 10.0), (True, False, "float", 1e2), (True, True, "half", 1.0), (False, True, "half", 0)],
)
def test_six_way_against_reference(device: str, turned, inside, kind, extinction, voxel, monkeypatch):
    """60 dB for noise from voxel to voxel and for one voxel, in slabs of a few planes, also from inside hot smoke."""
    scene = _scene(turned, inside=inside)
    scene.width, scene.height, scene.pitch, scene.extinction = 5, 4, 2.0, extinction
    if voxel:
        scene.density, scene.pitch = np.ones((1, 1, 1), np.float32), 0.4
        scene.origin = np.full(3, 0.5) + scene.toward * (0.2 if inside else 20.0)
    hot = np.random.default_rng(1).uniform(0, 1, scene.density.shape).astype(np.float16).astype(np.float32)
    monkeypatch.setattr(march_six, "_SLAB_BYTES", 16 * scene.height * scene.width * 5)
    result = _six(scene, device, TYPES[kind], (hot, 0.2), step=0.5, g=0.1)
    expected = reference.six_way(scene, 1 / 32, 0.1, hot, 0.2)
    assert (expected[:6].max() > 0.2) == (extinction > 0)
    # Light of 1 is that of white smoke; emission follows the steps of the density alone.
    for planes, most in ((slice(6), 1e-3), (6, 1e-3), (7, (0.1 if voxel else 1e-3) * expected[7].max())):
        assert np.sqrt(np.square(result[planes] - expected[planes]).mean()) < most, planes


@pytest.mark.parametrize("extinction", [1e-4, 0.05, 2.0])
def test_slab_closed_forms(device: str, extinction: float):
    """A ray through the middle of a block has closed forms, and an integral for the light from the sides."""
    n = 16
    centre = np.full(3, n / 2)
    density = np.ones((n, n, n), np.float32)
    scene = Scene(density, extinction, centre + [0, 0, 30.0], *np.eye(3), 0.25, 1, 1)
    tau = extinction * n
    # The light from the sides falls off quickly within the dense block's face.
    step = 0.05 if extinction < 1 else 0.01
    result = _six(scene, device, step=step)[:, 0, 0]
    assert result[6] == pytest.approx(np.exp(-tau), rel=1e-4, abs=2e-7)
    assert result[4] == pytest.approx(-np.expm1(-2 * tau) / 2, rel=1e-4)
    assert result[5] == pytest.approx(tau * np.exp(-tau), rel=1e-4, abs=2e-6)
    # The density rises over one voxel at either face, and so does a side's optical depth.
    z = (np.arange(200_000) + 0.5) * (n + 1) / 200_000 - 0.5
    rise = np.clip(np.minimum(z + 0.5, n + 0.5 - z), 0, 1)
    dz = z[1] - z[0]
    passed = extinction * (np.cumsum(rise) - rise / 2) * dz
    side = np.sum(extinction * rise * np.exp(-passed - extinction * rise * n / 2)) * dz
    np.testing.assert_allclose(result[:4], side, rtol=2e-3 if extinction > 1 else 2e-4)
    guide = _guide(scene, device, step=step, jitter=0.0, shared=False, cutoff=0.0)[:, 0, 0]
    np.testing.assert_allclose(guide[0], result[4] + 2 * side, rtol=2e-3)
    assert guide[1] == pytest.approx(result[6], rel=1e-4, abs=2e-7)


def test_empty_bricks(device: str):
    """Bricks without smoke within reach are found, and skipping them does not change the light."""
    density = np.zeros((40, 20, 9), np.float32)
    density[24:] = 1.0
    assert occupied(Medium(array(density, float, device), 1.0)).numpy()[:, 0, 0].tolist() == [0, 0, 1, 1, 1]
    sparse = (np.random.default_rng(7).random((40, 20, 9)) < 0.003).astype(np.float32)
    assert 0.2 < occupied(Medium(array(sparse, float, device), 1.0)).numpy().mean() < 0.9
    askew = _scene(True)
    middle = np.array(sparse.shape) / 2
    scene = Scene(sparse, 5.0, middle + 30.0 * askew.toward, askew.right, askew.up, askew.toward, 4.0, 10, 10)
    toward = np.array([0.6, 0.0, 0.8])
    expected = reference.lit(scene, toward, 0.4, 0.0)
    assert expected.max() > 0.1
    close(_run(march_lit, (), scene, device, toward, March(step=0.4)), expected, LOOSE, "light")
