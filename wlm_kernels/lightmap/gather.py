"""Ends a training step: converts the sums of `step` to gradients, and updates all parameters with Adam in one launch.

Read `tests/kernels/test_optimiser.py` first; it compares the updates with those of torch's Adam.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.lightmap.blocks import over_255, ste_endpoint, ste_weight
from wlm_kernels.lightmap.features import INPUTS, Maps, four_at
from wlm_kernels.native import native_source, on_cuda

wp.set_module_options({"enable_backward": False})

# Muon changes each singular value x of a momentum to A x + B x^3 + C x^5, five times.
_MUON = "constexpr float A = 3.4445f, B = -4.775f, C = 2.0315f;\n"
_MUON_SHARE = 0.2  # root mean square of a move over the rate, about that of Adam's


@wp.func
def _drain(sums: wp.array2d[float], i: int, clear: int) -> float:
    """Returns the sum of column i, and sets the column to 0 if `clear` is not 0."""
    s = float(0.0)
    for p in range(sums.shape[0]):
        s += sums[p, i]
    if clear != 0:  # a loop of its own: reads do not wait for writes
        for p in range(sums.shape[0]):
            sums[p, i] = 0.0
    return s


@wp.func_native(native_source(__package__, "put_four"))
def _put_four(values: wp.array1d[float], i: int, v: wp.vec4): ...


@wp.func_native(native_source(__package__, "take_four"))
def _take_four(sums: wp.array2d[wp.int64], i: int) -> wp.vec4: ...


@wp.func
def _drain_four(sums: wp.array2d[float], i: int) -> wp.vec4:
    return wp.vec4(
        _drain(sums, 4 * i, 1), _drain(sums, 4 * i + 1, 1), _drain(sums, 4 * i + 2, 1), _drain(sums, 4 * i + 3, 1)
    )


@wp.func
def _drain_four(sums: wp.array2d[wp.int64], i: int) -> wp.vec4:
    return _take_four(sums, i) * 9.094947017729282e-13  # steps of 2^-40, as `adjoint` adds them


@wp.struct
class Adam:
    """Settings of the optimiser Adam, and its moments of one array of parameters."""

    decay: wp.vec2  # of the gradients and of their squares
    epsilon: float
    first: wp.array1d[float]
    second: wp.array1d[float]


@wp.func
def _moved(state: wp.vec3, grad: float, decay: wp.vec2, epsilon: float, rate: float, corrections: wp.vec2) -> wp.vec3:
    """Returns a parameter and its two moments after Adam's step t. `corrections` are 1 / (1 - decay[0]^t) and
    1 / sqrt(1 - decay[1]^t), since the moments began at 0."""
    m = decay[0] * state[1] + (1.0 - decay[0]) * grad
    v = decay[1] * state[2] + (1.0 - decay[1]) * grad * grad
    return wp.vec3(state[0] - rate * corrections[0] * m / (wp.sqrt(v) * corrections[1] + epsilon), m, v)


@wp.func
def _move(values: wp.array1d[float], adam: Adam, i: int, grad: float, rate: float, corrections: wp.vec2):
    old = wp.vec3(values[i], adam.first[i], adam.second[i])
    new = _moved(old, grad, adam.decay, adam.epsilon, rate, corrections)
    values[i] = new[0]
    adam.first[i] = new[1]
    adam.second[i] = new[2]


@wp.func
def _level(maps: Maps, at: int, v: wp.vec4) -> wp.vec4:
    """Returns the levels of the file nearest to four numbers of maps, from index `at` on."""
    if at < maps.uv_weights or (at >= maps.uvt_endpoints and at < maps.uvt_weights):
        return ste_endpoint(v, 1)
    if at < maps.ut:
        return wp.vec4(ste_weight(v[0], 1), ste_weight(v[1], 1), ste_weight(v[2], 1), ste_weight(v[3], 1))
    b = v * 255.0 + wp.vec4(0.5)
    return over_255(wp.vec4(wp.floor(b[0]), wp.floor(b[1]), wp.floor(b[2]), wp.floor(b[3])))


@wp.kernel
def _put_levels(
    # in:
    maps: Maps,
    # out:
    rounded: wp.array1d[float],
):
    at = 4 * wp.tid()
    _put_four(rounded, at, _level(maps, at, four_at(maps.values, at)))


@wp.kernel
def _update(
    # in:
    levels: int,
    base: int,
    clear: int,
    turned: int,
    rates: wp.array1d[wp.vec4],
    # in and out:
    acc: wp.array2d[Any],
    adam: Adam,
    maps: Maps,
    partial: wp.array2d[float],
    adam_hidden: Adam,
    hidden: wp.array1d[float],
    partial_out: wp.array2d[float],
    adam_out: Adam,
    output: wp.array1d[float],
    loss: wp.array2d[float],
    mean_loss: wp.array1d[float],
    control: wp.array1d[int],
    # out:
    rounded: wp.array1d[float],
):
    # Networks come first: their sums take longest.
    t = base + wp.tid()
    now = rates[0]
    corrections = wp.vec2(now[2], now[3])
    if t == 0:
        control[0] = control[0] + 1
    if t < hidden.shape[0]:
        row = t // wp.max(turned, 1) % (INPUTS + 2 + turned)
        bias = row == INPUTS or row == INPUTS + 1 + turned
        rate = wp.where(turned == 0 or bias, now[1], 0.0)
        _move(hidden, adam_hidden, t, _drain(partial, t, clear), rate, corrections)
        return
    t -= hidden.shape[0]
    if t < output.shape[0]:
        _move(output, adam_out, t, _drain(partial_out, t, clear), now[1], corrections)
        return
    t -= output.shape[0]
    if t < mean_loss.shape[0]:
        mean_loss[t] += (_drain(loss, t, clear) - mean_loss[t]) * 0.02
        return
    t -= mean_loss.shape[0]
    # All reads come before the first write, for which they would wait.
    at = 4 * t
    value = four_at(maps.values, at)
    first = four_at(adam.first, at)
    second = four_at(adam.second, at)
    grad = _drain_four(acc, t)
    for c in range(4):
        new = _moved(wp.vec3(value[c], first[c], second[c]), grad[c], adam.decay, adam.epsilon, now[0], corrections)
        value[c] = wp.clamp(new[0], 0.0, 1.0)
        first[c] = new[1]
        second[c] = new[2]
    _put_four(maps.values, at, value)
    _put_four(adam.first, at, first)
    _put_four(adam.second, at, second)
    if levels != 0:
        _put_four(rounded, at, _level(maps, at, value))


# Both forms are compiled with the module: the threads of a fit on the CPU would compile one at the same time.
for _scalar in (float, wp.int64):
    wp.overload(_update, {"acc": wp.array2d[_scalar]})


def update(
    *arguments: Any,
    frozen: bool = False,
    levels: bool = False,
    clear: bool,
    turned: int = 0,
    lane: int = 0,
    lanes: int = 1,
) -> None:
    """Converts sums into gradients, updates the parameters with Adam and running means of losses, and counts the step.

    Args:
        arguments: Those of `_update` in its order. Sums are as `StepKernels.launch` adds them, those of maps are set to
            0; `maps` are updated and clamped to [0, 1]; `rounded` gets their levels in the file.
        frozen, levels, clear: Whether only networks are updated, `rounded` is written, networks' sums are set to 0.
        turned: H if `turn` moves the weights of the hidden layers, of which only moments are updated here, else 0.
        lane, lanes: This launch updates one of so many parts of all parameters.
    """
    maps, hidden, output, mean_loss = (arguments[i] for i in (3, 6, 9, 11))
    total = hidden.shape[0] + output.shape[0] + mean_loss.shape[0] + (0 if frozen else maps.values.shape[0] // 4)
    first, last = (min(total, each * -(-total // lanes)) for each in (lane, lane + 1))
    wp.launch(_update, last - first, inputs=[int(levels), first, int(clear), turned, *arguments], device=hidden.device)


def put_on_levels(maps: Maps, rounded: Maps) -> None:
    """Writes the levels of the file that are nearest to `maps.values` to `rounded.values`."""
    values = maps.values
    wp.launch(_put_levels, values.shape[0] // 4, inputs=[maps], outputs=[rounded.values], device=values.device)


def _turn_threads(width: int, is_cuda: bool) -> int:
    """Returns the number of threads that move a layer together: on a GPU a warp for each 16 x 16 weights."""
    return width * width // 8 if is_cuda else 1


@functools.cache
def _turn_kernel(width: int, threads: int) -> Any:
    cuda = native_source(__package__, "orthogonal", H=width, T=threads)
    cuda = native_source("wlm_kernels", "matrix_units") + _MUON + cuda
    cpu = _MUON + native_source(__package__, "orthogonal_cpu", H=width, I=INPUTS)

    @wp.func_native(on_cuda(cuda, cpu))
    def move(momentum: wp.array1d[float], at: int, rows: int, rate: float, weights: wp.array1d[float]): ...

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def turn(rates: wp.array1d[wp.vec4], momentum: wp.array1d[float], weights: wp.array1d[float]):
        n, layer, _thread = wp.tid()
        rows = wp.where(layer == 0, INPUTS, width)
        at = (n * wp.static(INPUTS + 2 + width) + layer * wp.static(INPUTS + 1)) * width
        size = wp.sqrt(float(wp.max(rows, width)))
        move(momentum, at, rows, rates[0][1] * wp.static(_MUON_SHARE) * size, weights)

    return turn


def load(device: str, turned: int) -> None:
    """Compiles `update` for a device, and `turn` of a width, unless it is 0; the first launch would do so otherwise."""
    wp.load_module(_update.module, device)
    if turned:
        threads = _turn_threads(turned, device != "cpu")
        wp.load_module(_turn_kernel(turned, threads).module, device, block_dim=threads)


def turn(width: int, rates: wp.array, momentum: wp.array, weights: wp.array) -> None:
    """Moves the weights of networks' hidden layers of a width H, float [N (18 + H) H] as in `wlm_kernels.mlp`, with
    Muon: along their momentum made orthogonal (Jordan et al., 2024), at the rate `rates[0][1]`. Biases stay."""
    threads = _turn_threads(width, weights.device.is_cuda)
    shape, kernel = (weights.shape[0] // ((INPUTS + 2 + width) * width), 2, threads), _turn_kernel(width, threads)
    wp.launch(kernel, shape, inputs=[rates, momentum, weights], device=weights.device, block_dim=threads)
