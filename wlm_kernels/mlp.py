"""A small MLP with two hidden layers of one width, GELU between and no activation at the output.

The weights of N networks lie in two arrays, column by column, so that a layer is ``h += column[c] * x[c]``:

    hidden  [N, I + 1 + H + 1] of vecH: I columns of the first layer, its bias, H columns of the second, its bias
    output  [N, H + 1] of vec3:         H columns of the third layer, its bias

I inputs, H units (any width; 8 to 64 are tested), 3 outputs. ``kernels`` builds and caches the functions of one
shape. GELU is "exact" (erf), "tanh" (the tanh form, within 4.8e-4 of it) or "fast" (the tanh form with the GPU's own
tanh instruction, 2^-11 relative; on the CPU the same as "tanh").

Two ways back: ``MlpKernels.backward`` is by hand, and ``linear`` with ``activate`` is recorded by ``wp.Tape``: one
thread an output, so that no accumulator has to be replayed (a dynamic loop's isn't, see the tests).
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

__all__ = ["GELUS", "MlpKernels", "activate", "kernels", "linear", "parameter_count"]

GELUS = ("exact", "tanh", "fast")


# GELU is x gate(x). Its derivative is made of the same gate, so that training evaluates each erf or tanh once.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("tanh.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return wp::tanh(x);
#endif
""")
def fast_tanh(x: float) -> float: ...


@wp.func
def gate_exact(x: float) -> float:
    return 0.5 + 0.5 * wp.erf(x * 0.7071067811865476)


@wp.func
def slope_exact(x: float, gate: float) -> float:
    return gate + x * 0.3989422804014327 * wp.exp(-0.5 * x * x)


# In the tanh form x (0.79788 + 0.035677 x^2) is sqrt(2 / pi) (x + 0.044715 x^3).


@wp.func
def gate_tanh(x: float) -> float:
    # (1 + tanh z) / 2 is 1 / (1 + exp(-2 z)); tanh itself is slow on a CPU.
    return 1.0 / (1.0 + wp.exp(x * (-1.5957691216057308 - 0.07135481627260025 * x * x)))


@wp.func
def gate_fast(x: float) -> float:
    return 0.5 + 0.5 * fast_tanh(x * (0.7978845608028654 + 0.035677408136300125 * x * x))


@wp.func
def slope_tanh(x: float, gate: float) -> float:
    # 1 - tanh^2 is 4 gate (1 - gate).
    return gate + 2.0 * x * gate * (1.0 - gate) * (0.7978845608028654 + 0.10703222440890037 * x * x)


_GELU = {
    "exact": (gate_exact, slope_exact),
    "tanh": (gate_tanh, slope_tanh),
    "fast": (gate_fast, slope_tanh),
}


@dataclass(frozen=True)
class MlpKernels:
    """The functions of one shape of network, for use inside kernels, and two launchers.

    Attributes:
        inputs: I, number of inputs.
        hidden: H, width of both hidden layers.
        vec_in: vec of I floats.
        vec_hidden: vec of H floats.
        first, second, third: ``wp.func`` of each layer before its activation.
        act: ``wp.func`` vecH -> vecH, GELU.
        gate, slope: ``wp.func``s with act(a) = a gate(a), and its derivative slope(a, gate(a)).
        back_hidden: ``wp.func``: delta of the second layer -> gradient of its input.
        back_output: ``wp.func``: delta of the third layer -> gradient of its input.
        back_input: ``wp.func``: delta of the first layer -> gradient of the network's input.
    """

    inputs: int
    hidden: int
    vec_in: Any
    vec_hidden: Any
    first: Any
    second: Any
    third: Any
    act: Any
    gate: Any
    slope: Any
    back_hidden: Any
    back_output: Any
    back_input: Any
    _forward: Any
    _deltas: Any
    _weights: Any

    def forward(self, hidden, output, x, y) -> None:
        """Evaluates N networks on B inputs each.

        Args:
            hidden: vecH [N, I + H + 2], see the module.
            output: vec3 [N, H + 1].
            x: vecI [N, B].
            y: vec3 [N, B], written.
        """
        wp.launch(self._forward, x.shape, inputs=[hidden, output, x], outputs=[y], device=x.device)

    def backward(self, hidden, output, x, grad_y, grad_x, grad_hidden, grad_output) -> None:
        """All gradients by hand; sums run in a fixed order, so that they repeat exactly.

        Args:
            hidden, output, x: As for ``forward``.
            grad_y: vec3 [N, B].
            grad_x: vecI [N, B], written.
            grad_hidden: vecH [N, I + H + 2], written.
            grad_output: vec3 [N, H + 1], written.
        """
        scratch = [wp.empty(x.shape, dtype=self.vec_hidden, device=x.device) for _ in range(4)]
        wp.launch(
            self._deltas,
            x.shape,
            inputs=[hidden, output, x, grad_y],
            outputs=[grad_x, *scratch],
            device=x.device,
        )
        rows = self.inputs + 2 * self.hidden + 3
        wp.launch(
            self._weights,
            (x.shape[0], rows),
            inputs=[x, grad_y, *scratch],
            outputs=[grad_hidden, grad_output],
            device=x.device,
        )


def parameter_count(inputs: int, hidden: int) -> int:
    """Scalars in one network of the given shape."""
    return (inputs + hidden + 2) * hidden + 3 * (hidden + 1)


@functools.cache
def kernels(inputs: int, hidden: int, gelu: str = "exact") -> MlpKernels:
    """Builds (once) the functions of one network shape.

    Args:
        inputs: I >= 1.
        hidden: H >= 1.
        gelu: One of ``GELUS``.

    Raises:
        ValueError: On a shape below 1 or an unknown activation.
    """
    if inputs < 1 or hidden < 1 or gelu not in GELUS:
        raise ValueError(f"no MLP of {inputs} inputs, {hidden} units and GELU {gelu!r}")
    vec_in = wp.types.vector(inputs, float)
    vec_hidden = wp.types.vector(hidden, float)
    gate_of, slope_of = _GELU[gelu]
    bias_1 = inputs
    columns_2 = inputs + 1
    bias_2 = inputs + 1 + hidden

    @wp.func
    def first(w: wp.array2d[vec_hidden], n: int, x: vec_in) -> vec_hidden:
        h = w[n, wp.static(bias_1)]
        for c in range(wp.static(inputs)):
            h += w[n, c] * x[c]
        return h

    @wp.func
    def second(w: wp.array2d[vec_hidden], n: int, x: vec_hidden) -> vec_hidden:
        h = w[n, wp.static(bias_2)]
        for c in range(wp.static(hidden)):
            h += w[n, wp.static(columns_2) + c] * x[c]
        return h

    @wp.func
    def third(w: wp.array2d[wp.vec3], n: int, x: vec_hidden) -> wp.vec3:
        y = w[n, wp.static(hidden)]
        for c in range(wp.static(hidden)):
            y += w[n, c] * x[c]
        return y

    @wp.func
    def gate(a: vec_hidden) -> vec_hidden:
        g = vec_hidden()
        for j in range(wp.static(hidden)):
            g[j] = gate_of(a[j])
        return g

    @wp.func
    def act(a: vec_hidden) -> vec_hidden:
        return wp.cw_mul(a, gate(a))

    @wp.func
    def slope(a: vec_hidden, g: vec_hidden) -> vec_hidden:
        s = vec_hidden()
        for j in range(wp.static(hidden)):
            s[j] = slope_of(a[j], g[j])
        return s

    @wp.func
    def back_hidden(w: wp.array2d[vec_hidden], n: int, delta: vec_hidden) -> vec_hidden:
        g = vec_hidden()
        for c in range(wp.static(hidden)):
            g[c] = wp.dot(w[n, wp.static(columns_2) + c], delta)
        return g

    @wp.func
    def back_output(w: wp.array2d[wp.vec3], n: int, delta: wp.vec3) -> vec_hidden:
        g = vec_hidden()
        for c in range(wp.static(hidden)):
            g[c] = wp.dot(w[n, c], delta)
        return g

    @wp.func
    def back_input(w: wp.array2d[vec_hidden], n: int, delta: vec_hidden) -> vec_in:
        g = vec_in()
        for c in range(wp.static(inputs)):
            g[c] = wp.dot(w[n, c], delta)
        return g

    options = {"enable_backward": False}

    @wp.kernel(module="unique", module_options=options)
    def forward(
        # in:
        w: wp.array2d[vec_hidden],
        o: wp.array2d[wp.vec3],
        x: wp.array2d[vec_in],
        # out:
        y: wp.array2d[wp.vec3],
    ):
        n, b = wp.tid()
        h1 = act(first(w, n, x[n, b]))
        h2 = act(second(w, n, h1))
        y[n, b] = third(o, n, h2)

    @wp.kernel(module="unique", module_options=options)
    def deltas(
        # in:
        w: wp.array2d[vec_hidden],
        o: wp.array2d[wp.vec3],
        x: wp.array2d[vec_in],
        grad_y: wp.array2d[wp.vec3],
        # out:
        grad_x: wp.array2d[vec_in],
        h1_out: wp.array2d[vec_hidden],
        h2_out: wp.array2d[vec_hidden],
        d1_out: wp.array2d[vec_hidden],
        d2_out: wp.array2d[vec_hidden],
    ):
        n, b = wp.tid()
        a1 = first(w, n, x[n, b])
        g1 = gate(a1)
        h1 = wp.cw_mul(a1, g1)
        a2 = second(w, n, h1)
        g2 = gate(a2)
        d2 = wp.cw_mul(back_output(o, n, grad_y[n, b]), slope(a2, g2))
        d1 = wp.cw_mul(back_hidden(w, n, d2), slope(a1, g1))
        grad_x[n, b] = back_input(w, n, d1)
        h1_out[n, b] = h1
        h2_out[n, b] = wp.cw_mul(a2, g2)
        d1_out[n, b] = d1
        d2_out[n, b] = d2

    @wp.kernel(module="unique", module_options=options)
    def weights(
        # in:
        x: wp.array2d[vec_in],
        grad_y: wp.array2d[wp.vec3],
        h1: wp.array2d[vec_hidden],
        h2: wp.array2d[vec_hidden],
        d1: wp.array2d[vec_hidden],
        d2: wp.array2d[vec_hidden],
        # out:
        grad_w: wp.array2d[vec_hidden],
        grad_o: wp.array2d[wp.vec3],
    ):
        n, row = wp.tid()
        count = x.shape[1]
        column = vec_hidden()
        colour = wp.vec3()
        if row < wp.static(bias_1):
            for b in range(count):
                column += d1[n, b] * x[n, b][row]
        elif row == wp.static(bias_1):
            for b in range(count):
                column += d1[n, b]
        elif row < wp.static(bias_2):
            for b in range(count):
                column += d2[n, b] * h1[n, b][row - wp.static(columns_2)]
        elif row == wp.static(bias_2):
            for b in range(count):
                column += d2[n, b]
        elif row < wp.static(bias_2 + 1 + hidden):
            for b in range(count):
                colour += grad_y[n, b] * h2[n, b][row - wp.static(bias_2 + 1)]
        else:
            for b in range(count):
                colour += grad_y[n, b]
        if row <= wp.static(bias_2):
            grad_w[n, row] = column
        else:
            grad_o[n, row - wp.static(bias_2 + 1)] = colour

    return MlpKernels(
        inputs,
        hidden,
        vec_in,
        vec_hidden,
        first,
        second,
        third,
        act,
        gate,
        slope,
        back_hidden,
        back_output,
        back_input,
        forward,
        deltas,
        weights,
    )


@wp.kernel
def _linear(
    # in:
    w: wp.array2d[float],
    bias_row: int,
    first_row: int,
    x: wp.array2d[float],
    groups: wp.array1d[int],
    width: int,
    # out:
    y: wp.array2d[float],
):
    i, j = wp.tid()
    n = groups[i]
    s = w[n, bias_row * width + j]
    for c in range(x.shape[1]):
        s += w[n, (first_row + c) * width + j] * x[i, c]
    y[i, j] = s


@wp.kernel
def _gelu(x: wp.array2d[float], y: wp.array2d[float]):
    i, j = wp.tid()
    y[i, j] = x[i, j] * gate_exact(x[i, j])


def linear(weights, first_row: int, bias_row: int, x, groups, y) -> None:
    """One layer of N networks for the tape: y[i] = W[groups[i]] x[i] + b.

    Args:
        weights: float [N, rows * W], the scalars of ``hidden`` or ``output`` above; W is the layer's width.
        first_row: Row of the layer's first column.
        bias_row: Row of its bias.
        x: float [M, I].
        groups: int [M], the network of each row.
        y: float [M, W], written.
    """
    wp.launch(
        _linear,
        y.shape,
        inputs=[weights, bias_row, first_row, x, groups, y.shape[1]],
        outputs=[y],
        device=x.device,
    )


def activate(x, y) -> None:
    """Exact GELU of each entry of x into y, both float [M, W]; recorded by an open ``wp.Tape``."""
    wp.launch(_gelu, x.shape, inputs=[x], outputs=[y], device=x.device)
