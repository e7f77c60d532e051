"""The smoke benchmark on tiny grids: every row has its figures, and they agree with what they are of."""

from dataclasses import replace

import pytest
from builders.bench_rows import by_option, check_outputs

from benchmarks.smoke import PANELS, QUICK, plotted, run

TINY = replace(
    QUICK,
    lattice=32,
    small=12,
    compared=(20, 40),
    drift=60,
    fills=(0.0, 1.0),
    coarse=6,
    cloud=24,
    resolution=16,
    guide_shared=(2, 10),
    guide_alone=(1, 10),
    six=(1.0, 0.5),
    plume=8,
    scale=0.08,
    frames=2,
    repeats=1,
)
BOUNDED = ("float32, all boundaries", "float16, all boundaries")
METHODS = [
    ("jet", "lattice"),
    ("jet", "lattice storage"),
    ("ball", "advection"),
    ("closed box", "advection mass"),
    ("cube", "advection bricks"),
    ("cloud", "guide"),
    ("cloud", "six ways"),
    ("plume", "weights"),
    ("jet-sphere", "frame"),
    ("jet", "devices"),
]


@pytest.fixture(scope="module")
def rows():
    return run(device="cpu", sizes=TINY)


def test_every_row_has_its_figures(rows, tmp_path):
    check_outputs(rows, tmp_path, PANELS, plotted(rows))
    assert {row.method for row in plotted(rows)} == {"guide", "six ways"}
    assert list(dict.fromkeys((row.scene, row.method) for row in rows)) == METHODS
    labels = [(row.scene, row.method, row.option) for row in rows]
    assert len(set(labels)) == len(labels)
    for row in rows:
        assert row.system == "smoke" and row.figures
        assert ("time_ms" in row.figures) == (row.method not in ("lattice storage", "advection mass", "weights"))
        assert row.get("time_ms") is None or row["time_ms"] > 0.0


def test_shares_of_the_copy(rows):
    """The bytes that a step must move, over its time and the copy's bandwidth."""
    lattice = by_option(rows, "lattice")
    bandwidth = 1e9 * lattice["a copy"]["bandwidth"]
    for option, size, cell in (
        ("float32, periodic", 32, 152),
        ("float32, all boundaries", 32, 153),
        ("float16, all boundaries", 32, 77),
        ("float32, all boundaries, D3Q27", 32, 217),
        ("float16, all boundaries, 12³", 12, 77),
    ):
        row = lattice[option]
        seconds = 1e-3 * row["time_ms"]
        assert row["cells"] == size
        assert row["of_copy"] == pytest.approx(size**3 * cell / seconds / bandwidth)
        assert row["mlups"] == pytest.approx(1e-6 * size**3 / seconds)
    for option, moved in (("semi-lagrangian, float32", 8), ("maccormack, float32", 20), ("maccormack, float16", 10)):
        row = by_option(rows, "advection")[option]
        assert row["of_copy"] == pytest.approx(24**3 * moved / (1e-3 * row["time_ms"]) / bandwidth)


def test_a_frame_is_the_sum_of_its_stages(rows):
    frame = by_option(rows, "frame")
    parts = ("simulation", "guide", "obstacles' shadows", "weights and background")
    total = frame["all but the network"]
    assert total["time_ms"] == pytest.approx(sum(frame[part]["time_ms"] for part in parts))
    assert total["frame_rate"] == pytest.approx(1e3 / total["time_ms"])
    assert frame["air alone"]["time_ms"] < frame["simulation"]["time_ms"]
    drawn = {f"all orders{what}" for what in (", drawn", ", no obstacle", " of a point light", " of fire")}
    assert drawn | {"six ways, drawn", *(f"six planes by paths, {n}" for n in ("one order", "all orders"))} < set(frame)


def test_several_devices_are_as_one(rows):
    devices = by_option(rows, "devices")
    assert list(devices) == [f"{name}, 2" for name in ("float32, periodic", *BOUNDED, "jet-sphere")]
    assert all(row["speedup"] > 0.0 and row["max_error"] < 1e-5 for row in devices.values())
