"""Steps that commands for lightmaps, atlases and probes share: fit and save, load an input, export, describe."""

import time
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

from wlm.cli import console
from wlm.cli import options as opt
from wlm.errors import WlmError


def fit(
    system: str,
    load: Callable[[], Any],
    output: Path,
    profile: str,
    settings: Mapping[str, Any],
    work: opt.FitOptions,
    inputs: Mapping[str, Any] | None = None,
    **options: Any,
) -> tuple[Any, Any, dict[str, Any]]:
    """Compresses an input into a file; shows progress, keeps a checkpoint, and prints warnings.

    The package of the system has `Profile`, `compress` and `open_checkpoint`. `load` reads the input, after the
    settings, which replace those of the profile, have been checked; `options` are further options of `compress`, and
    `inputs` of `open_checkpoint` too.
    Returns the input, the model, and the first facts of the result's table.
    """
    console.begin(output, ".wlm")
    package = import_module(f"wlm.{system}")
    checked = package.Profile.load(profile).override(settings, "--")
    data = load()
    console.note_warnings(data.warnings)
    same = {"seed": work.seed, "device": work.device} | dict(inputs or {})
    checkpoint = package.open_checkpoint(output, data, checked, resume=work.resume, every=work.checkpoint_every, **same)
    console.note_start(checkpoint, work.resume, "at step 0")
    start = time.perf_counter()
    with console.running("fit", checkpoint.path) as progress:
        options |= same | {"workers": work.workers, "cluster": work.cluster}
        model = package.compress(data, checked, progress=progress, checkpoint=checkpoint, **options)
        seconds = time.perf_counter() - start
        size = model.save(output)
        checkpoint.remove()
    return data, model, {"file": output, "bytes on disk": size, "seconds": f"{seconds:.1f}"}


def export(
    file: Path,
    output: Path,
    engine: str | None,
    shader: str | None,
    exact: bool,
    device: str,
    time: float | None = None,
    **options: Any,
) -> None:
    """Exports a model to a folder and lists the written files. `time` is that of light probes with several hours.
    `options` that are None are left out. Raises a WlmError if an option has no meaning for the engine, or the folder
    cannot be written."""
    for option, given in (("shader", shader), ("exact", exact)):
        if given and engine is not None:
            raise WlmError(f"--{option}: has no meaning with --engine {engine}, whose kit has its own shaders")
    console.quiet_warp()
    from wlm.export import export
    from wlm.system import load

    given = {name: value for name, value in options.items() if value is not None}
    model = load(file) if time is None else load(file).at(time)
    console.show_files(
        output, export(model, output, engine, shader=shader or "glsl", exact=exact, device=device, **given)
    )


def export_lightmaps(
    file: opt.ModelFile,
    output: Annotated[Path, opt.output_option("DIR", "The folder to write to.")],
    engine: opt.Engine = None,
    shader: opt.ShaderLanguage = None,
    exact: opt.ExactShader = False,
    device: opt.Device = "cpu",
) -> None:
    """Write lightmaps for an engine: textures and a shader, or with --engine a kit that shows them."""
    export(file, output, engine, shader, exact, device)


def describe(
    file: Path, system: str, device: str | None, as_json: bool, facts: Callable[[Any], Mapping[str, Any]]
) -> Any:
    """Shows what a file of a system contains: settings, sizes and the given facts; returns the model.

    `facts` returns the facts of a model as JSON values by name. With a device, the memory that the model needs there is
    shown.
    """
    console.quiet_warp()
    from wlm.formats.artifact import read_artifact
    from wlm.system import load

    artifact, model = read_artifact(file, system), load(file, system)
    model.check()
    shown = {"name": model.name, "system": artifact.system, **facts(model), "source": model.source}
    shown["bytes_on_disk"] = artifact.file_bytes
    if device is not None:
        decoder = model.decoder(device)
        shown |= {"device": decoder.device, "bytes_on_device": decoder.device_bytes}
    parts = {"header": artifact.header_bytes} | artifact.parts
    if as_json:
        console.show_json(shown | {"parts": parts, "profile": model.profile.model_dump(mode="json")})
    else:
        console.show_facts(str(file), shown | {"profile": model.profile.name, "bytes": parts})
    return model
