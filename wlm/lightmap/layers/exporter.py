"""Layered models for engines: each sheet as `wlm.lightmap.exporter` writes it, in a folder of its own, and an index."""

import os
import re
from pathlib import Path

from wlm.errors import WlmError
from wlm.formats.folder import UNFINISHED, claim, made_parents, read_index, write_index
from wlm.formats.lock import locked
from wlm.lightmap import exporter
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import ENCODINGS

FORMAT = "wlm-lightmap-layers-export"
INDEX_FILE = "sheets.json"
_VERSION = 1
_SHEET = re.compile(r"sheet_\d{2,}")

_ABOUT = (
    "Each sheet is a folder with a weights.json that says how to decode it: up to three channels of a layer of an "
    "atlas, in the order of red, green and blue; further ones repeat the last. radiance: linear light. unit and "
    "signed: values between least and greatest, decoded without gamma."
)


def export(
    model: LayeredModel,
    directory: str | os.PathLike[str],
    *,
    device: str = "cpu",
    shader: str = "glsl",
    exact: bool = False,
) -> list[Path]:
    """Writes a model's sheets as textures, weights and shaders, in folders `sheet_00` and so on, and `sheets.json`.

    An earlier export is replaced, and sheets that are no longer there are removed; other files stay. Where it is
    stopped half-way, `sheets.json` says so.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        device: Where the frames to compare with are decoded.
        shader, exact: As of `wlm.lightmap.exporter.export`.

    Returns:
        The files written.

    Raises:
        WlmError: As `wlm.lightmap.exporter.export`.
    """
    folder = Path(directory)
    written, sheets = [], []
    with made_parents(folder), locked(folder):
        claim(folder, INDEX_FILE, FORMAT)
        try:
            folder.mkdir(exist_ok=True)
            write_index(folder / INDEX_FILE, {"format": FORMAT, UNFINISHED: True})
            for number, (sheet, own) in enumerate(model.sheets.items()):
                name = f"sheet_{number:02d}"
                values = ENCODINGS[sheet.encoding] if sheet.linear else None
                written += exporter.export(own, folder / name, device=device, values=values, shader=shader, exact=exact)
                sheets.append(
                    {
                        "folder": name,
                        "atlas": sheet.atlas,
                        "layer": sheet.layer,
                        "channels": list(sheet.channels),
                        "encoding": sheet.encoding,
                        "width": own.width,
                        "height": own.height,
                    }
                    | ({} if values is None else {"least": values[0], "greatest": values[1]})
                )
            _remove_others(folder, {sheet["folder"] for sheet in sheets})
        except OSError as error:
            raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
        index = {
            "format": FORMAT,
            "version": _VERSION,
            "about": _ABOUT,
            "name": model.name,
            "source": model.source,
            "times": model.times.tolist(),
            "period": model.period,
            "sheets": sheets,
        }
        write_index(folder / INDEX_FILE, index)
    return [*written, folder / INDEX_FILE]


def _remove_others(folder: Path, names: set[str]) -> None:
    """Removes sheets of an earlier export, but for files in them that are none of it."""
    for path in folder.iterdir():
        if path.name in names or not _SHEET.fullmatch(path.name):
            continue
        if read_index(path / exporter.WEIGHTS_FILE).get("format") != exporter.FORMAT:
            continue
        for file in path.iterdir():
            if exporter.is_exported(file.name):
                file.unlink()
        if not any(path.iterdir()):
            path.rmdir()
