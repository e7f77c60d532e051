"""What readers take at most: bounds on the work and the memory that a file can ask for.

Honest inputs pass: lightmaps of 16384 x 16384, meshes of ten million vertices, a million probes, volumes of 1024^3
voxels. What a file claims beyond a size that any machine holds must be in the file: compressed data may grow by a
stated factor, and no more. `trust=True` of the loaders, `--trust` of the commands, lifts what the table of
`docs/limits.md` says; the two state the same numbers.
"""

from wlm.errors import WlmError

SETTINGS_BYTES = 64 << 10
"""Of a YAML file: settings have some kilobytes, a path of a thousand positions 40, and the parser is slow."""

INTEGER = 1 << 63
"""Integers of settings are below it, either way: beyond, arrays and counters can't hold them."""

INDEX_BYTES = 64 << 20
"""Of JSON that describes other files: `set.json`, `scene.json`, indices of exports, rows of the bench."""

JSON_BYTES = 512 << 20
"""Of JSON with the numbers themselves: a million probes with 27 numbers, or a glTF tree with its buffers in it."""

BAKE_BYTES = 1 << 30
"""Of a Godot bake: a probe has 156 bytes, and its tetrahedra and BSP tree some hundred."""

MODEL_BYTES = 2 << 30
"""Of an OBJ, PLY, STL or OFF file: ten million vertices of an OBJ have about 1.5 GB."""

MESH_BYTES = (4 << 30) - 1
"""Of a `.glb`, whose format allows no more, and of a buffer or an image beside a glTF file."""

VOLUME_BYTES = 16 << 30
"""Of a `.npz`, `.nvdb` or `.vdb`: 1024^3 voxels in float64 have 8.6 GB, twice that with their temperatures."""

GROWTH = 256
"""Bytes that a compressed byte may become. Zeros become 1,032 under deflate, honest arrays some ten."""

SURE_BYTES = 64 << 20
"""Bytes that compressed data may become however small it is."""

CORNERS_A_BYTE = 8
"""Corners and vertices of a drawn glTF mesh for a byte of the file and its buffers. Without instances it is below 1."""

SURE_CORNERS = 4 << 20
"""The same of a file however small."""

CORNERS = 1 << 28
"""The same of any file."""

PICTURE_SIDE = 65_536
"""Texels along a side of a lightmap's file: EXR, Radiance, KTX2, DDS."""

PICTURE_TEXELS = 1 << 28
"""Texels of one: 16384 x 16384, the largest texture of most GPUs."""

PICTURE_GROWTH = 2048
"""Bytes of pixels, as half floats, that a byte of one may become. Black ones become 950 under ZIP."""

PICTURE_BYTES = 256 << 20
"""The same of one however small it is: 6000 x 6000 black texels under any compression."""

IMAGE_BYTES = 2 << 30
"""Of a PNG or TGA: 16384 x 16384 texels of 8 bytes."""

VIDEO_GROWTH = 4096
"""Bytes of a video's pictures, 6 for a texel, that a byte of it may become: 0.012 bits a texel. One that stands still
takes less."""

VIDEO_BYTES = 256 << 20
"""The same of one however small it is."""

TIMES = 100_000
"""Lightmaps of a set."""

FRAMES = 1 << 30
"""Bytes of a set's lightmaps in memory that they may have however small their files are."""

VOXELS = 1 << 30
"""Voxels of a volume: 1024^3."""

SURE_VOXELS = 1 << 27
"""Voxels that a volume may have however small its file is: 512^3, for a simulation's frames without smoke."""

SURE_BOX = 1 << 24
"""Voxels that the box of a VDB grid may have however small the grid is: 256^3."""

VOXELS_A_BYTE = 64
"""Voxels in the box of a NanoVDB grid for a byte of the grid, or of a `.vdb` for one of the file: 1 of 256 may be
stored."""

RESAMPLED = 8
"""Cubic voxels that a voxel of another shape may become."""

PROBES = 1 << 24
"""Probes of a set."""

NUMBERS = 4096
"""Numbers of a probe: colours of spherical harmonics up to the 36th order. Kernels are compiled for their number."""


def check_sides(where: str, width: int, height: int) -> None:
    """Checks the size that a picture claims.

    Raises:
        WlmError: It has more than `PICTURE_TEXELS`, or more than `PICTURE_SIDE` along a side.
    """
    if max(width, height) > PICTURE_SIDE or width * height > PICTURE_TEXELS:
        raise WlmError(
            f"{where}: expected at most {PICTURE_TEXELS} texels, {PICTURE_SIDE} along a side, found {width} x {height}"
        )


def check_growth(where: str, small: int, large: int, growth: int = GROWTH, sure: int = SURE_BYTES) -> None:
    """Checks what compressed data says that it becomes.

    Args:
        where: The file and the field.
        small, large: Bytes as stored, and as they would become.
        growth: Bytes that a byte may become.
        sure: Bytes that are allowed however few are stored.

    Raises:
        WlmError: It is more.
    """
    if large > max(sure, growth * small):
        raise WlmError(
            f"{where}: expected at most {growth} times its {small} bytes once unpacked, found a size of {large}"
        )
