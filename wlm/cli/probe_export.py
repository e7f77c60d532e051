"""`wlm probe export`: light probes for engines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from wlm.cli.console import escape, quiet_warp, show, table
from wlm.cli.options import Device, ModelFile, ShaderLanguage, output_option, shader_of
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.probe import ProbeModel


def register(app: typer.Typer) -> None:
    """Adds the command to `wlm probe`."""
    app.command()(export)


def export(
    file: ModelFile,
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    engine: Annotated[
        Literal["raw", "three", "godot", "unity", "unreal"],
        typer.Option(
            help="Whose folder: for three.js, Godot and Unreal light on a lattice, for Godot and Unity the probes "
            "themselves too; raw is buffers and a shader that reads them, for any."
        ),
    ] = "raw",
    original: Annotated[
        Path | None,
        typer.Option(
            metavar="PROBES",
            help="The probes that were compressed, where FILE.wlm has no positions; for Godot their bake, to keep the "
            "rest of it.",
        ),
    ] = None,
    cells: Annotated[
        int | None, typer.Option(help="Of a lattice, along the longest side of the probes' box; default 24.")
    ] = None,
    mirror: Annotated[
        Literal["x", "y", "z"] | None,
        typer.Option(help="For Unity, which is left-handed: the axis to turn round; default none."),
    ] = None,
    shader: ShaderLanguage = None,
    device: Device = "cpu",
) -> None:
    """Write the light for an engine, as files that it takes as they are.

    Of raw, reference.json is the light at some positions: what the shader should make of the rest.
    """
    if cells is not None and engine not in ("three", "godot", "unreal"):
        raise WlmError("--cells: means nothing without --engine three, godot or unreal")
    if mirror is not None and engine != "unity":
        raise WlmError("--mirror: means nothing without --engine unity")
    language = shader_of(engine, shader)
    quiet_warp()
    from wlm.export import export as export_files
    from wlm.system import load

    model = load(file, "probe")
    given = {name: value for name, value in (("cells", cells), ("mirror", mirror), ("original", original))}
    given = {name: value for name, value in given.items() if value is not None}
    engine_or_raw = None if engine == "raw" else engine
    paths = export_files(model, output, engine_or_raw, shader=language, device=device, **given)
    rows = table(str(output), ["file", "bytes"])
    for path in paths:
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


def given_positions(model: "ProbeModel", original: Path | None) -> "np.ndarray | None":
    """Returns the positions of the model's own probes in another file, or None."""
    return None if original is None else own_positions(model, original)


def own_positions(model: "ProbeModel", original: Path) -> "np.ndarray":
    """Reads the positions of the model's own probes from another file."""
    from wlm.probe import load_positions

    position = load_positions(original)
    if not model.has_probes_at(position):
        raise WlmError(f"{original}: expected the {model.probes} probes of {model.name}, in their order")
    return position
