"""How far a decoded lightmap is from the original (lightmap-uv-clustering-cascade, section 4.1.4).

The mesh is drawn from cameras around it, ``wlm.atlas.views``. A pixel is the lightmap's linear RGB at the point that it
sees, without any shading. The reference is the original lightmap read bilinearly, clamped, its gaps filled from the
nearest texel of a chart. Only covered pixels count; a view of none is left out.

The peak of every PSNR and the range of SSIM are one number: largest less smallest of the reference's covered pixels of
all views. (The paper doesn't say which it takes; a peak for each view would change with the cameras.)

The stated behaviours:

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
decoded exactly                       PSNR is infinite, null in JSON; 1 - SSIM is 0; the seam ratio is NaN
some views exact                      each counts as ``PSNR_CAP_DB``, 120 dB, in the mean
the reference is one grey, to within  the peak is 0, PSNR and SSIM are NaN, null in JSON: there is no scale
a millionth
nothing covered in any view           the same, and the errors are NaN too
no seam on any screen                 ``seam_error`` and ``seam_ratio`` are NaN
an error at seams alone               ``seam_ratio`` is infinite, null in JSON
NaN or Inf in what was decoded        error that names the decoder
====================================  ================================================================
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from wlm.atlas.charts import mesh_charts, welded
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.views import View, sphere_views, texel_triangles, visible_uv
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics import PSNR_CAP_DB, SSIM_WINDOW
from wlm.ops import raster
from wlm.texels import fill_gaps

__all__ = ["Report", "Sampler", "evaluate"]

Sampler = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
"""A decoder: the mesh's own UVs float32 [N, 2], triangles int32 [N] and barycentrics float32 [N, 3] of points, to
linear RGB float [N, 3] or, of labels, to int [N]; all on one device."""

# Wang et al. 2004, as wlm.metrics has it.
_SIGMA, _C1, _C2 = 1.5, 0.01, 0.03
_HALF = SSIM_WINDOW // 2
# Reading one colour bilinearly in float32 gives it to within this share.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Report:
    """How wrong a decoder is.

    Attributes:
        name: The mesh's name.
        views: How many saw anything.
        pixels: Covered in all of them.
        peak: Range of the reference there, of the PSNRs and SSIM.
        psnr: dB, the mean over views of each view's.
        psnr_worst: dB, of the worst view.
        worst_view: Its number among the cameras; -1: no view, or no peak.
        one_minus_ssim: 1 less the mean SSIM of each view's covered pixels, averaged over the views: a Gaussian window
            of 11 pixels, sigma 1.5; pixels nearer than 5 to the picture's edge are left out. Beside the mesh both
            pictures have the reference's nearest covered pixel.
        seam_error: Mean absolute error of the covered pixels within 2 pixels of a chart's border, over all views.
        rest_error: Of all others.
        seam_ratio: ``seam_error`` over ``rest_error``: 1 where seams don't stand out.
        texel_psnr: dB, over the lightmap's texels that are in the mask and have their centre in a triangle.
    """

    name: str
    views: int
    pixels: int
    peak: float
    psnr: float
    psnr_worst: float
    worst_view: int
    one_minus_ssim: float
    seam_error: float
    rest_error: float
    seam_ratio: float
    texel_psnr: float

    def to_json(self) -> dict[str, Any]:
        """The report as JSON's own types, under the attributes' names; NaN and infinity are None."""
        values = dataclasses.asdict(self)
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in values.items()
        }


def evaluate(
    mesh: LightmappedMesh,
    decoders: Mapping[str, Sampler],
    *,
    views: int | Sequence[View] = 50,
    resolution: int = 512,
    device: str = "cpu",
    labels: Mapping[str, Sampler] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Report]:
    """Compares decoders with the original lightmap. Each view is drawn for all of them at once.

    On the CPU torch has one thread until it returns: 50 views of 512² take 2 to 5 s.

    Args:
        mesh: The mesh with its original lightmap.
        decoders: By name; see ``Sampler``.
        views: How many cameras, spread evenly on the sphere; or the cameras.
        resolution: Pixels along a side of a view, 1 to 16,384.
        device: "cpu" or "cuda:N", where the decoders are called.
        labels: For some of the decoders, what numbers their own charts or tiles: their seams are where it changes.
            Those of the others are the borders of the lightmap's charts, ``mesh_charts``. Either way a border is
            between neighbouring pixels that see one triangle or two that share a corner in space, so that an outline in
            front of something else is none.
        progress: Called with the views done and their number.

    Returns:
        The reports by name.

    Raises:
        WlmError: There is no such device, or a decoder gives NaN or infinity.
        ValueError: The resolution is out of range, a decoder's colours or labels have the wrong shape, or labels are
            given for no decoder.
    """
    device = check_device(device)
    labels = dict(labels or {})
    unknown = sorted(labels.keys() - decoders.keys())
    if unknown:
        raise ValueError(f"labels: expected names of decoders, got {', '.join(unknown)}")
    cameras = sphere_views(views) if isinstance(views, int) else list(views)
    image = torch.tensor(fill_gaps(mesh.lightmap, mesh.mask), device=device)
    chart = torch.tensor(mesh_charts(mesh), device=device)
    # Corners at one place in space have one number.
    place = torch.tensor(welded(mesh.position, np.zeros_like(mesh.uv), mesh.triangle), device=device)
    with torch.no_grad(), _one_thread(device):
        peak = _peak(mesh, image, cameras, resolution)
        tallies = {name: _Tally() for name in decoders}
        for number, (seen, barycentric, uv) in enumerate(visible_uv(mesh, cameras, resolution, device)):
            hit = seen >= 0
            points = _Points.of(uv[hit], seen[hit], barycentric[hit])
            if len(points.uv):
                wanted = raster.texture(image, points.uv).double()
                similar = _Similarity(hit, wanted, peak)
                border = _near_border(seen, chart[seen.clamp(min=0).long()], place)[hit]
                for name, decoder in decoders.items():
                    error = points.decode(decoder, mesh, name) - wanted
                    own = border
                    if name in labels:
                        label = torch.zeros(seen.shape, dtype=torch.int64, device=device)
                        label[hit] = points.labels(labels[name], name)
                        own = _near_border(seen, label, place)[hit]
                    tallies[name].add(number, error, own, similar.mean(wanted + error))
            if progress is not None:
                progress(number + 1, len(cameras))
        texels = _texel_errors(mesh, image, decoders)
    return {name: tally.report(mesh.name, peak, texels[name]) for name, tally in tallies.items()}


@contextmanager
def _one_thread(device: str) -> Iterator[None]:
    """Keeps torch to one thread on the CPU: its calls are short, and where others want the cores its second thread
    makes an evaluation ten times slower, while on a free machine it gains little."""
    threads = torch.get_num_threads()
    try:
        if device == "cpu":
            torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)


def _peak(mesh: LightmappedMesh, image: torch.Tensor, cameras: Sequence[View], resolution: int) -> float:
    """Largest less smallest of the reference in all views. Drawing twice is cheaper than keeping what all views see."""
    low, high = math.inf, -math.inf
    for seen, _, uv in visible_uv(mesh, cameras, resolution, str(image.device)):
        colour = raster.texture(image, uv[seen >= 0])
        if len(colour):
            low, high = min(low, float(colour.min())), max(high, float(colour.max()))
    if high < low:
        return math.nan
    return high - low if high - low > _ROUNDING * high else 0.0


@dataclass(frozen=True, eq=False)
class _Points:
    """What N pixels or texels see."""

    uv: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor

    @staticmethod
    def of(uv: torch.Tensor, triangle: torch.Tensor, barycentric: torch.Tensor) -> _Points:
        """Adds the third weight to [N, 2]."""
        return _Points(uv, triangle, torch.cat([barycentric, 1.0 - barycentric.sum(1, keepdim=True)], dim=1))

    def decode(self, decoder: Sampler, mesh: LightmappedMesh, name: str) -> torch.Tensor:
        """The colours, float64 [N, 3], checked."""
        colour = decoder(self.uv, self.triangle, self.barycentric)
        if colour.shape != (len(self.uv), 3):
            raise ValueError(f"{name}: expected colours [{len(self.uv)}, 3], got {tuple(colour.shape)}")
        broken = int((~torch.isfinite(colour).all(dim=1)).sum())
        if broken:
            raise WlmError(f"{mesh.name}: {name} decodes to NaN or infinity at {broken} of {len(colour)} points")
        return colour.double()

    def labels(self, label: Sampler, name: str) -> torch.Tensor:
        """The numbers, int64 [N], checked."""
        number = label(self.uv, self.triangle, self.barycentric)
        if number.shape != (len(self.uv),) or number.is_floating_point():
            raise ValueError(
                f"{name}: expected labels, integers [{len(self.uv)}], got {number.dtype} {tuple(number.shape)}"
            )
        return number.long()


@dataclass
class _Tally:
    """What adds up over the views of a decoder."""

    mse: list[float] = field(default_factory=list)
    view: list[int] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    pixels: int = 0
    seam: float = 0.0
    seam_pixels: int = 0
    rest: float = 0.0

    def add(self, view: int, error: torch.Tensor, border: torch.Tensor, ssim: float) -> None:
        absolute = error.abs().mean(dim=1)
        self.view.append(view)
        self.mse.append(float(error.square().mean()))
        self.ssim.append(ssim)
        self.pixels += len(error)
        self.seam += float(absolute[border].sum())
        self.rest += float(absolute[~border].sum())
        self.seam_pixels += int(border.sum())

    def report(self, name: str, peak: float, texel_mse: float) -> Report:
        psnr = [_psnr(mse, peak) for mse in self.mse]
        capped = [min(value, PSNR_CAP_DB) for value in psnr]
        exact = bool(psnr) and min(psnr) == math.inf
        ssim = [value for value in self.ssim if not math.isnan(value)]
        seam, rest = _ratio(self.seam, self.seam_pixels), _ratio(self.rest, self.pixels - self.seam_pixels)
        measured = bool(psnr) and peak > 0.0
        return Report(
            name=name,
            views=len(psnr),
            pixels=self.pixels,
            peak=peak,
            psnr=math.inf if exact else _ratio(sum(capped), len(capped)),
            psnr_worst=min(psnr, default=math.nan),
            worst_view=self.view[int(np.argmin(psnr))] if measured else -1,
            one_minus_ssim=1.0 - _ratio(sum(ssim), len(ssim)),
            seam_error=seam,
            rest_error=rest,
            seam_ratio=math.inf if rest == 0.0 and seam > 0.0 else _ratio(seam, rest),
            texel_psnr=_psnr(texel_mse, peak),
        )


def _ratio(a: float, b: float) -> float:
    return a / b if b else math.nan


def _psnr(mse: float, peak: float) -> float:
    """Decibels: infinite without an error, NaN without a range."""
    if math.isnan(mse) or not peak > 0.0:
        return math.nan
    return 20.0 * math.log10(peak) - 10.0 * math.log10(mse) if mse > 0.0 else math.inf


def _texel_errors(mesh: LightmappedMesh, image: torch.Tensor, decoders: Mapping[str, Sampler]) -> dict[str, float]:
    """Mean squared errors over the texels in the mask with their centre in an active triangle; NaN if there is none."""
    height, width = mesh.mask.shape
    device = image.device
    found, barycentric = texel_triangles(mesh, height, width, str(device))
    hit = (found >= 0) & torch.tensor(mesh.mask, device=device)
    row, column = torch.nonzero(hit, as_tuple=True)
    # At the centre itself, where the reference is the texel, not at the interpolated UV.
    uv = torch.stack([(column + 0.5) / width, (row + 0.5) / height], dim=1).float()
    points = _Points.of(uv, found[hit].int(), barycentric[hit])
    if not len(uv):
        return dict.fromkeys(decoders, math.nan)
    wanted = raster.texture(image, uv).double()
    return {
        name: float((points.decode(decoder, mesh, name) - wanted).square().mean()) for name, decoder in decoders.items()
    }


def _near_border(seen: torch.Tensor, label: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """The pixels within 2 pixels of a border.

    Args:
        seen: int [h, w], triangles, -1 for none.
        label: int [h, w], what differs on both sides of a border.
        place: int [F, 3], numbers of the corners' places in space.

    Returns:
        bool [h, w].
    """
    border = torch.zeros(seen.shape, dtype=torch.bool, device=seen.device)
    for axis in (0, 1):
        count = seen.shape[axis] - 1
        first, second = (seen.narrow(axis, start, count) for start in (0, 1))
        differ = label.narrow(axis, 0, count) != label.narrow(axis, 1, count)
        pairs = torch.nonzero(differ & (first >= 0) & (second >= 0), as_tuple=True)
        corners = place[first[pairs].long()], place[second[pairs].long()]
        touch = (corners[0][:, :, None] == corners[1][:, None, :]).flatten(1).any(dim=1)
        row, column = (index[touch] for index in pairs)
        border[row, column] = True
        border[row + (axis == 0), column + (axis == 1)] = True
    # These are the pixels at the border; their neighbours, also diagonal ones, are the second ones from it.
    return torch.nn.functional.max_pool2d(border[None].float(), 3, stride=1, padding=1)[0] > 0


class _Similarity:
    """SSIM of one view against many decoders, with what depends on the reference worked out once.

    Args:
        hit: bool [h, w], the covered pixels, some of them true.
        wanted: float64 [N, 3], the reference there, row by row.
        peak: The range.
    """

    def __init__(self, hit: torch.Tensor, wanted: torch.Tensor, peak: float) -> None:
        self._peak = peak
        height, width = hit.shape
        rows, columns = (torch.nonzero(hit.any(dim=axis)).flatten() for axis in (1, 0))
        top, bottom = max(int(rows[0]) - _HALF, 0), min(int(rows[-1]) + _HALF + 1, height)
        left, right = max(int(columns[0]) - _HALF, 0), min(int(columns[-1]) + _HALF + 1, width)
        cut = hit[top:bottom, left:right]
        # The crop's outermost pixels are out of the picture's inside, or uncovered.
        inside = cut[_HALF:-_HALF, _HALF:-_HALF] if min(cut.shape) >= SSIM_WINDOW else cut[:0]
        self._inside = inside
        if not (peak > 0.0 and bool(inside.any())):
            self._inside = inside[:0]
            return
        nearest = distance_transform_edt(~cut.cpu().numpy(), return_distances=False, return_indices=True)
        rank = torch.zeros(cut.shape, dtype=torch.int64, device=hit.device)
        rank[cut] = torch.arange(len(wanted), device=hit.device)
        row, column = torch.tensor(nearest, device=hit.device).long()
        self._hit, self._source = cut, rank[row, column]
        self._reference = wanted[self._source].permute(2, 0, 1)
        self._mean, square = _blur(torch.stack([self._reference, self._reference.square()]))
        self._variance = square - self._mean.square()

    def mean(self, colour: torch.Tensor) -> float:
        """SSIM's mean over the covered pixels whose window is in the picture; NaN if there is none, or no range.

        Args:
            colour: float64 [N, 3], decoded.
        """
        if not self._inside.numel():
            return math.nan
        picture = torch.where(self._hit, colour[self._source].permute(2, 0, 1), self._reference)
        mean, square, product = _blur(torch.stack([picture, picture.square(), picture * self._reference]))
        variance, covariance = square - mean.square(), product - mean * self._mean
        c1, c2 = (_C1 * self._peak) ** 2, (_C2 * self._peak) ** 2
        similar = (2.0 * mean * self._mean + c1) * (2.0 * covariance + c2)
        similar /= (mean.square() + self._mean.square() + c1) * (variance + self._variance + c2)
        return float(similar.mean(dim=0)[self._inside].mean())


def _blur(image: torch.Tensor) -> torch.Tensor:
    """Gaussian means of [..., h, w] where the window is inside: [..., h - 10, w - 10]."""
    offset = torch.arange(-_HALF, _HALF + 1, dtype=image.dtype)
    weight = torch.exp(-0.5 * (offset / _SIGMA) ** 2)
    weight = (weight / weight.sum()).tolist()
    for axis in (-2, -1):
        count = image.shape[axis] - 2 * _HALF
        blurred = weight[_HALF] * image.narrow(axis, _HALF, count)
        for k in range(_HALF):
            both = image.narrow(axis, k, count) + image.narrow(axis, 2 * _HALF - k, count)
            blurred.add_(both, alpha=weight[k])
        image = blurred
    return image
