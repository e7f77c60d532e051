"""Builds the room of the atlas demo and bakes its lightmap, small enough for a repository.

A floor and two walls, a column, a knot on a block, and a lamp. The sun gives hard shadows, the lamp soft ones, the sky
and three bounces the rest.

    python demos/make_atlas_mesh.py demos/data/atlas
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from wlm.cli.console import quiet_warp
from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.formats.gltf import document_from_meshes
from wlm.formats.gltf_writer import write_glb
from wlm.texels import fill_gaps

NAME = "room"
SIDE = 256  # texels
PADDING = 2  # texels between charts
DENSITIES = np.arange(40.0, 20.0, -0.25)  # texels a metre; the first at which all charts fit is taken

ROOM, WALL = 4.0, 2.6  # metres
COLUMN = (1.1, 1.0, 0.32)  # x, z, radius
BLOCK = (2.65, 2.45, 0.5, 0.45)  # x, z, half its side, height
KNOT = (2.65, 1.4, 2.45, 0.27, 0.115)  # x, y, z, size, radius of its tube
KNOT_CHARTS = 4
LAMP = (1.05, 1.9, 3.0, 0.22, 0.2)  # x, y, z, radius of its opening, height of its shade

ALBEDO = {"floor": (0.55, 0.5, 0.45), "back": (0.75, 0.72, 0.68), "left": (0.7, 0.28, 0.2), "other": (0.7, 0.7, 0.7)}
SUN = np.array([0.62, 0.62, 0.48])  # where it is
SUN_LIGHT, SUN_RADIUS = np.array([2.2, 2.0, 1.7]), 0.006  # irradiance facing it; radians
LAMP_LIGHT = np.array([9.0, 6.0, 3.2])  # radiance of its opening
SKY = np.array([0.10, 0.13, 0.18])  # radiance
SUN_RAYS, LAMP_RAYS, GATHER_RAYS, BOUNCES = 16, 512, 1024, 3
SUBSAMPLES = 4  # of a texel, along an axis
OFFSET = 2e-4  # metres, of a ray's origin from its surface
MANTISSA_BITS = 8


@dataclass
class Chart:
    """A rectangle of the lightmap: points of a grid, its size in metres, its colour."""

    point: np.ndarray  # [R, C, 3]; in the plane of rows and columns, metres
    width: float
    height: float
    albedo: tuple[float, float, float]


def sheet(origin, right, down, columns: int, rows: int, albedo: str = "other") -> Chart:
    """A flat chart; its normal is down x right."""
    origin, right, down = (np.array(v, float) for v in (origin, right, down))
    c, r = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    point = origin + c[..., None] * right + r[..., None] * down
    return Chart(point, np.linalg.norm(right), np.linalg.norm(down), ALBEDO[albedo])


def around(middle, radius: tuple[float, float], low: float, high: float, columns: int, rows: int) -> Chart:
    """A cylinder or cone that stands upright, seen from outside."""
    turn, share = np.meshgrid(np.linspace(0, 2 * np.pi, columns + 1), np.linspace(0, 1, rows + 1))
    reach = radius[0] + share * (radius[1] - radius[0])  # from the top
    y = high + share * (low - high)
    point = np.stack([middle[0] + reach * np.cos(-turn), y, middle[1] + reach * np.sin(-turn)], -1)
    return Chart(point, 2 * np.pi * max(radius), float(np.hypot(high - low, radius[1] - radius[0])), ALBEDO["other"])


def disc(middle, radius: float, columns: int, rows: int) -> Chart:
    """A flat disc that faces up, from a square whose rings become circles."""
    a, b = np.meshgrid(np.linspace(-1, 1, columns + 1), np.linspace(-1, 1, rows + 1))
    ring, length = np.maximum(abs(a), abs(b)), np.hypot(a, b)
    scale = radius * ring / np.where(length > 0, length, 1.0)
    point = np.stack([middle[0] + a * scale, np.full_like(a, middle[1]), middle[2] + b * scale], -1)
    return Chart(point, 2 * radius, 2 * radius, ALBEDO["other"])


def knot_charts(columns: int, rows: int) -> list[Chart]:
    """A trefoil's tube, cut into pieces along its length."""
    x, y, z, size, radius = KNOT
    turn = np.linspace(0, 2 * np.pi, KNOT_CHARTS * columns + 1)
    (s1, c1), (s2, c2), (s3, c3) = ((np.sin(k * turn), np.cos(k * turn)) for k in (1, 2, 3))
    line = np.stack([s1 + 2 * s2, c1 - 2 * c2, -s3], -1)
    along = np.stack([c1 + 4 * c2, 4 * s2 - s1, -3 * c3], -1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Across the tube: what is left of a fixed direction; the trefoil never runs along it.
    side = np.array([0.0, 0.0, 1.0]) - along[:, 2:] * along
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, rows + 1)[:, None, None]
    tube = size * line + radius * (np.cos(angle) * side + np.sin(angle) * other)  # [rows + 1, N + 1, 3]
    tube = np.concatenate([tube[:-1], tube[:1]]) + [x, y, z]
    tube[:, -1] = tube[:, 0]
    length = size * np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / KNOT_CHARTS
    pieces = (tube[:, i * columns : (i + 1) * columns + 1] for i in range(KNOT_CHARTS))
    return [Chart(piece, length, 2 * np.pi * radius, ALBEDO["other"]) for piece in pieces]


def scene() -> list[Chart]:
    """All charts, each facing the way that its light is baked for."""
    x, z, half, high = BLOCK
    low, far, side = x - half, z + half, 2 * half
    return [
        sheet((0, 0, 0), (ROOM, 0, 0), (0, 0, ROOM), 14, 14, "floor"),
        sheet((0, WALL, 0), (ROOM, 0, 0), (0, -WALL, 0), 14, 9, "back"),
        sheet((0, WALL, ROOM), (0, 0, -ROOM), (0, -WALL, 0), 14, 9, "left"),
        around(COLUMN[:2], (COLUMN[2], COLUMN[2]), 0.0, 1.9, 24, 8),
        disc((COLUMN[0], 1.9, COLUMN[1]), COLUMN[2], 6, 6),
        sheet((low, high, z - half), (side, 0, 0), (0, 0, side), 4, 4),
        sheet((low, high, far), (side, 0, 0), (0, -high, 0), 4, 2),
        sheet((low + side, high, z - half), (-side, 0, 0), (0, -high, 0), 4, 2),
        sheet((low + side, high, far), (0, 0, -side), (0, -high, 0), 4, 2),
        sheet((low, high, z - half), (0, 0, side), (0, -high, 0), 4, 2),
        around((LAMP[0], LAMP[2]), (0.05, LAMP[3]), LAMP[1], LAMP[1] + LAMP[4], 24, 2),
        *knot_charts(32, 9),
    ]


def placed(charts: list[Chart]) -> list[tuple[int, int, int, int]]:
    """Column, row, width and height of each chart in texels, on shelves, at the highest density that fits."""
    for density in DENSITIES:
        sizes = [(max(2, round(c.width * density)), max(2, round(c.height * density))) for c in charts]
        spots: list[tuple[int, int, int, int]] = [(0, 0, 0, 0)] * len(charts)
        x = y = shelf = 0
        for i in sorted(range(len(charts)), key=lambda i: -sizes[i][1]):
            w, h = sizes[i]
            if x + w > SIDE:
                x, y, shelf = 0, y + shelf + PADDING, 0
            spots[i] = x, y, w, h
            x, shelf = x + w + PADDING, max(shelf, h)
        if y + shelf <= SIDE:
            return spots
    raise ValueError("the charts do not fit")


@wp.kernel(enable_backward=False)
def _direct(
    # in:
    mesh: wp.uint64,
    position: wp.array1d[wp.vec3],
    normal: wp.array1d[wp.vec3],
    toward: wp.array1d[wp.vec3],
    sun: wp.vec3,
    lamp: wp.array1d[wp.vec3],
    lamp_light: wp.vec3,
    # out:
    out: wp.array1d[wp.vec3],
    buried: wp.array1d[wp.bool],
):
    i = wp.tid()
    x = position[i]
    n = normal[i]
    above = wp.mesh_query_ray(mesh, x, n, 100.0)
    buried[i] = above.result and above.sign < 0.0
    total = wp.vec3()
    for k in range(toward.shape[0]):
        facing = wp.dot(n, toward[k])
        if facing > 0.0 and not wp.mesh_query_ray(mesh, x, toward[k], 100.0).result:
            total += facing / float(toward.shape[0]) * sun
    for k in range(lamp.shape[0]):
        d = lamp[k] - x
        far = wp.length(d)
        d = d / far
        # The lamp shines down. Its radiance times its area is in `lamp_light`.
        cosines = wp.max(wp.dot(n, d), 0.0) * wp.max(d[1], 0.0)
        if cosines > 0.0 and not wp.mesh_query_ray(mesh, x, d, far - 1.0e-4).result:
            total += cosines / (far * far * float(lamp.shape[0])) * lamp_light
    out[i] = total


@wp.kernel(enable_backward=False)
def _gather(
    # in:
    mesh: wp.uint64,
    position: wp.array1d[wp.vec3],
    normal: wp.array1d[wp.vec3],
    direction: wp.array1d[wp.vec3],
    corner_uv: wp.array2d[wp.vec2],
    albedo: wp.array1d[wp.vec3],
    light: wp.array2d[wp.vec3],
    sky: wp.vec3,
    # out:
    out: wp.array1d[wp.vec3],
):
    i = wp.tid()
    n = normal[i]
    across = wp.normalize(wp.cross(n, wp.where(wp.abs(n[1]) < 0.9, wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0))))
    other = wp.cross(n, across)
    total = wp.vec3()
    for k in range(direction.shape[0]):
        d = direction[k]
        hit = wp.mesh_query_ray(mesh, position[i], d[0] * across + d[1] * other + d[2] * n, 100.0)
        if not hit.result:
            total += wp.pi * sky
        elif hit.sign > 0.0:  # backs are black
            uv = hit.u * corner_uv[hit.face, 0] + hit.v * corner_uv[hit.face, 1]
            uv += (1.0 - hit.u - hit.v) * corner_uv[hit.face, 2]
            row = wp.min(int(uv[1] * float(light.shape[0])), light.shape[0] - 1)
            column = wp.min(int(uv[0] * float(light.shape[1])), light.shape[1] - 1)
            total += wp.cw_mul(albedo[hit.face], light[row, column])
    out[i] = total / float(direction.shape[0])


def spiral(count: int) -> np.ndarray:
    """Points spread evenly over the unit disc. All texels use the same ones: errors vary slowly, and are no noise."""
    i = np.arange(count) + 0.5
    angle = i * np.pi * (3.0 - np.sqrt(5.0))
    return np.sqrt(i / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def bake(charts: list[Chart], spots: list[tuple[int, int, int, int]]) -> tuple[np.ndarray, ...]:
    """Positions [V, 3], triangles [F, 3], UVs [V, 2] and the lightmap [SIDE, SIDE, 3]."""
    positions, uvs, triangles, albedo = [], [], [], []
    texel, sample, normal = [], [], []
    first = 0
    for chart, (x, y, w, h) in zip(charts, spots, strict=True):
        rows, columns = (n - 1 for n in chart.point.shape[:2])
        # From centre to centre of the outermost texels: a bilinear read never leaves the chart.
        c, r = np.meshgrid(np.linspace(0.5, w - 0.5, columns + 1), np.linspace(0.5, h - 0.5, rows + 1))
        uvs.append(np.stack([x + c, y + r], -1).reshape(-1, 2) / SIDE)
        positions.append(chart.point.reshape(-1, 3))
        number = first + np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
        a, b, d, e = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
        triangles.append(np.stack([a, d, b, b, d, e], -1).reshape(-1, 3))
        albedo += [chart.albedo] * len(triangles[-1])
        first += number.size
        # Subsamples of the texels, those in the chart.
        step = (np.arange(w * SUBSAMPLES) + 0.5) / SUBSAMPLES, (np.arange(h * SUBSAMPLES) + 0.5) / SUBSAMPLES
        s, t = np.meshgrid(*step)
        inside = (s > 0.5) & (s < w - 0.5) & (t > 0.5) & (t < h - 0.5)
        s, t = s[inside], t[inside]
        texel.append((y + t.astype(int)) * SIDE + x + s.astype(int))
        point, right, down = _on_grid(chart.point, (s - 0.5) / (w - 1) * columns, (t - 0.5) / (h - 1) * rows)
        facing = np.cross(down, right)
        normal.append(facing / np.linalg.norm(facing, axis=1, keepdims=True))
        sample.append(point + OFFSET * normal[-1])
    positions, uvs, triangles = (np.concatenate(part) for part in (positions, uvs, triangles))
    texel, sample, normal = (np.concatenate(part) for part in (texel, sample, normal))
    mesh = wp.Mesh(wp.array(positions, dtype=wp.vec3), wp.array(triangles.reshape(-1).astype(np.int32), dtype=int))
    place, face = wp.array(sample, dtype=wp.vec3), wp.array(normal, dtype=wp.vec3)
    disc_points = spiral(SUN_RAYS)
    sun = SUN / np.linalg.norm(SUN)
    right = np.cross(sun, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    toward = sun + SUN_RADIUS * (disc_points[:, :1] * right + disc_points[:, 1:] * np.cross(sun, right))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    opening = LAMP[3] * spiral(LAMP_RAYS)
    lamp = np.stack([LAMP[0] + opening[:, 0], np.full(LAMP_RAYS, LAMP[1]), LAMP[2] + opening[:, 1]], -1)
    power = LAMP_LIGHT * np.pi * LAMP[3] ** 2
    found, buried = wp.zeros(len(sample), dtype=wp.vec3), wp.zeros(len(sample), dtype=wp.bool)
    lit = [wp.array(toward, dtype=wp.vec3), wp.vec3(SUN_LIGHT), wp.array(lamp, dtype=wp.vec3), wp.vec3(power)]
    wp.launch(_direct, len(sample), inputs=[mesh.id, place, face, *lit], outputs=[found, buried])
    # What lies inside of another body is dark, and would leak out between texels.
    inside = np.isin(np.arange(SIDE * SIDE), texel).reshape(SIDE, SIDE)
    free = ~buried.numpy()
    texel, sample, normal = texel[free], sample[free], normal[free]
    used, at, count = np.unique(texel, return_inverse=True, return_counts=True)
    known = np.isin(np.arange(SIDE * SIDE), used).reshape(SIDE, SIDE)

    def image(values: np.ndarray) -> np.ndarray:
        whole = np.zeros((SIDE * SIDE, 3), np.float32)
        whole[used] = values
        return fill_gaps(whole.reshape(SIDE, SIDE, 3), known) * inside[..., None]

    values = found.numpy()[free]
    direct = np.stack([np.bincount(at, values[:, c]) for c in range(3)], -1) / count[:, None]
    print(f"direct light of {len(used)} texels, {inside.sum() - len(used)} more are buried")
    # Light from all around is smooth: one sample a texel.
    nearest = _nearest(sample, at, len(used))
    disc_points = spiral(GATHER_RAYS)
    up = np.sqrt(np.maximum(0.0, 1.0 - (disc_points**2).sum(1)))
    direction = wp.array(np.column_stack([disc_points, up]), dtype=wp.vec3)
    corner_uv = wp.array(uvs[triangles], dtype=wp.vec2)
    colour = wp.array(np.array(albedo), dtype=wp.vec3)
    place, face = wp.array(sample[nearest], dtype=wp.vec3), wp.array(normal[nearest], dtype=wp.vec3)
    found = wp.zeros(len(used), dtype=wp.vec3)
    whole = direct
    for bounce in range(BOUNCES):
        light = wp.array(image(whole), dtype=wp.vec3)
        inputs = [mesh.id, place, face, direction, corner_uv, colour, light, wp.vec3(SKY)]
        wp.launch(_gather, len(used), inputs=inputs, outputs=[found])
        whole = direct + found.numpy()
        print(f"bounce {bounce + 1} of {BOUNCES}")
    return positions, triangles, uvs, rounded(image(whole))


def _on_grid(point: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N, 3] on the triangles of a grid, and how they change to the right and down."""
    c = column.astype(int).clip(0, point.shape[1] - 2)
    r = row.astype(int).clip(0, point.shape[0] - 2)
    u, v = (column - c)[:, None], (row - r)[:, None]
    a, b, d, e = point[r, c], point[r, c + 1], point[r + 1, c], point[r + 1, c + 1]
    upper = u + v <= 1.0
    right, down = np.where(upper, b - a, e - d), np.where(upper, d - a, e - b)
    return np.where(upper, a + u * right + v * down, e - (1 - u) * right - (1 - v) * down), right, down


def _nearest(sample: np.ndarray, texel: np.ndarray, count: int) -> np.ndarray:
    """Selects for each texel the sample nearest to the middle of its samples."""
    size = np.bincount(texel, minlength=count)
    middle = np.stack([np.bincount(texel, sample[:, c], count) for c in range(3)], -1) / size[:, None]
    order = np.lexsort((((sample - middle[texel]) ** 2).sum(1), texel))
    return order[np.concatenate([[0], np.cumsum(size)[:-1]])]


def rounded(image: np.ndarray) -> np.ndarray:
    """Rounded to few bits, which the file's compression takes."""
    mantissa, exponent = np.frexp(image)
    return np.ldexp(np.round(mantissa * 2**MANTISSA_BITS) / 2**MANTISSA_BITS, exponent)


def main() -> None:
    """Reads the command line, builds, bakes and says what was written."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT_DIR", help="the folder to write to")
    args = parser.parse_args()
    quiet_warp()
    charts = scene()
    position, triangle, uv, lightmap = bake(charts, placed(charts))
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        document, _ = document_from_meshes([(NAME, position, triangle, uv)], NAME)
        size = write_glb(args.out / f"{NAME}.glb", document, [], 1)
        write_exr(args.out / f"{NAME}.exr", lightmap)
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    used = np.count_nonzero(lightmap.any(axis=2)) / lightmap[..., 0].size
    print(f"{args.out}: {len(triangle)} triangles, {size / 1e3:.0f} kB; {used:.0%} of {SIDE}x{SIDE} texels in charts")


if __name__ == "__main__":
    main()
