"""`wlm smoke simulate`: options, interruption, resume, and hard scenes."""

import itertools
import os
import re
import signal

import numpy as np
import pytest
import torch
import yaml
from builders.checks import error_of
from builders.running import call, fails
from builders.smoke_plumes import SCENE, write_frames

from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.fluid.volume import load_volume, save_bricks
from wlm.formats.vdb import VdbFile
from wlm.smoke import simulation
from wlm.smoke.data import CHECKPOINT, load_frames, open_frames
from wlm.smoke.scene import Scene
from wlm.smoke.simulation import simulate
from wlm.system import Meter

JET = SCENE | {
    "grid": {"cells": [8, 10, 8], "cell": 0.125, "refine": 2, "origin": [-0.5, 0, -0.5]},
    "obstacles": [{"radius": 0.17, "path": [[0, -0.25, 0.6, 0], [1, 0.25, 0.6, 0]]}],
    "frames": 4,
    "rate": 8.0,
}


@pytest.fixture(scope="session")
def jet(tmp_path_factory):
    """A scene and the folder of its simulation."""
    folder = tmp_path_factory.mktemp("jet")
    (folder / "jet.yaml").write_text(yaml.safe_dump(JET))
    call("smoke", "simulate", folder / "jet.yaml", "-o", folder / "a")
    return folder


def test_simulate(jet, tmp_path):
    scene, out = jet / "jet.yaml", tmp_path / "out"
    text = call("smoke", "simulate", scene, "-o", out, "--device", "cpu,cpu")
    assert re.search(r"voxels of the smoke +│ +16 x 20 x 16 │", text) and "simulate: 4 of 4, smoke" in call.stderr
    assert "warning" not in call.stderr
    assert sorted(os.listdir(out)) == [*(f"frame_{i:04d}.npz" for i in range(1, 5)), "scene.json"]
    footage = load_frames(out)
    assert footage.scene == Scene.model_validate(JET)
    amounts = [float(footage.load(number).density.sum()) for number in footage.numbers]
    assert all(b > a > 0 for a, b in itertools.pairwise(amounts))
    last = footage.load(4)
    assert (last.voxel, last.extinction, last.temperature) == (0.0625, 8.0, None)
    # The jet goes up, and none of it is in the sphere.
    heights = last.density.sum((0, 2)).numpy()
    assert heights[:4].min() > 1.0 > 0.01 > heights[-2:].max()
    places = [last.origin[i] + last.voxel * (np.arange(n) + 0.5) for i, n in enumerate(last.shape)]
    away = np.stack(np.meshgrid(*places, indexing="ij"), -1) - footage.scene.obstacles[0].eased.at(0.5)
    assert not last.density[torch.from_numpy(np.linalg.norm(away, axis=-1) < 0.06)].any()
    # One scene gives one result, however often, and on however many devices, but for the sums of outlets.
    for number in footage.numbers:
        name = f"frame_{number:04d}.npz"
        torch.testing.assert_close(load_volume(out / name).density, load_volume(jet / "a" / name).density)
    assert "device 'gpu': expected one of: cpu" in fails("smoke", "simulate", scene, "-o", out, "--device", "cpu,gpu")


def test_simulate_as_told(jet, tmp_path):
    words = ("smoke", "simulate", jet / "jet.yaml", "-o", tmp_path / "a", "--frames", 1, "--scale", 0.5)
    call(*words, "--resume", "--volumes", "vdb")
    assert "there was nothing to resume" in call.stderr
    footage = load_frames(tmp_path / "a")
    assert footage.numbers == (1,) and footage.scene.grid.cells == (4, 5, 4) and footage.scene.grid.cell == 0.25
    grid = VdbFile((tmp_path / "a" / "frame_0001.vdb").read_bytes(), "a")
    assert [f"{head.name} {head.type}" for head in grid.heads] == ["density float", "velocity vec3s"]
    assert grid.read("density", True).values.sum() == pytest.approx(float(footage.load(1).density.sum()))
    sizes = []
    for form in ("nvdb", "nvdb-raw"):
        call(*words, "--volumes", form)
        assert not (tmp_path / "a" / "frame_0001.vdb").exists()
        path = tmp_path / "a" / "frame_0001.nvdb"
        assert float(load_volume(path).density.sum()) == pytest.approx(float(footage.load(1).density.sum()))
        sizes.append(path.stat().st_size)
    assert sizes[0] < 0.1 * sizes[1]
    for change, words in (
        ({"grid": {"cells": [4096, 4096, 4096], "cell": 0.1, "faces": {}}}, "4096 x 4096 x 4096 cells"),
        ({"air": {"speed": 0.1}}, "an obstacle of 1 m/s, 0.5 cells per step: leave air.speed null or at least 1"),
        ({"inlets": [SCENE["inlets"][0] | {"radius": 0.01}]}, "inlets.0: its circle covers no cell's centre"),
        ({"smoke": {"storage": "float16", "dissipation": 1e-3}}, "with float16"),
    ):
        (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(JET | change))
        assert words in fails("smoke", "simulate", tmp_path / "wrong.yaml", "-o", tmp_path / "b")
    assert "jet-sphere" in fails("smoke", "simulate", "none", "-o", tmp_path / "b")
    assert "found other files" in fails("smoke", "simulate", jet / "jet.yaml", "-o", tmp_path)


@pytest.mark.parametrize("within", [False, True])
def test_a_simulation_is_stopped_and_resumed(within, jet, tmp_path, monkeypatch):
    """Ctrl-C within the second frame or at its end keeps the state; the resumed frames are equal to the bit."""
    out, scene = tmp_path / "out", jet / "jet.yaml"
    step, done = Solver.step, []

    def interrupted(self, steps=1):
        step(self, steps)
        done.append(1)
        if len(done) == 9:
            os.kill(os.getpid(), signal.SIGINT)

    per_frame = Scene.model_validate(JET).steps // 2
    assert per_frame < 9 < 2 * per_frame
    monkeypatch.setattr(Solver, "step", interrupted)
    monkeypatch.setattr(Meter, "due", lambda self, done: within)
    call("smoke", "simulate", scene, "-o", out, code=130)
    monkeypatch.undo()
    whole = ["frame_0001.npz", *["frame_0002.npz"] * (not within)]
    assert f"stopped at frame {len(whole)}: repeat the command with --resume to continue from {out}" in call.stderr
    assert sorted(os.listdir(out)) == [*whole, "scene.json", CHECKPOINT]
    # With another scene it isn't resumed, and nothing is lost by the attempt.
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(JET | {"air": {"viscosity": 1.0}}))
    assert "its frames have another air" in fails("smoke", "simulate", tmp_path / "other.yaml", "-o", out, "--resume")
    volumes = ("smoke", "simulate", scene, "-o", out, "--resume", "--volumes", "nvdb-raw")
    assert "frame_0001.nvdb of a finished frame is missing" in fails(*volumes)
    monkeypatch.setattr(Solver, "step", lambda self, steps=1: done.append(1) or step(self, steps))
    call("smoke", "simulate", scene, "-o", out, "--resume", "--checkpoint-every", 0)
    assert len(done) == 4 * per_frame, "no step is done twice"
    assert sorted(os.listdir(out)) == [*(f"frame_{i:04d}.npz" for i in range(1, 5)), "scene.json"]
    for number in range(1, 5):
        name = f"frame_{number:04d}.npz"
        assert torch.equal(load_volume(out / name).density, load_volume(jet / "a" / name).density)
    # All is there: nothing is done again.
    before = (out / "frame_0004.npz").stat().st_mtime_ns
    call("smoke", "simulate", scene, "-o", out, "--resume")
    assert "nothing to resume" not in call.stderr
    assert (out / "frame_0004.npz").stat().st_mtime_ns == before
    assert "frame_0001.nvdb of a finished frame is missing" in fails(*volumes)


def test_a_simulation_goes_on_with_corrected_settings(tmp_path, monkeypatch):
    """Finished frames stay; the state goes on in other steps, and a later source and another path from now on act."""
    ball = {"centre": [0, 0.8, 0], "radius": 0.2}
    body = {"radius": 0.1, "path": [[0, 0, 0.6, 0], [0.1, 0.05, 0.6, 0]]}
    scene = JET | {"sources": [ball | {"stop": 0.05}], "obstacles": [body]}
    first = Scene.model_validate(scene | {"frames": 2})
    out, step = tmp_path / "out", Solver.step

    def stop(self, steps=1):
        step(self, steps)
        if self.steps == first.steps // 2 + 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(Solver, "step", stop)
    with pytest.raises(KeyboardInterrupt):
        simulate(open_frames(out, first), checkpoint_every=0.0)
    monkeypatch.undo()
    kept = (out / "frame_0001.npz").read_bytes()
    later = {"sources": [ball | {"stop": 0.05}, ball | {"start": 0.25}]}
    body = body | {"path": [*body["path"], [0.4, 0.05, 0.6, 0], [0.5, 0.05, 0.6, 0.05]]}
    settings = {"lattice_speed": 0.08, "speed": 1.3, "smagorinsky": 0.2}
    second = Scene.model_validate(scene | later | {"obstacles": [body], "air": settings})
    assert second.steps % first.steps
    for field, wrong in {
        "smoke.buoyancy": {"smoke": {"buoyancy": 1.0}},
        "sources": {"sources": [ball | {"stop": 0.06}]},
        "obstacles": {"obstacles": [body | {"path": [[0, 0, 0.6, 0], [0.15, 0.05, 0.6, 0]]}]},
    }.items():
        with pytest.raises(WlmError, match=f"another {field} than the scene"):
            open_frames(out, Scene.model_validate(scene | wrong), resume=True)
    assert simulate(open_frames(out, second, resume=True), resume=True) == 2
    assert (out / "frame_0001.npz").read_bytes() == kept and load_frames(out).numbers == (1, 2, 3, 4)
    whole = tmp_path / "whole"
    simulate(open_frames(whole, second))
    for number, least in ((1, 0.0), (2, 0.0), (3, 0.1), (4, 1.0)):
        ours, theirs = (load_frames(each).load(number).density.double() for each in (out, whole))
        assert float(ours.sum()) == pytest.approx(float(theirs.sum()), rel=0.1)
        assert float(ours[:, 10:].sum()) >= least


def test_hot_smoke_shortens_the_step(tmp_path):
    """Hot smoke faster than the scene's speed does not blow up; a step too short is refused with speed and bound."""
    hot = {"inlets": [], "obstacles": [], "sources": [{"centre": [0, 0.4, 0], "radius": 0.25, "temperature": 1.0}]}
    scene = Scene.model_validate(JET | hot | {"smoke": {"buoyancy": 200.0}, "frames": 2})
    solver = simulation.make_solver(scene)
    for frame in (1, 2):
        simulation.advance(scene, solver, frame)
        assert solver.fastest < 0.3 and np.isfinite(solver.density.numpy()).all()
    assert round(scene.step / solver.duration) in (2, 4, 8)
    assert solver.steps * scene.smoke.substeps * solver.duration == pytest.approx(scene.time(2))


def test_a_frame_that_cannot_be_written_is_not_resumed_past(tmp_path, monkeypatch):
    """A state is saved after its frame: a missing frame is simulated again."""
    scene, out, save = Scene.model_validate(JET), tmp_path / "out", save_bricks

    def full(path, *content):
        if path.name == "frame_0003.npz":
            raise WlmError(f"{path}: cannot write: no space left")
        save(path, *content)

    monkeypatch.setattr(simulation, "save_bricks", full)
    assert "no space left" in error_of(simulate, open_frames(out, scene), checkpoint_every=0.0)
    monkeypatch.setattr(simulation, "save_bricks", save)
    kept = (out / CHECKPOINT).read_bytes()
    # A frame that was lost otherwise can't be made of the state that is kept.
    (out / "frame_0001.npz").rename(tmp_path / "one.npz")
    with pytest.raises(WlmError, match="cannot resume after frame 2: frame_0001.npz is missing"):
        simulate(open_frames(out, scene, resume=True), resume=True)
    (tmp_path / "one.npz").rename(out / "frame_0001.npz")
    assert (out / CHECKPOINT).read_bytes() == kept
    assert simulate(open_frames(out, scene, resume=True), resume=True) == 3
    assert load_frames(out).numbers == (1, 2, 3, 4) and not (out / CHECKPOINT).exists()


@pytest.mark.parametrize("case", ["empty", "one cell", "hot", "bricks of halves"])
def test_hard_scenes(case, tmp_path):
    changed = {
        "empty": {"inlets": []},
        "one cell": {"grid": {"cells": [1, 1, 1], "cell": 1.0, "refine": 1}, "inlets": [], "obstacles": []},
        "bricks of halves": {"smoke": {"bricks": True, "storage": "float16", "scheme": "semi-lagrangian"}},
        "hot": {
            "inlets": [],
            "obstacles": [{"radius": [0.1, 0.1, 0.1], "shape": "cylinder", "path": [[0, 0, 1.0, 0]]}],
            "smoke": {"buoyancy": 20.0, "weight": 1.0, "emission": 4.0, "cooling": 0.5, "dissipation": 0.1},
            "sources": [{"centre": [0, 0.4, 0], "radius": 0.25, "temperature": 1.0, "stop": 0.2}],
        },
    }[case]
    scene = Scene.model_validate(JET | {"obstacles": []} | changed | {"frames": 2})
    reports = []
    simulate(open_frames(tmp_path / "a", scene), progress=reports.append)
    # A slow frame has reports of its own, without figures or with those of the last one.
    amounts = {report.done: report.figures["smoke m³"] for report in reports if report.figures}
    last = load_frames(tmp_path / "a").load(2)
    assert len(amounts) == 2 and last.warnings == ()
    assert (amounts[2] > 0) == (case in ("hot", "bricks of halves"))
    assert (last.temperature is not None) == (case == "hot")
    assert (last.density.dtype == torch.float16) == (case == "bricks of halves")
    if case == "hot":
        rows = last.density.sum((0, 2)) * torch.arange(last.shape[1])
        assert float(rows.sum() / last.density.sum()) > 0.4 / last.voxel, "it rises"


def test_earlier_results_outlast_a_command_that_fails(jet, tmp_path, monkeypatch):
    """Frames, lightmaps and pictures stay when the next run ends before its first result."""
    frames = write_frames(tmp_path / "frames", frames=2).path
    bake = ("smoke", "bake", frames, "-o", tmp_path / "bake", "--resolution", 8)
    call(*bake)
    call("smoke", "shade", tmp_path / "bake", "-o", tmp_path / "baked")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert "--camera toward: expected a direction" in fails(*bake, "--camera", "toward=0,0,0")
    (frames / "frame_0001.npz").write_bytes(b"x")
    call(*bake, code=2)
    (tmp_path / "bake" / "six_0001.exr").write_bytes(b"x")
    fails("smoke", "shade", tmp_path / "bake", "-o", tmp_path / "baked")
    monkeypatch.setattr("wlm.fluid.slabs.free_memory", lambda device: 3 * 2**10)
    line = fails("smoke", "simulate", jet / "jet.yaml", "-o", frames)
    assert re.search(
        r"8 x 10 x 8 cells of air and 16 x 20 x 16 voxels of smoke need .* but only 0.0 GiB are free", line
    )
    changed = {path for path, content in before.items() if not path.exists() or path.read_bytes() != content}
    assert changed == {frames / "frame_0001.npz", tmp_path / "bake" / "six_0001.exr"}
