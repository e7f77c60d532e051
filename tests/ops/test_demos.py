"""Short forms of the demos of operations: what they fit comes near what their pictures show."""

import runpy
from pathlib import Path

import pytest
import torch

DEMOS = Path(__file__).resolve().parents[2] / "demos"


def _demo(monkeypatch: pytest.MonkeyPatch, name: str, **changes: float) -> dict:
    """The names of a demo, with other constants."""
    monkeypatch.syspath_prepend(DEMOS)
    names = runpy.run_path(str(DEMOS / f"{name}.py"))
    for key, value in changes.items():
        assert key in names
        monkeypatch.setitem(names["run"].__globals__, key, value)
    return names["run"].__globals__


def test_density_and_wind_from_three_views(monkeypatch):
    demo = _demo(monkeypatch, "ops_march", PIXELS=14, STEPS=30, WIND_STEPS=25, RATE=0.05)
    axes = torch.meshgrid(*[torch.linspace(-1.0, 1.0, 10)] * 3, indexing="ij")
    centred = torch.stack(axes, -1) - torch.tensor([0.2, -0.1, 0.1])
    density = 0.5 * torch.exp(-5.0 * (centred * torch.tensor([1.0, 1.4, 0.8])).square().sum(-1))
    found = demo["reconstruct"](demo["look"](density, demo["VIEWS"]), 10)
    assert float((found - density).norm()) < 0.35 * float(density.norm())
    wind = torch.tensor([1.0, 0.4, -0.6])
    seen = demo["find_wind"](demo["look"](demo["moved"](density, wind), demo["VIEWS"]), found)
    assert float((seen - wind).norm()) < 0.35


def test_mesh_and_camera_from_silhouettes(monkeypatch, tmp_path):
    changes = {"PIXELS": 32, "KNOWN": 6, "DIVISIONS": 2, "STEPS": 60, "DEGREE": 3, "RATE": 0.04}
    demo = _demo(monkeypatch, "ops_silhouette", **changes, LEAST_OVERLAP=0.9, MOST_DEGREES=14.0)
    figures = demo["run"](tmp_path, "cpu")
    assert figures["overlap in the held-out view"] > figures["of the initial sphere"] + 0.05
    assert (tmp_path / "ops_silhouette.png").stat().st_size > 2000
