"""Comparison of two models of one input: bytes, settings, scores, and the PSNR between their decoded light."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wlm import atlas, lightmap, probe
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.formats.light import read_light
from wlm.metrics import PSNR_CAP_DB, psnr
from wlm.system import Meter, Model, OnProgress, load
from wlm.texels import fill_gaps
from wlm.view.display import Display, white_of
from wlm.view.document import Document

_Path = str | os.PathLike[str]

_GAIN = 8.0  # factor on differences in pictures
_SIDE = 300  # width of a picture in CSS pixels


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two models, A and B.

    Attributes:
        names: Names of the files; whole paths if the names are equal.
        system: System of both models.
        bytes: Sizes of the files.
        parts: Bytes of each part, the largest first; 0 if a file lacks it.
        settings: Settings that differ; None if a profile lacks one.
        apart: PSNR of B with A as the reference, dB; 120 if both decode to the same light.
        scores: Scores of each model against the original by name; empty without an original.
        pictures: Linear light of A, B and the original, if given, where A and B differ most.
        where: Description of the pictures.
    """

    names: tuple[str, str]
    system: str
    bytes: tuple[int, int]
    parts: Mapping[str, tuple[int, int]]
    settings: Mapping[str, tuple[Any, Any]]
    apart: float
    scores: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    where: str = ""

    @property
    def headings(self) -> tuple[str, str]:
        """Headings of the columns of A and B."""
        return f"A: {self.names[0]}", f"B: {self.names[1]}"

    def rows(self) -> list[tuple[str, str, str]]:
        """Rows of the table as text: name, value of A, value of B."""
        rows = [("bytes", *(f"{size:,}" for size in self.bytes))]
        rows += [(name, *(_number(value) for value in pair)) for name, pair in self.scores.items()]
        rows += [("PSNR of B against A, dB", "", f"{self.apart:.2f}")]
        settings = {"profile" if name == "name" else name: pair for name, pair in self.settings.items()}
        rows += [(name, *(_text(value) for value in pair)) for name, pair in settings.items()]
        return rows + [(f"bytes of {name}", *(f"{size:,}" for size in pair)) for name, pair in self.parts.items()]

    def write(self, path: str | os.PathLike[str]) -> int:
        """Writes the comparison as an HTML file; returns its size in bytes.

        Raises:
            WlmError: The file cannot be written.
        """
        page = Document(" and ".join(self.names))
        page.table("", ("", *self.headings), self.rows())
        if self.pictures:
            display = Display(1.0 / white_of(next(iter(self.pictures.values()))))
            a, b, *rest = self.pictures.values()
            shown = {name: display.picture(light) for name, light in self.pictures.items()}
            shown[f"|A - B| × {_GAIN:g}"] = display.picture(np.abs(a - b) * _GAIN)
            for original in rest:
                for name, light in (("A", a), ("B", b)):
                    shown[f"error of {name} × {_GAIN:g}"] = display.picture(np.abs(light - original) * _GAIN)
            page.pictures(self.where, shown, _SIDE)
        return page.write(path)


def compare(
    first: _Path,
    second: _Path,
    *,
    original: _Path | None = None,
    key: str | None = None,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> Comparison:
    """Compares two models of one input. Of lightmaps with several sheets the first sheet of radiance is compared.

    Args:
        first, second: Two `.wlm` of lightmaps, probes or atlases.
        original: The input that was compressed (lightmap set, probe file or lightmap of an atlas); None: no scores.
        key: Array of a probe file with several.
        device: Device that decodes both.
        progress: Called about twice a second.

    Raises:
        WlmError: A file cannot be read, the systems or sizes differ, or the models have nothing to compare.
    """
    paths = Path(first), Path(second)
    models = load(paths[0]), load(paths[1])
    systems = [model.SYSTEM for model in models]
    if systems[0] != systems[1]:
        raise WlmError(f"{paths[1]}: expected a model of {systems[0]} like {paths[0]}, found one of {systems[1]}")
    if systems[0] == "lightmap":
        return _lightmaps(paths, models, original, device, progress)
    if systems[0] == "probe":
        return _probes(paths, models, original, key, device, progress)
    if systems[0] == "atlas":
        return _atlases(paths, models, original, device, progress)
    raise WlmError(f"{paths[0]}: networks are compared by wlm evaluate, which gives each the same smoke")


def _facts(paths: Sequence[Path], models: Sequence[Model]) -> dict[str, Any]:
    """Attributes of a comparison that all systems have."""
    parts = [read_artifact(path).parts for path in paths]
    profiles = [model.profile.model_dump(mode="json") for model in models]
    names = list(dict.fromkeys([*profiles[0], *profiles[1]]))
    settings = {name: tuple(profile.get(name) for profile in profiles) for name in names}
    sizes = {name: tuple(each.get(name, 0) for each in parts) for name in dict.fromkeys([*parts[0], *parts[1]])}
    alike = paths[0].resolve().name == paths[1].resolve().name
    return {
        "names": tuple(str(path) if alike else path.resolve().name for path in paths),
        "system": models[0].SYSTEM,
        "bytes": tuple(path.stat().st_size for path in paths),
        "parts": dict(sorted(sizes.items(), key=lambda part: -max(part[1]))),
        "settings": {name: pair for name, pair in settings.items() if pair[0] != pair[1]},
    }


def _lightmaps(
    paths: Sequence[Path], models: Sequence[Any], original: _Path | None, device: str, progress: OnProgress | None
) -> Comparison:
    sizes = [(model.light.width, model.light.height) for model in models]
    if sizes[0] != sizes[1]:
        raise WlmError(f"{paths[1]}: expected lightmaps of {_size(sizes[0])}, found {_size(sizes[1])}")
    decoders = [model.decoder(device).light for model in models]
    times = models[0].times
    frames, meter = [], Meter(progress, "decode", len(times))
    for time in times:
        frames.append([decoder.frame(time) for decoder in decoders])
        if meter.due(len(frames)):
            meter.report(len(frames))
    # A frame of one colour has no range, and so no PSNR.
    by_time = [psnr(a, b) for a, b in frames]
    by_time = np.where(np.isnan(by_time), PSNR_CAP_DB, by_time)
    furthest = int(np.argmin(by_time))
    pictures = {"A": frames[furthest][0], "B": frames[furthest][1]}
    scores = {}
    if original is not None:
        lightmaps = lightmap.load(original)
        reports = [
            lightmap.evaluate(model, lightmaps, views=0, device=device, progress=_stage(progress, name))
            for model, name in zip(models, "AB", strict=True)
        ]
        names = {"PSNR dB": "psnr", "worst PSNR dB": "worst_psnr", "seen dB": "seen", "SSIM": "ssim", "FLIP": "flip"}
        scores = {title: tuple(getattr(report.light, name) for report in reports) for title, name in names.items()}
        nearest = int(np.abs(lightmaps.times - times[furthest]).argmin())
        mask = lightmaps.light.mask[..., None]
        pictures = {name: light * mask for name, light in pictures.items()}
        pictures["original"] = lightmaps.light.frames[nearest] * mask
    where = f"Furthest apart at time {times[furthest]:g}: {by_time[furthest]:.2f} dB"
    mean = float(np.mean(by_time))
    return Comparison(**_facts(paths, models), apart=mean, scores=scores, pictures=pictures, where=where)


def _probes(
    paths: Sequence[Path],
    models: Sequence[Any],
    original: _Path | None,
    key: str | None,
    device: str,
    progress: OnProgress | None,
) -> Comparison:
    counts = [(model.probes, model.outputs) for model in models]
    if counts[0] != counts[1]:
        probes, numbers = counts[0]
        raise WlmError(f"{paths[1]}: expected {probes} probes of {numbers} numbers, found {counts[1]}")
    scores, position = {}, None
    if original is not None:
        probes = probe.load(original, key=key)
        reports = [
            probe.evaluate(model, probes, device=device, progress=_stage(progress, name))
            for model, name in zip(models, "AB", strict=True)
        ]
        names = {"PSNR dB": "psnr", "PSNR of irradiance, dB": "irradiance_psnr", "largest error": "max_abs_error"}
        scores = {title: tuple(getattr(report, name) for report in reports) for title, name in names.items()}
        position = probes.position
    elif models[0].has_positions:
        position = models[0].stored_positions()
    else:
        raise WlmError(f"{paths[0]}: the file has no positions; expected --original, the file that was compressed")
    values = [model.decoder(device).decode_probes(position) for model in models]
    return Comparison(**_facts(paths, models), apart=psnr(*(each[:, None] for each in values)), scores=scores)


def _atlases(
    paths: Sequence[Path], models: Sequence[Any], original: _Path | None, device: str, progress: OnProgress | None
) -> Comparison:
    sizes = [tuple(sheet.size for sheet in model.sheets) for model in models]
    if sizes[0] != sizes[1]:
        raise WlmError(f"{paths[1]}: expected lightmaps of the same sizes as {paths[0]}")
    scene, decoders = models[0].scene, [model.decoder(device) for model in models]
    mask = scene.sheets[0].mask[..., None]
    light = [decoder.lightmap() * mask for decoder in decoders]
    pictures, scores = {"A": light[0], "B": light[1]}, {}
    if original is not None:
        if len(scene.sheets) * len(scene.states) > 1:
            raise WlmError(f"{original}: expected models of one lightmap; wlm evaluate scores scenes")
        picture = np.nan_to_num(read_light(original)[0][..., :3].astype(np.float32), posinf=65504.0)
        if picture.shape[:2] != sizes[0][0]:
            raise WlmError(
                f"{original}: expected {_size(sizes[0][0][::-1])} texels, found {_size(picture.shape[1::-1])}"
            )
        sheet = replace(scene.sheets[0], lightmaps=fill_gaps(picture, mask[..., 0])[None])
        samplers = dict(zip("AB", decoders, strict=True))
        found = atlas.compare(replace(scene, sheets=(sheet,)), samplers, device=device, progress=progress)
        names = {
            "PSNR of views, dB": "psnr",
            "PSNR of texels, dB": "texel_psnr",
            "PSNR tone mapped, dB": "tone_psnr",
            "1 - SSIM": "one_minus_ssim",
            "FLIP": "flip",
        }
        scores = {title: tuple(getattr(found[each], name) for each in "AB") for title, name in names.items()}
        pictures["original"] = sheet.lightmap * mask
    apart = psnr(*light, mask[..., 0])
    return Comparison(
        **_facts(paths, models), apart=apart, scores=scores, pictures=pictures, where="The first lightmap"
    )


def _stage(progress: OnProgress | None, name: str) -> OnProgress | None:
    """Reports the progress of one of the two models as a separate stage."""
    if progress is None:
        return None
    return lambda report: progress(replace(report, stage=f"{report.stage} {name}"))


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _number(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4g}"


def _text(value: Any) -> str:
    return "–" if value is None else str(value)
