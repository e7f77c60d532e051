"""The float64 decode against a slow one that goes by the equations, number by number."""

import math

import numpy as np
import pytest
from builders.probe_models import random_model

from wlm.probe import exact
from wlm.probe.exact import decode64
from wlm.probe.gaussian.model import CUT


def slow(model, point):
    """Eq. 2 to 7 and 14 for one point; a list of D numbers."""
    p, content = model.profile, model.content
    x = [min(max((point[a] - model.origin[a]) / model.extent, 0.0), float(model.size[a])) for a in range(3)]
    latent = [0.0] * p.latent
    for k in range(content.count):
        codes, levels = content.code[k].tolist(), content.levels.tolist()
        row = [
            float(content.bounds[0, c]) + code / level * (float(content.bounds[1, c]) - float(content.bounds[0, c]))
            for c, (code, level) in enumerate(zip(codes, levels, strict=True))
        ]
        scale = [math.exp(s) for s in row[3:6]]
        length = math.sqrt(sum(v * v for v in row[6:10]))
        w, i, j, h = [v / length for v in row[6:10]] if length > 0 else [1.0, 0.0, 0.0, 0.0]
        turn = [
            [1 - 2 * (j * j + h * h), 2 * (i * j - h * w), 2 * (i * h + j * w)],
            [2 * (i * j + h * w), 1 - 2 * (i * i + h * h), 2 * (j * h - i * w)],
            [2 * (i * h - j * w), 2 * (j * h + i * w), 1 - 2 * (i * i + j * j)],
        ]
        away = [x[a] - row[a] for a in range(3)]
        d2 = sum((sum(turn[a][b] * away[a] for a in range(3)) / scale[b]) ** 2 for b in range(3))
        reached = math.dist(x, row[:3]) < CUT * max(scale) if p.support == "sphere" else d2 < CUT**2
        if reached:
            latent = [f + math.exp(-d2 / 2) * v for f, v in zip(latent, row[10:], strict=True)]
    values, numbers = [*latent, *x], iter(content.net.tolist())
    for layer, width in enumerate([p.hidden, p.hidden, model.outputs]):
        weights = [[next(numbers) for _ in range(width)] for _ in values]
        sums = [next(numbers) + sum(v * row[c] for v, row in zip(values, weights, strict=True)) for c in range(width)]
        values = sums if layer == 2 else [1 / (1 + math.exp(-s)) for s in sums]
    return [content.gain * v for v in values]


@pytest.mark.parametrize("support", ["ellipsoid", "sphere"])
@pytest.mark.parametrize("pairs", [1, 1000, 1 << 20])
def test_every_number_by_the_equations(monkeypatch, support, pairs):
    monkeypatch.setattr(exact, "_PAIRS", pairs)
    model = random_model(count=20, outputs=6, latent=3, hidden=8, bits=7, support=support)
    model.content.bounds[:, 6:10] = [[0.0] * 4, [1.0] * 4]
    model.content.code[:2, 6:10] = 0  # no rotation at all
    points = model.origin + model.extent * np.random.default_rng(1).uniform(-0.2, 1.2, (30, 3)) * model.size
    np.testing.assert_allclose(decode64(model, points), [slow(model, point) for point in points], rtol=1e-11)


def test_a_gaussian_ends_at_the_cut():
    model = random_model(count=1, latent=1)
    model.content.bounds[:, 3:10] = [np.log(0.1)] * 3 + [1.0, 0.0, 0.0, 0.0]
    model.content.code[:, :3] = 2**15
    middle = model.origin + model.extent * model.content.rows()[0, :3].astype(np.float64)
    way = model.extent * 0.1 * 3.0 * np.array([[0.999, 0, 0], [1.001, 0, 0], [2.0, 0, 0]])
    inside, outside, far = decode64(model, middle + way)
    model.content.bounds[:, 10:] = 0.0
    nothing = decode64(model, middle + way)
    assert (inside != nothing[0]).any()
    np.testing.assert_allclose([outside, far], nothing[1:], rtol=1e-12)
