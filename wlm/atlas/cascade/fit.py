"""The paper's method: group triangles, pack them, and tune two small textures (lightmap-uv-clustering-cascade,
sections 3.1 to 3.3).

T_p, the colour texture, starts as the repacked lightmap downscaled by epsilon_p. T_c, the lookup texture, starts as the
coordinates of its own texels' centres; `wlm_kernels.atlas.cascade` describes how they are read. Adam then tunes both:

    space "views"   A step draws the mesh from one random camera of `views`, once with the old UVs and the lightmap,
                    its gaps filled, and once with the new UVs and the cascade. The loss is the L1 of the colours plus
                    `gradient` times the L1 of the images' gradients. This is the paper's choice.
    space "uv"      A step draws random points on the mesh, uniform over its area, as many as a quarter of a view's
                    pixels, in pairs one texel of the lightmap apart on one triangle. The loss is the same, with the
                    difference within a pair in place of an image's gradient. Places that no camera sees count too;
                    seams don't, since a pair doesn't cross one. This is our alternative.

The paper leaves some points open. Here the loss is a sum and not a mean, which hardly changes Adam's steps. Radiance,
and so T_p's rate, is in units of the lightmap's mean, since a dark lightmap would otherwise be tuned more coarsely than
a bright one. After each step T_p is clamped to the range of half floats and T_c to [0, 1], the range of its 16 bits,
where the folding of coordinates by eq. 8 changes nothing. `Profile.final_rate` lets rates, which are constant in the
paper, decay.

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
from wlm.ops.views import DISTANCE, ZOOM, normalised, sphere_views
from wlm.system import Meter, OnProgress
from wlm.texels import fill_gaps
from wlm_kernels.atlas import cascade as kernels
from wlm_kernels.atlas.patches import ORDERS
from wlm_kernels.raster import texture as texture_kernels
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
    with stages("cluster"):
        if (
            stages.checkpoint is not None
            and (kept := _kept_clusters(stages.checkpoint, len(sheet.triangle))) is not None
        ):
            return kept
        clusters = cluster(
            sheet.uv,
            sheet.triangle,
            sheet.lightmap,
            threshold=profile.threshold,
            colour_threshold=profile.colour_threshold,
            max_radiance=brightest if profile.max_radiance is None else profile.max_radiance,
            active=sheet.active,
            device=stages.device,
            progress=stages.progress,
        )
        if stages.checkpoint is not None:
            stages.checkpoint.add_finished(0, vars(clusters))
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
    """Compresses a lightmap to a cascade of two textures.

    Args:
        scene: A scene of one sheet and one state.
        clusters: The groups of its triangles that share texels; None: no triangles share any.
        profile, seed, stages: As for `wlm.atlas.fit.compress`.
        repack: Whether charts are packed anew (section 3.3.1). If false, the mesh keeps its UVs, tuning starts from the
            original lightmap, and `clusters` and the profile's `scale` are ignored (section 4.5.2).

    Returns:
        A model of method "cascade"; or "plain", with the colour texture T_p alone, if `lut_scale` is 0.

    Raises:
        WlmError: An error of `pack` or `tune`, or the package that encodes T_p's block format isn't installed.
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
            "charts": len(packed.to_lightmap),
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
    return AtlasModel(
        name=scene.name,
        source=scene.source,
        profile=profile,
        method="cascade" if textures.lut.size else "plain",
        colour=profile.colour,
        states=scene.states,
        sheets=(SheetPlace(sheet.name, *sheet.mask.shape),),
        **{name: texture[None] for name, texture in stored.items()},
        lut=np.rint(textures.lut * LUT_STEPS).astype(np.uint16),
        uv=uv,
        report={"triangles": count, **facts, "steps": profile.steps},
    )


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
    3, 2], are the corners' UVs for the cascade. The checkpoint saves the state between steps.

    Raises:
        WlmError: There is no such device, or the textures became NaN or infinite (the fit diverged).
    """
    device = interop.check_device(device)
    with interop.stream(device):
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
        raise WlmError(f"{sheet.name}: the fit diverged; use smaller learning rates than profile {profile.name}")
    return tuned


def _kept_clusters(checkpoint: Checkpoint, count: int) -> Clusters | None:
    triangle = Part(np.int32, (count,), least=0, most=count - 1)
    table = {
        "group": triangle,
        "representative": Part(np.int32, (None,), least=0, most=count - 1),
        "order": Part(np.int8, (count,), least=0, most=len(ORDERS) - 1),
        "distance": Part(np.float64, (count,), least=0.0),
        "excluded": Part(np.bool_, (count,)),
    }
    if (kept := checkpoint.finished(0, table)) is None:
        return None
    if kept["group"].max() >= len(kept["representative"]):
        raise WlmError(f"{checkpoint.path}: the groups of triangles are damaged: a group has no representative")
    return Clusters(**kept)


def _sides(height: int, width: int, scale: float) -> tuple[int, int]:
    return max(1, round(scale * height)), max(1, round(scale * width))


class _Step:
    """One step of tuning, as a callable. Its buffers are allocated once, so that a CUDA graph may capture the step."""

    def __init__(
        self,
        sheet: Sheet,
        uv: np.ndarray,
        textures: Textures,
        profile: Profile,
        seed: int,
        device: str,
    ) -> None:
        self._gradient = profile.gradient
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
        groups = [{"params": [self._colour], "lr": self._rate[0]}]
        if textures.lut.size:
            groups.append({"params": [self._lut], "lr": self._rate[1]})
        self._grads = [torch.zeros_like(self._colour), torch.zeros_like(self._lut)]
        self._colour.grad, self._lut.grad = self._grads
        on_cuda = device != "cpu"
        self._adam = torch.optim.Adam(groups, capturable=on_cuda, fused=True)
        self._textures = [_wrap(each, device) for each in (self._colour, self._lut)]
        self._texture_grads = [_wrap(each, device) for each in self._grads]
        self._image = _wrap(torch.tensor(sheet.lightmap / np.float32(self._unit), device=device), device)

        self._step = torch.zeros(1, dtype=torch.int32, device=device)
        # An inactive triangle hides what is behind it; NaN excludes it from the loss.
        active = sheet.active[:, None, None]
        self._corner, self._new_corner = (
            wp.array(np.where(active, each, np.nan).astype(np.float32), dtype=wp.vec2, device=device)
            for each in (sheet.uv[sheet.triangle], uv)
        )
        if profile.space == "views":
            self._points = _Views(sheet, profile, self._step, seed, device)
        else:
            self._points = _Surface(sheet, profile, self._step, seed, device)
        count, shape = self._points.count, self._points.shape
        self._uv, self._new_uv = (wp.empty(count, dtype=wp.vec2, device=device) for _ in range(2))
        self._value, self._target, grad = (torch.zeros(count, 3, device=device) for _ in range(3))
        self._value_array, self._target_array, self._value_grad = (
            _wrap(each, device) for each in (self._value, self._target, grad)
        )
        self._difference, self._difference_grad = (_wrap(each.view(shape), device) for each in (self._value, grad))

    def __call__(self) -> None:
        points = self._points
        points.draw()
        kernels.corner_points(points.triangle, points.barycentric, self._new_corner, self._new_uv)
        kernels.corner_points(points.triangle, points.barycentric, self._corner, self._uv)
        kernels.sample(*self._textures, self._new_uv, self._value_array)
        texture_kernels.sample(self._image, self._uv, self._target_array)
        self._value.sub_(self._target)
        points.loss(self._difference, self._gradient, self._difference_grad)
        for grad in self._grads:
            grad.zero_()
        kernels.sample_backward(*self._textures, self._new_uv, self._value_grad, *self._texture_grads)
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
        for group in self._adam.param_groups:
            for parameter in group["params"]:
                name = "colour" if parameter is self._colour else "lut"
                moments = self._adam.state[parameter]
                tensors |= {name: parameter} | {f"{name}.{key}": moments[key] for key in _MOMENTS}
        return {name: np.array(value.detach().cpu().numpy()) for name, value in tensors.items()}

    @torch.no_grad()
    def load(self, state: dict[str, np.ndarray]) -> None:
        """Restores the arrays that `state` returned.

        Raises:
            ValueError: The state belongs to another fit; nothing has changed.
        """
        table = {"step": Part(np.int32, (1,), least=0, most=len(self._rates))}
        for group in self._adam.param_groups:
            for parameter in group["params"]:
                name, shape = "colour" if parameter is self._colour else "lut", tuple(parameter.shape)
                table |= {name: Part(np.float32, shape), f"{name}.step": Part(np.float32, (), least=0.0)}
                table |= {f"{name}.{key}": Part(np.float32, shape) for key in _MOMENTS[1:]}
        check_parts(state, table)
        values = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
        self._step.copy_(values["step"])
        for group in self._adam.param_groups:
            for parameter in group["params"]:
                name = "colour" if parameter is self._colour else "lut"
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
    """Supplies the points of each step for the space "views": the pixels of one random view."""

    def __init__(self, sheet: Sheet, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        side = profile.resolution
        self.count, self.shape = side * side, (side, side, 3)
        axes = np.array([view.axes for view in sphere_views(profile.steps, seed)], np.float32).reshape(-1, 3, 3)
        self._axes = torch.tensor(axes, device=device)
        self._step = step
        self._position = torch.tensor(normalised(sheet.position, sheet.triangle), dtype=torch.float32, device=device)
        self._clip = torch.zeros(len(sheet.position), 4, device=device)
        triangle = wp.array(sheet.triangle, dtype=int, device=device)
        self._rasterizer = Rasterizer(triangle, side, side)
        self._clip_array = _wrap(self._clip, device)
        raster = self._rasterizer.raster
        self.triangle, self.barycentric = raster.triangle.flatten(), raster.barycentric.flatten()

    def draw(self) -> None:
        axes = self._axes.index_select(0, self._step)[0]
        # The product is written out, as in `wlm.ops.views`, so that coinciding vertices stay coinciding.
        x, y, back = (sum(self._position[:, k] * axes[i, k] for k in range(3)) for i in range(3))
        w = DISTANCE - back
        # z / w only has to increase with the distance.
        self._clip.copy_(torch.stack([ZOOM * x, ZOOM * y, w - 1.0, w], 1))
        self._rasterizer.run(self._clip_array)

    @staticmethod
    def loss(difference: wp.array, weight: float, grad: wp.array) -> None:
        kernels.image_loss(difference, weight, grad)


class _Surface:
    """Supplies the points of each step for the space "uv": new pairs of random points on the mesh."""

    def __init__(self, sheet: Sheet, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        pairs = max(1, profile.resolution**2 // (2 * _PIXELS_PER_POINT))
        self.count, self.shape = 2 * pairs, (2 * pairs, 3)
        self._seed = int(seed) % (1 << 30)
        position = normalised(sheet.position, sheet.triangle)[sheet.triangle]
        normal = np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0])
        area = np.where(sheet.active, np.linalg.norm(normal, axis=1), 0.0)
        self._area = wp.array(np.cumsum(area), dtype=wp.float64, device=device)
        texels = (sheet.uv * sheet.mask.shape[::-1])[sheet.triangle]
        self._texels = wp.array(texels.astype(np.float32), dtype=wp.vec2, device=device)
        self._step = _wrap(step, device)
        self.triangle = wp.empty(self.count, dtype=int, device=device)
        self.barycentric = wp.empty(self.count, dtype=wp.vec2, device=device)

    def draw(self) -> None:
        kernels.surface_points(self._area, self._texels, 1.0, self._seed, self._step, self.triangle, self.barycentric)

    @staticmethod
    def loss(difference: wp.array, weight: float, grad: wp.array) -> None:
        kernels.pair_loss(difference, weight, grad)


def _wrap(tensor: torch.Tensor, device: str) -> wp.array:
    """Wraps a tensor's memory; an empty tensor, which Warp can't wrap, becomes an empty array."""
    if tensor.numel():
        return interop.to_warp(tensor)
    return wp.empty(tuple(tensor.shape), dtype=float, device=device)
