"""Density volumes of smoke, checked, from arrays, `.npz` or NanoVDB (`.nvdb`) files; and writing `.npz`.

Stated behaviours. Repairs are listed in `DensityVolume.warnings`, one line for each kind.

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
NaN or infinite voxels                0; warning with the count and the first
negative voxels                       0; warning likewise (solvers and filters leave small ones)
all voxels zero                       fine: all is transparent
one voxel                             fine
no voxel                              error
float16                               stays half; float32, float64 and integers become float32
float64 beyond float32                as infinite: 0, warning
other types, other than 3 dimensions  error
more than 1024^3 voxels; above 512^3  error, unless the file is trusted
those that a small file only claims
temperature of another shape          error
temperature so high that one voxel    lowered to that; warning with the count and the first
gives off more than 65,504 (half's
maximum)
a length, extinction or emission      error
beyond float32
transform of a `.nvdb` that turns,  error
shears or stretches
a `.nvdb` of points, vectors, ints  error
a file missing or damaged             error that names the file, and the field
====================================  ================================================================

A grid's density has no unit of its own: the extinction per length is `extinction` times it.
"""

import math
import os
import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.exr import HALF_MAX
from wlm.formats.limits import (
    GROWTH,
    SURE_BOX,
    SURE_BYTES,
    SURE_VOXELS,
    VOLUME_BYTES,
    VOXELS,
    VOXELS_A_BYTE,
    check_growth,
)
from wlm.formats.npz import read_npz
from wlm.formats.reading import read_file
from wlm.interop import check_device, to_warp

_DENSITY, _TEMPERATURE = "density", "temperature"
# What Warp raises on a NanoVDB file that is none, is cut short, or lies about its sizes.
_BAD_GRID = (RuntimeError, TypeError, ValueError, LookupError, OverflowError, MemoryError, struct.error, zlib.error)
_LARGEST = 2**31 - 1  # voxels that a kernel can index
_TINY, _HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)

# Of the NanoVDB format: bytes of a file's header and of a grid's, and in the latter the place of its name's length.
_FILE_HEADER, _GRID_HEADER, _NAME_LENGTH = 16, 176, 120
_BLOSC = 2  # of its two compressions
_PIECE = 1 << 20  # bytes unpacked at once


@dataclass(frozen=True, eq=False)
class DensityVolume:
    """Smoke in a box of cubic voxels.

    The constructor doesn't check: a solver's frames are used as they lie on the device. `from_array` does.

    Attributes:
        density: float32 or float16 tensor [X, Y, Z], finite, not negative.
        extinction: Per unit of length at density 1; above 0.
        voxel: Edge of a voxel, in the world's unit.
        origin: float64 [3], the corner of voxel (0, 0, 0) in the world; its centre is half a voxel further.
        temperature: Like the density; None: no emission.
        emission: Light given off per unit of length at temperature 1.
        warnings: The repairs, one line each.
    """

    density: torch.Tensor
    extinction: float = 1.0
    voxel: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature: torch.Tensor | None = None
    emission: float = 1.0
    warnings: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int, int]:
        """X, Y, Z in voxels."""
        return tuple(self.density.shape)

    @property
    def device(self) -> torch.device:
        """The device of the voxels."""
        return self.density.device

    @property
    def centre(self) -> np.ndarray:
        """The box's centre in the world, float64 [3]."""
        return np.asarray(self.origin) + 0.5 * self.voxel * np.asarray(self.shape)

    def arrays(self) -> tuple[wp.array, wp.array | None]:
        """Density and temperature as Warp arrays that share the tensors' memory."""
        wp.init()  # unlike the rest of Warp, wrapping a tensor doesn't initialise it
        hot = None if self.temperature is None else to_warp(self.temperature)
        return to_warp(self.density), hot


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
    """Makes a checked volume from arrays.

    Args:
        density: Numbers [X, Y, Z]; copied where they have to be changed or moved.
        extinction: Per unit of length at density 1.
        voxel: Edge of a voxel, in the world's unit.
        origin: The corner of voxel (0, 0, 0) in the world.
        temperature: [X, Y, Z], or None.
        emission: Light given off per unit of length at temperature 1.
        device: "cpu" or "cuda:N".
        name: By which messages name it.

    Returns:
        The volume, repaired as in the module's table.

    Raises:
        WlmError: An error of the module's table, or a length or factor that isn't above 0.
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
            raise WlmError(f"{name}: {_TEMPERATURE}: expected {tuple(smoke.shape)} voxels, found {tuple(heat.shape)}")
        heat = _dimmed(name, heat, emission, voxel, warnings)
    corner = tuple(float(o) for o in origin)
    return DensityVolume(smoke, float(extinction), float(voxel), corner, heat, float(emission), tuple(warnings))


def load_volume(
    path: str | os.PathLike[str],
    *,
    extinction: float = 1.0,
    emission: float = 1.0,
    voxel: float | None = None,
    device: str = "cpu",
    trust: bool = False,
) -> DensityVolume:
    """Reads a volume from a file.

    - `.npz`: an array `density` [X, Y, Z], and optionally `temperature` of the same shape and the numbers
      `voxel` and `origin` [3].
    - `.nvdb`: a float grid named `density`, else the first one, over the box of its active voxels; and a grid named
      `temperature`, over the same box. Its transform gives the size and the position of the voxels.

    Args:
        path: The file; its suffix tells the format.
        extinction: Per unit of length at density 1.
        emission: Light given off per unit of length at temperature 1.
        voxel: Edge of a voxel, in the world's unit; None: the file's, or 1.
        device: "cpu" or "cuda:N".
        trust: Whether the file is believed to hold as many voxels as it says (`wlm.formats.limits`).

    Returns:
        The volume, repaired as in the module's table.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", ".nvdb"):
        raise WlmError(f"{path}: expected a name that ends in .npz or .nvdb, found {path.suffix or 'none'}")
    factors = {"extinction": extinction, "emission": emission, "name": str(path)}
    if path.suffix.lower() == ".npz":
        volume = from_array(**_read_npz(path, trust), **factors, device=device)
    else:
        # It becomes dense on the CPU: the file's tree is in host memory anyway.
        dense = from_grid(*_read_nvdb(path, trust), **factors, trust=trust)
        device = check_device(device)
        heat = None if dense.temperature is None else dense.temperature.to(device)
        volume = replace(dense, density=dense.density.to(device), temperature=heat)
    if voxel is None:
        return volume
    if not _TINY <= voxel <= _HUGE:
        raise WlmError(f"{path}: voxel: expected a length above 0 that float32 holds, found {voxel}")
    return replace(volume, voxel=voxel, origin=tuple(voxel / volume.voxel * o for o in volume.origin))


def save_volume(path: str | os.PathLike[str], volume: DensityVolume) -> None:
    """Writes a volume as `.npz`, atomically, such that `load_volume` reads it back.

    Raises:
        WlmError: Another suffix, or the file can't be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise WlmError(f"{path}: expected a name that ends in .npz")
    arrays = {
        _DENSITY: volume.density.cpu().numpy(),
        "voxel": np.float64(volume.voxel),
        "origin": np.asarray(volume.origin, np.float64),
    }
    if volume.temperature is not None:
        arrays[_TEMPERATURE] = volume.temperature.cpu().numpy()
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


def _check(
    name: str,
    field: str,
    values: np.ndarray | torch.Tensor,
    device: str,
    warnings: list[str],
    dtype: torch.dtype | None = None,
) -> torch.Tensor:
    """The values in `dtype`, or half where they are half, else float32; repaired as the module's table says."""
    if not isinstance(values, torch.Tensor):
        values = np.asarray(values)
        if values.dtype.kind not in "iuf" or values.dtype == np.longdouble:
            raise WlmError(f"{name}: {field}: expected numbers, found {values.dtype}")
        kept = np.float16 if values.dtype == np.float16 else np.float32
        with np.errstate(over="ignore"):  # values too large become infinite, which is repaired below
            values = torch.from_numpy(np.array(values, kept, order="C"))
    elif values.dtype.is_complex or values.dtype == torch.bool:
        raise WlmError(f"{name}: {field}: expected numbers, found {values.dtype}")
    if values.ndim != 3 or 0 in values.shape or values.numel() > _LARGEST:
        raise WlmError(f"{name}: {field}: expected [X, Y, Z] voxels, found {tuple(values.shape)}")
    dtype = dtype or (torch.float16 if values.dtype == torch.float16 else torch.float32)
    values = values.detach().to(device, dtype).contiguous()
    low, high = torch.aminmax(values)
    if low >= 0 and torch.isfinite(high):  # NaN would be both; most volumes need no masks as large as they are
        return values
    for bad, kind in ((~torch.isfinite(values), "NaN or infinite"), (values < 0, "negative")):
        if bad.any():
            count, first = _found(bad)
            warnings.append(f"{name}: {field}: {count} {kind} voxels count as 0, the first is {first}")
            values = torch.where(bad, torch.zeros_like(values), values)
    return values


def _found(bad: torch.Tensor) -> tuple[int, tuple[int, ...]]:
    """How many voxels are bad, and the first."""
    first = np.unravel_index(int(bad.flatten().to(torch.uint8).argmax()), bad.shape)
    return int(bad.sum()), tuple(int(i) for i in first)


def _dimmed(name: str, heat: torch.Tensor, emission: float, voxel: float, warnings: list[str]) -> torch.Tensor:
    """The temperatures, none so high that one voxel's light would be beyond what pictures hold."""
    most = HALF_MAX / max(emission * voxel, _TINY)
    bad = heat > most
    if bad.any():
        count, first = _found(bad)
        warnings.append(
            f"{name}: {_TEMPERATURE}: {count} voxels that each give off more than {HALF_MAX:,.0f} are lowered to it, "
            f"the first is {first}"
        )
        heat = heat.clamp(max=most)
    return heat


def _read_npz(path: Path, trust: bool) -> dict:
    wanted = (_DENSITY, _TEMPERATURE, "voxel", "origin")
    arrays = read_npz(
        path,
        lambda names: [_DENSITY, *(name for name in wanted[1:] if name in names)],
        numbers=_LARGEST if trust else VOXELS,
        sure=VOLUME_BYTES if trust else 4 * SURE_VOXELS,
    )
    for field, size in (("voxel", 1), ("origin", 3)):
        value = arrays.get(field)
        if value is None:
            continue
        if value.dtype.kind not in "iuf" or value.size != size or not np.isfinite(value).all():
            raise WlmError(f"{path}: {field}: expected {size} finite numbers, found {value.dtype} {value.shape}")
        arrays[field] = float(value.item()) if size == 1 else tuple(map(float, value.ravel()))
    for field in (_DENSITY, _TEMPERATURE):
        if field in arrays and arrays[field].dtype in (np.float16, np.float32):
            # A tensor, which `from_array` need not copy.
            arrays[field] = torch.from_numpy(arrays[field])
    return arrays


@wp.kernel(enable_backward=False)
def _dense(
    # in:
    grid: wp.uint64,
    low: wp.vec3i,
    # out:
    out: wp.array3d[float],
):
    i, j, k = wp.tid()
    out[i, j, k] = wp.volume_lookup_f(grid, low[0] + i, low[1] + j, low[2] + k)


def from_grid(
    density: wp.Volume,
    temperature: wp.Volume | None = None,
    *,
    extinction: float = 1.0,
    emission: float = 1.0,
    name: str = "grid",
    trust: bool = True,
) -> DensityVolume:
    """Makes a checked volume from a NanoVDB grid, on the grid's device, over the box of its active voxels.

    It becomes dense: a march reads eight voxels for each sample, each of which would be a walk down the tree.

    Args:
        density: A grid of floats.
        temperature: Another grid with the same transform, or None.
        extinction: Per unit of length at density 1.
        emission: Light given off per unit of length at temperature 1.
        name: By which messages name it.
        trust: Whether its box is believed, however few voxels the grid stores; false for a stranger's.

    Returns:
        The volume, repaired as in the module's table.

    Raises:
        WlmError: An error of the module's table.
    """
    info = density.get_grid_info()
    matrix = np.array(info.transform_matrix, np.float64).reshape(3, 3)
    voxel = abs(matrix[0, 0])
    if not (voxel > 0 and np.allclose(matrix, voxel * np.eye(3), atol=1e-5 * voxel)):
        raise WlmError(f"{name}: {info.name}: expected a grid of cubic voxels along the axes, found {matrix.tolist()}")
    low, high = _box(name, density, trust)
    heat = None
    if temperature is not None:
        heat_info = temperature.get_grid_info()
        same = np.allclose(np.array(heat_info.transform_matrix).reshape(3, 3), matrix, atol=1e-5 * voxel)
        if not (same and np.allclose(heat_info.translation, info.translation, atol=1e-4 * voxel)):
            raise WlmError(f"{name}: {_TEMPERATURE}: expected the voxels of {info.name}")
        heat = _read_dense(name, temperature, low, high)
    return from_array(
        _read_dense(name, density, low, high),
        extinction=extinction,
        voxel=float(voxel),
        # NanoVDB's coordinates are those of voxel centres.
        origin=tuple(float(t + voxel * (i - 0.5)) for t, i in zip(info.translation, low, strict=True)),
        temperature=heat,
        emission=emission,
        device=str(density.device),
        name=name,
    )


def _read_nvdb(path: Path, trust: bool) -> tuple[wp.Volume, wp.Volume | None]:
    """The grids named density, or the first, and temperature, if there is one."""
    data = read_file(path, VOLUME_BYTES, "the NanoVDB file")
    try:
        if not trust:
            check_growth(str(path), len(data), _unpacked_size(data, max(SURE_BYTES, GROWTH * len(data))))
        volume = wp.Volume.load_from_nvdb(data, device="cpu")
        grids = []
        while volume is not None:
            grids.append(volume)
            volume = volume.load_next_grid()
    except _BAD_GRID as error:
        raise WlmError(f"{path}: cannot read the NanoVDB file: {str(error) or type(error).__name__}") from error
    names = [grid.get_grid_info().name for grid in grids]
    density = grids[names.index(_DENSITY)] if _DENSITY in names else grids[0]
    return density, grids[names.index(_TEMPERATURE)] if _TEMPERATURE in names else None


def _unpacked_size(data: bytes, most: int) -> int:
    """Bytes of the grids of a compressed file, which Warp would unpack whatever they become; stops beyond `most`."""
    grids, codec = struct.unpack_from("<2H", data, _FILE_HEADER - 4)
    at, packed = _FILE_HEADER, 0
    for _ in range(grids):
        packed += struct.unpack_from("<Q", data, at + 8)[0]
        at += _GRID_HEADER + struct.unpack_from("<I", data, at + _NAME_LENGTH)[0]
    end, size = at + packed, 0
    while codec and at < end and size <= most:
        length = struct.unpack_from("<Q", data, at)[0]
        piece = data[at + 8 : at + 8 + length]
        if codec == _BLOSC:  # which states the size itself
            size += struct.unpack_from("<I", piece, 4)[0]
        else:
            unpacker = zlib.decompressobj()
            while piece and size <= most:
                size += len(unpacker.decompress(piece, _PIECE))
                piece = unpacker.unconsumed_tail
        at += 8 + length
    return size


def _box(where: str, volume: wp.Volume, trust: bool) -> tuple[np.ndarray, np.ndarray]:
    """First and last active voxel, tiles too, from the header of the tree's root, which Warp doesn't expose."""
    data = volume.array().numpy()
    grid_header, root_offset = 672, 24
    root = grid_header + struct.unpack_from("<q", data, grid_header + root_offset)[0]
    corners = np.array(struct.unpack_from("<6i", data, root)).reshape(2, 3)
    name = volume.get_grid_info().name or "grid 0"
    if (corners[1] < corners[0]).any():
        raise WlmError(f"{where}: {name}: expected active voxels, found none")
    most = _LARGEST if trust else min(VOXELS, max(SURE_BOX, VOXELS_A_BYTE * data.nbytes))
    if math.prod(corners[1].astype(object) - corners[0] + 1) > most:
        raise WlmError(
            f"{where}: {name}: expected a box of at most {most} voxels from a grid of {data.nbytes} bytes, "
            f"found {corners.tolist()}"
        )
    return corners[0], corners[1]


def _read_dense(where: str, volume: wp.Volume, low: np.ndarray, high: np.ndarray) -> torch.Tensor:
    info = volume.get_grid_info()
    if volume.dtype is not wp.float32:
        raise WlmError(f"{where}: {info.name or 'grid 0'}: expected a grid of floats, found {info.type_str}")
    out = wp.empty(tuple(int(n) for n in high - low + 1), dtype=float, device=volume.device)
    inputs = [volume.id, wp.vec3i(*map(int, low))]
    wp.launch(_dense, out.shape, inputs=inputs, outputs=[out], device=volume.device)
    return wp.to_torch(out)
