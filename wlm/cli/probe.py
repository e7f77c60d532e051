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
from wlm.cli.probe_day import (
    Time,
    at_time,
    evaluate_hours,
    is_source,
    joined,
    only_path,
    read_hours,
    read_times,
    stored_time,
)
from wlm.cli.probe_export import given_positions
from wlm.cli.probe_export import register as register_export
from wlm.cli.probe_volume import register, score_seen, show_seen, show_walk_scores, walk_scores
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.probe import DayModel, ProbeModel, ProbeSet, Report, Transform

app = typer.Typer(
    help="Light probes: a transform over their places, or 3D Gaussians and a small network; a cascaded volume of both."
)

_Key = Annotated[str | None, typer.Option(help="Name of the values in PROBES; default the only ones.")]
_Convention = Annotated[
    str | None, typer.Option(help="Of the numbers: threejs, godot, unreal or unity; default as PROBES says.")
]

_Hours = Annotated[
    list[Path],
    typer.Argument(metavar="PROBES...", help="A .npz, .json or .lmbake file of probes; of several hours one or more."),
]

_Original = Annotated[
    Path | None,
    typer.Option(metavar="PROBES", help="The probes that were compressed, where a transform's file has no positions."),
]


@app.command()
@exclusive
def compress(
    probes_paths: _Hours,
    output: Annotated[Path, output_option("OUT.wlm", "The file to write.")],
    profile: Annotated[
        str, typer.Option(help="transform, standard, compact, small, paper, or a YAML file of settings.")
    ] = "transform",
    target_psnr: Annotated[
        float | None, typer.Option(metavar="DB", help="Of a transform: the PSNR to reach; default 50.")
    ] = None,
    max_bytes: Annotated[
        int | None, typer.Option(metavar="BYTES", help="Of a transform: the most bytes that the file may have.")
    ] = None,
    region: Annotated[
        int | None, typer.Option(metavar="PROBES", help="Of a transform: live probes up to which a set is one region.")
    ] = None,
    ratio: Annotated[float | None, typer.Option(help="Gaussians as a share of the live probes.")] = None,
    bits: Annotated[int | None, typer.Option(help="Bits of a Gaussian's scale, rotation and latent.")] = None,
    latent: Annotated[int | None, typer.Option(help="Numbers in a Gaussian's latent.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit; default as the profile says.")] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    resume: Resume = False,
    checkpoint_every: CheckpointEveryIfKept = None,
    positions: Annotated[
        bool, typer.Option("--positions", help="Store the probes' positions too, 16 bits per axis.")
    ] = False,
    times: Annotated[
        str | None, typer.Option(metavar="9,12,21", help="Store several hours: of a file each, or of arrays of one.")
    ] = None,
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compress a probe set into one file.

    With --times it holds several hours of the set: PROBES are a file for each, or one with arrays sh_09.00, sh_12.00.

    The fit is kept in OUT.wlm.partial from time to time, and by Ctrl-C and SIGTERM; the same command with --resume goes
    on exactly.
    """
    check_output(output, ".wlm")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.probe import Profile, compress, compress_day, open_checkpoint
    from wlm.probe.fit import check_method

    overrides = {"target_psnr": target_psnr, "max_bytes": max_bytes, "region": region}
    overrides |= {"ratio": ratio, "bits": bits, "latent": latent, "steps": steps}
    settings = Profile.load(profile).override(overrides, "--")
    check_method(settings, overrides, "--")
    if checkpoint_every is not None and (times is not None or settings.method == "transform"):
        raise WlmError("--checkpoint-every: expected with Gaussians of one hour; a transform is made anew in seconds")
    device = check_device(device)
    sets, hours = [], None if times is None else read_times(times)
    if hours is None:
        probes = _load(only_path(probes_paths), key, convention)
    else:
        sets = read_hours(probes_paths, hours, key, convention)
        probes = joined(sets, hours)
    options = {"seed": seed, "device": device}
    every = seconds_between(checkpoint_every)
    checkpoint = open_checkpoint(output, probes, settings, resume=resume, every=every, **options)
    note_start(checkpoint, resume, "at step 0")
    start = time.perf_counter()
    with running("fit", checkpoint.path) as progress:
        if hours is None:
            model = compress(probes, settings, progress=progress, checkpoint=checkpoint, positions=positions, **options)
        else:
            model = compress_day(sets, hours, settings, progress=progress, positions=positions)
        seconds = time.perf_counter() - start
        size = model.save(output)
        checkpoint.remove()
    count = len(sets) or 1
    cells = {
        "file": escape(str(output)),
        "bytes": f"{size:,}",
        "of float32": f"{size / probes.float_bytes / count:.2%}",
        "bits per probe": f"{size * 8 / probes.probes / count:.2f}",
    }
    if hours is not None:
        cells["hours"] = str(count)
    if settings.method == "gaussians":
        cells |= {"Gaussians": f"{model.count:,}", "dropped": f"{model.dropped:,}"}
    cells["seconds"] = f"{seconds:.1f}"
    rows = table(model.name, list(cells))
    rows.add_row(*cells.values())
    show(rows)


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
    region: Annotated[
        int | None, typer.Option(metavar="NUMBER", help="Of a file of many regions: the live probes of one, from 0.")
    ] = None,
    time: Time = None,
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

    model = at_time(load(file, "probe"), time)
    if region is None:
        position, at_probes = _positions(model, positions)
        decoder = _decoder(model, device, original, position if at_probes else None)
        values = decoder.decode_probes(position) if at_probes else decoder.decode(position)
    else:
        position, values = _region(file, model, region, positions, original, device)
        at_probes = False
    save_probes(output, position, values, convention=convention)
    rows = table(str(file), ["file", "positions", "of", "zero", "mean", "largest"], text=["of"])
    rows.add_row(
        escape(str(output)),
        f"{len(position):,}",
        "its probes" if at_probes else "other points" if region is None else f"region {region}",
        f"{int(model.dead.sum()) if at_probes else 0:,}",
        f"{values.mean():.4g}",
        f"{values.max():.4g}",
    )
    show(rows)


@app.command()
def evaluate(
    file: ModelFile,
    probes_paths: _Hours,
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
    time: Time = None,
    device: Device = "cpu",
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compare the decoded probes with the input: PSNR of coefficients and of irradiance, and bits per probe.

    Of a file of several hours PROBES are as for compress: all hours are scored, or with --time one of them.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.probe import DayModel, evaluate
    from wlm.probe.hours import joint_source
    from wlm.system import load

    model = load(file, "probe")
    if isinstance(model, DayModel):
        sets = read_hours(probes_paths, model.times, key, convention)
        if time is None:
            if volume or views or mesh is not None or html_path is not None:
                raise WlmError("--time: expected with --volume, --views, --mesh and --html")
            evaluate_hours(file, model, sets, json_path, hold_out, device)
            return
        if hold_out:
            raise WlmError("--hold-out: expected no --time: all hours of a file are fitted at once")
        stored_time(model, time)
        probes = sets[model.times.index(time)]
        source, shared = joint_source(sets, model.times), len(sets)
    else:
        probes = _load(only_path(probes_paths), key, convention)
        source, shared = probes.source, 1
    model = at_time(model, time)
    with running("evaluate") as progress:
        size = max(1, file.stat().st_size // shared)
        report = evaluate(model, probes, device=device, progress=progress, file_bytes=size, hold_out=hold_out)
    if not is_source(model, source):
        note(f"warning: {probes_paths[0]}: not what {file} was made of; another key, convention or file?")
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
    from wlm.probe import DayModel, RegionModel, codec

    artifact = read_artifact(file, "probe")
    model = system.decode(file, artifact, codec.decode)
    decoder = model.decoder(device)
    transform = model.profile.method == "transform"
    facts: dict[str, Any] = {
        "name": model.name,
        "method": model.profile.method,
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
    day = isinstance(model, DayModel)
    if day:
        facts |= {"times": list(model.times), "hours": _hour_facts(model)}
    elif transform:
        facts |= {"step": model.head.step, "directions": model.head.vectors, "predicted": model.head.predicted}
        facts["regions"] = model.split.regions if isinstance(model, RegionModel) else 1
    else:
        facts |= {
            "gaussians": model.count,
            "dropped": model.dropped,
            "packed": model.packed is not None,
            "gaussian_bits": int(model.profile.code_bits().sum()) if model.packed is None else None,
            "origin": model.origin.tolist(),
            "size": (model.extent * model.size).tolist(),
        }
    if as_json:
        show_json(facts)
        return
    rows = table(str(file), ["", "value"])
    rows.add_row("name", escape(model.name))
    rows.add_row("method", model.profile.method)
    rows.add_row("bytes", f"{artifact.file_bytes:,}")
    rows.add_row("probes", f"{model.probes:,}, {facts['dead']:,} of them dead")
    rows.add_row("numbers of a probe", str(model.outputs))
    rows.add_row("bits per probe", f"{facts['bits_per_probe']:.2f}")
    if day:
        for hour in facts["hours"]:
            told = " and ".join(f"{time:g}" for time in hour["from"])
            rows.add_row(f"bytes of {hour['time']:g} h", f"{hour['bytes']:,}" + (f", told by {told}" if told else ""))
    elif transform:
        rows.add_row("step", f"{model.head.step:.4g}")
        rows.add_row("directions", str(model.head.vectors))
        rows.add_row("regions", str(facts["regions"]))
    else:
        rows.add_row("Gaussians", f"{model.count:,}, {model.dropped:,} dropped")
        rows.add_row("bits per Gaussian", str(facts["gaussian_bits"] or "packed"))
        rows.add_row("box", " x ".join(f"{side:.4g}" for side in facts["size"]))
    rows.add_row("positions", "stored" if facts["positions"] else "not stored")
    rows.add_row("source", escape(model.source))
    rows.add_row("profile", escape(model.profile.name))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    rows.add_section()
    rows.add_row(f"bytes on {decoder.device}", f"{decoder.device_bytes:,}")
    show(rows)


def _hour_facts(model: "DayModel") -> list[dict[str, Any]]:
    """What a file says of each of its hours, in its own order."""
    return [
        {
            "time": model.times[hour.number],
            "bytes": hour.bytes,
            "from": [model.times[i] for i in hour.told.references],
            "dead": int(hour.dead.sum()),
        }
        for hour in model.hours
    ]


def _load(path: Path, key: str | None, convention: str | None) -> "ProbeSet":
    """Reads a set and notes what was repaired in it."""
    from wlm.probe.data import load

    probes = load(path, key=key, convention=convention)
    for warning in probes.warnings:
        note(f"warning: {warning}")
    return probes


def _region(
    file: Path, model: "Any", number: int, positions: Path | None, original: Path | None, device: str
) -> "tuple[np.ndarray, np.ndarray]":
    """Positions and numbers of the live probes of one region; nothing of the others is read."""
    from wlm.probe import RegionModel

    if not isinstance(model, RegionModel) or not 0 <= number < model.split.regions:
        regions = model.split.regions if isinstance(model, RegionModel) else 0
        raise WlmError(f"--region: expected one of {file}'s {regions} regions, counted from 0, found {number}")
    if positions is not None:
        raise WlmError("--region: expected no --positions: they are those of the region's probes")
    given = given_positions(model, original)
    return model.decoder(device, position=given).region(number)


def _positions(model: "ProbeModel | Transform", path: Path | None) -> "tuple[np.ndarray, bool]":
    """The positions to decode at, float64 [M, 3], and whether they are those of the model's own probes."""
    from wlm.probe import load_positions

    if path is None:
        return model.stored_positions(), True
    position = load_positions(path)
    return position, model.has_probes_at(position)


def _decoder(
    model: "ProbeModel | Transform", device: str, original: Path | None, position: "np.ndarray | None" = None
) -> "Any":
    """A decoder, of a transform at the places of `original` or at `position`, the model's own probes."""
    given = given_positions(model, original)
    if given is None and model.profile.method == "transform":
        given = position
    return model.decoder(device) if given is None else model.decoder(device, position=given)


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
    if report.noise_psnr is not None:
        rows.add_row("of the input's own noise", number(report.noise_psnr, ".2f"))
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
