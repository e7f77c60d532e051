"""Code that the lightmap, atlas, probe and smoke systems share: settings, progress, reports, save and load of models.

The mathematics is not shared. Each system, a package of `wlm`, has these modules:

    data.py        the checked input               `load`, `from_arrays`
    model.py       settings and arrays             `Profile`, the model
    fit.py         training                        `compress` (smoke: `train`)
    codec.py       model to file parts and back    `encode`, `decode`
    decode.py      the runtime path                `Decoder`
    evaluation.py  scores                          `evaluate`
    bundle.py      textures, buffers and shader    `bundle`
"""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict

from wlm.config import check_settings, load_settings, profile_path
from wlm.errors import WlmError
from wlm.formats.artifact import Artifact, Content, encode_artifact, read_artifact, write_artifact

if TYPE_CHECKING:
    from wlm.bundle import Bundle

# The package that reads the files of each system.
_PACKAGES = {"lightmap": "wlm.lightmap", "atlas": "wlm.atlas", "probe": "wlm.probe", "smoke-network": "wlm.smoke"}
_REPORT_EVERY = 0.5  # seconds between two reports of progress


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


Name = Annotated[str, AfterValidator(_printable)]
"""A name from a file, in which spaces replace the control characters that a terminal would obey."""


class Checked(BaseModel):
    """Base of classes of settings: unknown keys, NaN and infinity are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class Settings(Checked):
    """Settings of the compression, which can be loaded by name: the base of each system's `Profile`.

    The docstring under a field becomes its description, from which the command line makes an option's help.

    Attributes:
        FILES: First part of the names of the profile files, `configs/FILES-NAME.yaml`.
    """

    FILES: ClassVar[str]

    name: Name
    """Name of the profile, shown in reports."""

    @classmethod
    def load(cls, profile: str | os.PathLike[str] | Self) -> Self:
        """Loads a profile by its name (NAME in `configs/FILES-NAME.yaml`; `FILES` is the class's) or the path of a YAML
        file; an instance is returned unchanged."""
        if isinstance(profile, cls):
            return profile
        path = os.fspath(profile)
        return load_settings(cls, path if path.endswith((".yaml", ".yml")) else profile_path(cls.FILES, path))

    def override(self, values: Mapping[str, Any], prefix: str = "") -> Self:
        """Returns the settings with new values by name; None leaves a setting as it is. `prefix` is the text before the
        setting's name in an error; `"--"` writes the name as an option."""
        changes = {name: value for name, value in values.items() if value is not None}
        return check_settings(type(self), self.model_dump() | changes, prefix) if changes else self

    def changes(self) -> dict[str, Any]:
        """Returns the settings that differ from the defaults, as plain values for a file's header."""
        defaults = type(self)(name="").model_dump()
        return {name: value for name, value in self.model_dump().items() if value != defaults[name]}


@dataclass(frozen=True)
class Progress:
    """How far a long computation has come, `seconds` after it began. `stage` names the current stage in a word or two,
    such as "fit" or "cluster"; `done` and `total` are its finished steps and all its steps, 0 if unknown. `figures` are
    values measured so far by name and unit, such as `{"PSNR dB": 41.2}`; NaN is unknown."""

    stage: str
    done: int
    total: int
    seconds: float
    figures: Mapping[str, float] = field(default_factory=dict)


OnProgress = Callable[[Progress], None]
"""A callback of long work. It may raise KeyboardInterrupt: the work then writes its checkpoint, if it has one, and
stops between two steps."""


class Meter:
    """Reports progress about twice a second. `stage` names the stage, `seconds` is the time since the work began."""

    def __init__(self, progress: OnProgress | None, stage: str, total: int, every: float = _REPORT_EVERY) -> None:
        """Starts the clock; `every` is the number of seconds between two reports, and without a callback there are
        none."""
        self._progress, self.stage, self._total, self._every = progress, stage, total, every
        self._start = self._last = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._start

    def due(self, done: int) -> bool:
        """Returns whether it is time for a report, for callers that must compute its values first."""
        if self._progress is None:
            return False
        return done >= self._total > 0 or time.perf_counter() - self._last >= self._every

    def report(self, done: int, **figures: float) -> None:
        """Reports now, with measured values. An underscore in a name stands for a space: `PSNR_dB=41.2`."""
        if self._progress is None:
            return
        self._last = time.perf_counter()
        named = {name.replace("_", " "): value for name, value in figures.items()}
        self._progress(Progress(self.stage, done, self._total, self.seconds, named))


class Report:
    """Base class of the systems' reports, for example of compression errors; a report is a frozen dataclass."""

    def to_json(self) -> dict[str, Any]:
        """Returns the attributes as JSON values by name; NaN and infinity become None."""
        return plain({item.name: getattr(self, item.name) for item in dataclasses.fields(self)})


def plain(value: Any) -> Any:
    """Converts NumPy values, tuples and dataclasses to JSON values; NaN and infinity become None."""
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


class Header(Checked):
    """Base of the classes that describe and check the settings in a model file's header. Types are strict: a text is
    never read as a number, nor a float as a count. NaN and infinity are refused."""

    model_config = ConfigDict(strict=True)


class Model:
    """Base of a system's model, which holds the content of a model file.

    The methods call the system's modules `codec`, `decode` and `bundle`. These import the system's `model`, so a method
    imports them only when it is called.

    Attributes:
        SYSTEM: The system's name in files.
        DECODER: Module and class of the decoder in the system's package.
    """

    SYSTEM: ClassVar[str]
    DECODER: ClassVar[tuple[str, str]] = ("decode", "Decoder")

    def save(self, path: str | os.PathLike[str]) -> int:
        """Writes the model to one file, whole or not at all. Returns the file's size in bytes."""
        try:
            settings, parts, source = self._encoded()
        except WlmError as error:
            raise WlmError(f"{path}: {error}") from error
        make = _module(self.SYSTEM, "codec").decode
        content = Artifact.of_parts(self.SYSTEM, settings, parts, source)
        decode(f"{path}: not written", content, lambda content: make(content).check())
        return write_artifact(path, self.SYSTEM, settings, parts, source)

    def file_bytes(self) -> int:
        """Returns the size of the file that `save` writes, bytes."""
        return sum(memoryview(part).nbytes for part in encode_artifact(self.SYSTEM, *self._encoded()))

    def decoder(self, device: str = "cpu", **options: Any) -> Any:
        """Loads the model onto a device and returns the system's `Decoder`, which takes the options."""
        module, name = self.DECODER
        return getattr(_module(self.SYSTEM, module), name)(self, device, **options)

    def bundle(self, device: str = "cpu", **options: Any) -> "Bundle":
        """Converts the model to textures, buffers and shader source for a GPU; the device computes the reference
        values. `options` are passed to the function `bundle` of the system."""
        return _module(self.SYSTEM, "bundle").bundle(self, device=device, **options)

    def check(self) -> None:
        """Reads and checks what `wlm.load` has left in the file, which only lightmaps do."""
        return

    def _encoded(self) -> tuple[dict[str, Any], dict[str, Content], str]:
        return _module(self.SYSTEM, "codec").encode(self)


def load(path: str | os.PathLike[str], system: str | None = None) -> Any:
    """Reads a model of any system from a file; with `system`, a model of another system is an error.

    Of a lightmap only the index is read: the maps, networks and frames of a tile are read when they are first used, and
    checked then (`wlm.lightmap.LightmapModel`). The models of other systems are read and checked whole.

    Raises:
        WlmError: One line: the file is no model, is cut short or damaged, is of another system or version, or has
            parts that do not fit each other.
    """
    artifact = read_artifact(path, system)
    _package(path, artifact)
    return decode(path, artifact, _module(artifact.system, "codec").decode)


def decode(path: str | os.PathLike[str], artifact: Artifact, make: Callable[[Artifact], Any]) -> Any:
    """Makes an object from an artifact's parts by a codec's `decode`, and turns any of its errors (WlmError,
    ValueError, TypeError, LookupError or AttributeError) into one line that names the file."""
    try:
        return make(artifact)
    except WlmError as error:
        raise WlmError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise WlmError(f"{path}: the file's parts do not fit its settings: {error}") from error


def system_of(path: str | os.PathLike[str]) -> str:
    """Returns the name of the system that wrote a file, which is the name of its package in `wlm`."""
    return _package(path, read_artifact(path)).split(".")[1]


def _package(path: str | os.PathLike[str], artifact: Artifact) -> str:
    if artifact.system not in _PACKAGES:
        raise WlmError(f"{path}: expected a model of {', '.join(_PACKAGES)}, found a file of {artifact.system}")
    return _PACKAGES[artifact.system]


def _module(system: str, name: str) -> Any:
    return import_module(f"{_PACKAGES[system]}.{name}")
