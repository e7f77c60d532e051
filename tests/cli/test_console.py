"""Lines of the console that depend on what earlier runs have left."""

import os
import subprocess
import sys

from wlm.cli.console import COMPILING

SCRIPT = """
import warp as wp
from wlm.cli.console import quiet_warp
@wp.kernel(module="unique")
def one(a: wp.array(dtype=float)): a[0] = 1.0
@wp.kernel(module="unique")
def two(a: wp.array(dtype=float)): a[0] = 2.0
quiet_warp()
for kernel in (one, two): wp.launch(kernel, 1, [wp.zeros(1, dtype=float, device="cpu")], device="cpu")
"""


def test_a_run_that_compiles_kernels_says_so_once(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    for said in (f"{COMPILING}\n", ""):
        command = [sys.executable, tmp_path / "script.py"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        assert (done.stdout, done.stderr) == ("", said)
