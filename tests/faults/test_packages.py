"""Packages that are installed but fail when they are imported: one line for each command that needs one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.gltf_maker import GltfMaker

from wlm.errors import WlmError, broken_package
from wlm.formats.exr import write_exr
from wlm.formats.hdr_blocks import need

ROOT = Path(__file__).resolve().parents[2]
FILES, CORPUS = ROOT / "tests" / "files", ROOT / "tests" / "fuzz" / "corpus"
LIBRARY = "libother.so.1: cannot open shared object file"
FAULTS = {
    "ImportError": f"raise ImportError({LIBRARY!r})",
    "OSError": f"raise OSError({LIBRARY!r})",  # as ctypes raises it
    "AttributeError": "import math\nmath.removed_in_the_next_version",
    "SyntaxError": "print 'for Python 2'",
}

BAKE = ROOT / "demos" / "cornell" / "room.yaml"
SET = ROOT / "demos" / "data" / "cornell"
# Each package with a fault, and a command that needs it; that of the core comes last.
COMMANDS = (
    ("mitsuba", "OSError", ("bake", "lightmaps", BAKE, "-o", "out")),
    ("pyvista", "ImportError", ("view", FILES / "lightmap.wlm")),
    ("imagecodecs", "AttributeError", ("compress", CORPUS / "mesh.glb", CORPUS / "runs.hdr", "-o", "out.wlm")),
    ("DracoPy", "SyntaxError", ("compress", "KHR_draco_mesh_compression.gltf", "a.exr", "-o", "out.wlm")),
    ("meshopt", "OSError", ("compress", "EXT_meshopt_compression.gltf", "a.exr", "-o", "out.wlm")),
    ("UnityPy", "AttributeError", ("compress", "a.asset", "-o", "out.wlm")),
    ("ispc_texcomp", "OSError", ("compress", SET, "--profile", "frames", "-o", "out.wlm")),
    ("uvunwrap", "ImportError", ("compress", CORPUS / "mesh.glb", "a.exr", "--profile", "cascade", "-o", "out.wlm")),
    (
        "astc_encoder",
        "AttributeError",
        ("compress", CORPUS / "mesh.glb", CORPUS / "astc.ktx2", "-o", "out.wlm"),
    ),
    ("onnx", "SyntaxError", ("smoke", "export-onnx", FILES / "smoke.wlm", "-o", "out.onnx")),
    ("ray", "OSError", ("compress", SET, "--cluster", "auto", "-o", "out.wlm")),
    ("trimesh", "AttributeError", ("compress", "a.ply", "a.exr", "-o", "out.wlm")),
)
RUN = """
import json, sys
from typer.testing import CliRunner
from wlm.cli import app
for words in json.load(sys.stdin):
    run = CliRunner().invoke(app, words)
    print(json.dumps([run.exit_code, run.stderr, repr(run.exception)]))
"""


def broken(folder, package, fault):
    (folder / package).mkdir()
    (folder / package / "__init__.py").write_text(FAULTS[fault])


def test_a_command_whose_package_is_broken_ends_in_one_line(tmp_path):
    packages, folder = tmp_path / "packages", tmp_path / "work"
    packages.mkdir(), folder.mkdir()
    for package, fault, _ in COMMANDS:
        broken(packages, package, fault)
    maker = GltfMaker()
    view = {"buffer": 0, "byteLength": 4, "byteStride": 4, "count": 1, "mode": "ATTRIBUTES"}
    for name in ("KHR_draco_mesh_compression", "EXT_meshopt_compression"):
        primitive = {"attributes": {"POSITION": 0}, "extensions": {name: {"bufferView": 0, "attributes": {}}}}
        maker.content |= {
            "extensionsUsed": [name],
            "meshes": [{"primitives": [primitive]}],
            "bufferViews": [{"buffer": 0, "byteLength": 4, "extensions": {name: view}}],
            "buffers": [{"byteLength": 4, "uri": "data:;base64,AAAAAA=="}],
        }
        (folder / f"{name}.gltf").write_text(json.dumps(maker.content))
    write_exr(folder / "a.exr", np.ones((8, 8, 3), np.float32))
    (folder / "a.asset").write_bytes(bytes(64))
    (folder / "a.ply").write_text("ply\n")
    before = sorted(os.listdir(folder))
    words = [[str(word) for word in words] for *_, words in COMMANDS]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(packages), str(ROOT)))}
    run = {"input": json.dumps(words), "cwd": folder, "env": environment, "capture_output": True, "text": True}
    child = subprocess.run([sys.executable, "-c", RUN], **run)
    assert child.returncode == 0, child.stderr
    runs = [json.loads(line) for line in child.stdout.splitlines() if line.startswith("[")]
    for (package, fault, command), (code, said, error) in zip(COMMANDS, runs, strict=True):
        lines = [line for line in said.splitlines() if not line.startswith("warning: ")]
        assert code == 2 and len(lines) == 1, (command, code, said, error)
        assert package in lines[0] and f"cannot be imported: {fault}" in lines[0], lines[0]
        assert "install it again" in lines[0]
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_package_is_not_called_missing(tmp_path, monkeypatch, fault):
    name = f"broken_{fault.lower()}"
    broken(tmp_path, name, fault)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(WlmError, match=f"view: {name} is installed but cannot be imported: {fault}: .*force-reinstall"):
        need(name, "view")
    with pytest.raises(WlmError, match=r"view: broken_absent is missing; needs the extra: pip install 'wlm\[view\]'"):
        need("broken_absent", "view")
    try:
        __import__(name)
    except Exception as error:
        assert broken_package(error) == name


def test_an_error_of_the_program_is_no_broken_package():
    for error in (OSError("a"), ImportError("b"), ImportError("c", name="wlm.gone"), SyntaxError("d"), ValueError("e")):
        try:
            raise error
        except Exception as caught:
            assert broken_package(caught) == ""
