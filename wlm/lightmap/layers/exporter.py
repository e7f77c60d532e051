"""Layered models for engines: each sheet as `wlm.lightmap.exporter` writes it, in a folder of its own, and an index."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.folder import UNFINISHED, claim, made_parents, read_index, write_index
from wlm.formats.lock import locked
from wlm.lightmap import exporter
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import ENCODINGS, Sheet

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

    def write(sheet: Sheet, place: Path) -> list[Path]:
        options = {"device": device, "values": _values(sheet), "shader": shader, "exact": exact}
        return exporter.export(model.sheets[sheet], place, **options)

    kind = SheetFolders(FORMAT, _ABOUT, exporter.FORMAT, exporter.is_exported)
    return export_sheets(model, Path(directory), list(model.sheets), kind, write)


@dataclass(frozen=True)
class SheetFolders:
    """What an export of sheets is.

    Attributes:
        form: `format` of its index.
        about: What its index says of it.
        sheet_form: `format` of a sheet's `weights.json`.
        is_exported: Whether a file of a sheet's folder is one of the export, by its name.
        shared: By name the files of an export of the kind that lie beside its index; None: this one has none.
    """

    form: str
    about: str
    sheet_form: str
    is_exported: Callable[[str], bool]
    shared: Mapping[str, str | None] = field(default_factory=dict)


def export_sheets(
    model: LayeredModel,
    folder: Path,
    chosen: Sequence[Sheet],
    kind: SheetFolders,
    write: Callable[[Sheet, Path], list[Path]],
) -> list[Path]:
    """Writes sheets, each into a folder of its own, and `sheets.json`; an earlier export of the kind is replaced.

    Args:
        model: The model.
        folder: The folder; made if it isn't there.
        chosen: The sheets; a folder's number is that of its sheet in the model.
        kind: What the export is.
        write: Writes a sheet into a folder; gives the files.

    Returns:
        The files written, the index last.

    Raises:
        WlmError: The folder holds something else, or can't be written; as `write`.
    """
    written, sheets = [], []
    with made_parents(folder), locked(folder):
        claim(folder, INDEX_FILE, kind.form)
        try:
            folder.mkdir(exist_ok=True)
            write_index(folder / INDEX_FILE, {"format": kind.form, UNFINISHED: True})
            for number, (sheet, own) in enumerate(model.sheets.items()):
                if sheet not in chosen:
                    continue
                name, values = f"sheet_{number:02d}", _values(sheet)
                written += write(sheet, folder / name)
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
            _remove_others(folder, {sheet["folder"] for sheet in sheets}, kind)
            for name, text in kind.shared.items():
                if text is None:
                    (folder / name).unlink(missing_ok=True)
                else:
                    atomic_write(folder / name, text.encode())
                    written.append(folder / name)
        except OSError as error:
            raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
        index = {
            "format": kind.form,
            "version": _VERSION,
            "about": kind.about,
            "name": model.name,
            "source": model.source,
            "times": model.times.tolist(),
            "period": model.period,
            "sheets": sheets,
        }
        write_index(folder / INDEX_FILE, index)
    return [*written, folder / INDEX_FILE]


def _values(sheet: Sheet) -> tuple[float, float] | None:
    """What the levels 0 and 1 stand for; None: the sheet is of light."""
    return ENCODINGS[sheet.encoding] if sheet.linear else None


def _remove_others(folder: Path, names: set[str], kind: SheetFolders) -> None:
    """Removes sheets of an earlier export, but for files in them that are none of it."""
    for path in folder.iterdir():
        if path.name in names or not _SHEET.fullmatch(path.name):
            continue
        if read_index(path / exporter.WEIGHTS_FILE).get("format") != kind.sheet_form:
            continue
        for file in path.iterdir():
            if kind.is_exported(file.name):
                file.unlink()
        if not any(path.iterdir()):
            path.rmdir()
