"""Ablation of the feature maps and of the simulation of block compression (neural-dynamic-gi, section 11).

One profile is fitted again and again in plain torch (`benchmarks.rivals.lightmap_torch`), from the same seed and for as
many steps, each time with other feature maps of about the same size in bytes. Errors are those after quantisation;
unless a row says otherwise, the network is fitted to the quantised maps at the end (section 4). The rows:

- "hybrid": the maps F_uv, F_uvt, F_ut and F_vt over texture coordinates u, v and time t, as in paper and profile.
- "2D alone": two maps F_uv and no other map. "3D alone": one F_uvt of 48 x 48 x 15 texels (table 6, figure 9).
- "tri-plane": F_uv, and F_ut and F_vt of six channels in place of F_uvt.
- "8 channels of F_uv": two maps F_uv in place of F_ut and F_vt (table 8).
- "no block simulation": the hybrid trained as 8-bit texels, which a BC7 encoder compresses at the end (table 7,
  figure 10).
- "encoder at the end": the hybrid trained with noise in place of rounding, and compressed after the last step by an
  encoder of all modes of BC7, as in the paper (section 3.4). The others round in training to the levels of mode 6.
- "kernels": the hybrid fitted by `wlm.lightmap.compress`, as a check of the fit in plain torch.
- "held out": `compress` without every second time, scored at these times alone, beside the originals of the times
  around them, interpolated. Times that are close to others, as those before and after a lamp is switched, are kept.
  "network": the network evaluates interpolated features, in place of a mix of radiance; "paper's axis": the axis of the
  features is the hour, too.

Only dynamic tiles, whose light changes over time by more than a common factor, are fitted and measured.
"""

import os
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from benchmarks.rivals.lightmap_torch import Features, PlainFit, dynamic_targets
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, check_only, demo_data
from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, load
from wlm.lightmap.evaluation import evaluate
from wlm.lightmap.fit import compress
from wlm.lightmap.profile import Profile, TimeAxis
from wlm.lightmap.tiles import TILE, TileGrid, place
from wlm.metrics import evaluate_frame, summarise

METHOD = "ablation"
"""The table of these rows."""

KERNELS = "kernels"
"""The row of the fit with fused kernels."""

VARIANTS = {
    "hybrid": Features(),
    "2D alone": Features(uv=2, uvt=0, channels=0),
    "3D alone": Features(uv=0, uvt=48, slices=15, channels=0),
    "tri-plane": Features(uvt=0, channels=6),
    "8 channels of F_uv": Features(uv=2, channels=0),
    "no block simulation": Features(blocks=False),
    "encoder at the end": Features(encoded=True),
}
"""The feature maps of each row except the last, at the sizes of profile M."""

HELD_OUT = {
    "held out": {},
    "held out, network": {"interpolation": "network"},
    "held out, paper's axis": {"interpolation": "network", "time_axis": "paper"},
}
"""The rows whose errors are of times that the fit has not seen, and the settings of their fits."""

ROWS = (*VARIANTS, KERNELS, *HELD_OUT)
"""The names of all rows."""

_PROFILE = "M"
_SEED = 0
_QUICK = {"steps": 200, "samples": 512}
_METRICS = ("psnr", "ssim")


def run(
    *,
    only: Sequence[str] | None = None,
    quick: bool,
    device: str,
    set_path: str | os.PathLike[str] | None = None,
    steps: int | None = None,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Fits the variants of profile M to one set and compares them.

    Args:
        only: Names of the variants to measure; None: all.
        quick: Whether to make short fits, which only show on a CPU that everything works.
        device: "cpu" or "cuda:0".
        set_path: A lightmap set; None: the checkout's `demos/data/city`, two tiles of the city.
        steps: Steps of each fit; None: as the profile states.
        progress: Called with a line before each part of the work.
        done: Called after each row with all rows so far.

    Returns:
        One row for each variant.

    Raises:
        WlmError: The set or the device isn't there, a name is unknown, no tile is dynamic, or a fit diverged.
    """
    only = only or ()
    check_only(only, ROWS)
    lightmaps = load(demo_data("city", "--set PATH") if set_path is None else set_path)
    profile = Profile.load(_PROFILE).override(_QUICK if quick else {})
    if steps is not None:
        profile = profile.override({"steps": steps})
    return run_rows(lightmaps, profile, only, device=device, progress=progress, done=done)


def run_rows(
    lightmaps: LightmapSet,
    profile: Profile,
    only: Sequence[str] = (),
    *,
    device: str,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Fits the variants to a set, with all settings of `profile` except the maps' sizes. Other arguments: see `run`."""
    check_only(only, ROWS)
    bench = _AblationBench(lightmaps, profile, device, progress)
    rows = []
    for name in ROWS:
        if not only or name in only:
            bench.note(f"fitting {name}")
            makers = {KERNELS: bench.kernels_row} | dict.fromkeys(VARIANTS, bench.variant_row)
            rows.append(makers.get(name, bench.held_out_row)(name))
            if done is not None:
                done(rows)
    return rows


class _AblationBench(Bench):
    def __init__(self, lightmaps: LightmapSet, profile: Profile, device: str, progress: Note | None) -> None:
        super().__init__("lightmap", device, progress, scene=f"{lightmaps.name}, ablation")
        self._set, self._lightmaps, self._profile = lightmaps, lightmaps.light, profile
        targets = dynamic_targets(self._lightmaps, profile)
        if targets is None:
            raise WlmError(
                f"{lightmaps.name}: expected a tile whose light changes over time by more than one common factor"
            )
        self._targets = targets
        self._grid = TileGrid.of(*self._lightmaps.mask.shape)
        tiles = np.ones((len(targets.number), TILE, TILE, 1), bool)
        self._held = self._assembled(tiles)[..., 0]

    def _assembled(self, tiles: np.ndarray) -> np.ndarray:
        image = np.zeros((self._grid.height, self._grid.width, tiles.shape[3]), tiles.dtype)
        place(image, tiles, self._targets.number, self._grid)
        return image

    def variant_row(self, name: str) -> Row:
        """Fits one variant of the feature maps in plain torch and returns its row."""
        axis = TimeAxis(self._lightmaps.times, self._lightmaps.period, self._profile.time_axis)
        try:
            fit = PlainFit(self._profile, axis, self._targets, VARIANTS[name], seed=_SEED, device=self.device)
            start = time.perf_counter()
            for _ in range(self._profile.steps):
                loss = fit.step()
            loss.item()  # waits for the device
            seconds = time.perf_counter() - start
            tiles = fit.decode()
        except WlmError as error:
            return self.missing_row(METHOD, name, error)
        frames = (self._assembled(tiles[:, k]) for k in range(len(self._lightmaps.times)))
        return self._row(name, "in plain torch", fit.tile_bytes * len(tiles), frames, seconds)

    def kernels_row(self, name: str) -> Row:
        """Fits the unchanged profile with the fused kernels and returns its row."""
        profile, tiles = self._profile, sorted(self._targets.number.tolist())
        compress(self._set, profile.override({"steps": 10}), tiles=tiles, device=self.device)  # compiles
        start = time.perf_counter()
        model = compress(self._set, profile, tiles=tiles, seed=_SEED, device=self.device)
        seconds = time.perf_counter() - start
        decoder = model.decoder(self.device)
        frames = (decoder.frame(t) for t in self._lightmaps.times)
        return self._row(name, "fused kernels", model.memory_bytes, frames, seconds)

    def held_out_row(self, name: str) -> Row:
        """Fits the profile with other settings without every second time, and returns the row of these times."""
        times, steps = self._lightmaps.times, self._profile.steps
        gaps = np.diff(times)
        alone = np.minimum(gaps[:-1], gaps[1:]) > np.median(gaps) / 2.0 if len(gaps) else gaps.astype(bool)
        left_out = times[1:-1][alone][::2].tolist()
        if not left_out:
            return self.missing_row(
                METHOD, name, "expected a time between two others at the usual distance, found none"
            )
        profile, tiles = self._profile.override(HELD_OUT[name]), sorted(self._targets.number.tolist())
        model = compress(self._set.without(left_out), profile, tiles=tiles, seed=_SEED, device=self.device)
        report = evaluate(model, self._set, device=self.device, metrics=_METRICS)
        held = report.light.held_out
        figures = {"mixed_psnr": held.mixed.psnr, "stored_psnr": report.psnr, "steps": steps}
        notes = f"fused kernels, {len(left_out)} of {len(times)} times left out"
        return self.row(METHOD, name, notes, psnr=held.decoded.psnr, ssim=held.decoded.ssim, **figures)

    def _row(self, name: str, notes: str, size: int, frames: Iterable[np.ndarray], seconds: float) -> Row:
        lightmaps, steps = self._lightmaps, self._profile.steps
        valid = [lightmaps.valid(i) & self._held for i in range(len(lightmaps.times))]
        triples = zip(lightmaps.frames, frames, valid, strict=True)
        scores = summarise([evaluate_frame(a, b, inside, TILE, _METRICS, name=name) for a, b, inside in triples])
        return self.row(
            METHOD,
            name,
            notes,
            bytes=size,
            bpp=8 * size / (int(self._held.sum()) * len(valid)),
            psnr=scores.psnr,
            ssim=scores.ssim,
            encode_seconds=seconds,
            step_ms=1e3 * seconds / steps,
            steps=steps,
            samples=self._profile.samples,
            dynamic_tiles=len(self._targets.number),
        )
