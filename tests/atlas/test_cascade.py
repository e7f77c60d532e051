"""The cascade: initial textures, a step's gradient against autograd, the tuned textures, and the stored ones."""

import numpy as np
import pytest
import torch
import warp as wp
from builders.atlas_models import grouped
from builders.checks import error_of
from kernels.compare import close, exact
from reference import cascade as reference

from benchmarks import plain
from wlm import interop
from wlm.atlas.cascade import fit as cascade
from wlm.atlas.cascade import pack as packing
from wlm.atlas.cascade.fit import Textures, fit_cascade, initial
from wlm.atlas.data import LightmappedScene, from_arrays
from wlm.atlas.model import AtlasModel, Profile
from wlm.atlas.stages import Stages
from wlm.ops import raster as ops_raster
from wlm.ops.views import clip_positions, normalised, sphere_views

pytest.importorskip("uvunwrap")

SIDE = 16  # texels of a face of the box


def pack(scene: LightmappedScene, *rest) -> packing.Packed:
    return packing.pack(scene.sheets[0], *rest)


def regenerate(scene: LightmappedScene, *rest) -> tuple[np.ndarray, np.ndarray]:
    return packing.regenerate(scene.sheets[0], *rest)


def tune(scene: LightmappedScene, *rest, **options) -> Textures:
    return cascade.tune(scene.sheets[0], *rest, **options)


def _profile(**settings) -> Profile:
    defaults = {"steps": 40, "resolution": 48, "colour_rate": 0.01, "lut_rate": 2e-3, "scale": 1.0}
    return Profile(**{"name": "test", "method": "cascade", **defaults, **settings})


def _box(gain: float = 1.0, light=None) -> LightmappedScene:
    """A box, each face a chart of two triangles with an edge of shadow in it; 2 x 3 faces in a map of 40 x 60."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    position, uv, triangle = [], [], []
    for face in range(6):
        axis, sign = face // 2, 2 * (face % 2) - 1
        at = np.full((4, 3), float(sign))
        at[:, (axis + 1) % 3], at[:, (axis + 2) % 3] = corner[:, 0] * sign, corner[:, 1]
        triangle += [[4 * face, 4 * face + 1, 4 * face + 2], [4 * face, 4 * face + 2, 4 * face + 3]]
        position.append(at)
        uv.append((corner * SIDE / 2 + SIDE / 2 + 2 + 20 * np.array([face % 3, face // 3])) / [60, 40])
    y, x = np.meshgrid(np.arange(40) + 0.5, np.arange(60) + 0.5, indexing="ij")
    if light is None:
        bright = 0.3 + 0.2 * np.sin(x / 9) + 0.5 / (1 + np.exp(-3 * ((x + 0.7 * y) % 17 - 8)))
        light = np.stack([bright, 0.8 * bright, 0.1 + 0.01 * y], -1)
    return from_arrays(np.concatenate(position), np.array(triangle), np.concatenate(uv), gain * light)


def _model_error(mesh: LightmappedScene, model: AtlasModel, uv: np.ndarray | None = None) -> float:
    return _error(mesh, model.uv if uv is None else uv, model.texels[0], model.lut / 65535.0)


def _error(mesh: LightmappedScene, uv: np.ndarray, colour: np.ndarray, lut: np.ndarray) -> float:
    """Mean error over the surface in units of the mean radiance, in float64 by the reference."""
    random = np.random.default_rng(9)
    triangle = random.integers(0, len(mesh.sheets[0].triangle), 4000)
    weights = random.dirichlet([1, 1, 1], 4000)[:, None]
    old, new = (exact((weights @ each[triangle])[:, 0]) for each in (mesh.sheets[0].uv[mesh.sheets[0].triangle], uv))
    want = plain.texture(exact(mesh.sheets[0].lightmap), old)
    got = reference.sample(exact(colour), exact(lut) if lut.size else None, new)
    return float((got - want).abs().mean() / want.mean())


def _start(mesh: LightmappedScene, profile: Profile) -> tuple[np.ndarray, Textures]:
    packed = pack(mesh, None, profile.scale)
    return packed.uv, initial(*regenerate(mesh, packed), profile)


def test_what_a_fit_starts_from():
    """Sides rounded, T_p the means of boxes, T_c the centres; gaps are filled before."""
    random = np.random.default_rng(0)
    lightmap = random.uniform(size=(12, 18, 3)).astype(np.float32)
    whole = np.ones((12, 18), bool)
    start = initial(lightmap, whole, _profile(colour_scale=0.5, lut_scale=0.7))
    assert start.colour.shape == (6, 9, 3) and start.lut.shape == (8, 13, 2)
    close(start.colour, lightmap.reshape(6, 2, 9, 2, 3).mean((1, 3)), 1e-6)
    close(start.lut[3, 5], np.array([5.5 / 13, 3.5 / 8]), 1e-6)
    uneven = initial(lightmap, whole, _profile(colour_scale=0.4)).colour
    assert uneven.shape == (5, 7, 3)
    close(uneven.mean((0, 1)), lightmap.mean((0, 1)), 1e-6)
    row = np.repeat(np.arange(12), 5).reshape(5, 12).mean(1)  # each texel in five parts, twelve parts a box
    close(initial(np.tile(np.arange(12.0, dtype=np.float32)[:, None, None], (1, 18, 3)), whole,
                  _profile(colour_scale=0.4)).colour[:, 0, 0], row, 1e-6)  # fmt: skip
    half = whole.copy()
    half[:, 9:] = False
    lightmap[:, :9] = 0.25
    assert (initial(lightmap, half, _profile()).colour == 0.25).all()


@pytest.mark.parametrize(("space", "lut_scale"), [("views", 0.7), ("views", 0.0), ("uv", 0.7)])
def test_a_steps_gradient(device: str, space: str, lut_scale: float):
    """Against autograd through a float64 reading and the losses; of a view also through `wlm.ops.raster`."""
    mesh, profile = _box(), _profile(space=space, lut_scale=lut_scale, gradient=0.6)
    uv, start = _start(mesh, profile)
    random = np.random.default_rng(1)
    # Rough textures, so that no difference is near 0, where float32 could tell its sign otherwise than float64.
    lut = start.lut + random.uniform(-0.04, 0.04, start.lut.shape).astype(np.float32)
    start = Textures(random.uniform(size=start.colour.shape).astype(np.float32), lut.clip(0, 1))
    (sheet,) = mesh.sheets
    with interop.stream(device):
        step = cascade._Step(sheet, uv, start, profile, 5, device)
        before = step.textures()
        step()
        grads = [each.grad.cpu().numpy() for each in step._tuned.values()]
        after = step.textures()
    triangle, barycentric = step.points.triangle.flatten().cpu().long(), step.points.barycentric.reshape(-1, 2).cpu()
    if space == "views":
        clip = torch.tensor(
            clip_positions(normalised(sheet.position, sheet.triangle), sphere_views(profile.steps, 5)[0])
        )
        raster = ops_raster.rasterize(clip, torch.tensor(sheet.triangle), 48, 48)
        assert torch.equal(raster.triangle.flatten().long(), triangle)
        close(barycentric, raster.barycentric.reshape(-1, 2), 1e-4)
    hit = triangle >= 0
    weights = torch.cat([barycentric, 1 - barycentric.sum(-1, keepdim=True)], -1)[hit].double()
    old, new = ((weights[:, None] @ exact(each)[triangle[hit]])[:, 0] for each in (sheet.uv[sheet.triangle], uv))
    unit = sheet.lightmap[sheet.mask].mean()
    leaves = [exact(before.colour / unit, grad=True), exact(before.lut, grad=True)]
    want = plain.texture(exact(sheet.lightmap / unit), old)
    difference = torch.zeros(len(hit), 3, dtype=torch.float64)
    difference[hit] = reference.sample(leaves[0], leaves[1] if lut_scale else None, new) - want
    if space == "views":
        reference.image_loss(difference.reshape(48, 48, 3), profile.gradient).backward()
    else:
        reference.pair_loss(difference, profile.gradient).backward()
    assert hit.sum() > 300
    close(grads[0], leaves[0].grad, 1e-3, "T_p")
    if lut_scale:
        close(grads[1], leaves[1].grad, 1e-3, "T_c")
    moved = (np.abs(after.colour - before.colour) / unit)[np.abs(grads[0]) > 0]
    np.testing.assert_allclose(moved, profile.colour_rate, rtol=1e-3)


@pytest.mark.parametrize(("space", "lut_scale"), [("views", 0.7), ("uv", 0.7), ("uv", 0.0)])
def test_a_fit_gets_better(device: str, space: str, lut_scale: float):
    """On the whole surface, by the reference's reading, well below where it began; all stays in range."""
    mesh, profile = _box(), _profile(space=space, lut_scale=lut_scale)
    uv, start = _start(mesh, profile)
    tuned = tune(mesh, uv, start, profile, device=device)
    first, last = (_error(mesh, uv, each.colour, each.lut) for each in (start, tuned))
    assert last < 0.75 * first
    assert tuned.colour.min() >= 0 and tuned.colour.shape == start.colour.shape
    assert tuned.lut.shape == start.lut.shape and (not tuned.lut.size or 0 <= tuned.lut.min() <= tuned.lut.max() <= 1)
    assert (np.abs(tuned.lut - start.lut) > 1e-3).any() == (lut_scale > 0)


@pytest.mark.parametrize("space", ["views", "uv"])
def test_the_unit_of_radiance_does_not_matter(space: str):
    """A map 1,024 times as bright gives that many times the textures; a black one stays black."""
    profile = _profile(space=space, steps=10)
    mesh, bright = _box(), _box(1024.0)
    uv, start = _start(mesh, profile)
    textures = tune(mesh, uv, start, profile)
    brighter = tune(bright, uv, Textures(1024 * start.colour, start.lut), profile)
    close(brighter.colour / 1024, textures.colour, 1e-4)
    close(brighter.lut, textures.lut, 1e-4)
    black = _box(0.0)
    assert not tune(black, uv, Textures(0 * start.colour, start.lut), profile).colour.any()


def test_a_fit_that_diverged():
    mesh, profile = _box(), _profile(steps=1)
    uv, start = _start(mesh, profile)
    start.colour[0, 0] = np.nan
    assert "array: the fit diverged; use smaller learning rates than those" in error_of(tune, mesh, uv, start, profile)


def test_the_whole(device: str):
    """Two faces that look alike share; what is stored shows the mesh, in the types and ranges of the model."""
    y, x = np.meshgrid(np.arange(40), np.arange(60), indexing="ij")
    light = 0.5 + 0.3 * np.sin((x % 20) / 4) * np.cos((y % 20) / 5)
    mesh = _box(light=np.stack([light, light, light + 0.1 * (x >= 40)], -1))
    clusters = grouped([0, 1, 0, 1, 4, 5, 0, 1, 0, 1, 10, 11])
    stages = Stages(device)
    model = fit_cascade(mesh, clusters, _profile(scale=1.0, colour_scale=0.8), 0, stages)
    assert (model.method, model.colour, model.source) == ("cascade", "half", mesh.source)
    assert model.sheets[0].size == (40, 60)
    assert model.texels.dtype == np.float16 and model.lut.dtype == np.uint16 and model.uv.dtype == np.float32
    assert model.blocks.shape == (0, 0, 16)
    height, width = model.report["packed"]
    assert model.texels.shape == (1, round(0.8 * height), round(0.8 * width), 3)
    assert model.lut.shape == (round(0.7 * height), round(0.7 * width), 2)
    counts = {key: model.report[key] for key in ("triangles", "groups", "shared", "charts", "steps")}
    assert counts == {"triangles": 12, "groups": 6, "shared": 8, "charts": 3, "steps": 40}
    assert set(stages.seconds) == {"pack", "regenerate", "fit", "write"}
    assert height * width < 0.5 * 6 * (SIDE + 2) ** 2 * 2
    assert _model_error(mesh, model) < 0.03
    assert 0 < model.compression_ratio < 1


def test_without_a_table_it_is_plain():
    mesh = _box()
    model = fit_cascade(mesh, None, _profile(lut_scale=0.0, colour_scale=1.0), 0, Stages("cpu"))
    assert model.method == "plain" and model.lut.shape == (0, 0, 2) and model.uv.shape == (12, 3, 2)
    assert _model_error(mesh, model) < 0.02


def test_triangles_that_are_not_active():
    """They hide what is behind them and teach nothing: a fit with one is finite, whatever its UVs say."""
    box = _box()
    sheet = box.sheets[0]
    uv = np.concatenate([sheet.uv, [[0.5, 0.5]] * 3])
    position = np.concatenate([sheet.position, [[-2, -2, 1.5], [2, -2, 1.5], [0, 2, 1.5]]])
    mesh = from_arrays(position, np.concatenate([sheet.triangle, [[24, 25, 26]]]), uv, sheet.lightmap, sheet.mask)
    assert mesh.sheets[0].active.sum() == 12
    for space in ("views", "uv"):
        model = fit_cascade(mesh, None, _profile(space=space), 0, Stages("cpu"))
        assert model.report["groups"] == 12 and np.isfinite(model.uv).all()
        assert _model_error(box, model, model.uv[:12]) < 0.1


def test_a_cuda_step_is_captured(device: str):
    """From the fourth on it is replayed."""
    if device == "cpu":
        pytest.skip("the CPU has no graphs")
    for space in ("views", "uv"):
        mesh, profile = _box(), _profile(space=space)
        uv, start = _start(mesh, profile)
        with interop.stream(device):
            graph = interop.StepGraph(cascade._Step(mesh.sheets[0], uv, start, profile, 0, device), device)
            for _ in range(5):
                graph()
            wp.synchronize_device(device)
        assert graph.captured
