"""Makes the files of the scene `demos/data/street` from two bakes of a city, without and with the sun's direct light.

`demos/data/street` was made from bakes of 512 x 512 texels, on a GPU:

    python demos/make_street.py .../city .../city_sun demos/data/street --device cuda:0

The scene file `street.yaml` is written by hand. The light of the sun is the difference of both bakes. Its direction and
the light of the lamps, which moving objects need, are fitted to the bakes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
import warp as wp
from street_models import VOXELS, plume, save_mesh, vehicles

import wlm
from wlm.cli.console import quiet_warp
from wlm.errors import WlmError
from wlm.fluid.volume import from_array
from wlm.formats.exr import write_exr
from wlm.formats.gltf import GltfPrimitive, read_gltf
from wlm.lightmap.data import LightmapSet
from wlm.ops import rasterize_uv
from wlm.probe.sphere import basis
from wlm.smoke.camera import Camera
from wlm.texels import fill_gaps

PARTS = ("light", "mesh", "originals", "probes", "moving", "smoke")
ORIGINALS = (7.0, 12.0, 18.55, 22.0)  # hours of the lightmaps for comparison

PROBE_HOURS = (5.0, 6.0, 7.0, 9.0, 12.0, 15.0, 17.0, 18.45, 18.55, 19.0)  # from 19 h to 5 h the light does not change
COLUMNS = np.linspace(-0.4, 4.4, 25)  # x and z of the probes, metres
HEIGHTS = (0.06, 0.2, 0.4, 0.7, 1.1, 1.6, 2.1)
RAYS = 512
MOST_BACKS = 0.1  # share of rays that meet the back of a triangle; a probe with more is inside a building
# Factors of the bands. The irradiance of a directional light is then 3/8 (cos + 1/sqrt 3)² of it, and never negative.
WINDOW = np.repeat([1.0, np.sqrt(0.75), 0.8], [1, 3, 5])

# Ends of the arms of the lamps (x, z). The bake's lamps shine down from a point beyond the end.
LAMPS = np.array(
    [(-0.25, 1), (0.25, 1), (1, 0.25), (1, -0.25), (2, 3.25), (2, 2.75), (2.75, 2), (3.25, 2)]
    + [(2.75, 4), (3.25, 4), (4, 3.25), (4, 2.75)]
)
LAMP_BEYOND, LAMP_HEIGHT = 0.1, 0.52
LAMP_REACH = 0.45  # metres; texels of the street up to here from a lamp take part in the fit

FRAMES, PIXELS = 24, 64  # of the smoke
DENSITY = 16.0  # optical depth across the box at density 1


def groups(city: LightmapSet, city_sun: LightmapSet) -> dict[str, LightmapSet]:
    """Splits the bakes in the light of sky and lamps, and that of the sun, which is 0 where noise makes it negative."""
    light, both = city.light, city_sun.light
    rows = [int(np.flatnonzero(light.times == time)[0]) for time in both.times]
    sun = np.maximum(both.frames - light.frames[rows], 0.0)
    return {"sky": city, "sun": wlm.lightmap.from_arrays(sun, both.times, mask=both.mask, period=light.period)}


def texels(mesh: GltfPrimitive, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns which texels have a point of the surface [H, W], and their positions and normals [K, 3]."""
    raster = rasterize_uv(torch.from_numpy(mesh.uv[0]), torch.from_numpy(mesh.triangle), *mask.shape)
    face = raster.triangle.numpy()
    inside = (face >= 0) & mask
    corner = mesh.position[mesh.triangle[face[inside]]]
    u, v = raster.barycentric.numpy()[inside].T[..., None]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return inside, u * corner[:, 0] + v * corner[:, 1] + (1 - u - v) * corner[:, 2], normal


def fit_sun(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Fits direction times irradiance s [3 axes, 3 channels] to the light of the sun on texels, E = max(n.s, 0)."""
    grey = light.mean(1)

    def bright(axis: int, sign: int) -> float:
        return np.percentile(grey[sign * normal[:, axis] > 0.99], 95)

    sun = np.array([bright(axis, 1) - (bright(axis, -1) if axis != 1 else 0.0) for axis in range(3)])
    for _ in range(20):  # without texels in shadow
        strength = np.linalg.norm(sun)
        lit = (normal @ sun > 0.3 * strength) & (abs(normal @ sun - grey) < 0.15 * strength)
        sun = np.linalg.lstsq(normal[lit], grey[lit], rcond=None)[0]
    return np.linalg.lstsq(normal[lit], light[lit], rcond=None)[0]


def fit_lamps(position: np.ndarray, normal: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits the lamps to the light of the street: returns their places [12, 3] and the intensity straight down [3]."""
    arm = np.where(abs(LAMPS - 3 * np.rint(LAMPS / 3)) < 0.5, 3 * np.rint(LAMPS / 3) - LAMPS, 0.0)
    place = LAMPS + LAMP_BEYOND * np.sign(arm)
    place = np.column_stack([place[:, 0], np.full(len(place), LAMP_HEIGHT), place[:, 1]])
    near = (normal[:, 1] > 0.99) & (position[:, 1] < 0.06)
    near &= np.linalg.norm(position[:, None, ::2] - place[:, ::2], axis=2).min(1) < LAMP_REACH
    toward = place - position[near, None]
    known = (toward[..., 1] ** 2 / (toward**2).sum(2) ** 2).sum(1)  # both cosines over the squared distance
    found = np.linalg.lstsq(np.stack([known, np.ones_like(known)], 1), light[near], rcond=None)[0]
    return place, found[0]


@wp.kernel(enable_backward=False)
def _trace(
    # in:
    mesh: wp.uint64,
    origin: wp.array1d[wp.vec3],
    direction: wp.array1d[wp.vec3],
    corner_uv: wp.array2d[wp.vec2],
    side: int,
    # out:
    face: wp.array2d[int],  # -1: the sky; -2: the back of a triangle
    texel: wp.array2d[int],
):
    i, k = wp.tid()
    hit = wp.mesh_query_ray(mesh, origin[i], direction[k], 100.0)
    face[i, k] = -1
    if hit.result:
        uv = hit.u * corner_uv[hit.face, 0] + hit.v * corner_uv[hit.face, 1]
        uv = float(side) * (uv + (1.0 - hit.u - hit.v) * corner_uv[hit.face, 2])
        texel[i, k] = wp.min(int(uv[1]), side - 1) * side + wp.min(int(uv[0]), side - 1)
        face[i, k] = wp.where(hit.sign > 0.0, hit.face, -2)


@wp.kernel(enable_backward=False)
def _reaches(mesh: wp.uint64, origin: wp.array1d[wp.vec3], way: wp.array2d[wp.vec3], out: wp.array2d[wp.bool]):
    i, k = wp.tid()
    far = wp.length(way[i, k])
    out[i, k] = not wp.mesh_query_ray(mesh, origin[i], way[i, k] / far, far).result


class Gather:
    """The light that reaches points, from lightmaps: rays are traced once, and serve all hours."""

    def __init__(self, mesh: GltfPrimitive, albedo: np.ndarray, points: np.ndarray, side: int) -> None:
        corners = wp.array(mesh.triangle.reshape(-1), dtype=int)
        self.mesh = wp.Mesh(wp.array(mesh.position, dtype=wp.vec3), corners)
        z = 1.0 - (2.0 * np.arange(RAYS) + 1.0) / RAYS  # even over the sphere, on a spiral
        turn, ring = np.arange(RAYS) * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(1.0 - z * z)
        direction = np.stack([ring * np.cos(turn), z, ring * np.sin(turn)], 1)
        self.weights = basis(direction, 9) * (4.0 * np.pi / RAYS)
        face, texel = (wp.zeros((len(points), RAYS), dtype=int) for _ in range(2))
        corner_uv = wp.array(mesh.uv[0][mesh.triangle], dtype=wp.vec2)
        inputs = [self.mesh.id, wp.array(points, dtype=wp.vec3), wp.array(direction, dtype=wp.vec3), corner_uv, side]
        wp.launch(_trace, (len(points), RAYS), inputs=inputs, outputs=[face, texel])
        self.free = (face.numpy() == -2).mean(1) <= MOST_BACKS
        self.points, self.face, self.texel = points[self.free], face.numpy()[self.free], texel.numpy()[self.free]
        self.albedo = np.vstack([albedo, np.zeros((2, 3))]).astype(np.float32)  # rows -1 and -2 reflect nothing

    def reflected(self, light: np.ndarray, sky: np.ndarray) -> np.ndarray:
        """Returns SH [N, 9, 3] of the light of the surfaces under a lightmap without gaps, and of the sky."""
        rays = self.albedo[self.face] * light.reshape(-1, 3)[self.texel] / np.pi
        rays[self.face == -1] = sky
        return np.einsum("rk,nrc->nkc", self.weights, rays, optimize=True)

    def direct(self, way: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Returns SH [N, 9, 3] of lights in the direction and at the distance of `way` [N, L, 3], of the irradiance
        `light` [N, L, 3], where nothing is between."""
        seen = wp.zeros(way.shape[:2], dtype=wp.bool)
        inputs = [self.mesh.id, wp.array(self.points, dtype=wp.vec3), wp.array(way, dtype=wp.vec3)]
        wp.launch(_reaches, way.shape[:2], inputs=inputs, outputs=[seen])
        toward = (way / np.linalg.norm(way, axis=2, keepdims=True)).reshape(-1, 3)
        return np.einsum("nlk,nlc->nkc", basis(toward, 9).reshape(*way.shape[:2], 9), light * seen.numpy()[..., None])


def make_probes(mesh: GltfPrimitive, albedo: np.ndarray, sets: dict[str, LightmapSet]) -> tuple[np.ndarray, dict]:
    """Returns the positions of probes in the open [N, 3], and by hour their SH of radiance [N, 9, 3], windowed."""
    sky, sun = sets["sky"].light, sets["sun"].light
    inside, position, normal = texels(mesh, sky.mask)
    y, x, z = (axis.reshape(-1) for axis in np.meshgrid(HEIGHTS, COLUMNS, COLUMNS, indexing="ij"))
    gather = Gather(mesh, albedo, np.stack([x, y, z], 1), len(sky.mask))
    lamps, intensity = fit_lamps(position, normal, (sky.at(21.0) - sky.at(18.45))[inside].clip(0.0))
    roof = (normal[:, 1] > 0.99) & (position[:, 1] > 1.0)
    found = {}
    for hour in PROBE_HOURS:
        sky_light, sun_light = sky.at(hour), sun.at(hour)
        open_sky = np.percentile(sky_light[inside][roof], 90, axis=0) / np.pi  # E = pi L under all of the sky
        values = gather.reflected(fill_gaps(sky_light + sun_light, sky.mask), open_sky)
        if sun_light.any():
            fitted = fit_sun(normal, sun_light[inside])
            axis = fitted.sum(1) / np.linalg.norm(fitted.sum(1))
            way = np.broadcast_to(100.0 * axis, (len(values), 1, 3))
            values += gather.direct(way, np.broadcast_to(np.linalg.norm(fitted, axis=0), way.shape))
            print(f"{hour:g} h: the sun is at {axis.round(2)} and gives {np.linalg.norm(fitted, axis=0).round(2)}")
        if not 6.0 <= hour <= 18.5:
            way = lamps - gather.points[:, None]
            far = np.maximum(np.linalg.norm(way, axis=2, keepdims=True), LAMP_BEYOND)
            values += gather.direct(way, intensity * np.maximum(way[..., 1:2], 0.0) / far**3)
        found[hour] = WINDOW[:, None] * values
    return gather.points, found


def check(path: Path, mesh: GltfPrimitive, albedo: np.ndarray, sets: dict[str, LightmapSet]) -> None:
    """Compares the light of the surfaces with that of a path tracer, without sky, at every tenth of its probes."""
    with np.load(path) as file:
        traced = {key: file[key][::10] for key in file}
    sky, sun = sets["sky"].light, sets["sun"].light
    gather = Gather(mesh, albedo, traced.pop("position").astype(np.float32), len(sky.mask))
    for key, expected in ((key, values[gather.free]) for key, values in traced.items()):
        hour = float(key.removeprefix("sh_"))
        found = gather.reflected(fill_gaps(sky.at(hour) + sun.at(hour), sky.mask), np.zeros(3))
        ratio = np.median(found[:, 0] / np.maximum(expected[:, 0], 1e-6))
        error = np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2))
        print(f"{hour:g} h: {len(found)} probes, {ratio:.3f} of the path tracer's light, RMS error {100 * error:.1f}%")


def make(args: argparse.Namespace) -> None:
    """Writes the chosen parts."""
    out: Path = args.out
    (out / "smoke").mkdir(parents=True, exist_ok=True)
    city, city_sun = (wlm.lightmap.load(each) for each in (args.city, args.city_sun))
    sets = groups(city, city_sun)
    _, (mesh,) = read_gltf(args.city / "scene.glb")
    albedo = np.load(args.city / "albedo.npz")["face_albedo"]
    if args.check:
        check(args.check, mesh, albedo, sets)
    if "mesh" in args.parts:
        save_mesh(out / "street.glb", mesh.position, mesh.triangle, albedo, mesh.uv[0])
    if "originals" in args.parts:
        for hour in ORIGINALS:
            light = np.maximum(city.light.at(hour), city_sun.light.at(hour) if 5.0 <= hour <= 19.0 else 0.0)
            name = f"lightmap_{hour:05.2f}h.exr".replace(".", "_", 1)
            write_exr(out / name, light * city.light.mask[..., None])
    if "moving" in args.parts:
        for name, (position, triangle, colour) in vehicles().items():
            save_mesh(out / f"{name}.glb", position, triangle, colour, None)
    if "smoke" in args.parts:
        camera = Camera.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.5), extent=1.0, height=PIXELS, width=PIXELS)
        for number in range(FRAMES):
            cloud = from_array(plume(number / FRAMES), extinction=DENSITY, voxel=1.0 / VOXELS)
            six = wlm.smoke.bake(cloud, camera, estimate=False)
            wlm.smoke.write_six_way(out / "smoke" / f"smoke_{number:02}.exr", six)
    if "probes" in args.parts:
        points, found = make_probes(mesh, albedo, sets)
        values = np.stack(list(found.values())).astype(np.float32)
        probes = wlm.probe.from_arrays(points, values, times=list(found), name="street")
        model = wlm.probe.compress(probes, args.probes, positions=True, device=args.device)
        size = model.save(out / "probes.wlm")
        print(f"probes.wlm: {len(points)} probes, {size} bytes, {wlm.probe.evaluate(model, probes).psnr:.1f} dB")
    if "light" in args.parts:
        settings = {"steps": args.steps} if args.steps else {}
        both = wlm.lightmap.from_groups(sets, "street")
        model = wlm.lightmap.compress(both, args.profile, device=args.device, **settings)
        print(f"street.wlm: {model.save(out / 'street.wlm')} bytes, {model.memory_bytes} bytes in the memory of a GPU")


def main() -> None:
    """Reads the command line, makes the files and says what was written."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "city", type=Path, metavar="CITY", help="the folder of the bake without the direct light of the sun"
    )
    parser.add_argument("city_sun", type=Path, metavar="CITY_SUN", help="that of the bake with it")
    parser.add_argument("out", type=Path, metavar="OUT_DIR", help="the folder to write to")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to make; else all")
    parser.add_argument("--profile", default="M", help="profile of the lightmaps")
    parser.add_argument("--steps", type=int, help="steps of their fit; by default those of the profile")
    parser.add_argument("--probes", default="pca", help="profile of the probes")
    parser.add_argument("--check", type=Path, metavar="NPZ", help="probes of a path tracer to compare the gather with")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    args = parser.parse_args()
    quiet_warp()
    try:
        make(args)
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    size = sum(file.stat().st_size for file in args.out.rglob("*") if file.is_file())
    print(f"{args.out}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
