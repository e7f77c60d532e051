"""The noise of a set's own light, told from probes that are next to each other."""

import numpy as np
import pytest

import wlm
from wlm.probe.data import from_arrays
from wlm.probe.noise import noise_psnr

RANDOM = np.random.default_rng(0)
PLACE = RANDOM.random((8000, 3)) * [8.0, 0.0, 8.0]  # on a floor: close pairs are many
SMOOTH = 2.0 + np.sin(PLACE @ RANDOM.normal(size=(3, 24)) * 0.3 + RANDOM.random(24) * 6)
EDGED = SMOOTH * np.where(PLACE[:, :1] + PLACE[:, 2:] > 8.0, 1.0, 0.7)


def noisy(light, psnr, place=PLACE, dead=0):
    noise = np.random.default_rng(1).normal(size=light.shape) * np.ptp(light) * 10 ** (-psnr / 20)
    values = (light + noise).astype(np.float32)
    values[:dead] = 0.0
    return from_arrays(place, values, name="noisy")


@pytest.mark.parametrize("light", [SMOOTH, EDGED], ids=["smooth", "edged"])
@pytest.mark.parametrize("psnr", [30, 38])
def test_noise_is_told_from_light(light, psnr):
    assert noise_psnr(noisy(light, psnr)) == pytest.approx(psnr, abs=2.0)


def test_dead_probes_are_exact_and_count():
    live = noise_psnr(noisy(SMOOTH, 30))
    place, values = np.concatenate([PLACE, PLACE + 100.0]), noisy(SMOOTH, 30).values
    half = noise_psnr(from_arrays(place, np.concatenate([values, 0 * values]), name="half"))
    # The range begins at the dead ones' zeros.
    more = 10 * np.log10(2) + 20 * np.log10(values.max() / np.ptp(values))
    assert half == pytest.approx(live + more, abs=0.05)


def test_light_without_noise_has_none_and_a_lattice_tells_nothing():
    for light in (SMOOTH, EDGED):
        assert noise_psnr(from_arrays(PLACE, light.astype(np.float32), name="clean")) is None
    lattice = np.stack(np.meshgrid(*[np.arange(12.0)] * 3), -1).reshape(-1, 3)
    assert noise_psnr(noisy(2.0 + np.sin(lattice @ RANDOM.normal(size=(3, 3))), 30, lattice)) is None
    same = np.zeros((300, 3))
    assert noise_psnr(from_arrays(same, RANDOM.random((300, 3)).astype(np.float32), name="one place")) is None


def test_no_byte_is_spent_on_noise_unless_asked_to():
    probes = noisy(SMOOTH[:, :6], 43)
    report = wlm.probe.evaluate(wlm.probe.compress(probes), probes)
    assert 41.0 < report.noise_psnr < 45.0
    assert report.noise_psnr <= report.psnr < report.noise_psnr + 0.2
    asked = wlm.probe.compress(probes, target_psnr=48)
    assert wlm.probe.evaluate(asked, probes).psnr >= 48.0 and asked.file_bytes() > 1.2 * report.bytes


def test_each_hour_ends_at_its_own_noise():
    noise, clean = noisy(SMOOTH[:, :6], 43), from_arrays(PLACE, SMOOTH[:, :6].astype(np.float32), name="noisy")
    day = wlm.probe.compress_day([noise, clean], (9, 12))
    first, second = wlm.probe.evaluate_day(day, [noise, clean])
    assert first.noise_psnr <= first.psnr < first.noise_psnr + 0.3 and second.psnr >= 50.0
