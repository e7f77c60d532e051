"""Command line options that are generated from the fields of a settings model.

A command states its model as `@with_settings("wlm.lightmap:Profile")`. Its function then receives the options that
were given as the mapping `settings`, ready for `Settings.override(settings, "--")`, which checks them: the types,
the ranges and the help texts are those of the model alone.
"""

import functools
import inspect
import re
import types
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import typer
from typer.core import TyperCommand
from typer.main import get_command

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

_PANEL = "Settings; default: as the profile says"
_SENTENCE_END = re.compile(r"(?<=\.)(?<!eq\.)\s+(?=[A-Z\"`])")
_LIMITS = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}", "multiple_of": "multiple of {}"}


class _Field(NamedTuple):
    """A field of a settings model or of a model inside it, by the names of the fields that lead to it."""

    path: tuple[str, ...]
    info: "FieldInfo"

    @property
    def parameter(self) -> str:
        return "__".join(("set", *self.path))


def with_settings(place: str, into: str = "settings") -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Marks a command as having an option for each field of a settings model.

    `place` names the model as `module:name`, which is imported when `command_of` builds the command. The parameter
    `into` of the command receives the given options, nested as the model is.
    """

    def mark(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command)
        own = [parameter for name, parameter in signature.parameters.items() if name != into]
        command.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]
        command.settings_model = (place, into, command)  # type: ignore[attr-defined]
        return command

    return mark


def command_of(name: str, function: Callable[..., None]) -> Any:
    """Builds the command of a function, with the options of its settings if `with_settings` has marked it."""
    if hasattr(function, "settings_model"):
        place, into, function = function.settings_model
        module, _, model = place.partition(":")
        function = _expanded(function, list(_fields(getattr(import_module(module), model))), into)
    app = typer.Typer(add_completion=False)
    app.command(name)(function)
    return get_command(app)


class Generated(TyperCommand):
    """A command that adds its generated options only when it is called, since this imports the settings model."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        return command_of(str(self.name), self.callback).make_context(info_name, args, parent, **extra)


def _expanded(command: Callable[..., None], settings: "list[_Field]", into: str) -> Callable[..., None]:
    """Returns the command with an option for each settings field in its signature, which typer reads."""

    @functools.wraps(command)
    def run(**values: Any) -> None:
        given = {field.path: values.pop(field.parameter) for field in settings}
        command(**values, **{into: _nested({path: value for path, value in given.items() if value is not None})})

    own = list(inspect.signature(command).parameters.values())
    generated = [_parameter(field) for field in settings]
    # typer reads both.
    run.__signature__ = inspect.Signature([*own, *generated])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *generated)}
    return run


def _fields(model: "type[BaseModel]", path: tuple[str, ...] = ()) -> Iterator[_Field]:
    for name, info in model.model_fields.items():
        inner = _bare(info.annotation)
        if hasattr(inner, "model_fields"):
            yield from _fields(inner, (*path, name))
        elif (*path, name) != ("name",):
            yield _Field((*path, name), info)


def _bare(annotation: Any) -> Any:
    """Returns a type annotation without `Annotated` and without `None`."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _bare(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        options = [each for each in get_args(annotation) if each is not type(None)]
        return _bare(options[0]) if len(options) == 1 else annotation
    return annotation


def _parameter(field: _Field) -> inspect.Parameter:
    option, kind = "--" + "-".join(field.path).replace("_", "-"), _bare(field.info.annotation)
    words = {"help": _help(field.info), "rich_help_panel": _PANEL, "show_default": False}
    if kind is bool:
        annotation = Annotated[bool | None, typer.Option(f"{option}/--no-{option[2:]}", **words)]
    elif get_origin(kind) is tuple:
        annotation = Annotated[str | None, typer.Option(option, metavar="N,N", callback=_numbers, **words)]
    else:
        # A choice of numbers is compared with numbers, not with text.
        form: Any = int if get_origin(kind) is Literal and isinstance(get_args(kind)[0], int) else str
        annotation = Annotated[form | None, typer.Option(option, metavar=_metavar(kind), **words)]
    return inspect.Parameter(field.parameter, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _metavar(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    return {int: "INTEGER", float: "NUMBER"}.get(kind, "TEXT")


def _help(info: "FieldInfo") -> str:
    """Returns the help text of a field: the first sentence of its docstring, and the range of its values."""
    text = " ".join((info.description or "").split())
    sentence = _SENTENCE_END.split(text)[0].rstrip(".;:") if text else ""
    limits = [
        form.format(f"{getattr(limit, name):g}")
        for limit in info.metadata
        for name, form in _LIMITS.items()
        if getattr(limit, name, None) is not None
    ]
    return f"{sentence} ({', '.join(limits)})." if limits else f"{sentence}."


def _numbers(text: str | None) -> Any:
    return None if text is None else text.split(",")


def _nested(values: dict[tuple[str, ...], Any]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for path, value in values.items():
        place = result
        for name in path[:-1]:
            place = place.setdefault(name, {})
        place[path[-1]] = value
    return result
