"""Commands that work on files of every system: `wlm compress`, `evaluate`, `decode`, `export` and `info`.

Such a command is called a verb here. The kind of file of its first argument chooses the system, and the function of
the verb's name in `wlm.cli.<system>` does the work. Each of these functions has its own options; a module without the
function may name another command in its mapping `INSTEAD`.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from wlm.errors import WlmError

SYSTEMS = ("lightmap", "atlas", "probe", "smoke")  # as in wlm.system, which takes long to import
VERBS = ("compress", "evaluate", "decode", "export", "info")


def _model_system(path: Path) -> str:
    from wlm.system import system_of

    return system_of(path)


Detect = Callable[[Path], str]


class Verb(TyperCommand):
    """A command whose options depend on the system (lightmap, atlas, probe or smoke) of its first argument."""

    detect: Detect = staticmethod(_model_system)

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        words, system = _without_system(args)
        if system is None:
            first = first_argument(words, _options(str(self.name)))
            system = None if first is None else self.detect(Path(first))
        if system is None:
            return super().make_context(info_name, args, parent, **extra)
        return variant(str(self.name), system).make_context(info_name, words, parent, **extra)


def register(
    app: typer.Typer,
    name: str,
    help_text: str,
    metavar: str = "FILE.wlm",
    argument_help: str = "A compressed file.",
    detect: Detect = _model_system,
) -> None:
    """Adds a verb to the command line.

    `metavar`, `argument_help` and `help_text` are what `--help` shows without a file. `detect` returns the system of a
    file, or raises a WlmError that says what to do if the file has none.
    """

    def general(
        file: Annotated[Path, typer.Argument(metavar=metavar, help=argument_help)],
        system: Annotated[
            str | None,
            typer.Option(
                metavar="|".join(SYSTEMS), help="System that reads the file; default: the one that the file belongs to."
            ),
        ] = None,
    ) -> None:
        """Placeholder that describes the verb in `--help`; a call with a file runs the function for that file."""

    kind = type(f"Verb{name.title()}", (Verb,), {"detect": staticmethod(detect)})
    app.command(name, cls=kind, help=help_text)(general)


def functions(verb: str) -> dict[str, Callable[..., None]]:
    """Returns the functions that do the work of a verb, by name of the system; systems without it are left out."""
    modules = {system: import_module(f"wlm.cli.{system}") for system in SYSTEMS}
    return {system: getattr(module, verb) for system, module in modules.items() if hasattr(module, verb)}


def variant(verb: str, system: str) -> Any:
    """Builds the command that a verb runs for files of a system. Raises a WlmError if the system does not have the
    verb; the line names the alternative."""
    from wlm.cli.settings import command_of

    function = functions(verb).get(system)
    if function is None:
        instead = getattr(import_module(f"wlm.cli.{system}"), "INSTEAD", {}).get(verb, "")
        raise WlmError(f"wlm {verb}: does not apply to files of {system}" + (f"; use {instead}" if instead else ""))
    return command_of(verb, function)


def first_argument(words: Sequence[str], options: Mapping[str, bool]) -> str | None:
    """Returns the first word of a command line that is neither an option nor its value, or None.

    `options` states for each known option whether it takes a value. A word after another option, which is generated
    from a setting, is its value unless it names an existing file or folder.
    """
    value: bool | None = False  # whether the next word is a value; None: unless it names a file
    for word in words:
        if word.startswith("-"):
            value = options.get(word, None if "=" not in word else False)
        elif value is False or (value is None and Path(word).exists()):
            return word
        else:
            value = False
    return None


def _without_system(args: Sequence[str]) -> tuple[list[str], str | None]:
    """Removes `--system NAME` from a command line. Returns the other words, and the name or None."""
    words, system, rest = [], None, iter(args)
    for word in rest:
        if word == "--system" or word.startswith("--system="):
            system = word.partition("=")[2] or next(rest, "")
            if system not in SYSTEMS:
                raise WlmError(f"--system: expected one of {', '.join(SYSTEMS)}, got {system!r}")
        else:
            words.append(word)
    return words, system


def _options(verb: str) -> dict[str, bool]:
    """Returns, for each option of a verb that is not generated from a setting, whether it takes a value."""
    found = {}
    for function in functions(verb).values():
        for name, parameter in inspect.signature(function).parameters.items():
            kind, *notes = get_args(parameter.annotation) or (parameter.annotation,)
            for note in notes:
                if isinstance(note, OptionInfo):
                    found |= dict.fromkeys(note.param_decls or (f"--{name.replace('_', '-')}",), kind is not bool)
    return found
