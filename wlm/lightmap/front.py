"""The front door: the verbs of `wlm.lightmap`, for sets of one lightmap and for layered ones alike."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.lightmap import data, evaluation, exporter, fit
from wlm.lightmap.contest import is_contest
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.evaluation import Report
from wlm.lightmap.layers import data as layers_data
from wlm.lightmap.layers import evaluation as layers_evaluation
from wlm.lightmap.layers import exporter as layers_exporter
from wlm.lightmap.layers import fit as layers_fit
from wlm.lightmap.layers.data import LayeredSet
from wlm.lightmap.layers.evaluation import LayeredReport
from wlm.lightmap.layers.listing import is_layered
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import Sheet
from wlm.lightmap.model import LightmapModel, Profile


def load(
    path: str | os.PathLike[str],
    *,
    times: Sequence[float] | None = None,
    mask: str | os.PathLike[str] | None = None,
    period: float | None = None,
    trust: bool = False,
    map_id: str | None = None,
    layers: Sequence[str] | None = None,
) -> LightmapSet | LayeredSet:
    """Reads a set: as `wlm.lightmap.data.load`, or a layered one as `wlm.lightmap.layers.data.load`.

    A set is layered where its `set.json` has `layers`, and where there is none and a folder, or folders in it, have
    files as Unity names them, `Lightmap-0_comp_light.exr`.

    Args:
        path: The `set.json` or the folder.
        times: One time for each lightmap or state, in place of those of the set.
        mask: A PNG, "alpha" or "all"; None takes what the set says.
        period: Length of the day in the unit of the times.
        trust: Whether a `set.json` may name files outside its folder, and small files may hold large frames.
        map_id: Which lightmap of a contest's folder.
        layers: Which layers of a layered set; None: all.

    Raises:
        WlmError: One line that names the file and the field.
    """
    path = Path(path)
    options = {"times": times, "mask": mask, "period": period, "trust": trust}
    if map_id is not None or (path.is_dir() and is_contest(path)) or not is_layered(path):
        if layers is not None:
            raise WlmError(f"{path}: expected a set with layers to choose some of")
        return data.load(path, map_id=map_id, **options)
    return layers_data.load(path, layers=layers, **options)


def load_light(path: str | os.PathLike[str], sheet: Sheet | None = None) -> LightmapSet:
    """Reads a set for what shows three channels: of a layered one a sheet.

    Args:
        path: As for `load`.
        sheet: Which; None: the first of light, or the first.

    Raises:
        WlmError: As `load`, or it has no such sheet.
    """
    lightmaps = load(path)
    if not isinstance(lightmaps, LayeredSet):
        return lightmaps
    sheets = lightmaps.sheets
    if sheet is None:
        return next((own for one, own in sheets.items() if not one.linear), next(iter(sheets.values())))
    if sheet not in sheets:
        raise WlmError(f"{path}: expected a set with {sheet.label}, found {', '.join(one.label for one in sheets)}")
    return sheets[sheet]


def compress(
    lightmaps: LightmapSet | LayeredSet, profile: str | os.PathLike[str] | Profile = "M", **options: Any
) -> LightmapModel | LayeredModel:
    """Compresses a set.

    Args:
        lightmaps: The set.
        profile: The settings: a name, the path of a YAML file, or a `Profile`.
        options: As for `wlm.lightmap.fit.compress`: `seed`, `device`, `workers`, `cluster`, `progress`, `checkpoint`,
            and settings in place of the profile's; of a set that isn't layered also `tiles`.

    Raises:
        WlmError, KeyboardInterrupt: As there.
    """
    return (layers_fit if isinstance(lightmaps, LayeredSet) else fit).compress(lightmaps, profile, **options)


def open_checkpoint(
    output: str | os.PathLike[str],
    lightmaps: LightmapSet | LayeredSet,
    profile: str | os.PathLike[str] | Profile = "M",
    **options: Any,
) -> Checkpoint:
    """Opens the checkpoint of a fit, see `wlm.lightmap.fit.open_checkpoint`."""
    verbs = layers_fit if isinstance(lightmaps, LayeredSet) else fit
    return verbs.open_checkpoint(output, lightmaps, profile, **options)


def evaluate(
    model: LightmapModel | LayeredModel, lightmaps: LightmapSet | LayeredSet, **options: Any
) -> Report | LayeredReport:
    """Decodes every stored time, and times between them, from the stored bytes and compares them with the input.

    Args:
        model: The model.
        lightmaps: The input, layered if the model is.
        options: As for `wlm.lightmap.evaluation.evaluate`: `device`, `metrics`, `views`, `progress`, `file_bytes`.

    Raises:
        WlmError: As there; or one of both is layered and the other isn't.
    """
    layered = isinstance(model, LayeredModel)
    if layered != isinstance(lightmaps, LayeredSet):
        found = "has layers, but this set has none" if layered else "has no layers, but this set has some"
        raise WlmError(f"{lightmaps.name}: the file {model.name} {found}")
    return (layers_evaluation if layered else evaluation).evaluate(model, lightmaps, **options)


def export(
    model: LightmapModel | LayeredModel,
    directory: str | os.PathLike[str],
    *,
    device: str = "cpu",
    shader: str = "glsl",
    exact: bool = False,
) -> list[Path]:
    """Writes a model as textures, weights and shaders, see `wlm.lightmap.exporter` and `wlm.lightmap.layers.exporter`.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        device: Where the frames to compare with are decoded.
        shader: Its language, one of `wlm.export.shading.LANGUAGES`.
        exact: The shader fetches texels and mixes them in floats, rather than to have them filtered.

    Returns:
        The files written.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; no such device or
            language; or a number of the model isn't finite.
    """
    verbs = layers_exporter if isinstance(model, LayeredModel) else exporter
    return verbs.export(model, directory, device=device, shader=shader, exact=exact)
