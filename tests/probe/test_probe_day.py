"""Several hours of probes in one file: what each hour comes back as, what lies between, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from builders.probe_sets import synthetic

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.compact import BODY
from wlm.probe import compress_day, evaluate_day, load_hours, save_probes
from wlm.probe.data import from_arrays
from wlm.probe.day import DayModel
from wlm.probe.fields import pack_own
from wlm.probe.transform import SOURCE, Places

TIMES = (9.0, 12.0, 21.0)
PROBES = 70


def scene(coefficients=4, probes=PROBES):
    """Three hours of `probes` probes: two alike, and one of other light with its own dead probes."""
    base = synthetic(probes, coefficients=coefficients, dead=3)
    random = np.random.default_rng(1)
    morning = base.values
    noon = morning * 1.5 + random.normal(size=morning.shape).astype(np.float32) * 0.002 * base.live[:, None]
    night = random.normal(size=morning.shape).astype(np.float32) * 0.1
    night[-4:] = 0.0
    return [from_arrays(base.position, values, name="room") for values in (morning, noon, night)]


@pytest.fixture(scope="module")
def sets():
    return scene()


@pytest.fixture(scope="module")
def model(sets):
    return compress_day(sets, TIMES, target_psnr=45.0, positions=True)


def psnr(model, time, probes):
    error = model.at(time).values(Places.of(probes.position)) - probes.values
    return 10.0 * np.log10(np.ptp(probes.values) ** 2 / np.square(error).mean())


def test_every_hour_reaches_its_psnr_and_comes_back_from_a_file(sets, model, tmp_path):
    assert all(44.99 <= psnr(model, time, probes) < 46.5 for time, probes in zip(TIMES, sets, strict=True))
    assert sorted(len(hour.told.references) for hour in model.hours) == [0, 0, 1]
    model.save(tmp_path / "day.wlm")
    read = wlm.load(tmp_path / "day.wlm")
    assert isinstance(read, DayModel) and read.times == TIMES and read.time == 9.0
    for time, probes in zip(TIMES, sets, strict=True):
        values = read.at(time).decoder().decode_probes(probes.position)
        np.testing.assert_array_equal(values, model.at(time).stored_values)
        assert (values[~probes.live] == 0).all()
        np.testing.assert_array_equal(np.flatnonzero(read.at(time).dead), np.flatnonzero(~probes.live))


def test_what_one_hour_tells_of_another_is_not_stored_again(sets, model):
    alone = [wlm.probe.compress(probes, target_psnr=45.0) for probes in sets]
    sizes = [one.file_bytes() for one in alone]
    # One of the two that are alike, and what the file says of three hours.
    assert model.without_places().file_bytes() < sum(sizes) - 0.6 * sizes[0]
    twice = compress_day([sets[0], sets[0]], (6.0, 5.0), target_psnr=45.0)
    assert twice.file_bytes() < sizes[0] + 80


def test_light_between_hours_is_mixed_round_the_clock(sets, model):
    morning, noon, night = (model.at(time).stored_values for time in TIMES)
    np.testing.assert_allclose(model.at(11.0).stored_values, morning / 3 + noon * 2 / 3, atol=1e-6)
    np.testing.assert_allclose(model.at(1.0).stored_values, night * 2 / 3 + morning / 3, atol=1e-6)
    np.testing.assert_array_equal(model.at(-15.0).stored_values, morning)
    np.testing.assert_array_equal(model.at(24.0 + 21.0).stored_values, night)
    assert np.abs(model.at(9.0 + 1e-9).stored_values - morning).max() < 1e-6
    # Dead at both alone.
    assert model.at(15.0).dead.sum() == (~sets[1].live & ~sets[2].live).sum()
    with pytest.raises(WlmError, match="time: expected a finite number"):
        model.at(np.nan)


def test_hours_stand_in_any_order(sets, model):
    other = compress_day(sets[::-1], TIMES[::-1], target_psnr=45.0, positions=True)
    assert other.source == model.source and other.times == TIMES
    np.testing.assert_array_equal(other.at(10.0).stored_values, model.at(10.0).stored_values)


def test_a_size_is_kept(sets):
    made = compress_day(sets, TIMES, max_bytes=1400)
    assert 1270 < made.file_bytes() <= 1400
    # All hours have one step, so about one error.
    scores = [psnr(made, time, probes) for time, probes in zip(TIMES, sets, strict=True)]
    assert max(scores) - min(scores) < 4.0
    with pytest.raises(WlmError, match=r"--max-bytes: expected at least \d+ for room, got 40"):
        compress_day(sets[:1], TIMES[:1], max_bytes=40)


def test_hours_are_scored_and_held_out(sets, model):
    reports = evaluate_day(model, sets, hold_out=True)
    assert all(report.psnr >= 44.9 for report in reports)
    assert sum(report.bytes for report in reports) == pytest.approx(model.file_bytes(), abs=3)
    first, _, night = (report.held_out for report in reports)
    assert first.probes == 12 and first.psnr > first.kriging - 2.0 and night.psnr < 25.0
    assert first.bytes <= 0.8 * model.without_places().file_bytes()
    with pytest.raises(WlmError, match="expected one hour"):
        wlm.probe.evaluate(model, sets[0], hold_out=True)


@pytest.mark.parametrize(
    "case",
    [
        "one hour",
        "one probe",
        "bright",
        "nan",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("all alike", "wide")),
    ],
)
def test_hard_cases(case):
    sets, times = scene(25 if case == "wide" else 4, 24), TIMES
    if case == "one hour":
        sets, times = sets[:1], (0.0,)
    if case == "one probe":
        sets = [from_arrays(probes.position[:1], probes.values[:1] + 1.0) for probes in sets]
    if case == "bright":
        values = sets[1].values.copy()
        values[7, :3] = 1e4
        sets[1] = from_arrays(sets[1].position, values)
    if case == "nan":
        values = sets[0].values.copy()
        values[9, 4] = np.nan
        sets[0] = from_arrays(sets[0].position, values)
    if case == "all alike":
        sets[1] = from_arrays(sets[1].position, np.ones_like(sets[1].values))
    model = compress_day(sets, times, target_psnr=50.0)
    for time, probes in zip(times, sets, strict=True):
        peak = np.ptp(probes.values) or 1.0
        error = model.at(time).values(Places.of(probes.position)) - probes.values
        assert 10.0 * np.log10(peak**2 / max(np.square(error).mean(), 1e-30)) >= 49.9
        assert (error[~probes.live] == 0).all()
    assert not any(hour.told.references for hour in model.hours) or case != "wide"


def test_hours_are_read_from_one_file_or_several(sets, tmp_path):
    arrays = {f"sh_{time:05.2f}": probes.values for time, probes in zip(TIMES, sets, strict=True)}
    np.savez(tmp_path / "day.npz", position=sets[0].position, **arrays)
    for time, probes in zip(TIMES, sets, strict=True):
        save_probes(tmp_path / f"{time:g}.npz", probes.position, probes.values)
    joint = load_hours([tmp_path / "day.npz"], TIMES)
    parted = load_hours([tmp_path / f"{time:g}.npz" for time in TIMES], TIMES)
    assert [a.source for a in joint] == [b.source for b in parted] == [probes.source for probes in sets]
    with pytest.raises(WlmError, match="expected values named 10.00"):
        load_hours([tmp_path / "day.npz"], (9.0, 10.0))
    moved = from_arrays(sets[0].position + 1.0, sets[0].values, name="moved")
    few = from_arrays(sets[0].position, sets[0].values[:, :3], name="few")
    for wrong, times, line in (
        (sets, (9.0, 9.0, 12.0), "each hour once, got 9 twice"),
        (sets, (9.0, 12.0), "one for each of 3 sets, got 2"),
        (sets, (9.0, 12.0, 24.0), "from 0 to below 24, got 24"),
        (sets, (9.0, 12.0, np.inf), "from 0 to below 24, got inf"),
        ([*sets[:2], moved], TIMES, "moved, 21 h: expected the positions of room"),
        ([*sets[:2], few], TIMES, "few, 21 h: expected 12 numbers a probe, found 3"),
    ):
        with pytest.raises(WlmError, match=line):
            compress_day(wrong, times)
    with pytest.raises(WlmError, match="expected a profile of the method transform"):
        compress_day(sets, TIMES, "small")


def test_a_damaged_body_is_refused(model, tmp_path):
    model.save(tmp_path / "day.wlm")
    body = read_artifact(tmp_path / "day.wlm").tensors[BODY]
    # Flags, N, D, source and T come first, then the times and the places.
    times = SOURCE // 2 + 5
    hour = times + 8 * len(TIMES) + len(pack_own(np.zeros(0, bool), model.places)[1])

    def refused(line, *changes, end=None, more=b""):
        data = bytearray(body[:end].tobytes() + more)
        for at, content in changes:
            data[at : at + len(content)] = content
        write_artifact(tmp_path / "bad.wlm", "probe", {}, {BODY: np.frombuffer(bytes(data), np.uint8)}, "")
        with pytest.raises(WlmError, match=line):
            wlm.load(tmp_path / "bad.wlm")

    refused("part body: expected [0-9]+ bytes at byte [0-9]+, found fewer", end=-9)
    refused("part hours: expected [0-9]+ bytes", more=b"123456789")
    refused("expected known flags", (0, bytes([body[0] | 1])))
    refused("1 to 255 hours", (times - 1, b"\0"))
    refused("increasing times of day", (times, np.array([9.0, 9.0]).tobytes()))
    refused("increasing times of day", (times, np.array([np.nan]).tobytes()))
    refused("each hour once", (hour, bytes([3])))
    refused("each hour once", (hour, bytes([model.hours[0].number, 1, model.hours[0].number])))
    refused("positive gain", (hour + 2, np.array([-1.0], "<f4").tobytes()))
    refused("expected known flags", (hour + 7, bytes([body[hour + 7] | 4])))
    refused("hour [0-9]+: ", (len(body) - 9, bytes(9)))


def test_more_probes_than_a_region_are_refused():
    live = max(int(probes.live.sum()) for probes in scene(4, 300))
    with pytest.raises(WlmError, match=f"--region: expected at least {live}: several hours are one region, got 256"):
        compress_day(scene(4, 300), TIMES, region=256)


def test_a_file_of_before_reads_as_it_did():
    files = Path(__file__).resolve().parents[1] / "files"
    model = wlm.load(files / "probe-day.wlm")
    with np.load(files / "probe-day.npz") as before:
        assert len(before.files) == 4
        for name in before.files:
            values = model.at(float(name.removeprefix("sh_"))).stored_values
            np.testing.assert_allclose(values, before[name], atol=1e-5)
