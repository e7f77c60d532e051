"""Error of a decoded lightmap in views of the mesh (lightmap-uv-clustering-cascade, section 4.1.4).

The mesh is drawn from cameras around it, `wlm.ops.views`, and as often by viewers who stand in it, where they can,
`wlm.ops.indoors`. A pixel is the lightmap's linear RGB at its surface
point, without any shading. The reference is the original lightmap read bilinearly, clamped, its gaps filled from the
nearest texel of a chart. Only covered pixels count; a view without any is left out.

The peak of every PSNR and the range of SSIM are one number: maximum less minimum of the reference's covered pixels of
all views. (The paper doesn't name its peak; one per view would change with the cameras.) A maximum above twice the
99.9th percentile counts as that: one bright texel must not make every error small.

The stated behaviours:

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
decoded exactly                       PSNR is `PSNR_CAP_DB`, 120 dB, in a view as in the mean;
                                      1 - SSIM is 0; the seam ratio is NaN
the reference is one grey, to within  the peak is 0, PSNR and SSIM are NaN, null in JSON: there is no
a millionth                           range to measure against
nothing covered in any view           the same, and the errors are NaN too
no seam on any screen                 `seam_error` and `seam_ratio` are NaN
an error at seams alone               `seam_ratio` is infinite, null in JSON
FLIP of no covered view               NaN, null in JSON: it is taken of some of the views alone
NaN or Inf in decoded colours         error that names the decoder
====================================  ================================================================
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from wlm import system
from wlm.atlas.charts import charts, welded
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.decode import Decoder
from wlm.atlas.display import FLIP_VIEWS, Screen, ScreenTally, screen_exposure
from wlm.atlas.model import AtlasModel, disk_ratio
from wlm.atlas.stages import one_thread
from wlm.atlas.views import corner_weights, mesh_charts, mesh_views, texel_triangles, visible_uv
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics import SSIM_WINDOW
from wlm.metrics.error import psnr_from_mse
from wlm.ops import raster
from wlm.ops.views import View, Viewpoint
from wlm.system import Meter, OnProgress

Sampler = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
"""A decoder: the mesh's own UVs float32 [N, 2], triangles int32 [N] and barycentrics float32 [N, 3] of points, to
linear RGB float [N, 3] or, for labels, to int [N]; all on one device."""

VIEWS, RESOLUTION = 50, 512
"""Cameras of a score, as many as in section 4.1.4, and pixels along a side of a view, which the paper doesn't state."""

_PERCENTILE, _ABOVE = 0.999, 2.0  # of the peak
_BINS, _OCTAVES = 8192, (-32.0, 32.0)  # of a histogram of light

# Wang et al. 2004, as in `wlm.metrics.structural`.
_SIGMA, _C1, _C2 = 1.5, 0.01, 0.03
_HALF = SSIM_WINDOW // 2
# Relative rounding error of reading a constant colour bilinearly in float32.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Score(system.Report):
    """The error of a decoder.

    Attributes:
        name: The mesh's name.
        views: Number of views that show the mesh.
        pixels: Covered pixels in all of them.
        peak: Range of the reference there, of the PSNRs and SSIM, see the module.
        brightest: Maximum of the reference there.
        psnr: dB, the mean over views of each view's.
        around_psnr, inside_psnr: The same of the views from around the mesh and of those from inside it.
        inside_views: Number of views from inside that show the mesh.
        eye_height: Of the viewers inside, above their floor, in the scene's unit; NaN where nobody can stand.
        psnr_worst: dB, of the worst view.
        worst_view: Its number among the cameras; -1: no view, or no peak.
        one_minus_ssim: 1 less the mean SSIM of each view's covered pixels, averaged over the views: a Gaussian window
            of 11 pixels, sigma 1.5; pixels nearer than 5 to the picture's edge are left out. Uncovered pixels of both
            pictures have the reference's nearest covered value.
        seam_error: Mean absolute error of the covered pixels within 2 pixels of a chart's border, over all views.
        rest_error: Mean absolute error of all others.
        seam_ratio: `seam_error` over `rest_error`: 1 where seams don't stand out.
        texel_psnr: dB, over the lightmap's texels that are in the mask and have their centre in a triangle.
        tone_psnr: dB, the mean over views of each view's as a screen shows it, `wlm.atlas.display`.
        flip: Mean FLIP of some of the views as a screen shows them, 0 to 1.
    """

    name: str
    views: int
    pixels: int
    peak: float
    brightest: float
    psnr: float
    around_psnr: float
    inside_psnr: float
    inside_views: int
    eye_height: float
    psnr_worst: float
    worst_view: int
    one_minus_ssim: float
    seam_error: float
    rest_error: float
    seam_ratio: float
    texel_psnr: float
    tone_psnr: float
    flip: float


@dataclass(frozen=True)
class Report(Score):
    """The error and the size of a model.

    Attributes:
        method: The model's.
        profile: Name of its settings.
        bytes: Size of its file.
        cr: Compression ratio of both textures (eq. 9).
        cr_disk: Compression ratio of the file.
    """

    method: str
    profile: str
    bytes: int
    cr: float
    cr_disk: float


def evaluate(
    model: AtlasModel,
    mesh: LightmappedMesh,
    *,
    views: int | Sequence[View | Viewpoint] = VIEWS,
    resolution: int = RESOLUTION,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
) -> Report:
    """Compares a model with the original lightmap.

    Seams are the borders of the new UVs' charts, or of the lightmap's where the mesh keeps its UVs.

    Args:
        model: The model.
        mesh: The mesh that was compressed, with its original lightmap.
        views, resolution, device, progress: As for `compare`.
        file_bytes: Size of the model's file; None: `model.file_bytes()`.

    Raises:
        WlmError: There is no such device.
    """
    decoder = Decoder(model, device)
    labels = {"model": chart_labels(model, mesh, decoder.device)} if len(model.uv) else {}
    options = {"views": views, "resolution": resolution, "device": device, "progress": progress}
    score = compare(mesh, {"model": decoder}, labels=labels, **options)["model"]
    size = model.file_bytes() if file_bytes is None else file_bytes
    return Report(
        **vars(score),
        method=model.method,
        profile=model.profile.name,
        bytes=size,
        cr=model.compression_ratio,
        cr_disk=disk_ratio(size, (model.height, model.width)),
    )


def compare(
    mesh: LightmappedMesh,
    decoders: Mapping[str, Sampler],
    *,
    views: int | Sequence[View | Viewpoint] = VIEWS,
    resolution: int = RESOLUTION,
    device: str = "cpu",
    labels: Mapping[str, Sampler] | None = None,
    progress: OnProgress | None = None,
) -> dict[str, Score]:
    """Compares any decoders with the original lightmap. Each view is drawn once for all of them.

    On the CPU torch has one thread until it returns: 50 views of 512² take some seconds, FLIP about as much a decoder.

    Args:
        mesh: The mesh with its original lightmap.
        decoders: By name; see `Sampler`.
        views: Number of cameras, spread evenly on the sphere, and of views from inside; or the cameras.
        resolution: Pixels along a side of a view, 1 to 16,384.
        device: "cpu" or "cuda:N", where the decoders are called.
        labels: For some of the decoders, numbers of their own charts or tiles: their seams are where these change.
            Those of the others are the borders of the lightmap's charts, `mesh_charts`. Either way a border lies
            between neighbouring pixels that show one triangle or two that share a corner in space, so that an outline
            in front of something else is none.
        progress: Called with the views done.

    Returns:
        The scores by name.

    Raises:
        WlmError: There is no such device, or a decoder gives NaN or infinity.
        ValueError: The resolution is out of range, a decoder's colours or labels have the wrong shape, or labels name
            no decoder.
    """
    device = check_device(device)
    labels = dict(labels or {})
    unknown = sorted(labels.keys() - decoders.keys())
    if unknown:
        raise ValueError(f"labels: expected names of decoders, got {', '.join(unknown)}")
    cameras = mesh_views(mesh, views) if isinstance(views, int) else list(views)
    inside = [isinstance(camera, Viewpoint) for camera in cameras]
    image = torch.tensor(mesh.filled, device=device)
    chart = torch.tensor(mesh_charts(mesh), device=device)
    # Corners at one place in space have one number.
    place = torch.tensor(welded(mesh.position, np.zeros_like(mesh.uv), mesh.triangle), device=device)
    factor, stride = screen_exposure(mesh), max(1, len(cameras) // FLIP_VIEWS)
    meter = Meter(progress, "evaluate", len(cameras))
    with torch.no_grad(), one_thread(device):
        peak, brightest = _peak(mesh, image, cameras, resolution)
        tallies = {name: _Tally() for name in decoders}
        for number, (visible, barycentric, uv) in enumerate(visible_uv(mesh, cameras, resolution, device)):
            hit = visible >= 0
            points = uv[hit], visible[hit], corner_weights(barycentric[hit])
            if len(points[0]):
                target = raster.texture(image, points[0]).double()
                similarity = _Similarity(hit, target, peak)
                screen = Screen(factor, hit, target, number % stride == 0)
                chart_border = _near_border(visible, chart[visible.clamp(min=0).long()], place)[hit]
                for name, decoder in decoders.items():
                    error = _colours(decoder, points, mesh, name) - target
                    border = chart_border
                    if name in labels:
                        label = torch.zeros(visible.shape, dtype=torch.int64, device=device)
                        label[hit] = _labels(labels[name], points, name)
                        border = _near_border(visible, label, place)[hit]
                    tallies[name].add(number, error, border, similarity.mean(target + error))
                    tallies[name].screen.add(*screen.errors(target + error))
            if meter.due(number + 1):
                meter.report(number + 1)
        texel_errors = _texel_errors(mesh, image, decoders)
    height = mesh.indoors.height if any(inside) else math.nan
    facts = {"name": mesh.name, "peak": peak, "brightest": brightest, "eye_height": height}
    return {name: tally.score(facts, texel_errors[name], inside) for name, tally in tallies.items()}


def chart_labels(model: AtlasModel, mesh: LightmappedMesh, device: str) -> Sampler:
    """Numbers of the charts of a model's own UVs, as `compare` takes labels.

    Args:
        model: A model with `uv`.
        mesh: The mesh that was compressed.
        device: "cpu" or "cuda:N", where the points will be.
    """
    corner = np.arange(3 * len(model.uv)).reshape(-1, 3)
    corner = welded(mesh.position[mesh.triangle].reshape(-1, 3), model.uv.reshape(-1, 2), corner)
    number = torch.from_numpy(charts(corner)).to(device)
    return lambda uv, triangle, barycentric: number[triangle.long()]


def _peak(
    mesh: LightmappedMesh, image: torch.Tensor, cameras: Sequence[View | Viewpoint], resolution: int
) -> tuple[float, float]:
    """The range of the reference in all views, see the module, and its maximum.

    Drawing twice is cheaper than storing all views.
    """
    low, high = math.inf, -math.inf
    count = torch.zeros(_BINS, dtype=torch.float64)
    for visible, _, uv in visible_uv(mesh, cameras, resolution, str(image.device)):
        colour = raster.texture(image, uv[visible >= 0])
        if len(colour):
            low, high = min(low, float(colour.min())), max(high, float(colour.max()))
            octave = colour.clamp(min=2.0 ** _OCTAVES[0]).log2().float().cpu()
            count += torch.histc(octave, _BINS, *_OCTAVES)
    if high < low:
        return math.nan, math.nan
    share = count.cumsum(0) / count.sum()
    top = int(torch.searchsorted(share, _PERCENTILE)) + 1
    top = 2.0 ** (_OCTAVES[0] + (_OCTAVES[1] - _OCTAVES[0]) * top / _BINS)
    peak = min(high, max(_ABOVE * top, low)) - low
    return (peak if peak > _ROUNDING * high else 0.0), high


_Points = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""The arguments of a `Sampler`: UVs, triangles and corner weights of points."""


def _colours(decoder: Sampler, points: _Points, mesh: LightmappedMesh, name: str) -> torch.Tensor:
    """The decoded colours, float64 [N, 3], checked."""
    colour, count = decoder(*points), len(points[0])
    if colour.shape != (count, 3):
        raise ValueError(f"{name}: expected colours [{count}, 3], got {tuple(colour.shape)}")
    broken = int((~torch.isfinite(colour).all(dim=1)).sum())
    if broken:
        raise WlmError(f"{mesh.name}: {name} decodes to NaN or infinity at {broken} of {count} points")
    return colour.double()


def _labels(labels: Sampler, points: _Points, name: str) -> torch.Tensor:
    """The labels, int64 [N], checked."""
    label, count = labels(*points), len(points[0])
    if label.shape != (count,) or label.is_floating_point():
        raise ValueError(f"{name}: expected labels, integers [{count}], got {label.dtype} {tuple(label.shape)}")
    return label.long()


@dataclass
class _Tally:
    """Sums over the views of a decoder."""

    mse: list[float] = field(default_factory=list)
    view: list[int] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    pixels: int = 0
    seam: float = 0.0
    seam_pixels: int = 0
    rest: float = 0.0
    screen: ScreenTally = field(default_factory=ScreenTally)

    def add(self, view: int, error: torch.Tensor, border: torch.Tensor, ssim: float) -> None:
        absolute = error.abs().mean(dim=1)
        self.view.append(view)
        self.mse.append(float(error.square().mean()))
        self.ssim.append(ssim)
        self.pixels += len(error)
        self.seam += float(absolute[border].sum())
        self.rest += float(absolute[~border].sum())
        self.seam_pixels += int(border.sum())

    def score(self, facts: dict[str, Any], texel_mse: float, inside: Sequence[bool]) -> Score:
        peak = facts["peak"]
        psnr = [psnr_from_mse(mse, peak) for mse in self.mse]
        kinds: tuple[list[float], list[float]] = [], []  # around the mesh, inside
        for each, number in zip(psnr, self.view, strict=True):
            kinds[inside[number]].append(each)
        ssim = [value for value in self.ssim if not math.isnan(value)]
        seam, rest = _ratio(self.seam, self.seam_pixels), _ratio(self.rest, self.pixels - self.seam_pixels)
        measured = bool(psnr) and peak > 0.0
        return Score(
            **facts,
            views=len(psnr),
            pixels=self.pixels,
            psnr=_ratio(sum(psnr), len(psnr)),
            around_psnr=_ratio(sum(kinds[0]), len(kinds[0])),
            inside_psnr=_ratio(sum(kinds[1]), len(kinds[1])),
            inside_views=len(kinds[1]),
            psnr_worst=min(psnr, default=math.nan),
            worst_view=self.view[int(np.argmin(psnr))] if measured else -1,
            one_minus_ssim=1.0 - _ratio(sum(ssim), len(ssim)),
            seam_error=seam,
            rest_error=rest,
            seam_ratio=math.inf if rest == 0.0 and seam > 0.0 else _ratio(seam, rest),
            texel_psnr=psnr_from_mse(texel_mse, peak),
            **self.screen.figures(),
        )


def _ratio(a: float, b: float) -> float:
    return a / b if b else math.nan


def _texel_errors(mesh: LightmappedMesh, image: torch.Tensor, decoders: Mapping[str, Sampler]) -> dict[str, float]:
    """Mean squared errors over the texels in the mask with their centre in an active triangle; NaN without any."""
    height, width = mesh.mask.shape
    device = image.device
    triangle, barycentric = texel_triangles(mesh, height, width, str(device))
    hit = (triangle >= 0) & torch.tensor(mesh.mask, device=device)
    row, column = torch.nonzero(hit, as_tuple=True)
    # At the centre itself, where the reference is the texel, not at the interpolated UV.
    uv = torch.stack([(column + 0.5) / width, (row + 0.5) / height], dim=1).float()
    points = uv, triangle[hit].int(), corner_weights(barycentric[hit])
    if not len(uv):
        return dict.fromkeys(decoders, math.nan)
    target = raster.texture(image, uv).double()
    return {
        name: float((_colours(decoder, points, mesh, name) - target).square().mean())
        for name, decoder in decoders.items()
    }


def _near_border(visible: torch.Tensor, label: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """The pixels within 2 pixels of a border.

    Args:
        visible: int [h, w], triangles, -1 for none.
        label: int [h, w], which differs on the two sides of a border.
        place: int [F, 3], numbers of the corners' places in space.

    Returns:
        bool [h, w].
    """
    border = torch.zeros(visible.shape, dtype=torch.bool, device=visible.device)
    for axis in (0, 1):
        count = visible.shape[axis] - 1
        first, second = (visible.narrow(axis, start, count) for start in (0, 1))
        differ = label.narrow(axis, 0, count) != label.narrow(axis, 1, count)
        pairs = torch.nonzero(differ & (first >= 0) & (second >= 0), as_tuple=True)
        corners = place[first[pairs].long()], place[second[pairs].long()]
        touch = (corners[0][:, :, None] == corners[1][:, None, :]).flatten(1).any(dim=1)
        row, column = (index[touch] for index in pairs)
        border[row, column] = True
        border[row + (axis == 0), column + (axis == 1)] = True
    # These pixels are the first ones from the border; their neighbours, also diagonal ones, the second ones.
    return torch.nn.functional.max_pool2d(border[None].float(), 3, stride=1, padding=1)[0] > 0


class _Similarity:
    """SSIM of one view's decoders, equal to `wlm.metrics.ssim` of the whole pictures.

    That one compares two images on the host; this one computes the reference's part once for all decoders, on their
    device, and only where the mesh is.

    Args:
        hit: bool [h, w], the covered pixels, at least one.
        target: float64 [N, 3], the reference there, row by row.
        peak: The range.
    """

    def __init__(self, hit: torch.Tensor, target: torch.Tensor, peak: float) -> None:
        self._peak = peak
        height, width = hit.shape
        rows, columns = (torch.nonzero(hit.any(dim=axis)).flatten() for axis in (1, 0))
        top, bottom = max(int(rows[0]) - _HALF, 0), min(int(rows[-1]) + _HALF + 1, height)
        left, right = max(int(columns[0]) - _HALF, 0), min(int(columns[-1]) + _HALF + 1, width)
        crop = hit[top:bottom, left:right]
        # The crop's outermost pixels are uncovered, or have no whole window in the picture.
        inside = crop[_HALF:-_HALF, _HALF:-_HALF] if min(crop.shape) >= SSIM_WINDOW else crop[:0]
        self._inside = inside
        if not (peak > 0.0 and bool(inside.any())):
            self._inside = inside[:0]
            return
        nearest = distance_transform_edt(~crop.cpu().numpy(), return_distances=False, return_indices=True)
        index = torch.zeros(crop.shape, dtype=torch.int64, device=hit.device)
        index[crop] = torch.arange(len(target), device=hit.device)
        row, column = torch.tensor(nearest, device=hit.device).long()
        self._hit, self._source = crop, index[row, column]
        self._reference = target[self._source].permute(2, 0, 1)
        self._mean, square = _blur(torch.stack([self._reference, self._reference.square()]))
        self._variance = square - self._mean.square()

    def mean(self, colour: torch.Tensor) -> float:
        """Mean over the covered pixels whose window is in the picture; NaN without any, or without a range.

        Args:
            colour: float64 [N, 3], decoded.
        """
        if not self._inside.numel():
            return math.nan
        picture = torch.where(self._hit, colour[self._source].permute(2, 0, 1), self._reference)
        mean, square, product = _blur(torch.stack([picture, picture.square(), picture * self._reference]))
        variance, covariance = square - mean.square(), product - mean * self._mean
        c1, c2 = (_C1 * self._peak) ** 2, (_C2 * self._peak) ** 2
        similarity = (2.0 * mean * self._mean + c1) * (2.0 * covariance + c2)
        similarity /= (mean.square() + self._mean.square() + c1) * (variance + self._variance + c2)
        return float(similarity.mean(dim=0)[self._inside].mean())


def _blur(image: torch.Tensor) -> torch.Tensor:
    """Gaussian means of [..., h, w] where the whole window is inside: [..., h - 10, w - 10]."""
    offset = torch.arange(-_HALF, _HALF + 1, dtype=image.dtype)
    weight = torch.exp(-0.5 * (offset / _SIGMA) ** 2)
    weight = (weight / weight.sum()).tolist()
    for axis in (-2, -1):
        count = image.shape[axis] - 2 * _HALF
        blurred = weight[_HALF] * image.narrow(axis, _HALF, count)
        for k in range(_HALF):
            pair = image.narrow(axis, k, count) + image.narrow(axis, 2 * _HALF - k, count)
            blurred.add_(pair, alpha=weight[k])
        image = blurred
    return image
