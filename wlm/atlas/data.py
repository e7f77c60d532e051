"""Input: a mesh with lightmap UVs and its lightmap, read from files or arrays and checked; writing it with new UVs.

The stated behaviours. "Inside" means inside the mask. Each kind of repair or oddity is one line of
`LightmappedMesh.warnings`, with its count.

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
no triangle, no UVs                   error
several meshes that lie on each       the one that the lightmap fits best (`belonging`), the others left out; warning.
other in UV space                     Error where none fits clearly better: `node` says which
a lightmap that fits its charts       warning: `flip` turns it
better upside down
six times as long as wide             warning: such are a cube's faces, of a reflection probe
a primitive without the UV set        left out, and unchanged in what is written; warning
a position or UV NaN or infinite,     error that names the primitive and the vertex
a position beyond float32
a UV outside [0, 1]                   clamped to it, as a lightmap is read clamped; warning
triangles without area, in space or   kept, but not `active`: they take no part; warning
in UV
no triangle with area                 error
UVs of less than a texel in all       warning
overlapping UVs, a mesh drawn twice   fine: what shares texels is lit alike; warning
NaN, Inf inside                       the texel takes the value of the nearest finite one inside; warning
a speck inside, less than 3 texels    the same
wide, above 16 times the light's
99.5th percentile
NaN, Inf or above 4 times the light   the same, without a warning
beside it, in a texel that a triangle
touches, its centre outside
no finite texel inside                error
negative inside                       the channel is clamped to 0; warning
above 65,504 inside (half's maximum)  the channel is clamped to 65,504; warning
any of these outside                  0, 0 and 65,504, without a warning
a mask of another size                error that names both files
an empty mask                         error
a mask that misses over 1% of the     warning: it may be of another UV set
texels whose centres are in triangles
no mask                               derived: texels whose centre is in a triangle, and those that a
                                      triangle touches at all unless they are 0, as texels never baked are
====================================  ================================================================

The method's inputs: lightmap-uv-clustering-cascade, section 3 (mesh, UVs and an HDR lightmap).
"""

import hashlib
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from wlm.atlas.belonging import chart_map, choose_mesh, fits_flipped, named, replace_strays
from wlm.atlas.coverage import covered_texels, touched_texels
from wlm.errors import WlmError
from wlm.formats.channels import read_encoded
from wlm.formats.gltf import GltfDocument, GltfPrimitive, document_from_arrays, read_gltf
from wlm.formats.gltf_writer import Replacement, write_glb
from wlm.formats.light import read_light
from wlm.formats.mask import read_mask
from wlm.formats.obj import read_obj
from wlm.ops.indoors import Indoors, indoors
from wlm.texels import fill_gaps, repair

_FLAT = 1e-12  # ratio of area to longest side squared below which float64 can't tell a triangle from one without area
_FACES = 6  # of a cube
_MISSED = 0.01  # fraction of covered texels that a mask may miss without a warning


@dataclass(frozen=True, eq=False)
class Part:
    """Where one primitive's vertices and triangles begin in the mesh; they keep their order.

    Attributes:
        primitive: The primitive.
        vertex: Number of its first vertex in the mesh.
        triangle: Number of its first triangle in the mesh.
    """

    primitive: GltfPrimitive
    vertex: int
    triangle: int


@dataclass(frozen=True, eq=False)
class LightmappedMesh:
    """A mesh and its lightmap, checked and repaired as the module's table says.

    Attributes:
        name: The mesh's name.
        position: float64 [V, 3], in the scene's space and unit, finite.
        triangle: int32 [F, 3], at least one; each vertex is of one primitive.
        uv: float64 [V, 2] in [0, 1]; u right, v down from the lightmap's top row.
        active: bool [F], false where a triangle has no area; at least one is true.
        lightmap: float32 [H, W, 3], linear, finite, in [0, 65504].
        mask: bool [H, W], true where a texel belongs to a chart; at least one is.
        uv_set: n of the `TEXCOORD_n` that was read; 0 where the input is no glTF.
        source: 16 hexadecimal digits of BLAKE2b over the mesh, the lightmap and the mask.
        warnings: Repairs and oddities, one line each.
        document: The file that the mesh came from, or one made for it.
        parts: The primitives that make up the mesh, in order.
        metres: Whether the unit is known to be the metre, as it is in glTF.
    """

    name: str
    position: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray
    active: np.ndarray
    lightmap: np.ndarray
    mask: np.ndarray
    uv_set: int
    source: str
    warnings: tuple[str, ...]
    document: GltfDocument
    parts: tuple[Part, ...]
    metres: bool

    @cached_property
    def filled(self) -> np.ndarray:
        """The lightmap with charts dilated into the gaps between them, float32 [H, W, 3]; not to be written to."""
        return fill_gaps(self.lightmap, self.mask)

    @cached_property
    def indoors(self) -> Indoors:
        """Where viewers can stand in it, see `wlm.ops.indoors`."""
        return indoors(self.position, self.triangle, metres=self.metres)


def load(
    mesh_path: str | os.PathLike[str],
    lightmap_path: str | os.PathLike[str],
    *,
    mask_path: str | os.PathLike[str] | None = None,
    uv_set: int | None = None,
    node: str | None = None,
    encoding: str | None = None,
    flip: bool = False,
    trust: bool = False,
) -> LightmappedMesh:
    """Reads a mesh (`.glb`, `.gltf`, `.obj`) and its lightmap (EXR, Radiance, KTX2, DDS: see `wlm.formats.light`; PNG).

    Args:
        mesh_path: The mesh. All primitives that its scene draws and that have the UV set make one mesh, but where
            they lie on each other in UV space, see the module's table.
        lightmap_path: Linear RGB; row 0 is v = 0 of glTF, v = 1 of an `.obj`.
        mask_path: A PNG of the lightmap's size; a texel belongs to a chart where any colour channel is above 0. None
            derives it from the triangles.
        uv_set: n of `TEXCOORD_n`, the lightmap's UVs. None takes 1, where engines and viewers look for them, if any
            primitive has it, else 0. An `.obj` has only 0.
        node: The node that the lightmap belongs to, by its name, its mesh's name or its number; None: see above.
        encoding: What the bytes of a PNG stand for, one of `wlm.formats.channels.ENCODINGS`; None: it is no PNG.
        flip: Whether the lightmap is upside down, its top row v = 1 of glTF.
        trust: Whether a glTF file may name files outside its folder, and draw more than its bytes account for
            (`wlm.formats.limits`).

    Returns:
        The mesh, repaired as the module's table says.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table, and where a file
            is missing or damaged.
    """
    path = Path(mesh_path)
    suffix = path.suffix.lower()
    if suffix not in (".glb", ".gltf", ".obj"):
        raise WlmError(f"{path}: expected a name that ends in .glb, .gltf or .obj, found {suffix or 'none'}")
    if suffix == ".obj":
        arrays = read_obj(path)
        if not len(arrays.triangle):
            raise WlmError(f"{path}: has no triangles")
        if arrays.uv is None:
            raise WlmError(f"{path}: the mesh has no UVs: expected vt, and f with them")
        document, primitive = _document(str(path), path.stem, arrays.position, arrays.triangle, arrays.uv)
        primitives = [primitive]
    else:
        document, primitives = read_gltf(path, trust)
    if node is not None:
        primitives = named(str(path), primitives, node)
    lightmap = read_light(lightmap_path)[0] if encoding is None else read_encoded(lightmap_path, encoding)
    lightmap = np.array(lightmap[:: -1 if flip else 1, :, :3], np.float32, order="C")
    mask = None if mask_path is None else read_mask(Path(mask_path), lightmap_path, lightmap.shape[:2])
    return checked_mesh(
        str(path),
        path.stem,
        document,
        primitives,
        uv_set,
        lightmap,
        mask,
        str(lightmap_path),
        str(mask_path),
        metres=suffix != ".obj",
    )


def from_arrays(
    position: np.ndarray,
    triangle: np.ndarray,
    uv: np.ndarray,
    lightmap: np.ndarray,
    mask: np.ndarray | None = None,
    name: str = "array",
) -> LightmappedMesh:
    """Makes a checked mesh of arrays, under the same rules as `load`.

    Args:
        position: [V, 3] of numbers, in any unit; rounded to float32, as files hold it.
        triangle: [F, 3] of integers, 0 to V - 1.
        uv: [V, 2] of numbers; u right, v down from the lightmap's top row; rounded to float32.
        lightmap: [H, W, 3] of numbers, linear RGB; copied.
        mask: [H, W], true where a texel belongs to a chart. None derives it from the triangles.
        name: The mesh's name, used in messages too.

    Returns:
        The mesh, repaired as the module's table says. Vertices that no triangle uses are left out.

    Raises:
        WlmError: A shape is wrong, or an error of the module's table.
    """
    lightmap = np.asarray(lightmap)
    if lightmap.ndim != 3 or lightmap.shape[2] != 3 or 0 in lightmap.shape:
        raise WlmError(f"{name}: expected a lightmap [H, W, 3], none of them 0, got {lightmap.shape}")
    valid = None if mask is None else np.array(mask).astype(bool)
    if valid is not None and valid.shape != lightmap.shape[:2]:
        raise WlmError(f"{name}: expected a mask of {lightmap.shape[:2]}, got {valid.shape}")
    document, primitive = _document(name, name, np.asarray(position), np.asarray(triangle), np.asarray(uv))
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes Inf and is repaired as Inf
        copied = np.array(lightmap, np.float32, order="C")
    return checked_mesh(name, name, document, [primitive], 0, copied, valid, f"{name}: lightmap", f"{name}: mask")


def write_mesh(
    path: str | os.PathLike[str], mesh: LightmappedMesh, corner_uv: np.ndarray, uv_set: int | None = None
) -> int:
    """Writes the mesh's file again, with one more UV set and all else as it was, whole or not at all.

    Corners of one vertex that have the same new UV stay one vertex; the others become vertices of their own with the
    same attributes.

    Args:
        path: The `.glb` to write; its folder must exist.
        mesh: The mesh.
        corner_uv: [F, 3, 2], the new UV of each triangle's corners; u right, v down; stored as float32.
        uv_set: n of the new `TEXCOORD_n`; None takes the one after the last that a primitive of the mesh has.

    Returns:
        n of the new set.

    Raises:
        ValueError: The shape is wrong, a UV isn't finite, or a primitive has that set already.
        WlmError: The file can't be written.
    """
    corner_uv = np.asarray(corner_uv, np.float32)
    if corner_uv.shape != (len(mesh.triangle), 3, 2) or not np.isfinite(corner_uv).all():
        raise ValueError(f"corner_uv: expected finite numbers [{len(mesh.triangle)}, 3, 2], got {corner_uv.shape}")
    if uv_set is None:
        uv_set = 1 + max(number for part in mesh.parts for number in part.primitive.uv)
    replacements = []
    for part in mesh.parts:
        vertex = part.primitive.triangle.reshape(-1)
        uv = corner_uv[part.triangle : part.triangle + len(part.primitive.triangle)].reshape(-1, 2) + np.float32(0.0)
        # Compared by their bits; adding 0 above made -0 into 0.
        key = np.stack([vertex.astype(np.uint32), *uv.view(np.uint32).T], axis=1)
        distinct, corner = np.unique(key, axis=0, return_inverse=True)
        new_uv = np.ascontiguousarray(distinct[:, 1:]).view(np.float32)
        replacements.append(Replacement(part.primitive, distinct[:, 0].astype(np.int64), corner.reshape(-1, 3), new_uv))
    write_glb(path, mesh.document, replacements, uv_set)
    return uv_set


def _document(
    where: str, name: str, position: np.ndarray, triangle: np.ndarray, uv: np.ndarray
) -> tuple[GltfDocument, GltfPrimitive]:
    """Checks arrays' shapes and ranges, and makes a document of the vertices that triangles use."""
    for field, array, kinds in (("position", position, "iuf"), ("triangle", triangle, "iu"), ("uv", uv, "iuf")):
        width = 2 if field == "uv" else 3
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in kinds:
            raise WlmError(f"{where}: {field}: expected numbers [N, {width}], got {array.dtype} {array.shape}")
    if len(uv) != len(position):
        raise WlmError(f"{where}: uv: expected {len(position)} rows, one per position, got {len(uv)}")
    if not len(triangle):
        raise WlmError(f"{where}: has no triangles")
    if triangle.min() < 0 or triangle.max() >= len(position):
        raise WlmError(
            f"{where}: triangle: expected vertices 0 to {len(position) - 1}, found {triangle.min()} to {triangle.max()}"
        )
    used, corner = np.unique(triangle, return_inverse=True)
    with np.errstate(over="ignore"):  # `_check_finite` reports it as infinite
        return document_from_arrays(position[used], corner.reshape(-1, 3), uv[used], name)


def checked_mesh(
    where: str,
    name: str,
    document: GltfDocument,
    primitives: list[GltfPrimitive],
    uv_set: int | None,
    lightmap: np.ndarray,  # [H, W, 3], repaired in place
    mask: np.ndarray | None,  # [H, W]
    lightmap_name: str,
    mask_name: str,
    metres: bool = False,
    choose: bool = True,
) -> LightmappedMesh:
    """Applies the module's table to the content of the files.

    Args:
        where, name: The file and the mesh, for messages.
        document, primitives: As read.
        uv_set: As for `load`.
        lightmap: float32 [H, W, 3], repaired in place.
        mask: bool [H, W]; None: derived.
        lightmap_name, mask_name: For messages.
        metres: As in `LightmappedMesh`.
        choose: Whether of meshes that lie on each other in UV space one is chosen.
    """
    warnings: list[str] = []
    primitives, uv_set = _select(where, primitives, uv_set, warnings)
    if choose:
        primitives, left_out = choose_mesh(where, name, primitives, uv_set, lightmap)
        warnings += left_out
    parts, vertices, triangles = [], 0, 0
    for primitive in primitives:
        _check_finite(where, primitive, uv_set)
        parts.append(Part(primitive, vertices, triangles))
        vertices, triangles = vertices + len(primitive.position), triangles + len(primitive.triangle)
    position = np.concatenate([part.primitive.position for part in parts])
    triangle = np.concatenate([part.primitive.triangle + part.vertex for part in parts], dtype=np.int32)
    uv = np.concatenate([part.primitive.uv[uv_set] for part in parts]).astype(np.float64)

    beyond = np.maximum(-uv, uv - 1.0).max(axis=1)
    outside = np.count_nonzero(beyond > 0)
    if outside:
        warnings.append(
            f"{name}: {_count(outside, 'vertex', 'vertices')} with UVs outside [0, 1], by up to {beyond.max():.3g}: "
            "clamped"
        )
        uv = uv.clip(0.0, 1.0)
    active = _has_area(position, triangle) & _has_area(uv, triangle)
    flat = len(active) - np.count_nonzero(active)
    if flat == len(active):
        raise WlmError(f"{where}: no triangle has an area in space and in TEXCOORD_{uv_set}")
    if flat:
        warnings.append(f"{name}: {_count(flat, 'triangle')} without area in space or in UV: left out")

    height, width = lightmap.shape[:2]
    if max(height, width) == _FACES * min(height, width):
        warnings.append(f"{lightmap_name}: {width} x {height}, as a cube's six faces: is it a reflection probe?")
    texels = _uv_area(uv, triangle[active]) * height * width
    if texels < 1.0:
        warnings.append(
            f"{name}: all triangles together have {texels:.2g} texels of {width} x {height} in TEXCOORD_{uv_set}: are "
            "its UVs in [0, 1]?"
        )
    coverage = covered_texels(uv, triangle[active], height, width)
    overlaps = np.count_nonzero(coverage > 1)
    if overlaps:
        warnings.append(f"{name}: {_count(overlaps, 'texel')} in several triangles: their UVs overlap")
    if mask is None:
        touched = touched_texels(uv, triangle[active], height, width)
        # A baker that samples texel centres leaves the fringe of a chart at 0: a gap to fill, not darkness.
        mask = touched & ((coverage > 0) | (lightmap != 0).any(axis=2))
        if not mask.any():
            mask = touched
    else:
        if not mask.any():
            raise WlmError(f"{mask_name}: the mask is empty: no texel belongs to a chart")
        missed, covered = np.count_nonzero((coverage > 0) & ~mask), np.count_nonzero(coverage)
        if missed > _MISSED * covered:
            warnings.append(
                f"{name}: {_count(missed, 'texel')} of {covered} that triangles cover are outside the mask: "
                f"is it of another UV set than TEXCOORD_{uv_set}, or upside down?"
            )
    if fits_flipped(lightmap, chart_map(position, uv, triangle[active], height, width)):
        warnings.append(f"{lightmap_name}: fits the mesh's charts better upside down: see flip (--flip)")
    specks = replace_strays(lightmap, mask, coverage > 0)
    if specks:
        warnings.append(f"{lightmap_name}: {_count(specks, 'texel')} in specks far above all other light: replaced")
    warnings += [f"{lightmap_name}: {text}" for text in repair(lightmap, mask, lightmap_name)]
    source = _hash(position, triangle, uv, lightmap, mask)
    return LightmappedMesh(
        name,
        position,
        triangle,
        uv,
        active,
        lightmap,
        mask,
        uv_set,
        source,
        tuple(warnings),
        document,
        tuple(parts),
        metres,
    )


def _select(
    where: str, primitives: list[GltfPrimitive], uv_set: int | None, warnings: list[str]
) -> tuple[list[GltfPrimitive], int]:
    """Selects the UV set and the primitives that have it."""
    if not primitives:
        raise WlmError(f"{where}: has no triangles")
    sets = sorted({number for each in primitives for number in each.uv})
    if not sets:
        raise WlmError(f"{where}: the mesh has no UVs: expected TEXCOORD_0 or TEXCOORD_1")
    if uv_set is None:
        uv_set = 1 if 1 in sets else 0
    selected = [each for each in primitives if uv_set in each.uv]
    if not selected:
        names = ", ".join(f"TEXCOORD_{number}" for number in sets)
        raise WlmError(f"{where}: expected the UV set TEXCOORD_{uv_set}, found {names}")
    skipped = [each for each in primitives if uv_set not in each.uv]
    if skipped:
        warnings.append(
            f"{where}: {_count(len(skipped), 'primitive')} of {len(primitives)} without TEXCOORD_{uv_set}, first "
            f"{skipped[0].name}: left out"
        )
    return selected, uv_set


def _check_finite(where: str, primitive: GltfPrimitive, uv_set: int) -> None:
    limit = float(np.finfo(np.float32).max)
    for field, values in (("POSITION", primitive.position), (f"TEXCOORD_{uv_set}", primitive.uv[uv_set])):
        bad = np.flatnonzero(~(np.abs(values) <= limit).all(axis=1))
        if len(bad):
            text = ", ".join(f"{x:g}" for x in values[bad[0]])
            raise WlmError(
                f"{where}: {primitive.name}: {field} of vertex {primitive.row[bad[0]]}: expected finite numbers, "
                f"got ({text})"
            )


def _has_area(point: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Whether each triangle of points [V, 2 or 3] has an area, whatever its size: bool [F]."""
    a, b, c = (point[triangle[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    longest = np.sqrt(np.maximum.reduce([(edge * edge).sum(axis=1) for edge in (ab, ac, c - b)]))
    # Scaled to a longest side of 1, so that neither tiny nor huge triangles leave float64's range.
    scale = np.divide(1.0, longest, out=np.zeros_like(longest), where=longest > 0)[:, None]
    ab, ac = ab * scale, ac * scale
    if point.shape[1] == 2:
        twice_area = np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    else:
        twice_area = np.linalg.norm(np.cross(ab, ac), axis=1)
    return twice_area > 2 * _FLAT


def _uv_area(uv: np.ndarray, triangle: np.ndarray) -> float:
    """Sum of the triangles' areas in UV."""
    ab, ac = uv[triangle[:, 1]] - uv[triangle[:, 0]], uv[triangle[:, 2]] - uv[triangle[:, 0]]
    return 0.5 * float(np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).sum())


def _count(number: int, singular: str, plural: str | None = None) -> str:
    return f"{number} {singular if number == 1 else plural or singular + 's'}"


def _hash(*arrays: np.ndarray) -> str:
    """Hashes the input to 16 hexadecimal digits, the same on every machine."""
    digest = hashlib.blake2b(digest_size=8)
    for array in arrays:
        digest.update(np.asarray(array.shape, "<i8").tobytes())
        digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")))
    return digest.hexdigest()
