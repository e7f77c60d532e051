"""Pages of the site that are made: the API from the packages' public names, and the home page from the README."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from wlm._facade import places

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "wlm",
    "wlm.lightmap",
    "wlm.atlas",
    "wlm.probe",
    "wlm.smoke",
    "wlm.fluid",
    "wlm.ops",
    "wlm.bake",
    "wlm.inspection",
    "wlm.scene",
    "wlm.export",
)
_OUTSIDE = re.compile(
    r"\[([^\]]+)\]\((?:\.\./)*(?:wlm|wlm_kernels|benchmarks|demos|notebooks|tests|configs|LICENSE|README\.md)(?:[/#][^)]*)?\)"
)


def on_files(files: Files, config: Any) -> Files:
    """Adds the home page and a page for each package."""
    from mkdocs.structure.files import File

    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=readme))
    for name in PACKAGES:
        files.append(File.generated(config, f"api/{page_of(name)}", content=api_page(import_module(name))))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to the repository's own files stay as text: the site has the pages alone."""
    return _OUTSIDE.sub(r"\1", markdown)


def page_of(package: str) -> str:
    """The name of a package's page."""
    return f"{package.rpartition('.')[2]}.md"


def api_page(package: ModuleType) -> str:
    """The package's docstring and each public name: where it is defined, or a link to the package that it is of."""
    rooms = [each for each in PACKAGES if each.rpartition(".")[0] == package.__name__]
    lines = [f"# {package.__name__}", "", package.__doc__.strip(), ""]
    lines += [f"- [`{room}`]({page_of(room)}): {import_module(room).__doc__.splitlines()[0]}" for room in rooms]
    lines += [""]
    for name, module in sorted(places(package.__file__).items()):
        public, place = f"{package.__name__}.{name}", _place(getattr(package, name), module, name)
        home = next((each for each in PACKAGES[1:] if place == each or place.startswith(f"{each}.")), "wlm")
        if public in rooms:
            continue
        if home in (package.__name__, "wlm"):
            lines += [f"::: {place}", "    options:", f"      heading: {public}", f"      toc_label: {name}", ""]
        else:
            lines += [f"### {public}", "", f"[`{home}.{place.rpartition('.')[2]}`]({page_of(home)}#{place})", ""]
    return "\n".join(lines)


def _place(value: Any, module: str, name: str) -> str:
    """The full name of a public name's definition."""
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, type) or callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    return f"{module}.{name}"
