"""Maps as BC7 blocks: reconstruction, sampling, adjoints, and the equality with the file's bytes."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import blocks as reference

from kernels.compare import array, close, exact
from wlm.formats.bc7 import decode_mode6, pack_mode6
from wlm_kernels.lightmap import blocks

SLICES, HEIGHT, WIDTH = 3, 8, 12


def _map(seed: int, low: float = 0.0, high: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Random endpoints and weights in [low, high]."""
    random = np.random.default_rng(seed)
    endpoints = random.uniform(low, high, (SLICES, HEIGHT // 4, WIDTH // 4, 2, 4)).astype(np.float32)
    return endpoints, random.uniform(low, high, (SLICES, HEIGHT, WIDTH)).astype(np.float32)


def _points(seed: int, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Random slices and points; the first are the corners, the last texel centres."""
    random = np.random.default_rng(seed)
    points = random.uniform(0.0, 1.0, (count, 2)).astype(np.float32)
    points[:4] = [[0, 0], [1, 0], [0, 1], [1, 1]]
    points[-2:] = [[0.5 / WIDTH, 0.5 / HEIGHT], [(WIDTH - 0.5) / WIDTH, 2.5 / HEIGHT]]
    return random.integers(0, SLICES, count).astype(np.int32), points


def _reconstruct(endpoints: wp.array, weights: wp.array, quantised: bool) -> wp.array:
    out = wp.zeros(weights.shape, dtype=wp.vec4, device=weights.device, requires_grad=True)
    blocks.reconstruct(endpoints, weights, out, quantised)
    return out


def _sample(endpoints, weights, slices, points, quantised: bool) -> wp.array:
    out = wp.zeros(len(points), dtype=wp.vec4, device=weights.device, requires_grad=True)
    blocks.sample(endpoints, weights, slices, points, out, quantised)
    return out


def _both_ways(device: str, values, slices, points, sampled: bool, quantised: bool):
    """Runs the kernel under a tape and the reference under autograd; gives outputs and gradients of each."""
    e, w = array(values[0], wp.vec4, device, grad=True), array(values[1], float, device, grad=True)
    e64, w64 = exact(values[0], grad=True), exact(values[1], grad=True)
    with wp.Tape() as tape:
        if sampled:
            out = _sample(e, w, array(slices, int, device), array(points, wp.vec2, device), quantised)
        else:
            out = _reconstruct(e, w, quantised)
    if sampled:
        out64 = reference.sample(e64, w64, torch.tensor(slices), exact(points), quantised)
    else:
        out64 = reference.texels(e64, w64, quantised)
    toward = np.random.default_rng(5).normal(size=tuple(out64.shape)).astype(np.float32)
    tape.backward(grads={out: array(toward, wp.vec4, device)})
    out64.backward(exact(toward))
    return (out, e.grad, w.grad), (out64, e64.grad, w64.grad)


@pytest.mark.parametrize("quantised", [False, True])
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("span", [(0.0, 1.0), (-0.3, 1.3)], ids=["inside", "outside"])
def test_against_reference(device: str, sampled: bool, quantised: bool, span: tuple[float, float]):
    """Values to float32's precision; gradients by autograd, straight through clamps and roundings."""
    got, want = _both_ways(device, _map(1, *span), *_points(2), sampled, quantised)
    close(got[0], want[0], 1e-6, "value")
    close(got[1], want[1], 1e-5, "gradient of the endpoints")
    close(got[2], want[2], 1e-5, "gradient of the weights")
    assert float(want[2].abs().min()) > 0.0 or sampled, "a gradient that is 0 tests nothing"


@pytest.mark.parametrize("sampled", [False, True])
def test_adjoint_against_differences(device: str, sampled: bool):
    """A texel is bilinear in its endpoints and weight, so that central differences are exact for any step."""
    random = np.random.default_rng(7)
    values = _map(3, 0.2, 0.8)
    slices, points = _points(4)
    (_, grad_e, grad_w), _ = _both_ways(device, values, slices, points, sampled, False)
    toward = np.random.default_rng(5).normal(size=(len(points), 4) if sampled else (*values[1].shape, 4))
    step = [random.uniform(-0.2, 0.2, v.shape).astype(np.float32) for v in values]

    def objective(sign: float) -> float:
        moved = [v + np.float32(sign) * d for v, d in zip(values, step, strict=True)]
        e, w = array(moved[0], wp.vec4, device), array(moved[1], float, device)
        if sampled:
            out = _sample(e, w, array(slices, int, device), array(points, wp.vec2, device), False)
        else:
            out = _reconstruct(e, w, False)
        return float((out.numpy() * toward).sum())

    slope = 0.5 * (objective(1.0) - objective(-1.0))
    along = float((grad_e.numpy() * step[0]).sum() + (grad_w.numpy() * step[1]).sum())
    assert slope == pytest.approx(along, rel=1e-4)


def test_outside_is_clamped_and_keeps_its_gradient(device: str):
    """Adam must be able to bring back a value that it has pushed out."""
    far = np.full((1, 1, 1, 2, 4), 1.5, np.float32)
    far[..., 0, :] = -0.5
    for quantised in (False, True):
        e, w = (
            array(far, wp.vec4, device, grad=True),
            array(np.full((1, 4, 4), 2.0), float, device, grad=True),
        )
        with wp.Tape() as tape:
            out = _reconstruct(e, w, quantised)
        np.testing.assert_array_equal(out.numpy(), 1.0)
        tape.backward(grads={out: array(np.ones((1, 4, 4, 4)), wp.vec4, device)})
        np.testing.assert_array_equal(e.grad.numpy()[0, 0, 0], [[0.0] * 4, [16.0] * 4])
        np.testing.assert_array_equal(w.grad.numpy(), 4.0)


def test_border_is_clamped(device: str):
    """Beyond the last texel centre the map goes on with its last texel, on each side."""
    endpoints, weights = _map(9)
    edge = np.array([[0, 0.3], [1, 0.3], [0.4, 0], [0.4, 1]], np.float32)
    inside = np.clip(edge, 0.5 / np.array([WIDTH, HEIGHT]), 1 - 0.5 / np.array([WIDTH, HEIGHT]))
    e, w = array(endpoints, wp.vec4, device), array(weights, float, device)
    slices = array(np.zeros(4, np.int32), int, device)
    at_edge = _sample(e, w, slices, array(edge, wp.vec2, device), False).numpy()
    at_centre = _sample(e, w, slices, array(inside.astype(np.float32), wp.vec2, device), False).numpy()
    np.testing.assert_allclose(at_edge, at_centre, atol=1e-6)


def _edge_endpoints() -> np.ndarray:
    """Random endpoints [B, 2, 4], and those where rounding is delicate: 0, 1, ties, outside, equal, NaN-free."""
    random = np.random.default_rng(11)
    cases = [random.uniform(-0.2, 1.2, (400, 2, 4))]
    corners = np.array([0.0, 1.0, -3.0, 4.0, 0.5, 1 / 255, 254 / 255, 127.5 / 255, 0.5 / 255, 254.5 / 255])
    cases.append(random.choice(corners, (400, 2, 4)))
    cases.append(np.repeat(random.uniform(0, 1, (100, 1, 4)), 2, 1))  # equal endpoints
    cases.append(np.broadcast_to(corners[:, None, None], (len(corners), 2, 4)))
    cases.append(np.arange(256)[:, None, None] / 255.0 * np.ones((1, 2, 4)))  # every byte
    return np.concatenate(cases).astype(np.float32)


def _blocks_in_a_row(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One slice of edge endpoints with random and edge weights: [1, 1, B, 2, 4] and [1, 4, 4 B]."""
    endpoints = _edge_endpoints()[None, None]
    random = np.random.default_rng(seed)
    weights = random.uniform(-0.1, 1.1, (1, 4, 4 * endpoints.shape[2])).astype(np.float32)
    special = random.random(weights.shape) < 0.3
    weights[special] = random.choice([0.0, 1.0, 0.5, 7.5 / 15, -2.0, 3.0], special.sum())
    return endpoints, weights


def _quantise(endpoints: np.ndarray, weights: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    bytes_out = wp.zeros(endpoints.shape[:-1], dtype=wp.vec4ub, device=device)
    index_out = wp.zeros(weights.shape, dtype=wp.uint8, device=device)
    blocks.quantise(array(endpoints, wp.vec4, device), array(weights, float, device), bytes_out, index_out)
    return bytes_out.numpy(), index_out.numpy()


def test_quantised_texels_are_the_decoded_file(device: str):
    """What is trained on is what the file decodes to, bit for bit."""
    endpoints, weights = _blocks_in_a_row(12)
    stored, index = _quantise(endpoints, weights, device)
    count = endpoints.shape[2]
    in_blocks = index.reshape(4, count, 4).swapaxes(0, 1).reshape(count, 16)
    decoded = decode_mode6(pack_mode6(stored[0, 0], in_blocks)).reshape(count, 4, 4, 4)
    used = _reconstruct(array(endpoints, wp.vec4, device), array(weights, float, device), True).numpy()
    used = used[0].reshape(4, count, 4, 4).swapaxes(0, 1)
    np.testing.assert_array_equal(used, decoded.astype(np.float32) / np.float32(255.0))


def test_quantised_endpoints_are_the_nearest(device: str):
    """No storable endpoint is nearer, beyond float32's say in a tie; indices are the nearest of sixteen."""
    endpoints, weights = _blocks_in_a_row(13)
    stored, index = _quantise(endpoints, weights, device)
    assert np.all(stored & 1 == (stored & 1)[..., :1])
    best, margin = reference.endpoint_bytes(torch.tensor(endpoints))
    wanted = np.clip(endpoints.astype(np.float64), 0, 1) * 255

    def distance(chosen: np.ndarray) -> np.ndarray:
        return ((chosen.astype(np.float64) - wanted) ** 2).sum(-1)

    np.testing.assert_array_less(distance(stored), distance(best.numpy()) + 1e-3)
    clear = margin.numpy() > 1e-3
    assert clear.mean() > 0.5
    # A channel half-way between two bytes of one parity may go either way; its distance is checked above.
    near_tie = np.abs(wanted - best.numpy()) > 0.999
    same = (stored == best.numpy()) | near_tie
    assert same[clear].all()
    position = np.clip(weights.astype(np.float64), 0, 1) * 15
    assert np.abs(index - position).max() <= 0.5 + 1e-5
    assert set(np.unique(index)) == set(range(16))
