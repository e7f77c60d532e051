"""`wlm doctor`: shows devices, libraries, and installed and missing extras."""

import os
import platform
import re
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from rich.markup import escape

from wlm import __version__
from wlm.cli.console import quiet_warp, show, table


def doctor() -> None:
    """Show Python, devices, libraries, extras and the kernel cache."""
    quiet_warp()
    import torch
    import warp as wp

    from wlm.interop import available_devices

    rows = table(f"wlm {__version__}", ["", "found"], text=["found"])
    rows.add_row("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    rows.add_row("executable", escape(sys.executable))
    rows.add_row("warp", f"{wp.config.version}, CUDA {'yes' if wp.is_cuda_available() else 'no'}")
    rows.add_row("torch", f"{torch.__version__}, CUDA {torch.version.cuda or 'no'}")
    for name in available_devices():
        device = wp.get_device(name)
        memory = f", {device.total_memory / 2**30:.0f} GiB" if device.is_cuda else ""
        rows.add_row(name, f"{device.name}{memory}")
    rows.add_section()
    extras = _extras()
    for extra, missing in extras.items():
        absent = f"missing: {', '.join(missing)}; pip install 'wlm[{extra}]'"
        rows.add_row(f"extra {extra}", escape(absent) if missing else "complete")
    if not extras:
        rows.add_row("extras", "unknown: wlm is not installed as a package; pip install -e .")
    rows.add_section()
    cache = Path(wp.config.kernel_cache_dir)
    size = _size_of(cache)
    rows.add_row("kernel cache", escape(str(cache)))
    rows.add_row("size of the cache", f"{size / 1e6:.1f} MB")
    show(rows)


def _size_of(folder: Path) -> int:
    total = 0
    for parent, _, files in os.walk(folder):
        for name in files:
            with suppress(FileNotFoundError):
                total += (Path(parent) / name).stat().st_size
    return total


def _extras() -> dict[str, list[str]]:
    try:
        requirements = metadata.requires("wlm") or []
    except metadata.PackageNotFoundError:
        return {}
    extras: dict[str, list[str]] = {}
    for requirement in requirements:
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        package = re.match(r"[\w.-]+", requirement)
        if extra is None or package is None:
            continue
        missing = extras.setdefault(extra[1], [])
        try:
            metadata.version(package[0])
        except metadata.PackageNotFoundError:
            missing.append(package[0])
    return extras
