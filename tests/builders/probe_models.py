"""Probe models of random Gaussians and a random network: as good as fitted ones for whoever only decodes them."""

import numpy as np

from wlm.probe.model import CENTRE_BITS, ProbeModel, Profile, layer_shapes

ORIGIN, EXTENT, SIZE = np.array([-3.0, 1.0, 20.0]), 8.0, np.array([1.0, 0.375, 0.75])


def random_model(
    count=40, probes=200, outputs=27, dead=3, positions=False, seed=0, origin=ORIGIN, turn=1.0, **settings
) -> ProbeModel:
    """Makes a model of a box of 8 x 3 x 6; `settings` are the profile's, with `turn=0` all quaternions are zero."""
    rng = np.random.default_rng(seed)
    profile = Profile(name="random", **{"hidden": 16} | settings)
    latent, hidden = profile.latent, profile.hidden
    scales = np.log([0.05, 0.4])
    low = np.concatenate([np.zeros(3), np.full(3, scales[0]), np.full(4, -turn), np.full(latent, -1.0)])
    high = np.concatenate([SIZE, np.full(3, scales[1]), np.full(4, turn), np.full(latent, 2.0)])
    code = rng.integers(0, 2**profile.bits, (count, 7 + latent)).astype(np.uint16)
    shapes = layer_shapes(latent, hidden, outputs)
    inputs = np.repeat([latent + 3, hidden, hidden], [rows * columns for rows, columns in shapes])
    zero = np.zeros(probes if dead else 0, bool)
    zero[np.linspace(0, probes - 1, dead).astype(int)] = dead > 0
    stored = rng.integers(0, 2**16, (probes if positions else 0, 3)).astype(np.uint16)
    return ProbeModel(
        name="random",
        source="0123456789abcdef",
        profile=profile,
        probes=probes,
        outputs=outputs,
        origin=np.array(origin, np.float64),
        extent=EXTENT,
        size=SIZE,
        gain=2.5,
        centre=rng.integers(0, 2**CENTRE_BITS, (count, 3)).astype(np.uint16),
        code=code,
        bounds=np.stack([low, high]).astype(np.float32),
        net=(rng.standard_normal(len(inputs)) * 2.0 * inputs**-0.5).astype(np.float16),
        dead=zero,
        positions=stored,
        dropped=2,
    )
