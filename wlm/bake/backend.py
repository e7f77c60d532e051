"""Loads Mitsuba and the compiler that it needs, or reports in one line what to install."""

import ctypes
from pathlib import Path
from types import ModuleType

from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.formats.stderr import captured_stderr

_EXTRA = "bake"
_VARIANTS = {"cpu": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
_MAPS = Path("/proc/self/maps")
_CHATTER = (b"jit_find_library", b"jitc_llvm_")
_INSTALL = "install LLVM 16 or later (apt install libllvm19, for example), or name its library in DRJIT_LIBLLVM_PATH"


def start(device: str = "cpu") -> ModuleType:
    """Imports Mitsuba with its variant for "cpu" or "cuda" (the first GPU), and returns Mitsuba's module."""
    if device not in _VARIANTS:
        raise WlmError(f"device: expected cpu or cuda (the first GPU) for a bake, got {device}")
    # Dr.Jit's C library writes lines when it finds no LLVM.
    with captured_stderr(lambda line: line.startswith(_CHATTER)):
        mitsuba, drjit = need("mitsuba", _EXTRA), need("drjit", _EXTRA)
        has_llvm = drjit.has_backend(drjit.JitBackend.LLVM)
    if device == "cpu":
        if not has_llvm:
            raise WlmError(f"{_EXTRA}: LLVM, with which Mitsuba compiles for the CPU, is missing: {_INSTALL}")
        if (path := _old_llvm()) is not None:
            # An older LLVM would end the process at the first unknown instruction.
            raise WlmError(f"{_EXTRA}: {path} is older than LLVM 16, which Mitsuba's kernels need: {_INSTALL}")
    elif not drjit.has_backend(drjit.JitBackend.CUDA):
        raise WlmError(f"{_EXTRA}: Mitsuba finds no NVIDIA GPU, or no OptiX in its driver: use --device cpu")
    mitsuba.set_variant(_VARIANTS[device])
    return mitsuba


def _old_llvm() -> str | None:
    """Returns the path of a loaded LLVM library below version 16, which cannot tell its version; None without one."""
    try:
        lines = _MAPS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # only Linux lists the loaded libraries
        return None
    paths = dict.fromkeys(line.split(maxsplit=5)[-1] for line in lines if "libLLVM" in line)
    return next((path for path in paths if not hasattr(ctypes.CDLL(path), "LLVMGetVersion")), None)
