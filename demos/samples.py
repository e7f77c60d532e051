"""Writes the light of the sample projects in `samples`, which engines open, from the demos' data.

    python -m demos.samples              # all of them, after a change of the kits or of the data

`samples/room.wlm` are the room's lightmaps, compressed by `wlm compress demos/data/cornell`; probes are compressed
here. The rest of the projects is written by hand.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np

import wlm
from wlm.cli.console import quiet_warp
from wlm.errors import WlmError
from wlm.export import export
from wlm.formats.gltf import read_gltf
from wlm.smoke.bundle import bundle
from wlm.smoke.flipbook.book import Shot, pack_book
from wlm.texels import to_srgb

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parent / "samples"
CORNELL, SMOKE = HERE / "data" / "cornell", HERE / "data" / "street" / "smoke"
ROOM = SAMPLES / "room.wlm"
# By engine: the folders of its project for lightmaps and smoke, and the file of the mesh.
PLACES = {
    "three": ("threejs/light", "threejs/smoke", "threejs/room.glb"),
    "godot": ("godot/light", "godot/smoke", "godot/room.glb"),
    "unity": ("unity/Assets/Light", "unity/Assets/Smoke", "unity/Assets/room.obj"),
    "unreal": ("unreal/Light", "unreal/Smoke", "unreal/room.glb"),
}
HOURS = (6, 8, 12, 17, 20)  # of the probes
CELLS = 6
EVERY, RATE = 2, 6.0  # of the 24 frames of smoke, and frames a second


def write(out: Path) -> None:
    """Writes the light of all projects into their folders below `out`."""
    room = wlm.load(ROOM)
    files = sorted(SMOKE.glob("*.exr"))[::EVERY]
    frames = [Shot(number, wlm.smoke.read_six_way(path)) for number, path in enumerate(files)]
    book = bundle(pack_book(frames, padding=1, rate=RATE))
    for engine, (light, smoke, mesh) in PLACES.items():
        export(room, out / light, engine)
        export(book, out / smoke, engine)
        (out / mesh).parent.mkdir(parents=True, exist_ok=True)
        if mesh.endswith(".obj"):
            write_obj(out / mesh)
        else:
            shutil.copyfile(CORNELL / "scene.glb", out / mesh)
    for hour in HOURS:
        probes = wlm.probe.load(CORNELL / "probes.npz", key=f"{hour}h")
        options = {"cells": CELLS, "original": CORNELL / "probes.npz"}
        export(wlm.probe.compress(probes), out / "threejs" / f"probes_{hour:02}", "three", **options)


def write_obj(path: Path) -> None:
    """Writes the room as an OBJ file with its colours beside it, which Unity imports without a package."""
    document, primitives = read_gltf(CORNELL / "scene.glb")
    lines, colours, first = [f"mtllib {path.stem}.mtl", "o room"], [], 1
    for each in primitives:
        material = document.content["materials"][each.material]
        linear = np.array(material["pbrMetallicRoughness"]["baseColorFactor"][:3])
        shown = " ".join(f"{level:.4f}" for level in to_srgb(linear))
        colours.append(f"newmtl {material['name']}\nKd {shown}\n")
        lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in each.position]
        lines += [f"vt {u:.7g} {1.0 - v:.7g}" for u, v in each.uv[1]]  # v is up in OBJ
        lines += [f"usemtl {material['name']}"]
        lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in each.triangle + first]
        first += len(each.position)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    path.with_suffix(".mtl").write_text("".join(colours), encoding="utf-8")


def main() -> None:
    """Reads the command line and writes the light of the projects."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=SAMPLES, help="the folder of the projects")
    out = parser.parse_args().out
    quiet_warp()
    try:
        write(out)
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    for project in sorted(path for path in out.iterdir() if path.is_dir()):
        print(f"{project.name}: {sum(file.stat().st_size for file in project.rglob('*') if file.is_file()):,} bytes")


if __name__ == "__main__":
    main()
