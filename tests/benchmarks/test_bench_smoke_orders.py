"""The benchmark of light of all orders on tiny pictures: every row, who is nearest."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.bench_rows import ENVIRONMENT
from builders.smoke_plumes import facing, plume

import benchmarks.rivals.smoke_orders as rivals
import benchmarks.smoke_orders as bench
from benchmarks import read_json, tables, write_json
from benchmarks.rivals.smoke_orders import FITTED
from benchmarks.smoke_orders import ALBEDOS, GRIDS, INSIDE, METHOD, PHASES, QUICK, GridSizes, run

SINGLE = GridSizes((12, 16), extinctions=(20.0,), pixels=10, samples=64)
SMALL = {"plumes": 1, "pixels": 10, "samples": 96, "scale": 0.08, "frames": 20, "sides": 1}
OTHER = {"views": 1, "samples": 32, "cells": 12}
TINY = replace(QUICK, **SMALL, repeats=1, single=SINGLE, other=OTHER)
SCATTERING = ("single scattering", "single x gain", "three octaves", "fitted octaves", "fitted filter")
WAYS = (*SCATTERING, "diffusion", "learned mix")


@pytest.fixture(scope="module")
def rows():
    with pytest.MonkeyPatch.context() as patch:
        # Of fifteen octaves a few: each is a march.
        patch.setattr(rivals, "FITTED", FITTED[::4])
        return run(device="cpu", sizes=TINY)


def test_every_row_has_its_figures(rows, tmp_path):
    """Of each scene and albedo each way, what a frame takes by it, and the references' noise; flicker of the jet."""
    write_json(tmp_path / "rows.json", rows, ENVIRONMENT)
    assert read_json(tmp_path / "rows.json") == (list(rows), ENVIRONMENT) and "| learned mix |" in tables(rows)
    scenes = [f"{name}, albedo {albedo:g}" for name in ("plumes", "jet") for albedo in ALBEDOS]
    assert list(dict.fromkeys(row.scene for row in rows)) == [*scenes, "single lights", "plumes", "plume and cloud"]
    assert [row.option for row in rows if row.method == GRIDS] == ["12 voxels", "16 voxels"]
    phases, inside = ([row for row in rows if row.method == method] for method in (PHASES, INSIDE))
    assert len(phases) == 8 and len(inside) == 9 and all(np.isfinite(row["psnr"]) for row in phases + inside)
    assert all(row["gain"] > 3.0 for row in phases) and all(abs(row["bias"]) < 1.0 for row in inside)
    for scene in scenes:
        found = {row.option: row for row in rows if row.scene == scene}
        denoised = {"1 sample, denoised"} if importlib.util.find_spec("pyoidn") else set()
        assert set(found) == {*WAYS, "path tracing"} | denoised
        for option, row in found.items():
            assert (row.system, row.method) == ("smoke", METHOD) and row["pixels"] == 10 and row["lights"] == 3
            assert row["psnr_min"] <= row["psnr"] <= row["psnr_max"]
            if option == "path tracing":
                assert row["samples"] == 96 and row["psnr"] > 30.0
                continue
            assert 0 < row["flip"] <= row["flip_max"] and row["time_ms"] > 0
            assert ("flicker" in row.figures) == scene.startswith("jet")


def test_flicker_is_what_the_smokes_motion_leaves():
    """Of a picture that moves as its smoke does there is none; of one that stays, the reference's and more."""
    random = torch.Generator().manual_seed(2)
    picture = torch.rand(16, 16, 3, generator=random)
    later = picture.roll(2, 1)
    motion = torch.stack([torch.full((16, 16), 2.0), torch.zeros(16, 16)])
    volume, camera = plume(), facing(plume(), size=16)
    shots = [bench.Shot(volume, camera, (), 0), bench.Shot(volume, camera, (), 1, motion)]
    noise = [0.02 * torch.randn(16, 16, 3, generator=random) for _ in range(4)]
    light = torch.full((16, 16, 3), 0.3)
    halves = [(light + noise[0], light + noise[1]), (1.5 * light + noise[2], 1.5 * light + noise[3])]
    opacity = [torch.ones(16, 16)] * 2
    assert bench._flicker(shots, [picture, later], halves, opacity)["flicker"] < 1e-3
    brighter = bench._flicker(shots, [light, 1.5 * light], halves, opacity)
    # The references' noise isn't counted as their change.
    assert brighter["flicker"] > 20 and brighter["flicker_ratio"] == pytest.approx(1.0, abs=0.06)
    # Those that stay have nothing that a picture's flicker could be compared with.
    still = [(0.0 * light, 0.0 * light)] * 2
    assert set(bench._flicker(shots, [light, 1.5 * light], still, opacity)) == {"flicker"}
