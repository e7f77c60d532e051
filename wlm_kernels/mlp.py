"""A small MLP with two hidden layers of equal width, GELU activations and a linear output.

The weights of N networks are stored in two arrays, column by column, so that a layer is `h += column[c] * x[c]`:

    hidden  [N, I + 1 + H + 1] of vecH: I columns of the first layer, its bias, H columns of the second, its bias
    output  [N, H + 1] of vecO:         H columns of the third layer, its bias

A network has I inputs, H units in each hidden layer (any width; 8 to 64 are tested) and O outputs. `kernels` builds and
caches the functions of one shape. GELU is "exact" (erf), "tanh" (the tanh form, within 4.8e-4 of "exact") or "fast"
(the tanh form with the GPU's tanh instruction, whose relative error is 2^-11; on the CPU the same as "tanh").

`MlpKernels.backward` computes the gradients of the inputs and of each layer's result. The gradients of the weights are
matrix products of these, which `wlm.ops.mlp` leaves to torch. `benchmarks.plain.mlp` is the same network in ten lines.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

GELUS = ("exact", "tanh", "fast")


# GELU is x gate(x). Its derivative uses the same gate, so that training evaluates each erf or tanh once.


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


_GELU = {"exact": (gate_exact, slope_exact), "tanh": (gate_tanh, slope_tanh), "fast": (gate_fast, slope_tanh)}


@dataclass(frozen=True)
class MlpKernels:
    """The functions of one shape of network, for use inside kernels, and two functions that launch kernels.

    Attributes:
        inputs: I, number of inputs.
        hidden: H, width of the two hidden layers.
        vec_in, vec_hidden, vec_out: Warp's types of vectors of I, H and O floats.
        first, second, third: `wp.func` of each layer before its activation.
        act: `wp.func` of GELU, from vecH to vecH.
        gate, slope: `wp.func`s with act(a) = a gate(a), and its derivative slope(a, gate(a)).
        back_hidden, back_output, back_input: `wp.func`s that convert the gradient of the result before activation of
            the second, third and first layer to the gradient of the layer's input.
    """

    inputs: int
    hidden: int
    vec_in: Any
    vec_hidden: Any
    vec_out: Any
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
    _backward: Any

    def forward(self, hidden, output, x, y) -> None:
        """Evaluates N networks on B inputs each, `x`, vecI [N, B]; writes the outputs `y`, vecO [N, B]. The layers are
        `hidden`, vecH [N, I + H + 2], see the module, and `output`, vecO [N, H + 1]."""
        wp.launch(self._forward, x.shape, inputs=[hidden, output, x], outputs=[y], device=x.device)

    def backward(self, hidden, output, x, grad_y, grad_x, h1, h2, d1, d2) -> None:
        """Computes the gradients of the inputs and of each layer's result, one input of one network per thread.

        If h is a layer's input and d the gradient of its result before the activation, the gradient of its weights is
        h^T d, and of its bias the sum of d. The three layers' (h, d) are (x, d1), (h1, d2), (h2, grad_y).

        Args:
            hidden, output, x: Weights and inputs, see `forward`.
            grad_y: vecO [N, B], gradient of the outputs.
            grad_x: vecI [N, B], written: gradient of the inputs.
            h1, h2: vecH [N, B], written: the hidden layers' results.
            d1, d2: vecH [N, B], written: gradients of the hidden layers' results before their activation.
        """
        inputs = [hidden, output, x, grad_y]
        wp.launch(self._backward, x.shape, inputs=inputs, outputs=[grad_x, h1, h2, d1, d2], device=x.device)


def parameter_count(inputs: int, hidden: int) -> int:
    """Returns the number of weights and biases in one network with three outputs."""
    return (inputs + hidden + 2) * hidden + 3 * (hidden + 1)


@functools.cache
def kernels(inputs: int, hidden: int, gelu: str = "exact", outputs: int = 3) -> MlpKernels:
    """Returns the functions of one network shape, which are built once and cached.

    Args:
        inputs: I >= 1, number of inputs.
        hidden: H >= 1, width of the two hidden layers.
        gelu: One of `GELUS`.
        outputs: O >= 1, number of outputs.
    """
    if min(inputs, hidden, outputs) < 1 or gelu not in GELUS:
        raise ValueError(f"MLP: expected sizes above 0 and GELU {GELUS}, got {inputs, hidden, outputs, gelu}")
    vec_in = wp.types.vector(inputs, float)
    vec_hidden = wp.types.vector(hidden, float)
    vec_out = wp.vec3 if outputs == 3 else wp.types.vector(outputs, float)
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
    def third(w: wp.array2d[vec_out], n: int, x: vec_hidden) -> vec_out:
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
    def back_output(w: wp.array2d[vec_out], n: int, delta: vec_out) -> vec_hidden:
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
        o: wp.array2d[vec_out],
        x: wp.array2d[vec_in],
        # out:
        y: wp.array2d[vec_out],
    ):
        n, b = wp.tid()
        h1 = act(first(w, n, x[n, b]))
        h2 = act(second(w, n, h1))
        y[n, b] = third(o, n, h2)

    @wp.kernel(module="unique", module_options=options)
    def backward(
        # in:
        w: wp.array2d[vec_hidden],
        o: wp.array2d[vec_out],
        x: wp.array2d[vec_in],
        grad_y: wp.array2d[vec_out],
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

    return MlpKernels(
        inputs,
        hidden,
        vec_in,
        vec_hidden,
        vec_out,
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
        backward,
    )
