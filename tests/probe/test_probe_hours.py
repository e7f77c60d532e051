"""Probes at several hours of the day: input, fit, file, decoding at any time, scores and export."""

import dataclasses

import numpy as np
import pytest
from builders.checks import error_of
from builders.probe_sets import synthetic
from builders.running import call, fails
from reference.components import decode as reference_decode

import wlm
from benchmarks.probe_exact import decode64
from wlm.probe import Profile, compress, evaluate, from_arrays, load, open_checkpoint
from wlm.probe.hours import hour_factors
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.walk import settle

TIMES = (2.0, 5.0, 6.5, 9.0, 12.0, 15.0, 17.0, 18.5, 21.0)
TINY = Profile(name="tiny", method="gaussians", ratio=0.1, latent=1, hidden=8, steps=60)


@pytest.fixture(scope="module")
def day():
    """150 probes of three numbers at nine hours, by a sky, a sun and at night a lamp; five are dead, and one is dark at
    the first hour."""
    room = synthetic(150, dead=5)
    ambient, (x, y, _) = room.values[:, :3].astype(np.float64), room.position.T[..., None]
    height = np.sin((np.array(TIMES) - 6.0) / 12.0 * np.pi)[:, None, None]
    values = np.maximum(height, 0.05) * ambient * (1.0 + y * np.abs(height)) + (height < 0) * 0.02 * x * ambient
    values[0, 77] = 0.0
    return from_arrays(room.position, values, times=TIMES, name="day")


@pytest.fixture(scope="module", params=["gaussians", "pca"])
def model(request, day, tmp_path_factory):
    """The set compressed, saved and read."""
    path = tmp_path_factory.mktemp("day") / "day.wlm"
    compress(day, TINY if request.param == "gaussians" else "pca", positions=True).save(path)
    return wlm.load(path)


def test_hours_are_read_from_the_names_of_arrays(day, tmp_path):
    path, hours = tmp_path / "a.npz", day.values.reshape(150, 9, 3)
    arrays = {f"sh_{time:05.2f}": hours[:, i, None] for i, time in reversed(list(enumerate(TIMES)))}
    np.savez(path, position=day.position, **arrays)
    every = load(path)
    np.testing.assert_array_equal(every.times, TIMES)
    np.testing.assert_array_equal(every.values, day.values)
    assert every.source == day.source and (every.outputs, every.probes) == (3, 150)
    assert every.live.sum() == 145 and every.live[77] and not every.at(2.0).live[77]
    two = load(path, key=["21.00", "sh_09.00"])
    np.testing.assert_array_equal(two.times, [9, 21])
    np.testing.assert_array_equal(two.values.reshape(150, 2, 3), hours[:, [3, 8]])
    np.testing.assert_array_equal(load(path, key="09.00").values, hours[:, 3])
    np.savez(path, position=day.position, sh_9h=hours[:, 0], sh_noon=hours[:, 1])
    assert "choose one by its key: sh_9h, sh_noon" in error_of(load, path)
    np.savez(path, position=day.position, sh_0h=hours[:, 0], sh_24h=hours[:, 1])
    assert "expected different hours of the day, 0 to 24, got 0, 24" in error_of(load, path)
    np.savez(path, position=day.position, sh_9h=hours[:, 0], sh_12h=hours[:, :2])
    assert "expected one shape at all hours" in error_of(load, path)


def test_a_probe_that_is_broken_at_one_hour_is_dead(day):
    values = day.values.reshape(150, 9, 3).swapaxes(0, 1).copy()
    values[4, 7, 1] = np.nan
    broken = from_arrays(day.position, values, times=TIMES)
    assert broken.live.sum() == 144 and not broken.values[7].any() and "1 probe with a NaN" in broken.warnings[0]
    assert "expected an array for each of 8 hours, got 9" in error_of(
        lambda: from_arrays(day.position, values, times=TIMES[:8])
    )


@pytest.mark.parametrize(
    ("time", "expected"),
    [(9.0, {3: 1.0}), (13.0, {4: 2 / 3, 5: 1 / 3}), (23.5, {8: 0.5, 0: 0.5}), (25.0, {8: 0.2, 0: 0.8})],
)
def test_light_between_hours_is_linear_and_periodic(day, time, expected):
    wanted = np.array([expected.get(i, 0.0) for i in range(9)])
    np.testing.assert_allclose(hour_factors("", day.times, time), wanted, atol=1e-12)
    mixed = np.einsum("ntd,t->nd", day.values.reshape(150, 9, 3).astype(np.float64), wanted)
    np.testing.assert_allclose(day.at(time).values, mixed, rtol=1e-5, atol=1e-6)
    assert "expected --time, one of the day, for light of the hours 2, 5, 6.5, 9" in error_of(day.at)
    assert "time: expected a finite number, got nan" in error_of(day.at, np.nan)


def test_decoding_at_any_time_is_the_mix_of_the_hours(day, model, device):
    decoder = model.decoder(device)

    def exact(factors):
        content = model.content
        if model.method == "gaussians":
            *shared, last = content.layers()
            hours = last.reshape(len(last), 9, 4).astype(np.float64)
            net = np.concatenate([layer.ravel() for layer in (*shared, np.einsum("t,rtd->rd", factors, hours))])
            one = dataclasses.replace(model.at(2.0), content=dataclasses.replace(content, hours=1, net=net))
            return decode64(one, model.stored_positions()) * model.live[:, None]
        basis = content.basis if len(content.basis) else np.eye(content.count)[None]
        basis = np.einsum("t,cktd->ckd", factors * model.scales, basis.reshape(*basis.shape[:2], 9, 3).astype(float))
        values = np.zeros((150, 3))
        values[model.live] = reference_decode(content.cluster, content.code, content.bounds, basis, 1.0, 3)
        return values

    largest = max(np.abs(exact(row)).max() for row in np.eye(9))
    for time in (2.0, 13.0, 0.0, 21.0 + 24.0, 18.0):
        decoder.set_time(time)
        wanted = exact(hour_factors("", model.times, time))
        # Components and the model of one time are rounded to half floats.
        close = 2e-5 if model.method == "gaussians" else 2e-3
        np.testing.assert_allclose(decoder.decode_probes(), wanted, rtol=0, atol=close * largest)
        one = model.at(time).decoder().decode_probes()
        np.testing.assert_allclose(one, wanted, rtol=0, atol=1e-2 * largest)
    assert "time: expected a finite number" in error_of(decoder.set_time, np.inf)


def test_a_volume_follows_the_hour(model, device):
    own = model.stored_positions()

    def made(time):
        decoder = model.decoder(device)
        decoder.set_time(time)
        volume = Volume(own, decoder.light(own), live=model.live, tolerance=0.0)
        settle(volume, own.mean(0))
        return decoder, volume

    decoder, volume = made(2.0)
    before = volume.read(own).values
    decoder.set_time(13.0 + 24.0)
    np.testing.assert_array_equal(volume.read(own).values, before)
    settle(volume, own.mean(0))
    wanted = made(13.0)[1].read(own)
    np.testing.assert_allclose(volume.read(own).values, wanted.values, atol=1e-5 * np.abs(wanted.values).max())
    assert np.abs(wanted.values - before).max() > 0.1 * np.abs(before).max() and decoder.time == 13.0


def test_numbers_without_magnitudes_are_mixed_linearly(model):
    if model.method == "gaussians":
        content = dataclasses.replace(model.content, relative=False, outputs=4)
        factors, scales = np.linspace(0.0, 0.25, 9), np.linspace(1.0, 0.1, 9)
        hours = content.layers()[2].reshape(-1, 9, 4).astype(np.float64)
        wanted, mixed = np.einsum("t,rtd->rd", factors * scales, hours), content.at(factors, scales)
        assert mixed.columns == 4
        np.testing.assert_allclose(mixed.layers()[2], wanted, rtol=1e-3, atol=1e-6)


def test_scores_are_by_hour(day, model):
    report = evaluate(model, day)
    decoder = model.decoder()
    for i, hour in enumerate(report.hours):
        decoder.set_time(TIMES[i])
        wanted = day.values[:, 3 * i : 3 * i + 3].astype(np.float64)
        error = np.mean(np.square(decoder.decode_probes() - wanted))
        assert hour["time"] == TIMES[i]
        assert hour["psnr"] == pytest.approx(10 * np.log10(np.ptp(wanted) ** 2 / error), abs=1e-3)
        # Each hour is fitted with the precision of its own light, the dark ones too.
        assert hour["relative_error"] < (0.08 if model.method == "pca" else 0.9)
    assert report.psnr == min(hour["psnr"] for hour in report.hours)
    assert report.gpu_bytes == model.content.nbytes
    assert "has the hours one, but 2, 5, 6.5, 9" in error_of(evaluate, model, day.at(9.0))
    alone = evaluate(model.at(9.0), day.at(9.0), file_bytes=1)
    assert alone.psnr == pytest.approx(report.hours[3]["psnr"], abs=0.05) and not alone.hours


def test_a_set_is_smaller_than_its_hours(day):
    together = compress(day, "pca")
    alone = [compress(day.at(time), "pca") for time in TIMES]
    assert together.content.nbytes < 0.6 * sum(one.content.nbytes for one in alone)
    assert together.file_bytes() < 0.6 * sum(one.file_bytes() for one in alone)


def test_a_target_is_that_of_every_hour(day):
    """With 2% of light over the day alone, a fit would leave the dark hours with more error."""
    light = day.values.reshape(150, 9, 3).swapaxes(0, 1).copy()
    light[7] *= np.geomspace(0.02, 1.0, 150)[:, None]  # lamps that reach some probes
    lamps = from_arrays(day.position, light, times=TIMES)
    plain, found = compress(lamps, "pca"), compress(lamps, TINY.model_copy(update={"method": "auto", "target": 0.02}))

    def error(model):
        return np.sqrt(np.mean([hour["relative_error"] ** 2 for hour in evaluate(model, lamps).hours]))

    assert found.method == "pca" and error(found) <= 0.02 < error(plain)


def test_the_bundle_has_the_words_of_all_hours(model):
    made = model.bundle()
    document, place = made.document, made.document["hour"]
    assert document["times"] == list(TIMES)
    assert sum(each.nbytes for name, each in made.buffers.items() if name != "positions") == model.content.nbytes
    words = made.buffers["hours"].reshape(9, place["words"]).view("<f2").astype(np.float32)
    shown = made.buffers[place["buffer"]].copy()
    span = slice(place["first_word"], place["first_word"] + place["words"])
    np.testing.assert_array_equal(shown[span], made.buffers["hours"][: place["words"]])
    # As an engine mixes them.
    mixed, half = (0.5 * (words[0] + words[1])).astype("<f2"), model.at(3.5)
    wanted = half.bundle().buffers[place["buffer"]]
    np.testing.assert_allclose(mixed, wanted[span].view("<f2"), rtol=2e-3, atol=1e-5)
    shown[span] = wanted[span]
    np.testing.assert_array_equal(shown, wanted)
    scale = np.abs(made.reference["values"]).max()
    np.testing.assert_allclose(half.bundle().reference["values"], made.reference["mixed"], atol=4e-3 * scale)


def test_an_interrupted_fit_resumes_exactly(day, tmp_path):
    whole = compress(day, TINY)

    def stop(progress):
        if progress.stage == "fit" and progress.done >= 20:
            raise KeyboardInterrupt

    output = tmp_path / "a.wlm"
    with pytest.raises(KeyboardInterrupt):
        compress(day, TINY, progress=stop, checkpoint=open_checkpoint(output, day, TINY, every=0))
    checkpoint = open_checkpoint(output, day, TINY, resume=True)
    resumed = compress(day, TINY, checkpoint=checkpoint)
    assert checkpoint.resumed
    for name, part in whole.content.parts().items():
        np.testing.assert_array_equal(resumed.content.parts()[name], part)


def test_the_commands_take_a_time(day, model, tmp_path):
    file, probes, out = tmp_path / "day.wlm", tmp_path / "day.npz", tmp_path / "out.npz"
    hours = {f"sh_{time:g}h": day.values[:, 3 * i : 3 * i + 3] for i, time in enumerate(TIMES)}
    np.savez(probes, position=day.position, **hours)
    if model.method == "pca":
        text = call("compress", probes, "-o", file, "--profile", "pca", "--positions")
        assert "2, 5, 6.5, 9, 12, 15, 17, 18.5, 21" in text
    else:
        model.save(file)
    assert "expected --time" in fails("decode", file, "-o", out)
    call("decode", file, "-o", out, "--time", 13)
    decoder = model.decoder()
    decoder.set_time(13.0)
    light = decoder.decode_probes()
    np.testing.assert_allclose(load(out).values, light, rtol=0, atol=4e-3 * light.max())
    text = call("evaluate", file, probes)
    assert "at 18.5 h" in text and "worst hour" in text
    assert "but 2, 5" in fails("evaluate", file, probes, "--key", "9h")
    assert "expected --time" in fails("evaluate", file, probes, "--volume")
    assert "expected --time" in fails("export", file, "-o", tmp_path / "kit", "--engine", "unity")
    call("export", file, "-o", tmp_path / "kit", "--engine", "unity", "--time", 9)


def test_one_hour_is_the_trivial_case(day):
    one = from_arrays(day.position, day.values.reshape(150, 9, 3)[None, :, 4], times=[12.0])
    assert not len(one.times) and one.source == from_arrays(day.position, day.values[:, 12:15]).source
    fitted = compress(one, "pca")
    fitted.decoder().set_time(3.0)
    assert fitted.at(3.0) is fitted and not len(fitted.times)
    assert dataclasses.replace(fitted).content.hours == 1
