"""Small networks with two hidden layers, evaluated in batches of networks."""

import torch
from torch.autograd.function import once_differentiable

from wlm.interop import to_warp
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, dense, on_stream
from wlm_kernels.mlp import GELUS, MlpKernels, kernels

WIDEST = 64
"""Largest width of a hidden layer: a thread stores a layer in registers, and a wider one would spill."""


@takes_arrays("x", "hidden", "output")
def mlp(x: torch.Tensor, hidden: torch.Tensor, output: torch.Tensor, *, gelu: str = "exact") -> torch.Tensor:
    """Evaluates networks with two hidden layers of H units and GELU activations; reference: `benchmarks.plain.mlp`.

    y = gelu(gelu(x W1 + b1) W2 + b2) W3 + b3 (neural-dynamic-gi, section 3.3). The first use of a shape compiles its
    kernels, which takes several seconds.

    Args:
        x: float [B, I], or [N, B, I] for N networks with B inputs each; has a gradient, like `hidden` and `output`.
        hidden: float [I + H + 2, H] or [N, I + H + 2, H], concatenated: W1 [I, H], b1 [1, H], W2 [H, H],
            b2 [1, H]. The weight of a `torch.nn.Linear` is the transpose of such a matrix.
        output: float [H + 1, O] or [N, H + 1, O]: W3 [H, O], b3 [1, O].
        gelu: "exact" (erf); "tanh", an approximation within 4.8e-4 of "exact"; "fast", like "tanh" but with the GPU's
            instruction, whose relative error is 2^-11, gradients within 5e-3. On the CPU "fast" equals "tanh".

    Returns:
        float [B, O] or [N, B, O].

    Raises:
        ValueError: A tensor's shape, type or device doesn't fit, H is above 64, I or O is 0, there is no such GELU, or
            a number isn't finite. The check of numbers waits for the GPU and is skipped while a CUDA graph is
            captured.
    """
    if gelu not in GELUS:
        raise ValueError(f"gelu: expected one of {', '.join(GELUS)}, got {gelu!r}")
    for name, tensor in {"x": x, "hidden": hidden, "output": output}.items():
        check(name, tensor, (...,))
    check("x", x, (None,) * (3 if x.ndim == 3 else 2))
    width, outputs = hidden.shape[-1] if hidden.ndim else 0, output.shape[-1] if output.ndim else 0
    networks = tuple(x.shape[:-2])
    check("hidden", hidden, (*networks, x.shape[-1] + width + 2, width), x.device)
    check("output", output, (*networks, width + 1, outputs), x.device)
    if not (1 <= width <= WIDEST and x.shape[-1] and outputs):
        raise ValueError(f"hidden: expected 1 to {WIDEST} units, some inputs and outputs, got {tuple(hidden.shape)}")
    check_finite(x=x, hidden=hidden, output=output)
    if x.ndim == 2:
        return _Mlp.apply(x[None], hidden[None], output[None], gelu)[0]
    return _Mlp.apply(x, hidden, output, gelu)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, hidden, output, gelu):
        x, hidden, output = (dense(tensor) for tensor in (x, hidden, output))
        y = x.new_empty(*x.shape[:2], output.shape[2])
        network = kernels(x.shape[2], hidden.shape[2], gelu, output.shape[2])
        with on_stream(x.device):
            network.forward(*_arrays(network, x, hidden, output), to_warp(y, network.vec_out))
        ctx.save_for_backward(x, hidden, output)
        ctx.network = network
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_y):
        x, hidden, output = ctx.saved_tensors
        grad_y, network = dense(grad_y), ctx.network
        on_x = torch.empty_like(x)
        h1, h2, d1, d2 = (x.new_empty(*x.shape[:2], network.hidden) for _ in range(4))
        with on_stream(x.device):
            network.backward(
                *_arrays(network, x, hidden, output),
                to_warp(grad_y, network.vec_out),
                to_warp(on_x, network.vec_in),
                *(to_warp(layer, network.vec_hidden) for layer in (h1, h2, d1, d2)),
            )
        # Matrix products over the inputs: torch's implementation is the fastest on either device, in single floats.
        with torch.autocast(x.device.type, enabled=False):
            return on_x, torch.cat([_weights(x, d1), _weights(h1, d2)], 1), _weights(h2, grad_y), None


def _arrays(network: MlpKernels, x: torch.Tensor, hidden: torch.Tensor, output: torch.Tensor) -> list:
    return [to_warp(hidden, network.vec_hidden), to_warp(output, network.vec_out), to_warp(x, network.vec_in)]


def _weights(h: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    return torch.cat([h.transpose(1, 2) @ d, d.sum(1, keepdim=True)], 1)
