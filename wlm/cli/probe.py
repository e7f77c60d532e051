"""`wlm probe`: compress light probes, decode them anywhere, score them, walk through them, export them."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    escape,
    exclusive,
    note,
    note_start,
    number,
    quiet_warp,
    running,
    show,
    show_json,
    table,
    write_json,
)
from wlm.cli.options import (
    AsJson,
    CheckpointEveryIfKept,
    Device,
    ModelFile,
    PageFile,
    ReportFile,
    Resume,
    Seed,
    output_option,
    seconds_between,
)
from wlm.cli.probe_export import given_positions
from wlm.cli.probe_export import register as register_export
from wlm.cli.probe_volume import register, score_seen, show_seen, show_walk_scores, walk_scores

if TYPE_CHECKING:
    import numpy as np

    from wlm.probe import ProbeModel, ProbeSet, Report

app = typer.Typer(
    help="Light probes: 3D Gaussians and a small network, or principal components; a cascaded volume of both."
)

_Key = Annotated[str | None, typer.Option(help="Name of the values in PROBES; default the only ones.")]
_Convention = Annotated[
    str | None, typer.Option(help="Of the numbers: threejs, godot, unreal or unity; default as PROBES says.")
]

_Probes = Annotated[
    Path, typer.Argument(metavar="PROBES", help="Probe file: .npz, .json, Godot's .lmbake or Unity's .asset.")
]

_Original = Annotated[
    Path | None,
    typer.Option(metavar="PROBES", help="The probes that were compressed, if the file stores no positions."),
]


@app.command()
@exclusive
def compress(
    probes_path: _Probes,
    output: Annotated[Path, output_option("OUT.wlm", "The file to write.")],
    profile: Annotated[
        str, typer.Option(help="standard, compact, small, paper, pca, or a YAML file of settings.")
    ] = "standard",
    ratio: Annotated[float | None, typer.Option(help="Number of Gaussians as a share of the live probes.")] = None,
    latent: Annotated[int | None, typer.Option(help="Length of the latent vector of a Gaussian.")] = None,
    steps: Annotated[int | None, typer.Option(help="Number of training steps.")] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    resume: Resume = False,
    checkpoint_every: CheckpointEveryIfKept = None,
    positions: Annotated[
        bool, typer.Option("--positions", help="Also store the positions of the probes, 16 bits per axis.")
    ] = False,
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compress light probes into one file: Gaussians and a small network, or principal components for small sets.

    The fit is saved in OUT.wlm.partial from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume to
    continue exactly.
    """
    check_output(output, ".wlm")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.probe import Profile, compress, open_checkpoint

    settings = Profile.load(profile).override({"ratio": ratio, "latent": latent, "steps": steps}, "--")
    device = check_device(device)
    probes = _load(probes_path, key, convention)
    options = {"seed": seed, "device": device}
    every = seconds_between(checkpoint_every)
    checkpoint = open_checkpoint(output, probes, settings, resume=resume, every=every, **options)
    note_start(checkpoint, resume, "at step 0")
    start = time.perf_counter()
    with running("fit", checkpoint.path) as progress:
        model = compress(probes, settings, progress=progress, checkpoint=checkpoint, positions=positions, **options)
        seconds = time.perf_counter() - start
        size = model.save(output)
        checkpoint.remove()
    cells = {
        "file": escape(str(output)),
        "bytes": f"{size:,}",
        "of float32": f"{size / probes.float_bytes:.2%}",
        "bits per probe": f"{size * 8 / probes.probes:.2f}",
        "GPU bytes": f"{model.content.nbytes:,}",
    }
    cells |= {name: str(value) for name, value in model.content.facts().items()}
    cells["seconds"] = f"{seconds:.1f}"
    rows = table(model.name, list(cells))
    rows.add_row(*cells.values())
    show(rows)
    note(model.choice)


@app.command()
def decode(
    file: ModelFile,
    output: Annotated[Path, output_option("OUT", "The .npz or .json file to write.")],
    positions: Annotated[
        Path | None,
        typer.Option(metavar="PROBES", help="Where: a .npz, .json or .lmbake file, of which `position` is taken."),
    ] = None,
    convention: Annotated[str, typer.Option(help="Of the numbers: threejs, godot, unreal or unity.")] = "threejs",
    original: _Original = None,
    device: Device = "cpu",
) -> None:
    """Decode the light at the stored positions, or at any others.

    Positions as many as the file has probes, and in the same box, are taken for those probes in their order: the dead
    ones among them decode to zero. Anywhere else there is no telling who is dead.
    """
    check_output(output, ".npz", ".json")
    quiet_warp()
    from wlm.probe import save_probes
    from wlm.system import load

    model = load(file, "probe")
    position, at_probes = _positions(model, positions)
    decoder = model.decoder(device, position=position if at_probes else given_positions(model, original))
    values = decoder.decode_probes() if at_probes else decoder.decode(position)
    save_probes(output, position, values, convention=convention)
    rows = table(str(file), ["file", "positions", "of", "zero", "mean", "largest"], text=["of"])
    rows.add_row(
        escape(str(output)),
        f"{len(position):,}",
        "its probes" if at_probes else "other points",
        f"{int(model.dead.sum()) if at_probes else 0:,}",
        f"{values.mean():.4g}",
        f"{values.max():.4g}",
    )
    show(rows)


@app.command()
def evaluate(
    file: ModelFile,
    probes_path: _Probes,
    json_path: ReportFile = None,
    html_path: PageFile = None,
    volume: Annotated[
        bool, typer.Option("--volume", help="Score what is read through the cascaded volume along a walk.")
    ] = False,
    views: Annotated[int, typer.Option(help="Score so many pictures of balls and of --mesh under the light.")] = 0,
    mesh: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The scene, .glb, .gltf or .obj, for the pictures.")
    ] = None,
    hold_out: Annotated[
        bool, typer.Option("--hold-out", help="Fit four fifths of the probes again, and score the light at the others.")
    ] = False,
    device: Device = "cpu",
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compare the decoded probes with the input: PSNR of coefficients and of irradiance, and bits per probe."""
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.probe import evaluate
    from wlm.system import load

    model = load(file, "probe")
    probes = _load(probes_path, key, convention)
    with running("evaluate") as progress:
        size = file.stat().st_size
        report = evaluate(model, probes, device=device, progress=progress, file_bytes=size, hold_out=hold_out)
    if not probes.source.startswith(model.source):
        note(f"warning: {probes_path}: not what {file} was made of; another key, convention or file?")
    if html_path is not None:
        from wlm.view.reports import probe_report

        probe_report(html_path, model, probes, report)
    seen = score_seen(model, probes, views, mesh, device) if views or mesh is not None else []
    walked = walk_scores(model, probes, device) if volume else {}
    if json_path is not None:
        content = report.to_json() | ({"volume": walked} if walked else {})
        write_json(json_path, content | ({"views": [score.to_json() for score in seen]} if seen else {}))
    _show_report(file, model.profile.name, report)
    show_walk_scores(walked)
    show_seen(seen)


@app.command()
def info(file: ModelFile, as_json: AsJson = False, device: Device = "cpu") -> None:
    """Say what a file holds, and what memory it takes on a device, without decoding it."""
    quiet_warp()
    from wlm import system
    from wlm.formats.artifact import read_artifact
    from wlm.probe import codec

    artifact = read_artifact(file, "probe")
    model = system.decode(file, artifact, codec.decode)
    decoder = model.decoder(device)
    facts: dict[str, Any] = {
        "name": model.name,
        "method": model.method,
        "bytes": artifact.file_bytes,
        "probes": model.probes,
        "dead": int(model.dead.sum()),
        "outputs": model.outputs,
        "bits_per_probe": artifact.file_bytes * 8 / model.probes,
        "positions": model.has_positions,
        "source": model.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "device": decoder.device,
        "device_bytes": decoder.device_bytes,
        "profile": model.profile.model_dump(mode="json"),
    }
    facts |= model.content.facts() | {"gpu_bytes": model.content.nbytes}
    facts |= {"origin": model.origin.tolist(), "size": (model.extent * model.size).tolist()}
    if as_json:
        show_json(facts)
        return
    rows = table(str(file), ["", "value"])
    rows.add_row("name", escape(model.name))
    rows.add_row("method", model.method)
    rows.add_row("bytes", f"{artifact.file_bytes:,}")
    rows.add_row("probes", f"{model.probes:,}, {facts['dead']:,} of them dead")
    rows.add_row("numbers of a probe", str(model.outputs))
    rows.add_row("bits per probe", f"{facts['bits_per_probe']:.2f}")
    for name, value in model.content.facts().items():
        rows.add_row(name, str(value))
    rows.add_row("box", " x ".join(f"{side:.4g}" for side in facts["size"]))
    rows.add_row("positions", "stored" if facts["positions"] else "not stored")
    rows.add_row("source", escape(model.source))
    rows.add_row("profile", escape(model.profile.name))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    rows.add_section()
    rows.add_row("bytes for a GPU", f"{model.content.nbytes:,}")
    rows.add_row(f"bytes on {decoder.device}", f"{decoder.device_bytes:,}")
    show(rows)


def _load(path: Path, key: str | None, convention: str | None) -> "ProbeSet":
    """Reads a set and notes what was repaired in it."""
    from wlm.probe.data import load

    probes = load(path, key=key, convention=convention)
    for warning in probes.warnings:
        note(f"warning: {warning}")
    return probes


def _positions(model: "ProbeModel", path: Path | None) -> "tuple[np.ndarray, bool]":
    """The positions to decode at, float64 [M, 3], and whether they are those of the model's own probes."""
    from wlm.probe import load_positions

    if path is None:
        return model.stored_positions(), True
    position = load_positions(path)
    return position, model.has_probes_at(position)


def _show_report(file: Path, profile: str, report: "Report") -> None:
    columns = ["", "PSNR dB", "live dB", "irradiance dB", "bytes", "of float32", "bits a probe"]
    rows = table(str(file), columns)
    psnr = (number(value, ".2f") for value in (report.psnr, report.psnr_live, report.irradiance_psnr))
    sizes = (f"{report.bytes:,}", f"{report.ratio:.2%}", f"{report.bits_per_probe:.2f}")
    rows.add_row(f"wlm {escape(profile)}", *psnr, *sizes)
    if report.psnr_by_band is not None:
        rows.add_section()
        for band, psnr in enumerate(report.psnr_by_band):
            rows.add_row(f"band {band}", number(psnr, ".2f"))
    if report.between_psnr is not None:
        rows.add_section()
        rows.add_row("half-way between probes", number(report.between_psnr, ".2f"))
    if report.held_out is not None:
        held = report.held_out
        rows.add_row(f"{held.probes:,} probes held out", number(held.psnr, ".2f"), "", "", f"{held.bytes:,}")
        rows.add_row("  by the nearest uncompressed", number(held.nearest, ".2f"))
        rows.add_row("  by distance, of 8 uncompressed", number(held.distance, ".2f"))
    show(rows)
    if report.worst_probe is not None:
        worst = report.worst_probe
        place = ", ".join(f"{x:.4g}" for x in worst["position"])
        note(f"worst: {number(worst['psnr'], '.2f')} dB, probe {worst['probe']} at ({place})")
    for warning in report.warnings:
        note(f"warning: {warning}")


register_export(app)
register(app)
