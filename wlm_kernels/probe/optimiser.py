"""The optimisers of Gaussians and network, one number per thread: Adan or Adam (gaussian-probe-compression, section 5).

A whole step must be in one CUDA graph, which excludes libraries that count steps in Python. The references are torch's
Adam and pytorch-optimizer's Adan, with which `tests/kernels/test_probe_step.py` compares these.
"""

import functools

import warp as wp

from wlm_kernels.probe.gaussians import LATENT, SHAPE_NUMBERS, Shape, functions

# Range of the logarithm of a scale, in the normalised frame.
LOG_SCALES = wp.constant(wp.vec2(-9.21, 1.39))  # 1e-4 to 4
ADAM = wp.constant(wp.vec2(0.9, 0.999))
ADAN = wp.constant(wp.vec3(0.98, 0.92, 0.99))  # as Xie et al. and pytorch-optimizer have them
EPSILON = wp.constant(1.0e-8)

_vec8 = wp.types.vector(8, float)


@wp.struct
class Optimiser:
    """Settings of the two optimisers.

    Attributes:
        control: int [1], number of the step, from 1.
        schedule: float [steps], factor of all rates at each step.
        rates: float [10 + L], of each channel of a Gaussian.
        net_rate: Rate of the network.
        bounds: float [2, 10 + L], lowest and highest value of each channel.
        keep: 1 to clamp the rows to `bounds`.
        move: 0 to leave the Gaussians unchanged.
        adan: 1 to train the Gaussians by Adan (Xie et al. 2024), 0 by Adam; the network is always trained by Adam.
    """

    control: wp.array1d[int]
    schedule: wp.array1d[float]
    rates: wp.array1d[float]
    net_rate: float
    bounds: wp.array2d[float]
    keep: int
    move: int
    adan: int


@functools.cache
def update_kernel(latent: int):
    """Builds the kernel of `step.StepKernels.update` for latents of length L, once."""
    fn = functions(latent)
    vec_sums, chain = fn.vec_sums, fn.chain
    channels = LATENT + latent

    @wp.kernel(module="unique", module_options={"enable_backward": False, "max_unroll": 32})
    def update(
        # in:
        o: Optimiser,
        used: wp.array2d[float],
        shapes: wp.array1d[Shape],
        sums: wp.array2d[float],
        partial: wp.array2d[float],
        # out:
        rows: wp.array2d[float],
        moments: wp.array3d[float],
        net: wp.array1d[float],
        net_moments: wp.array2d[float],
    ):
        i = wp.tid()
        t = o.control[0]
        rate = o.schedule[t - 1]
        if i < net.shape[0]:
            g = float(0.0)
            whole = partial.shape[0] // 8 * 8
            for b in range(0, whole, 8):
                # Eight loads are in flight at once.
                part = _vec8()
                for u in range(8):
                    part[u] = partial[b + u, i]
                for u in range(8):
                    g += part[u]
            for b in range(whole, partial.shape[0]):
                g += partial[b, i]
            m = ADAM[0] * net_moments[0, i] + (1.0 - ADAM[0]) * g
            v = ADAM[1] * net_moments[1, i] + (1.0 - ADAM[1]) * g * g
            net_moments[0, i] = m
            net_moments[1, i] = v
            mean = m / (1.0 - wp.pow(ADAM[0], float(t)))
            spread = wp.sqrt(v / (1.0 - wp.pow(ADAM[1], float(t))))
            net[i] = net[i] - rate * o.net_rate * mean / (spread + EPSILON)
        else:
            k = (i - net.shape[0]) // wp.static(channels)
            c = (i - net.shape[0]) % wp.static(channels)
            g = float(0.0)
            if c < LATENT:
                # The values that the step used, since other threads are changing the rows.
                s = vec_sums()
                for a in range(SHAPE_NUMBERS):
                    s[a] = sums[k, a]
                gradient = chain(
                    s,
                    shapes[k],
                    wp.vec3(used[k, 3], used[k, 4], used[k, 5]),
                    wp.vec4(used[k, 6], used[k, 7], used[k, 8], used[k, 9]),
                )
                g = gradient[c]
            else:
                g = sums[k, SHAPE_NUMBERS + c - LATENT]
            beta1 = wp.where(o.adan != 0, ADAN[0], ADAM[0])
            beta2 = ADAN[1]
            beta3 = wp.where(o.adan != 0, ADAN[2], ADAM[1])
            # Adam is Adan without the change of the gradient.
            change = float(0.0)
            if o.adan != 0 and t > 1:
                change = g - moments[3, k, c]
            look = g + beta2 * change
            m = beta1 * moments[0, k, c] + (1.0 - beta1) * g
            v = beta2 * moments[1, k, c] + (1.0 - beta2) * change
            n = beta3 * moments[2, k, c] + (1.0 - beta3) * look * look
            moments[0, k, c] = m
            moments[1, k, c] = v
            moments[2, k, c] = n
            moments[3, k, c] = g
            mean = m / (1.0 - wp.pow(beta1, float(t))) + beta2 * v / (1.0 - wp.pow(beta2, float(t)))
            spread = wp.sqrt(n / (1.0 - wp.pow(beta3, float(t))))
            value = rows[k, c] - rate * o.rates[c] * mean / (spread + EPSILON)
            if o.keep != 0:
                value = wp.clamp(value, o.bounds[0, c], o.bounds[1, c])
            elif c >= 3 and c < 6:
                value = wp.clamp(value, LOG_SCALES[0], LOG_SCALES[1])
            rows[k, c] = value

    return update
