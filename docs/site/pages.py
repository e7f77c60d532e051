"""Pages of the site that are made: the API from the packages' public names, and the home page from the README."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import wlm.atlas
import wlm.fluid
import wlm.lightmap
import wlm.ops
import wlm.probe
import wlm.smoke
import wlm.web

ROOT = Path(__file__).resolve().parents[2]
OTHERS = "wlm|benchmarks|demos|tests|configs|LICENSE|README"
PACKAGES = (wlm.lightmap, wlm.atlas, wlm.probe, wlm.smoke, wlm.fluid, wlm.ops, wlm.web)


def on_files(files: Files, config: Any) -> Files:
    """Adds the home page and a page for each package."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=readme))
    for package in PACKAGES:
        name = package.__name__.rpartition(".")[2]
        files.append(File.generated(config, f"api/{name}.md", content=api_page(package)))
    return files


def api_page(package: Any) -> str:
    """The package's docstring and each public name, where it is defined."""
    lines = [f"# {package.__name__}", "", package.__doc__.strip(), ""]
    for name in package.__all__:
        value = getattr(package, name)
        place = getattr(value, "__module__", None)
        # Constants have no place of their own; subpackages have docstrings.
        if place is not None and place.startswith("wlm"):
            lines += [f"::: {place}.{value.__qualname__}", ""]
    return "\n".join(lines)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to the repository's own files stay as text: the site has the pages alone."""
    return re.sub(rf"\[([^\]]+)\]\((?:\.\./)+(?:{OTHERS})[^)]*\)", r"\1", markdown)
