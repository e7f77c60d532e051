"""Surfaces of a scene: triangles in world space with normals, lightmap UVs (or newly unwrapped UVs) and materials."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bake.settings import BakeScene, LightmapSettings
from wlm.errors import WlmError, one_line
from wlm.formats.gltf import GltfDocument, GltfPrimitive, read_gltf, reported, texture_transform, vertex_normals
from wlm.formats.gltf_slots import lightmap_uv, texture_picture, usual_set
from wlm.formats.gltf_writer import Replacement
from wlm.formats.hdr_blocks import need

_UNWRAPPED = 1  # n of the new `TEXCOORD_n`
_STRONGEST = 1e9  # radiance
_LARGEST = 1e9
_NEAREST = 0.01  # least size over distance: Mitsuba offsets ray origins by 1e-4 (1 + |position|), in float32
_BRIGHTEST = 0.99  # largest albedo: with 1, light in a closed scene would never be absorbed


@dataclass(frozen=True, eq=False)
class Material:
    """A diffuse material, with a name by which lamps refer to it, or "".

    Its linear RGB albedo is `colour` times that of the texture, float32 [H, W, 3], if there is one; this uses the UV
    set `TEXCOORD_n` of n = `uv_set`, whose UVs (u, v, 1) `placed`, the matrix [2, 3] of `KHR_texture_transform`, moves.
    `emission` is the radiance on the front. The back reflects as well if it is `double`, else it absorbs all light.
    """

    name: str = ""
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    texture: np.ndarray | None = None
    uv_set: int = 0
    placed: np.ndarray = field(default_factory=lambda: np.eye(2, 3))
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    double: bool = False


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one material, int32 [F, 3], counter-clockwise as seen from the front, of vertices float64 [V, 3] in
    the world.

    `normal`, float64 [V, 3], are unit shading normals, 0 where the file has none; `uv`, float64 [V, 2], are lightmap
    UVs, None if the surface has none and isn't baked; `texture_uv`, float32 [V, 2] or None, are for the material's
    texture.
    """

    position: np.ndarray
    triangle: np.ndarray
    normal: np.ndarray
    uv: np.ndarray | None
    texture_uv: np.ndarray | None
    material: Material


@dataclass(frozen=True, eq=False)
class Geometry:
    """The surfaces of a glTF file, in its order.

    New UVs are written to `document`; `replacements` are the primitives with new UVs, for `write_glb`. `uv_set` is the
    number n of the lightmap's UV set `TEXCOORD_n`, None if no lightmap UVs were requested; `usual` tells whether
    readers choose this UV set by default: `TEXCOORD_1` if it exists, else `TEXCOORD_0`.
    """

    document: GltfDocument
    surfaces: tuple[Surface, ...]
    replacements: tuple[Replacement, ...]
    uv_set: int | None = None
    usual: bool = True

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the lowest and the highest corner of the bounding box, float64 [3] each."""
        used = np.concatenate([each.position[each.triangle.reshape(-1)] for each in self.surfaces])
        return used.min(0), used.max(0)


def read_geometry(path: Path, settings: LightmapSettings | None, trust: bool = False) -> Geometry:
    """Reads a glTF file; `settings` selects the lightmap UVs or how to unwrap them, None if no UVs are needed."""
    document, primitives = read_gltf(path, trust)
    for each in primitives:
        if not np.isfinite(each.position).all():
            raise WlmError(f"{path}: {each.name}: expected finite positions, found NaN or infinity")
    replacements: list[Replacement] = []
    number, usual = None, True
    if settings is not None and settings.unwrap:
        with reported(document.path):
            document, primitives = _without_lightmap(document, primitives)
        replacements = unwrap(document, primitives, settings)
        number = _UNWRAPPED
    elif settings is not None:
        own = usual_set(primitives)
        number = own if settings.uv_set is None else settings.uv_set
        usual = number == own
        if not any(number in each.uv for each in primitives):
            raise WlmError(f"{path}: no lightmap UVs in TEXCOORD_{number}: lightmap.unwrap: true creates new UVs")
    cache: dict[int | None, Material] = {}
    surfaces = []
    normals = vertex_normals(document, primitives)
    new = {(each.primitive.node, each.primitive.primitive): each for each in replacements}
    for each, normal in zip(primitives, normals, strict=True):
        if each.material not in cache:
            with reported(document.path):
                cache[each.material] = _material(document, each.material)
        made = new.get((each.node, each.primitive))
        gather = np.arange(len(each.position)) if made is None else made.gather
        triangle = each.triangle if made is None else made.triangle
        uv = None if made is None else made.uv
        if made is None and number in each.uv:
            uv = lightmap_uv(document, each, number)
        surface = _surface(each, gather, triangle, normal, uv, cache[each.material])
        if len(surface.triangle):
            surfaces.append(surface)
    if not surfaces:
        raise WlmError(f"{path}: expected at least one triangle with an area above 0, found none")
    geometry = Geometry(document, tuple(surfaces), tuple(replacements), number, usual)
    low, high = geometry.box
    size, reach = float(np.linalg.norm(high - low)), float(np.maximum(-low, high).max())
    if not _NEAREST * (1.0 + reach) <= size <= _LARGEST:
        raise WlmError(
            f"{path}: expected a scene diagonal from {_NEAREST * (1.0 + reach):.3g} to {_LARGEST:g}, found {size:.3g}: "
            f"float32 rays are too coarse at the farthest coordinate, {reach:.3g}"
        )
    return geometry


def check_lamps(path: Path, scene: BakeScene, geometry: Geometry) -> None:
    """Checks that the materials named by lamps exist; `path` is the scene file, for the message."""
    names = sorted({each.material.name for each in geometry.surfaces})
    for i, lamp in enumerate(scene.lamps):
        if lamp.material is not None and lamp.material not in names:
            raise WlmError(f"{path}: lamps.{i}.material: expected one of {', '.join(names)}, got {lamp.material!r}")


def _surface(
    primitive: GltfPrimitive,
    gather: np.ndarray,
    triangle: np.ndarray,
    normal: np.ndarray | None,
    uv: np.ndarray | None,
    material: Material,
) -> Surface:
    """Returns a primitive's triangles whose area isn't 0, with their front faces on the side of their normals."""
    position = primitive.position[gather]
    triangle = np.asarray(triangle, np.int32)
    a, b, c = position[triangle].transpose(1, 0, 2)
    face = np.cross(b - a, c - a)
    kept = np.linalg.norm(face, axis=1) > 0
    triangle, face = triangle[kept], face[kept]
    normal = np.zeros_like(position) if normal is None else normal[gather]
    # A mirroring node transform reverses the winding but not the normals.
    if len(face) and float(np.einsum("fk,fk->", face, normal[triangle].sum(1))) < 0:
        triangle = triangle[:, [0, 2, 1]]
    if uv is not None:
        uv = np.asarray(uv, np.float64)
        if not np.isfinite(uv).all():
            raise WlmError(f"{primitive.name}: expected finite lightmap UVs, found NaN or infinity")
    texture_uv = None
    if material.texture is not None:
        texture_uv = primitive.uv.get(material.uv_set)
        if texture_uv is not None:
            texture_uv = (texture_uv[gather] @ material.placed[:, :2].T + material.placed[:, 2]).astype(np.float32)
    return Surface(position, triangle, normal, uv, texture_uv, material)


def unwrap(
    document: GltfDocument, primitives: Sequence[GltfPrimitive], settings: LightmapSettings
) -> list[Replacement]:
    """Creates UVs in one unit square for all primitives together; UV areas are proportional to areas in the world.
    Returns a replacement for each primitive that has a triangle with area, its UVs in [0, 1]."""
    uvunwrap = need("uvunwrap", "bake")
    meshes, kept = [], []
    for each in primitives:
        a, b, c = each.position[each.triangle].transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0
        if area.any():
            kept.append((each, np.flatnonzero(area)))
            # Positions are centred, because float32 is imprecise far from the origin.
            local = (each.position - each.position.mean(0)).astype(np.float32)
            meshes.append(uvunwrap.Mesh(local, each.triangle[area].astype(np.uint32)))
    if not meshes:
        raise WlmError(f"{document.path}: expected at least one triangle with an area above 0, found none")
    try:
        atlas = uvunwrap.generate(meshes, page_size=settings.resolution, padding=settings.padding)
    except uvunwrap.UnwrapError as error:
        raise WlmError(f"{document.path}: uvunwrap: {one_line(error)}") from error
    if atlas.page_count != 1 or max(atlas.width, atlas.height) > settings.resolution:
        raise WlmError(
            f"{document.path}: charts don't fit: raise lightmap.resolution ({settings.resolution}) or lower its padding"
        )
    scale = np.array([atlas.width, atlas.height]) / settings.resolution
    replacements = []
    for (primitive, numbers), mesh in zip(kept, atlas.meshes, strict=True):
        corner = np.asarray(mesh.corner_uvs, np.float64).reshape(-1, 2) * scale
        vertex = primitive.triangle[numbers].reshape(-1)
        # Each old vertex becomes one vertex per distinct UV position.
        rows = np.column_stack([vertex.astype(np.float64), corner])
        unique, index = np.unique(rows, axis=0, return_inverse=True)
        replacements.append(
            Replacement(primitive, unique[:, 0].astype(np.int64), index.reshape(-1, 3).astype(np.int32), unique[:, 1:])
        )
    return replacements


def _without_lightmap(
    document: GltfDocument, primitives: Sequence[GltfPrimitive]
) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Returns a copy without `TEXCOORD_1` and above, which belong to an old lightmap; they must not be in use."""
    content = copy.deepcopy(document.content)
    for material in content.get("materials", []):
        if used := [one for one in _texture_sets(material) if one >= _UNWRAPPED]:
            raise WlmError(f"{document.path}: a texture uses TEXCOORD_{used[0]}, which lightmap.unwrap replaces")
    for mesh in content.get("meshes", []):
        for primitive in mesh["primitives"]:
            for name in [name for name in primitive["attributes"] if name.startswith("TEXCOORD_")]:
                if name != "TEXCOORD_0":
                    del primitive["attributes"][name]
    uvs = [replace(each, uv={n: uv for n, uv in each.uv.items() if n < _UNWRAPPED}) for each in primitives]
    return replace(document, content=content), uvs


def _texture_sets(value: Any) -> list[int]:
    if isinstance(value, list):
        return [one for each in value for one in _texture_sets(each)]
    if not isinstance(value, dict):
        return []
    inner = [one for each in value.values() for one in _texture_sets(each)]
    return inner + ([value["texCoord"]] if isinstance(value.get("texCoord"), int) else [])


def _material(document: GltfDocument, number: int | None) -> Material:
    """Converts a material to a diffuse one; the base colour of a metal becomes its albedo too."""
    if number is None:
        return Material()
    content = document.item("materials", number)
    surface = content.get("pbrMetallicRoughness", {})
    factor = np.clip(np.array(surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), np.float64)[:3], 0.0, _BRIGHTEST)
    strength = float(
        content.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    )
    emission = np.array(content.get("emissiveFactor", (0.0, 0.0, 0.0)), np.float64) * strength
    if emission.shape != (3,) or not ((emission >= 0) & (emission <= _STRONGEST)).all():
        raise WlmError(
            f"{document.path}: materials[{number}]: expected an emission of three numbers from 0 to {_STRONGEST:g}"
        )
    if factor.shape != (3,) or np.isnan(factor).any():
        raise WlmError(f"{document.path}: materials[{number}]: expected a base colour of three numbers, none NaN")
    texture, uv_set, placed = None, None, np.eye(2, 3)
    if "baseColorTexture" in surface:
        used = surface["baseColorTexture"]
        pixels = np.asarray(texture_picture(document, used["index"]), np.float32) / np.float32(255.0)
        texture = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4).astype(np.float32)
        uv_set, placed = texture_transform(f"{document.path}: materials[{number}]", used)
    return Material(
        str(content.get("name", "")),
        tuple(map(float, factor)),
        texture,
        uv_set or 0,
        placed,
        tuple(map(float, emission)),
        bool(content.get("doubleSided", False)),
    )
