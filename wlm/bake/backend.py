"""Mitsuba and the compiler that it needs: found, or what to install in one line."""

import ctypes
from pathlib import Path
from types import ModuleType

from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need

_EXTRA = "bake"
_VARIANTS = {"cpu": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
_MAPS = Path("/proc/self/maps")
_INSTALL = "install LLVM 16 or later (apt install libllvm19, for example), or name its library in DRJIT_LIBLLVM_PATH"


def start(device: str = "cpu") -> ModuleType:
    """Imports Mitsuba and chooses its variant.

    Args:
        device: "cpu" or "cuda"; Mitsuba takes the first GPU.

    Returns:
        The module `mitsuba`.

    Raises:
        WlmError: A package, LLVM or a GPU is missing; the line says what to install.
    """
    mitsuba = need("mitsuba", _EXTRA)
    drjit = need("drjit", _EXTRA)
    if device not in _VARIANTS:
        raise WlmError(f"device: expected cpu or cuda, the first GPU, for a bake, got {device}")
    if device == "cpu":
        if not drjit.has_backend(drjit.JitBackend.LLVM):
            raise WlmError(f"{_EXTRA}: LLVM is missing, with which Mitsuba compiles for the CPU: {_INSTALL}")
        if (path := _old_llvm()) is not None:
            # It would end the process where it meets an instruction that it doesn't know.
            raise WlmError(f"{_EXTRA}: {path} is older than what Mitsuba's kernels need: {_INSTALL}")
    elif not drjit.has_backend(drjit.JitBackend.CUDA):
        raise WlmError(f"{_EXTRA}: Mitsuba finds no NVIDIA GPU, or no OptiX in its driver: take --device cpu")
    mitsuba.set_variant(_VARIANTS[device])
    return mitsuba


def _old_llvm() -> str | None:
    """The library of LLVM that is loaded, where it is older than 16: from then on it tells its version."""
    try:
        lines = _MAPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # elsewhere than on Linux nothing tells which one it is
        return None
    paths = dict.fromkeys(line.split(maxsplit=5)[-1] for line in lines if "libLLVM" in line)
    return next((path for path in paths if not hasattr(ctypes.CDLL(path), "LLVMGetVersion")), None)
