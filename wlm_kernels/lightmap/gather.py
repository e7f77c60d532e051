"""Converts the sums of a training step (`step`) to gradients; on a GPU also updates the parameters with Adam.

On a GPU the launches that sum the gradients also run Adam. Torch's fused Adam would read and write the gradients once
more, and would use only one to six multiprocessors for the networks of 64 tiles, because it gives 65,536 numbers to
each block of threads.

Read `tests/kernels/stepping.py` first; it compares these gradients with autograd's.
"""

import warp as wp


@wp.func
def drain(partial: wp.array2d[float], i: int, clear: int) -> float:
    """Returns the sum of column i, and sets the column to 0 if `clear` is not 0."""
    s = float(0.0)
    for p in range(partial.shape[0]):
        s += partial[p, i]
        if clear != 0:
            partial[p, i] = 0.0
    return s


@wp.kernel(enable_backward=False)
def _gather_maps_cpu(
    # in and out:
    acc: wp.array2d[float],
    parameters: wp.array1d[float],
    base: int,
    # out:
    grad: wp.array1d[float],
):
    i = base + wp.tid()
    grad[i] = drain(acc, i, 1)
    parameters[i] = wp.clamp(parameters[i], 0.0, 1.0)


@wp.struct
class Adam:
    """Settings of the optimiser Adam, and its moments of one array of parameters."""

    decay: wp.vec2  # of the gradients and of their squares
    epsilon: float
    first: wp.array1d[float]
    second: wp.array1d[float]


@wp.func
def moved(adam: Adam, i: int, value: float, grad: float, rate: float, corrections: wp.vec2) -> float:
    """Returns parameter i, now `value`, after Adam's step t, and updates its moments. `corrections` are 1 - decay[0]^t
    and sqrt(1 - decay[1]^t), since the moments began at 0."""
    first = adam.decay[0] * adam.first[i] + (1.0 - adam.decay[0]) * grad
    second = adam.decay[1] * adam.second[i] + (1.0 - adam.decay[1]) * grad * grad
    adam.first[i] = first
    adam.second[i] = second
    return value - rate / corrections[0] * first / (wp.sqrt(second) / corrections[1] + adam.epsilon)


@wp.kernel(enable_backward=False)
def _update_maps(
    # in:
    schedule: wp.array1d[wp.vec3],
    first_rates: wp.vec2,
    control: wp.array1d[int],
    move: int,
    # in and out:
    acc: wp.array2d[wp.int64],
    adam: Adam,
    parameters: wp.array1d[float],
    # out:
    grad: wp.array1d[float],
    rates: wp.array1d[float],
):
    i = wp.tid()
    now = schedule[wp.min(control[0], schedule.shape[0] - 1)]
    g = float(acc[0, i]) * 9.094947017729282e-13  # steps of 2^-40, as `adjoint` adds them
    acc[0, i] = wp.int64(0)
    grad[i] = g
    value = wp.clamp(parameters[i], 0.0, 1.0)
    if move != 0:
        value = moved(adam, i, value, g, now[0] * first_rates[0], wp.vec2(now[1], now[2]))
    parameters[i] = value
    if i == 0:
        rates[0] = now[0] * first_rates[0]
        rates[1] = now[0] * first_rates[1]
        rates[2] = now[1]
        rates[3] = now[2]


@wp.func
def toward(mean: float, value: float) -> float:
    """Returns a running mean over about 50 steps, updated with a new value."""
    return mean + (value - mean) * 0.02


@wp.kernel(enable_backward=False)
def _update_net(
    # in:
    partial: wp.array2d[float],
    partial_out: wp.array2d[float],
    loss: wp.array2d[float],
    rates: wp.array1d[float],
    # in and out:
    adam: Adam,
    adam_out: Adam,
    hidden: wp.array1d[float],
    output: wp.array1d[float],
    mean_loss: wp.array1d[float],
    control: wp.array1d[int],
    # out:
    grad: wp.array1d[float],
    grad_out: wp.array1d[float],
):
    i = wp.tid()
    corrections = wp.vec2(rates[2], rates[3])
    if i < grad.shape[0]:
        g = drain(partial, i, 0)
        grad[i] = g
        hidden[i] = moved(adam, i, hidden[i], g, rates[1], corrections)
    if i < grad_out.shape[0]:
        g_out = drain(partial_out, i, 0)
        grad_out[i] = g_out
        output[i] = moved(adam_out, i, output[i], g_out, rates[1], corrections)
    if i < mean_loss.shape[0]:
        mean_loss[i] = toward(mean_loss[i], drain(loss, i, 0))
    if i == 0:
        control[0] = control[0] + 1


@wp.kernel(enable_backward=False)
def _gather_net(
    # in and out:
    partial: wp.array2d[float],
    partial_out: wp.array2d[float],
    loss: wp.array2d[float],
    schedule: wp.array1d[wp.vec3],
    first_rates: wp.vec2,
    control: wp.array1d[int],
    # out:
    grad: wp.array1d[float],
    grad_out: wp.array1d[float],
    mean_loss: wp.array1d[float],
    rates: wp.array1d[float],
):
    i = wp.tid()
    if i < grad.shape[0]:
        grad[i] = drain(partial, i, 1)
    if i < grad_out.shape[0]:
        grad_out[i] = drain(partial_out, i, 1)
    if i < mean_loss.shape[0]:
        mean_loss[i] = toward(mean_loss[i], drain(loss, i, 1))
    if i == 0:
        share = schedule[wp.min(control[0], schedule.shape[0] - 1)][0]
        rates[0] = share * first_rates[0]
        rates[1] = share * first_rates[1]
        control[0] = control[0] + 1


def gather_maps(acc: wp.array, parameters: wp.array, grad: wp.array, base: int = 0, count: int | None = None) -> None:
    """Converts the maps' sums from `StepKernels.launch` on the CPU into gradients, and sets the sums to 0.

    Args:
        acc: float [lanes, M], sums for the M parameters of the maps, a row for each CPU thread (lane); set to 0.
        parameters: float [M], the maps; clamped to [0, 1].
        grad: float [M], written.
        base, count: First index and number of parameters that this launch converts; default all.
    """
    dim = parameters.shape[0] - base if count is None else count
    wp.launch(_gather_maps_cpu, dim, inputs=[acc, parameters, base], outputs=[grad], device=parameters.device)


def gather_net(
    partial: wp.array,
    partial_out: wp.array,
    loss: wp.array,
    schedule: wp.array,
    first_rates: tuple[float, float],
    control: wp.array,
    grad: wp.array,
    grad_out: wp.array,
    mean_loss: wp.array,
    rates: wp.array,
) -> None:
    """Converts the networks' sums on the CPU into gradients, and advances the schedule of learning rates by one step.

    Args:
        partial, partial_out, loss: Sums of P threads for hidden and output layers and losses, float [P, ...]; set to 0.
        schedule: vec3 [steps], whose first component is the factor on the initial learning rates at each step.
        first_rates: The initial learning rates of the maps and of the networks.
        control: int [1], number of the step; increased by 1.
        grad, grad_out: float, written: gradients of the hidden and output layers.
        mean_loss: float [N], running mean of each tile's loss, updated.
        rates: float [2], written: the learning rates of the maps and of the networks at this step.
    """
    wp.launch(
        _gather_net,
        max(grad.shape[0], grad_out.shape[0], mean_loss.shape[0]),
        inputs=[partial, partial_out, loss, schedule, wp.vec2(*first_rates), control],
        outputs=[grad, grad_out, mean_loss, rates],
        device=partial.device,
    )


def update_maps(
    schedule: wp.array,
    first_rates: tuple[float, float],
    control: wp.array,
    move: bool,
    acc: wp.array,
    adam: Adam,
    parameters: wp.array,
    grad: wp.array,
    rates: wp.array,
) -> None:
    """Converts the maps' integer sums into gradients and updates the maps with Adam: the first half of a step's update.

    Args:
        schedule: vec3 [steps]: the factor on the initial learning rates, and Adam's two corrections, see `moved`.
        first_rates: The initial learning rates of the maps and of the networks.
        control: int [1], number of the step.
        move: Whether Adam updates the maps; they are clamped in any case.
        acc: int64 [1, M], the sums in steps of 2^-40; set to 0.
        adam: State of the optimiser, updated.
        parameters: float [M], the maps; clamped to [0, 1], then updated.
        grad: float [M], written.
        rates: float [4], written: the learning rates of maps and networks at this step, and Adam's two corrections.
    """
    wp.launch(
        _update_maps,
        parameters.shape,
        inputs=[schedule, wp.vec2(*first_rates), control, int(move), acc, adam, parameters],
        outputs=[grad, rates],
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
    grad: wp.array,
    grad_out: wp.array,
) -> None:
    """Converts the networks' sums on a GPU into gradients and updates the networks with Adam: ends a step's update.

    Args:
        partial, partial_out, loss: Sums of P thread blocks for hidden and output layers and losses, float [P, ...].
        rates: As `update_maps` wrote them.
        adam, adam_out: States of the optimisers of hidden and output layers, updated.
        hidden, output: float, the hidden and output layers, updated.
        mean_loss: float [N], running mean of each tile's loss, updated.
        control: int [1], number of the step; increased by 1.
        grad, grad_out: float, written: gradients of the hidden and output layers.
    """
    wp.launch(
        _update_net,
        max(grad.shape[0], grad_out.shape[0], mean_loss.shape[0]),
        inputs=[partial, partial_out, loss, rates, adam, adam_out, hidden, output, mean_loss, control],
        outputs=[grad, grad_out],
        device=partial.device,
    )
