"""`wlm atlas`: compress the lightmap of a mesh, decode it, score it, say what is in it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
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
    from wlm.atlas.data import LightmappedMesh
    from wlm.atlas.evaluation import Sampler
    from wlm.atlas.exporter import Output
    from wlm.atlas.model import AtlasModel, Profile

__all__ = ["app"]

app = typer.Typer(help="The lightmap of a mesh: a small colour texture, read through a small table.")

_Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A folder that compress wrote.")]
_Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
_VIEWS, _RESOLUTION = 50, 512  # section 4.1.4 has as many views


@app.command()
def compress(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="A .glb, .gltf or .obj file.")],
    lightmap_path: Annotated[Path, typer.Argument(metavar="LIGHTMAP", help="Its lightmap, an EXR.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The folder to write to.")],
    mask: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Which texels belong to a chart; default by the triangles.")
    ] = None,
    uv_set: Annotated[
        int | None, typer.Option("--uv-set", min=0, help="n of TEXCOORD_n, the lightmap's UVs; default 1, else 0.")
    ] = None,
    profile: Annotated[
        str, typer.Option(help="standard, bc6h, astc, compact, cascade, paper, or a YAML file.")
    ] = "standard",
    budget: Annotated[
        float | None, typer.Option(help="Bits of both textures as a share of the lightmap's at 48 a texel.")
    ] = None,
    colour: Annotated[str | None, typer.Option(help="How the colour texture is stored: half, bc6h or astc.")] = None,
    views: Annotated[
        int | None, typer.Option(help="Random views that say how much each texel is seen; 0: by area.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the random views.")] = 0,
    device: _Device = "cpu",
) -> None:
    """Compress the lightmap of a mesh into a folder: the model, the mesh, textures for engines, a shader, a report."""
    settings = _settings(profile, budget=budget, colour=colour, views=views)
    if settings.method == "cascade" and budget is not None:
        raise WlmError("--budget: profiles of the cascade have sizes of their own; expected one of tiles, or none")
    quiet_warp()
    from wlm.atlas.data import load_mesh
    from wlm.atlas.exporter import MODEL_FILE, check_folder, disk_ratio, export
    from wlm.atlas.fit import compress
    from wlm.interop import check_device

    device = check_device(device)
    check_folder(output)
    mesh = load_mesh(mesh_path, lightmap_path, mask_path=mask, uv_set=uv_set)
    for warning in mesh.warnings:
        note(f"warning: {warning}")
    model = compress(mesh, settings, seed=seed, device=device, progress=lambda stage: note(f"compress: {stage}"))
    facts = {
        "inputs": {
            "mesh": str(mesh_path.resolve()),
            "lightmap": str(lightmap_path.resolve()),
            "mask": None if mask is None else str(mask.resolve()),
        },
        "seed": seed,
        "device": device,
    }
    rows = table(str(output), ["file", "bytes"])
    for path in export(output, model, mesh, facts):
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    rows.add_section()
    rows.add_row("method", model.method)
    rows.add_row("CR of both textures", f"{model.compression_ratio:.2%}")
    rows.add_row(f"CR of {MODEL_FILE}", f"{disk_ratio((output / MODEL_FILE).stat().st_size, model):.2%}")
    rows.add_row("seconds", f"{sum(model.report['seconds'].values()):.1f}")
    show(rows)


@app.command()
def evaluate(
    folder: _Folder,
    views: Annotated[int, typer.Option(min=1, max=4096, help="Cameras, spread evenly on a sphere.")] = _VIEWS,
    resolution: Annotated[int, typer.Option(min=16, max=16384, help="Pixels along a side of a view.")] = _RESOLUTION,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")] = None,
    mesh: Annotated[Path | None, typer.Option(help="The mesh; default where it was.")] = None,
    lightmap: Annotated[Path | None, typer.Option(help="The lightmap; default where it was.")] = None,
    mask: Annotated[Path | None, typer.Option(help="The mask; default where it was, if there was one.")] = None,
    device: _Device = "cpu",
) -> None:
    """Compare with the original lightmap on views of the mesh, beside a smaller lightmap of equal bits."""
    if json_path is not None:
        check_output(json_path, ".json")
    quiet_warp()
    from wlm.atlas.decode import Decoder
    from wlm.atlas.exporter import disk_ratio, read_folder
    from wlm.baselines.atlas import evaluate_rivals, share_of

    output = read_folder(folder)
    model = output.model
    original = _inputs(output, mesh, lightmap, mask)
    decoder = Decoder(model, device)
    with progress_bar("evaluate") as bar:
        ours, ((rival, other),) = evaluate_rivals(
            model,
            decoder,
            original,
            views=views,
            resolution=resolution,
            device=decoder.device,
            labels=_labels(model, original, decoder.device),
            progress=lambda done, total: bar(done, total, ""),
        )
    rival_cr = 1.0 - share_of(rival, original)
    facts = {
        "method": model.method,
        "profile": model.profile.name,
        "bytes": output.model_bytes,
        "cr": model.compression_ratio,
        "cr_disk": disk_ratio(output.model_bytes, model),
    }
    if json_path is not None:
        rest = {"size": list(rival.size), "cr": rival_cr, "seconds": rival.encode_seconds}
        settings = {"cameras": views, "resolution": resolution, "device": decoder.device}
        write_json(json_path, ours.to_json() | facts | settings | {rival.name: other.to_json() | rest})
    rows = table(f"{folder}: {ours.views} views", ["", "ours", rival.name])
    rows.add_row("CR (eq. 9)", f"{facts['cr']:.2%}", f"{rival_cr:.2%}")
    rows.add_row("CR on disk", f"{facts['cr_disk']:.2%}", "–")
    for label, name, form in _ROWS:
        rows.add_row(label, *(number(getattr(each, name), form) for each in (ours, other)))
    show(rows)


# Of a report: what the table calls a field, the field, its format.
_ROWS = (
    ("PSNR dB", "psnr", ".2f"),
    ("PSNR dB, worst view", "psnr_worst", ".2f"),
    ("worst view", "worst_view", "d"),
    ("1 - SSIM", "one_minus_ssim", ".5f"),
    ("error at seams / elsewhere", "seam_ratio", ".2f"),
    ("PSNR dB of texels", "texel_psnr", ".2f"),
)


@app.command()
def decode(
    folder: _Folder,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="A .exr; of a view also a .png.")],
    view: Annotated[
        int | None, typer.Option(min=0, help="Draw the mesh from this camera of evaluate, instead of the lightmap.")
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=1, max=4096, help="Of a --view: cameras that evaluate has; default 50.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(min=16, max=16384, help="Of a --view: pixels along a side; default 512.")
    ] = None,
    device: _Device = "cpu",
) -> None:
    """Rebuild the lightmap in its original layout, or draw a view of the mesh. The inputs aren't needed."""
    check_output(output, ".exr", ".png")
    if view is None:
        if output.suffix.lower() == ".png":
            raise WlmError(f"{output}: a lightmap is written as .exr; a .png is of a --view")
        for option, given in (("views", views), ("resolution", resolution)):
            if given is not None:
                raise WlmError(f"--{option}: expected with --view alone: a lightmap has its own size")
    views = _VIEWS if views is None else views
    resolution = _RESOLUTION if resolution is None else resolution
    if view is not None and view >= views:
        raise WlmError(f"--view: expected 0 to {views - 1}, got {view}")
    quiet_warp()
    from wlm.atlas.decode import Decoder
    from wlm.atlas.exporter import geometry, read_folder
    from wlm.formats.exr import write_exr

    found = read_folder(folder)
    mesh = geometry(found)
    decoder = Decoder(found.model, device)
    if view is None:
        picture = decoder.lightmap(mesh)
        covered = mesh.mask
        write_exr(output, picture)
    else:
        from wlm.atlas.views import sphere_views
        from wlm.view.atlas import draw, encode, save_png, white_of

        pictures, covered = draw(mesh, {"ours": decoder}, sphere_views(views)[view], resolution, decoder.device)
        picture = pictures["ours"]
        if output.suffix.lower() == ".png":
            save_png(output, encode(picture, covered, white_of(picture[covered])))
        else:
            write_exr(output, picture)
    rows = table(str(folder), ["file", "size", "covered", "mean", "largest"])
    inside = picture[covered]
    rows.add_row(
        escape(str(output)),
        f"{picture.shape[1]}x{picture.shape[0]}",
        f"{covered.mean():.1%}",
        number(float(inside.mean()) if inside.size else None, ".4g"),
        number(float(inside.max()) if inside.size else None, ".4g"),
    )
    show(rows)


@app.command()
def info(
    path: Annotated[Path, typer.Argument(metavar="DIR|FILE.wlm", help="A folder that compress wrote, or its .wlm.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Say what a compressed lightmap holds, without decoding it."""
    quiet_warp()
    from wlm.atlas import codec
    from wlm.atlas.exporter import MODEL_FILE, check_run, disk_ratio, read_report

    if path.is_dir():
        report, found = read_report(path), codec.inspect(path / MODEL_FILE)
        check_run(path, report, found.source)
    else:
        found = codec.inspect(path)
    facts: dict[str, Any] = {
        "name": found.name,
        "method": found.method,
        "colour": found.colour,
        "bytes": found.file_bytes,
        "size": [found.width, found.height],
        "colour_size": list(found.texels[::-1]),
        "lut_size": list(found.lut[::-1]),
        "new_uvs": found.triangles,
        "cr": found.compression_ratio,
        "cr_disk": disk_ratio(found.file_bytes, found),
        "source": found.source,
        "parts": {"header": found.header_bytes} | found.parts,
        "found": found.report,
        "profile": found.profile.model_dump(mode="json"),
    }
    if as_json:
        show_json(facts)
        return
    rows = table(str(path), ["", "value"])
    rows.add_row("name", escape(found.name))
    rows.add_row("method", found.method)
    rows.add_row("bytes", f"{found.file_bytes:,}")
    for label, key in (("lightmap", "size"), ("colour texture", "colour_size"), ("table", "lut_size")):
        rows.add_row(label, "x".join(map(str, facts[key])) if facts[key][0] else "none")
    rows.add_row("colour stored as", found.colour)
    rows.add_row("UVs", f"new, of {found.triangles:,} triangles" if found.triangles else "the mesh's own")
    rows.add_row("CR of both textures", f"{facts['cr']:.2%}")
    rows.add_row("CR on disk", f"{facts['cr_disk']:.2%}")
    rows.add_row("source", escape(found.source))
    rows.add_row("profile", escape(found.profile.name))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    show(rows)


def _settings(profile: str, **given: Any) -> "Profile":
    """Loads a profile and checks what replaces a part of it."""
    from pydantic import ValidationError

    from wlm.atlas.model import Profile, load_profile

    loaded = load_profile(profile)
    try:
        return Profile(**loaded.model_dump() | {name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        expected = problem["msg"].replace("Input should be", "expected", 1)
        raise WlmError(f"--{problem['loc'][0]}: {expected}, got {problem['input']}") from error


def _inputs(output: "Output", mesh: Path | None, lightmap: Path | None, mask: Path | None) -> "LightmappedMesh":
    """The mesh and lightmap that were compressed, from where they were or where the options say."""
    from wlm.atlas.data import load_mesh
    from wlm.atlas.exporter import REPORT_FILE

    stored = output.report.get("inputs")
    stored = stored if isinstance(stored, dict) else {}
    paths = {"mesh": mesh, "lightmap": lightmap, "mask": mask}
    paths |= {name: Path(stored[name]) for name, given in paths.items() if given is None and stored.get(name)}
    for name in ("mesh", "lightmap"):
        if paths[name] is None:
            raise WlmError(f"{output.folder / REPORT_FILE}: inputs.{name}: expected a path, found none; give --{name}")
        if not paths[name].is_file():
            raise WlmError(f"{paths[name]}: no such {name}; if it has moved, give --{name}")
    found = load_mesh(paths["mesh"], paths["lightmap"], mask_path=paths["mask"], uv_set=output.report.get("uv_set"))
    if found.source != output.model.source:
        names = ", ".join(str(path) for path in paths.values() if path is not None)
        raise WlmError(
            f"{output.folder}: made of other inputs than {names}: expected source {output.model.source}, found "
            f"{found.source}"
        )
    return found


def _labels(model: "AtlasModel", mesh: "LightmappedMesh", device: str) -> "dict[str, Sampler]":
    """Numbers of the new UVs' charts, whose borders are seams of our own; none where the mesh keeps its UVs."""
    import numpy as np
    import torch

    from wlm.atlas.charts import charts, welded

    if not len(model.uv):
        return {}
    corner = np.arange(3 * len(model.uv)).reshape(-1, 3)
    joined = welded(mesh.position[mesh.triangle].reshape(-1, 3), model.uv.reshape(-1, 2), corner)
    number = torch.from_numpy(charts(joined)).to(device)
    return {"ours": lambda uv, triangle, barycentric: number[triangle.long()]}
