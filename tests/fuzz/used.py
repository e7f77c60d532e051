"""Cases that commands use whole: each of the files of a case is good or nearly so, but they don't belong together.

A case is JSON, a command with the files that it takes; its copies lie beside it. A command must end well and write
finite numbers, or say in one line what is wrong.
"""

import functools
import gzip
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from builders.atlas_meshes import sheet
from PIL import Image
from typer.testing import CliRunner

from wlm.atlas.stored import store
from wlm.cli import app
from wlm.errors import WlmError
from wlm.formats.channels import read_channels
from wlm.formats.exr import write_exr

from .reader import CORPUS, FILES, Reader, check_finite

MESHES = ("mesh.glb", "mesh.gltf", "mesh.obj", "atlas.glb")
LIGHTS = tuple("light.exr tiled.exr wide.exr plain.hdr light.pfm bc6h.dds half-mips.ktx2 nan.exr layers.exr".split())
LEVELS = ("mask-rgba.png", "mask-grey.png", "levels.jpg", "flipbook.tga", "strips.tif")
LIGHTMAPS = ("lightmap.wlm", "lightmap-frames.wlm", "lightmap-layers.wlm")
ATLASES = tuple(f"atlas-{kind}.wlm" for kind in ("tiles", "mixed", "cascade", "bc6h", "plain", "shared", "separate"))
CLOUDS = ("probe.wlm", "probe-pca.wlm")
MODELS = (*LIGHTMAPS, *ATLASES, *CLOUDS, "smoke.wlm")
PROBES = ("probes.npz", "probes-known.npz", "probes-vci.json", "probes-scene.json", "probes.csv", "volume.ktx2")
SETS = ("set", "alpha", "mixed", "gone")
VOLUMES = ("volume.npz", "volume-bricks.npz", "openvdb.vdb", "huge.npz")
BOOKS = ("flipbook.png", "flipbook.tga", "mask-rgba.png", "mask-grey.png", "large.png", "six-way.exr", "light.exr")
LISTS = tuple(f"list-{i}.json" for i in range(4))
ENCODINGS = tuple("linear srgb rgbm rgbm:1e-30:9 rgbm:99999:8 rgbd rgbd:1:1 dldr rgbe layer:View.Bake x".split())
QUICK = ("--views", "1", "--resolution", "16")
TIMES = ("18.5", "-5", "1e300", "nan", "25.5")
LAYOUTS = ("unity", "o3de", "embergen")

# A form of a command: each tuple is a choice.
_FORMS: tuple[tuple[Any, ...], ...] = (
    ("compress", MESHES, LIGHTS, *QUICK, "--steps", "10", "-o", "OUT.wlm"),
    ("compress", MESHES, LEVELS + LIGHTS, "--encoding", ENCODINGS, *QUICK, "-o", "OUT.wlm"),
    ("compress", MESHES, LISTS, *QUICK, "-o", "OUT.wlm"),
    ("compress", SETS, "--steps", "10", "--samples", "128", "-o", "OUT.wlm"),
    ("compress", SETS, "--steps", "10", "--samples", "128", "--mask", ("mask-rgba.png", "alpha"), "-o", "OUT.wlm"),
    ("compress", PROBES, "--steps", "10", "--order", ("coefficient", "channel"), "-o", "OUT.wlm"),
    ("info", MODELS),
    ("decode", LIGHTMAPS, "--time", TIMES, "-o", ("OUT.exr", "OUT.png")),
    ("decode", ATLASES, "--sheet", ("0", "1", "99"), "--state", ("0", "0.5", "1e300"), "-o", "OUT.exr"),
    ("decode", CLOUDS, "--positions", PROBES + ("positions.npz", "positions.json", "light.exr"), "-o", "OUT.npz"),
    ("evaluate", LIGHTMAPS, SETS, "--views", "0"),
    ("evaluate", ATLASES, MESHES, LIGHTS, *QUICK),
    ("evaluate", CLOUDS, PROBES, "--json", "OUT.json"),
    ("export", MODELS, "--engine", ("three", "godot", "unity", "unreal", "bevy"), "-o", "OUT"),
    ("web", LIGHTMAPS + CLOUDS, "--mesh", MESHES, "-o", "OUT.html"),
    ("web", MODELS, "--original", SETS + PROBES + LIGHTS, "-o", "OUT.html"),
    ("smoke", "shade", BOOKS, "--with", BOOKS, "--from", LAYOUTS, "--cells", ("1x1", "2x2", "5x3"), "-o", "OUT.png"),
    ("smoke", "bake", VOLUMES, "--resolution", "8", "-o", "OUT.exr"),
    ("smoke", "light", VOLUMES, "--resolution", "8", "--orders", "single", "-o", "OUT.exr"),
    ("smoke", "predict", VOLUMES, "--resolution", "8", "-o", "OUT.exr"),
    ("inspect", MESHES + LIGHTS + LEVELS + MODELS + PROBES + SETS + VOLUMES + BOOKS + LISTS),
)


def _drawn(draw: Random, data: bytes) -> bytes:
    words = [draw.choice(word) if isinstance(word, tuple) else word for word in draw.choice(_FORMS)]
    return json.dumps(words).encode()


@functools.cache
def _good() -> Sequence[bytes]:
    """Commands that are accepted, with the first file of each choice; they load what others need, too."""
    forms = [form for form in _FORMS if form[0] != "evaluate" and LISTS not in form and "--original" not in form]
    return [json.dumps([word[0] if isinstance(word, tuple) else word for word in form]).encode() for form in forms]


@functools.cache
def _files() -> dict[str, bytes]:
    """All files that commands name; those of a set are in its folder."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        for source in (*CORPUS.iterdir(), *FILES.glob("*.wlm")):
            shutil.copy(source, folder / source.name)
        (folder / "openvdb.vdb").write_bytes(gzip.decompress((FILES / "openvdb.vdb.gz").read_bytes()))
        (folder / "atlas.glb").write_bytes(store(sheet(quads=3)).glb)
        odd = np.where(np.arange(360).reshape(12, 10, 3) % 7 > 0, np.inf, 0.5).astype(np.float32)
        checked = np.dstack([np.ones((12, 10, 3)), np.indices((12, 10)).sum(0) % 2]).astype(np.float32)
        write_exr(folder / "wide.exr", np.full((3, 70, 3), 60000.0, np.float32))
        write_exr(folder / "nan.exr", odd, half=False)
        write_exr(folder / "small.exr", np.ones((5, 7, 3), np.float32))
        write_exr(folder / "alpha.exr", checked)
        Image.new("RGBA", (300, 200), (9, 200, 30, 100)).save(folder / "large.png")
        np.savez(folder / "huge.npz", density=np.full((4, 5, 6), 3e38, np.float32), voxel=1e-30)
        places = {"small.exr": [1, 1, 0, 0], "nan.exr": [0] * 4, "wide.exr": [9, 9, -3, -3], "../x.exr": [1, 1, 0, 0]}
        for i, (file, place) in enumerate(places.items()):
            objects = [{"node": node, "sheet": 0, "scale_offset": place} for node in ("left", "mesh", "")]
            listing = {"states": ["a"], "convention": "gltf", "sheets": [{"files": [file]}], "objects": objects}
            (folder / f"list-{i}.json").write_text(json.dumps(listing))
        files = {path.name: path.read_bytes() for path in folder.iterdir()}
    light, mask = files["light.exr"], files["mask-grey.png"]
    files |= {"set/set.json": files["set.json"], "set/a.exr": light, "set/b.exr": light, "set/mask.png": mask}
    for name, states, mask in (("alpha", ["alpha"] * 300, "alpha"), ("mixed", ["alpha", "small", "light"], "mask.png")):
        entries = [{"time_hours": 0.05 * i, "file": f"{state}.exr"} for i, state in enumerate(states)]
        files[f"{name}/set.json"] = json.dumps({"name": name, "mask": mask, "lightmaps": entries}).encode()
        files |= {f"{name}/{state}.exr": files[f"{state}.exr"] for state in states}
    return files | {"mixed/mask.png": files["mask-rgba.png"]}


def _use(path: Path) -> None:
    """Runs the command in a folder of its own."""
    words, files = json.loads(path.read_bytes()), _files()
    folder = path.parent / "used"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        for name in {each for word in words for each in files if each == word or each.startswith(f"{word}/")}:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(files[name])
        for name in ("light.exr", "nan.exr", "small.exr", "wide.exr", "mask-grey.png"):  # that lists and meshes name
            (folder / name).write_bytes(files[name])
        before = set(folder.rglob("*"))
        names = {*files, *SETS}
        words = [f"{folder}/{word}" if word in names or word[:3] == "OUT" else word for word in words]
        result = CliRunner().invoke(app, words)
        after = sorted(set(folder.rglob("*")) - before)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code in (0, 2), f"exit code {result.exit_code}"
        if result.exit_code:
            errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
            assert len(errors) == 1, f"expected one line of error, found {len(errors)}"
            assert not after, f"left {', '.join(each.name for each in after)}"
            raise WlmError(f"{path}: {errors[0]}")
        for each in after:
            _check_written(each)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check_written(path: Path) -> None:
    if path.suffix == ".exr":
        check_finite(**{path.stem: read_channels(path)[0]})
    elif path.suffix == ".npz":
        with np.load(path) as arrays:
            check_finite(**{name: each for name, each in arrays.items() if each.dtype.kind == "f"})
    elif path.suffix in (".json", ".gltf"):
        json.loads(path.read_bytes(), parse_constant=_refuse_constant)


def _refuse_constant(text: str) -> None:
    raise AssertionError(f"accepted, but wrote {text}")


READERS = (Reader("commands", "a.json", _good, _drawn, _use, cost=4, blind=0.0),)
