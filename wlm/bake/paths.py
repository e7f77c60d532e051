"""Path tracing with Mitsuba: incident light at surface points and at points in space.

Each path starts at one of these points. Lights are sampled from it and from every surface that the path hits, and
lights hit by the path count too; multiple importance sampling uses the power heuristic (Veach 1995, with exponent 2).
The sun is sampled separately from the other lights, so that its direct light can be excluded.

Mitsuba's types depend on its variant, which `wlm.bake.backend.start` sets first.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

with suppress(ImportError):  # `wlm.bake.backend.start`, which runs first, reports a missing package
    import drjit as dr
    import mitsuba as mi

SUN_ANGLE = math.radians(0.5358 / 2.0)
"""Radius of the sun's disc in the sky."""

# Increments of the samples' second and third coordinate, in units of 2^-32: the golden ratio and the square root of 2.
# The first coordinate is the sample's index; with the second it forms a Fibonacci lattice.
_GOLDEN, _ROOT = int(2**32 * (math.sqrt(5.0) - 1.0) / 2.0), int(2**32 * (math.sqrt(2.0) - 1.0))
_PARTS = 8  # number of batches of samples, whose spread estimates the noise
_LANES = 1 << 20  # number of parallel paths
_RANDOM_BOUNCE = 3  # first bounce with Russian roulette
_COEFFICIENTS = 9


@dataclass(frozen=True)
class Sun:
    """The sun as a distant light: the direction to it, [3], of unit length, and its irradiance R, G, B on a surface
    that faces it."""

    direction: tuple[float, float, float]
    irradiance: tuple[float, float, float]


@dataclass(frozen=True)
class Tracing:
    """Settings of the path tracer, and the lights outside Mitsuba's scene, which need no random light selection.

    There is no `sun` if it is below the horizon; `sun_direct` tells whether its direct light is included. `ambient` is
    the radiance R, G, B of rays that hit no surface. `samples` counts paths per texel or probe, rounded up to a
    multiple of 8; `bounces` is the largest number of reflections.
    """

    sun: Sun | None
    ambient: tuple[float, float, float]
    sun_direct: bool
    samples: int
    bounces: int
    seed: int


@dataclass(frozen=True, eq=False)
class Gathered:
    """Estimated incident light at N points, float32 [N, C], with the standard error of each estimate; `back`, float32
    [N], is the share of first rays that hit the back of a single-sided surface, which indicates a point inside an
    object."""

    mean: np.ndarray
    noise: np.ndarray
    back: np.ndarray


class _Outside:
    """The sun and the ambient light as Mitsuba variables, not constants, so that all hours share the same kernels."""

    def __init__(self, tracing: Tracing) -> None:
        self.ambient = mi.Color3f(*tracing.ambient)
        self.has_sun = tracing.sun is not None
        sun = tracing.sun or Sun((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
        self.frame = mi.Frame3f(mi.Vector3f(*sun.direction))
        self.irradiance = mi.Color3f(*sun.irradiance)
        dr.make_opaque(self.frame, self.irradiance, self.ambient)

    def sample(self, rng: mi.PCG32) -> mi.Vector3f:
        """Samples a direction to a point of the sun's disc."""
        square = mi.Point2f(rng.next_float32(), rng.next_float32())
        return self.frame.to_world(mi.warp.square_to_uniform_cone(square, math.cos(SUN_ANGLE)))


def irradiance(scene: Any, texels: Any, tracing: Tracing, *, report: Any = None) -> Gathered:
    """Computes irradiance, RGB, at the texels of a lightmap, as the mean over their sample positions; `report` is
    called with the finished share of the work."""
    places = [mi.Point3f(texels.position.T), mi.Vector3f(texels.normal.T), mi.Vector3f(texels.face.T)]
    first = mi.UInt32(texels.first[:-1].astype(np.uint32))
    count = mi.UInt32(np.diff(texels.first).astype(np.uint32))
    sky = _Outside(tracing)

    def one(number: mi.UInt32, at: tuple, rng: mi.PCG32) -> tuple[list, mi.Float]:
        held = dr.gather(mi.UInt32, count, number)
        place = dr.gather(mi.UInt32, first, number) + dr.minimum(mi.UInt32(at[2] * held), held - 1)
        p, normal, face = (dr.gather(type(each), each, place) for each in places)
        it = _interaction(p, face)
        d = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(at[0], at[1])))
        cosine = dr.dot(d, normal)
        # Directions behind the geometric triangle contribute nothing, regardless of the shading normal.
        seen = (dr.dot(d, face) > 0) & (cosine > 0)
        light, back = _radiance(scene, it, d, cosine * dr.inv_pi, sky, rng, tracing.bounces, seen)
        total = light * dr.pi
        ds, weight = scene.sample_emitter_direction(it, mi.Point2f(rng.next_float32(), rng.next_float32()), True)
        cosine = dr.dot(ds.d, normal)
        ahead = (cosine > 0) & (dr.dot(ds.d, face) > 0)
        pdf = dr.select(ds.delta, 0.0, cosine * dr.inv_pi)
        total += dr.select(ahead, weight * cosine * _heuristic(ds.pdf, pdf), 0.0)
        if sky.has_sun and tracing.sun_direct:
            toward = sky.sample(rng)
            cosine = dr.dot(toward, normal)
            ahead = (cosine > 0) & (dr.dot(toward, face) > 0)
            ahead &= ~scene.ray_test(it.spawn_ray(toward), active=ahead)
            total += dr.select(ahead, sky.irradiance * cosine, 0.0)
        return [total.x, total.y, total.z], dr.select(back, 1.0, 0.0)

    return _gather(one, len(texels.index), 3, tracing, report)


def harmonics(scene: Any, position: np.ndarray, tracing: Tracing, *, report: Any = None) -> Gathered:
    """Projects radiance at points [N, 3] onto the second-order spherical harmonics of `wlm.probe.sphere.basis`. Returns
    estimates with 27 channels: red, green and blue of each coefficient."""
    place = mi.Point3f(np.asarray(position, np.float32).T)
    sky = _Outside(tracing)

    def one(number: mi.UInt32, at: tuple, rng: mi.PCG32) -> tuple[list, mi.Float]:
        it = _interaction(dr.gather(mi.Point3f, place, number), mi.Vector3f(0.0))
        d = mi.warp.square_to_uniform_sphere(mi.Point2f(at[0], at[1]))
        light, back = _radiance(scene, it, d, mi.Float(dr.inv_four_pi), sky, rng, tracing.bounces, mi.Bool(True))
        parts = [(light * (4.0 * dr.pi), d)]
        ds, weight = scene.sample_emitter_direction(it, mi.Point2f(rng.next_float32(), rng.next_float32()), True)
        pdf = dr.select(ds.delta, 0.0, mi.Float(dr.inv_four_pi))
        parts.append((weight * _heuristic(ds.pdf, pdf), ds.d))
        if sky.has_sun and tracing.sun_direct:
            toward = sky.sample(rng)
            lit = ~scene.ray_test(it.spawn_ray(toward))
            parts.append((dr.select(lit, sky.irradiance, 0.0), toward))
        out = [mi.Float(0.0)] * (3 * _COEFFICIENTS)
        for value, toward in parts:
            # A light that wasn't sampled has no direction.
            value = dr.select(dr.any(value > 0), value, 0.0)
            for k, shape in enumerate(_basis(toward)):
                for c in range(3):
                    out[3 * k + c] = out[3 * k + c] + dr.select(value[c] > 0, value[c] * shape, 0.0)
        return out, dr.select(back, 1.0, 0.0)

    return _gather(one, len(position), 3 * _COEFFICIENTS, tracing, report)


def _gather(one: Any, count: int, channels: int, tracing: Tracing, report: Any) -> Gathered:
    each = -(-tracing.samples // _PARTS)
    at_once = max(1, _LANES // each)
    total, square = np.zeros((2, count, channels))
    back = np.zeros(count)
    keys = np.random.SeedSequence(tracing.seed)
    for part in range(_PARTS):
        key = int(keys.spawn(1)[0].generate_state(1, np.uint64)[0])
        for begin in range(0, count, at_once):
            # All launches except the last have the same size, so that they share a kernel.
            length = min(at_once, count - begin)
            lane = dr.arange(mi.UInt32, length * each)
            number, sample = lane // each, lane % each
            number += dr.opaque(mi.UInt32, begin)
            # Mitsuba adds each lane's index to this seed.
            rng = mi.PCG32(length * each, dr.opaque(mi.UInt64, key), dr.opaque(mi.UInt64, begin * each))
            shift = mi.sample_tea_32(number, dr.opaque(mi.UInt32, key & 0xFFFFFFFF), 8)
            third = mi.sample_tea_32(number, dr.opaque(mi.UInt32, key >> 32), 8)[0]
            # Values rounded to 1 lie on the edge of the unit square, where the mapping to directions is degenerate.
            at = tuple(
                dr.minimum(mi.Float((start + sample * step) >> 8) * 2.0**-24, 1.0 - 2.0**-24)
                for start, step in zip((*shift, third), (2**32 // each % 2**32, _GOLDEN, _ROOT), strict=True)
            )
            values, hidden = one(number, at, rng)
            # A path that hits a degenerate edge may yield NaN.
            sums = [dr.block_sum(dr.select(dr.isfinite(value), value, 0.0), each) for value in (*values, hidden)]
            dr.eval(*sums)
            block = np.stack([value.numpy() for value in sums], -1).astype(np.float64) / each
            total[begin : begin + length] += block[:, :-1]
            square[begin : begin + length] += block[:, :-1] ** 2
            back[begin : begin + length] += block[:, -1]
            if report is not None:
                report((part + (begin + length) / count) / _PARTS)
    mean = total / _PARTS
    variance = np.maximum(square / _PARTS - mean**2, 0.0) / (_PARTS - 1)
    return Gathered(mean.astype(np.float32), np.sqrt(variance).astype(np.float32), (back / _PARTS).astype(np.float32))


def _radiance(
    scene: Any,
    start: mi.Interaction3f,
    direction: mi.Vector3f,
    pdf: mi.Float,
    sky: _Outside,
    rng: mi.PCG32,
    bounces: int,
    active: mi.Bool,
) -> tuple[mi.Color3f, mi.Bool]:
    """Traces a path in a direction sampled with density `pdf`; returns its radiance and whether the first ray hits a
    back face. Lights that it hits are weighted against light sampling by multiple importance sampling."""
    context = mi.BSDFContext()

    def body(ray, light, share, before, pdf, rng, back, depth, active):
        si = scene.ray_intersect(ray, active)
        emitter = si.emitter(scene)
        ds = mi.DirectionSample3f(scene, si, before)
        chance = dr.select(emitter != None, scene.pdf_emitter_direction(before, ds, active), 0.0)  # noqa: E711
        light = light + dr.select(active, share * emitter.eval(si, active) * _heuristic(pdf, chance), 0.0)
        light += dr.select(active & ~si.is_valid(), share * sky.ambient, 0.0)
        bsdf = si.bsdf(ray)
        two_sided = mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
        back |= active & (depth == 0) & si.is_valid() & (si.wi.z < 0) & ~two_sided
        active &= si.is_valid() & (depth < bounces)

        ds, weight = scene.sample_emitter_direction(
            si, mi.Point2f(rng.next_float32(), rng.next_float32()), True, active
        )
        value, chance = bsdf.eval_pdf(context, si, si.to_local(ds.d), active)
        chance = dr.select(ds.delta, 0.0, chance)
        light += dr.select(active & (ds.pdf > 0), share * value * weight * _heuristic(ds.pdf, chance), 0.0)
        if sky.has_sun:
            toward = sky.sample(rng)
            value = bsdf.eval(context, si, si.to_local(toward), active)
            lit = active & (dr.max(value) > 0)
            lit &= ~scene.ray_test(si.spawn_ray(toward), active=lit)
            light += dr.select(lit, share * value * sky.irradiance, 0.0)

        sample, value = bsdf.sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), active
        )
        share = share * value
        stay = dr.select(depth >= _RANDOM_BOUNCE, dr.minimum(dr.max(share), 0.95), 1.0)
        active &= (dr.max(share) > 0) & (rng.next_float32() < stay)
        share = dr.select(stay > 0, share / stay, 0.0)
        before = _interaction(si.p, si.n)
        ray = si.spawn_ray(si.to_world(sample.wo))
        return ray, light, share, before, sample.pdf, rng, back, depth + 1, active

    size = dr.width(direction, start.p)
    state = (
        mi.Ray3f(start.spawn_ray(direction)),
        dr.zeros(mi.Color3f, size),
        dr.full(mi.Color3f, 1.0, size),
        start,
        mi.Float(pdf),
        rng,
        dr.full(mi.Bool, False, size),
        dr.zeros(mi.UInt32, size),
        mi.Bool(active) & dr.full(mi.Bool, True, size),
    )
    state = dr.while_loop(state, lambda *values: values[-1], body, label="paths")
    return state[1], state[6]


def _interaction(p: mi.Point3f, normal: mi.Vector3f) -> mi.Interaction3f:
    """Creates the origin of rays, offset from the surface against self-intersection; a normal of 0 means no surface."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.n = p, mi.Normal3f(normal)
    return it


def _heuristic(pdf: mi.Float, other: mi.Float) -> mi.Float:
    a, b = dr.square(pdf), dr.square(other)
    return dr.select(a > 0, a / (a + b), 0.0)


def _basis(d: mi.Vector3f) -> list[mi.Float]:
    """Evaluates orthonormal real SH: L00, y, z, x, xy, yz, 3z2-1, xz, x2-y2."""
    first, second = math.sqrt(3.0 / (4.0 * math.pi)), math.sqrt(15.0 / (4.0 * math.pi))
    return [
        mi.Float(math.sqrt(0.25 / math.pi)),
        first * d.y,
        first * d.z,
        first * d.x,
        second * d.x * d.y,
        second * d.y * d.z,
        math.sqrt(5.0 / (16.0 * math.pi)) * (3.0 * dr.square(d.z) - 1.0),
        second * d.x * d.z,
        0.5 * second * (dr.square(d.x) - dr.square(d.y)),
    ]
