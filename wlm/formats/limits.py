"""Limits of readers: bounds on the work and the memory that a file can demand.

Realistic inputs pass: lightmaps of 16384 x 16384, meshes of ten million vertices, a million probes, volumes of 1024^3
voxels. Beyond a size that any machine can store, a claimed size must be backed by bytes of the file: compressed data
may grow by at most a stated factor. `trust=True` of the loaders (`--trust` of the commands) lifts the limits that the
table in `docs/limits.md` marks; the table states the same numbers.
"""

from wlm.errors import WlmError

SETTINGS_BYTES = 64 << 10
"""Largest YAML file. Settings have some kilobytes, a path of a thousand positions 40, and the parser is slow."""

INTEGER = 1 << 63
"""Bound of the magnitude of integers in settings; larger ones do not fit arrays and counters."""

INDEX_BYTES = 64 << 20
"""Largest JSON file that describes other files: `set.json`, `scene.json`, indices of exports, benchmark rows."""

JSON_BYTES = 512 << 20
"""Largest JSON file of data: a million probes with 27 numbers, or a glTF tree with embedded buffers."""

JSON_GROWTH = 24
"""Largest memory of the values of a JSON text per byte of it. Lists of three numbers of three digits take 16."""

SURE_JSON = 256 << 20
"""Memory of the values of a JSON text that is allowed for any length of it, in bytes."""

MEMBERS_BYTES = 1 << 20
"""Largest list of members of a ZIP archive: ten thousand arrays."""

BAKE_BYTES = 1 << 30
"""Largest Godot bake. A probe has 156 bytes, and its tetrahedra and BSP tree some hundred."""

MODEL_BYTES = 2 << 30
"""Largest OBJ, PLY, STL or OFF file. Ten million vertices of an OBJ take about 1.5 GB."""

NUMBER_BYTES = 3
"""Bytes of an OBJ, PLY, STL or OFF file per number in it, beyond `SURE_CORNERS` numbers; large meshes have 6 to 8."""

MATERIALS = 1024
"""Most materials of an OBJ file."""

MESH_BYTES = (4 << 30) - 1
"""Largest `.glb`, by its format, and largest buffer or image beside a glTF file."""

VOLUME_BYTES = 16 << 30
"""Largest `.npz`, `.nvdb` or `.vdb`: 1024^3 voxels in float64 take 8.6 GB, twice that with temperatures."""

GROWTH = 256
"""Largest expansion of compressed data. Zeros expand 1,032 times under deflate, realistic arrays about ten times."""

SURE_BYTES = 64 << 20
"""Decompressed bytes that are allowed for any size of compressed data."""

CORNERS_A_BYTE = 8
"""Drawn corners and vertices of a glTF file per byte of the file and its buffers; below 1 without instances."""

SURE_CORNERS = 4 << 20
"""Drawn corners and vertices of a glTF file, and numbers of an OBJ, that are allowed for any size of file."""

CORNERS = 1 << 28
"""Largest number of drawn corners and vertices."""

PICTURE_SIDE = 65_536
"""Longest side of a lightmap file (EXR, Radiance, PFM, TIFF, KTX2, DDS), in texels."""

PICTURE_TEXELS = 1 << 28
"""Most texels of a lightmap file: 16384 x 16384, the largest texture of most GPUs."""

PICTURE_GROWTH = 2048
"""Largest expansion of a lightmap file. Black pixels expand 950 times under ZIP."""

PICTURE_BYTES = 256 << 20
"""Decoded bytes that are allowed for any size of file: 6000 x 6000 black texels of half floats."""

IMAGE_BYTES = 2 << 30
"""Largest PNG, JPEG, WebP, TGA or TIFF file, in bytes: 16384 x 16384 texels of 8 bytes."""

TIMES = 100_000
"""Most lightmaps of a set."""

FRAMES = 1 << 30
"""Decoded bytes of a set of lightmaps that are allowed for any size of its files."""

VOXELS = 1 << 30
"""Most voxels of a volume: 1024^3."""

SURE_VOXELS = 1 << 27
"""Voxels that are allowed for any size of file: 512^3, for frames of a simulation without smoke."""

SURE_BOX = 1 << 24
"""Voxels of the bounding box of a VDB grid, and of its cubic voxels, that are allowed for any size of grid: 256^3."""

VOXELS_A_BYTE = 64
"""Voxels of the bounding box per byte of a NanoVDB grid or of a `.vdb` file: 1 of 256 voxels may be stored."""

RESAMPLED = 8
"""Most cubic voxels into which a non-cubic voxel is resampled."""

PROBES = 1 << 24
"""Most probes of a set."""

NUMBERS = 4096
"""Most numbers per probe: spherical harmonics in RGB up to order 36. Kernels are compiled for the number."""


def check_sides(where: str, width: int, height: int) -> None:
    """Checks the claimed size of a picture."""
    if not 0 < min(width, height) <= max(width, height) <= PICTURE_SIDE or width * height > PICTURE_TEXELS:
        raise WlmError(
            f"{where}: expected at least one texel, at most {PICTURE_TEXELS} texels and {PICTURE_SIDE} along a side, "
            f"found {width} x {height}"
        )


def check_growth(where: str, small: int, large: int, growth: int = GROWTH, sure: int = SURE_BYTES) -> None:
    """Checks the claimed size of decompressed data in bytes, `large`, against the compressed size, `small`.

    The claimed size may be `sure` bytes or `growth` times the compressed size, whichever is more. `where` names the
    file and the field in the message.
    """
    if large > max(sure, growth * small):
        raise WlmError(
            f"{where}: expected at most {growth} times its {small} compressed bytes, found {large} unpacked bytes"
        )


class Budget:
    """The work or memory that reading one file may still take; each loop of the reader takes from it beforehand."""

    def __init__(self, where: str, most: int, unit: str, hint: str = "") -> None:
        """Allows `most` units. `where` (the file), `unit` (plural) and `hint` (advice at the end) are for messages."""
        self._left = most
        self._text = f"{where}: expected at most {most} {unit} for the size of the file, found more{hint}"

    def spend(self, amount: int) -> None:
        """Takes an amount from what is left."""
        self._left -= amount
        if self._left < 0:
            raise WlmError(self._text)
