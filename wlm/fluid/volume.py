"""Density volumes of smoke: checked input from arrays, `.npz`, NanoVDB (`.nvdb`) or OpenVDB (`.vdb`); output as the
same.

Repairs are listed in `DensityVolume.warnings`, one line for each kind; `docs/fluid.md` lists them and the errors.

A grid's density has no unit: the extinction per length is `extinction` times the density.
"""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
import warp as wp
from torch.nn.functional import pad

from wlm.errors import WlmError
from wlm.fluid.black_body import GLOWING, black_body_luminance
from wlm.fluid.grids import UPS, Grid, choose, is_level_set, on_one_lattice
from wlm.formats.atomic import atomic_path, atomic_write
from wlm.formats.exr import HALF_MAX
from wlm.formats.limits import RESAMPLED, SURE_BOX, SURE_VOXELS, VOLUME_BYTES, VOXELS, check_growth
from wlm.formats.nanovdb import NanoVdbFile
from wlm.formats.nanovdb_writing import encode_nvdb
from wlm.formats.npz import read_npz
from wlm.formats.reading import FileBytes, open_file, read_file
from wlm.formats.vdb import LARGEST, GridHead, VdbFile
from wlm.formats.vdb_writing import encode_vdb
from wlm.interop import check_device, to_warp

if TYPE_CHECKING:
    from wlm_kernels.smoke.march import Solid

EDGE = 8
"""Voxels along an edge of a brick."""


def gather(fields: Sequence[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Extracts the bricks of 8^3 voxels in which any of several fields [X, Y, Z] of one shape is not 0.

    Returns the bricks' indices, int32 [N], increasing, with x the slowest axis; and each field's values in them, [N, 8,
    8, 8], 0 in the parts of bricks outside the field.
    """
    margins = [part for n in reversed(fields[0].shape) for part in (0, -n % EDGE)]
    cut = []
    for field in fields:
        padded = pad(field, margins) if any(margins) else field
        x, y, z = (n // EDGE for n in padded.shape)
        cut.append(padded.reshape(x, EDGE, y, EDGE, z, EDGE))
    some = torch.stack([(part != 0).any(5).any(3).any(1) for part in cut]).any(0)
    return torch.nonzero(some.flatten())[:, 0].int(), [part.permute(0, 2, 4, 1, 3, 5)[some] for part in cut]


def scatter(numbers: torch.Tensor, bricks: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
    """Inverse of `gather`: returns a field of the given shape, 0 outside the bricks with the indices `numbers`."""
    counts = [-(-n // EDGE) for n in shape]
    whole = torch.zeros([n * EDGE for n in counts], dtype=bricks.dtype, device=bricks.device)
    x, y, z = torch.unravel_index(numbers.long(), counts)
    whole.view(counts[0], EDGE, counts[1], EDGE, counts[2], EDGE)[x, :, y, :, z, :] = bricks
    return whole[tuple(slice(n) for n in shape)].contiguous()


_DENSITY, _TEMPERATURE, _BRICKS = "density", "temperature", "bricks"
_TINY, _HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)

_THIN, _THICK = 0.1, 1000.0  # optical thickness of smoke that hides 10% of the light, and that looks solid
_KELVIN = 250.0  # temperatures above it are kelvins; those of smoke simulations are about 1

SUFFIXES = (".npz", ".nvdb", ".vdb")
"""Suffixes of the files that `load_volume` reads and `save_volume` writes."""


@dataclass(frozen=True, eq=False)
class DensityVolume:
    """Smoke in a box of cubic voxels.

    The constructor does not check the values, so that frames of a solver need no copy; `from_array` checks them.

    Attributes:
        density: float32 or float16 tensor [X, Y, Z], finite, not negative.
        extinction: Extinction per unit of length at density 1; above 0.
        voxel: Edge of a voxel, in the world's unit.
        origin: float64 [3], corner of voxel (0, 0, 0) in the world; its centre is half a voxel further.
        temperature: Tensor like the density; None: no emission.
        emission: Light emitted per unit of length at temperature 1.
        kelvin: Whether the file has kelvins; the temperature is then the light of black bodies, 1 at 1,500 kelvin.
        warnings: The values that were repaired, one line for each kind.
        places: int32 tensor [X / 8, Y / 8, Z / 8], rounded up, numbers of bricks of 8^3 voxels: density and temperature
            are then [N, 8, 8, 8], with 0 in brick 0. None: all voxels are stored.
        cells: X, Y and Z of a volume with `places`.
        near: uint8 tensor like `places`, 1 where a brick, or a voxel next to it, has smoke, else 0. None: each march
            finds these bricks, see `wlm.smoke.march.launch.in_bricks`.
        solid: Obstacles for marches that light the smoke, see `wlm.view.smoke.Drawing.among`.
    """

    density: torch.Tensor
    extinction: float = 1.0
    voxel: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature: torch.Tensor | None = None
    emission: float = 1.0
    kelvin: bool = False
    warnings: tuple[str, ...] = ()
    places: torch.Tensor | None = None
    cells: tuple[int, int, int] | None = None
    near: torch.Tensor | None = None
    solid: "Solid | None" = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        return self.cells or tuple(self.density.shape)

    @property
    def device(self) -> torch.device:
        """Device of the voxels."""
        return self.density.device

    @property
    def size(self) -> np.ndarray:
        """Edges of the box in the world, float64 [3]."""
        return self.voxel * np.asarray(self.shape, np.float64)

    @property
    def centre(self) -> np.ndarray:
        """Centre of the box in the world, float64 [3]."""
        return np.asarray(self.origin) + 0.5 * self.size

    @property
    def thickness(self) -> float:
        """Largest optical thickness along an axis: the extinction times the density, integrated through the box."""
        slabs = [[slab.sum(axis, dtype=torch.float32) for axis in range(3)] for slab in self.slabs(self.density)]
        along = [sum(sums[0] for sums in slabs), *(torch.cat(sums) for sums in list(zip(*slabs, strict=True))[1:])]
        return self.extinction * self.voxel * max(float(sums.max()) for sums in along)

    def slabs(self, field: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yields the density or the temperature as tensors [x, Y, Z] whose x add up to X: one, or with bricks of 8."""
        if self.places is None:
            yield field
            return
        for x, places in enumerate(self.places):
            slab = field[places.long()].permute(2, 0, 3, 1, 4).reshape(EDGE, *(EDGE * n for n in places.shape))
            yield slab[: self.shape[0] - EDGE * x, : self.shape[1], : self.shape[2]]

    def arrays(self) -> tuple[wp.array, wp.array | None]:
        """Returns density and temperature as contiguous Warp arrays of three axes, which share the tensors' memory if
        these are contiguous."""
        hot = None if self.temperature is None else to_warp(self.temperature.flatten(0, -3).contiguous())
        return to_warp(self.density.flatten(0, -3).contiguous()), hot


def from_array(
    density: np.ndarray | torch.Tensor,
    *,
    extinction: float = 1.0,
    voxel: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    temperature: np.ndarray | torch.Tensor | None = None,
    emission: float = 1.0,
    device: str = "cpu",
    name: str = "array",
) -> DensityVolume:
    """Makes a validated volume from arrays.

    Args:
        density, temperature: Numbers [X, Y, Z], copied only if they must be changed or moved; temperature None: the
            smoke emits no light.
        extinction, voxel, origin, emission: The attributes of `DensityVolume`.
        device: "cpu" or "cuda:N".
        name: Name of the volume in messages.

    Returns:
        The volume; NaN, infinite and negative values are replaced by 0, see `docs/fluid.md`.

    Raises:
        WlmError: The input has one of the errors that `docs/fluid.md` lists.
    """
    device = check_device(device)
    # Kernels compute in float32.
    if not _TINY <= voxel <= _HUGE:
        raise WlmError(f"{name}: voxel: expected a length above 0 that float32 holds, found {voxel}")
    if not _TINY <= extinction <= _HUGE:
        raise WlmError(f"{name}: extinction: expected a number above 0 that float32 holds, found {extinction}")
    if not 0 <= emission <= _HUGE:
        raise WlmError(f"{name}: emission: expected a number of at least 0 that float32 holds, found {emission}")
    if np.shape(origin) != (3,) or not (np.abs(origin) <= _HUGE).all():
        raise WlmError(f"{name}: origin: expected three numbers that float32 holds, found {origin}")
    warnings: list[str] = []
    smoke = _check(name, _DENSITY, density, device, warnings)
    heat = None
    if temperature is not None:
        # Kernels take both in one type.
        heat = _check(name, _TEMPERATURE, temperature, device, warnings, smoke.dtype)
        if heat.shape != smoke.shape:
            raise WlmError(f"{name}: {_TEMPERATURE}: expected shape {tuple(smoke.shape)}, found {tuple(heat.shape)}")
        heat = _dimmed(name, heat, emission, voxel, warnings)
    corner = tuple(float(o) for o in origin)
    factors = {"extinction": float(extinction), "voxel": float(voxel), "emission": float(emission)}
    return DensityVolume(smoke, **factors, origin=corner, temperature=heat, warnings=tuple(warnings))


def load_volume(
    path: str | os.PathLike[str],
    *,
    extinction: float = 1.0,
    emission: float = 1.0,
    voxel: float | None = None,
    device: str = "cpu",
    trust: bool = False,
    up: str | None = None,
    density: str | None = None,
    temperature: str | None = None,
    kelvin: bool | None = None,
) -> DensityVolume:
    """Reads a volume from a file.

    - `.npz`: an array `density` [X, Y, Z], and optionally `temperature` of the same shape and the numbers
      `voxel` and `origin` [3]; or their bricks, as `save_volume` writes them.
    - `.nvdb` and `.vdb`: grids of floats, over the box of their active voxels. Their maps to the world give the size
      and the position of the voxels; voxels that are not cubes along the axes are resampled (`wlm.fluid.grids`).

    Args:
        path: The file; its suffix determines the format.
        extinction: Extinction per unit of length at density 1.
        emission: Light emitted per unit of length at temperature 1.
        voxel: Edge of a voxel, in the world's unit; None: the size in the file, or 1.
        device: "cpu" or "cuda:N".
        trust: Whether to accept more voxels than is likely for the size of the file (`wlm.formats.limits`).
        up: "x", "y" or "z", the axis of the file's world that becomes +y. None: y, with a warning if a `.nvdb` or
            `.vdb` is longest along z, which is up in Blender and Unreal.
        density: Name of the array or grid; None: `density`, or in a VDB file as `wlm.fluid.grids.choose` does.
        temperature: Name of the array or grid of temperatures; None: `temperature`, if it exists.
        kelvin: Whether temperatures are kelvins, whose light is that of black bodies: `emission` per length at 1,500
            kelvin. None: yes, with a warning, if one is above 250.

    Returns:
        The volume; NaN, infinite and negative values are replaced by 0, see `docs/fluid.md`.

    Raises:
        WlmError: The input has one of the errors that `docs/fluid.md` lists; the message names the file and the field.
    """
    path, suffix = Path(path), _suffix(path)
    told, up = up is not None, up or "y"
    if up not in UPS:
        raise ValueError(f"up: expected one of {', '.join(UPS)}, got {up!r}")
    names, device = (density, temperature), check_device(device)
    factors = {"extinction": extinction, "emission": emission, "name": str(path)}
    if suffix == ".npz":
        arrays, hot, hints = _in_kelvin(path, _read_npz(path, names, device, trust), emission, kelvin)
        volume = from_array(**arrays, **factors, device=device)
        volume = _turned(volume, up) if up != "y" else volume
    else:
        grids, warnings = _read_grids(path, names, trust)
        most = LARGEST if trust else min(VOXELS, max(SURE_BOX, RESAMPLED * sum(g.values.numel() for g in grids)))
        lattice, (smoke, *heat) = on_one_lattice(grids, most, up)
        arrays = {"density": smoke, "temperature": heat[0] if heat else None}
        arrays, hot, hints = _in_kelvin(path, arrays, emission, kelvin)
        volume = from_array(**arrays, voxel=lattice.voxel, origin=lattice.origin, device=device, **factors)
        volume = replace(volume, warnings=(*warnings, *volume.warnings))
        if not told and is_long_along_z(volume):
            warning = f"{path}: longest along z: if that is up, as in Blender and Unreal, say so (--volume up=z)"
            volume = replace(volume, warnings=(*volume.warnings, warning))
    volume = replace(volume, kelvin=hot, warnings=(*volume.warnings, *hints))
    if voxel is None:
        return volume
    if not _TINY <= voxel <= _HUGE:
        raise WlmError(f"{path}: voxel: expected a length above 0 that float32 holds, found {voxel}")
    return replace(volume, voxel=voxel, origin=tuple(voxel / volume.voxel * o for o in volume.origin))


def _in_kelvin(
    path: Path, arrays: dict[str, Any], emission: float, kelvin: bool | None
) -> tuple[dict[str, Any], bool, list[str]]:
    """Replaces the temperature of a file by the light of black bodies if it is in kelvin; returns whether it is, and a
    warning if this is an assumption."""
    heat = arrays.get(_TEMPERATURE)
    values = np.asarray(heat.cpu() if isinstance(heat, torch.Tensor) else heat)
    if kelvin is False or values.dtype.kind not in "iuf" or values.ndim != 3:
        return arrays, False, []
    hottest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    if not (kelvin or hottest > _KELVIN):
        return arrays, False, []
    light, unit = np.empty(values.shape, np.float32), black_body_luminance(np.array(GLOWING))
    for out, plane in zip(light, values, strict=True):
        out[...] = np.where(np.isfinite(plane), black_body_luminance(plane) / unit, plane)
    if kelvin:
        return arrays | {_TEMPERATURE: light}, True, []
    most = float(black_body_luminance(hottest) / unit)
    warning = (
        f"{path}: temperatures up to {hottest:,.0f} are read as kelvins: the hottest voxel emits {emission * most:.2g} "
        f"per length; --volume emission={1 / most:.2g} makes it 1, kelvin=no takes temperatures for light"
    )
    return arrays | {_TEMPERATURE: light}, True, [warning]


def _suffix(path: str | os.PathLike[str]) -> str:
    """Returns the suffix of a volume's file in lower case, which must be one of `SUFFIXES`."""
    if (suffix := Path(path).suffix.lower()) not in SUFFIXES:
        raise WlmError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}, found {suffix or 'none'}")
    return suffix


def thickness_hint(thickness: float, extinction: float) -> str | None:
    """Returns a line for smoke so thin that it can hardly be seen, or so thick that it looks solid; None otherwise.

    `thickness` is `DensityVolume.thickness`, of several frames the largest, at an `extinction` per length at density 1.
    """
    if not 0 < thickness < _THIN and not thickness > _THICK:
        return None
    looks, good = ("can hardly be seen", 3.0) if thickness < _THIN else ("looks like a solid", 10.0)
    found, better = (f"{float(f'{value:.2g}'):g}" for value in (thickness, extinction * good / thickness))
    return (
        f"the smoke has an optical thickness of at most {found} and {looks}: --volume extinction={better} makes it "
        f"{good:.0f}"
    )


def is_long_along_z(volume: DensityVolume) -> bool:
    """Returns whether a volume is longest along z, which suggests that its smoke rises along z."""
    x, y, z = volume.shape
    return z > max(x, y)


def _turned(volume: DensityVolume, up: str) -> DensityVolume:
    matrix = np.diag([volume.voxel] * 3 + [1.0])
    matrix[:3, 3] = np.asarray(volume.origin) + 0.5 * volume.voxel
    parts = [Grid(_DENSITY, volume.density, matrix)]
    if volume.temperature is not None:
        parts.append(Grid(_TEMPERATURE, volume.temperature, matrix))
    lattice, (smoke, *heat) = on_one_lattice(parts, LARGEST, up)
    return replace(volume, density=smoke, temperature=heat[0] if heat else None, origin=lattice.origin)


def save_volume(
    path: str | os.PathLike[str],
    volume: DensityVolume,
    *,
    bricks: bool = False,
    velocity: np.ndarray | None = None,
    codec: Literal["zip", "none"] = "zip",
) -> None:
    """Writes a volume as `.npz`, `.vdb` or `.nvdb`, whole or not at all; `load_volume` reads it back.

    With `bricks` an `.npz` is not compressed, but empty bricks of 8^3 voxels are omitted: writing is much faster, but
    the file is larger and other programs cannot read it. A `.vdb`, for Blender and Houdini, and a `.nvdb`, for
    renderers on GPUs, have grids named `density`, `temperature` if there is one, and `velocity` if it is given, [X, Y,
    Z, 3] in the volume's box, also in larger voxels. A `.nvdb` is compressed by zlib unless `codec` is "none".

    Raises:
        WlmError: The suffix is wrong, the volume has the light of a file in kelvin, or the file cannot be written.
    """
    suffix = _suffix(path)
    if volume.kelvin:
        raise WlmError(f"{path}: temperature: expected kelvins, found their light: load the volume with kelvin=False")
    parts = zip((_DENSITY, _TEMPERATURE), (volume.density, volume.temperature), strict=True)
    fields = {name: torch.cat(list(volume.slabs(part))) for name, part in parts if part is not None}
    if suffix != ".npz":
        grids = {name: values.cpu().numpy() for name, values in fields.items()}
        grids |= {} if velocity is None else {"velocity": velocity}
        placed = []
        for name, values in grids.items():
            edge = volume.size[0] / len(values)
            matrix = np.diag([edge, edge, edge, 1.0])
            matrix[:3, 3] = np.asarray(volume.origin) + 0.5 * edge
            placed.append((name, values, matrix))
        atomic_write(path, encode_vdb(placed) if suffix == ".vdb" else encode_nvdb(placed, codec))
        return
    if bricks:
        save_bricks(path, *gather(list(fields.values())), volume.shape, volume.voxel, volume.origin)
        return
    arrays = {name: values.cpu().numpy() for name, values in fields.items()}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, voxel=np.float64(volume.voxel), origin=np.asarray(volume.origin, np.float64), **arrays
        )


def save_bricks(
    path: str | os.PathLike[str],
    numbers: torch.Tensor,
    values: Sequence[torch.Tensor],
    shape: Sequence[int],
    voxel: float,
    origin: Sequence[float],
) -> None:
    """Writes smoke in bricks as the `.npz` file of `save_volume` with `bricks`, whole or not at all.

    `numbers` and `values` are the indices of the bricks, and the density and perhaps the temperature in them, as of
    `gather`; `shape` has the voxels along x, y and z. Raises a WlmError if the file cannot be written.
    """
    parts = zip((_DENSITY, _TEMPERATURE), values, strict=False)
    arrays = {f"{name}_bricks": part.cpu().numpy() for name, part in parts} | {_BRICKS: numbers.cpu().numpy()}
    place = {"shape": np.asarray(shape, np.int64), "voxel": np.float64(voxel), "origin": np.asarray(origin, np.float64)}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **place, **arrays)


def _check(
    name: str,
    field: str,
    values: np.ndarray | torch.Tensor,
    device: str,
    warnings: list[str],
    dtype: torch.dtype | None = None,
) -> torch.Tensor:
    """Returns a field as a tensor, with NaN, infinite and negative values set to 0, for which warnings are added.
    `dtype` is the type of the tensor; None: half floats if the values are half floats, else float32."""
    if not isinstance(values, torch.Tensor):
        values = np.asarray(values)
        if values.dtype.kind not in "iuf" or values.dtype == np.longdouble:
            raise WlmError(f"{name}: {field}: expected an array of real numbers, found the type {values.dtype}")
        kept = np.float16 if values.dtype == np.float16 else np.float32
        with np.errstate(over="ignore"):  # values too large become infinite, which is repaired below
            values = torch.from_numpy(np.array(values, kept, order="C"))
    elif values.dtype.is_complex or values.dtype == torch.bool:
        raise WlmError(f"{name}: {field}: expected an array of real numbers, found the type {values.dtype}")
    if values.ndim != 3 or 0 in values.shape or values.numel() > LARGEST:
        raise WlmError(f"{name}: {field}: expected [X, Y, Z], 1 to {LARGEST} voxels, found {tuple(values.shape)}")
    dtype = dtype or (torch.float16 if values.dtype == torch.float16 else torch.float32)
    values = values.detach().to(device, dtype).contiguous()
    low, high = torch.aminmax(values)
    if low >= 0 and torch.isfinite(high):  # NaN fails this test; most volumes then need no masks
        return values
    for bad, kind in ((~torch.isfinite(values), "NaN or infinite"), (values < 0, "negative")):
        if bad.any():
            count, first = _found(bad)
            warnings.append(f"{name}: {field}: {count} {kind} voxels count as 0, the first is {first}")
            values = torch.where(bad, torch.zeros_like(values), values)
    return values


def _found(bad: torch.Tensor) -> tuple[int, tuple[int, ...]]:
    first = np.unravel_index(int(bad.flatten().to(torch.uint8).argmax()), bad.shape)
    return int(bad.sum()), tuple(int(i) for i in first)


def _dimmed(name: str, heat: torch.Tensor, emission: float, voxel: float, warnings: list[str]) -> torch.Tensor:
    """Returns temperatures clamped so that the light of a voxel stays within the range of half floats."""
    most = HALF_MAX / max(emission * voxel, _TINY)
    if float(heat.max()) > most:
        count, first = _found(heat > most)
        warnings.append(
            f"{name}: {_TEMPERATURE}: {count} voxels that each emit more light than {HALF_MAX:,.0f}, the largest half "
            f"float, are lowered to it, the first is {first}"
        )
        heat = heat.clamp(max=most)
    return heat


def _read_npz(path: Path, names: tuple[str | None, str | None], device: str, trust: bool) -> dict[str, Any]:
    density, temperature = (name or default for name, default in zip(names, (_DENSITY, _TEMPERATURE), strict=True))
    wanted = {_DENSITY: density, _TEMPERATURE: temperature, "voxel": "voxel", "origin": "origin"}
    if names[1] is None and density == temperature:
        del wanted[_TEMPERATURE]
    needed = [density] if names[1] is None else [density, temperature]

    def choose(found: Sequence[str]) -> list[str]:
        if _BRICKS in found and density not in found:
            return [name for name in found if name.removesuffix("_bricks") in (*wanted.values(), _BRICKS, "shape")]
        return [*needed, *(name for name in wanted.values() if name in found and name not in needed)]

    most = LARGEST if trust else VOXELS
    arrays = read_npz(path, choose, numbers=most, sure=VOLUME_BYTES if trust else 4 * SURE_VOXELS)
    if _BRICKS in arrays:
        arrays = _in_place(path, arrays, most, device, trust)
        if missing := next((name for name in needed if name not in arrays), None):
            raise WlmError(f"{path}: {missing} is missing; found {', '.join(arrays) or 'nothing'}")
    arrays = {field: arrays[name] for field, name in wanted.items() if name in arrays}
    for field, size in (("voxel", 1), ("origin", 3)):
        value = arrays.get(field)
        if value is None:
            continue
        if value.dtype.kind not in "iuf" or value.size != size or not np.isfinite(value).all():
            raise WlmError(f"{path}: {field}: expected {size} finite numbers, found {value.dtype} {value.shape} or NaN")
        arrays[field] = float(value.item()) if size == 1 else tuple(map(float, value.ravel()))
    for field in (_DENSITY, _TEMPERATURE):
        if isinstance(arrays.get(field), np.ndarray) and arrays[field].dtype in (np.float16, np.float32):
            # A tensor, which `from_array` need not copy.
            arrays[field] = torch.from_numpy(arrays[field])
    return arrays


def _in_place(path: Path, arrays: dict[str, Any], most: int, device: str, trust: bool) -> dict[str, Any]:
    """Returns a file's arrays with fields that are stored as bricks expanded to tensors [X, Y, Z] on a device."""
    shape, numbers = arrays.pop("shape", np.zeros(0)), arrays.pop(_BRICKS)
    if shape.shape != (3,) or shape.dtype.kind not in "iu" or not (shape.min() >= 1 and shape.max() <= most):
        raise WlmError(f"{path}: shape: expected 3 whole numbers from 1 to {most}, found {shape.ravel()[:4].tolist()}")
    sides = shape.tolist()
    counts = [-(-n // EDGE) for n in sides]
    if math.prod(sides) > most:
        raise WlmError(f"{path}: shape: expected at most {most} voxels, found {sides}")
    if not trust:
        stored = sum(array.nbytes for array in arrays.values())
        check_growth(f"{path}: shape", stored, 4 * math.prod(counts) * EDGE**3, sure=4 * SURE_VOXELS)
    if numbers.ndim != 1 or numbers.dtype != np.int32 or (np.diff(numbers.astype(np.int64)) < 1).any():
        raise WlmError(f"{path}: {_BRICKS}: expected rising int32 [N], found {numbers.dtype} {numbers.shape}")
    if len(numbers) and not (numbers[0] >= 0 and numbers[-1] < math.prod(counts)):
        raise WlmError(
            f"{path}: {_BRICKS}: expected numbers from 0 to {math.prod(counts) - 1}, found {numbers[[0, -1]]}"
        )
    places = torch.from_numpy(numbers).to(device)
    for name in [name for name in arrays if name.endswith("_bricks")]:
        cut = arrays.pop(name)
        if cut.shape != (len(numbers), EDGE, EDGE, EDGE) or cut.dtype not in (np.float16, np.float32):
            raise WlmError(f"{path}: {name}: expected floats [{len(numbers)}, 8, 8, 8], found {cut.dtype} {cut.shape}")
        arrays[name.removesuffix("_bricks")] = scatter(places, torch.from_numpy(cut).to(device), sides)
    return arrays


def grid_heads(path: Path) -> tuple[GridHead, ...]:
    """Returns the names, types and classes of the grids of a `.nvdb` or `.vdb` file; none for a `.npz`."""
    if path.suffix.lower() not in _FILES:
        return ()
    kind, what = _FILES[path.suffix.lower()]
    with open_file(path, what) as file:
        return kind(FileBytes(file), str(path)).heads


def _read_grids(path: Path, names: tuple[str | None, str | None], trust: bool) -> tuple[list[Grid], list[str]]:
    """Reads the grids of density and, if it exists, temperature from a file, with warnings."""
    kind, what = _FILES[path.suffix.lower()]
    file = kind(read_file(path, VOLUME_BYTES, what), str(path))
    density, temperature, warnings = choose(str(path), file.heads, *names)
    grids = []
    same = [head for head in file.heads if head.name == density]
    if len(same) > 1:
        warnings.append(f"{path}: {len(same)} grids are named {density or 'nothing'}: only the first is read")
    for name in (density,) if temperature is None else (density, temperature):
        grid = file.read(name, trust)
        matrix, where, values = grid.matrix.copy(), f"{path}: {name or 'grid 0'}", grid.values
        matrix[:3, 3] += matrix[:3, :3] @ grid.low
        if name == density and is_level_set(grid, same[0].group):
            if names[0] is None:
                raise WlmError(f"{where}: expected a density, found a level set: --volume density={name} fills it")
            # Smoke fills the inside, and fades to the surface within the narrow band.
            values = np.clip(-values / grid.background, 0.0, 1.0)
            warnings.append(f"{where}: a level set, which is filled with smoke of density 1")
        elif name == density and grid.background > 0:
            warnings.append(f"{where}: the background, {grid.background:.4g}, counts as 0 outside the grid's box")
        grids.append(Grid(where, torch.from_numpy(np.ascontiguousarray(values)), matrix))
    return grids, warnings


_FILES: dict[str, tuple[Any, str]] = {".nvdb": (NanoVdbFile, "the NanoVDB file"), ".vdb": (VdbFile, "the OpenVDB file")}
