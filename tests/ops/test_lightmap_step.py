"""The operations put together: a temporal lightmap's training step, against the fused kernel and by autograd."""

import pytest
import torch
from kernels.compare import close
from kernels.stepping import TILE, Case, Problem, Step, fused_step, problem, tolerance, trainer

from wlm import ops
from wlm.ops import plain


def _composed(problem: Problem, device: str) -> Step:
    """The loss and all gradients of a problem of temporal tiles (neural-dynamic-gi, eq. 4 and 5)."""

    def put(values: torch.Tensor) -> torch.Tensor:
        values = values.detach().to(device)
        return values.float() if values.is_floating_point() else values

    maps = {key: put(values).requires_grad_() for key, values in problem.maps.items()}
    hidden, output = put(problem.hidden).requires_grad_(), put(problem.output).requires_grad_()
    levels = {key: maps[key].clamp(0.0, 1.0) for key in ("ut", "vt")}
    if problem.quantised:
        levels = {key: torch.floor(values * 255.0 + 0.5) / 255.0 for key, values in levels.items()}
    planes = {key: plain.straight_through(maps[key], values) for key, values in levels.items()}
    options = {"layer": put(problem.tile), "periodic": problem.periodic}
    y, x, _ = put(problem.place).reshape(-1, 3).unbind(1)
    u, v, tau = (x + 0.5) / TILE, (y + 0.5) / TILE, put(problem.tau).flatten()
    texels = ops.bc7_texels(maps["uvt_endpoints"], maps["uvt_weights"], quantised=problem.quantised)
    features = [
        ops.bc7_map(
            maps["uv_endpoints"],
            maps["uv_weights"],
            torch.stack([u, v], 1),
            layer=options["layer"],
            quantised=problem.quantised,
        ),
        ops.volume(texels.reshape(len(hidden), -1, *texels.shape[1:]), torch.stack([u, v, tau], 1), **options),
        ops.plane(planes["ut"], torch.stack([u, tau], 1), **options),
        ops.plane(planes["vt"], torch.stack([v, tau], 1), **options),
    ]
    centred = (torch.cat(features, 1) - 0.5) * 12.0**0.5
    inputs = torch.cat([centred, put(problem.encoding).reshape(-1, 4)], 1).reshape(problem.noise.shape)
    answer = ops.mlp(inputs + put(problem.noise), hidden, output, gelu=problem.gelu)
    loss = (put(problem.weight) * (answer - put(problem.target)) ** 2).mean((1, 2))
    loss.sum().backward()
    leaves = maps | {"hidden": hidden, "output": output}
    return Step(loss.detach().cpu().numpy(), {key: leaf.grad.cpu().numpy() for key, leaf in leaves.items()})


@pytest.mark.parametrize("quantised", [False, True], ids=["continuous", "quantised"])
@pytest.mark.parametrize("periodic", [False, True], ids=["clamped", "periodic"])
def test_training_step(device: str, periodic: bool, quantised: bool):
    """Six operations under torch's autograd give the loss and the gradients of the kernel that does all at once."""
    fit = trainer(Case(periodic=periodic), device)
    composed = _composed(problem(fit, Case(periodic=periodic), quantised), device)
    fused = fused_step(fit, quantised)
    fit.close()
    close(fused.loss, composed.loss, tolerance(fit), "loss")
    for key, grad in composed.grads.items():
        assert grad.any()
        close(fused.grads[key], grad, tolerance(fit), f"gradient of {key}")
