"""Mitsuba as a rival: its variant on the CPU, and rows that are left out without it."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import benchmarks.smoke_network as bench_module
from benchmarks import path_tracer
from benchmarks.path_tracer import choose_variant
from benchmarks.runner import Bench


@pytest.mark.parametrize(
    ("backends", "llvm", "variant"),
    [(("llvm",), 19, "llvm_ad_rgb"), (("llvm",), 18, "scalar_rgb"), (("cuda",), 19, "scalar_rgb")],
)
def test_the_variant_is_the_fastest_that_works(monkeypatch, backends, llvm, variant):
    detail = SimpleNamespace(llvm_version=lambda: (llvm, 1, 0))
    names = SimpleNamespace(LLVM="llvm")
    module = SimpleNamespace(JitBackend=names, has_backend=lambda name: name in backends, detail=detail)
    monkeypatch.setitem(sys.modules, "drjit", module)
    monkeypatch.setattr(path_tracer, "has_tracer", lambda: True)
    assert choose_variant() == variant


@pytest.mark.parametrize("denoiser", [True, False])
def test_rows(monkeypatch, denoiser):
    """Two scenes of grey smoke, and a tracer that finds the same light everywhere."""
    lines = []
    bench = Bench("smoke-network", "cpu", lines.append, clock="time_ms")
    bench.camera, bench.sizes = None, SimpleNamespace(frames=2, samples=(1, 4), few=1, resolution=16)
    bench.frames = [SimpleNamespace(later=None) for _ in range(4)]
    bench.references = [torch.full((8, 16, 16), 0.5) for _ in range(4)]

    class Tracer:
        variant = "scalar_rgb"

        def __init__(self, volume, camera):
            pass

        def __call__(self, samples):
            return np.full((6, 16, 16), 0.2, np.float32), np.ones((16, 16))

    monkeypatch.setattr(bench_module, "PathTracer", Tracer)
    monkeypatch.setattr(bench_module, "has_tracer", lambda: True)
    monkeypatch.setattr(bench_module, "has_denoiser", lambda: denoiser)
    monkeypatch.setattr(bench_module, "denoise", lambda images: images)
    rows = bench_module.traced_rows(bench)
    options = ["1 sample", "1 sample, denoised", "4 samples", "4 samples, denoised"]
    assert [row.option for row in rows] == (options if denoiser else options[::2])
    assert all(row.notes == "on the CPU, scalar_rgb" and row["time_ms"] > 0.0 for row in rows)
    # 0.2 is 0.4845 in sRGB.
    assert rows[0]["psnr"] == pytest.approx(-20.0 * np.log10(0.5 - 0.48453), abs=0.01)
    monkeypatch.setattr(bench_module, "has_tracer", lambda: False)
    assert bench_module.traced_rows(bench) == [] and "left out, mitsuba is not installed" in lines[-1]
