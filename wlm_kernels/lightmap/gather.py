"""Ends a training step: converts the sums of `step` to gradients, and updates the parameters with Adam in one pass.

Read `tests/kernels/test_optimiser.py` first; it compares the updates with those of torch's Adam.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def _drain(sums: wp.array2d[float], i: int, clear: int) -> float:
    """Returns the sum of column i, and sets the column to 0 if `clear` is not 0."""
    s = float(0.0)
    for p in range(sums.shape[0]):
        s += sums[p, i]
        if clear != 0:
            sums[p, i] = 0.0
    return s


@wp.func
def _drain(sums: wp.array2d[wp.int64], i: int, clear: int) -> float:
    s = float(sums[0, i]) * 9.094947017729282e-13  # steps of 2^-40, as `adjoint` adds them
    sums[0, i] = wp.int64(0)
    return s


@wp.struct
class Adam:
    """Settings of the optimiser Adam, and its moments of one array of parameters."""

    decay: wp.vec2  # of the gradients and of their squares
    epsilon: float
    first: wp.array1d[float]
    second: wp.array1d[float]


@wp.func
def moved(adam: Adam, i: int, value: float, grad: float, rate: float, corrections: wp.vec2) -> float:
    """Returns parameter i, now `value`, after Adam's step t, and updates its moments. `corrections` are
    1 / (1 - decay[0]^t) and 1 / sqrt(1 - decay[1]^t), since the moments began at 0."""
    first = adam.decay[0] * adam.first[i] + (1.0 - adam.decay[0]) * grad
    second = adam.decay[1] * adam.second[i] + (1.0 - adam.decay[1]) * grad * grad
    adam.first[i] = first
    adam.second[i] = second
    return value - rate * corrections[0] * first / (wp.sqrt(second) * corrections[1] + adam.epsilon)


@wp.kernel
def _update_maps(
    # in:
    schedule: wp.array1d[wp.vec3],
    first_rates: wp.vec2,
    control: wp.array1d[int],
    move: int,
    base: int,
    # in and out:
    acc: wp.array2d[Any],
    adam: Adam,
    parameters: wp.array1d[float],
    # out:
    rates: wp.array1d[float],
):
    i = base + wp.tid()
    now = schedule[wp.min(control[0], schedule.shape[0] - 1)]
    g = _drain(acc, i, 1)
    value = wp.clamp(parameters[i], 0.0, 1.0)
    if move != 0:
        value = moved(adam, i, value, g, now[0] * first_rates[0], wp.vec2(now[1], now[2]))
    parameters[i] = value
    if i == 0:
        rates[0] = now[0] * first_rates[0]
        rates[1] = now[0] * first_rates[1]
        rates[2] = now[1]
        rates[3] = now[2]


# Both forms are compiled with the module: the threads of a fit on the CPU would compile one at the same time.
for _scalar in (float, wp.int64):
    wp.overload(_update_maps, {"acc": wp.array2d[_scalar]})


@wp.func
def toward(mean: float, value: float) -> float:
    """Returns a running mean over about 50 steps, updated with a new value."""
    return mean + (value - mean) * 0.02


@wp.kernel
def _update_net(
    # in:
    rates: wp.array1d[float],
    clear: int,
    # in and out:
    partial: wp.array2d[float],
    partial_out: wp.array2d[float],
    loss: wp.array2d[float],
    adam: Adam,
    adam_out: Adam,
    hidden: wp.array1d[float],
    output: wp.array1d[float],
    mean_loss: wp.array1d[float],
    control: wp.array1d[int],
):
    i = wp.tid()
    corrections = wp.vec2(rates[2], rates[3])
    if i < hidden.shape[0]:
        hidden[i] = moved(adam, i, hidden[i], _drain(partial, i, clear), rates[1], corrections)
    if i < output.shape[0]:
        output[i] = moved(adam_out, i, output[i], _drain(partial_out, i, clear), rates[1], corrections)
    if i < mean_loss.shape[0]:
        mean_loss[i] = toward(mean_loss[i], _drain(loss, i, clear))
    if i == 0:
        control[0] = control[0] + 1


def update_maps(
    schedule: wp.array,
    first_rates: tuple[float, float],
    control: wp.array,
    move: bool,
    acc: wp.array,
    adam: Adam,
    parameters: wp.array,
    rates: wp.array,
    base: int = 0,
    count: int | None = None,
) -> None:
    """Converts the maps' sums into gradients and updates the maps with Adam: the first half of a step's update.

    Args:
        schedule: vec3 [steps]: the factor on the initial learning rates, and Adam's two corrections, see `moved`.
        first_rates: The initial learning rates of the maps and of the networks.
        control: int [1], number of the step.
        move: Whether Adam updates the maps; they are clamped in any case.
        acc: The sums for the M parameters, as `StepKernels.launch` adds them; set to 0.
        adam: State of the optimiser, updated.
        parameters: float [M], the maps; clamped to [0, 1], then updated.
        rates: float [4], written with parameter 0: the learning rates of maps and networks at this step, and Adam's
            two corrections.
        base, count: First index and number of the parameters that this launch updates; default all.
    """
    wp.launch(
        _update_maps,
        parameters.shape[0] - base if count is None else count,
        inputs=[schedule, wp.vec2(*first_rates), control, int(move), base, acc, adam, parameters],
        outputs=[rates],
        device=parameters.device,
    )


def update_net(
    partial: wp.array,
    partial_out: wp.array,
    loss: wp.array,
    rates: wp.array,
    adam: Adam,
    adam_out: Adam,
    hidden: wp.array,
    output: wp.array,
    mean_loss: wp.array,
    control: wp.array,
) -> None:
    """Converts the networks' sums into gradients and updates the networks with Adam: ends a step's update.

    Args:
        partial, partial_out, loss: Sums of P threads or blocks for hidden and output layers and losses, float [P, ...];
            set to 0 on the CPU, whose next step adds to them.
        rates: As `update_maps` wrote them.
        adam, adam_out: States of the optimisers of hidden and output layers, updated.
        hidden, output: float, the hidden and output layers, updated.
        mean_loss: float [N], running mean of each tile's loss, updated.
        control: int [1], number of the step; increased by 1.
    """
    clear, sums = int(partial.device.is_cpu), (partial, partial_out, loss)
    wp.launch(
        _update_net,
        max(hidden.shape[0], output.shape[0], mean_loss.shape[0]),
        inputs=[rates, clear, *sums, adam, adam_out, hidden, output, mean_loss, control],
        device=partial.device,
    )
