"""The wheel: built from the checkout, it works alone, with its profiles, kernels' headers, assets and data."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = """
import pathlib, sys
import wlm, wlm_kernels
folder = pathlib.Path(sys.argv[1])
for module in (wlm, wlm_kernels):
    assert pathlib.Path(module.__file__).is_relative_to(folder), module.__file__
try:
    import benchmarks
    raise SystemExit("benchmarks is installed")
except ImportError:
    pass
import numpy as np
day = wlm.lightmap.from_arrays(np.full((2, 8, 8, 3), [[[[0.5]]], [[[1.0]]]], np.float32), np.arange(2.0), period=24.0)
wlm.lightmap.compress(day, "M", steps=10).save(folder / "day.wlm")
print(wlm.load(folder / "day.wlm").decoder("cpu").frame(0.5).mean())
from wlm.smoke.codec import shipped
assert shipped().is_file()
"""


def run(*words: object, **options: object) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_wheel_works_outside_the_checkout(tmp_path):
    # Without isolation: an isolated build would download setuptools.
    build = ["-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path]
    run(sys.executable, *build, ROOT, cwd=tmp_path)
    (wheel,) = tmp_path.glob("wlm-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    tracked = run("git", "ls-files", "configs", "wlm", "wlm_kernels", cwd=ROOT).splitlines()
    expected = {f"wlm/{name}" if name.startswith("configs/") else name for name in tracked}
    assert expected <= set(names), sorted(expected - set(names))
    # The packages that the wheel requires come from this environment, the wheel alone from the folder.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(tmp_path / "installed")
    out = run(sys.executable, "-P", "-c", PROGRAM, tmp_path / "installed", cwd=tmp_path, env=environment)
    assert 0.0 < float(out.split()[-1]) < 2.0
    assert "Usage" in run(sys.executable, "-P", "-m", "wlm", "--help", cwd=tmp_path, env=environment)
