"""Reads YAML files into checked settings and finds profiles by name."""

import difflib
import os
import reprlib
from collections.abc import Iterator
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from wlm.errors import WlmError, one_line
from wlm.formats.limits import INTEGER, SETTINGS_BYTES
from wlm.formats.reading import read_file

_Settings = TypeVar("_Settings", bound=BaseModel)

_SHOWN_VALUE = 60  # characters of a wrong value that an error message repeats
_DEEPEST = 50
_MERGE = "tag:yaml.org,2002:merge"
_NOT_YAML = (yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
_INTEGER_LENGTH = 80  # characters: 64 binary digits with signs between them


def load_settings(cls: type[_Settings], path: str | os.PathLike[str]) -> _Settings:
    """Reads a YAML file, one mapping, into a settings model and checks it, see `check_settings`."""
    return check_settings(cls, read_yaml(path), f"{path}: ", folder=Path(path).parent)


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """Reads a YAML file that is one mapping."""
    try:
        text = read_file(path, SETTINGS_BYTES, "the settings").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise WlmError(f"{path}: expected YAML in UTF-8, found an invalid byte at position {error.start}") from error
    try:
        values = yaml.load(text, _Loader)
    except _NOT_YAML as error:
        raise WlmError(f"{path}: expected YAML: {_yaml_problem(error)}") from error
    if values is None:
        raise WlmError(f"{path}: expected a mapping of settings, found an empty file")
    if not isinstance(values, dict):
        raise WlmError(f"{path}: expected a mapping of settings, found {_shown(values)}")
    return values


def check_settings(
    cls: type[_Settings],
    values: Any,
    prefix: str = "",
    extra: Literal["forbid", "ignore"] = "forbid",
    folder: str | os.PathLike[str] = "",
) -> _Settings:
    """Checks a mapping of plain values as a settings model, whatever its own configuration says about unknown keys:
    errors, or ignored with `extra`.

    `prefix` is the text before the field's name in an error, such as `"scene.yaml: "` or `"file: profile."`; `"--"`
    writes the field as a command line option, with dashes. Validators find `folder`, to which paths of files are
    relative, in their context.
    """
    try:
        return cls.model_validate(values, extra=extra, context={"folder": folder})
    except ValidationError as error:
        raise WlmError(f"{prefix}{_first_problem(cls, error, as_option=prefix == '--')}") from error


def profile_path(system: str, name: str) -> Path:
    """Finds the profile `configs/<system>-<name>.yaml`, in a checkout or in the installed package."""
    file_name = f"{system}-{name}.yaml"
    for folder in profile_folders():
        # The name is compared with the listing and not joined to a path, so that `../x` cannot leave the folder.
        for candidate in folder.glob("*.yaml"):
            if candidate.name == file_name:
                return candidate
    names = ", ".join(profile_names(system)) or "none"
    raise WlmError(f"profile '{name}' of {system}: expected one of the known profiles: {names}")


def profile_names(system: str) -> list[str]:
    """Returns the sorted names of a system's profiles; `system` is the first part of the names of their files."""
    prefix = f"{system}-"
    files = {file.stem for folder in profile_folders() for file in folder.glob(f"{prefix}*.yaml")}
    return sorted(stem.removeprefix(prefix) for stem in files)


def profile_folders() -> Iterator[Path]:
    """Finds the folders of the shipped profiles: of a checkout, and of the installed package."""
    root = Path(__file__).resolve().parents[1]
    # An installed package is in site-packages; only a checkout has a pyproject.toml beside the package.
    if (root / "pyproject.toml").is_file() and (root / "configs").is_dir():
        yield root / "configs"
    with suppress(ModuleNotFoundError):
        installed = resources.files("wlm.configs")
        for folder in getattr(installed, "_paths", [installed]):
            yield Path(str(folder))


class _Loader(yaml.SafeLoader):
    """A safe loader that rejects YAML features which settings do not need and an attacker could misuse. It rejects
    repeated keys, for which YAML would silently use the last value; anchors, aliases and merge keys, with which a few
    lines can expand to billions of values; integers beyond 64 bits; and unlimited nesting."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if self._depth > _DEEPEST:
            raise _refused(f"expected values at most {_DEEPEST} deep in others", event.start_mark)
        if getattr(event, "anchor", None) is not None:
            raise _refused(f"expected a value, found the anchor or alias '{event.anchor}'", event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        # The length is checked first, because the value of a million digits takes long to compute.
        value = super().construct_yaml_int(node) if len(node.value) <= _INTEGER_LENGTH else INTEGER
        if not -INTEGER < value < INTEGER:
            raise _refused("expected an integer within 64 bits, found a larger one", node.start_mark)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key, _ in node.value:
            if key.tag == _MERGE:
                raise _refused("expected keys of settings, found '<<'", key.start_mark)
            if isinstance(key, yaml.ScalarNode):
                if key.value in keys:
                    raise _refused(f"the key '{key.value}' is given twice", key.start_mark)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def _refused(problem: str, mark: yaml.Mark) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def _yaml_problem(error: Exception) -> str:
    problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
    if problem is None:
        return one_line(error)
    return problem if mark is None else f"{problem} (line {mark.line + 1}, column {mark.column + 1})"


def _first_problem(cls: type[BaseModel], error: ValidationError, as_option: bool) -> str:
    problem, *others = error.errors(include_url=False)
    message = problem["msg"].removeprefix("Value error, ")
    field = ".".join(str(part) for part in problem["loc"]) or "settings"
    if as_option:
        field = field.replace(".", "-").replace("_", "-")
    if problem["type"] == "extra_forbidden":
        text = f"unknown key '{field}'{_suggestion(cls, problem['loc'])}"
    elif problem["type"] == "missing":
        text = f"{field}: expected a value, found none"
    elif problem["type"] in ("too_short", "too_long"):
        least = "at least {min_length}" if problem["type"] == "too_short" else "at most {max_length}"
        text = f"{field}: expected {least} entries, found {{actual_length}}".format(**problem["ctx"])
    elif problem["type"] in ("model_type", "dict_type"):
        text = f"{field}: expected a mapping, got {_shown(problem['input'])}"
    elif isinstance(problem["input"], dict) and "Input" not in problem["msg"]:
        # A check of several fields together: its message, or else its type, names one of them.
        name = [] if ": " in message or problem["type"] == "value_error" else [problem["type"]]
        text = ": ".join(filter(None, [".".join([*map(str, problem["loc"]), *name]), message]))
        text = text.replace("_", "-") if as_option else text
    else:
        text = f"{field}: {message.replace('Input should be', 'expected', 1)}, got {_shown(problem['input'])}"
    return f"{text} (and {len(others)} more)" if others else text


def _suggestion(cls: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Returns the end of a message about an unknown key: the most similar known key, or else all; "" if unknown."""
    model: Any = cls
    for part in location[:-1]:
        field = model.model_fields.get(part)
        model = None if field is None else field.annotation
        # The keys of a union, a list or a dict of models are not known here.
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return ""
    fields = [field.alias or name for name, field in model.model_fields.items()]
    close = difflib.get_close_matches(str(location[-1]), fields, n=1)
    return f"; did you mean '{close[0]}'?" if close else f"; expected one of: {', '.join(fields)}"


def _shown(value: object) -> str:
    return one_line(_Short().repr(value), _SHOWN_VALUE)


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 16
        self.maxstring = self.maxother = 2 * _SHOWN_VALUE

    def repr_int(self, value: int, level: int) -> str:
        # Python refuses to write integers of thousands of digits.
        return repr(value) if abs(value) < 10**_SHOWN_VALUE else "a huge integer"
