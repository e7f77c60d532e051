"""Checks that every import points to a lower layer and that modules form no import cycle."""

import ast
import functools
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BASE = (
    "wlm_kernels wlm wlm._facade wlm.bundle wlm.dispatch wlm.errors wlm.formats wlm.metrics wlm.config wlm.interop "
    "wlm.texels wlm.system wlm.workers"
)
LAYERS = (
    BASE.split(),
    ["wlm.ops"],
    ["wlm.fluid"],
    ["wlm.lightmap", "wlm.atlas", "wlm.probe", "wlm.smoke"],
    ["wlm.bake"],
    ["wlm.scene"],
    ["wlm.inspection"],
    ["wlm.export", "wlm.view"],
    ["wlm.cli"],
    ["wlm.__main__"],
    ["benchmarks"],
)
LAYER_OF = {package: layer for layer, packages in enumerate(LAYERS) for package in packages}


def package_of(module: str) -> str:
    """Returns `wlm.probe` for `wlm.probe.fit`; `wlm_kernels` and `benchmarks` are one package each."""
    root = module.split(".", maxsplit=1)[0]
    return root if root != "wlm" else ".".join(module.split(".")[:2])


@functools.cache
def imports() -> dict[str, set[str]]:
    """Returns the project modules that each module imports anywhere, including in functions and for type checking."""
    files = [path for folder in ("wlm", "wlm_kernels", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}
    graph = {}
    for name, path in names.items():
        targets = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                targets |= {
                    full if (full := f"{node.module}.{alias.name}") in names else node.module for alias in node.names
                }
        graph[name] = {target for target in targets if target in names} - {name}
    return graph


def test_imports_point_down():
    wrong = []
    for module, targets in imports().items():
        here = package_of(module)
        for target in targets:
            there = package_of(target)
            # Packages of one layer don't import each other, except those of the lowest layer.
            highest = LAYER_OF[here] - 1 if LAYER_OF[here] else 0
            if here != there and (LAYER_OF[there] > highest or here == "wlm_kernels"):
                wrong.append(f"{module} imports {target}")
    assert not wrong


def test_no_cycles():
    tuple(TopologicalSorter(imports()).static_order())
