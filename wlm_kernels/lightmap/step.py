"""Training step of lightmap tiles in one launch: samples the maps, runs the MLP, computes the loss and all gradients.

It handles B random samples of each of N tiles (neural-dynamic-gi, section 3.3, 3.4 and 4): draws a valid texel and a
time, samples F_uv, F_uvt, F_ut and F_vt, adds the uniform noise of eq. 6, centres the features, runs the network,
computes the weighted squared error and sums the gradients. `gather` turns the sums into gradients.

On CUDA, networks run on the matrix units in half floats (`matrix_step`), on the CPU in float32.

The sums are integers or have a fixed order, so that one seed gives one result on one device. The samples of a tile only
depend on the seed, the step and the number of the tile, so that a tile is trained to the same result in any batch.

Read `train_features` and `losses` in `tests/reference/temporal.py` first; they compute the same loss in torch.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.lightmap.adjoint import scatters
from wlm_kernels.lightmap.blocks import ste_mix
from wlm_kernels.lightmap.features import (
    CENTRE,
    INPUTS,
    MAP_INPUTS,
    Batch,
    Maps,
    Sample,
    cell_of,
    draw_sample,
    four_at,
    plane_at,
    texel_weight,
    track_error,
    uv_place,
    volume_at,
)
from wlm_kernels.lightmap.matrix_step import BLOCK, matrix_network

LAUNCH_BOUNDS = (BLOCK, 4)  # the maximum that fits shared memory at width 64
NOISE = wp.constant(1.0 / 256.0)  # alpha of eq. 6: one step of 8 bits


@dataclass(frozen=True)
class StepKernels:
    """The training step for one network shape on one kind of device; see `launch`.

    Attributes:
        net: Forward and backward functions of the network.
        scalar: Type of the sums of the maps' gradients: int64 on CUDA, float on the CPU.
        draw: Kernel that writes the samples that the next step will draw, for tests.
    """

    net: mlp.MlpKernels
    scalar: Any
    draw: Any
    _step: Any

    def load(self, device: str) -> None:
        """Compiles the training step for a device, which would otherwise happen at the first launch."""
        wp.load_module(self._step.module, device, block_dim=BLOCK)

    def launch(
        self,
        maps: Maps,
        hidden: wp.array,
        output: wp.array,
        batch: Batch,
        samples: int,
        acc: wp.array,
        partial: wp.array,
        partial_out: wp.array,
        loss: wp.array,
        base: int = 0,
        count: int | None = None,
    ) -> None:
        """Draws B samples of each of N tiles, and sums their losses and gradients.

        Args:
            maps: The maps, whose M parameters are trained, or the levels of the file that are nearest to them.
            hidden: vecH [N, 18 + H], the hidden layers, see `wlm_kernels.mlp`.
            output: vec3 [N, H + 1], the output layers.
            batch: The training data.
            samples: B; on CUDA a multiple of `BLOCK`.
            acc: [lanes, M], gradients of `maps.values`, added to: int64 of one lane on CUDA, float of a lane for each
                thread of the CPU.
            partial: float [P, N, 18 + H, H], gradients of the hidden layers: on CUDA of P blocks of `BLOCK` samples,
                written; on the CPU of P lanes, added to.
            partial_out: float [P, N, H + 1, 3], gradients of the output layers, like `partial`.
            loss: float [P, N], sums of weighted squared errors over samples and channels / (3 B), like `partial`.
            base, count: On the CPU the launch takes samples `base` to `base` + `count` - 1 of each tile; default all.
        """
        tiles = hidden.shape[0]
        span = samples if count is None else count
        wp.launch(
            self._step,
            tiles * span if self.scalar == wp.int64 else (tiles, span),
            inputs=[maps, hidden, output, batch, samples, base],
            outputs=[acc, partial, partial_out, loss],
            device=hidden.device,
            block_dim=BLOCK,
        )


@functools.cache
def step_kernels(hidden: int, gelu: str, device_kind: str) -> StepKernels:
    """Builds (once) the training step for networks of one hidden width.

    Args:
        hidden: H, width of the hidden layers; on CUDA one of `matrix_step.WIDTHS`.
        gelu: "exact" or "tanh".
        device_kind: "cpu" or "cuda".
    """
    net = mlp.kernels(INPUTS, hidden, gelu)
    vec_in, vec_hidden = net.vec_in, net.vec_hidden
    first, second, third = net.first, net.second, net.third
    gate, slope = net.gate, net.slope
    back_hidden, back_output, back_input = net.back_hidden, net.back_output, net.back_input
    scatter_texel, scatter_volume, scatter_plane, scalar = scatters(device_kind)
    units, columns_2 = net.hidden, INPUTS + 1

    @wp.func
    def place_of(sample: Sample):
        return (float(sample.flat & 127) + 0.5) / 128.0, (float(sample.flat >> 7) + 0.5) / 128.0

    @wp.func
    def sampled(maps: Maps, batch: Batch, n: int, sample: Sample, quantised: int) -> vec_in:
        f = vec_in()
        u, v = place_of(sample)
        tau = batch.tau[sample.k]
        place = uv_place(maps, n, sample.flat)
        low = four_at(maps.values, place.endpoints)
        high = four_at(maps.values, place.endpoints + 4)
        w = maps.values[place.weight]
        uvt = volume_at(maps, n, cell_of(maps, u, v, tau, batch.periodic), quantised)
        uv = ste_mix(low, high, w, quantised)  # late, so that its reads need no waiting
        ut = plane_at(maps, maps.ut, n, u, tau, batch.periodic)
        vt = plane_at(maps, maps.vt, n, v, tau, batch.periodic)
        e = batch.encoding[sample.k]
        for c in range(4):
            f[c] = uv[c]
            f[4 + c] = uvt[c]
            f[12 + c] = e[c]
        for c in range(2):
            f[8 + c] = ut[c]
            f[10 + c] = vt[c]
        return f

    @wp.func
    def features(maps: Maps, batch: Batch, n: int, sample: Sample) -> vec_in:
        f = vec_in()
        state = sample.state
        if batch.quantised == 0:
            f = sampled(maps, batch, n, sample, 0)
            for c in range(wp.static(MAP_INPUTS)):
                f[c] += (wp.randf(state) - 0.5) * NOISE  # eq. 6: in place of the rounding, until maps are quantised
        else:
            f = sampled(maps, batch, n, sample, 1)
        for c in range(wp.static(MAP_INPUTS)):
            f[c] = (f[c] - 0.5) * CENTRE
        return f

    @wp.func
    def scatter(acc: wp.array2d[scalar], lane: int, maps: Maps, batch: Batch, n: int, sample: Sample, g: vec_in):
        c = CENTRE
        u, v = place_of(sample)
        tau = batch.tau[sample.k]
        cell = cell_of(maps, u, v, tau, batch.periodic)
        scatter_texel(acc, lane, maps, n, sample.flat, c * wp.vec4(g[0], g[1], g[2], g[3]))
        scatter_volume(acc, lane, maps, n, cell, c * wp.vec4(g[4], g[5], g[6], g[7]))
        scatter_plane(acc, lane, maps, maps.ut, n, u, tau, batch.periodic, c * wp.vec2(g[8], g[9]))
        scatter_plane(acc, lane, maps, maps.vt, n, v, tau, batch.periodic, c * wp.vec2(g[10], g[11]))

    # The depth is LLVM's own, at which it finds the vectors of the network; Warp's default of 4 does not.
    flags = "-march=native -mllvm=-inline-threshold=9000 -mllvm=-slp-recursion-max-depth=12"
    options = {"enable_backward": False, "cpu_compiler_flags": flags}

    @wp.kernel(module="unique", module_options=options)
    def draw(
        # in:
        maps: Maps,
        batch: Batch,
        samples: int,
        # out:
        place: wp.array2d[wp.vec3i],
        f: wp.array2d[vec_in],
    ):
        n, b = wp.tid()
        sample = draw_sample(batch, n, b, samples)
        place[n, b] = wp.vec3i(sample.flat // 128, sample.flat % 128, sample.k)
        f[n, b] = features(maps, batch, n, sample)

    if device_kind == "cpu":

        @wp.kernel(module="unique", module_options=options)
        def step(
            # in:
            maps: Maps,
            hidden: wp.array2d[vec_hidden],
            output: wp.array2d[wp.vec3],
            batch: Batch,
            samples: int,
            base: int,
            # out:
            acc: wp.array2d[scalar],
            partial: wp.array3d[vec_hidden],
            partial_out: wp.array3d[wp.vec3],
            loss: wp.array2d[float],
        ):
            n, i = wp.tid()
            b = base + i
            lane = wp.where(base == 0, 0, 1)
            sample = draw_sample(batch, n, b, samples)
            k = sample.k
            f = features(maps, batch, n, sample)
            a1 = first(hidden, n, f)
            g1 = gate(a1)
            h1 = wp.cw_mul(a1, g1)
            a2 = second(hidden, n, h1)
            g2 = gate(a2)
            h2 = wp.cw_mul(a2, g2)
            target = batch.targets[n, k, sample.flat]
            error = third(output, n, h2) - target
            track_error(batch, lane, n, k, target, error)
            half = wp.cw_mul(texel_weight(batch, n, k, target), error) / (3.0 * float(samples))
            loss[lane, n] += wp.dot(half, error)
            d3 = 2.0 * half
            d2 = wp.cw_mul(back_output(output, n, d3), slope(a2, g2))
            d1 = wp.cw_mul(back_hidden(hidden, n, d2), slope(a1, g1))
            for c in range(wp.static(INPUTS)):
                partial[lane, n, c] += d1 * f[c]
            partial[lane, n, wp.static(INPUTS)] += d1
            for c in range(wp.static(units)):
                partial[lane, n, wp.static(columns_2) + c] += d2 * h1[c]
                partial_out[lane, n, c] += d3 * h2[c]
            partial[lane, n, wp.static(columns_2 + units)] += d2
            partial_out[lane, n, wp.static(units)] += d3
            if batch.frozen == 0:
                scatter(acc, lane, maps, batch, n, sample, back_input(hidden, n, d1))

    else:
        network = matrix_network(hidden, gelu)

        @wp.kernel(module="unique", module_options=options, launch_bounds=LAUNCH_BOUNDS)
        def step(
            # in:
            maps: Maps,
            hidden: wp.array2d[vec_hidden],
            output: wp.array2d[wp.vec3],
            batch: Batch,
            samples: int,
            base: int,
            # out:
            acc: wp.array2d[scalar],
            partial: wp.array2d[float],
            partial_out: wp.array2d[float],
            loss: wp.array1d[float],
        ):
            i = wp.tid()
            n = i // samples
            b = i - n * samples
            sample = draw_sample(batch, n, b, samples)
            k = sample.k
            target = batch.targets[n, k, sample.flat]  # first, since it is far away
            f = features(maps, batch, n, sample)
            weight = texel_weight(batch, n, k, target)
            row = (b // wp.static(BLOCK)) * hidden.shape[0] + n
            share = 1.0 / (3.0 * float(samples))
            r = network(hidden, output, n, f, target, weight, share, row, partial, partial_out, loss)
            error = wp.vec3(r[wp.static(INPUTS)], r[wp.static(INPUTS + 1)], r[wp.static(INPUTS + 2)])
            track_error(batch, 0, n, k, target, error)
            g = vec_in()
            for c in range(wp.static(INPUTS)):
                g[c] = r[c]
            if batch.frozen == 0:
                scatter(acc, int(r[wp.static(INPUTS + 3)]), maps, batch, n, sample, g)

    return StepKernels(net, scalar, draw, step)
