"""The training step composed of the public kernels under a ``wp.Tape``."""

import numpy as np
import torch
import warp as wp

from kernels.stepping import TILE, Problem, Step
from wlm_kernels import interpolate, mlp
from wlm_kernels.lightmap import blocks


@wp.kernel
def _join(
    # in:
    uv: wp.array1d[wp.vec4],
    uvt: wp.array2d[float],
    ut: wp.array2d[float],
    vt: wp.array2d[float],
    encoding: wp.array2d[float],
    noise: wp.array2d[float],
    # out:
    f: wp.array2d[float],
):
    i, c = wp.tid()
    scale = 3.4641016151377544
    if c < 4:
        f[i, c] = (uv[i][c] - 0.5) * scale + noise[i, c]
    elif c < 8:
        f[i, c] = (uvt[i, c - 4] - 0.5) * scale + noise[i, c]
    elif c < 10:
        f[i, c] = (ut[i, c - 8] - 0.5) * scale + noise[i, c]
    elif c < 12:
        f[i, c] = (vt[i, c - 10] - 0.5) * scale + noise[i, c]
    else:
        f[i, c] = encoding[i, c - 12]


@wp.kernel
def _loss(
    # in:
    y: wp.array2d[float],
    target: wp.array2d[float],
    weight: wp.array2d[float],
    samples: int,
    # out:
    loss: wp.array1d[float],
):
    i, c = wp.tid()
    error = y[i, c] - target[i, c]
    wp.atomic_add(loss, i // samples, weight[i, c] * error * error / (3.0 * float(samples)))


class _Leaf:
    """A parameter with its gradient, as any Warp types that share their memory."""

    def __init__(self, values: np.ndarray, device: str):
        self.values = torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)
        self.grad = torch.zeros_like(self.values)

    def wrap(self, dtype, shape: tuple[int, ...] | None = None) -> wp.array:
        values, grad = self.values, self.grad
        if shape is not None:
            values, grad = values.view(shape), grad.view(shape)
        grad = wp.from_torch(grad, dtype=dtype, requires_grad=False)
        return wp.from_torch(values, dtype=dtype, requires_grad=True, grad=grad)


def taped_step(problem: Problem, device: str) -> Step:
    """The loss and all gradients of a problem of temporal tiles."""
    n, samples, inputs = problem.noise.shape
    rows, width = n * samples, problem.hidden.shape[-1]
    y, x, _ = (v.numpy() for v in problem.place.reshape(-1, 3).unbind(1))
    tau = problem.tau.flatten().numpy()
    u, v = (x + 0.5) / TILE, (y + 0.5) / TILE
    leaves = {key: _Leaf(value.detach().numpy(), device) for key, value in problem.maps.items()}
    for key in ("ut", "vt"):
        # The public kernel has no levels: its plane holds the values as used, and its gradient is straight through.
        used = np.clip(leaves[key].values.cpu().numpy(), 0.0, 1.0)
        if problem.quantised:
            used = np.floor(used * np.float32(255.0) + np.float32(0.5)) / np.float32(255.0)
        leaves[key] = _Leaf(used, device)
    leaves["hidden"] = _Leaf(problem.hidden.detach().numpy(), device)
    leaves["output"] = _Leaf(problem.output.detach().numpy(), device)

    def put(values, dtype) -> wp.array:
        kind = np.int32 if dtype is int else np.float32
        return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device=device)

    def fresh(*shape: int, dtype=float) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=device, requires_grad=True)

    tile = put(np.arange(rows) // samples, int)
    uvt_shape = tuple(problem.maps["uvt_weights"].shape)
    decoded = _Leaf(np.zeros((*uvt_shape, 4)), device)
    uv = fresh(rows, dtype=wp.vec4)
    uvt, ut, vt = fresh(rows, 4), fresh(rows, 2), fresh(rows, 2)
    f, loss = fresh(rows, inputs), fresh(n)
    w = leaves["hidden"].wrap(wp.float32, (n, -1))
    o = leaves["output"].wrap(wp.float32, (n, -1))
    # Wrapped once: what one kernel writes as vec4, the next reads as floats.
    as_vec4, as_floats = decoded.wrap(wp.vec4), decoded.wrap(wp.float32)
    target, weight = (put(values.reshape(rows, 3), float) for values in (problem.target, problem.weight))
    encoding = put(problem.encoding.reshape(-1, 4).numpy(), float)
    noise = put(problem.noise.reshape(rows, inputs), float)
    maps = {key: leaves[key].wrap(wp.vec4 if "endpoints" in key else wp.float32) for key in problem.maps}
    points = {
        "uv": put(np.stack([u, v], 1), wp.vec2),
        "ut": put(np.stack([u, tau], 1), wp.vec2),
        "vt": put(np.stack([v, tau], 1), wp.vec2),
        "uvt": put(np.stack([u, v, tau], 1), wp.vec3),
    }

    def layer(weights: wp.array, first: int, bias: int, x: wp.array, size: int) -> wp.array:
        out = fresh(rows, size)
        mlp.linear(weights, first, bias, x, tile, out)
        return out

    def gelu(x: wp.array) -> wp.array:
        out = fresh(rows, width)
        mlp.activate(x, out)
        return out

    with wp.Tape() as tape:
        blocks.sample(
            maps["uv_endpoints"], maps["uv_weights"], tile, points["uv"], uv, quantised=problem.quantised
        )
        blocks.reconstruct(maps["uvt_endpoints"], maps["uvt_weights"], as_vec4, quantised=problem.quantised)
        interpolate.sample_volume(as_floats, uvt_shape[0] // n, tile, points["uvt"], uvt, problem.periodic)
        interpolate.sample_plane(maps["ut"], tile, points["ut"], ut, problem.periodic)
        interpolate.sample_plane(maps["vt"], tile, points["vt"], vt, problem.periodic)
        wp.launch(_join, f.shape, inputs=[uv, uvt, ut, vt, encoding, noise], outputs=[f], device=device)
        h1 = gelu(layer(w, 0, inputs, f, width))
        h2 = gelu(layer(w, inputs + 1, inputs + 1 + width, h1, width))
        answer = layer(o, 0, width, h2, 3)
        wp.launch(
            _loss, answer.shape, inputs=[answer, target, weight, samples], outputs=[loss], device=device
        )
    tape.backward(grads={loss: put(np.ones(n), float)})
    wp.synchronize_device(device)
    return Step(loss.numpy(), {key: leaf.grad.cpu().numpy() for key, leaf in leaves.items()})
