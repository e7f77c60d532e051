"""The paper's method after its clustering: pack, regenerate, and tune two small textures
(lightmap-uv-clustering-cascade, section 3.3).

T_p begins as the regenerated lightmap made smaller by epsilon_p, T_c as the coordinates of its own texels' centres;
``wlm_kernels.atlas.cascade`` says how they are read. Adam then tunes both:

    space "views"   A step draws the mesh from one random camera of ``views``, with the old UVs and the lightmap, its
                    gaps filled, and with the new UVs and the cascade. The loss is the L1 of the colours, and
                    ``gradient`` times the L1 of the images' gradients. The paper's.
    space "uv"      A step draws random points on the mesh, each place as likely, as many as a quarter of a view's
                    pixels, in pairs a texel of the lightmap apart on one triangle. The loss is the same, with the
                    difference within a pair for an image's gradient. What no camera sees counts too; seams don't, as
                    a pair doesn't cross one. Ours.

Where the paper is silent: the loss is a sum and not a mean, which Adam doesn't notice but for its epsilon, so that
that is next to nothing; radiance, and so T_p's rate, is in units of the lightmap's mean, as else a map of a dark room
would be tuned more coarsely than that of a bright one; after each step T_p is clamped to what half floats hold and T_c
to [0, 1], which 16 bits hold and where F does nothing. The paper's rates stay as they are; ``Profile.final_rate`` lets
them fall, so that less noise of the last steps is stored, and lets them begin higher: 5e-3 and 1e-3 falling to a
hundredth are 0.6 to 1.3 dB better than the best that stay, with 300 steps as with 2,000.

On CUDA gradients are added in any order: two fits with one seed differ in the last bits of each step.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas import colour as codec
from wlm.atlas.cluster import Clusters
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import AtlasModel, Profile
from wlm.atlas.pack import pack, regenerate
from wlm.atlas.resize import resize
from wlm.atlas.views import DISTANCE, normalised, sphere_views
from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX
from wlm.texels import fill_gaps
from wlm_kernels.atlas import cascade as kernels
from wlm_kernels.raster import texture as texture_kernels
from wlm_kernels.raster.rasterize import Rasterizer

__all__ = ["Textures", "fit", "fit_cascade", "initial"]

REPORT_EVERY = 0.5  # seconds between two reports
_CHUNK = {"cpu": 5, "cuda": 100}  # steps between two looks at the clock
_STEPS = 65535.0  # of a stored coordinate
# As in ``views``: a camera just sees the sphere around the cube.
_ZOOM = math.sqrt(DISTANCE**2 - 3.0) / math.sqrt(3.0)
_SHARE = 4  # a view's pixels for each point of space "uv": about as many show the mesh


@dataclass(frozen=True, eq=False)
class Textures:
    """A cascade.

    Attributes:
        colour: float32 [Hp, Wp, 3], T_p, linear radiance.
        lut: float32 [Hc, Wc, 2], T_c, x and y over the size of T_p; [0, 0, 2]: none.
    """

    colour: np.ndarray
    lut: np.ndarray


def initial(lightmap: np.ndarray, mask: np.ndarray, profile: Profile) -> Textures:
    """What a fit starts from (section 3.3.3).

    Args:
        lightmap: float32 [H_r, W_r, 3], the regenerated lightmap.
        mask: bool [H_r, W_r], its texels that are used; the others are filled from them.
        profile: ``colour_scale`` and ``lut_scale``; a side is rounded, to at least one texel.

    Returns:
        T_p, each texel the mean of what it covers, and T_c; none if ``lut_scale`` is 0.
    """
    height, width = mask.shape
    colour = resize(lightmap, mask, *_sides(height, width, profile.colour_scale), "box").astype(np.float32)
    if profile.lut_scale == 0.0:
        return Textures(colour, np.zeros((0, 0, 2), np.float32))
    rows, columns = _sides(height, width, profile.lut_scale)
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return Textures(colour, np.stack([u, v], -1).astype(np.float32))


def fit(
    mesh: LightmappedMesh,
    uv: np.ndarray,
    textures: Textures,
    profile: Profile,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Textures:
    """Tunes a cascade until it shows the mesh as its lightmap does.

    Args:
        mesh: The mesh.
        uv: float32 [F, 3, 2], the corners' UVs under which the cascade is read.
        textures: What to start from.
        profile: ``space``, ``steps``, ``colour_rate``, ``lut_rate``, ``final_rate``, ``resolution`` and ``gradient``.
        seed: Of the cameras or points.
        device: "cpu" or "cuda:N".
        progress: Called about twice a second with the steps done and their number.

    Returns:
        The tuned cascade.

    Raises:
        WlmError: No such device, or the fit diverged.
    """
    device = interop.check_device(device)
    with interop.stream(device):
        step = _Step(mesh, uv, textures, profile, seed, device)
        graph = interop.StepGraph(step, device)
        last, done = time.perf_counter(), 0
        while done < profile.steps:
            count = min(_CHUNK["cpu" if device == "cpu" else "cuda"], profile.steps - done)
            for _ in range(count):
                graph()
            done += count
            if progress is None:
                continue
            if device != "cpu":
                torch.cuda.synchronize(device)
            if done == profile.steps or time.perf_counter() - last >= REPORT_EVERY:
                last = time.perf_counter()
                progress(done, profile.steps)
        found = step.textures()
    if not (np.isfinite(found.colour).all() and np.isfinite(found.lut).all()):
        raise WlmError(f"{mesh.name}: the fit diverged; expected smaller rates than those of {profile.name}")
    return found


def fit_cascade(
    mesh: LightmappedMesh,
    clusters: Clusters | None,
    profile: Profile,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> AtlasModel:
    """Compresses a lightmap whose triangles are grouped.

    Args:
        mesh: The mesh.
        clusters: Its groups; None: no triangle shares.
        profile: The settings.
        seed, device, progress: As for ``fit``.

    Returns:
        A model of method "cascade", or "plain" where ``lut_scale`` is 0: T_p alone, under the new UVs.

    Raises:
        WlmError: As ``pack`` and ``fit``; or a package for the blocks of T_p is missing.
    """
    device = interop.check_device(device)
    seconds, start = {}, time.perf_counter()

    def clock(stage: str) -> None:
        nonlocal start
        now = time.perf_counter()
        seconds[stage], start = now - start, now

    packed = pack(mesh, clusters, profile.scale)
    clock("pack")
    lightmap, mask = regenerate(mesh, packed, device)
    first = initial(lightmap, mask, profile)
    clock("regenerate")
    textures = fit(mesh, packed.uv, first, profile, seed=seed, device=device, progress=progress)
    clock("fit")
    blocks, texels = np.empty((0, 16), np.uint8), textures.colour
    if profile.colour != "half":
        blocks, texels = codec.encode(texels, profile.colour)
    clock("write")
    count = len(mesh.triangle)
    shares = np.bincount(packed.source[packed.source >= 0], minlength=count)
    report = {
        "seconds": seconds,
        "triangles": count,
        "groups": int(np.count_nonzero(shares)),
        "shared": int(shares[shares > 1].sum()),
        "charts": len(packed.back),
        "packed": [packed.height, packed.width],
        "steps": profile.steps,
    }
    return AtlasModel(
        name=mesh.name,
        source=mesh.source,
        profile=profile,
        method="cascade" if textures.lut.size else "plain",
        colour=profile.colour,
        height=mesh.mask.shape[0],
        width=mesh.mask.shape[1],
        texels=texels.clip(0.0, HALF_MAX).astype(np.float16),
        blocks=blocks,
        lut=np.rint(textures.lut * _STEPS).astype(np.uint16),
        uv=packed.uv,
        report=report,
    )


def _sides(height: int, width: int, scale: float) -> tuple[int, int]:
    return max(1, round(scale * height)), max(1, round(scale * width))


class _Step:
    """A step of the fit. All buffers are made here, so that it may be captured in a CUDA graph."""

    def __init__(
        self,
        mesh: LightmappedMesh,
        uv: np.ndarray,
        textures: Textures,
        profile: Profile,
        seed: int,
        device: str,
    ) -> None:
        self._gradient = profile.gradient
        # A black map has no unit, and needs none.
        self._unit = float(mesh.lightmap[mesh.mask].mean(dtype=np.float64)) or 1.0
        self._colour = torch.tensor(textures.colour / np.float32(self._unit), device=device).requires_grad_()
        self._lut = torch.tensor(textures.lut, device=device).requires_grad_()
        # Rates are read on the device, as a step of a graph can't be told of new ones.
        half = 0.5 + 0.5 * np.cos(np.linspace(0.0, math.pi, max(profile.steps, 1)))
        last = profile.final_rate
        rates = np.outer(last + (1.0 - last) * half, [profile.colour_rate, profile.lut_rate])
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
        self._on_textures = [_wrap(each, device) for each in self._grads]
        image = fill_gaps(mesh.lightmap, mesh.mask) / np.float32(self._unit)
        self._image = _wrap(torch.tensor(image, device=device), device)

        self._next = torch.zeros(1, dtype=torch.int32, device=device)
        # What isn't active hides what is behind it, and counts as nothing.
        shown = mesh.active[:, None, None]
        old = mesh.uv[mesh.triangle]
        self._old, self._new = (
            wp.array(np.where(shown, each, np.nan).astype(np.float32), dtype=wp.vec2, device=device)
            for each in (old, uv)
        )
        if profile.space == "views":
            self._points = _Views(mesh, profile, self._next, seed, device)
        else:
            self._points = _Surface(mesh, profile, self._next, seed, device)
        count = self._points.count
        self._uv, self._old_uv = (wp.empty(count, dtype=wp.vec2, device=device) for _ in range(2))
        self._read, self._want, self._on_read = (torch.zeros(count, 3, device=device) for _ in range(3))
        self._warp = [_wrap(each, device) for each in (self._read, self._want, self._on_read)]
        shape = self._points.shape
        self._loss = [_wrap(each.view(shape), device) for each in (self._read, self._on_read)]

    def __call__(self) -> None:
        points = self._points
        points.draw()
        kernels.corner_points(points.triangle, points.barycentric, self._new, self._uv)
        kernels.corner_points(points.triangle, points.barycentric, self._old, self._old_uv)
        read, want, on_read = self._warp
        kernels.sample(*self._textures, self._uv, read)
        texture_kernels.sample(self._image, self._old_uv, want)
        self._read.sub_(self._want)
        points.loss(self._loss[0], self._gradient, self._loss[1])
        for grad in self._grads:
            grad.zero_()
        kernels.sample_backward(*self._textures, self._uv, on_read, *self._on_textures)
        for rate, now in zip(self._rate, self._rates.index_select(0, self._next)[0], strict=True):
            rate.copy_(now)
        self._adam.step()
        self._next += 1
        with torch.no_grad():
            self._colour.clamp_(0.0, HALF_MAX / self._unit)
            self._lut.clamp_(0.0, 1.0)

    def textures(self) -> Textures:
        colour, lut = (each.detach().cpu().numpy() for each in (self._colour, self._lut))
        return Textures(colour * np.float32(self._unit), lut.copy())


class _Views:
    """The pixels of a random view, drawn anew."""

    def __init__(self, mesh: LightmappedMesh, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        side = profile.resolution
        self.count, self.shape = side * side, (side, side, 3)
        axes = np.array([view.axes for view in sphere_views(profile.steps, seed)], np.float32).reshape(-1, 3, 3)
        self._axes = torch.tensor(axes, device=device)
        self._step = step
        self._position = torch.tensor(normalised(mesh), dtype=torch.float32, device=device)
        self._clip = torch.zeros(len(mesh.position), 4, device=device)
        triangle = wp.array(mesh.triangle, dtype=int, device=device)
        self._rasterizer = Rasterizer(triangle, side, side)
        self._on_device = _wrap(self._clip, device)
        raster = self._rasterizer.raster
        self.triangle, self.barycentric = raster.triangle.flatten(), raster.barycentric.flatten()

    def draw(self) -> None:
        axes = self._axes.index_select(0, self._step)[0]
        # Sums by hand, as in ``views``: vertices at one place must stay at one.
        x, y, back = (sum(self._position[:, k] * axes[i, k] for k in range(3)) for i in range(3))
        w = DISTANCE - back
        # z / w only has to rise with the distance.
        self._clip.copy_(torch.stack([_ZOOM * x, _ZOOM * y, w - 1.0, w], 1))
        self._rasterizer.run(self._on_device)

    @staticmethod
    def loss(difference: wp.array, weight: float, grad: wp.array) -> None:
        kernels.image_loss(difference, weight, grad)


class _Surface:
    """Pairs of random points on the mesh, drawn anew."""

    def __init__(self, mesh: LightmappedMesh, profile: Profile, step: torch.Tensor, seed: int, device: str) -> None:
        pairs = max(1, profile.resolution**2 // (2 * _SHARE))
        self.count, self.shape = 2 * pairs, (2 * pairs, 3)
        self._seed = int(seed) % (1 << 30)
        position = normalised(mesh)[mesh.triangle]
        across = np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0])
        area = np.where(mesh.active, np.linalg.norm(across, axis=1), 0.0)
        self._area = wp.array(np.cumsum(area), dtype=wp.float64, device=device)
        texels = (mesh.uv * mesh.mask.shape[::-1])[mesh.triangle]
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
    """An array over a tensor's memory, also of a tensor without numbers, which Warp doesn't wrap."""
    if tensor.numel():
        return interop.to_warp(tensor)
    return wp.empty(tuple(tensor.shape), dtype=float, device=device)
