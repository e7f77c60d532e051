"""Rivals of probe compression: known answers, sizes, hard cases, and the search at a size."""

import functools

import numpy as np
import pytest
from builders.checks import error_of

from benchmarks.rivals import probe_mbd, probe_pca
from benchmarks.rivals.probe import (
    RIVALS,
    at_bytes,
    clustered_pca,
    global_pca,
    moving_basis,
    pack_unreal,
    unpack_unreal,
    unreal_packing,
)

HALF = 2.0**-11  # relative error of a half float
SIGNAL = functools.partial(clustered_pca, signal=True)
# Each as (positions, values, components, parts, bits=...).
METHODS = {
    "global_pca": lambda position, values, components, parts, **more: global_pca(position, values, components, **more),
    "clustered_pca": clustered_pca,
    "clustered_pca_signal": SIGNAL,
    "moving_basis": moving_basis,
}
# The moving basis gets a grid of 3 cells, which has more than 8 corners; every other method gets 8 parts.
PARTS = {"moving_basis": 3}


def _probes(count: int = 400, width: int = 12, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Makes probes in a flat room whose values bend with the place, every direction with some spread."""
    random = np.random.default_rng(seed)
    position = random.uniform((-2.0, 0.0, 5.0), (6.0, 1.0, 9.0), (count, 3))
    phase = position @ random.normal(size=(3, 6)) * 0.5
    values = np.concatenate([np.sin(phase), np.cos(phase)], 1) @ random.normal(size=(12, width))
    return position, (values * 0.5 ** np.arange(width) + 0.01 * random.normal(size=(count, width))).astype(np.float32)


def _error(values: np.ndarray, decoded: np.ndarray) -> float:
    return float(np.square(values.astype(np.float64) - decoded).mean())


def _make(name: str, position: np.ndarray, values: np.ndarray, components: int, **more: object):
    return METHODS[name](position, values, components, PARTS.get(name, 8), **more)


@pytest.mark.parametrize("width", [3, 12])
@pytest.mark.parametrize("name", METHODS)
def test_all_components_reproduce_the_values(name, width):
    position, values = _probes(width=width)
    result = _make(name, position, values, width)
    assert result.name == name and result.decoded.dtype == np.float32 and result.decoded.shape == values.shape
    # Weights reach a few times the largest value, and each component adds its own rounding.
    np.testing.assert_allclose(result.decoded, values, rtol=0, atol=4 * HALF * np.abs(values).max())
    assert result.encode_seconds > 0.0 and result.decode_seconds > 0.0


def test_global_pca_is_a_truncated_svd():
    position, values = _probes()
    wide = values.astype(np.float64)
    u, s, v = np.linalg.svd(wide - wide.mean(0), full_matrices=False)
    for k in (1, 3, 12):
        mean, basis = probe_pca.fit_subspaces(wide, [np.arange(len(wide))], k)
        found = (wide - mean) @ basis[0].T @ basis[0] + mean
        np.testing.assert_allclose(found, (u[:, :k] * s[:k]) @ v[:k] + wide.mean(0), atol=1e-9)
    best = np.square(s[3:]).sum() / wide.size
    assert best <= _error(values, global_pca(position, values, 3).decoded) < best * 1.001


def test_sizes_by_hand():
    position, values = _probes(count=101)
    n, d, k = 101, 12, 3
    assert global_pca(position, values, k).bytes == 14 + (k + 1) * d * 2 + n * k * 2
    assert global_pca(position, values, k, bits=5).bytes == 14 + (k + 1) * d * 2 + k * 4 + -(-n * k * 5 // 8)
    # A centre is 6 bytes; an index of one of 8 is 3 bits a probe.
    assert clustered_pca(position, values, k, 8).bytes == 14 + 8 * (6 + (k + 1) * d * 2) + n * k * 2
    assert SIGNAL(position, values, k, 8).bytes == 14 + -(-n * 3 // 8) + 8 * (k + 1) * d * 2 + n * k * 2
    corners, cells = probe_mbd.grid_parts(position, 2)
    expected = 13 + corners * (k + 1) * d * 2 + cells * k * 4 + -(-n * k * 8 // 8)
    assert moving_basis(position, values, k, 2, bits=8).bytes == expected


@pytest.mark.parametrize("bits", [None, 8, 10])
def test_bytes_and_positions_are_all_that_decoding_needs(bits):
    position, values = _probes()
    wide = values.astype(np.float64)
    cut = [probe_pca.whole(position), probe_pca.by_place(position, 9, 1)]
    for partition in (*cut, probe_pca.by_signal(wide, 9, 2, 1)):
        payload = probe_pca.encode(wide, partition, 2, bits)
        assert len(payload) == probe_pca.payload_bytes(partition.kind, 400, 12, 2, partition.count, bits)
        assert probe_pca.part_count(payload) == partition.count
        decoded = probe_pca.decode(bytes(bytearray(payload)), position.copy())
        assert _error(values, decoded) <= _error(values, global_pca(position, values, 2, bits=4).decoded)
        # A probe's values depend on its place and weights, so other positions must not decode to the same.
        if partition.kind == probe_pca.PLACE:
            elsewhere = probe_pca.decode(payload, position[:, ::-1])
            assert _error(values, elsewhere) > 2 * _error(values, decoded)
    payload = probe_mbd.encode(position, wide, 2, 3, 3, bits)
    assert len(payload) == probe_mbd.payload_bytes(400, 12, 2, probe_mbd.grid_parts(position, 3), bits)
    shown = moving_basis(position, values, 2, 3, 3, bits=bits).decoded
    np.testing.assert_array_equal(probe_mbd.decode(payload, position), shown)


def test_clusters_by_signal_find_lines_that_share_one_place():
    random = np.random.default_rng(4)
    truth = random.integers(0, 4, 400)
    point, direction = random.normal(size=(2, 4, 12))
    values = (4 * point[truth] + direction[truth] * random.normal(size=(400, 1))).astype(np.float32)
    position = random.uniform(size=(400, 3))
    found = SIGNAL(position, values, 1, 4)
    np.testing.assert_allclose(found.decoded, values, rtol=0, atol=4 * HALF * np.abs(values).max())
    assert _error(values, clustered_pca(position, values, 1, 4).decoded) > 0.1
    again = [SIGNAL(position, values, 1, 4, seed).decoded for seed in (7, 7)]
    np.testing.assert_array_equal(*again)


@pytest.mark.parametrize("grid", [1, 4])
def test_moving_basis_never_gets_worse_and_beats_pca(grid):
    position, values = _probes()
    wide = values.astype(np.float64)
    for k in (1, 3):
        solver = probe_mbd.Solver(position, wide, k, grid)
        errors = [solver.error()]
        for _ in range(6):
            solver.solve_corners()
            errors.append(solver.error())
            solver.solve_weights()
            errors.append(solver.error())
        _, s, _ = np.linalg.svd(wide - wide.mean(0), full_matrices=False)
        assert errors[0] == pytest.approx(np.square(s[k:]).sum(), rel=1e-9)
        assert (np.diff(errors) <= 1e-9 * errors[0]).all()
        assert errors[-1] < 0.8 * errors[0]
        for bits in (None, 8):
            found = _error(values, moving_basis(position, values, k, grid, bits=bits).decoded)
            assert found < _error(values, global_pca(position, values, k).decoded)
    none = moving_basis(position, values, 3, grid, 0).decoded
    assert _error(values, none) == pytest.approx(_error(values, global_pca(position, values, 3).decoded), rel=1e-3)


def _sh(direction: np.ndarray) -> np.ndarray:
    """Real SH of a unit vector up to L2, in the order of the probe files, over Y00."""
    x, y, z = direction
    one, two = np.sqrt(3.0), np.sqrt(15.0)
    band = (x * y, y * z, (3 * z * z - 1) / np.sqrt(12.0), x * z, (x * x - y * y) / 2)
    return np.array([1.0, *(one * np.array([y, z, x])), *(two * np.array(band))])


def test_unreal_by_hand():
    light = _sh(np.array([0.0, 0.0, 1.0]))[:, None] * np.array([1.0, 0.5, 0.0])
    light[:, 2] = 7.0
    light[0, 2] = 0.0  # no ambient: nothing can be kept
    payload = pack_unreal(light.reshape(1, 27), 3)
    # 1.0, 0.5 and 0 with half float's exponent; z at its end, 3z²-1 at half of its range, 128 for zero.
    assert payload[:4] == (0x3C00 >> 4 | 0x3800 >> 4 << 11).to_bytes(4, "little")
    red = [128, 255, 128, 128, 128, 191, 128, 128]
    assert list(payload[4:]) == red * 2 + [128] * 8
    decoded = unpack_unreal(payload, 27, 3).reshape(9, 3)
    zero = (128 / 127.5 - 1) * np.sqrt(3.0)
    expected = [1.0, zero, np.sqrt(3.0), zero, *[zero * np.sqrt(5.0)] * 2, (191 / 127.5 - 1) * np.sqrt(20.0)]
    np.testing.assert_allclose(decoded[:7, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(decoded[:, 1], decoded[:, 0] / 2, rtol=1e-6)
    assert not decoded[:, 2].any() and unreal_packing(*_probes(count=20)).bytes == 20 * 13


@pytest.mark.parametrize("name", RIVALS)
def test_at_bytes_keeps_the_size_and_uses_it(name):
    position, values = _probes(count=100)
    budgets = [int(share * values.nbytes) for share in (0.15, 0.4)]
    results = [at_bytes(name, position, values, budget) for budget in budgets]
    for result, budget in zip(results, budgets, strict=True):
        assert result.name == name and result.bytes <= budget
    errors = [_error(values, result.decoded) for result in results]
    assert errors[0] > errors[1]
    assert f"{name}: no settings fit 100 probes into 20 bytes" in error_of(at_bytes, name, position, values, 20)
