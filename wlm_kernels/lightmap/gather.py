"""Turns the sums of `step` into gradients, and advances the schedule.

Read first: `kernels/stepping.py` in the tests, which reads these gradients and holds them to autograd's.
"""

import warp as wp


@wp.func
def drain(partial: wp.array2d[float], i: int, clear: int) -> float:
    """The sum of column i, which is cleared if `clear` isn't 0."""
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


@wp.kernel(enable_backward=False)
def _gather_maps_cuda(
    # in and out:
    acc: wp.array2d[wp.int64],
    parameters: wp.array1d[float],
    # out:
    grad: wp.array1d[float],
):
    i = wp.tid()
    grad[i] = float(acc[0, i]) * 9.094947017729282e-13  # steps of 2^-40, as `adjoint` adds them
    acc[0, i] = wp.int64(0)
    parameters[i] = wp.clamp(parameters[i], 0.0, 1.0)


@wp.kernel(enable_backward=False)
def _gather_net(
    # in and out:
    partial: wp.array2d[float],
    partial_out: wp.array2d[float],
    loss: wp.array2d[float],
    clear: int,
    schedule: wp.array1d[float],
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
        grad[i] = drain(partial, i, clear)
    if i < grad_out.shape[0]:
        grad_out[i] = drain(partial_out, i, clear)
    if i < mean_loss.shape[0]:
        s = drain(loss, i, clear)
        mean_loss[i] = mean_loss[i] + (s - mean_loss[i]) * 0.02  # a running mean over about 50 steps
    if i == 0:
        share = schedule[wp.min(control[0], schedule.shape[0] - 1)]
        rates[0] = share * first_rates[0]
        rates[1] = share * first_rates[1]
        control[0] = control[0] + 1


def gather_maps(acc: wp.array, parameters: wp.array, grad: wp.array, base: int = 0, count: int | None = None) -> None:
    """Turns the maps' sums that `StepKernels.launch` left into gradients, and clears them.

    Args:
        acc: [lanes, M], the sums; cleared.
        parameters: float [M], the maps; clamped to [0, 1].
        grad: float [M], written.
        base, count: On the CPU, the range that this launch takes; default all.
    """
    device = parameters.device
    if device.is_cpu:
        dim = parameters.shape[0] - base if count is None else count
        wp.launch(_gather_maps_cpu, dim, inputs=[acc, parameters, base], outputs=[grad], device=device)
    else:
        wp.launch(_gather_maps_cuda, parameters.shape, inputs=[acc, parameters], outputs=[grad], device=device)


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
    """Turns the networks' sums into gradients, and advances the schedule by one step.

    Args:
        partial, partial_out, loss: The networks' sums as float [P, ...]; cleared on the CPU.
        schedule: float [steps], fraction of the initial learning rates at each step.
        first_rates: The initial learning rates of the maps and of the networks.
        control: int [1], the step; increased.
        grad, grad_out: float, the networks' gradients, written.
        mean_loss: float [N], running mean of each tile's loss, updated.
        rates: float [2], the learning rates of this step, written.
    """
    device = partial.device
    wp.launch(
        _gather_net,
        max(grad.shape[0], grad_out.shape[0], mean_loss.shape[0]),
        inputs=[partial, partial_out, loss, int(device.is_cpu), schedule, wp.vec2(*first_rates), control],
        outputs=[grad, grad_out, mean_loss, rates],
        device=device,
    )
