"""Where Mitsuba traces: on the bench's GPU if that works, else on the CPU, and never at the cost of other rows."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import benchmarks.smoke_network_rivals as rivals
from benchmarks import path_tracer
from benchmarks.path_tracer import GPU, choose_variant, try_variant
from benchmarks.runner import Bench
from wlm.errors import WlmError

BACKENDS = SimpleNamespace(CUDA="cuda", LLVM="llvm")


@pytest.fixture
def drjit(monkeypatch):
    """Installs a stand-in for Mitsuba's compiler, with these backends, this version of LLVM and this trial program."""

    def install(backends=("cuda", "llvm"), llvm=19, trial="print()"):
        detail = SimpleNamespace(llvm_version=lambda: (llvm, 1, 0))
        module = SimpleNamespace(JitBackend=BACKENDS, has_backend=lambda name: name in backends, detail=detail)
        monkeypatch.setitem(sys.modules, "drjit", module)
        monkeypatch.setattr(path_tracer, "has_tracer", lambda: True)
        monkeypatch.setattr(path_tracer, "_TRIAL", trial)

    return install


def test_the_variant_is_the_devices(drjit):
    drjit()
    assert choose_variant("cuda:0") == (GPU, "")
    assert choose_variant("cpu") == ("llvm_ad_rgb", "")


def test_an_old_or_missing_llvm_is_not_used(drjit):
    drjit(llvm=18)
    assert choose_variant() == ("scalar_rgb", "")
    drjit(backends=("cuda",))
    assert choose_variant() == ("scalar_rgb", "")


@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        ("raise RuntimeError('no OptiX\\nhere')", "here"),
        ("import sys; sys.exit('x' * 999)", "x" * 157 + "..."),
        ("import os; os._exit(3)", "a first image ended with 3"),
        ("import os; os.abort()", "a first image ended with -6"),
    ],
)
def test_a_gpu_whose_first_image_fails(drjit, trial, reason):
    """Whichever way it does, this process goes on, with the CPU's variant."""
    drjit(trial=trial)
    assert choose_variant("cuda:0") == ("llvm_ad_rgb", reason)


def test_a_gpu_whose_first_image_does_not_end(drjit, monkeypatch):
    drjit(trial="import time; time.sleep(60)")
    monkeypatch.setattr(path_tracer, "_PATIENCE", 0.2)
    assert choose_variant("cuda:0") == ("llvm_ad_rgb", "a first image took more than 0.2 s")


def test_a_gpu_that_is_not_tried(drjit):
    drjit(backends=("llvm",), trial="raise SystemExit('tried')")
    assert choose_variant("cuda:0") == ("llvm_ad_rgb", "Dr.Jit finds no CUDA")
    drjit(trial="raise SystemExit('tried')")
    assert choose_variant("cuda:1") == ("llvm_ad_rgb", "Mitsuba takes the first GPU alone")


def test_without_mitsuba(monkeypatch):
    monkeypatch.setattr(path_tracer, "has_tracer", lambda: False)
    for device in ("cpu", "cuda:0"):
        with pytest.raises(WlmError, match=r"mitsuba: install wlm\[bake\]"):
            choose_variant(device)


@pytest.mark.parametrize("value", [0.0, np.nan, 0.5])
def test_a_trial_wants_light(monkeypatch, value):
    """The program of a trial is a call of this."""
    assert path_tracer._TRIAL.endswith(f"try_variant('{GPU}')")
    variants = []

    def tracer(volume, camera, *, variant):
        variants.append(variant)
        return lambda samples: (np.full((6, camera.height, camera.width), value), np.ones((8, 8)))

    monkeypatch.setattr(path_tracer, "PathTracer", tracer)
    if value == 0.5:
        try_variant(GPU)
    else:
        with pytest.raises(WlmError, match=f"^path tracing: {GPU}: expected light, found none, or numbers"):
            try_variant(GPU)
    assert variants == [GPU]


def test_the_real_trial():
    pytest.importorskip("mitsuba")
    try_variant(choose_variant()[0])


@pytest.fixture
def bench(monkeypatch):
    """Two scenes of grey smoke, and a tracer that works on the variants in `works` alone."""
    works, lines = set(), []
    references = [torch.full((8, 16, 16), 0.5) for _ in range(4)]

    class Tracer:
        def __init__(self, volume, camera, *, variant):
            if variant not in works:
                raise RuntimeError(f"{variant}: doesn't work; it never did")

        def __call__(self, samples):
            return np.full((6, 16, 16), 0.2, np.float32), np.ones((16, 16))

    monkeypatch.setattr(rivals, "PathTracer", Tracer)
    monkeypatch.setattr(rivals, "has_tracer", lambda: True)
    monkeypatch.setattr(rivals, "has_denoiser", lambda: True)
    monkeypatch.setattr(rivals, "denoise", lambda images: images)
    bench = Bench("smoke-network", "cpu", lines.append, clock="time_ms")
    bench.device, bench.camera, bench.lines, bench.works = "cuda:0", None, lines, works
    bench.sizes = SimpleNamespace(frames=2, samples=(1, 4), few=1, resolution=16)
    bench.frames, bench.references = [SimpleNamespace(later=None) for _ in range(4)], references
    return bench


def choose(monkeypatch, variant: str, reason: str = ""):
    monkeypatch.setattr(
        rivals, "choose_variant", lambda device="cpu": (variant, reason) if device != "cpu" else ("scalar_rgb", "")
    )


def test_rows_on_the_gpu(bench, monkeypatch):
    choose(monkeypatch, GPU)
    bench.works.add(GPU)
    rows = rivals.traced_rows(bench)
    options = ["1 sample", "1 sample, denoised on the CPU", "4 samples", "4 samples, denoised on the CPU"]
    assert [row.option for row in rows] == options
    assert all(row.notes == "on the GPU, cuda_ad_rgb" and row["time_ms"] > 0.0 for row in rows)
    # 0.2 is 0.4845 in sRGB.
    assert rows[0]["psnr"] == pytest.approx(-20.0 * np.log10(0.5 - 0.48453), abs=0.01)
    assert bench.lines == ["path tracing"]


@pytest.mark.parametrize(
    ("chosen", "reason", "note"),
    [
        ("scalar_rgb", "no OptiX: none; at all", "no OptiX: none; at all"),
        (GPU, "", "cuda_ad_rgb: doesn't work; it never did"),
    ],
)
def test_rows_of_a_gpu_that_does_not_work_are_the_cpus(bench, monkeypatch, chosen, reason, note):
    """Whether it shows in the trial or after it; the reason is in the notes."""
    choose(monkeypatch, chosen, reason)
    bench.works.add("scalar_rgb")
    rows = rivals.traced_rows(bench)
    assert [row.option for row in rows] == ["1 sample", "1 sample, denoised", "4 samples", "4 samples, denoised"]
    for row in rows:
        assert row.notes == f"on the CPU, scalar_rgb: not on the GPU, {note}"
        assert set(row.figures) == {"psnr", "psnr_min", "psnr_max", "pixels", "time_ms"}
    assert bench.lines[1].startswith("path tracing: on the CPU: ") and len(bench.lines) == 2


@pytest.mark.parametrize("where", ["cpu", "cuda:0"])
def test_a_tracer_that_works_nowhere_costs_its_own_rows_alone(bench, monkeypatch, where):
    bench.device = where
    choose(monkeypatch, GPU)
    assert rivals.traced_rows(bench) == []
    assert bench.lines[-1] == "path tracing: left out: scalar_rgb: doesn't work; it never did"
