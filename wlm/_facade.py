"""Packages whose public names are imported when they are first used (PEP 562).

The stub `__init__.pyi` beside each `__init__.py` lists the names, a line each, for type checkers and for `facade`.
"""

import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

_LINE = re.compile(r"^from ([\w.]+) import (\w+) as \2$", re.MULTILINE)


def places(file: str) -> dict[str, str]:
    """Returns the public names of a package, given its `__init__.py`, and the module that each is imported from."""
    text = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: module for module, name in _LINE.findall(text)}


def facade(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Returns a `__getattr__`, a `__dir__` and an `__all__` for a package that imports its public names at first use.

    A public name is that of a subpackage, imported from the package itself, or not the name of a submodule, because
    importing the submodule would replace it.
    """
    known = places(file)

    def get(name: str) -> Any:
        if name not in known:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        own = known[name] == package
        value = import_module(f"{package}.{name}") if own else getattr(import_module(known[name]), name)
        # Later accesses find the name without this function.
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *known}), sorted(known)
