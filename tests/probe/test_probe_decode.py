"""The Gaussian decoders: float32 against float64, and float64 against the equations, number by number."""

import math

import numpy as np
import pytest
import warp as wp
from builders.checks import error_of, misuse_of
from builders.probe_models import EXTENT, ORIGIN, SIZE, random_model

from benchmarks import probe_exact as exact
from benchmarks.probe_exact import decode64
from wlm.errors import WlmError
from wlm.probe.gaussian.decode import GaussianDecoder
from wlm.probe.gaussian.model import CUT, check_outputs, layer_shapes, split_layers
from wlm_kernels.probe.decode import decode_kernels
from wlm_kernels.probe.network import most_outputs, padded

RANDOM = np.random.default_rng(11)


def points(count, model):
    return model.origin + EXTENT * SIZE * RANDOM.random((count, 3))


def close(decoded, model, position):
    """Within float32's rounding of the float64 decode, but for points at the very edge of a Gaussian."""
    exact = decode64(model, position)
    error = np.abs(decoded - exact).max(1)
    assert np.median(error) < 2e-6 * np.abs(exact).max()
    assert (error > 2e-5 * np.abs(exact).max()).mean() < 0.01


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"outputs": 3, "latent": 1, "hidden": 8},
        {"outputs": 75, "hidden": 64, "latent": 12},
        {"support": "sphere"},
        {"turn": 0.0},
        {"count": 1},
        {"error": "absolute"},
    ],
    ids=str,
)
def test_against_float64(settings, device):
    model = random_model(**settings)
    position = points(130, model)
    close(GaussianDecoder(model, device).decode(position), model, position)


@pytest.mark.parametrize("sizes", [(9, 64, 27, True), (1, 8, 3, False), (14, 24, 9, True)])
def test_packed_network(sizes):
    """The weights lie where the lanes of a warp read them, and the last layer's have twice a half float's precision."""
    latent, hidden, outputs, relative = sizes
    kernels = decode_kernels(*sizes, 3, "cuda")
    shapes = layer_shapes(latent, hidden, padded(outputs + relative))
    net = RANDOM.normal(size=sum(rows * columns for rows, columns in shapes)).astype(np.float32)
    layers = split_layers(net, shapes)
    layers[2] = layers[2][:, : outputs + relative]
    if relative:
        layers[2] = np.roll(layers[2], 1, axis=1)
    packed = wp.zeros(kernels.words, dtype=float, device="cpu")
    wp.launch(kernels._pack, packed.shape, inputs=[wp.array(net, dtype=float, device="cpu")], outputs=[packed])
    rest, tiles = packed.numpy(), [-(-(latent + 3) // 16), -(-hidden // 16), -(-(outputs + relative) // 8)]
    found = []
    for down, across in ((tiles[0], tiles[1]), (tiles[1], tiles[1]), (tiles[1], tiles[2])):
        own, rest = np.split(rest, [128 * down * across])
        # Tile, lane / 4 and lane % 4, two pairs of words, of which each has two numbers.
        own = own.view(np.float16).reshape(down, across, 8, 4, 2, 2, 2).astype(np.float32)
        if len(found) < 2:
            found.append(own.transpose(0, 5, 3, 6, 1, 4, 2).reshape(16 * down, 16 * across))
        else:
            found.append(own.sum(4).transpose(0, 4, 3, 5, 1, 2).reshape(16 * down, 8 * across))
    biases = np.split(rest, np.cumsum([each.shape[1] for each in found[:2]]))
    for layer, weights, bias, error in zip(layers, found, biases, (6e-4, 6e-4, 1e-6), strict=True):
        rows, columns = layer.shape
        np.testing.assert_allclose(weights[: rows - 1, :columns], layer[:-1], rtol=error, atol=1e-7)
        np.testing.assert_array_equal(bias[:columns], layer[-1])
        assert not weights[rows - 1 :].any() and not weights[:, columns:].any() and not bias[columns:].any()


def test_far_from_the_origin(device):
    model = random_model(origin=np.array([1e6, -2e6, 5e5]))
    position = points(100, model)
    close(GaussianDecoder(model, device).decode(position), model, position)


def test_outside_is_the_nearest_point_of_the_box(device):
    model = random_model()
    inside = points(20, model)
    high = ORIGIN + EXTENT * SIZE
    outside, nearest = inside.copy(), inside.copy()
    outside[:, 0], nearest[:, 0] = high[0] + 1e9, high[0]
    outside[:10, 2], nearest[:10, 2] = ORIGIN[2] - 0.5, ORIGIN[2]
    decoder = GaussianDecoder(model, device)
    np.testing.assert_array_equal(decoder.decode(outside), decoder.decode(nearest))


def test_the_models_own_probes(device):
    model = random_model(positions=True, dead=5)
    decoder = GaussianDecoder(model, device)
    decoded = decoder.decode_probes()
    assert decoded.shape == (200, 27) and (decoded[model.dead] == 0).all() and (decoded[~model.dead] != 0).any(1).all()
    decoder = GaussianDecoder(model, device, position=model.stored_positions())
    np.testing.assert_array_equal(decoder.decode_probes(), decoded)
    # The order of the points on the device does not show in the result.
    turned = decoder.decode(model.stored_positions()[::-1])[::-1]
    np.testing.assert_array_equal(turned[~model.dead], decoded[~model.dead])


def test_wrong_positions():
    decoder = GaussianDecoder(random_model())
    assert "random: the file stores no positions" in error_of(decoder.decode_probes)
    with pytest.raises(WlmError, match="expected the positions of its own 200 probes"):
        GaussianDecoder(random_model(), position=np.zeros((7, 3)))
    bad = np.zeros((4, 3))
    bad[2, 1] = np.nan
    assert "position 2: expected finite" in error_of(decoder.decode, bad)
    assert "expected [M, 3]" in misuse_of(decoder.decode, np.zeros(3))
    assert "device 'cuda:9'" in error_of(GaussianDecoder, random_model(), "cuda:9")
    assert decoder.decode(np.zeros((0, 3))).shape == (0, 27)


def test_more_numbers_than_a_block_of_cuda_threads_can_hold():
    model = random_model(outputs=1501, count=3)
    position = points(20, model)
    close(model.decoder("cpu").decode(position), model, position)
    most = most_outputs(9, 16)
    check_outputs("x", 9, 16, most, False, "cuda:0")
    with pytest.raises(WlmError, match=f"expected at most {most - 1} numbers a probe on CUDA with latent .* found 15"):
        check_outputs("x", 9, 16, 1501, True, "cuda:0")


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
    for layer, width in enumerate([p.hidden, p.hidden, p.columns(model.outputs)]):
        weights = [[next(numbers) for _ in range(width)] for _ in values]
        sums = [next(numbers) + sum(v * row[c] for v, row in zip(values, weights, strict=True)) for c in range(width)]
        values = sums if layer == 2 else [1 / (1 + math.exp(-s)) for s in sums]
    if p.error == "relative":
        *values, last = values
        values = [math.exp(min(last, 0.0)) * v for v in values]
    lit = 3 if model.outputs in (3, 12, 27) else 0
    return [content.gain * (max(v, 0.0) if d < lit else v) for d, v in enumerate(values)]


@pytest.mark.parametrize("support", ["ellipsoid", "sphere"])
@pytest.mark.parametrize("pairs", [1, 1000, 1 << 20])
def test_every_number_by_the_equations(monkeypatch, support, pairs):
    monkeypatch.setattr(exact, "_PAIRS", pairs)
    kind = {"support": support, "error": "absolute" if pairs == 1 else "relative"}
    model = random_model(count=20, outputs=12 if pairs == 1000 else 6, latent=3, hidden=8, bits=7, **kind)
    model.content.bounds[:, 6:10] = [[0.0] * 4, [1.0] * 4]
    model.content.code[:2, 6:10] = 0  # no rotation at all
    points = model.origin + model.extent * np.random.default_rng(1).uniform(-0.2, 1.2, (30, 3)) * model.size
    np.testing.assert_allclose(decode64(model, points), [slow(model, point) for point in points], rtol=1e-11)
