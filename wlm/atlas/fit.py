"""From a mesh with a lightmap to an atlas model.

The method of the profile, `tiles` or `cascade`, makes a model; a plain smaller lightmap of as many bits replaces it
where that has no larger error.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from wlm import interop
from wlm.atlas import colour
from wlm.atlas.cascade import fit_cascade, group_triangles
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.decode import Decoder
from wlm.atlas.mips import make_tail
from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    COLOUR_BITS,
    SOURCE_BITS,
    AtlasModel,
    Profile,
    check_area,
    tail_bits,
    tail_codec,
)
from wlm.atlas.resize import fitting_size, resized
from wlm.atlas.stages import Stages
from wlm.atlas.tiles import fit_tiles
from wlm.atlas.views import corner_weights
from wlm.atlas.weights import FineGrid, weights
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.hdr_blocks import need
from wlm.metrics import LostLight
from wlm.ops.raster import texture
from wlm.system import OnProgress
from wlm.texels import check_size

_CELLS_AT_ONCE = 1 << 24
_VIEWS_OF_ONE = 4  # of a profile that so many are to one of comparing the model with a plain lightmap
_NO_ROOM = "budget: {:g} of {}x{} texels is less than the smallest tiles and their table take: expected more"
_PACKAGES = {"cascade": "uvunwrap", "astc": "astc_encoder"}  # of the extra, by method and colour


def compress(
    mesh: LightmappedMesh,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    **overrides: Any,
) -> AtlasModel:
    """Compresses the lightmap of a mesh.

    Args:
        mesh: The mesh.
        profile: The settings: a profile's name, a YAML file or a `Profile`.
        seed: Of the random views.
        device: "cpu" or "cuda:N".
        progress: Called as each stage begins, and about twice a second in stages of many steps.
        checkpoint: From `open_checkpoint` for the same settings, or None: where a running compression is kept, and an
            interrupted one resumed.
        overrides: Settings that replace the profile's, by name: `budget=0.1`.

    Returns:
        The model. It is "plain", a smaller lightmap of as many bits, where that has no larger error than the method.
        Its report has "lost light", lines, where texels lost more than half of theirs and PSNR doesn't show it.

    Raises:
        WlmError: No such profile or device, a wrong setting, a missing package, a lightmap that is too large, or a
            budget that the smallest model exceeds.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written in a stage that
            it keeps.
    """
    device = interop.check_device(device)
    profile = Profile.load(profile).override(overrides)
    check_size(*mesh.mask.shape)
    for choice in (profile.method, profile.colour):
        if choice in _PACKAGES:  # said now, and not after minutes
            need(_PACKAGES[choice], "atlas")
    tail, tiles = tail_bits(*mesh.mask.shape), profile.method == "tiles"
    if profile.mips and tiles and tail >= profile.budget * mesh.mask.size * SOURCE_BITS:
        raise WlmError(f"budget: {profile.budget:g} is less than mips take: expected more, or no mips")
    stages, grid = Stages(device, progress, checkpoint), FineGrid(mesh, device)
    if not tiles:
        model = fit_cascade(mesh, group_triangles(mesh, profile, stages), profile, seed, stages)
    else:
        model = fit_tiles(grid, profile, seed, stages)
    if profile.fallback:
        with stages("compare"):
            # Other views than those of the fit, in which its error is less than elsewhere; fewer tell which is larger.
            fewer = profile.model_copy(update={"views": -(-profile.views // _VIEWS_OF_ONE)})
            weight = None if model is None else weights(grid, fewer, seed + 1)
            model = with_fallback(grid, model, profile, weight)
    elif model is None:
        raise WlmError(_NO_ROOM.format(profile.budget, *mesh.mask.shape[::-1]))
    if profile.mips:
        with stages("mips"):
            model = replace(model, tail=make_tail(mesh, tail_codec(model.colour), device))
    check_area(mesh.mask.shape, model.texels.shape[:2], model.lut.shape[:2])
    lost = LostLight()
    inside = torch.from_numpy(mesh.mask).to(device)
    lost.add(torch.from_numpy(mesh.lightmap).to(device)[inside], Decoder(model, device).texels(mesh))
    if warnings := lost.warnings(mesh.name, "texel", "the lightmap"):
        model = replace(model, report=model.report | {"lost light": warnings})
    return replace(model, report=model.report | {"seconds": stages.seconds})


def open_checkpoint(
    output: str | os.PathLike[str],
    mesh: LightmappedMesh,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
    **overrides: Any,
) -> Checkpoint:
    """Opens the checkpoint of a compression, the file `OUTPUT.partial`.

    It keeps what takes long: of tiles the errors of their sizes, of a cascade the groups of triangles and the state of
    the fit. The other stages are done again.

    Args:
        output: The folder that the compression is for.
        mesh, profile, seed, overrides: As for `compress`: what the compression depends on.
        device: Only its kind matters: a compression may go on on another GPU.
        resume: Whether to go on from the file, if there is one.
        every: Seconds between two saves of a running stage; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or of another compression; the line names what differs.
    """
    fit = {
        "input": mesh.source,
        "profile": Profile.load(profile).override(overrides).model_dump(mode="json"),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    # Resolved: the folder's own name may be `.`.
    return Checkpoint(os.path.realpath(output), AtlasModel.SYSTEM, fit, mesh.source, resume=resume, every=every)


def with_fallback(
    grid: FineGrid, model: AtlasModel | None, profile: Profile, weight: torch.Tensor | None
) -> AtlasModel:
    """The model, or a smaller lightmap of at most as many bits whose weighted error is no larger.

    Args:
        grid: The mesh, with its lightmap, and the device.
        model: None: the smaller lightmap has the budget's bits, and a texel, or a block, at least.
        profile: `budget`, `colour` and `mips`.
        weight: float64 [2 H, 2 W], how much each cell counts; of a model alone.
    """
    mesh, device = grid.mesh, grid.device
    height, width = mesh.mask.shape
    # The model has no mips yet.
    mips = tail_bits(height, width) / (height * width * SOURCE_BITS) if profile.mips else 0.0
    share = profile.budget - mips if model is None else 1.0 - model.compression_ratio
    format = BLOCKS if profile.colour == "mixed" else profile.colour
    block = BLOCK_SIDE if format in colour.BLOCK_CODECS else 1
    bits = COLOUR_BITS[format]
    size = fitting_size(height, width, share * height * width * SOURCE_BITS, (block, block), bits)
    if size is None:
        if model is not None:
            return model
        size = 1, 1
    textures = colour.quantise(resized(mesh.filled, mesh.mask, *size, device=device), format, device=device)
    plain = AtlasModel(mesh.name, mesh.source, profile, "plain", format, height, width, **textures)
    if model is None:
        return replace(plain, report={"why plain": "tiles do not fit the budget"})
    image, decoders = torch.from_numpy(mesh.filled).to(device), [Decoder(each, device) for each in (model, plain)]
    errors = torch.zeros(2, dtype=torch.float64)
    for points, share in cell_centres(grid, weight):
        target = texture(image, points[0])
        for i, decoder in enumerate(decoders):
            errors[i] += float(((decoder(*points) - target).double().square().sum(1) * share).sum())
    error, plain_error = errors.tolist()
    ratio = {"error against a plain lightmap of as many bits": error / plain_error if plain_error else None}
    if error < plain_error:
        return replace(model, report=model.report | ratio)
    return replace(plain, report=ratio | {"why plain": f"its error is no larger than that of {model.method}"})


def cell_centres(
    grid: FineGrid, weight: torch.Tensor
) -> Iterator[tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]]:
    """Centres of cells that are in a triangle, as a decoder takes them, and their weights; some rows at a time.

    Where no triangle holds a centre, being too small, the cells with a weight stand for their triangles.
    """
    held = bool((grid.triangle[0] >= 0).any())
    rows = max(1, _CELLS_AT_ONCE // grid.width)
    pieces = (values.split(rows) for values in (*grid.triangle, weight))
    for number, (triangle, barycentric, share) in enumerate(zip(*pieces, strict=True)):
        hit = triangle >= 0 if held else share > 0
        row, column = torch.nonzero(hit, as_tuple=True)
        uv = torch.stack([(column + 0.5) / grid.width, (row + number * rows + 0.5) / grid.height], 1).float()
        triangle = torch.where(triangle < 0, int(np.flatnonzero(grid.mesh.active)[0]), triangle)
        yield (uv, triangle[hit], corner_weights(barycentric[hit])), share[hit]
