"""Calls of every differentiable operation of `wlm.ops`, of tensors or of arrays: those of `CASES`, and of drawing."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from builders.operation_cases import CASES, normal

from wlm import ops

WITHOUT = {"Raster": "a class", "bc7_blocks": "refuses gradients", "funcs": "for kernels", "plain": "the references"}
"""Names of `wlm.ops` that aren't differentiable operations."""


@dataclass
class Subject:
    """A call: `run` takes the leaves and the constants by name and returns the results that have gradients."""

    run: Callable[..., tuple]
    leaves: dict[str, np.ndarray]
    constants: dict[str, np.ndarray]


def drawing() -> dict[str, list[Subject]]:
    """Calls of the operations that draw: one image, a batch, mip levels and silhouettes."""
    random = np.random.default_rng(3)
    corner = np.array([[-0.8, -0.7, 0.1, 1.0], [0.9, -0.8, 0.2, 1.5], [0.7, 0.9, 0.3, 1.2], [-0.9, 0.8, 0.4, 0.9]])
    clip, uv = corner.astype(np.float32), (0.5 + 0.5 * corner[:, :2]).astype(np.float32)
    clips, uvs = (np.stack([each, 0.9 * each]).astype(np.float32) for each in (clip, uv))
    triangle = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    drawn = ops.rasterize(torch.tensor(clip), torch.tensor(triangle), 9, 11, derivative=True)
    fields = ("triangle", "barycentric", "depth", "derivative")
    one = {name: getattr(drawn, name).numpy() for name in fields}
    both = {name: np.stack([field, field]) for name, field in one.items()}
    where = random.uniform(-1.0, 2.0, (2, 5, 8, 2)).astype(np.float32)
    slopes = normal(2, 5, 8, 2, 2, seed=4) * 0.3

    def raster(**pixels) -> ops.Raster:
        return ops.Raster(pixels["visible"], pixels["barycentric"], pixels["depth"], pixels["derivative"], None, 2)

    def interpolate(attribute, triangle, **pixels) -> tuple:
        return (ops.interpolate(attribute, triangle, raster(**pixels)),)

    def with_slopes(attribute, triangle, **pixels) -> tuple:
        return ops.interpolate(attribute, triangle, raster(**pixels), derivatives=True)

    def antialias(colour, clip, triangle, **pixels) -> tuple:
        return (ops.antialias(colour, raster(**pixels), clip, triangle),)

    def read(**tensors) -> tuple:
        return (ops.texture(**tensors, boundary="mirror"),)

    def pixels(fields: dict, *without: str) -> dict:
        renamed = {{"triangle": "visible"}.get(name, name): field for name, field in fields.items()}
        return {"triangle": triangle} | {name: field for name, field in renamed.items() if name not in without}

    def rasterize(clip, triangle) -> tuple:
        return (ops.rasterize(clip, triangle, 9, 11).barycentric,)

    def rasterize_uv(uv, triangle) -> tuple:
        return (ops.rasterize_uv(uv, triangle, 9, 11).barycentric,)

    mesh = {"triangle": triangle}
    return {
        "rasterize": [Subject(rasterize, {"clip": each}, mesh) for each in (clip, clips)],
        "rasterize_uv": [Subject(rasterize_uv, {"uv": each}, mesh) for each in (uv, uvs)],
        "interpolate": [
            Subject(run, {"attribute": values, "barycentric": fields["barycentric"]}, pixels(fields, "barycentric"))
            for values, fields in ((clip, one), (clip, both), (clips, both))
            for run in (interpolate, with_slopes)
        ],
        "texture": [
            Subject(read, {"image": normal(6, 7, 3), "uv": where[0]}, {}),
            Subject(read, {"image": normal(2, 6, 7, 3), "uv": where}, {}),
            Subject(read, {"image": normal(6, 7, 3), "uv": where[0], "derivatives": slopes[0]}, {}),
            Subject(read, {"image": normal(2, 6, 7, 3), "uv": where, "derivatives": slopes}, {}),
        ],
        "antialias": [
            Subject(antialias, {"colour": normal(9, 11, 3), "clip": clip}, pixels(one)),
            Subject(antialias, {"colour": normal(2, 9, 11, 3), "clip": clips}, pixels(both)),
        ],
    }


def subjects(name: str) -> list[Subject]:
    """All calls of one operation."""
    if name in drawing():
        return drawing()[name]

    def subject_of(case) -> Subject:
        return Subject(lambda **tensors: case.call(ops, tensors), case.leaves, case.constants)

    return [subject_of(case) for case in CASES.values() if case.op == name]
