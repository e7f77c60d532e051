"""Fitting a lightmap set: from checked input to a compressed model (neural-dynamic-gi, sections 3.4 and 4)."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.model import (
    LightmapModel,
    Profile,
    TimeAxis,
    decode_scale,
    encode_scale,
)
from wlm.lightmap.tiles import TILE, TileData, TileGrid, TileKind, channel_means, classify, split
from wlm.lightmap.trainer import Targets, Trainer

__all__ = ["Progress", "compress", "dynamic_targets"]

BATCH_TEXELS = 64 * 26 * TILE * TILE  # texel-times of a batch: 64 tiles of 26 times, 330 MB of targets
REPORT_EVERY = 0.5  # seconds between two reports


@dataclass(frozen=True)
class Progress:
    """Where a fit is.

    Attributes:
        step, steps: Done and in all, over all batches.
        loss: Mean over the tiles of the current batch.
        psnr: dB, of the samples since the last report, by the tiled protocol.
        seconds: So far.
    """

    step: int
    steps: int
    loss: float
    psnr: float
    seconds: float


def compress(
    lightmaps: LightmapSet,
    profile: Profile,
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[Progress], None] | None = None,
    checkpoint=None,
) -> LightmapModel:
    """Compresses a lightmap set.

    Args:
        lightmaps: The set.
        profile: The settings.
        tiles: Numbers of the tiles to compress; None: all. The others are stored as empty.
        seed: One seed gives one result on one device.
        device: "cpu" or "cuda:0".
        progress: Called about twice a second.
        checkpoint: from ``wlm.lightmap.checkpoint``, or None: where an interrupted fit is kept and resumed.

    Returns:
        The model, ready for ``wlm.lightmap.codec.write``.

    Raises:
        WlmError: On a device that isn't there, or tiles that aren't.
        KeyboardInterrupt: Raised by ``progress``, after the checkpoint, if there is one, has been written.
    """
    device = interop.check_device(device)
    axis = TimeAxis(lightmaps.times, lightmaps.period, profile.time_axis)
    data = split(lightmaps, profile.gamma, tiles)
    kinds = classify(data, profile.gamma, profile.static_budget_db)
    grid = TileGrid.of(*lightmaps.mask.shape)
    order = np.argsort(data.index, kind="stable")
    data = TileData(data.index[order], data.colour[order], data.mask[order])
    kinds = kinds[order]

    scales = _Scales(data, kinds, profile.gamma)
    jobs = _batches(kinds, lightmaps.frames.shape[0])
    results: dict[int, dict[str, np.ndarray]] = {}
    meter = _Meter(progress, profile.steps * len(jobs))
    for number, (kind, rows) in enumerate(jobs):
        if checkpoint is not None and checkpoint.finished(number) is not None:
            parts = checkpoint.finished(number)
        else:
            parts = _fit_batch(
                data,
                scales,
                profile,
                axis,
                kind == TileKind.DYNAMIC,
                rows,
                seed,
                device,
                checkpoint,
                number,
                meter,
            )
        meter.finish_batch(profile.steps)
        for i, row in enumerate(rows):
            results[int(row)] = {key: value[i] for key, value in parts.items()}
    return _assemble(lightmaps, profile, grid, data, kinds, scales, results)


class _Scales:
    """The rounded scale, bound, shift and spread of the tiles that have maps; rows follow ``data``."""

    def __init__(self, data: TileData, kinds: np.ndarray, gamma: float):
        n, times = data.colour.shape[:2]
        self.mapped = np.flatnonzero(kinds >= TileKind.STATIC)
        means = channel_means(data.colour, data.mask)[self.mapped]
        peaks = np.zeros((len(self.mapped), times))
        for i, row in enumerate(self.mapped):
            peaks[i] = data.colour[row][:, data.mask[row]].max((1, 2))
        self.dynamic = kinds[self.mapped] == TileKind.DYNAMIC
        self.scale_code = encode_scale(means[self.dynamic], gamma)
        self.scale_static = means[~self.dynamic].astype(np.float16)
        self.peak_code = encode_scale(peaks, gamma, up=True)
        self.scale = np.empty(means.shape, np.float32)  # [N_m, T, 3], as rounded
        self.scale[self.dynamic] = decode_scale(self.scale_code, gamma)
        self.scale[~self.dynamic] = self.scale_static
        self.affine = np.zeros((len(self.mapped), 2, 3), np.float16)
        self.place = {int(row): i for i, row in enumerate(self.mapped)}
        for i, row in enumerate(self.mapped):
            lit = self.scale[i] > 0
            factor = np.divide(1.0, self.scale[i], out=np.zeros_like(self.scale[i]), where=lit)
            values = data.colour[row][:, data.mask[row]] * factor[:, None]  # [T, K, 3]
            for c in range(3):
                chosen = values[lit[:, c], :, c]
                shift, spread = (chosen.mean(), chosen.std()) if chosen.size else (0.0, 1.0)
                # Half floats end at 6e-8; a channel that is the same everywhere has nothing left to spread.
                self.affine[i, :, c] = shift, max(spread, 1e-4)


def _targets(data: TileData, scales: _Scales, profile: Profile, rows: np.ndarray) -> Targets:
    place = np.array([scales.place[int(row)] for row in rows])
    return Targets(
        data.index[rows],
        data.colour[rows],
        data.mask[rows],
        scales.scale[place],
        scales.affine[place].astype(np.float32),
        profile.gamma,
        profile.metric_weight,
    )


def dynamic_targets(lightmaps: LightmapSet, profile: Profile) -> Targets | None:
    """What the dynamic tiles of a set are fitted to, for other ways to fit them; None where there are none."""
    data = split(lightmaps, profile.gamma)
    kinds = classify(data, profile.gamma, profile.static_budget_db)
    rows = np.flatnonzero(kinds == TileKind.DYNAMIC)
    return _targets(data, _Scales(data, kinds, profile.gamma), profile, rows) if len(rows) else None


def _batches(kinds: np.ndarray, times: int) -> list[tuple[TileKind, np.ndarray]]:
    most = max(1, BATCH_TEXELS // (times * TILE * TILE))
    jobs = []
    for kind in (TileKind.DYNAMIC, TileKind.STATIC):
        rows = np.flatnonzero(kinds == kind)
        jobs += [(kind, rows[i : i + most]) for i in range(0, len(rows), most)]
    return jobs


class _Meter:
    """Turns steps of batches into reports."""

    def __init__(self, report: Callable[[Progress], None] | None, steps: int):
        self._report, self._steps, self._before = report, steps, 0
        self._start = self._last = time.perf_counter()

    @property
    def wanted(self) -> bool:
        """Whether there is somebody to report to."""
        return self._report is not None

    def at(self, step: int, trainer: Trainer, now: bool = False) -> None:
        moment = time.perf_counter()
        if self._report is None or not (now or moment - self._last >= REPORT_EVERY):
            return
        self._last = moment
        loss, psnr = float(trainer.losses().mean()), trainer.psnr()
        self._report(Progress(self._before + step, self._steps, loss, psnr, moment - self._start))

    def finish_batch(self, steps: int) -> None:
        self._before += steps


def _fit_batch(
    data,
    scales: _Scales,
    profile: Profile,
    axis,
    dynamic: bool,
    rows,
    seed,
    device,
    checkpoint,
    number,
    meter,
) -> dict[str, np.ndarray]:
    targets = _targets(data, scales, profile, rows)
    trainer = Trainer(profile, axis, targets, dynamic, seed, device, track=meter.wanted)
    del targets
    try:
        if checkpoint is not None and (state := checkpoint.running(number)) is not None:
            trainer.load(state)
        chunk = 200 if device != "cpu" else 5
        step = trainer.step
        while step < profile.steps:
            count = min(chunk, profile.steps - step)
            trainer.run(count)
            step += count
            try:
                meter.at(step, trainer, now=step == profile.steps)
            except KeyboardInterrupt:
                # Between two steps, so that what is kept is whole; anywhere else an interrupt keeps nothing.
                if checkpoint is not None:
                    checkpoint.save_running(number, trainer.state())
                raise
        if not np.isfinite(trainer.losses()).all():
            bad = data.index[rows][~np.isfinite(trainer.losses())]
            raise WlmError(
                f"tile {bad[0]}: the fit diverged; expected a smaller map_rate or net_rate than {profile.name}'s"
            )
        parts = trainer.quantised()
    finally:
        trainer.close()
    result = {
        "uv": pack_mode6(parts["uv_endpoints"], _block_order(parts["uv_index"])),
        "net": parts["net"],
    }
    if dynamic:
        s = profile.uvt_slices
        uvt = pack_mode6(parts["uvt_endpoints"], _block_order(parts["uvt_index"]))
        result |= {"uvt": uvt.reshape(-1, s, *uvt.shape[1:]), "ut": parts["ut"], "vt": parts["vt"]}
    if checkpoint is not None:
        checkpoint.add_finished(number, result)
    return result


def _block_order(index: np.ndarray) -> np.ndarray:
    """Texels [S, H, W] -> blocks [S, H/4, W/4, 16], row-major in the block."""
    s, h, w = index.shape
    return index.reshape(s, h // 4, 4, w // 4, 4).swapaxes(2, 3).reshape(s, h // 4, w // 4, 16)


def _assemble(lightmaps, profile, grid, data, kinds, scales, results) -> LightmapModel:
    times, r = len(lightmaps.times), profile.uvt_resolution // 4
    dynamic = [int(i) for i in np.flatnonzero(kinds == TileKind.DYNAMIC)]
    static = [int(i) for i in np.flatnonzero(kinds == TileKind.STATIC)]
    mapped = [int(i) for i in scales.mapped]

    def stack(rows: list[int], key: str, shape: tuple[int, ...], dtype) -> np.ndarray:
        return np.stack([results[row][key] for row in rows]) if rows else np.zeros((0, *shape), dtype)

    plane = (profile.plane_rows, profile.plane_columns, 2)
    kind = np.zeros(grid.count, np.uint8)
    kind[data.index] = kinds
    constants = np.flatnonzero(kinds == TileKind.CONSTANT)
    constant = np.zeros((len(constants), times, 3), np.float16)
    for i, row in enumerate(constants):
        values = data.colour[row][:, data.mask[row]].astype(np.float64) ** profile.gamma
        constant[i] = 0.5 * (values.min(1) + values.max(1))  # the middle: at most half a step of half float off
    return LightmapModel(
        name=lightmaps.name,
        width=grid.width,
        height=grid.height,
        times=lightmaps.times,
        period=lightmaps.period,
        source=lightmaps.source,
        profile=profile,
        kind=kind,
        uv=stack(mapped, "uv", (32, 32, 16), np.uint8),
        uvt=stack(dynamic, "uvt", (profile.uvt_slices, r, r, 16), np.uint8),
        ut=stack(dynamic, "ut", plane, np.uint8),
        vt=stack(dynamic, "vt", plane, np.uint8),
        net=stack(dynamic, "net", (0,), np.float16),
        net_static=stack(static, "net", (0,), np.float16),
        scale=scales.scale_code,
        scale_static=scales.scale_static,
        peak=scales.peak_code,
        affine=scales.affine,
        constant=constant,
    )
