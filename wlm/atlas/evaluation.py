"""Measures the error of decoded lightmaps in views of the scene (lightmap-uv-clustering-cascade, section 4.1.4).

The scene is rendered from cameras around it (`wlm.ops.views`) and, where viewers can stand in it, from as many cameras
inside it (`wlm.ops.indoors`). A pixel is the lightmap's linear RGB at its surface point, without any shading. The
reference is the original lightmap read bilinearly, clamped, its gaps filled from the nearest texel of a chart. Only
covered pixels count; a view without any is left out. Results are means over all states and views.

The peak of every PSNR and the range of SSIM are one number for each state: the maximum minus the minimum of the
reference over the covered pixels of all views. (The paper doesn't name its peak; one per view would change with the
cameras.) The maximum is limited to twice the 99.9th percentile, since one bright texel must not make every error small.

Errors are also measured as displayed on a screen: light is exposed so that nearly all texels of the original's charts
are below white (`wlm.texels.exposure`), clipped to [0, 1] and encoded as sRGB. The peak of this PSNR is 1.

A result without a meaning is NaN, null in JSON: PSNR and SSIM if the reference has a single value, to within a
millionth, or nothing is covered; and seams if no view shows a border. An exact decoder has 120 dB (`PSNR_CAP_DB`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import numpy as np
import torch

from wlm import system
from wlm.atlas import codec
from wlm.atlas.charts import charts, welded
from wlm.atlas.data import LightmappedScene
from wlm.atlas.decode import Decoder
from wlm.atlas.model import AtlasModel
from wlm.atlas.views import Points, corner_weights, points_at, scene_views, sheet_charts, texel_triangles, visible_uv
from wlm.errors import WlmError
from wlm.interop import check_device, one_thread
from wlm.metrics import SSIM_WINDOW, picture_error, psnr_from_mse, ssim
from wlm.ops import raster
from wlm.ops.views import View, Viewpoint
from wlm.system import Meter, OnProgress
from wlm.texels import exposure, to_srgb

Sampler = Callable[[Points, int], torch.Tensor]
"""A decoder maps points of a scene, on one device, and the number of a state to linear RGB float [N, 3]."""

Labels = Callable[[Points], torch.Tensor]
"""Numbers of a decoder's own charts or tiles at points, int [N]."""

VIEWS, RESOLUTION = 50, 512
"""Cameras of a score, as many as in section 4.1.4, and pixels along a side of a view, which the paper doesn't state."""

SHARED_VIEWS, SHARED_RESOLUTION = 24, 256
"""Number of cameras and resolution for a scene with several lightmaps."""

FLIP_VIEWS = 8
"""FLIP is the mean of about this many views and states, evenly chosen: it takes longer than the rest of a score."""

_PERCENTILE, _ABOVE = 0.999, 2.0  # see the peak
_BINS, _OCTAVES = 8192, (-32.0, 32.0)  # bins and range of a histogram of light
_ON_DEVICE = 1 << 32  # bytes of reference lightmaps that stay on the device

# Relative rounding error of reading a constant colour bilinearly in float32.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Score(system.Report):
    """The error of a decoder, measured in views of the scene.

    Attributes:
        name: The scene's name.
        views: Number of views that show a surface with a lightmap.
        pixels: Number of covered pixels in all views.
        peak: Maximum minus minimum of the original in the covered pixels, for PSNR and SSIM; mean over the states.
        peaks: The same for each state.
        brightest: Maximum of the original's light in the covered pixels, in any state.
        psnr: dB, the mean over states and views.
        psnr_by_state: dB, means over the views.
        around_psnr, inside_psnr: The same as `psnr`, for cameras around the scene and for cameras inside.
        inside_views: Number of views from inside that show such a surface.
        eye_height: Height of the cameras inside the scene above the ground, in the scene's unit; NaN if there are none.
        psnr_worst: dB, of the worst view and state.
        worst_view: Number of the camera of that worst view; -1 if there is no view or no peak.
        one_minus_ssim: 1 minus the mean SSIM of each view's covered pixels, averaged over views and states. The window
            is a Gaussian of 11 pixels, sigma 1.5; pixels nearer than 5 to the picture's edge are left out. In both
            pictures, uncovered pixels take the original's nearest covered value.
        seam_error: Mean absolute error of the covered pixels within 2 pixels of a chart's border, over all views.
        rest_error: Mean absolute error of all other pixels.
        seam_ratio: `seam_error` over `rest_error`: 1 where seams are no worse than other pixels.
        texel_psnr: dB, over the texels that are in a mask and have their centre in a triangle; mean over the states.
        tone_psnr: dB, the mean over views and states of the PSNR as displayed on a screen.
        flip: Mean FLIP error, 0 to 1, of a subset of the views as displayed on a screen.
    """

    name: str
    views: int
    pixels: int
    peak: float
    peaks: tuple[float, ...]
    brightest: float
    psnr: float
    psnr_by_state: tuple[float, ...]
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
        method: The model's method.
        profile: Name of the settings of the compression.
        bytes: Size of the model's file in bytes.
        geometry_bytes: Bytes of the triangles and masks in the file.
        gpu_bytes: Bytes of the model's textures and tables on a GPU.
        cr: Compression ratio of the textures (eq. 9).
    """

    method: str
    profile: str
    bytes: int
    geometry_bytes: int
    gpu_bytes: int
    cr: float


def evaluate(
    model: AtlasModel,
    scene: LightmappedScene,
    *,
    views: int | Sequence[View | Viewpoint] | None = None,
    resolution: int | None = None,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> Report:
    """Compares a model with the original lightmaps of the scene; options are those of `compare`.

    Seams are the borders of charts in the model's new UVs, or in the original UVs if the mesh keeps them.

    Raises:
        WlmError: There is no such device, or the model was made from another scene.
    """
    if model.source != scene.source:
        raise WlmError(
            f"{scene.name}: expected the mesh and lightmaps that the model was made of, hash {model.source}, found "
            f"others, hash {scene.source}"
        )
    decoder = Decoder(model, device)
    labels = {"model": chart_labels(model, scene, decoder.device)} if len(model.uv) else {}
    options = {"views": views, "resolution": resolution, "device": device, "progress": progress}
    score = compare(scene, {"model": decoder}, labels=labels, **options)["model"]
    whole, geometry = codec.sizes(model)
    return Report(
        **vars(score),
        method=model.method,
        profile=model.profile.name,
        bytes=whole,
        geometry_bytes=geometry,
        gpu_bytes=-(-model.bits // 8),
        cr=model.compression_ratio,
    )


def compare(
    scene: LightmappedScene,
    decoders: Mapping[str, Sampler],
    *,
    views: int | Sequence[View | Viewpoint] | None = None,
    resolution: int | None = None,
    device: str = "cpu",
    labels: Mapping[str, Labels] | None = None,
    progress: OnProgress | None = None,
) -> dict[str, Score]:
    """Compares any decoders with the original lightmaps. All decoders share a view's two renderings.

    Args:
        scene: The scene with its original lightmaps.
        decoders: The decoders, by names that the result uses; see `Sampler`.
        views: Number of cameras spread evenly around the scene; as many are placed inside. Or the cameras. None:
            `VIEWS`, or `SHARED_VIEWS` for several lightmaps.
        resolution: Pixels along a side of a view, 1 to 16,384. None: `RESOLUTION` or `SHARED_RESOLUTION`.
        device: "cpu" or "cuda:N", where the decoders are called.
        labels: By the name of a decoder, a function from points to the index of their chart or tile: seams lie where
            it changes. For other decoders, seams are the borders of the lightmaps' charts. Outlines in front of
            other surfaces are no seams.
        progress: Called with the number of views done.

    Returns:
        The scores by name.

    Raises:
        WlmError: There is no such device, or a decoder gives NaN or infinity.
        ValueError: The resolution is out of range, a decoder's colours or labels have the wrong shape, or a name in
            `labels` isn't in `decoders`.
    """
    device, labels = check_device(device), dict(labels or {})
    unknown = sorted(labels.keys() - decoders.keys())
    if unknown:
        raise ValueError(f"labels: expected names that decoders has, got {', '.join(unknown)}")
    several = len(scene.sheets) * len(scene.states) > 1
    views = (SHARED_VIEWS if several else VIEWS) if views is None else views
    resolution = (SHARED_RESOLUTION if several else RESOLUTION) if resolution is None else resolution
    cameras = scene_views(scene, views) if isinstance(views, int) else list(views)
    inside = [isinstance(camera, Viewpoint) for camera in cameras]
    states, reference = range(len(scene.states)), _Reference(scene, device)
    chart = torch.tensor(_chart_numbers(scene), device=device)
    # Corners at the same position in space share a number.
    corners = scene.triangles
    place = torch.tensor(welded(corners.position, np.zeros_like(corners.uv), corners.triangle), device=device)
    stride = max(1, len(cameras) * len(states) // FLIP_VIEWS)
    meter = Meter(progress, "evaluate", len(cameras))
    with torch.no_grad(), one_thread(device):
        peaks, brightest = _peaks(scene, reference, cameras, resolution, device)
        tallies = {name: _Tally(len(states)) for name in decoders}
        for number, (visible, barycentric, uv) in enumerate(visible_uv(scene, cameras, resolution, device)):
            hit, points = points_at(scene, visible, barycentric, uv)
            if len(points):
                borders = {}
                for name in (None, *labels):
                    label = torch.zeros(visible.shape, dtype=torch.int64, device=device)
                    label[hit] = chart[points.triangle].long() if name is None else _labels(labels[name], points, name)
                    borders[name] = _near_border(visible, label, place)[hit]
                for state in states:
                    target = reference.light(points, state).double()
                    sampled = (number * len(states) + state) % stride == 0
                    pictures = _View(hit, target, peaks[state], reference.exposure(state), sampled)
                    for name, decoder in decoders.items():
                        error = _colours(decoder, points, state, scene, name) - target
                        border = borders[name if name in labels else None]
                        tallies[name].add(number, state, error, border, *pictures.errors(target + error))
            if meter.due(number + 1):
                meter.report(number + 1)
        texel_errors = _texel_errors(scene, reference, decoders, device)
    height = scene.indoors.height if any(inside) else math.nan
    facts = {"name": scene.name, "peaks": tuple(peaks), "brightest": brightest, "eye_height": height}
    return {name: tally.score(facts, texel_errors[name], inside) for name, tally in tallies.items()}


def chart_labels(model: AtlasModel, scene: LightmappedScene, device: str) -> Labels:
    """Makes a function for `labels` of `compare`: from points on the device to their charts' numbers in a model's new
    UVs."""
    (sheet,) = scene.sheets
    corner = np.arange(3 * len(model.uv)).reshape(-1, 3)
    corner = welded(sheet.position[sheet.triangle].reshape(-1, 3), model.uv.reshape(-1, 2), corner)
    number = torch.from_numpy(charts(corner)).to(device)
    return lambda points: number[points.triangle]


def _chart_numbers(scene: LightmappedScene) -> np.ndarray:
    """Returns the number of each triangle's chart, int64 [F]; charts of different sheets have different numbers."""
    result, count = np.full(len(scene.triangles.triangle), -1, np.int64), 0
    first = 0
    for sheet in scene.sheets:
        number = sheet_charts(sheet)
        result[first : first + len(number)] = np.where(number < 0, -1, number + count)
        first, count = first + len(number), count + int(number.max(initial=-1)) + 1
    return result


def original(scene: LightmappedScene, device: str = "cpu") -> Sampler:
    """Makes a function of points and a state that returns the original lightmaps' light there, read bilinearly."""
    return _Reference(scene, check_device(device)).light


class _Reference:
    """The original lightmaps, in the device's memory unless they are too large for it."""

    def __init__(self, scene: LightmappedScene, device: str) -> None:
        self._device = device
        self._images = [torch.from_numpy(sheet.lightmaps) for sheet in scene.sheets]
        if sum(image.nbytes for image in self._images) <= _ON_DEVICE:
            self._images = [image.to(device) for image in self._images]
        self._charts = [sheet.lightmaps[:, sheet.mask] for sheet in scene.sheets]

    def light(self, points: Points, state: int = 0) -> torch.Tensor:
        """Returns the lightmaps' light at points, read bilinearly, float32 [N, 3]."""
        if len(self._images) == 1:
            return raster.texture(self._image(0, state), points.uv)
        light = torch.empty((len(points), 3), dtype=torch.float32, device=self._device)
        for number in torch.unique(points.sheet).tolist():
            at = points.sheet == number
            light[at] = raster.texture(self._image(number, state), points.uv[at].contiguous())
        return light

    def exposure(self, state: int) -> float:
        """Returns the exposure factor from linear light to display values."""
        return exposure(np.concatenate([chart[state] for chart in self._charts]))

    def _image(self, number: int, state: int) -> torch.Tensor:
        return self._images[number][state].to(self._device)


def _peaks(
    scene: LightmappedScene, reference: _Reference, cameras: Sequence[View | Viewpoint], resolution: int, device: str
) -> tuple[list[float], float]:
    """Returns the range of the original light over all views for each state, as the module's docstring defines it, and
    the maximum over all states. Rendering each view twice is cheaper than storing all views."""
    states = range(len(scene.states))
    low, high = [math.inf] * len(states), [-math.inf] * len(states)
    count = torch.zeros((len(states), _BINS), dtype=torch.float64)
    for drawn in visible_uv(scene, cameras, resolution, device):
        points = points_at(scene, *drawn)[1]
        for state in states if len(points) else ():
            colour = reference.light(points, state)
            low[state], high[state] = min(low[state], float(colour.min())), max(high[state], float(colour.max()))
            octave = colour.clamp(min=2.0 ** _OCTAVES[0]).log2().float().cpu()
            count[state] += torch.histc(octave, _BINS, *_OCTAVES)
    if high[0] < low[0]:
        return [math.nan] * len(states), math.nan
    peaks = []
    for a, b, histogram in zip(low, high, count, strict=True):
        share = histogram.cumsum(0) / histogram.sum()
        top = int(torch.searchsorted(share, _PERCENTILE)) + 1
        top = 2.0 ** (_OCTAVES[0] + (_OCTAVES[1] - _OCTAVES[0]) * top / _BINS)
        peak = min(b, max(_ABOVE * top, a)) - a
        peaks.append(peak if peak > _ROUNDING * b else 0.0)
    return peaks, max(high)


def _colours(decoder: Sampler, points: Points, state: int, scene: LightmappedScene, name: str) -> torch.Tensor:
    colour, count = decoder(points, state), len(points)
    if colour.shape != (count, 3):
        raise ValueError(f"decoder {name}: expected colours [{count}, 3], got {tuple(colour.shape)}")
    broken = int((~torch.isfinite(colour).all(dim=1)).sum())
    if broken:
        raise WlmError(f"{scene.name}: decoder {name} gives NaN or infinity at {broken} of {count} points")
    return colour.double()


def _labels(labels: Labels, points: Points, name: str) -> torch.Tensor:
    label, count = labels(points), len(points)
    if label.shape != (count,) or label.is_floating_point():
        raise ValueError(f"labels of {name}: expected integers [{count}], got {label.dtype} {tuple(label.shape)}")
    return label.long()


@dataclass
class _Tally:
    """Collects the errors of a decoder by view and state: MSE, SSIM, and as displayed on a screen the MSE and FLIP."""

    states: int
    rows: list[tuple[float, ...]] = field(default_factory=list)
    pixels: int = 0
    seam: float = 0.0
    seam_pixels: int = 0
    rest: float = 0.0

    def add(self, view: int, state: int, error: torch.Tensor, border: torch.Tensor, *figures: float) -> None:
        absolute = error.abs().mean(dim=1)
        self.rows.append((view, state, float(error.square().mean()), *figures))
        self.pixels += len(error)
        self.seam += float(absolute[border].sum())
        self.rest += float(absolute[~border].sum())
        self.seam_pixels += int(border.sum())

    def score(self, facts: dict[str, Any], texel_mse: Sequence[float], inside: Sequence[bool]) -> Score:
        views, of_state, mse, ssim, tone_mse, flip = zip(*self.rows, strict=True) if self.rows else [()] * 6
        peaks, states = facts["peaks"], range(self.states)
        psnr = [psnr_from_mse(mse, peaks[state]) for mse, state in zip(mse, of_state, strict=True)]
        pairs = list(zip(psnr, views, of_state, strict=True))
        known = [(value, view) for value, view, _ in pairs if not math.isnan(value)]
        seam, rest = _ratio(self.seam, self.seam_pixels), _ratio(self.rest, self.pixels - self.seam_pixels)
        seen = set(views)
        return Score(
            **facts,
            peak=_mean(peaks),
            views=len(seen),
            pixels=self.pixels // self.states,
            psnr=_mean(psnr),
            psnr_by_state=tuple(_mean([value for value, _, each in pairs if each == state]) for state in states),
            around_psnr=_mean([value for value, view, _ in pairs if not inside[view]]),
            inside_psnr=_mean([value for value, view, _ in pairs if inside[view]]),
            inside_views=sum(inside[view] for view in seen),
            psnr_worst=min(known)[0] if known else math.nan,
            worst_view=min(known)[1] if known else -1,
            one_minus_ssim=1.0 - _mean(ssim),
            seam_error=seam,
            rest_error=rest,
            seam_ratio=math.inf if rest == 0.0 and seam > 0.0 else _ratio(seam, rest),
            texel_psnr=_mean([psnr_from_mse(mse, peak) for mse, peak in zip(texel_mse, peaks, strict=True)]),
            tone_psnr=_mean([psnr_from_mse(mse, 1.0) for mse in tone_mse]),
            flip=_mean(flip),
        )


def _ratio(a: float, b: float) -> float:
    return a / b if b else math.nan


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return fmean(known) if known else math.nan


def _texel_errors(
    scene: LightmappedScene, reference: _Reference, decoders: Mapping[str, Sampler], device: str
) -> dict[str, list[float]]:
    """Returns mean squared errors, by decoder and state, over mask texels whose centre is in an active triangle."""
    sums, total, first = {name: [0.0] * len(scene.states) for name in decoders}, 0, 0
    for number, sheet in enumerate(scene.sheets):
        height, width = sheet.mask.shape
        triangle, barycentric = texel_triangles(sheet, height, width, device)
        hit = (triangle >= 0) & torch.tensor(sheet.mask, device=device)
        row, column = torch.nonzero(hit, as_tuple=True)
        # The decoder is read at the texel's centre, where the reference equals the texel, not at the interpolated UV.
        uv = torch.stack([(column + 0.5) / width, (row + 0.5) / height], dim=1).float()
        owner = torch.full((len(uv),), number, dtype=torch.int32, device=device)
        points = Points(uv, owner, triangle[hit] + first, corner_weights(barycentric[hit]))
        for state in range(len(scene.states)) if len(uv) else ():
            target = reference.light(points, state).double()
            for name, decoder in decoders.items():
                error = _colours(decoder, points, state, scene, name) - target
                sums[name][state] += float(error.square().mean()) * len(uv)
        first, total = first + len(sheet.triangle), total + len(uv)
    return {name: [_ratio(each, total) for each in values] for name, values in sums.items()}


def _near_border(visible: torch.Tensor, label: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Finds the pixels within 2 pixels of a border, bool [h, w]. `visible` has a triangle's number or -1 at each pixel.
    A border lies between triangles with different labels and a corner in common; `place`, int [F, 3], numbers the
    corners, equally where they coincide."""
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
    # These pixels are adjacent to the border; their neighbours, including diagonal ones, are 2 pixels from it.
    return torch.nn.functional.max_pool2d(border[None].float(), 3, stride=1, padding=1)[0] > 0


class _View:
    """One view's pictures of the original lightmaps, to be compared with those of decoders."""

    def __init__(self, hit: torch.Tensor, target: torch.Tensor, peak: float, exposure: float, flip: bool) -> None:
        """Makes pictures of the original's light [N, 3] at the covered pixels `hit`, bool [h, w]. If `flip`, `errors`
        computes FLIP too."""
        whole = hit.cpu().numpy()
        # SSIM reads half a window around a covered pixel.
        rows, columns = (np.flatnonzero(whole.any(axis=axis)) for axis in (1, 0))
        spans = (
            slice(max(int(at[0]) - SSIM_WINDOW // 2, 0), int(at[-1]) + SSIM_WINDOW // 2 + 1) for at in (rows, columns)
        )
        self._hit, self._peak, self._exposure, self._flip = whole[tuple(spans)], peak, exposure, flip
        self._light, self._screen = self._pictures(target)

    def errors(self, light: torch.Tensor) -> tuple[float, float, float]:
        """Returns a decoder's SSIM (NaN if the original is constant), MSE as displayed on a screen, and FLIP (or
        NaN)."""
        picture, screen = self._pictures(light)
        similarity = ssim(self._light, picture, self._hit, self._peak) if self._peak > 0.0 else math.nan
        return similarity, *picture_error(self._screen, screen, self._hit, self._flip)

    def _pictures(self, light: torch.Tensor) -> np.ndarray:
        """Returns light [N, 3] as pictures, linear and as displayed, float64 [2, h, w, 3]; the rest is black."""
        values = light.cpu().numpy().astype(np.float64)
        pictures = np.zeros((2, *self._hit.shape, 3))
        pictures[:, self._hit] = values, to_srgb(values * self._exposure)
        return pictures
