"""The plain torch peer fits the same thing: its loss falls, and one seed gives one result."""

import numpy as np

from wlm.baselines.lightmap_torch import PlainFit
from wlm.lightmap.data import from_arrays
from wlm.lightmap.fit import dynamic_targets
from wlm.lightmap.model import Profile, TimeAxis, encode_time

HOURS = [0.0, 6.0, 12.0, 18.0]


def losses(steps: int, seed: int) -> np.ndarray:
    x = np.linspace(0.0, 1.0, 128)
    # A bright band that moves over the tile during the day.
    frames = [np.exp(-40.0 * (x - hour / 24.0) ** 2)[None, :, None] + 0.1 * x[:, None, None] for hour in HOURS]
    lightmaps = from_arrays(
        np.stack([np.repeat(f, 3, 2) + 0.05 for f in frames]).astype(np.float32), HOURS, period=24.0
    )
    profile = Profile(name="tiny", hidden=8, uvt_resolution=8, uvt_slices=4, metric_weight=0.0)
    targets = dynamic_targets(lightmaps, profile)
    tau, encoding = encode_time(TimeAxis(lightmaps.times, lightmaps.period, profile.time_axis))
    fit = PlainFit(
        tau=tau,
        encoding=encoding,
        colour=targets.colour,
        texels=targets.texels,
        count=targets.count,
        weight=targets.weight,
        sizes=(8, 8, 4, profile.plane_columns, profile.plane_rows),
        rates=(256, steps, 2e-2, 1e-2, 1e-3),
        seed=seed,
        device="cpu",
    )
    return np.array([float(fit.step()) for _ in range(steps)])


def test_loss_falls_and_repeats():
    first = losses(60, 3)
    # The targets have variance 1: a network that knows nothing loses about as much.
    assert 0.5 < first[0] < 3.0 and first[-10:].mean() < 0.1
    np.testing.assert_array_equal(losses(5, 3), losses(5, 3))
    assert not np.array_equal(losses(5, 3), losses(5, 4))
