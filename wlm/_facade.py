"""Packages whose public names are imported when they are first used (PEP 562), and their stubs for type checkers.

Type checkers read the stub `__init__.pyi` beside each `__init__.py`. `python -m wlm._facade`, run in a checkout, writes
the stubs anew.
"""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any


def facade(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Returns a `__getattr__` and a `__dir__` for a package that import its public names at first use.

    `places` names for each public name the module that defines it, or for a subpackage its own full name. A public name
    must not be the name of a submodule, because importing the submodule would replace it.
    """

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(places[name])
        value = module if places[name] == f"{package}.{name}" else getattr(module, name)
        # Later accesses find the name without this function.
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *places})


def stub(package: str, places: Mapping[str, str]) -> str:
    """Returns the text of a package's stub file.

    Args:
        package, places: Arguments of `facade`.
    """
    modules = {
        name: place.removesuffix(f".{name}") if place == f"{package}.{name}" else place
        for name, place in places.items()
    }
    names = sorted(places, key=lambda name: (modules[name], name))
    lines = [f"from {modules[name]} import {name} as {name}" for name in names]
    version = ["", "__version__: str"] if package == "wlm" else []
    return "\n".join(["# Written by python -m wlm._facade from `_PLACES` of the package.", *lines, *version, ""])


def packages(root: Path) -> dict[Path, str]:
    """Returns the stub text of each package that uses `facade`, by the path of the stub file.

    Args:
        root: The folder of the package `wlm`.
    """
    found = {}
    for path in sorted(root.rglob("__init__.py")):
        if "facade(__name__" in path.read_text(encoding="utf-8"):
            name = ".".join(path.relative_to(root.parent).parent.parts)
            found[path.with_suffix(".pyi")] = stub(name, import_module(name)._PLACES)
    return found


if __name__ == "__main__":
    for path, text in packages(Path(__file__).parent).items():
        path.write_text(text, encoding="utf-8")
