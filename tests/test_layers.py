"""The arrows of the house: every import points down a floor, and no two modules import each other."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GROUND = (
    "wlm_kernels wlm wlm._facade wlm.bundle wlm.errors wlm.formats wlm.metrics wlm.config wlm.interop wlm.texels "
    "wlm.system wlm.workers"
)
FLOORS = (
    GROUND.split(),
    ["wlm.ops", "wlm.fluid"],
    ["wlm.lightmap", "wlm.atlas", "wlm.probe", "wlm.smoke"],
    ["wlm.inspection"],
    ["wlm.bake", "wlm.export", "wlm.view"],
    ["wlm.cli"],
    ["wlm.__main__"],
    ["benchmarks"],
)
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


def room_of(module: str) -> str:
    """`wlm.probe` of `wlm.probe.fit`; the kernels and the benchmarks are one room each."""
    root = module.split(".", maxsplit=1)[0]
    return root if root != "wlm" else ".".join(module.split(".")[:2])


def imports() -> dict[str, set[str]]:
    """For each module the modules of ours that it imports anywhere, also in functions and for types alone."""
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
        here = room_of(module)
        for target in targets:
            there = room_of(target)
            # Rooms of one floor never meet, but for those of the ground.
            highest = FLOOR_OF[here] - 1 if FLOOR_OF[here] else 0
            if here != there and (FLOOR_OF[there] > highest or here == "wlm_kernels"):
                wrong.append(f"{module} imports {target}")
    assert not wrong


def test_no_circles():
    tuple(TopologicalSorter(imports()).static_order())
