"""Sets of many regions: one step for all, each decoded alone, and no border between them."""

import dataclasses

import numpy as np
import pytest
from builders.contract import FILES
from builders.probe_sets import synthetic

import wlm
from wlm.errors import WlmError
from wlm.formats import scratch
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.compact import DATA, HEAD
from wlm.probe import data, transform_fit
from wlm.probe.data import from_arrays
from wlm.probe.regions import RegionModel, Split, members
from wlm.probe.transform import Places

ASKED = {"region": 256, "target_psnr": 40.0}


@pytest.fixture(scope="module")
def probes():
    full = synthetic(900, dead=30)
    return from_arrays(full.position, full.values[:, :3], name="many")


@pytest.fixture(scope="module", params=[True, False], ids=["positions", "none"])
def stored(request, probes, tmp_path_factory):
    path = tmp_path_factory.mktemp("regions") / "a.wlm"
    model = wlm.probe.compress(probes, positions=request.param, **ASKED)
    assert model.save(path) == model.file_bytes() == path.stat().st_size
    return path


def test_a_kept_file_decodes_as_it_did():
    kept = np.load(FILES / "probe-regions.npz")["values"]
    values = wlm.load(FILES / "probe-regions.wlm").decoder().decode_probes()
    np.testing.assert_allclose(values, kept, rtol=0, atol=1e-6 * np.abs(kept).max())


def test_planes_part_places_evenly():
    code = np.random.default_rng(0).integers(0, 65536, (5000, 3)).astype(np.uint16)
    code[:700] = code[0]
    split = Split.of(code, 600)
    parts = members(split.labels(code), split.regions)
    assert split.is_whole() and split.regions == 9 and sum(map(len, parts)) == 5000
    assert max(len(part) for part in parts) <= 701 + 600
    for part in parts:
        inside = ((code >= code[part].min(0)) & (code <= code[part].max(0))).all(1)
        assert inside.sum() == len(part)
    assert Split.of(code[:700], 100).regions == 1


def test_a_file_comes_back_in_the_order_of_the_probes(stored, probes, tmp_path):
    model = wlm.load(stored)
    assert isinstance(model, RegionModel) and model.split.regions == 4
    model.save(tmp_path / "b.wlm")
    assert (tmp_path / "b.wlm").read_bytes() == stored.read_bytes()
    np.testing.assert_array_equal(model.dead, ~probes.live)
    decoder = model.decoder(position=None if model.has_positions else probes.position)
    values = decoder.decode_probes()
    assert 40.0 <= wlm.probe.evaluate(model, probes).psnr < 41.0
    assert not values[~probes.live].any()
    np.testing.assert_array_equal(values, model.decoder().decode_probes(probes.position.astype(np.float32)))
    if model.has_positions:
        np.testing.assert_allclose(model.stored_positions(), probes.position, atol=1e-4)
        assert model.has_probes_at(model.stored_positions()) and model.has_probes_at(probes.position)
        np.testing.assert_array_equal(model.decoder(position=model.stored_positions()).decode_probes(), values)
        plain = model.without_places()
        assert plain.file_bytes() < model.file_bytes() - 900
        np.testing.assert_array_equal(plain.decoder().decode_probes(probes.position), values)
    with pytest.raises(WlmError, match="expected the positions of its own 900 probes"):
        model.decoder().decode_probes(probes.position[::-1])


def test_stored_positions_next_to_a_plane_are_the_models_own(tmp_path):
    random = np.random.default_rng(0)
    position = random.random((300, 3)) * [8.0, 3.0, 6.0]
    # Within some codes of the plane, whichever probe it goes through.
    position[:200, 0] = 4.0 + random.random(200) * 1e-3
    probes = from_arrays(position, random.random((300, 3)).astype(np.float32) + 1.0, name="next to a plane")
    wlm.probe.compress(probes, positions=True, region=256, target_psnr=20.0).save(tmp_path / "a.wlm")
    model = wlm.load(tmp_path / "a.wlm")
    stored = model.stored_positions()
    assert (model.split.labels(Places.of(stored).code) != model.labels_of(None)).any()
    assert model.has_probes_at(stored) and model.has_probes_at(position) and not model.has_probes_at(stored[:-1])
    values = model.decoder().decode_probes()
    np.testing.assert_array_equal(model.decoder(position=stored).decode_probes(stored), values)
    np.testing.assert_array_equal(model.decoder().decode_probes(position), values)


def test_damage_is_not_taken_for_other_probes(stored, probes):
    model = wlm.load(stored)
    piece = model.pieces[1]
    model = dataclasses.replace(model, pieces=(model.pieces[0], piece._replace(data=piece.data ^ 1), *model.pieces[2:]))
    with pytest.raises(WlmError, match="a, region 1: damaged"):
        model.has_probes_at(probes.position)


def test_no_border_is_seen_between_regions(stored, probes):
    model = wlm.load(stored)
    given = None if model.has_positions else probes.position
    points = np.random.default_rng(0).random((300, 3)) * np.ptp(probes.position, 0) * 1.2 + probes.position.min(0)
    lazily = model.decoder(position=given, kept=1).decode(points)
    whole = model.decoder(position=given)
    placed = whole.points(points)
    whole.run(placed)
    scale = np.abs(lazily).max()
    np.testing.assert_allclose(lazily, placed.values(), rtol=0, atol=2e-3 * scale)
    assert np.abs(np.diff(lazily, axis=0)).max() > 0.1 * scale


def test_only_the_regions_that_are_asked_for_are_read(stored, probes):
    model = wlm.load(stored)
    broken = [piece._replace(data=piece.data[:-1]) for piece in model.pieces]
    for alone in range(4):
        pieces = [*broken[:alone], model.pieces[alone], *broken[alone + 1 :]]
        decoder = dataclasses.replace(model, pieces=tuple(pieces)).decoder(
            position=None if model.has_positions else probes.position
        )
        own = probes.live & (model.labels_of(probes.position) == alone)
        place, values = decoder.region(alone)
        np.testing.assert_allclose(place, probes.position[own], atol=1e-4)
        error = np.square(values - probes.values[own]).mean()
        assert error < np.ptp(probes.values) ** 2 * 1e-3
        with pytest.raises(WlmError, match=f"a, region {(alone + 1) % 4}: damaged"):
            decoder.region((alone + 1) % 4)


def test_what_is_asked_for_holds_for_the_whole_set(probes, monkeypatch):
    probes = from_arrays(probes.position[:600], probes.values[:600, :4])
    size = wlm.probe.compress(probes, **ASKED).file_bytes() // 2
    one = wlm.probe.compress(probes, region=256, max_bytes=size)
    assert 0.9 * size < one.file_bytes() <= size
    # In processes it is the same file.
    monkeypatch.setattr(transform_fit, "_ALONE", 1)
    monkeypatch.setattr(transform_fit, "cores", lambda: 2)
    two = wlm.probe.compress(probes, region=256, max_bytes=size)
    assert [bytes(piece.data) for piece in two.pieces] == [bytes(piece.data) for piece in one.pieces]


def test_a_head_that_is_signed_but_wrong_is_one_line(stored, tmp_path):
    artifact = read_artifact(stored)
    head, refused = artifact.tensors[HEAD], 0
    for at in range(0, len(head), 3):
        for changed in (np.where(np.arange(len(head)) == at, head ^ 0x41, head), head[:at]):
            parts = {HEAD: changed.astype(np.uint8), DATA: artifact.tensors[DATA]}
            write_artifact(tmp_path / "a.wlm", "probe", {}, parts, "")
            try:
                model = wlm.load(tmp_path / "a.wlm")
                if model.has_positions:
                    assert np.isfinite(model.stored_values).all()
            except WlmError as error:
                refused += 1
                assert "\n" not in str(error)
    assert refused > len(head) // 3


def test_a_set_that_lies_on_the_disk_is_the_same(tmp_path, monkeypatch):
    values = np.random.default_rng(0).random((300, 9, 3)).astype(np.float32)
    values[5], values[7, 2] = 0.0, np.nan
    np.savez_compressed(tmp_path / "a.npz", position=np.random.default_rng(1).random((300, 3)), sh=values)
    whole = wlm.probe.load(tmp_path / "a.npz")
    monkeypatch.setattr(scratch, "IN_MEMORY", 1 << 10)
    monkeypatch.setattr(data, "_ROWS", 64)
    pieces = wlm.probe.load(tmp_path / "a.npz")
    assert (pieces.source, pieces.warnings) == (whole.source, whole.warnings)
    np.testing.assert_array_equal(pieces.values, whole.values)
