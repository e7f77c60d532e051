"""`wlm bake`: makes lightmaps and probes of a scene by path tracing."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import begin, exclusive, note, note_start, quiet_warp, running, show, table
from wlm.cli.options import PlaceOptions, Resume, Trust, output_option, with_options

app = typer.Typer(help="Make inputs by path tracing: lightmaps and probes, by Mitsuba (extra `bake`).")

_Scene = Annotated[
    Path,
    typer.Argument(
        metavar="SCENE.yaml", help="YAML file of the scene: its glTF file, its lights by hour, and the resolution."
    ),
]


@app.command()
@with_options
@exclusive
def lightmaps(
    scene: _Scene,
    output: Annotated[Path, output_option("DIR", "Folder to write the set to.")],
    place: PlaceOptions,
    resume: Resume = False,
    trust: Trust = False,
) -> None:
    """Bake a lightmap for each hour into a set for wlm compress.

    Finished hours are kept in DIR.partial; repeat the command with --resume to continue with the next hour.
    """
    quiet_warp()
    from wlm.bake.lightmaps import FORMAT, INDEX, bake_lightmaps, write_lightmaps
    from wlm.bake.work import open_checkpoint, open_task
    from wlm.formats.folder import claim

    claim(output, INDEX, FORMAT)
    task = open_task(scene, trust)
    checkpoint = open_checkpoint(output, task, "lightmaps", place.device, resume=resume)
    note_start(checkpoint, resume, "from the beginning")
    with running("bake", checkpoint.path, "percent", whole=False) as progress:
        baked = bake_lightmaps(task, **asdict(place), checkpoint=checkpoint, progress=progress)
        files = write_lightmaps(output, task, baked)
        checkpoint.remove()
    rows = table(str(output), ["hour", "mean irradiance", "largest", "relative noise"])
    for hour, light, error in zip(baked.hours, baked.light, baked.error, strict=True):
        seen = light[baked.mask].astype("float32")
        rows.add_row(f"{hour:g}", f"{seen.mean():.4g}", f"{seen.max():.4g}", f"{error:.2%}")
    show(rows)
    height, width = baked.mask.shape
    note(f"{len(files)} files of {width}x{height} texels, {baked.mask.mean():.0%} of them in charts")


@app.command()
@with_options
@exclusive
def probes(
    scene: _Scene,
    output: Annotated[Path, output_option("OUT.npz", "The file to write.")],
    place: PlaceOptions,
    resume: Resume = False,
    trust: Trust = False,
) -> None:
    """Bake SH probes for each hour into a file for wlm compress.

    Finished hours are kept in OUT.npz.partial; repeat the command with --resume to continue with the next hour.
    """
    begin(output, ".npz")
    from wlm.bake.probes import bake_probes, write_probes
    from wlm.bake.work import open_checkpoint, open_task

    task = open_task(scene, trust)
    checkpoint = open_checkpoint(output, task, "probes", place.device, resume=resume)
    note_start(checkpoint, resume, "from the beginning")
    with running("bake", checkpoint.path, "percent", whole=False) as progress:
        baked = bake_probes(task, **asdict(place), checkpoint=checkpoint, progress=progress)
        write_probes(output, baked)
        checkpoint.remove()
    rows = table(str(output), ["hour", "probes", "lit probes", "mean ambient light", "relative noise"])
    for hour, values, error in zip(baked.hours, baked.values, baked.error, strict=True):
        lit = values.any(axis=(1, 2))
        mean = f"{values[lit, 0].mean():.4g}" if lit.any() else "–"
        rows.add_row(f"{hour:g}", f"{len(values):,}", f"{int(lit.sum()):,}", mean, f"{error:.2%}")
    show(rows)
