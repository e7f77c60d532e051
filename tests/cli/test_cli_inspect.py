"""`wlm inspect`: what lies in a folder is named, with the command that takes it and what is wrong with it."""

import gzip
import io
import json
import os
import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from builders import small_sets
from builders.contract import FILES
from builders.godot_bakes import Writer, bake, probes
from builders.running import call, fails
from fuzz.readers import _own_lights as own_lights
from PIL import Image
from typer.testing import CliRunner

import wlm
from wlm.cli.app import app
from wlm.errors import printable
from wlm.export import export
from wlm.formats.artifact import encode_artifact
from wlm.formats.exr import write_exr
from wlm.inspection import files, input_system, inspect
from wlm.inspection.finding import UNREADABLE
from wlm.inspection.folders import MOST

CORPUS = Path(__file__).resolve().parents[1] / "fuzz" / "corpus"


def chart(width: int, seed: int = 0, height: int = 64, alpha: bool = False) -> np.ndarray:
    """Light on stripes of a width with gaps of two texels between them."""
    light = np.random.default_rng(seed).random((height, 64, 3)).astype(np.float32) + 0.1
    lit = np.broadcast_to((np.arange(64) % width < width - 2)[None, :], (height, 64))
    light *= lit[..., None]
    return np.concatenate([light, lit[..., None].astype(np.float32)], 2) if alpha else light


def small_npz(**arrays: np.ndarray) -> bytes:
    """The bytes of an archive of arrays."""
    held = io.BytesIO()
    np.savez(held, **arrays)
    return held.getvalue()


def write_set(folder) -> None:
    """A set of five hours with its `set.json`."""
    small_sets.write_set(folder, small_sets.moving_light())
    names = sorted(path.name for path in folder.glob("*.exr"))
    entries = [{"time_hours": i, "file": name} for i, name in enumerate(names)]
    (folder / "set.json").write_text(json.dumps({"width": 128, "height": 128, "lightmaps": entries}))


def told(path) -> str:
    """All that is said, a line each, with names relative to the folder."""
    lines = []
    for finding in inspect(path):
        lines.append(f"{finding.path.relative_to(path)}: {finding.what} -> {finding.command}")
        lines += finding.problems
    assert all("\n" not in line for line in lines)
    return "\n".join(lines).replace(str(path), "HERE")


def test_a_project_is_told_piece_by_piece(tmp_path):
    for state, seed in (("night", 1), ("day", 2)):
        (tmp_path / "unity" / state).mkdir(parents=True)
        write_exr(tmp_path / "unity" / state / "Lightmap-0_comp_light.exr", chart(16, seed, alpha=True))
        Image.new("RGBA", (32, 32)).save(tmp_path / "unity" / state / "Lightmap-0_comp_dir.png")
    Image.new("RGBA", (64, 64)).save(tmp_path / "unity" / "day" / "Lightmap-0_comp_shadowmask.png")
    write_exr(tmp_path / "unity" / "day" / "ReflectionProbe-0.exr", np.ones((8, 48, 3), np.float32))
    write_set(tmp_path / "set")
    (tmp_path / "set" / "LICENSE").write_text("none")
    (tmp_path / "other").mkdir()
    position, sh = probes(9)
    writer = Writer()
    (tmp_path / "other" / "room.lmbake").write_bytes(writer.file(bake(writer, position, np.abs(sh) * 0.1 + 1.0)))
    np.savez(tmp_path / "other" / "smoke.npz", density=np.ones((4, 5, 6), np.float32))
    np.savez(tmp_path / "other" / "two.npz", position=position, sh_9=sh, sh_12=sh)
    (tmp_path / "other" / "smoke.vdb").write_bytes(b" BDV\0\0\0\0")
    shutil.copy(FILES / "lightmap.wlm", tmp_path / "other" / "map.wlm")
    shutil.copy(FILES / "atlas-tiles.wlm", tmp_path / "other" / "atlas.wlm")
    text = told(tmp_path)
    for said in (
        "unity: 2 states of light from Unity, 1 map of 64x64, with light, dir, shadowmask -> "
        "wlm compress HERE/unity --times 0:2:1 -o OUT.wlm",
        "the hours of day, night are unknown",
        "unity/day/ReflectionProbe-0.exr: six faces of a cube, 48x8",
        "set: a set of lightmaps at 5 times, 128x128 -> wlm compress HERE/set -o OUT.wlm",
        "room.lmbake: 9 light probes of 9 RGB coefficients, 9 of them lit; SH of radiance in the file's unit; "
        "convention godot, as the file states; coefficient by coefficient (r0 g0 b0 r1 ...); Godot's axes, "
        "right-handed, y up, in metres -> wlm compress",
        "smoke.npz: a volume of smoke, 4x5x6 voxels of 1 -> wlm smoke bake",
        "two.npz: 9 light probes of 9 RGB coefficients, 9 of them lit, under the keys sh_9, sh_12; SH",
        "wlm compress HERE/other/two.npz --key sh_9 -o OUT.wlm",
        "smoke.vdb: cannot be read",
        "map.wlm: compressed lightmaps over time",
        "atlas.wlm: compressed lightmaps of meshes",
    ):
        assert said in text, said
    # Compression prints the same lines.
    lines = wlm.lightmap.load(tmp_path / "unity", times=[0, 1]).warnings
    assert len(lines) == 4 and all(line.removeprefix(f"{tmp_path}/unity: ") in text.splitlines() for line in lines)
    assert "LICENSE" not in text and text.count("set") < 20
    export(wlm.load(FILES / "atlas-tiles.wlm"), tmp_path / "engine", "unity")
    # No command takes it, nor any of its files.
    assert told(tmp_path / "engine").endswith(" -> ")
    assert "a model that wlm export wrote" in inspect(tmp_path / "engine" / "colour.bytes")[0].what


SCENE = {"name": "tiny", "grid": {"cells": [8, 8, 8], "cell": 0.025}, "frames": 1, "rate": 1000.0}
SHEETS = {"sheets": [{"files": ["day.exr"]}], "objects": [{"node": "a", "sheet": 0}], "states": ["day"]}
TINY = {  # options that make a command of a system quick
    "atlas": ["--views", "1", "--resolution", "16"],
    "lightmap": ["--steps", "10", "--samples", "128"],
    "probe": ["--steps", "10"],
    "bake": ["--resolution", "16"],
}


def kinds() -> dict[str, dict[str, bytes]]:
    """For each kind of file the contents of small ones, by suffix, or by name after a slash."""
    stored = {name: (CORPUS / name).read_bytes() for name in os.listdir(CORPUS)}
    yaml_scene, sheets = json.dumps(SCENE).encode(), json.dumps(SHEETS).encode()
    light = "light.exr six-way.exr plain.hdr light.pfm strips.tif levels.jpg mask-grey.png bc6h.dds".split()
    return {
        "arrays": {".npz": small_npz(other=np.ones(3))},
        "checkpoint": {".wlm.partial": encode_artifact("probe-checkpoint", {}, {"a": np.ones(3)}, "none")},
        "export": {"bundle.json": b'{"format": "wlm-bundle"}'},
        "godot bake": {".lmbake": stored["probes.lmbake"]},
        "json": {".json": b"{}"},
        "lights": {".json": sheets},
        "mesh": {".glb": stored["mesh.glb"], ".gltf": next(iter(own_lights())), ".obj": stored["mesh.obj"]},
        "model": {
            f" {name}": (FILES / name).read_bytes()
            for name in ("atlas-tiles.wlm", "lightmap.wlm", "probe.wlm", "smoke.wlm")
        },
        "output": {".html": b"<html>"},
        "picture": {f" {name}": stored[name] for name in light},
        "positions": {".json": stored["positions.json"], ".npz": stored["positions.npz"]},
        "probes": {f" {name}": stored[name] for name in ("probes.npz", "probes-vci.json", "probes.csv", "volume.ktx2")}
        | {".npz": small_npz(**{"position": probes(9)[0], "sh_-1 $'": probes(9)[1], "sh-2": probes(9)[1]})},
        "scores": {".json": b'{"psnr": 40.0}'},
        "set": {"set.json": stored["set.json"]},
        "settings": {".yaml": yaml_scene, " profile.yml": b"steps: 10", " bake.yaml": b"geometry: mesh.glb"},
        "unity asset": {".asset": stored["probes.asset"]},
        "volume": {f" {name}": stored[name] for name in ("volume.npz", "volume-bricks.npz")}
        | {".nvdb": gzip.decompress(stored["cloud.nvdb.gz"])},
    }


NAME = "-it's $HOME\t\n`a`"
"""Begins with a dash, and contains what a shell reads: quotes, spaces, a variable, a tab and a line break."""


def run(finding) -> None:
    """Runs the command that is printed for a file or folder, as a shell reads it; nothing may be unreadable."""
    assert UNREADABLE not in finding.what and "\n" not in finding.what, finding
    if finding.command:
        split = ["bash", "-c", f"printf '%s\\0' {finding.command}"]
        words = subprocess.run(split, capture_output=True, check=True).stdout.decode().split("\0")[1:-1]
        if words[0] == "bake" and find_spec("mitsuba") is None:
            assert "the extra" in fails(*words[:-1], "BAKED") and "wlm[bake]" in finding.problems[-1]
            return
        call(*words, *TINY.get(input_system(words[1]) if words[0] == "compress" else words[1], []))


@pytest.mark.parametrize("kind", files._KINDS)
def test_every_printed_command_works_as_printed(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path(NAME)
    folder.mkdir()
    for name, content in kinds()[kind].items():
        path = folder / name if name[0] not in " ." else Path(f"{folder}{name}")
        path.write_bytes(content if isinstance(content, bytes) else b"".join(map(bytes, content)))
        if kind == "set":
            copy(folder, {"a.exr": "light.exr", "b.exr": "light.exr", "mask.png": "mask-grey.png"})
        if kind == "settings":
            copy(Path(), {"mesh.glb": "mesh.glb"})
        assert files.kind_of(path) == kind
        (finding,) = inspect(path)
        printed = CliRunner().invoke(app, ["inspect", "--", str(path)]).output.splitlines()[0]
        assert printed.startswith(f"{printable(str(finding.path))}: ") and printed.endswith(finding.command)
        run(finding)


def test_a_scene_to_bake_without_lightmap_uvs_gives_probes(tmp_path):
    (tmp_path / "a.yaml").write_text("geometry: a.gltf\nhours: [6, 18]")
    copy(tmp_path, {"image.png": "mask-grey.png"})
    content = json.loads((CORPUS / "mesh.gltf").read_bytes())
    for mesh in content["meshes"]:
        for each in mesh["primitives"]:
            each["attributes"] = {name: at for name, at in each["attributes"].items() if name[:8] != "TEXCOORD"}
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    finding = inspect(tmp_path / "a.yaml")[0]
    assert finding.what == "a scene to bake at 2 hours, a.gltf" and finding.command.startswith("wlm bake probes ")
    assert "lightmap.unwrap: true creates new UVs" in finding.problems[0]
    (tmp_path / "a.yaml").write_text("geometry: a.gltf\nlamps: [{material: none}]")
    finding = inspect(tmp_path / "a.yaml")[0]
    assert finding.command == "" and "lamps.0.material: expected one of" in finding.problems[0]


def copy(folder: Path, names: dict[str, str]) -> None:
    """Makes a folder of files of the corpus: the name of each, and which it is."""
    folder.mkdir(exist_ok=True)
    for name, source in names.items():
        shutil.copy(CORPUS / source, folder / name)


@pytest.mark.parametrize(
    ("names", "command"),
    [
        ({"a_6h.exr": "light.exr", "a_9h.exr": "light.exr", "-a.png": "mask-grey.png"}, "compress"),
        ({"-a.hdr": "plain.hdr", "b.hdr": "plain.hdr"}, "compress"),
        ({"-a.glb": "mesh.glb", "-b.exr": "light.exr"}, "compress"),
        ({"-a_comp_light.exr": "light.exr", "-a_comp_dir.png": "mask-rgba.png"}, "compress"),
        ({"frame_0001.npz": "volume.npz", "scene.json": "scene.json"}, "smoke bake"),
        ({"-a.exr": "six-way.exr"}, "smoke flipbook"),
        ({"-a_RLT.png": "flipbook.png", "-a_BBF.png": "flipbook.png"}, "smoke shade"),
        # What cannot be read together gets no command.
        ({"a_6h.exr": "light.exr", "a_9h.exr": "light.exr", "b.hdr": "mesh.obj"}, ""),
        ({"a.obj": "mesh.obj", "b.exr": "six-way.exr", "set.json": "set.json"}, ""),
    ],
)
def test_every_command_for_a_folder_works(names, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    copy(Path(NAME), names)
    found = inspect(Path(NAME))
    assert [each.command.startswith(f"wlm {command}") for each in found if each.command] == [True] * bool(command)
    for finding in found if command else ():
        run(finding)


def test_one_texture_of_a_flip_book_is_no_lightmap(tmp_path):
    copy(tmp_path, {"x_RLT.exr": "light.exr", "y_BBF.png": "flipbook.png", "rltd.exr": "light.exr"})
    text = told(tmp_path)
    assert text.count("half of a flip book of six-way lightmaps of smoke, without the other texture -> ") == 2
    assert "rltd.exr: a lightmap" in text


def test_all_folders_that_are_written_are_known():
    """Textures of an unknown export would be taken for lightmaps that can be compressed."""
    package = Path(wlm.__file__).parent
    texts = [path.read_text(encoding="utf-8") for path in package.rglob("*.py") if path.parent.name != "inspection"]
    formats = {name for text in texts for name in re.findall(r'"(wlm-[a-z-]+)"', text)}
    assert len(formats) > 2 and formats <= set(files._EXPORTS)


def test_pictures_of_several_atlases_are_no_times(tmp_path):
    for hour, width in ((6, 16), (12, 16), (18, 16)):
        write_exr(tmp_path / f"map_{hour}h.exr", chart(width, hour))
    what, hours = told(tmp_path).splitlines()
    assert what == ".: 3 lightmaps of 64x64 -> wlm compress HERE -o OUT.wlm" and "map_18h.exr = 18" in hours
    for hour in (6, 12):
        (tmp_path / f"map_{hour}h.hdr").write_bytes(imagecodecs.rgbe_encode(chart(16, hour)[..., :3], header=True))
        (tmp_path / f"map_{hour}h.exr").unlink()
    assert told(tmp_path).splitlines()[0] == what, "the size of a Radiance picture is known only when it is read"
    for hour in (6, 12):
        (tmp_path / f"map_{hour}h.hdr").unlink()
        write_exr(tmp_path / f"map_{hour}h.exr", chart(16, hour))
    write_exr(tmp_path / "map_18h.exr", chart(11, 18))
    text = told(tmp_path)
    assert "3 lightmaps of different UV layouts" in text and "compress them with their mesh ->" in text
    assert "map_6h.exr and map_18h.exr have different charts" in text
    write_exr(tmp_path / "map_18h.exr", chart(16, 18, height=32))
    assert "map_18h.exr is 64x32, map_6h.exr is 64x64" in told(tmp_path)


def test_what_is_damaged_is_said_and_nothing_stops(tmp_path):
    write_set(tmp_path / "set")
    data = sorted((tmp_path / "set").glob("*.exr"))[0].read_bytes()
    sorted((tmp_path / "set").glob("*.exr"))[1].unlink()
    for suffix in ("exr", "ktx2", "dds", "hdr", "npz", "glb", "lmbake", "wlm", "nvdb", "json", "png"):
        (tmp_path / f"empty.{suffix}").write_bytes(b"")
    (tmp_path / "cut.exr").write_bytes(data[: len(data) // 2])
    (tmp_path / "link").symlink_to(tmp_path)
    os.mkfifo(tmp_path / "pipe.exr")
    text = told(tmp_path)
    assert text.count("cannot be read") == 12 and "is missing" in text and "pipe" not in text and "link" not in text
    (tmp_path / "empty").mkdir()
    assert told(tmp_path / "empty") == ".: no known kind of file -> "


def test_no_more_is_told_than_can_be_read(tmp_path):
    for number in range(300):
        (tmp_path / f"{number}.vdb").write_bytes(b" BDV\0\0\0\0")
        (tmp_path / "deep" / str(number)).mkdir(parents=True)
    assert len(inspect(tmp_path)) == MOST and len(inspect(tmp_path / "deep")) == 1


def test_the_command(tmp_path):
    path = tmp_path / "a volume.npz"
    np.savez(path, density=np.ones((2, 2, 2), np.float32))
    run = CliRunner().invoke
    assert run(app, ["inspect", str(path)]).output.startswith(f"{path}: a volume of smoke, 2x2x2 voxels of 1 -> wlm")
    (found,) = json.loads(run(app, ["inspect", str(path), "--json"]).output)
    assert found["path"] == str(path) and found["problems"] == []
    assert found["command"] == f"wlm smoke bake '{path}' -o OUT.exr"
    result = run(app, ["inspect", str(tmp_path / "absent")])
    assert result.exit_code == 2 and "no such file or folder" in result.output
