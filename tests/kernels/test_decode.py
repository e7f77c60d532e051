"""Decoding from stored bytes: against float64, and the file against the fit."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import decode_tile64
from kernels.compare import array, close
from kernels.stepping import Case, draw, trainer
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.encodings.maps import MapTiles, split_networks
from wlm.lightmap.model import SheetModel
from wlm_kernels.lightmap.matrix_network import pack_networks

KINDS = (3, 3, 3, 1)
BETWEEN = 21.7  # between the last stored time and the next day's first


def _model(hidden: int, gelu: str, **settings) -> SheetModel:
    """A random model whose colours use most of the 8 bits: a scale of about 1 and a bound of about 1.3."""
    random = np.random.default_rng(hidden)
    model = random_sheet(KINDS, hidden=hidden, gelu=gelu, **settings)
    scale = random.integers(143, 148, model.scale.shape, np.uint8)
    scale[0, 1, 2] = 0  # a channel that is black at the second time
    peak = random.integers(149, 153, model.peak.shape, np.uint8)
    affine = np.stack([np.full((3, 3), 0.8), random.uniform(0.6, 1.0, (3, 3))], 1).astype(np.float16)
    return dataclasses.replace(model, scale=scale, peak=peak, affine=affine)


@pytest.mark.parametrize(("resolution", "slices", "columns", "rows"), [(4, 1, 1, 1), (128, 2, 128, 3)])
def test_extreme_sizes(device: str, resolution: int, slices: int, columns: int, rows: int):
    """Maps of one cell on each axis, and maps as fine as the tile."""
    sizes = {"uvt_resolution": resolution, "uvt_slices": slices, "plane_columns": columns, "plane_rows": rows}
    model = _model(16, "tanh", **sizes)
    radiance = SheetDecoder(model, device).tiles([2], BETWEEN)[0]
    close(radiance, decode_tile64(model, 2, BETWEEN), 2e-5)


@pytest.mark.parametrize("width", [16, 48])
def test_networks_packed_for_matrix_units(width: int):
    """The words that each lane of a warp multiplies, in the order of the PTX instruction's fragments."""
    random = np.random.default_rng(width)
    hidden = random.standard_normal((2, 18 + width, width)).astype(np.float16).astype(np.float32)
    output = random.standard_normal((2, width + 1, 3)).astype(np.float16).astype(np.float32)
    words = pack_networks(hidden, output)[1]
    place = 0

    def layer(inputs: int, units: int) -> np.ndarray:
        nonlocal place
        weights = np.empty((inputs, units))
        for k in range(inputs // 16):
            for i in range(units // 8):
                for lane in range(32):
                    g, q = lane // 4, lane % 4
                    for row in (2 * q, 2 * q + 8):
                        weights[16 * k + row : 16 * k + row + 2, 8 * i + g] = words[place : place + 1].view(np.float16)
                        place += 1
        return weights

    first, second, one, other = layer(16, width), layer(width, width), layer(width, 8), layer(width, 8)
    scale = (np.sqrt(2.0 / np.pi) * 0.044715) ** (1 / 3)
    first[:4] /= np.sqrt(12.0) / 255.0
    np.testing.assert_allclose(first[:12] / scale, hidden[1, :12], rtol=1e-3, atol=3e-5)
    assert (first[12:] == 0).all()
    np.testing.assert_allclose(2.0 * second, hidden[1, 17:-1], atol=1e-6)
    np.testing.assert_allclose(2.0 * scale * one[:, :3], output[1, :-1], rtol=1e-3)
    assert (one[:, 3:] == 0).all() and np.array_equal(np.roll(one, 4, axis=1), other)
    bias = words[place : place + width // 2].view(np.float16)
    np.testing.assert_allclose(bias / scale, hidden[1, -1], rtol=1e-3, atol=1e-6)
    assert words[place + width // 2 :].view(np.float32).tolist() == [*output[1, -1].tolist(), 0.0]


def _stored(fit, case: Case) -> SheetModel:
    """A trainer's tiles as the file holds them, with random scales."""
    parts, n = fit.quantised(), fit.tiles
    base = random_sheet([3] * n, columns=n, times=tuple(fit.axis.times), hidden=case.hidden)
    random = np.random.default_rng(1)
    return dataclasses.replace(
        base,
        profile=case.profile(),
        period=fit.axis.period,
        scale=random.integers(143, 148, base.scale.shape, np.uint8),
        peak=random.integers(149, 153, base.peak.shape, np.uint8),
        **parts,
    )


@pytest.mark.parametrize("periodic", [True, False], ids=["periodic", "clamped"])
def test_file_is_what_was_trained(device: str, periodic: bool):
    """The features of quantised training through the rounded network give the light that the file decodes to."""
    case = Case(periodic=periodic, samples=8192)
    fit = trainer(case, device)
    fit.run(6)
    model = _stored(fit, case)
    place, features = draw(fit, True)
    net = fit._kernels.net
    half = split_networks(model.net.astype(np.float32), case.hidden)
    hidden, output = array(half[0], net.vec_hidden, device), array(half[1], wp.vec3, device)
    answer = wp.zeros(place.shape[:2], dtype=wp.vec3, device=device)
    net.forward(hidden, output, array(features, net.vec_in, device), answer)
    y = answer.numpy()

    tiles, rows = MapTiles(model, device, case.gelu), np.arange(fit.tiles)
    for k, time in enumerate(model.times):
        light, state = tiles.radiance(rows, time), tiles.state(time)
        for n in range(fit.tiles):
            chosen = place[n, :, 2] == k
            shift, spread, scale = (v.numpy()[n] for v in (state.shift, state.spread, state.scale))
            expected = np.maximum((shift + spread * y[n, chosen]) * scale, np.float32(0)) ** np.float32(2.2)
            decoded = light[n, place[n, chosen, 0], place[n, chosen, 1]]
            # A GPU's compiler may contract the same operations differently in two kernels.
            np.testing.assert_allclose(decoded, expected, rtol=1e-6 if device == "cpu" else 1e-4, atol=1e-7)
    fit.close()
