"""The paper's method: group triangles, pack them, and tune two small textures (lightmap-uv-clustering-cascade,
sections 3.1 to 3.3).

C(u) = T_p(F(T_c(u))) (eq. 7): the lookup texture T_c gives a coordinate, the triangle wave F folds it into [0, 1], and
the colour texture T_p gives the colour; both are read bilinearly, by `wlm.ops.texture`. T_p starts as the repacked
lightmap downscaled by epsilon_p, T_c as the coordinates of its own texels' centres. Adam then tunes both:

    space "views"   A step draws the mesh from one random camera of `views`, once with the old UVs and the lightmap,
                    its gaps filled, and once with the new UVs and the cascade. The loss is the L1 of the colours plus
                    `gradient` times the L1 of the images' gradients. This is the paper's choice.
    space "uv"      A step draws random points on the mesh, uniform over its area, as many as a quarter of a view's
                    pixels, in pairs one texel of the lightmap apart on one triangle. The loss is the same, with the
                    difference within a pair in place of an image's gradient. Places that no camera sees count too;
                    seams don't, since a pair doesn't cross one. This is our alternative.

Eq. 8 has a floor in place of an absolute value, and would be -2 or 0 everywhere; here F(x) is 2 |x/2 - floor(x/2 +
1/2)|. The paper leaves some points open. Here the loss is a sum and not a mean, which hardly changes Adam's steps.
Radiance, and so T_p's rate, is in units of the lightmap's mean, since a dark lightmap would otherwise be tuned more
coarsely than a bright one. After each step T_p is clamped to the range of half floats and T_c to [0, 1], the range of
its 16 bits, where F changes nothing. `Profile.final_rate` lets rates, which are constant in the paper, decay.

On CUDA gradients are added in any order: two fits with one seed differ in the last bits of each step.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas.cascade.cluster import Clusters, cluster
from wlm.atlas.cascade.pack import pack, regenerate
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.atlas.model import LUT_STEPS, AtlasModel, Profile, SheetPlace, snapped
from wlm.atlas.resize import resized
from wlm.atlas.stages import Stages
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.exr import HALF_MAX
from wlm.formats.parts import Part, check_parts
from wlm.ops.raster import texture
from wlm.ops.views import DISTANCE, ZOOM, normalised, sphere_views
from wlm.system import Meter, OnProgress
from wlm.texels import fill_gaps
from wlm_kernels.atlas.patches import ORDERS
from wlm_kernels.atlas.surface import loss_gradient, surface_points
from wlm_kernels.raster.gradient import interpolate
from wlm_kernels.raster.rasterize import Rasterizer

_CHUNK = {"cpu": 5, "cuda": 100}  # steps between two progress reports
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # state of Adam
_PIXELS_PER_POINT = 4  # for space "uv": about a quarter of a view's pixels show the mesh


@dataclass(frozen=True, eq=False)
class Textures:
    """A cascade before it is stored: the colour texture T_p, float32 [Hp, Wp, 3], linear radiance; and the lookup
    texture T_c, float32 [Hc, Wc, 2], coordinates in T_p as fractions of its size, [0, 0, 2] if there is no T_c."""

    colour: np.ndarray
    lut: np.ndarray


def group_triangles(sheet: Sheet, profile: Profile, stages: Stages) -> Clusters | None:
    """Groups triangles whose lighting is alike (sections 3.1 and 3.2); returns None if the threshold is 0, since no
    triangles share texels then."""
    if profile.threshold == 0:
        return None
    # A black lightmap may use any number, since its triangles are all alike.
    brightest = float(sheet.lightmap[sheet.mask].max()) or 1.0
    triangle = Part(np.int32, (count := len(sheet.triangle),), least=0, most=count - 1)
    table = {
        "group": triangle,
        "representative": Part(np.int32, (None,), least=0, most=count - 1),
        "order": Part(np.int8, (count,), least=0, most=len(ORDERS) - 1),
        "distance": Part(np.float64, (count,), least=0.0),
        "excluded": Part(np.bool_, (count,)),
    }

    def make() -> dict[str, np.ndarray]:
        limits = {"threshold": profile.threshold, "colour_threshold": profile.colour_threshold}
        limits["patch_size"] = profile.patch_size
        limits["max_radiance"] = brightest if profile.max_radiance is None else profile.max_radiance
        options = {"active": sheet.active, "device": stages.device, "progress": stages.progress}
        return vars(cluster(sheet.uv, sheet.triangle, sheet.lightmap, **limits, **options))

    with stages("cluster"):
        clusters = Clusters(**stages.batch(0, table, make))
    if clusters.group.max() >= len(clusters.representative):
        raise WlmError(f"{stages.checkpoint.path}: the checkpoint is damaged: a group has no representative triangle")
    return clusters


def fit_cascade(
    scene: LightmappedScene,
    clusters: Clusters | None,
    profile: Profile,
    seed: int,
    stages: Stages,
    *,
    repack: bool = True,
) -> AtlasModel:
    """Compresses a lightmap, of a scene of one sheet and one state, to a cascade of two textures; the groups of its
    triangles share texels.

    Without `repack`, charts are not packed anew (section 3.3.1): the mesh keeps its UVs, tuning starts from the
    original lightmap, and `clusters` and the profile's `scale` are ignored (section 4.5.2). Returns a model of method
    "cascade"; or "plain", with the colour texture T_p alone, if `lut_scale` is 0.
    """
    (sheet,), facts = scene.sheets, {}
    count = len(sheet.triangle)
    # The cascade is tuned with UVs rounded as in the file.
    if repack:
        with stages("pack"):
            packed = pack(sheet, clusters, profile.scale)
            uv = snapped(packed.uv)
        with stages("regenerate"):
            start = initial(*regenerate(sheet, packed, stages.device), profile)
        shares = np.bincount(packed.source[packed.source >= 0], minlength=count)
        facts = {
            "groups": int(np.count_nonzero(shares)),
            "shared": int(shares[shares > 1].sum()),
            "charts": len(packed.rotation),
            "packed": [packed.height, packed.width],
        }
    else:
        uv = snapped(sheet.uv[sheet.triangle].astype(np.float32))
        start = initial(sheet.lightmap, sheet.mask, profile)
    with stages("fit"):
        options = {"device": stages.device, "progress": stages.progress, "checkpoint": stages.checkpoint}
        textures = tune(sheet, uv, start, profile, seed=seed, **options)
    with stages("write"):
        stored = quantise(textures.colour, profile.colour)
    method, parts = "cascade" if textures.lut.size else "plain", {name: part[None] for name, part in stored.items()}
    settings = (scene.name, scene.source, profile, method, profile.colour, scene.states)
    parts |= {"lut": np.rint(textures.lut * LUT_STEPS).astype(np.uint16), "uv": uv}
    report = {"triangles": count, **facts, "steps": profile.steps}
    return AtlasModel(*settings, (SheetPlace(sheet.name, *sheet.mask.shape),), **parts, report=report)


def initial(lightmap: np.ndarray, mask: np.ndarray, profile: Profile) -> Textures:
    """Makes the textures from which tuning starts (section 3.3.3). Each texel of T_p is the mean of the lightmap's
    texels that it covers, and T_c holds the coordinates of its texels' centres. `lightmap` is the repacked one, float32
    [H_r, W_r, 3]; `mask`, bool [H_r, W_r], is true for texels in charts. All others first take the nearest of these
    colours."""
    height, width = mask.shape
    sides = _sides(height, width, profile.colour_scale)
    colour = resized(fill_gaps(lightmap, mask), mask, *sides, "box").numpy().astype(np.float32)
    if profile.lut_scale == 0.0:
        return Textures(colour, np.zeros((0, 0, 2), np.float32))
    rows, columns = _sides(height, width, profile.lut_scale)
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return Textures(colour, np.stack([u, v], -1).astype(np.float32))


def tune(
    sheet: Sheet,
    uv: np.ndarray,
    textures: Textures,
    profile: Profile,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
) -> Textures:
    """Tunes the textures of a cascade so that the mesh looks as it does with the original lightmap. `uv`, float32 [F,
    3, 2], are the corners' UVs for the cascade. The checkpoint saves the state between steps."""
    device = interop.check_device(device)
    with interop.stream(device), interop.one_thread(device):
        step = _Step(sheet, uv, textures, profile, seed, device)
        graph = interop.StepGraph(step, device)
        meter, done = Meter(progress, "fit", profile.steps), 0
        if checkpoint is not None and checkpoint.restore(1, step.load):
            done = step.done
        while done < profile.steps:
            count = min(_CHUNK["cpu" if device == "cpu" else "cuda"], profile.steps - done)
            for _ in range(count):
                graph()
            done += count
            if device != "cpu" and not (progress is None and checkpoint is None):
                torch.cuda.synchronize(device)
            if meter.due(done):
                try:
                    meter.report(done)
                except KeyboardInterrupt:
                    if checkpoint is not None:
                        checkpoint.save({1: step.state()})
                    raise
            if checkpoint is not None and checkpoint.due():
                checkpoint.save({1: step.state()})
        tuned = step.textures()
    if not (np.isfinite(tuned.colour).all() and np.isfinite(tuned.lut).all()):
        raise WlmError(
            f"{sheet.name}: the fit diverged; use smaller learning rates than those of profile {profile.name}"
        )
    return tuned


def _sides(height: int, width: int, scale: float) -> tuple[int, int]:
    return max(1, round(scale * height)), max(1, round(scale * width))


class _Step:
    """One step of tuning, as a callable. Its buffers are allocated once, so that a CUDA graph may capture the step."""

    def __init__(
        self, sheet: Sheet, uv: np.ndarray, textures: Textures, profile: Profile, seed: int, device: str
    ) -> None:
        self._weight = profile.gradient
        # A black lightmap has no mean to divide by, and needs none.
        self._unit = float(sheet.lightmap[sheet.mask].mean(dtype=np.float64)) or 1.0
        self._colour = torch.tensor(textures.colour / np.float32(self._unit), device=device).requires_grad_()
        self._lut = torch.tensor(textures.lut, device=device).requires_grad_()
        # Rates are read on the device, since the arguments of a captured step are fixed.
        cosine = 0.5 + 0.5 * np.cos(np.linspace(0.0, math.pi, max(profile.steps, 1)))
        final = profile.final_rate
        rates = np.outer(final + (1.0 - final) * cosine, [profile.colour_rate, profile.lut_rate])
        self._rates = torch.tensor(rates, dtype=torch.float32, device=device)
        self._rate = [torch.zeros((), device=device) for _ in range(2)]
        self._tuned = {"colour": self._colour} | ({"lut": self._lut} if textures.lut.size else {})
        groups = [{"params": [each], "lr": rate} for each, rate in zip(self._tuned.values(), self._rate, strict=False)]
        for each in self._tuned.values():
            each.grad = torch.zeros_like(each)  # of a fixed address
        self._adam = torch.optim.Adam(groups, capturable=device != "cpu", fused=True)
        self._image = torch.tensor(sheet.lightmap / np.float32(self._unit), device=device)
        self._step = torch.zeros(1, dtype=torch.int32, device=device)
        # An inactive triangle hides what is behind it; NaN excludes it from the loss, as does one more triangle, which
        # stands for "none".
        corners = np.full((2, len(uv) + 1, 3, 2), np.nan, np.float32)
        corners[:, :-1][:, sheet.active] = np.stack([sheet.uv[sheet.triangle], uv])[:, sheet.active]
        self._none = len(uv)
        rows = wp.array(np.arange(3 * len(uv) + 3).reshape(-1, 3), dtype=int, device=device)
        kind = _Views if profile.space == "views" else _Surface
        self.points = kind(sheet, profile, self._step, seed, device)
        self._triangle = torch.empty_like(self.points.triangle)
        self._uv, self._new_uv = (torch.empty_like(self.points.barycentric) for _ in range(2))
        self._gradient = self._uv.new_empty(*self._triangle.shape, 3)
        # Of fixed addresses, and so wrapped once.
        points = interop.to_warp(self._triangle), interop.to_warp(self.points.barycentric, wp.vec2)
        uvs = map(interop.to_warp, (self._uv, self._new_uv))
        self._interpolated = [
            (wp.array(each.reshape(-1, 2), device=device), rows, *points, uv)
            for each, uv in zip(corners, uvs, strict=True)
        ]

    def __call__(self) -> None:
        self.points.draw()
        torch.remainder(self.points.triangle, self._none + 1, out=self._triangle)
        for arrays in self._interpolated:
            interpolate(*arrays)
        if "lut" in self._tuned:
            colour = texture(self._colour, texture(self._lut, self._new_uv), boundary="mirror")
        else:
            colour = texture(self._colour, self._new_uv)
        images = (colour.detach(), texture(self._image, self._uv))
        loss_gradient(*map(interop.to_warp, images), self._weight, self.points.across, interop.to_warp(self._gradient))
        self._adam.zero_grad(set_to_none=False)
        colour.backward(self._gradient)
        for rate, now in zip(self._rate, self._rates.index_select(0, self._step)[0], strict=True):
            rate.copy_(now)
        self._adam.step()
        self._step += 1
        with torch.no_grad():
            self._colour.clamp_(0.0, HALF_MAX / self._unit)
            self._lut.clamp_(0.0, 1.0)

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays that later steps depend on, by name: the textures and Adam's state."""
        tensors = {"step": self._step}
        for name, parameter in self._tuned.items():
            moments = self._adam.state[parameter]
            tensors |= {name: parameter} | {f"{name}.{key}": moments[key] for key in _MOMENTS}
        return {name: np.array(value.detach().cpu().numpy()) for name, value in tensors.items()}

    @torch.no_grad()
    def load(self, state: dict[str, np.ndarray]) -> None:
        """Restores the arrays that `state` returned."""
        table = {"step": Part(np.int32, (1,), least=0, most=len(self._rates))}
        for name, parameter in self._tuned.items():
            shapes = {name: parameter.shape} | {f"{name}.{key}": parameter.shape for key in _MOMENTS[1:]}
            table |= {each: Part(np.float32, tuple(shape)) for each, shape in shapes.items()}
            table[f"{name}.step"] = Part(np.float32, (), least=0.0)
        check_parts(state, table)
        values = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
        self._step.copy_(values["step"])
        for name, parameter in self._tuned.items():
            parameter.copy_(values[name])
            moments = self._adam.state[parameter]
            moments["step"] = values[f"{name}.step"].to(parameter.device)
            for key in _MOMENTS[1:]:
                # Both use the parameter's memory layout, which the fused step expects.
                moments[key] = torch.zeros_like(parameter).copy_(values[f"{name}.{key}"])

    @property
    def done(self) -> int:
        return int(self._step.item())

    def textures(self) -> Textures:
        colour, lut = (each.detach().cpu().numpy() for each in (self._colour, self._lut))
        return Textures(colour * np.float32(self._unit), lut.copy())


class _Views:
    """Supplies the points of each step for the space "views": the pixels of one random view. `triangle`, int32 [H, W],
    is the triangle at each point, -1 for none; `barycentric`, float32 [H, W, 2], has the weights of its corners 0 and
    1. `across` tells whether horizontal neighbours are compared too, besides vertical ones."""

    across = True

    def __init__(self, sheet: Sheet, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        self._side = profile.resolution
        axes = np.array([view.axes for view in sphere_views(profile.steps, seed)], np.float32).reshape(-1, 3, 3)
        self._axes = torch.tensor(axes, device=device)
        self._step = step
        self._position = torch.tensor(normalised(sheet.position, sheet.triangle), dtype=torch.float32, device=device)
        self._clip = torch.zeros(len(sheet.position), 4, device=device)
        self._clip_array = interop.to_warp(self._clip)
        self._rasterizer = Rasterizer(wp.array(sheet.triangle, dtype=int, device=device), self._side, self._side)
        raster = self._rasterizer.raster
        self.triangle, self.barycentric = wp.to_torch(raster.triangle), wp.to_torch(raster.barycentric)

    def draw(self) -> None:
        axes = self._axes.index_select(0, self._step)[0]
        # The product is written out, as in `wlm.ops.views`, so that coinciding vertices stay coinciding.
        x, y, back = (sum(self._position[:, k] * axes[i, k] for k in range(3)) for i in range(3))
        w = DISTANCE - back
        # z / w only has to increase with the distance.
        self._clip.copy_(torch.stack([ZOOM * x, ZOOM * y, w - 1.0, w], 1))
        self._rasterizer.run(self._clip_array)


class _Surface:
    """Supplies the points of each step for the space "uv": new pairs of random points on the mesh, with the attributes
    of `_Views`; H is 2, and the points of a column are a pair."""

    across = False

    def __init__(self, sheet: Sheet, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        pairs = max(1, profile.resolution**2 // (2 * _PIXELS_PER_POINT))
        position = normalised(sheet.position, sheet.triangle)[sheet.triangle]
        normal = np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0])
        area = np.where(sheet.active, np.linalg.norm(normal, axis=1), 0.0)
        texels = (sheet.uv * sheet.mask.shape[::-1])[sheet.triangle]
        self.triangle = torch.empty(2, pairs, dtype=torch.int32, device=device)
        self.barycentric = torch.empty(2, pairs, 2, device=device)
        self._inputs = (
            wp.array(np.cumsum(area), dtype=wp.float64, device=device),
            wp.array(texels.astype(np.float32), dtype=wp.vec2, device=device),
            1.0,
            int(seed) % (1 << 30),
            interop.to_warp(step),
            interop.to_warp(self.triangle.flatten()),
            interop.to_warp(self.barycentric.flatten(0, 1), wp.vec2),
        )

    def draw(self) -> None:
        surface_points(*self._inputs)
