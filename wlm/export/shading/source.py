"""Lexer and preprocessor of our GLSL; `wlm.export.shading.tree` parses the tokens."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

_WORD = re.compile(
    r"(?P<comment>//[^\n]*)|(?P<number>(\d+\.\d*|\.\d+)([eE][-+]?\d+)?|\d+[eE][-+]?\d+|\d+u?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>\+\+|--|<<|>>|<=|>=|==|!=|&&|\|\||[-+*/%&|^]=|[-+*/%&|^<>=!~?:;,.(){}\[\]])"
)


@dataclass(frozen=True)
class Word:
    """A token of a shader: a `comment`, `number`, `name` or `mark` (an operator or bracket) with its text as written;
    whether it is the first on its line, and whether a blank line precedes it."""

    kind: str
    text: str
    alone: bool = False
    blank: bool = False


@dataclass(frozen=True)
class _Macro:
    parameters: tuple[str, ...] | None
    body: tuple[Word, ...]


def read_words(text: str, defined: Iterable[str] = ()) -> list[Word]:
    """Splits GLSL into tokens, expands macros and evaluates conditional directives; macros in `defined` are set to 1.
    Raises a ValueError for an unsupported directive, or a character that is not part of GLSL."""
    macros = {name: _Macro(None, (Word("number", "1"),)) for name in defined}
    words: list[Word] = []
    kept = [True]
    blank = False
    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith("#"):
            _direct(stripped[1:].strip(), macros, kept)
        elif not stripped:
            blank = True
        elif all(kept):
            words += _expand(list(_split(line, blank)), macros)
            blank = False
    return words


def _direct(directive: str, macros: dict[str, _Macro], kept: list[bool]) -> None:
    name, _, rest = directive.partition(" ")
    rest = rest.strip()
    if name in ("ifdef", "ifndef"):
        kept.append((rest in macros) == (name == "ifdef"))
    elif name == "else":
        kept[-1] = not kept[-1]
    elif name == "endif":
        kept.pop()
    elif name == "define":
        if not all(kept):
            return
        match = re.match(r"(\w+)(\(([\w, ]*)\))?\s*(.*)", rest)
        assert match is not None
        parameters = None if match[2] is None else tuple(part.strip() for part in match[3].split(","))
        macros[match[1]] = _Macro(parameters, tuple(_split(match[4], False)))
    else:
        raise ValueError(f"directive: expected ifdef, ifndef, else, endif or define, got {name!r}")


def _split(line: str, blank: bool) -> Iterator[Word]:
    at, first = 0, True
    while at < len(line):
        if line[at].isspace():
            at += 1
            continue
        match = _WORD.match(line, at)
        if match is None:
            raise ValueError(f"GLSL: expected a token, got {line[at:]!r}")
        kind = next(name for name in ("comment", "number", "name", "mark") if match[name] is not None)
        yield Word(kind, match[0], first, first and blank)
        at, first = match.end(), False


def _expand(words: Sequence[Word], macros: dict[str, _Macro]) -> list[Word]:
    """Expands the macros in the tokens of one line; a macro's arguments must end on that line."""
    out: list[Word] = []
    i = 0
    while i < len(words):
        word = words[i]
        i += 1
        macro = macros.get(word.text) if word.kind == "name" else None
        if macro is None:
            out.append(word)
            continue
        if macro.parameters is None:
            out += _expand(macro.body, {name: each for name, each in macros.items() if name != word.text})
            continue
        depth, start, arguments = 1, i + 1, []
        i = start
        while depth:
            text = words[i].text
            if depth == 1 and text in (",", ")"):
                arguments.append(_expand(words[start:i], macros))
                start = i + 1
            depth += (text == "(") - (text == ")")
            i += 1
        given = dict(zip(macro.parameters, arguments, strict=True))
        body = [each for one in macro.body for each in (given.get(one.text, [one]) if one.kind == "name" else [one])]
        out += _expand(body, {name: each for name, each in macros.items() if name != word.text})
    return out
