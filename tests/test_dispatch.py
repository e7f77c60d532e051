"""Long work by several workers: the same bytes for every job, lost workers, and what goes wrong in one line."""

import functools
import os
import shutil
import sys
from functools import partial

import numpy as np
import pytest
from builders.atlas_meshes import sheet
from builders.bake_rooms import ROOM
from builders.checks import error_of
from builders.probe_sets import synthetic
from builders.running import call, report_always
from builders.small_sets import moving_light, tiny_profile
from builders.worker_pools import Several, ToyBaker, ToyWorker

from wlm import dispatch, workers
from wlm.atlas import fit as atlas_fit
from wlm.atlas.shared import curves
from wlm.bake import work
from wlm.bake.geometry import read_geometry
from wlm.dispatch import Place, Task, gathered
from wlm.errors import WlmError
from wlm.fluid.volume import from_array, save_volume
from wlm.lightmap import fit as lightmap_fit
from wlm.probe import fit as probe_fit
from wlm.probe.model import Profile
from wlm.smoke.network.dataset import make_pool
from wlm.smoke.network.settings import DatasetSettings
from wlm.system import Meter


def tiles(folder, monkeypatch, **place):
    monkeypatch.setattr(lightmap_fit, "CPU_TILES", 1)
    model = lightmap_fit.compress(moving_light(256, 256), tiny_profile(steps=20), **place)
    model.save(folder / "a.wlm")
    return (folder / "a.wlm").read_bytes()


def regions(folder, monkeypatch, **place):
    profile = Profile(name="small", ratio=0.1, latent=3, hidden=16, steps=20, region=60)
    return probe_fit.compress(synthetic(200), profile, **place).content.packed


def objects(folder, monkeypatch, **place):
    monkeypatch.setattr(curves, "_AT_ONCE", 16)
    model = atlas_fit.compress(sheet(), views=1, budget=0.4, mips=True, tile=5, **place)
    model.save(folder / "a.wlm")
    return (folder / "a.wlm").read_bytes()


def sequences(folder, monkeypatch, **place):
    settings = {"cells": 16, "refine": 1, "frames": 1, "views_a_frame": 2, "sequences": 3, "resolution": 24}
    pool = make_pool(DatasetSettings(**settings, warmup=0.6, kept_empty=1.0), seed=5, place=Place(**place))
    assert len(pool) == 6
    return [vars(pool)[name].numpy().tobytes() for name in vars(pool)]


def hours(folder, monkeypatch, **place):
    monkeypatch.setattr(work, "HourBaker", ToyBaker)
    shutil.copytree(ROOM, folder / "room", dirs_exist_ok=True)
    task = work.open_task(folder / "room" / "room.yaml")
    geometry = read_geometry(task.geometry, None)
    made = work.each_hour(task, geometry, "irradiance", np.zeros(2), (2, 3), Place(**place), None, None)
    return [each["mean"].tobytes() for each in made]


def frames(folder, monkeypatch, **place):
    (folder / "smoke").mkdir(exist_ok=True)
    for number in range(3):
        density = np.random.default_rng(number).random((8, 8, 8)).astype(np.float32)
        save_volume(folder / "smoke" / f"a_{number}.npz", from_array(density))
    options = [word for name, value in place.items() for word in (f"--{name}", value)]
    call("smoke", "bake", folder / "smoke", "-o", folder / "six", "--resolution", 8, *options)
    return [path.read_bytes() for path in sorted((folder / "six").iterdir())]


JOBS = (tiles, regions, objects, sequences, hours, frames)


@pytest.mark.parametrize("job", JOBS)
def test_order_and_lost_workers_change_nothing(job, tmp_path, monkeypatch):
    whole = job(tmp_path, monkeypatch)
    monkeypatch.setattr(dispatch, "start_workers", functools.partial(Several, order=1, lose=(2, 5)))
    assert job(tmp_path, monkeypatch, workers=2) == whole


def kills_one(monkeypatch, kind, kill):
    """Makes a worker of a kind of pool die at its first step; returns the list of those that did."""
    begin, killed = kind.call, []

    def call_and_kill(self, number, method, *arguments):
        begin(self, number, method, *arguments)
        if method == "advance" and not killed:
            killed.append(number)
            kill(self, number)

    monkeypatch.setattr(kind, "call", call_and_kill)
    return killed


SLOW = tuple(pytest.param(job, marks=pytest.mark.slow) for job in JOBS if job is not hours)


@pytest.mark.parametrize("job", [*SLOW, hours])
def test_a_killed_process_changes_nothing(job, tmp_path, monkeypatch):
    whole = job(tmp_path, monkeypatch)
    killed = kills_one(monkeypatch, workers.Processes, lambda pool, number: pool._processes[number].kill())
    assert job(tmp_path, monkeypatch, workers=2) == whole and killed


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
def test_a_killed_actor_of_a_cluster_changes_nothing(job, tmp_path, monkeypatch, cluster):
    whole = job(tmp_path, monkeypatch)
    killed = kills_one(monkeypatch, workers.Actors, lambda pool, number: cluster.kill(pool._actors[number]))
    assert job(tmp_path, monkeypatch, cluster="auto") == whole and killed
    assert "cluster auto: expected at least 1 GPU for a worker" in error_of(toys, [1], cluster="auto", device="cuda")


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray")
    paths = {"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}  # of the tests' own classes
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, runtime_env=paths)
    yield ray
    ray.shutdown()


def toys(jobs, progress=None, **place):
    tasks = [Task((number,), 1, partial(lambda each: each, job)) for number, job in enumerate(jobs)]
    return gathered((ToyWorker, 3), tasks, Meter(progress, "toys", len(tasks)), Place(**place))


def children():
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return file.read()


def test_few_tasks_and_many_workers():
    assert toys([], workers=3) == {} and toys([2], workers=3) == {0: 6}
    assert toys([1, 2, 5], workers=9) == {0: 3, 1: 6, 2: 15}


@pytest.mark.parametrize(
    ("job", "says"),
    [
        ("die", r"^toys: 3 workers died of task 1: it was ended by signal 9"),
        ("fail", r"^a.exr: expected light$"),
        ("unsendable", r"^toys: 3 workers died of task 1: .*pickle"),
        (lambda: 0, r"^toys: task 1 cannot be sent to a worker: .*pickle"),
    ],
)
def test_what_goes_wrong_is_told_in_a_line(job, says):
    before = children()
    with pytest.raises(WlmError, match=says) as error:
        toys([1, job], workers=2)
    assert "\n" not in str(error.value) and children() == before


def test_an_interrupt_leaves_no_process(monkeypatch):
    report_always(monkeypatch)
    before = children()

    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        toys([1, "sleep"], stop, workers=2)
    assert children() == before
