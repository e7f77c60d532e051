"""Sets of many probes in regions: their split, fit, file, decoding, volume and export."""

import dataclasses
import json

import numpy as np
import pytest
from builders.checks import error_of
from builders.probe_sets import synthetic
from typer.testing import CliRunner

import wlm
from wlm.cli.app import app
from wlm.errors import WlmError
from wlm.export import export
from wlm.export.page.probe import probe_page
from wlm.probe import fit
from wlm.probe.data import from_arrays
from wlm.probe.evaluation import evaluate
from wlm.probe.fit import compress, open_checkpoint
from wlm.probe.model import Profile
from wlm.probe.regions.tree import Tree
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight, at_probes
from wlm.probe.volume.update import update_bundle
from wlm.probe.volume.walk import settle
from wlm.system import Meter

SMALL = Profile(name="small", ratio=0.1, latent=3, hidden=16, steps=60, region=50)
RANDOM = np.random.default_rng(3)
CLOUD = RANDOM.random((301, 3)) * [9.0, 2.0, 4.0]


def _smooth(position: np.ndarray) -> np.ndarray:
    phase = position @ np.random.default_rng(5).normal(size=(3, 27)) / 4
    return (0.2 * np.sin(phase) + (np.arange(27) < 3)).astype(np.float32)


@pytest.fixture(scope="module")
def probes():
    return synthetic(301, dead=20)


@pytest.fixture(scope="module")
def model(probes):
    return compress(probes, SMALL, positions=True)


@pytest.fixture(scope="module")
def path(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("regions") / "room.wlm"
    model.save(path)
    return path


@pytest.fixture
def damaged(path, tmp_path):
    """The file with another byte at its end, that is, in the last region."""
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    (tmp_path / "damaged.wlm").write_bytes(content)
    return tmp_path / "damaged.wlm"


PLACES = {
    "a cloud": (CLOUD, 8, 38),
    "one too many": (CLOUD[:51], 2, 26),
    "just enough": (CLOUD[:50], 1, 50),
    "a plane": (CLOUD * [1, 0, 1], 8, 38),
    "a lattice": (np.stack(np.meshgrid(*[np.arange(7.0)] * 3), -1).reshape(-1, 3), 9, 50),
    "at one point": (np.repeat(CLOUD[:1], 301, 0), 1, 301),
    "most at one point": (np.concatenate([np.repeat(CLOUD[:1], 300, 0), CLOUD[1:2]]), 2, 300),
    "one far away": (np.concatenate([CLOUD, [[1e140, 0, 0]]]), 8, 38),
    "neighbours in float64": (1.0 + np.arange(51.0)[:, None] * [2.0**-52, 0, 0], 2, 26),
}


@pytest.mark.parametrize(("position", "least", "most"), PLACES.values(), ids=PLACES)
def test_a_split_has_regions_of_limited_size(position, least, most):
    tree = Tree.split(position, 50)
    tree.check()
    sizes = np.bincount(tree.regions_of(position), minlength=tree.count)
    assert tree.count >= least and sizes.min() > 0 and sizes.max() <= most
    again = Tree.split(position, 50)
    np.testing.assert_array_equal(again.plane, tree.plane)


def test_regions_learn_as_well_as_one_fit(probes, model):
    assert model.content.tree.count == 8 and model.method == "gaussians"
    assert model.content.count + model.content.counts[:, 1].sum() == 28
    assert "8 regions" in model.choice
    whole = evaluate(compress(probes, SMALL, region=301, method="gaussians"), probes)
    assert evaluate(model, probes).relative_error < 1.1 * whole.relative_error


def test_light_is_continuous_where_regions_meet():
    position = np.random.default_rng(0).random((400, 3)) * [4.0, 1.0, 2.0]
    values = _smooth(position)
    model = compress(from_arrays(position, values), SMALL, steps=400, region=100)
    content, decoder = model.content, model.decoder()
    place = np.random.default_rng(1).random((400, 3)) * [4.0, 1.0, 2.0]
    error = np.sqrt(np.square(decoder.decode(place) - _smooth(place)).mean())
    # Points on both sides of the plane that is nearest along its axis.
    node = np.abs(place[:, content.tree.axis] - content.tree.plane).argmin(1)
    sides = np.stack([place, place])
    for side, factor in enumerate((1 - 1e-9, 1 + 1e-9)):
        sides[side, np.arange(400), content.tree.axis[node]] = content.tree.plane[node] * factor
    low, high = (content.tree.regions_of(side) for side in sides)
    crossed = low != high
    assert crossed.sum() > 100
    jump = decoder.decode(sides[0][crossed]) - decoder.decode(sides[1][crossed])
    assert np.sqrt(np.square(jump).mean()) < 2.0 * error < 0.02


def test_a_file_is_read_region_by_region(device, model, path, damaged):
    loaded = wlm.load(path, "probe")
    position = loaded.stored_positions()
    decoder = loaded.decoder(device, position=position)
    values = model.decoder(device, position=position).decode_probes()
    np.testing.assert_array_equal(decoder.decode_probes(), values)
    assert not values[~model.live].any() and loaded.file_bytes() == path.stat().st_size
    sizes = [model.content.region(number).content.nbytes for number in range(8)]
    assert loaded.content.nbytes == model.content.nbytes == sum(sizes)
    owner, x = loaded.content.place(position)
    for number in range(8):
        alone = loaded.content.region(number)
        np.testing.assert_array_equal(alone.normalise(position[owner == number]), x[owner == number])
        here = (owner == number) & loaded.live
        np.testing.assert_array_equal(alone.decoder(device).decode(position[here]), values[here])
    broken = wlm.load(damaged, "probe").decoder(device, position=position)
    np.testing.assert_array_equal(broken.decode(position[owner == 0]), decoder.decode(position[owner == 0]))
    with pytest.raises(WlmError, match=rf"^{damaged}: region 7: the file is damaged here[^\n]*$"):
        broken.decode_probes()
    assert "region 7" in error_of(wlm.load(damaged, "probe").check)


def test_many_points_are_decoded_as_few_are(device, model):
    position = model.stored_positions()
    for each in (model, model.content.region(0)):
        decoder = each.decoder(device)
        many = decoder.decode(np.tile(position, (113, 1)))  # more than 1,056 blocks of 32 points
        np.testing.assert_allclose(many, np.tile(decoder.decode(position), (113, 1)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("change", ["child", "boxes", "counts", "packed"])
def test_contradictions_are_refused(model, change, tmp_path):
    content = model.content
    if change == "child":
        content = dataclasses.replace(content, tree=dataclasses.replace(content.tree, child=content.tree.child * 0))
    elif change == "packed":
        content = dataclasses.replace(content, packed=content.packed[:-1])
    else:
        content = dataclasses.replace(content, **{change: getattr(content, change) + 1})
    with pytest.raises(WlmError, match=r"not written: [^\n]*expected [^\n]*$"):
        dataclasses.replace(model, content=content).save(tmp_path / "a.wlm")
    assert not (tmp_path / "a.wlm").exists()


def test_memory_is_limited_to_what_is_needed(model):
    position = model.stored_positions()
    decoder = model.decoder(position=position, most_bytes=1)
    owner, _ = model.content.place(position)
    whole = model.decoder(position=position).decode(position)
    for number in (2, 5, 5):
        np.testing.assert_array_equal(decoder.decode(position[owner == number]), whole[owner == number])
        assert decoder.loaded == (number,)
    np.testing.assert_array_equal(decoder.decode(position), whole)
    assert decoder.decode(position[:0]).shape == (0, 27)


def test_a_volume_loads_the_regions_that_it_touches(device, model):
    position = model.stored_positions()
    decoder = model.decoder(device, position=position, most_bytes=1)
    light = decoder.light(position)
    settings = {"live": model.live, "block": 0.5, "side": 4, "ratios": (1, 2), "budget": 16}
    volume = Volume(position, light, **settings)
    first = volume.update(position[0])
    assert (first.updated, first.cached) == (0, 0) and first.left == first.queued > 0
    settle(volume, position[0])
    assert 1 <= len(decoder.loaded) < 8
    decoded = model.decoder(device, position=position).decode_probes()
    other = Volume(position, StoredLight(decoded, device), **settings)
    for viewpoint in (position[0], position[-1], position[0]):
        settle(volume, viewpoint)
        settle(other, viewpoint)
        ours, theirs = volume.read(position), other.read(position)
        np.testing.assert_array_equal(ours.level, theirs.level)
        np.testing.assert_allclose(ours.values, theirs.values, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(at_probes(light, volume.numbers), at_probes(other.light, volume.numbers))


def test_rows_are_given_back_while_light_is_coming(model):
    position = model.stored_positions()
    decoder = model.decoder(position=position)
    volume = Volume(position, decoder.light(position), live=model.live, block=0.5, side=4, budget=16, rows=32)
    for viewpoint in (position[0], position[150]):
        settle(volume, viewpoint)
        pages = volume.state().pages
        taken = pages[pages >= 0]
        assert len(taken) == len(set(taken)) > 0
        assert (volume.read(position).level >= 0).any()


def test_a_damaged_region_is_dark_in_a_volume_and_told_once(damaged):
    model = wlm.load(damaged, "probe")
    position = model.stored_positions()
    owner, _ = model.content.place(position)
    volume = Volume(position, model.decoder(position=position).light(position), live=model.live, block=0.5)
    assert "region 7: the file is damaged" in error_of(settle, volume, position[owner == 7][0])
    settle(volume, position[owner == 7][0])
    level = volume.read(position).level
    assert (level[(owner == 7) & model.live] >= 0).any()


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_an_interrupted_fit_continues_with_its_regions(probes, model, tmp_path, monkeypatch, at_once):
    monkeypatch.setattr(fit, "_AT_ONCE", {"cpu": at_once})
    monkeypatch.setattr(Meter, "due", lambda meter, done: meter._progress is not None)
    output = tmp_path / "a.wlm"

    def stop(progress):
        if progress.done > 60 * at_once + 30:
            raise KeyboardInterrupt

    settings = {"positions": True}
    with pytest.raises(KeyboardInterrupt):
        checkpoint = open_checkpoint(output, probes, SMALL, every=0)
        compress(probes, SMALL, progress=stop, checkpoint=checkpoint, **settings)
    reports = []
    checkpoint = open_checkpoint(output, probes, SMALL, resume=True)
    if at_once > 1:
        del checkpoint._running[1_000_000 + at_once]  # the first of the regions that were running
        with pytest.raises(WlmError, match=r"a.wlm.partial: state of batch \d+: part control: expected 0 steps"):
            compress(probes, SMALL, checkpoint=checkpoint, **settings)
    checkpoint = open_checkpoint(output, probes, SMALL, resume=True)
    again = compress(probes, SMALL, progress=lambda each: reports.append(each.done), checkpoint=checkpoint, **settings)
    assert again.content.packed == model.content.packed
    assert all(done > 60 * at_once for done in reports) and reports[-1] == 8 * 60


def test_hours_and_bytes_hold_for_all_regions(tmp_path):
    values = _smooth(CLOUD)
    day = from_arrays(CLOUD, np.stack([values.reshape(-1, 9, 3), 2 * values.reshape(-1, 9, 3)]), times=[6.0, 18.0])
    model = compress(day, SMALL, method="gaussians", max_bytes=60_000, steps=20)
    assert model.content.nbytes <= 60_000 and model.content.tree.count == 8
    model.save(tmp_path / "day.wlm")
    decoder = wlm.load(tmp_path / "day.wlm").decoder(position=CLOUD, most_bytes=1)
    for time in (6.0, 12.0):
        decoder.set_time(time)
        wanted = model.at(time).decoder().decode(CLOUD)
        np.testing.assert_allclose(decoder.decode(CLOUD), wanted, rtol=0, atol=0.02)
        assert model.at(time).content.nbytes < model.content.nbytes


def test_commands_and_exports(path, tmp_path):
    told = json.loads(CliRunner().invoke(app, ["info", str(path), "--json"]).output)
    assert told["regions"] == 8 and told["gaussians"] + told["dropped"] == 28
    model = wlm.load(path)
    export(model, tmp_path / "out")
    index = json.loads((tmp_path / "out/bundle.json").read_text())
    assert index["parts"] == [f"region-{number}" for number in range(8)] and index["shader"] is None
    assert (tmp_path / "out/region-7/bundle.json").exists()
    assert export(model, tmp_path / "grid", "three", cells=4)
    assert "which decodes one region, found 8" in error_of(probe_page, [path])
    position = model.stored_positions()
    assert "expected one region" in error_of(update_bundle, Volume(position, model.decoder().light(position)), model)
