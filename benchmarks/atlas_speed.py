"""Seconds that the stages of an atlas' profiles take at any size, and those of the clustering of many triangles.

    python benchmarks/atlas_speed.py atlas-speed.json --side 8192 --times 1 --device cuda:0 --profile standard
    python benchmarks/atlas_speed.py atlas-speed.json --triangles 1000000 --device cuda:0

Each call is a set of the file, with the command; a set that is there is replaced.

A lightmap of the size is the demo's room enlarged, times noise of many scales, so that tiles vary at each. A profile is
run once before, on 128 x 128 texels, so that kernels are compiled, and then as often as `--times` says: the least total
counts. Triangles are those of a bumpy sheet under a lightmap of 2048 x 2048 texels, by profile `paper`.
"""

import argparse
import json
import math
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import wlm
from benchmarks import describe_environment
from benchmarks.atlas import PROFILES
from wlm.atlas.cascade.fit import group_triangles
from wlm.atlas.data import LightmappedScene, from_arrays
from wlm.atlas.data import load as load_scene
from wlm.atlas.fit import compress
from wlm.atlas.model import Profile
from wlm.atlas.stages import Stages
from wlm.formats.atomic import atomic_write
from wlm.texels import fill_gaps

DATA = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / "atlas"
WARM_SIDE, SHEET_SIDE = 128, 2048
OCTAVES, CONTRAST = 8, 0.2


def noise(side: int) -> np.ndarray:
    """Numbers about 1 that vary at many scales, [side, side]."""
    total = torch.zeros((side, side))
    generator = torch.Generator().manual_seed(0)
    for octave in range(OCTAVES):
        cells = max(side >> octave, 2)
        grid = torch.rand((1, 1, cells, cells), generator=generator) - 0.5
        total += torch.nn.functional.interpolate(grid, (side, side), mode="bilinear")[0, 0] * 2.0 ** (octave / 2.0)
    return (1.0 + CONTRAST * total / total.std()).clamp(min=0.05).numpy()


def enlarged(scene: LightmappedScene, side: int) -> LightmappedScene:
    """Makes the scene under a lightmap of another size."""
    (mesh,) = scene.sheets
    light = torch.from_numpy(mesh.lightmap).permute(2, 0, 1)[None]
    light = torch.nn.functional.interpolate(light, (side, side), mode="bilinear")[0].permute(1, 2, 0).numpy()
    mask = torch.from_numpy(mesh.mask).float()[None, None]
    inside = torch.nn.functional.interpolate(mask, (side, side), mode="nearest")[0, 0].numpy() > 0
    lightmaps = np.ascontiguousarray(light * noise(side)[..., None], np.float32)[None]
    return replace(scene, sheets=(replace(mesh, lightmaps=fill_gaps(lightmaps, inside), mask=inside),))


def sheet(triangles: int) -> LightmappedScene:
    """Makes a bumpy sheet of about a number of triangles."""
    count = max(math.isqrt(triangles // 2), 1)
    row, column = np.mgrid[: count + 1, : count + 1] / count
    uv = np.stack([column, row], -1).reshape(-1, 2)
    position = np.stack([column, 0.02 * np.sin(40 * column) * np.cos(30 * row), row], -1).reshape(-1, 3)
    corner = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangle = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, c, b), (b, c, d))])
    light = noise(SHEET_SIDE)[..., None] * np.array([1.0, 0.8, 0.6])
    return from_arrays(position, triangle, uv, light, np.ones((SHEET_SIDE, SHEET_SIDE), bool), name="sheet")


def compressed(scene: LightmappedScene, name: str, device: str) -> dict[str, float]:
    """Seconds of each stage of a compression, and in all."""
    scene = replace(scene)  # nothing is kept from a run before
    start = time.perf_counter()
    seconds = compress(scene, name, device=device).report["seconds"]
    return seconds | {"all": time.perf_counter() - start}


def clustered(triangles: int, device: str) -> dict[str, float]:
    """Seconds of the clustering of a number of triangles, without compiling."""
    profile = Profile.load("paper")
    for count in (1000, triangles):
        mesh, stages = sheet(count).sheets[0], Stages(device)
        groups = group_triangles(mesh, profile, stages)
    return stages.seconds | {"triangles": len(mesh.triangle), "groups": len(groups.representative)}


def main() -> None:
    """Reads the command line, measures, and writes after each profile what is done."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="FILE.json")
    parser.add_argument("--side", type=int, default=512, help="texels of the lightmap along a side")
    parser.add_argument("--profile", action="append", help="default all; several times")
    parser.add_argument("--times", type=int, default=2)
    parser.add_argument("--triangles", type=int, help="number of triangles to cluster instead")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    title = f"{args.triangles} triangles" if args.triangles else str(args.side)
    command = shlex.join(["python", "benchmarks/atlas_speed.py", args.out.name, *sys.argv[2:]])
    measured = {"name": title, "environment": describe_environment(args.device, command), "methods": {}}
    known = json.loads(args.out.read_text())["sets"] if args.out.exists() else []
    sets = [each for each in known if each["name"] != title]

    def done(name: str, seconds: dict[str, float]) -> None:
        measured["methods"][name] = seconds
        print(name, " ".join(f"{stage} {value:.3g}" for stage, value in seconds.items()), flush=True)
        atomic_write(args.out, (json.dumps({"sets": [*sets, measured]}, indent=1) + "\n").encode())

    if args.triangles:
        done("clustering", clustered(args.triangles, args.device))
        return
    room = load_scene(DATA / "room.glb", DATA / "room.exr")
    mesh, small = enlarged(room, args.side), enlarged(room, WARM_SIDE)
    for name in args.profile or PROFILES:
        compressed(small, name, args.device)
        runs = [compressed(mesh, name, args.device) for _ in range(args.times)]
        done(name, min(runs, key=lambda each: each["all"]))


if __name__ == "__main__":
    main()
