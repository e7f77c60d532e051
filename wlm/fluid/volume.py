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
temperature of another shape          error
transform of a `.nvdb` that turns,  error
shears or stretches
a `.nvdb` of points, vectors, ints  error
a file missing or damaged             error that names the file, and the field
====================================  ================================================================

A grid's density has no unit of its own: the extinction per length is `extinction` times it.
"""

import os
import struct
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.interop import check_device, to_warp

_DENSITY, _TEMPERATURE = "density", "temperature"
_BAD_FILE = (OSError, ValueError, EOFError, KeyError, MemoryError, NotImplementedError, zipfile.BadZipFile, zlib.error)
_LARGEST = 2**31 - 1  # voxels that a kernel can index


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
    if not (0 < voxel < np.inf):
        raise WlmError(f"{name}: voxel: expected a length above 0, found {voxel}")
    if not (0 < extinction < np.inf):
        raise WlmError(f"{name}: extinction: expected a number above 0, found {extinction}")
    if not (0 <= emission < np.inf):
        raise WlmError(f"{name}: emission: expected a number of at least 0, found {emission}")
    if np.shape(origin) != (3,) or not np.isfinite(origin).all():
        raise WlmError(f"{name}: origin: expected three finite numbers, found {origin}")
    warnings: list[str] = []
    smoke = _check(name, _DENSITY, density, device, warnings)
    heat = None
    if temperature is not None:
        # Kernels take both in one type.
        heat = _check(name, _TEMPERATURE, temperature, device, warnings).to(smoke.dtype)
        if heat.shape != smoke.shape:
            raise WlmError(f"{name}: {_TEMPERATURE}: expected {tuple(smoke.shape)} voxels, found {tuple(heat.shape)}")
    corner = tuple(float(o) for o in origin)
    return DensityVolume(smoke, float(extinction), float(voxel), corner, heat, float(emission), tuple(warnings))


def load_volume(
    path: str | os.PathLike[str],
    *,
    extinction: float = 1.0,
    emission: float = 1.0,
    voxel: float | None = None,
    device: str = "cpu",
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

    Returns:
        The volume, repaired as in the module's table.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", ".nvdb"):
        raise WlmError(f"{path}: expected a name that ends in .npz or .nvdb, found {path.suffix or 'none'}")
    if not path.is_file():
        raise WlmError(f"{path}: no such file")
    factors = {"extinction": extinction, "emission": emission, "name": str(path)}
    if path.suffix.lower() == ".npz":
        volume = from_array(**_read_npz(path), **factors, device=device)
    else:
        # It becomes dense on the CPU: the file's tree is in host memory anyway.
        dense = from_grid(*_read_nvdb(path), **factors)
        device = check_device(device)
        heat = None if dense.temperature is None else dense.temperature.to(device)
        volume = replace(dense, density=dense.density.to(device), temperature=heat)
    if voxel is None:
        return volume
    if not 0 < voxel < np.inf:
        raise WlmError(f"{path}: voxel: expected a length above 0, found {voxel}")
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


def _check(name: str, field: str, values: np.ndarray | torch.Tensor, device: str, warnings: list[str]) -> torch.Tensor:
    if not isinstance(values, torch.Tensor):
        values = np.asarray(values)
        if values.dtype.kind not in "iuf" or values.dtype == np.longdouble:
            raise WlmError(f"{name}: {field}: expected numbers, found {values.dtype}")
        dtype = np.float16 if values.dtype == np.float16 else np.float32
        with np.errstate(over="ignore"):  # values too large become infinite, which is repaired below
            values = torch.from_numpy(np.array(values, dtype, order="C"))
    elif values.dtype.is_complex or values.dtype == torch.bool:
        raise WlmError(f"{name}: {field}: expected numbers, found {values.dtype}")
    if values.ndim != 3 or 0 in values.shape or values.numel() > _LARGEST:
        raise WlmError(f"{name}: {field}: expected [X, Y, Z] voxels, found {tuple(values.shape)}")
    values = values.detach().to(device, values.dtype if values.dtype == torch.float16 else torch.float32).contiguous()
    for bad, kind in ((~torch.isfinite(values), "NaN or infinite"), (values < 0, "negative")):
        count = int(bad.sum())
        if count:
            first = np.unravel_index(int(bad.flatten().to(torch.uint8).argmax()), values.shape)
            at = tuple(int(i) for i in first)
            warnings.append(f"{name}: {field}: {count} {kind} voxels count as 0, the first is {at}")
            values = torch.where(bad, torch.zeros_like(values), values)
    return values


def _read_npz(path: Path) -> dict:
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise WlmError(f"{path}: expected a .npz file of several arrays, found a single array")
        with loaded as file:
            if _DENSITY not in file.files:
                raise WlmError(f"{path}: {_DENSITY} is missing; found {', '.join(file.files) or 'nothing'}")
            parts = {_DENSITY: file[_DENSITY], "voxel": 1.0, "origin": (0.0, 0.0, 0.0)}
            if _TEMPERATURE in file.files:
                parts[_TEMPERATURE] = file[_TEMPERATURE]
            for field, size in (("voxel", 1), ("origin", 3)):
                if field in file.files:
                    value = file[field]
                    if value.dtype.kind not in "iuf" or value.size != size or not np.isfinite(value).all():
                        raise WlmError(f"{path}: {field}: expected {size} finite numbers, found {value.tolist()}")
                    parts[field] = float(value.item()) if size == 1 else tuple(map(float, value.ravel()))
            return parts
    except _BAD_FILE as error:
        raise WlmError(f"{path}: cannot read the arrays: {error or type(error).__name__}") from error


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
) -> DensityVolume:
    """Makes a checked volume from a NanoVDB grid, on the grid's device, over the box of its active voxels.

    It becomes dense: a march reads eight voxels for each sample, each of which would be a walk down the tree.

    Args:
        density: A grid of floats.
        temperature: Another grid with the same transform, or None.
        extinction: Per unit of length at density 1.
        emission: Light given off per unit of length at temperature 1.
        name: By which messages name it.

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
    low, high = _box(name, density)
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


def _read_nvdb(path: Path) -> tuple[wp.Volume, wp.Volume | None]:
    """The grids named density, or the first, and temperature, if there is one."""
    try:
        volume = wp.Volume.load_from_nvdb(path.read_bytes(), device="cpu")
        grids = []
        while volume is not None:
            grids.append(volume)
            volume = volume.load_next_grid()
    except (RuntimeError, TypeError, struct.error, *_BAD_FILE) as error:
        raise WlmError(f"{path}: cannot read the NanoVDB file: {error or type(error).__name__}") from error
    names = [grid.get_grid_info().name for grid in grids]
    density = grids[names.index(_DENSITY)] if _DENSITY in names else grids[0]
    return density, grids[names.index(_TEMPERATURE)] if _TEMPERATURE in names else None


def _box(where: str, volume: wp.Volume) -> tuple[np.ndarray, np.ndarray]:
    """First and last active voxel, tiles too, from the header of the tree's root, which Warp doesn't expose."""
    data = volume.array().numpy().tobytes()
    grid_header, root_offset = 672, 24
    root = grid_header + struct.unpack_from("<q", data, grid_header + root_offset)[0]
    corners = np.array(struct.unpack_from("<6i", data, root)).reshape(2, 3)
    name = volume.get_grid_info().name or "grid 0"
    if (corners[1] < corners[0]).any():
        raise WlmError(f"{where}: {name}: expected active voxels, found none")
    if np.prod((corners[1] - corners[0] + 1).astype(object)) > _LARGEST:
        raise WlmError(f"{where}: {name}: expected a box of at most {_LARGEST} voxels, found {corners.tolist()}")
    return corners[0], corners[1]


def _read_dense(where: str, volume: wp.Volume, low: np.ndarray, high: np.ndarray) -> torch.Tensor:
    info = volume.get_grid_info()
    if volume.dtype is not wp.float32:
        raise WlmError(f"{where}: {info.name or 'grid 0'}: expected a grid of floats, found {info.type_str}")
    out = wp.empty(tuple(int(n) for n in high - low + 1), dtype=float, device=volume.device)
    inputs = [volume.id, wp.vec3i(*map(int, low))]
    wp.launch(_dense, out.shape, inputs=inputs, outputs=[out], device=volume.device)
    return wp.to_torch(out)
