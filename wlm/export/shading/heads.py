"""Adapts the comment at the head of a GLSL shader to the language that it is translated into."""

import re
from collections.abc import Collection

_GAP = r"\s*(?://\s*)?"
_REST = r"(?:[^.]|\.(?!\s))*\."  # the rest of a sentence, to its full stop
_FOR_GLSL = re.compile(rf"For GLSL [^;]*;{_GAP}include{_GAP}it{_GAP}below{_GAP}#version[^.:]*\.")
_CHOICE = re.compile(rf"(?:Where|If) (WLM_\w+) is defined,?{_GAP}([^;.]*);{_GAP}(?:else|otherwise) ([^.]*)\.")
_IF = re.compile(rf"\s(?://\s*)?If (WLM_\w+)\(\w\) is defined,{_REST}")
# Clauses; the last pattern is a whole sentence.
_MACROS = (
    re.compile(rf",{_GAP}unless (?:[^.]|\.(?!\s))*? before{_GAP}this{_GAP}file(?:[^.]|\.(?!\s))*(?=\.)"),
    re.compile(rf",{_GAP}or{_GAP}define WLM_[^.]*? before{_GAP}this{_GAP}file(?=\.)"),
    re.compile(rf"\s(?://\s*)?For{_GAP}a{_GAP}uniform block, [^.]*? before{_GAP}this{_GAP}file{_REST}"),
)


def decided(text: str, dialect: str, defined: Collection[str]) -> str:
    """Rewrites the head comment for one language, with sentences about macros decided.

    Args:
        text: A GLSL shader of this package.
        dialect: The language's name in prose.
        defined: Names of the macros that are defined.
    """
    text = _FOR_GLSL.sub(f"For {dialect}.", text)
    text = _CHOICE.sub(lambda match: _sentence(match[2] if match[1] in defined else match[3]), text)
    text = _IF.sub(lambda match: match[0] if match[1] in defined else "", text)
    for pattern in _MACROS:
        text = pattern.sub("", text)
    return text


def _sentence(clause: str) -> str:
    return clause[0].upper() + clause[1:] + "."
