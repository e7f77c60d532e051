"""Fitting a lightmap set: from checked input to a compressed model (neural-dynamic-gi, sections 3.4 and 4)."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.parts import Part
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.frame_packing import needed_blocks
from wlm.lightmap.frames import choose_frames, encode_frames, missing_encoder
from wlm.lightmap.model import LightmapModel, Profile, encode_scale, part_table
from wlm.lightmap.packing import check_packable, clear_unused
from wlm.lightmap.targets import Targets
from wlm.lightmap.tiles import TILE, TileGrid, TileKind, channel_means, classify, split
from wlm.lightmap.trainer import Trainer
from wlm.system import Meter, OnProgress

BATCH_TEXELS = 64 * 26 * TILE * TILE  # texels times times in a batch: 64 tiles of 26 times, 330 MB of targets

_CONSTANT_ERROR = 0.01  # of a constant tile's radiance: half floats near their end, 6e-8, are further off


def compress(
    lightmaps: LightmapSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    **overrides: Any,
) -> LightmapModel:
    """Compresses a lightmap set.

    Args:
        lightmaps: The set.
        profile: The settings: a name, the path of a YAML file, or a `Profile`.
        tiles: Numbers of the tiles to compress; None: all. The others are stored as empty.
        seed: One seed gives one result on one device.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called about twice a second; its figures are the loss and "PSNR dB", of the samples since the last
            report, by the tiled protocol.
        checkpoint: From `open_checkpoint`: where a running fit is kept, and an interrupted one resumed.
        overrides: Settings in place of the profile's: `steps=500`.

    Returns:
        The model; its `warnings` say what could not be done as the settings ask.

    Raises:
        WlmError: No such profile, setting, device or tile; a checkpoint that isn't of this fit; the fit diverged; or
            the settings ask for frames and the extra `frames` is missing.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    device = interop.check_device(device)
    fit = _Fit(lightmaps, Profile.load(profile).override(overrides), tiles)
    fit.store_frames(progress)
    steps, batches = fit.profile.steps, fit.batches()
    meter = Meter(progress, "fit", steps * len(batches))
    for number, batch in enumerate(batches):
        parts = checkpoint.finished(number, fit.table(batch)) if checkpoint is not None else None
        if parts is not None:
            try:
                check_packable(parts, fit.profile, batch.kind == TileKind.DYNAMIC)
            except WlmError as error:
                raise WlmError(f"{checkpoint.path}: finished batch {number}: {error}") from error
        else:
            targets = fit.targets(batch.rows)
            dynamic = batch.kind == TileKind.DYNAMIC
            trainer = Trainer(fit.profile, fit.model.axis, targets, dynamic, seed, device, track=progress is not None)
            del targets
            try:
                _run(trainer, number, meter, checkpoint)
                parts = trainer.quantised()
            finally:
                trainer.close()
            if checkpoint is not None:
                checkpoint.add_finished(number, parts)
        fit.store(batch, parts)
    return fit.model


def open_checkpoint(
    output: str | os.PathLike[str],
    lightmaps: LightmapSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
    **overrides: Any,
) -> Checkpoint:
    """Opens the checkpoint of a fit: the file `OUTPUT.partial`, which names everything that the fit depends on.

    Args:
        output: The file that the fit is for.
        lightmaps, profile, tiles, seed, overrides: As for `compress`.
        device: Only its kind matters: a fit may go on on another GPU.
        resume: Whether to go on from the file, if there is one. Otherwise it is ignored, and replaced at the first
            save.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or of another fit; the line names what differs.
    """
    profile = Profile.load(profile).override(overrides)
    if profile.frames == "auto" and missing_encoder(0):
        profile = profile.override({"frames": "never"})
    fit = {
        "input": lightmaps.source,
        # Not in the input's hash, and yet the time axis wraps by it.
        "period": lightmaps.period,
        "profile": profile.model_dump(mode="json"),
        "tiles": None if tiles is None else sorted(int(tile) for tile in tiles),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, "lightmap", fit, lightmaps.source, resume=resume, every=every)


def dynamic_targets(lightmaps: LightmapSet, profile: Profile) -> Targets | None:
    """What the dynamic tiles of a set are fitted to, for peers of the trainer; None where there are none."""
    fit = _Fit(lightmaps, profile)
    rows = np.flatnonzero(fit.kinds == TileKind.DYNAMIC)
    return fit.targets(rows) if len(rows) else None


@dataclass(frozen=True, eq=False)
class _Batch:
    """Tiles of one kind that are fitted together.

    Attributes:
        kind: STATIC or DYNAMIC.
        rows: int [n], their places among the fit's tiles.
        first: Number of tiles of that kind in earlier batches.
    """

    kind: TileKind
    rows: np.ndarray
    first: int


class _Fit:
    """The tiles of a set, and the model that a fit fills with them.

    Attributes:
        profile: The settings.
        data: The N tiles, by number.
        kinds: int [N], `TileKind` of each.
        model: Complete but for the maps and networks of the batches that have not been stored.
    """

    def __init__(self, lightmaps: LightmapSet, profile: Profile, tiles: Sequence[int] | None = None) -> None:
        self.profile = profile
        self.data = split(lightmaps, profile.gamma, None if tiles is None else sorted(tiles))
        self.kinds = classify(self.data, profile.gamma, profile.static_budget_db)
        grid = TileGrid.of(*lightmaps.mask.shape)
        framed = choose_frames(self.kinds, self.data.index, lightmaps.mask, len(lightmaps.times), profile)
        warnings = ()
        if profile.frames == "auto" and framed.any() and (warning := missing_encoder(int(framed.sum()))):
            warnings, framed[:] = (f"{lightmaps.name}: {warning}",), False
        self.kinds[framed] = TileKind.FRAMES
        kind = np.zeros(grid.count, np.uint8)
        kind[self.data.index] = self.kinds
        table = part_table(profile, kind, len(lightmaps.times))
        self.model = LightmapModel(
            name=lightmaps.name,
            width=grid.width,
            height=grid.height,
            times=lightmaps.times,
            period=lightmaps.period,
            source=lightmaps.source,
            profile=profile,
            mask=lightmaps.mask,
            kind=kind,
            constant=self._constants(len(lightmaps.times)),
            warnings=warnings,
            **{name: np.zeros(part.shape, part.dtype) for name, part in table.items() if name != "constant"},
        )
        self._mapped = np.flatnonzero(np.isin(self.kinds, (TileKind.STATIC, TileKind.DYNAMIC)))
        self._set_scales()
        self._scale = self.model.scales

    def _valid(self, row: int) -> np.ndarray:
        """Colour of a tile's K valid texels, [T, K, 3] in gamma space."""
        return self.data.colour[row][:, self.data.mask[row]]

    def _constants(self, times: int) -> np.ndarray:
        """Radiance of the constant tiles, [N_c, T, 3]: half floats, or float32 where one would be over 1% off."""
        rows = np.flatnonzero(self.kinds == TileKind.CONSTANT)
        values = np.zeros((len(rows), times, 3))
        for i, row in enumerate(rows):
            radiance = self._valid(row).astype(np.float64) ** self.profile.gamma
            # The middle of the range: at most half a step of half float off.
            values[i] = 0.5 * (radiance.min(1) + radiance.max(1))
        half = values.astype(np.float16)
        return half if (np.abs(half - values) <= _CONSTANT_ERROR * values).all() else values.astype(np.float32)

    def _set_scales(self) -> None:
        """Sets scale, bound, shift and spread of the tiles that have maps (section 4), rounded as in the file."""
        model, gamma = self.model, self.profile.gamma
        means = channel_means(self.data.colour, self.data.mask)[self._mapped]
        dynamic = self.kinds[self._mapped] == TileKind.DYNAMIC
        model.scale[:] = encode_scale(means[dynamic], gamma)
        model.scale_static[:] = means[~dynamic]
        for i, (row, scale) in enumerate(zip(self._mapped, model.scales, strict=True)):
            colour = self._valid(row)
            model.peak[i] = encode_scale(colour.max((1, 2)).astype(np.float64), gamma, up=True)
            lit = scale > 0
            values = colour * np.divide(1.0, scale, out=np.zeros_like(scale), where=lit)[:, None]
            for c in range(3):
                chosen = values[lit[:, c], :, c]
                shift, spread = (chosen.mean(), chosen.std()) if chosen.size else (0.0, 1.0)
                # Half floats end at 6e-8; a channel that is the same everywhere has nothing left to spread.
                model.affine[i, :, c] = shift, max(spread, 1e-4)

    def store_frames(self, progress: OnProgress | None) -> None:
        """Encodes the tiles that are stored as frames, and puts them into the model."""
        rows = np.flatnonzero(self.kinds == TileKind.FRAMES)
        meter = Meter(progress, "frames", len(rows))
        for i, row in enumerate(rows):
            needed = needed_blocks(self.model.mask, int(self.data.index[row]))
            tile = encode_frames(self.data.colour[row], self.data.mask[row], needed, self.profile.frames_loss)
            self.model.frames[i], self.model.ranges[i] = tile
            if meter.due(i + 1):
                meter.report(i + 1)

    def batches(self) -> list[_Batch]:
        """Batches of `BATCH_TEXELS`, dynamic tiles first."""
        size = max(1, BATCH_TEXELS // (len(self.model.times) * TILE * TILE))
        result = []
        for kind in (TileKind.DYNAMIC, TileKind.STATIC):
            rows = np.flatnonzero(self.kinds == kind)
            result += [_Batch(kind, rows[i : i + size], i) for i in range(0, len(rows), size)]
        return result

    def targets(self, rows: np.ndarray) -> Targets:
        """What some tiles are fitted to."""
        slots = np.searchsorted(self._mapped, rows)
        return Targets(
            self.data.index[rows],
            self.data.colour[rows],
            self.data.mask[rows],
            self._scale[slots],
            self.model.affine[slots].astype(np.float32),
            self.profile.gamma,
            self.profile.metric_weight,
        )

    def table(self, batch: _Batch) -> dict[str, Part]:
        """The parts of a batch that is finished, as the trainer gives them."""
        kind = np.full(len(batch.rows), batch.kind, np.uint8)
        table = part_table(self.profile, kind, len(self.model.times))
        if batch.kind == TileKind.STATIC:
            return {"net": table["net_static"], "uv": table["uv"]}
        return {name: table[name] for name in ("net", "uv", "uvt", "ut", "vt")}

    def store(self, batch: _Batch, parts: dict[str, np.ndarray]) -> None:
        """Puts the maps and networks of a batch into the model."""
        for row, blocks in zip(batch.rows, parts["uv"], strict=True):
            self.model.uv[np.searchsorted(self._mapped, row)] = clear_unused(blocks, self.data.mask[row])
        for name in parts.keys() - {"uv"}:
            target = "net_static" if batch.kind == TileKind.STATIC else name
            getattr(self.model, target)[batch.first : batch.first + len(batch.rows)] = parts[name]


def _run(trainer: Trainer, number: int, meter: Meter, checkpoint: Checkpoint | None) -> None:
    """Trains batch `number` to its end, from its checkpoint if it has one."""
    steps = trainer.profile.steps
    if checkpoint is not None:
        checkpoint.restore(number, trainer.load)
    chunk = 200 if trainer.device != "cpu" else 5
    step = trainer.step
    while step < steps:
        count = min(chunk, steps - step)
        trainer.run(count)
        step += count
        done = number * steps + step
        if meter.due(done):
            try:
                meter.report(done, loss=float(trainer.losses().mean()), PSNR_dB=trainer.psnr())
            except KeyboardInterrupt:
                # Between two steps the state is whole; anywhere else an interrupt keeps nothing.
                if checkpoint is not None:
                    checkpoint.save_running(number, trainer.state())
                raise
        if checkpoint is not None and checkpoint.due():
            checkpoint.save_running(number, trainer.state())
    trainer.check()
