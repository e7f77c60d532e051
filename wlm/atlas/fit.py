"""Compresses the lightmaps of a scene to an atlas model.

One lightmap is compressed by the method of the profile, `tiles` or `cascade`; a plain smaller lightmap of as many bits
replaces the model if its error is no larger. Several lightmaps, of several sheets or states, share tiles (`shared`).
"""

import functools
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from wlm.atlas import colour
from wlm.atlas.cascade.fit import fit_cascade, group_triangles
from wlm.atlas.data import LightmappedScene
from wlm.atlas.decode import Decoder
from wlm.atlas.model import BLOCK_SIDE, BLOCKS, COLOUR_BITS, SOURCE_BITS, AtlasModel, Profile, SheetPlace, check_area
from wlm.atlas.resize import fitting_size, resized
from wlm.atlas.shared.fit import fit_shared
from wlm.atlas.stages import Stages
from wlm.atlas.stored import store
from wlm.atlas.tiles.fit import fit_tiles
from wlm.atlas.views import Points, corner_weights
from wlm.atlas.weights import FineGrid, weights
from wlm.dispatch import Place
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import check_sides
from wlm.interop import one_thread
from wlm.metrics import LostLight
from wlm.ops.raster import texture
from wlm.system import OnProgress

_CELLS_AT_ONCE = 1 << 24
_FEWER_VIEWS = 4  # one view of the comparison with a plain lightmap per this number of the profile's views
_NO_ROOM = "budget: {:g} of the bits of {}x{} texels is less than the smallest tiles and lookup texture take; give more"


def compress(
    scene: LightmappedScene,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    workers: int | None = None,
    cluster: str | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    **settings: Any,
) -> AtlasModel:
    """Compresses the lightmaps of a scene.

    Args:
        scene: The scene.
        profile: The settings: a profile's name, a YAML file or a `Profile`.
        seed: Seed of random choices, such as views.
        device: "cpu" or "cuda:N".
        workers, cluster: Where tiles that lightmaps share are tried side by side, with the same result: see
            `wlm.dispatch.Place`.
        progress: Called as each stage begins, and about twice a second in stages of many steps.
        checkpoint: From `open_checkpoint` for the same settings, or None: keeps a running compression, so that an
            interrupted one can be resumed.
        settings: Settings that replace the profile's, by name: `budget=0.1`.

    Returns:
        The model. For one lightmap it is "plain", a smaller lightmap of as many bits, if that has no larger error. Its
        report has lines under "lost light" if texels lost more than half of their light and PSNR doesn't show it.

    Raises:
        WlmError: No such profile or device, a wrong setting, a missing package, a lightmap that is too large, or a
            budget that the smallest model exceeds.
        KeyboardInterrupt: Raised by `progress`, after the finished work of long stages has been written to the
            checkpoint, if there is one; other stages run again on resuming.
    """
    place = Place(device, workers, cluster)
    device = place.here
    profile, method = Profile.load(profile).override(settings).checked(len(scene.sheets) * len(scene.states))
    for sheet in scene.sheets:
        check_sides("size", *sheet.mask.shape[::-1])
    if method == "cascade":
        need("uvunwrap", "atlas")  # if it is missing, this is reported now, not after minutes
    stages = Stages(device, progress, checkpoint)
    stages.place = place
    try:
        with one_thread(device):
            grid = FineGrid(scene.sheets[0], device) if method != "shared" else None
            fit = functools.partial(_fit_one, method, grid) if grid else fit_shared
            model = fit(scene, profile, seed, stages)
    except KeyboardInterrupt:
        if checkpoint is not None:
            checkpoint.flush()  # finished batches that are not written yet
        raise
    for place in model.rows:
        texels = model.texels.size + model.block_texels.size
        check_area(place.size, texels // 3, model.lut[..., 0].size)
    report = model.report | {"seconds": stages.seconds}
    if lines := _lost_light(scene, model, device, grid):
        report["lost light"] = lines
    return replace(model, stored=store(scene), report=report)


def open_checkpoint(
    output: str | os.PathLike[str],
    scene: LightmappedScene,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
    **settings: Any,
) -> Checkpoint:
    """Opens the checkpoint of a compression, the file `OUTPUT.partial`.

    Args:
        output: The file that the compression is for.
        scene, profile, seed, settings: As for `compress`.
        device: Only its kind matters: a compression may resume on another GPU.
        resume: Whether to go on from the file, if there is one.
        every: Seconds between two saves of a running stage; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or belongs to another compression; the line names what differs.
    """
    fit = {
        "input": scene.source,
        "profile": Profile.load(profile).override(settings).model_dump(mode="json"),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(os.path.realpath(output), AtlasModel.SYSTEM, fit, scene.source, resume=resume, every=every)


def _fit_one(
    method: str, grid: FineGrid, scene: LightmappedScene, profile: Profile, seed: int, stages: Stages
) -> AtlasModel:
    """Compresses one lightmap by `tiles` or `cascade`, or by a plain smaller lightmap if that is no worse."""
    (sheet,) = scene.sheets
    if method == "tiles":
        model = fit_tiles(scene, grid, profile, seed, stages)
    else:
        model = fit_cascade(scene, group_triangles(sheet, profile, stages), profile, seed, stages)
    if profile.fallback:
        with stages("compare"):
            # These views differ from the fit's, where the error is smaller than elsewhere; fewer are enough to compare.
            fewer = profile.model_copy(update={"views": -(-profile.views // _FEWER_VIEWS)})
            weight = None if model is None else weights(scene, grid, fewer, seed + 1)
            model = with_fallback(scene, grid, model, profile, weight)
    elif model is None:
        raise WlmError(_NO_ROOM.format(profile.budget, *sheet.mask.shape[::-1]))
    return model


def _lost_light(scene: LightmappedScene, model: AtlasModel, device: str, grid: FineGrid | None) -> list[str]:
    """Makes lines of text about texels that lost more than half of their light where PSNR doesn't show it. `grid` has
    the only lightmap on the device; None if there are several."""
    lost, decoder = LostLight(), Decoder(model, device)
    for number, sheet in enumerate(scene.sheets):
        inside = torch.from_numpy(sheet.mask).to(device)
        for state, lightmap in enumerate(sheet.lightmaps):
            light = grid.light if grid else torch.from_numpy(lightmap).to(device)
            lost.add(light[inside], decoder.texels(sheet, number, state))
    return lost.warnings(scene.name, "texel", "the lightmap" if scene.texels == sheet.mask.size else "the lightmaps")


def with_fallback(
    scene: LightmappedScene, grid: FineGrid, model: AtlasModel | None, profile: Profile, weight: torch.Tensor | None
) -> AtlasModel:
    """Returns the model, or a plain smaller lightmap if that has at most the model's bits and no larger weighted error.
    `weight`, float64 [2 H, 2 W], has the weights of errors in quarters of texels (cells). Without a model the smaller
    lightmap has as many bits as `profile.budget` allows, but at least one texel or block."""
    (sheet,), device = scene.sheets, grid.device
    height, width = sheet.mask.shape
    bits = profile.budget * sheet.mask.size * SOURCE_BITS if model is None else model.bits
    format = BLOCKS if profile.colour == "mixed" else profile.colour
    block = BLOCK_SIDE if format in colour.BLOCK_CODECS else 1
    size = fitting_size(height, width, bits, (block, block), COLOUR_BITS[format])
    if size is None and model is not None:
        return model
    textures = colour.quantised(resized(grid.light, grid.mask, *(size or (1, 1)), device=device), format, None, device)
    report: dict[str, Any] = {"why plain": "tiles do not fit the budget"}
    if model is not None:
        decoder, small = Decoder(model, device), textures["texels"].float()
        errors = torch.zeros(2, dtype=torch.float64)
        for points, share in _cell_centres(grid, weight):
            target = texture(grid.light, points.uv)
            for i, light in enumerate((decoder(points), texture(small, points.uv))):
                errors[i] += float(((light - target).double().square().sum(1) * share).sum())
        error, plain_error = errors.tolist()
        report = {"error against a plain lightmap of as many bits": error / plain_error if plain_error else None}
        if error < plain_error:
            return replace(model, report=model.report | report)
        report["why plain"] = f"its error is no larger than that of {model.method}"
    settings = (scene.name, scene.source, profile, "plain", format, scene.states)
    parts = {name: each[None].cpu().numpy() for name, each in textures.items()}
    return AtlasModel(*settings, (SheetPlace(sheet.name, height, width),), **parts, report=report)


def _cell_centres(grid: FineGrid, weight: torch.Tensor) -> Iterator[tuple[Points, torch.Tensor]]:
    """Yields, some rows at a time, the centres of those quarters of texels (cells) that are in a triangle, and their
    weights. If all triangles are so small that none contains a centre, the cells with a weight are used instead."""
    any_held = bool((grid.triangle[0] >= 0).any())
    rows = max(1, _CELLS_AT_ONCE // grid.width)
    pieces = (values.split(rows) for values in (*grid.triangle, weight))
    for number, (triangle, barycentric, share) in enumerate(zip(*pieces, strict=True)):
        hit = triangle >= 0 if any_held else share > 0
        row, column = torch.nonzero(hit, as_tuple=True)
        uv = torch.stack([(column + 0.5) / grid.width, (row + number * rows + 0.5) / grid.height], 1).float()
        triangle = torch.where(triangle < 0, int(np.flatnonzero(grid.sheet.active)[0]), triangle)
        sheet = torch.zeros(len(uv), dtype=torch.int32, device=uv.device)
        yield Points(uv, sheet, triangle[hit], corner_weights(barycentric[hit])), share[hit]
