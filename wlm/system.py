"""What the four systems share: settings by name, progress, reports, headers of files, save and load.

Only manners are shared here; each system's mathematics stays in its own rooms:

    data.py        what comes in, checked          `load`
    model.py       settings and arrays             `Profile`, the model
    fit.py         training                        `compress` (smoke: `train`)
    codec.py       model to parts and back         `encode`, `decode`
    decode.py      the runtime path                `Decoder`
    exact.py       the same in float64, to check
    evaluation.py  scores                          `evaluate`
    exporter.py    files for engines               `export`
"""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict

from wlm.config import check_settings, load_settings, profile_path
from wlm.errors import WlmError
from wlm.formats.artifact import FORMAT_VERSION, Artifact, encode_artifact, read_artifact, write_artifact

# Which package reads which system's files.
_PACKAGES = {
    "lightmap": "wlm.lightmap",
    "atlas": "wlm.atlas",
    "probe": "wlm.probe",
    "smoke-network": "wlm.smoke",
}
_REPORT_EVERY = 0.5  # seconds between two reports of progress


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


Name = Annotated[str, AfterValidator(_printable)]
"""A name from a file: what a terminal would obey rather than show has become spaces."""


class Settings(BaseModel):
    """Settings of a fit, loaded by name: the base of each system's `Profile`.

    Attributes:
        FILES: First part of the names of its files, `configs/FILES-NAME.yaml`.
        name: Shown in reports.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    FILES: ClassVar[str]
    name: Name

    @classmethod
    def load(cls, profile: str | os.PathLike[str] | Self) -> Self:
        """Loads a profile.

        Args:
            profile: A name (`configs/FILES-NAME.yaml`), the path of a YAML file, or settings, which are returned.

        Raises:
            WlmError: Unknown profile, unreadable file, or a wrong setting.
        """
        if isinstance(profile, cls):
            return profile
        path = os.fspath(profile)
        return load_settings(cls, path if path.endswith((".yaml", ".yml")) else profile_path(cls.FILES, path))

    def override(self, values: Mapping[str, Any], prefix: str = "") -> Self:
        """Replaces some settings.

        Args:
            values: By name; None leaves a setting as it is.
            prefix: Text before the setting's name in an error, `"--"` where they are options.

        Raises:
            WlmError: Unknown or out of range.
        """
        changes = {name: value for name, value in values.items() if value is not None}
        return check_settings(type(self), self.model_dump() | changes, prefix) if changes else self

    def changes(self) -> dict[str, Any]:
        """The settings that differ from the defaults, as plain values: what a file's header holds."""
        defaults = type(self)(name="").model_dump()
        return {name: value for name, value in self.model_dump().items() if value != defaults[name]}


@dataclass(frozen=True)
class Progress:
    """How far long work is.

    Attributes:
        stage: What is being done, in a word or two: "fit", "cluster".
        done, total: Steps done and in all; a total of 0 is unknown.
        seconds: Since the work began.
        figures: What can be said so far, by name with the unit: `{"PSNR dB": 41.2}`. NaN is unknown.
    """

    stage: str
    done: int
    total: int
    seconds: float
    figures: Mapping[str, float] = field(default_factory=dict)


OnProgress = Callable[[Progress], None]
"""A callback of long work. It may raise KeyboardInterrupt: the work stops between two steps, after its checkpoint, if
there is one, has been written."""


class Meter:
    """Reports progress about twice a second.

    Attributes:
        seconds: Since the work began.
    """

    def __init__(self, progress: OnProgress | None, stage: str, total: int, every: float = _REPORT_EVERY) -> None:
        """Starts the clock.

        Args:
            progress: The callback, or None for no reports.
            stage: As in `Progress`.
            total: As in `Progress`.
            every: Seconds between two reports.
        """
        self._progress, self._stage, self._total, self._every = progress, stage, total, every
        self._start = self._last = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._start

    def due(self, done: int) -> bool:
        """Whether a report is due: worth asking before figures that cost time."""
        if self._progress is None:
            return False
        return done >= self._total > 0 or time.perf_counter() - self._last >= self._every

    def report(self, done: int, **figures: float) -> None:
        """Reports at once; `figures` have their names' spaces as underscores: `PSNR_dB=41.2`."""
        if self._progress is None:
            return
        self._last = time.perf_counter()
        named = {name.replace("_", " "): value for name, value in figures.items()}
        self._progress(Progress(self._stage, done, self._total, self.seconds, named))


class Report:
    """Base of a system's report, which is a frozen dataclass."""

    def to_json(self) -> dict[str, Any]:
        """The report as JSON's own types, under the attributes' names; NaN and infinity are None."""
        return plain({item.name: getattr(self, item.name) for item in dataclasses.fields(self)})


def plain(value: Any) -> Any:
    """Turns NumPy values, tuples, dataclasses, NaN and infinity into what JSON holds."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class Header(BaseModel):
    """What a file's header says beside its parts: the base of each codec's table of settings.

    Types are exact: no number is taken from a text, no count from a float. No number is NaN or infinite.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Model:
    """Base of a system's model: what its file holds.

    Saving, loading and decoding are asked for here and done in the system's `codec` and `decode`. These stand above
    its `model`, so they are looked up when they are called.

    Attributes:
        SYSTEM: The system's name in files.
        DECODER: Module and class of the decoder, in the system's package.
    """

    SYSTEM: ClassVar[str]
    DECODER: ClassVar[tuple[str, str]] = ("decode", "Decoder")

    def save(self, path: str | os.PathLike[str]) -> int:
        """Writes the model to one file, whole or not at all.

        Returns:
            The file's size, bytes.

        Raises:
            WlmError: What the file would hold can't be read again, NaN from a fit that diverged for example; or the
                file can't be written. What was there before stays.
        """
        try:
            settings, parts, source = self._encoded()
        except WlmError as error:
            raise WlmError(f"{path}: {error}") from error
        content = Artifact(self.SYSTEM, FORMAT_VERSION, settings, source, parts, {}, 0, 0)
        decode(f"{path}: not written", content, _room(self.SYSTEM, "codec").decode)
        return write_artifact(path, self.SYSTEM, settings, parts, source)

    def file_bytes(self) -> int:
        """Size of the file that `save` writes, bytes."""
        return sum(memoryview(part).nbytes for part in encode_artifact(self.SYSTEM, *self._encoded()))

    def decoder(self, device: str = "cpu", **options: Any) -> Any:
        """Loads the model onto a device.

        Args:
            device: "cpu", "cuda" or "cuda:N".
            options: As the system's `Decoder` takes them.

        Returns:
            The system's `Decoder`.

        Raises:
            WlmError: No such device.
        """
        room, name = self.DECODER
        return getattr(_room(self.SYSTEM, room), name)(self, device, **options)

    def bundle(self, device: str = "cpu", **options: Any) -> Any:
        """Makes the textures, buffers and shader that a GPU reads.

        Args:
            device: Device that decodes the reference.
            options: Further arguments of the system's `bundle`.

        Returns:
            The `wlm.bundle.Bundle`.

        Raises:
            WlmError: There is no such device, or the model can not be exported.
        """
        return _room(self.SYSTEM, "bundle").bundle(self, device=device, **options)

    def _encoded(self) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
        """Settings, parts and source of the file."""
        return _room(self.SYSTEM, "codec").encode(self)


def load(path: str | os.PathLike[str], system: str | None = None) -> Any:
    """Reads any file that a model was saved to.

    Args:
        path: The file.
        system: The system that must have written it; None: any.

    Returns:
        The system's model.

    Raises:
        WlmError: One line: not such a file, cut short, damaged, of another system or version, or with parts that don't
            fit each other.
    """
    artifact = read_artifact(path, system)
    if artifact.system not in _PACKAGES:
        systems = ", ".join(_PACKAGES)
        raise WlmError(f"{path}: expected a model of {systems}, found a file of {artifact.system}")
    return decode(path, artifact, _room(artifact.system, "codec").decode)


def decode(path: str | os.PathLike[str], artifact: Artifact, make: Callable[[Artifact], Any]) -> Any:
    """Makes an object of an artifact's parts; whatever is wrong with them is one line that names the file.

    Args:
        path: The file, for messages.
        artifact: Its content.
        make: A codec's `decode`, which raises WlmError, ValueError, TypeError, LookupError or AttributeError on parts
            that don't fit.
    """
    try:
        return make(artifact)
    except WlmError as error:
        raise WlmError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise WlmError(f"{path}: the file's parts do not fit its settings: {error}") from error


def _room(system: str, name: str) -> Any:
    """One module of a system's package."""
    return import_module(f"{_PACKAGES[system]}.{name}")
