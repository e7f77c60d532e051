"""A test of whether VTK can render on this machine."""

import functools
import subprocess
import sys

from wlm.errors import WlmError

_TRIAL = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.AddRenderer(vtkRenderer())
window.Render()
"""
_TRIAL_SECONDS = 60.0


@functools.cache
def require_opengl() -> None:
    """Checks in a child process that VTK can render: it crashes its process if no OpenGL works."""
    try:
        trial = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, timeout=_TRIAL_SECONDS, check=False)
        works = trial.returncode == 0
    except (OSError, subprocess.SubprocessError):
        works = False
    if not works:
        raise WlmError(
            "view: VTK cannot render here: it found no OpenGL that works; expected a display, EGL or OSMesa; on "
            "Debian or Ubuntu: apt install libegl1"
        )
