"""Shared by every test: the devices, and a cache of Warp kernels that outlasts the run."""

import gc
import os
from pathlib import Path

import pytest

# A worker per core: with a thread for each core in each worker, they would wait for each other more than they compute.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# All workers share one cache, so that each kernel is compiled once: Warp builds a module in a folder of its process and
# renames that folder. Set before anything imports Warp, which reads it when it starts.
os.environ["WARP_CACHE_PATH"] = str(Path(__file__).resolve().parents[1] / ".cache" / "warp")


# What imports and collection leave stays to the end: the garbage collector need not look through it each time.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def _devices() -> list[str]:
    """Lists the devices to test on: all that Warp finds, or the ones that WLM_TEST_DEVICES names."""
    import warp as wp

    # Its banner and compile notes would drown a failing test's output.
    wp.config.log_level = wp.LOG_WARNING
    found = ["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"]
    asked = os.environ.get("WLM_TEST_DEVICES")
    if not asked:
        return found
    names = [name.strip() for name in asked.split(",") if name.strip()]
    missing = [name for name in names if name not in found]
    # Asked for and absent must not pass as tested.
    if missing or not names:
        raise pytest.UsageError(f"WLM_TEST_DEVICES={asked}: expected some of {', '.join(found)}")
    return names


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Runs each test that takes `device` on every device."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", _devices())
