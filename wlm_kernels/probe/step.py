"""A training step of the Gaussians (gaussian-probe-compression, section 3.2 and 3.3), except for the network
(`network`).

Probes are sorted along a space-filling curve and divided into groups of 64 neighbours, each with a bounding box. A step
has five launches: bit masks of the Gaussians that meet each group (`touch`); the Gaussians' sum at each probe
(`features`); the network, forward and backward (`network`); the sums from which the gradients of each Gaussian follow
(`collect`); and the optimisers (`update`), which are our own since those of libraries count steps in Python while
a whole step must be in one CUDA graph. There are no atomic additions: a seed gives one result on each device.

The masks replace the paper's sorted lists of cubes, since probes do not move in training: nothing has to be counted,
scanned and sorted. The reference is `tests/reference/gaussians.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.native import native_source
from wlm_kernels.probe.gaussians import LATENT, SHAPE_NUMBERS, Shape, functions, shape_of, touches

GROUP = 64  # probes
SPLITS = 4  # threads that share a probe's sum on CUDA; one thread for each of 15,000 probes leaves most of a GPU idle
PARTS = 4  # blocks of threads that share a Gaussian's gradient on CUDA: some Gaussians reach all groups, most a few
_COLLECTORS = 128  # threads of such a block
_SMALL = 32  # threads of the blocks that make shapes, whose scattered stores would keep a few processors busy for long

# Range of the logarithm of a scale, in the normalised frame.
LOG_SCALES = wp.constant(wp.vec2(-9.21, 1.39))  # 1e-4 to 4
ADAM = wp.constant(wp.vec2(0.9, 0.999))
ADAN = wp.constant(wp.vec3(0.98, 0.92, 0.99))  # as Xie et al. and pytorch-optimizer have them
EPSILON = wp.constant(1.0e-8)

_IN_FLIGHT = 32  # loads of partial gradients
_vec_loads = wp.types.vector(_IN_FLIGHT, float)


@wp.struct
class Groups:
    """Light probes in G groups of `GROUP` neighbours; N = G * `GROUP` is the number of probes, rounded up.

    Attributes:
        x: vec3 [N], positions in normalised coordinates; positions from index `count` on only fill up the last group.
        middle, half: vec3 [G], centre of each group's bounding box, and half the size of the box.
        count: Number of probes.
    """

    x: wp.array1d[wp.vec3]
    middle: wp.array1d[wp.vec3]
    half: wp.array1d[wp.vec3]
    count: int


@wp.struct
class Optimiser:
    """Settings of the optimisers of the Gaussians and of the network.

    Attributes:
        control: int [1], number of the step, from 1.
        schedule: float [steps], factor of all learning rates at each step.
        rates: float [10 + L], learning rate of each parameter of a Gaussian.
        net_rate: Learning rate of the network.
        bounds: float [2, 10 + L], lowest and highest value of each parameter of a Gaussian.
        keep: 1 to clamp the Gaussians' parameters to `bounds`, else 0.
        move: 1 to train the Gaussians, 0 to leave them unchanged.
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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def next_bit(bits: wp.uint32) -> int:
    """Returns the index of the lowest set bit; `bits` must not be 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, bit != 0);
#else
    return 0u;
#endif
""")
def _ballot(bit: int) -> wp.uint32: ...


@wp.func
def _meet(groups: Groups, shapes: wp.array1d[Shape], transposed: int, row: int, column: int) -> int:
    g = wp.where(transposed != 0, column, row)
    k = wp.where(transposed != 0, row, column)
    if g < groups.middle.shape[0] and k < shapes.shape[0]:
        if touches(shapes[k], groups.middle[g], groups.half[g]):
            return 1
    return 0


@wp.kernel(enable_backward=False)
def _touch(
    # in:
    groups: Groups,
    shapes: wp.array1d[Shape],
    lanes: int,
    # out:
    by_group: wp.array2d[wp.uint32],
    by_gaussian: wp.array2d[wp.uint32],
):
    at, lane = wp.tid()
    width = by_group.shape[1]
    transposed = int(0)
    if at >= by_group.shape[0] * width:
        at -= by_group.shape[0] * width
        width = by_gaussian.shape[1]
        transposed = 1
    row = at // width
    word = at % width
    bits = wp.uint32(0)
    if lanes == 32:
        # The last dimension has 32 threads, which are one warp in every launch on CUDA.
        bits = _ballot(_meet(groups, shapes, transposed, row, word * 32 + lane))
    else:
        for b in range(32):
            met = _meet(groups, shapes, transposed, row, word * 32 + b)
            bits = bits | (wp.uint32(met) << wp.uint32(b))
    if lane == 0:
        if transposed != 0:
            by_gaussian[row, word] = bits
        else:
            by_group[row, word] = bits


def touch(groups, shapes, by_group, by_gaussian) -> None:
    """Finds which Gaussians may reach which groups.

    Args:
        groups: The G groups of probes.
        shapes: Shape [K] of the K Gaussians.
        by_group: uint32 [G, ceil(K / 32)], written: for each group bit b of word w is 1 if Gaussian 32 w + b may reach
            it.
        by_gaussian: uint32 [K, ceil(G / 32)], written: for each Gaussian the bits of the groups that it may reach.
    """
    device = shapes.device
    lanes = 32 if device.is_cuda else 1
    inputs, outputs = [groups, shapes, lanes], [by_group, by_gaussian]
    wp.launch(_touch, (by_group.size + by_gaussian.size, lanes), inputs=inputs, outputs=outputs, device=device)


@dataclass(frozen=True)
class StepKernels:
    """The launches of a training step, for latent vectors of one length L and one kind of device."""

    device_kind: str
    _shapes: Any
    _features: Any
    _collect: Any
    _update: Any

    def load(self, device) -> None:
        """Compiles the kernels for a device, which would otherwise happen at their first launches."""
        # A module is compiled anew for each size of blocks that is launched.
        blocks = {
            self._shapes: _SMALL if self.device_kind == "cuda" else None,
            self._features: GROUP,
            self._collect: _COLLECTORS,
            self._update: None,
            _touch: None,
        }
        for kernel, threads in blocks.items():
            wp.load_module(kernel.module, device, block_dim=threads)

    def shapes(self, rows, bounds, quantised, levels, cut, sphere, used, shapes) -> None:
        """Rounds the Gaussians' parameters as a model file stores them, and prepares the Gaussians for evaluation.

        Args:
            rows: float [K, 10 + L], parameters of the K Gaussians.
            bounds: float [2, 10 + L], lowest and highest value of each parameter.
            quantised: 1 to round to the stored values (eq. 13 and 14), 0 to use the parameters unchanged.
            levels: float [10 + L], number of steps from the lowest to the highest stored value of each parameter.
            cut, sphere: The arguments of `gaussians.shape_of`.
            used: float [K, 10 + L], the rounded parameters, written.
            shapes: Shape [K], written.
        """
        inputs = [rows, bounds, quantised, levels, cut, sphere]
        options = {"block_dim": _SMALL} if self.device_kind == "cuda" else {}
        wp.launch(self._shapes, rows.shape[0], inputs=inputs, outputs=[used, shapes], device=rows.device, **options)

    def features(self, groups, shapes, used, by_group, cut, f, base=0, count=None) -> None:
        """Sums the Gaussians at each probe.

        Args:
            groups, shapes, used, by_group, cut: The same as for `touch` and `shapes`.
            f: float [S, L, N], written: S partial sums, S = `SPLITS` on CUDA and 1 on the CPU.
            base, count: Index of the first probe and number of probes of this launch, on the CPU alone; default all.
        """
        probes = groups.x.shape[0]
        dims = (probes // GROUP, SPLITS, GROUP) if self.device_kind == "cuda" else count or probes
        inputs = [groups, shapes, used, by_group, cut, base]
        wp.launch(self._features, dims, inputs=inputs, outputs=[f], device=f.device, block_dim=GROUP)

    def collect(self, groups, shapes, used, by_gaussian, grad_f, cut, sums, base=0, count=None) -> None:
        """Computes for each Gaussian the sums over the probes from which its gradient follows.

        Args:
            groups, shapes, used, by_gaussian, cut: The same as for `touch` and `shapes`.
            grad_f: float [L, N], gradient with respect to the result of `features`; 0 from index `groups.count` on.
            sums: float [K P, 9 + L], the sums of `GaussianFunctions.accumulate`, written: those of each Gaussian in P
                parts, P = `PARTS` on CUDA and 1 on the CPU.
            base, count: Index of the first Gaussian and number of Gaussians of this launch, on the CPU alone; default
                all.
        """
        gaussians = used.shape[0]
        dims = (gaussians, PARTS, _COLLECTORS) if self.device_kind == "cuda" else count or gaussians
        inputs = [groups, shapes, used, by_gaussian, grad_f, cut, base]
        wp.launch(self._collect, dims, inputs=inputs, outputs=[sums], device=sums.device, block_dim=_COLLECTORS)

    def update(self, optimiser, rows, used, shapes, sums, moments, net, net_moments, partial) -> None:
        """Takes a step of Adan or Adam for the Gaussians and of Adam for the network.

        Args:
            optimiser: The settings.
            rows: float [K, 10 + L], parameters of the Gaussians, updated.
            used: float [K, 10 + L], parameters at which the gradients were taken.
            shapes: Shape [K], made from `used`.
            sums: float [K P, 9 + L], result of `collect`.
            moments: float [4, K, 10 + L], Adan's or Adam's running means for the Gaussians, updated.
            net: float [P], weights of the network, updated.
            net_moments: float [2, P], Adam's running means for the network, updated.
            partial: float [B, P], partial gradients with respect to `net`, see `network.NetworkKernels.launch`.
        """
        numbers = net.shape[0] + (rows.size if optimiser.move else 0)
        inputs, outputs = [optimiser, used, shapes, sums, partial], [rows, moments, net, net_moments]
        wp.launch(self._update, numbers, inputs=inputs, outputs=outputs, device=net.device)


@functools.cache
def step_kernels(latent: int, device_kind: str) -> StepKernels:
    """Builds (once) the launches of a training step. `latent` is the length L of a latent vector. `device_kind` is
    "cpu" or "cuda"."""
    fn = functions(latent)
    vec_latent, vec_sums = fn.vec_latent, fn.vec_sums
    add, accumulate = fn.add, fn.accumulate
    channels = LATENT + latent
    options = {"enable_backward": False, "max_unroll": 32}
    cuda = device_kind == "cuda"
    block_sum, teams = _block_sum(vec_sums, SHAPE_NUMBERS + latent), _COLLECTORS // GROUP

    @wp.kernel(module="unique", module_options=options)
    def shapes_kernel(
        # in:
        rows: wp.array2d[float],
        bounds: wp.array2d[float],
        quantised: int,
        levels: wp.array1d[float],
        cut: float,
        sphere: int,
        # out:
        used: wp.array2d[float],
        shapes: wp.array1d[Shape],
    ):
        k = wp.tid()
        for c in range(wp.static(channels)):
            value = rows[k, c]
            if quantised != 0:
                low = bounds[0, c]
                high = bounds[1, c]
                if high > low:
                    step = (high - low) / levels[c]
                    value = low + step * wp.clamp(wp.floor((value - low) / step + 0.5), 0.0, levels[c])
                else:
                    value = low
            used[k, c] = value
        shapes[k] = shape_of(used, k, cut, sphere)

    @wp.func
    def sum_at(
        groups: Groups,
        shapes: wp.array1d[Shape],
        used: wp.array2d[float],
        by_group: wp.array2d[wp.uint32],
        cut: float,
        i: int,
        mask: wp.uint32,
    ) -> vec_latent:
        g = i // GROUP
        x = groups.x[i]
        f = vec_latent()
        for w in range(by_group.shape[1]):
            bits = by_group[g, w] & mask
            while bits != wp.uint32(0):
                k = w * 32 + next_bit(bits)
                bits = bits & (bits - wp.uint32(1))
                f = add(f, shapes[k], used, k, x, cut)
        return f

    @wp.func
    def sums_of(
        groups: Groups,
        shapes: wp.array1d[Shape],
        used: wp.array2d[float],
        by_gaussian: wp.array2d[wp.uint32],
        grad_f: wp.array2d[float],
        cut: float,
        k: int,
        mask: wp.uint32,
        lane: int,
        lanes: int,
    ) -> vec_sums:
        s = vec_sums()
        shape = shapes[k]
        for w in range(by_gaussian.shape[1]):
            bits = by_gaussian[k, w] & mask
            while bits != wp.uint32(0):
                g = w * 32 + next_bit(bits)
                bits = bits & (bits - wp.uint32(1))
                for j in range(lane, GROUP, lanes):
                    i = g * GROUP + j
                    # Most probes of a group may be out of reach: the test comes before their gradients are loaded.
                    if not touches(shape, groups.x[i], wp.vec3()):
                        continue
                    gradient = vec_latent()
                    for c in range(wp.static(latent)):
                        gradient[c] = grad_f[c, i]
                    s = accumulate(s, shape, used, k, groups.x[i], gradient, cut)
        return s

    @wp.kernel(module="unique", module_options=options)
    def features(
        # in:
        groups: Groups,
        shapes: wp.array1d[Shape],
        used: wp.array2d[float],
        by_group: wp.array2d[wp.uint32],
        cut: float,
        base: int,
        # out:
        f: wp.array3d[float],
    ):
        if wp.static(cuda):
            g, split, lane = wp.tid()
            i = g * GROUP + lane
            s = sum_at(groups, shapes, used, by_group, cut, i, wp.static(_mask(SPLITS)) << wp.uint32(split))
            for c in range(wp.static(latent)):
                f[split, c, i] = s[c]
        else:
            i = base + wp.tid()
            s = sum_at(groups, shapes, used, by_group, cut, i, wp.static(_mask(1)))
            for c in range(wp.static(latent)):
                f[0, c, i] = s[c]

    @wp.kernel(module="unique", module_options=options)
    def collect(
        # in:
        groups: Groups,
        shapes: wp.array1d[Shape],
        used: wp.array2d[float],
        by_gaussian: wp.array2d[wp.uint32],
        grad_f: wp.array2d[float],
        cut: float,
        base: int,
        # out:
        sums: wp.array2d[float],
    ):
        if wp.static(cuda):
            k, part, t = wp.tid()
            share = part * wp.static(teams) + t // GROUP
            mask = wp.static(_mask(PARTS * teams)) << wp.uint32(share)
            s = sums_of(groups, shapes, used, by_gaussian, grad_f, cut, k, mask, t % GROUP, GROUP)
            block_sum(s, k * PARTS + part, sums)
        else:
            k = base + wp.tid()
            s = sums_of(groups, shapes, used, by_gaussian, grad_f, cut, k, wp.static(_mask(1)), 0, 1)
            for c in range(wp.static(SHAPE_NUMBERS + latent)):
                sums[k, c] = s[c]

    return StepKernels(device_kind, shapes_kernel, features, collect, update_kernel(latent))


def _mask(share: int) -> wp.uint32:
    """Returns a word with one of each `share` bits set, the bits of a word that are for the first of so many."""
    return wp.uint32(sum(1 << bit for bit in range(0, 32, share)))


def _block_sum(vec_sums, numbers: int):

    @wp.func_native(native_source(__package__, "block_sum", N=numbers, WARPS=_COLLECTORS // 32))
    def block_sum(v: vec_sums, k: int, out: wp.array2d[float]): ...

    return block_sum


@functools.cache
def update_kernel(latent: int):
    """Builds (once) the kernel for an Adam step of Gaussians and network, for latent vectors of length `latent`."""
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
            whole = partial.shape[0] // _IN_FLIGHT * _IN_FLIGHT
            for b in range(0, whole, _IN_FLIGHT):
                part = _vec_loads()
                for u in range(_IN_FLIGHT):
                    part[u] = partial[b + u, i]
                for u in range(_IN_FLIGHT):
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
            parts = sums.shape[0] // rows.shape[0]
            if c < LATENT:
                # The values that the step used, since other threads are changing the rows.
                s = vec_sums()
                for p in range(k * parts, (k + 1) * parts):
                    for a in range(SHAPE_NUMBERS):
                        s[a] += sums[p, a]
                gradient = chain(s, shapes[k], used, k)
                g = gradient[c]
            else:
                for p in range(k * parts, (k + 1) * parts):
                    g += sums[p, SHAPE_NUMBERS + c - LATENT]
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
