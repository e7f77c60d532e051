"""`wlm probe`: compress light probes, decode them anywhere, score them, walk through them, export them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    deferred_interrupt,
    escape,
    note,
    number,
    progress_bar,
    quiet_warp,
    show,
    show_json,
    table,
    write_json,
)
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.baselines.rival import Rival
    from wlm.probe.data import ProbeSet
    from wlm.probe.evaluation import Report
    from wlm.probe.model import ProbeModel, Profile

__all__ = ["app"]

app = typer.Typer(help="Light probes: quantised 3D Gaussians and a small network, read through a cascaded volume.")

_Probes = Annotated[Path, typer.Argument(metavar="PROBES", help="A .npz, .json or .lmbake file of probes.")]
_File = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="A file that compress wrote.")]
_Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
_Key = Annotated[str | None, typer.Option(help="Name of the values in PROBES; default the only ones.")]
_Convention = Annotated[
    str | None, typer.Option(help="Of the numbers: threejs, godot, unreal or unity; default as PROBES says.")
]

_AXES = ("x", "y", "z")
_NAMES = {
    "global_pca": "PCA",
    "block_pca": "block PCA",
    "window_pca": "windowed block PCA",
    "clustered_pca": "clustered PCA",
    "clustered_pca_signal": "clustered PCA, by signal",
    "moving_basis": "moving basis",
    "unreal": "Unreal's 8 bits",
}


@app.command()
def compress(
    probes_path: _Probes,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT.wlm", help="The file to write.")],
    profile: Annotated[str, typer.Option(help="standard, compact, paper, or a YAML file of settings.")] = "standard",
    ratio: Annotated[float | None, typer.Option(help="Gaussians as a share of the live probes.")] = None,
    bits: Annotated[int | None, typer.Option(help="Bits of a Gaussian's scale, rotation and latent.")] = None,
    latent: Annotated[int | None, typer.Option(help="Numbers in a Gaussian's latent.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit; default as the profile says.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="One seed gives one result on one device.")] = 0,
    device: _Device = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted fit of OUT.wlm.")] = False,
    positions: Annotated[
        bool, typer.Option("--positions", help="Store the probes' positions too, 16 bits an axis.")
    ] = False,
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compress a probe set into one file.

    Ctrl-C keeps the fit in OUT.wlm.partial; the same command with --resume goes on exactly.
    """
    check_output(output, ".wlm")
    settings = _settings(profile, ratio=ratio, bits=bits, latent=latent, steps=steps)
    quiet_warp()
    from wlm.interop import check_device
    from wlm.probe import codec
    from wlm.probe.fit import Progress, compress, open_checkpoint

    device = check_device(device)
    probes = _load(probes_path, key, convention)
    checkpoint = open_checkpoint(output, probes, settings, seed=seed, device=device, resume=resume)
    if resume and not checkpoint.resumed:
        note(f"{checkpoint.path}: there is nothing to resume; starting at step 0")
    seconds, at = 0.0, 0
    try:
        with deferred_interrupt() as check_interrupt, progress_bar("fit") as bar:

            def report(now: Progress) -> None:
                nonlocal seconds, at
                seconds, at = now.seconds, now.step
                bar(now.step, now.steps, f"PSNR {number(now.psnr, '.1f')} dB")
                check_interrupt()

            model = compress(
                probes,
                settings,
                seed=seed,
                device=device,
                progress=report,
                checkpoint=checkpoint,
                positions=positions,
            )
    except KeyboardInterrupt:
        note(f"stopped at step {at}: the same command with --resume goes on from {checkpoint.path}")
        raise
    size = codec.write(output, model)
    checkpoint.remove()
    rows = table(model.name, ["file", "bytes", "of float32", "bits a probe", "Gaussians", "dropped", "seconds"])
    rows.add_row(
        escape(str(output)),
        f"{size:,}",
        f"{size / probes.float_bytes:.2%}",
        f"{size * 8 / probes.probes:.2f}",
        f"{model.count:,}",
        f"{model.dropped:,}",
        f"{seconds:.1f}",
    )
    show(rows)


@app.command()
def decode(
    file: _File,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="The .npz or .json file to write.")],
    positions: Annotated[
        Path | None,
        typer.Option(metavar="PROBES", help="Where: a .npz, .json or .lmbake file, of which `position` is taken."),
    ] = None,
    convention: Annotated[str, typer.Option(help="Of the numbers: threejs, godot, unreal or unity.")] = "threejs",
    device: _Device = "cpu",
) -> None:
    """Decode the light at the stored positions, or at any others.

    Positions as many as the file has probes, and in the same box, are taken for those probes in their order: the dead
    ones among them decode to zero. Anywhere else there is no telling who is dead.
    """
    check_output(output, ".npz", ".json")
    quiet_warp()
    from wlm.probe import codec
    from wlm.probe.data import save_probes
    from wlm.probe.decode import Decoder

    model = codec.read(file)
    decoder = Decoder(model, device)
    position, own = _positions(model, file, positions)
    values = decoder.decode_probes(position) if own else decoder.decode(position)
    save_probes(output, position, values, convention=convention)
    rows = table(str(file), ["file", "positions", "of", "zero", "mean", "largest"], text=["of"])
    rows.add_row(
        escape(str(output)),
        f"{len(position):,}",
        "its probes" if own else "other points",
        f"{int(model.dead.sum()) if own else 0:,}",
        f"{values.mean():.4g}",
        f"{values.max():.4g}",
    )
    show(rows)


@app.command()
def evaluate(
    file: _File,
    probes_path: _Probes,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")] = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Add the PCA family, a moving basis and 8 bits, at equal bytes.")
    ] = False,
    device: _Device = "cpu",
    key: _Key = None,
    convention: _Convention = None,
) -> None:
    """Compare the decoded probes with the input: PSNR of coefficients and of irradiance, and bits a probe."""
    if json_path is not None:
        check_output(json_path, ".json")
    quiet_warp()
    from wlm.probe import codec
    from wlm.probe.decode import Decoder
    from wlm.probe.evaluation import evaluate

    model = codec.read(file)
    decoder = Decoder(model, device)
    probes = _load(probes_path, key, convention)
    report = evaluate(decoder.decode_probes(probes.position), probes, file.stat().st_size)
    if probes.source != model.source:
        note(f"warning: {probes_path}: not what {file} was made of; another key, convention or file?")
    rivals = []
    if baselines:
        from wlm.baselines.probe import evaluate_rivals

        with progress_bar("baselines") as bar:
            rivals = evaluate_rivals(probes, report.bytes, progress=bar, skipped=lambda error: note(str(error)))
    if json_path is not None:
        scored = [{"method": rival.name} | rival.to_json() | score.to_json() for rival, score in rivals]
        write_json(json_path, report.to_json() | ({"baselines": scored} if baselines else {}))
    _show_report(file, model.profile.name, report, rivals)


@app.command()
def info(
    file: _File,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    device: Annotated[str, typer.Option(help="Where to load it, to say what memory it takes there.")] = "cpu",
) -> None:
    """Say what a file holds, without decoding it."""
    quiet_warp()
    from wlm.formats.artifact import read_artifact
    from wlm.probe import codec
    from wlm.probe.decode import Decoder

    model = codec.read(file)
    decoder = Decoder(model, device)
    artifact = read_artifact(file)
    facts: dict[str, Any] = {
        "name": model.name,
        "bytes": artifact.file_bytes,
        "probes": model.probes,
        "dead": int(model.dead.sum()),
        "outputs": model.outputs,
        "gaussians": model.count,
        "dropped": model.dropped,
        "gaussian_bits": model.profile.gaussian_bits(),
        "bits_per_probe": artifact.file_bytes * 8 / model.probes,
        "origin": model.origin.tolist(),
        "size": (model.extent * model.size).tolist(),
        "positions": bool(len(model.positions)),
        "source": model.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "device": decoder.device,
        "device_bytes": decoder.device_bytes,
        "profile": model.profile.model_dump(mode="json"),
    }
    if as_json:
        show_json(facts)
        return
    rows = table(str(file), ["", "value"])
    rows.add_row("name", escape(model.name))
    rows.add_row("bytes", f"{artifact.file_bytes:,}")
    rows.add_row("probes", f"{model.probes:,}, {facts['dead']:,} of them dead")
    rows.add_row("numbers a probe", str(model.outputs))
    rows.add_row("bits a probe", f"{facts['bits_per_probe']:.2f}")
    rows.add_row("Gaussians", f"{model.count:,}, {model.dropped:,} dropped")
    rows.add_row("bits a Gaussian", str(facts["gaussian_bits"]))
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


@app.command()
def export(
    file: _File,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The folder to write to.")],
    device: Annotated[str, typer.Option(help="Where the values to compare with are decoded.")] = "cpu",
) -> None:
    """Write the Gaussians and the network as buffers, with a shader that reads them, for an engine.

    reference.json is the light at some positions: what the shader should make of the rest.
    """
    quiet_warp()
    from wlm.probe import codec
    from wlm.probe.exporter import export

    rows = table(str(output), ["file", "bytes"])
    for path in export(codec.read(file), output, device=device):
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


@app.command()
def walk(
    file: _File,
    probes_path: Annotated[
        Path | None, typer.Argument(metavar="PROBES", help="The probes' positions; default those in FILE.wlm.")
    ] = None,
    frames: Annotated[int, typer.Option(help="Frames of a loop through the scene.")] = 600,
    path: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Viewpoints: a JSON list of x, y, z, or `position` of a .npz.")
    ] = None,
    scale: Annotated[float, typer.Option(help="Of the volume's blocks and the eye's height: units in a metre.")] = 1.0,
    up: Annotated[str, typer.Option(help="The axis that points up: x, y or z.")] = "y",
    budget: Annotated[int | None, typer.Option(help="Blocks decoded in a frame; default 64.")] = None,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")] = None,
    device: _Device = "cpu",
) -> None:
    """Walk through the scene with a cascaded lighting volume: what a frame costs, covers and gets wrong."""
    if json_path is not None:
        check_output(json_path, ".json")
    if up not in _AXES:
        raise WlmError(f"--up: expected x, y or z, got {up}")
    quiet_warp()
    from wlm.probe import codec
    from wlm.probe.decode import Decoder
    from wlm.probe.volume import BUDGET, Volume
    from wlm.probe.walk import EYE_HEIGHT, camera_path, load_path, summary, walk

    model = codec.read(file)
    decoder = Decoder(model, device)
    position, own = _positions(model, file, probes_path)
    if not own:
        raise WlmError(f"{probes_path}: expected the {model.probes} probes that {file} was made of, in their order")
    volume = Volume(
        position,
        decoder.decode,
        model.outputs,
        live=~model.dead if len(model.dead) else None,
        scale=scale,
        budget=BUDGET if budget is None else budget,
        device=decoder.device,
    )
    if path is None:
        viewpoints = camera_path(volume.position, frames, EYE_HEIGHT * scale, _AXES.index(up))
    else:
        viewpoints = load_path(path)
    with progress_bar("walk") as bar:
        figures = summary(walk(volume, viewpoints, progress=lambda done, total: bar(done, total, "")))
    memory = {
        "volume_bytes": volume.memory_bytes,
        "model_bytes": decoder.device_bytes,
        "host_bytes": volume.host_bytes,
    }
    if json_path is not None:
        settings = {"device": decoder.device, "sizes": list(volume.sizes), "side": volume.side, "budget": volume.budget}
        write_json(json_path, {"name": model.name} | settings | memory | figures)
    _show_walk(file, figures, memory)


def _settings(profile: str, **given: Any) -> "Profile":
    """Loads a profile and checks what replaces a part of it."""
    from pydantic import ValidationError

    from wlm.probe.model import Profile, load_profile

    loaded = load_profile(profile)
    try:
        return Profile(**loaded.model_dump() | {name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        expected = problem["msg"].replace("Input should be", "expected", 1)
        raise WlmError(f"--{problem['loc'][0]}: {expected}, got {problem['input']}") from error


def _load(path: Path, key: str | None, convention: str | None) -> "ProbeSet":
    """Reads a set and says what was repaired in it."""
    from wlm.probe.data import load_probes

    probes = load_probes(path, key=key, convention=convention)
    for warning in probes.warnings:
        note(f"warning: {warning}")
    return probes


def _positions(model: "ProbeModel", file: Path, path: Path | None) -> "tuple[np.ndarray, bool]":
    """The positions to decode at, float64 [M, 3], and whether they are those of the model's own probes."""
    import numpy as np

    if path is None:
        if not len(model.positions):
            raise WlmError(f"{file}: holds no positions; expected a file of them, or compress --positions")
        return model.stored_positions(), True
    position = _read_positions(path)
    if len(position) != model.probes:
        return position, False
    box = np.stack([model.origin, model.origin + model.extent * model.size])
    found = np.stack([position.min(0), position.max(0)])
    # An engine may have rounded them to float32.
    slack = 1e-6 * model.extent + np.finfo(np.float32).eps * np.abs(box).max()
    return position, bool((np.abs(found - box) <= slack).all())


def _read_positions(path: Path) -> "np.ndarray":
    """Takes the positions of a probe file, whatever else is in it; float64 [M, 3]."""
    import json

    import numpy as np

    from wlm.formats.godot import read_lmbake
    from wlm.probe.walk import load_path

    kind = path.suffix.lower()
    if kind not in (".npz", ".json", ".lmbake"):
        raise WlmError(f"{path}: expected a name that ends in .npz, .json or .lmbake, found {kind or 'none'}")
    if not path.is_file():
        raise WlmError(f"{path}: no such file")
    if kind == ".npz":
        return load_path(path)
    if kind == ".lmbake":
        return read_lmbake(path)[0].astype(np.float64)
    try:
        content = json.loads(path.read_bytes())
        if isinstance(content, dict) and "probes" in content:
            content = [probe["position"] for probe in content["probes"]]
        elif isinstance(content, dict):
            content = content["position"]
        position = np.asarray(content)
    except OSError as error:
        raise WlmError(f"{path}: cannot read: {error.strerror or error}") from error
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise WlmError(f"{path}: expected JSON with a position [x, y, z] for each probe: {error}") from error
    if position.dtype.kind not in "fiu" or position.ndim != 2 or position.shape[1] != 3 or len(position) == 0:
        found = f"{position.dtype} {list(position.shape)}"
        raise WlmError(f"{path}: position: expected numbers [M, 3], at least one position, got {found}")
    bad = np.flatnonzero(~np.isfinite(position).all(1))
    if len(bad):
        raise WlmError(f"{path}: position {bad[0]}: expected finite numbers, got {position[bad[0]].tolist()}")
    return position.astype(np.float64)


def _show_report(file: Path, profile: str, report: "Report", rivals: "list[tuple[Rival, Report]]") -> None:
    columns = ["", "PSNR dB", "live dB", "irradiance dB", "bytes", "of float32", "bits a probe"]
    rows = table(str(file), columns)
    named = [(f"wlm {escape(profile)}", report)]
    named += [(f"{_NAMES.get(rival.name, rival.name)}, {rival.option}", score) for rival, score in rivals]
    for name, score in named:
        psnr = (number(value, ".2f") for value in (score.psnr, score.psnr_live, score.irradiance_psnr))
        rows.add_row(name, *psnr, f"{score.bytes:,}", f"{score.ratio:.2%}", f"{score.bits_per_probe:.2f}")
    if report.psnr_by_band is not None:
        rows.add_section()
        for band, psnr in enumerate(report.psnr_by_band):
            rows.add_row(f"band {band}", number(psnr, ".2f"))
    show(rows)
    if report.worst_probe is not None:
        worst = report.worst_probe
        place = ", ".join(f"{x:.4g}" for x in worst["position"])
        note(f"worst: {number(worst['psnr'], '.2f')} dB, probe {worst['probe']} at ({place})")


def _show_walk(file: Path, figures: dict[str, Any], memory: dict[str, int]) -> None:
    rows = table(f"{file}: {figures['frames']} frames", ["a frame", "mean", "95%", "worst"])
    counts = {
        "blocks decoded": "updated",
        "blocks from the cache": "cached",
        "blocks waiting": "left",
        "probes": "probes",
    }
    times = {f"{name} ms": f"{name}_ms" for name in ("update", "find", "decode", "upload", "read")}
    for names, form in ((counts, ".1f"), (times, ".3f"), ({"error": "rmse", "light": "rms"}, ".4g")):
        for name, key in names.items():
            found = figures[key] or {}
            rows.add_row(name, *(number(found.get(part), form) for part in ("mean", "p95", "max")))
        rows.add_section()
    covered = figures["coverage"] or {}
    rows.add_row("covered", *(number(covered.get(part), ".2%") for part in ("mean", "p5", "min")))
    rows.add_section()
    for name, count in memory.items():
        rows.add_row(name.replace("_bytes", ", bytes"), f"{count:,}")
    show(rows)
