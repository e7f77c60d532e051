"""The site of the documents, as far as that needs no mkdocs: its pages are there, and every public name is on one."""

import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

import wlm

ROOT = Path(__file__).resolve().parents[1]
CONFIG = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def script(name: str) -> ModuleType:
    """A module of docs/site, which is no package."""
    spec = spec_from_file_location(f"site_{name}", ROOT / "docs" / "site" / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pages_of(nav) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for part in (nav.values() if isinstance(nav, dict) else nav) for page in pages_of(part)]


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    return script("pages")


def test_the_navigation_has_every_page_and_no_other(pages):
    written = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    made = ["index.md", *(f"api/{pages.page_of(name)}" for name in pages.PACKAGES)]
    assert sorted(pages_of(CONFIG["nav"])) == sorted(written + made)
    assert all((ROOT / hook).is_file() for hook in CONFIG["hooks"])


def test_every_public_name_is_on_its_page(pages):
    packages = {module.parent for module in (ROOT / "wlm").glob("*/__init__.py") if "facade(" in module.read_text()}
    assert set(pages.PACKAGES) == {"wlm", *(f"wlm.{folder.name}" for folder in packages)}
    for name in pages.PACKAGES:
        package = sys.modules[name] if name == "wlm" else getattr(wlm, name.removeprefix("wlm."))
        page = pages.api_page(package)
        for public in package.__all__:
            full = f"{name}.{public}"
            assert public == "__version__" or re.search(rf"(heading: |### |\[`){re.escape(full)}(`\]|$)", page, re.M), (
                full
            )
        for place in re.findall(r"^::: (.*)$", page, re.M):
            assert place.startswith(("wlm.", "wlm_kernels."))


def test_a_name_of_another_package_is_a_link_to_its_page(pages):
    page = pages.api_page(wlm.smoke)
    assert "[`wlm.fluid.load_volume`](fluid.md#wlm.fluid.volume.load_volume)" in page
    assert "::: wlm.fluid" not in page and "::: wlm.fluid.volume.load_volume" in pages.api_page(wlm.fluid)


def test_links_out_of_the_documents_become_text(pages):
    text = "[a](../demos/x.md#b) [b](LICENSE) [c](lightmap.md) [d](results/atlas.md) [e](../../wlm/export/page/assets)"
    assert pages.on_page_markdown(text) == "a b [c](lightmap.md) [d](results/atlas.md) e"


def test_each_name_has_an_entry_of_its_own(monkeypatch):
    monkeypatch.setitem(sys.modules, "griffe", SimpleNamespace(Extension=object))
    text = "Draws.\n\n    a, b: it.\n\nArgs:\n    {}    name: Of it:\n        a, b: or more.\n\nRaises:\n    A, B: It."
    thing = SimpleNamespace(docstring=SimpleNamespace(value=text.format("h, w: Texels\n        or pixels.\n")))
    entries = script("docstrings").Entries()
    entries.on_object(obj=thing)
    assert thing.docstring.value == text.format("h: Texels or pixels.\n    w: Texels or pixels.\n")
    entries.on_object(obj=SimpleNamespace(docstring=None))
