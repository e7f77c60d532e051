"""Access to VTK through the optional package pyvista; one-line errors if it is missing or cannot render."""

import functools
import subprocess
import sys
from types import ModuleType

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


def import_pyvista(what: str) -> ModuleType:
    """Imports pyvista.

    Args:
        what: Name of the feature that needs it, for the error.

    Raises:
        WlmError: It is not installed.
    """
    try:
        import pyvista
    except ImportError as error:
        raise WlmError(f"{what}: pyvista is missing; needs the extra: pip install 'wlm[view]'") from error
    return pyvista


@functools.cache
def require_opengl(what: str) -> None:
    """Renders in a child process first, since VTK crashes its process if no OpenGL works.

    Args:
        what: Name of the feature that needs it, for the error.

    Raises:
        WlmError: The child process failed.
    """
    try:
        trial = subprocess.run([sys.executable, "-c", _TRIAL], capture_output=True, timeout=_TRIAL_SECONDS, check=False)
        works = trial.returncode == 0
    except (OSError, subprocess.SubprocessError):
        works = False
    if not works:
        raise WlmError(
            f"{what}: VTK cannot render here: it found no OpenGL that works; expected a display, EGL or OSMesa; on "
            "Debian or Ubuntu: apt install libegl1"
        )
