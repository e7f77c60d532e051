"""`wlm atlas`: compress the lightmap of a mesh, decode it, score it, say what is in it."""

from pathlib import Path
from typing import Annotated

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
    EngineOrRaw,
    ExactShader,
    PageFile,
    ReportFile,
    Resume,
    Seed,
    ShaderLanguage,
    Trust,
    output_option,
    seconds_between,
    shader_of,
)
from wlm.errors import WlmError

app = typer.Typer(help="The lightmap of a mesh: a small colour texture, read through a small table.")

_Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A folder that compress wrote.")]
_VIEWS, _RESOLUTION = 50, 512  # as in `wlm.atlas.evaluation`, which takes long to import


@app.command()
@exclusive
def compress(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="A .glb, .gltf or .obj file.")],
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    lightmap_path: Annotated[
        Path | None,
        typer.Argument(
            metavar="LIGHTMAP",
            help="Its lightmap: EXR, Radiance .hdr, KTX2, DDS, or PNG. Of a scene a folder, a .lmbake, or a .json that "
            "lists all; none: the materials' own.",
        ),
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Which texels belong to a chart; default by the triangles.")
    ] = None,
    uv_set: Annotated[
        int | None, typer.Option("--uv-set", min=0, help="n of TEXCOORD_n, the lightmap's UVs; default 1, else 0.")
    ] = None,
    node: Annotated[
        str | None, typer.Option(help="The node that the lightmap belongs to; default the one that it fits best.")
    ] = None,
    encoding: Annotated[
        str | None, typer.Option(help="What a PNG's bytes stand for: linear, srgb, rgbm, dldr or rgbe.")
    ] = None,
    flip: Annotated[bool, typer.Option("--flip", help="The lightmap is upside down: its top row is v = 1.")] = False,
    profile: Annotated[
        str, typer.Option(help="standard, half, bc6h, astc, compact, cascade, paper, or a YAML file.")
    ] = "standard",
    budget: Annotated[
        float | None, typer.Option(help="Bits of both textures as a fraction of the lightmap's at 48 per texel.")
    ] = None,
    colour: Annotated[
        str | None, typer.Option(help="How the colour texture is stored: half, rgb9e5, bc6h, astc or mixed.")
    ] = None,
    mips: Annotated[
        bool, typer.Option("--mips", help="Smaller levels beside the tiles, in 1.4% of the lightmap's bits.")
    ] = False,
    views: Annotated[
        int | None, typer.Option(help="Random views; a texel counts by the pixels that show it. 0: by its area.")
    ] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    resume: Resume = False,
    checkpoint_every: CheckpointEveryIfKept = None,
    trust: Trust = False,
) -> None:
    """Compress the lightmap of a mesh into a folder: the model, the mesh, textures for engines, a shader, a report.

    What takes long is kept in DIR.partial from time to time, and by Ctrl-C and SIGTERM; the same command with --resume
    goes on exactly.
    """
    from wlm.atlas.model import Profile

    if lightmap_path is None or lightmap_path.suffix.lower() in (".json", ".lmbake") or lightmap_path.is_dir():
        lone = {
            "mask": mask,
            "node": node,
            "encoding": encoding,
            "flip": flip,
        }
        for name, value in lone.items():
            if value:
                raise WlmError(f"--{name}: expected with one lightmap alone; of a scene its list says it")
        for name, value in {"resume": resume or None, "checkpoint-every": checkpoint_every}.items():
            if value is not None:
                raise WlmError(
                    f"--{name}: expected with one lightmap alone; a scene's compression isn't kept while it runs"
                )
        quiet_warp()
        from wlm.cli.atlas_scene import compress_scene

        changes = {"budget": budget, "colour": colour, "mips": mips or None, "views": views}
        options = {"seed": seed, "device": device, "trust": trust}
        compress_scene(mesh_path, lightmap_path, output, uv_set=uv_set, profile=profile, overrides=changes, **options)
        return
    settings = Profile.load(profile).override(
        {"budget": budget, "colour": colour, "mips": mips or None, "views": views}, "--"
    )
    quiet_warp()
    from wlm.atlas.data import load
    from wlm.atlas.exporter import FORMAT, MODEL_FILE, REPORT_FILE, export
    from wlm.atlas.fit import compress, open_checkpoint
    from wlm.atlas.model import disk_ratio
    from wlm.formats.folder import claim
    from wlm.interop import check_device

    device = check_device(device)
    claim(output, REPORT_FILE, FORMAT)
    reading = {"node": node, "encoding": encoding, "flip": flip}
    mesh = load(mesh_path, lightmap_path, mask_path=mask, uv_set=uv_set, trust=trust, **reading)
    for warning in mesh.warnings:
        note(f"warning: {warning}")
    options = {"seed": seed, "device": device}
    every = seconds_between(checkpoint_every)
    checkpoint = open_checkpoint(output, mesh, settings, resume=resume, every=every, **options)
    note_start(checkpoint, resume, "at the first stage")
    inputs = {"mesh": mesh_path, "lightmap": lightmap_path, "mask": mask}
    facts = {"inputs": {name: path and str(path.resolve()) for name, path in inputs.items()} | reading}
    with running("compress", checkpoint.path) as progress:
        model = compress(mesh, settings, progress=progress, checkpoint=checkpoint, **options)
        files = export(model, output, mesh, facts | options)
        checkpoint.remove()
    rows = table(str(output), ["file", "bytes"])
    for path in files:
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    rows.add_section()
    rows.add_row("method", model.method)
    rows.add_row("CR of the textures", f"{model.compression_ratio:.2%}")
    rows.add_row(f"CR of {MODEL_FILE}", f"{disk_ratio((output / MODEL_FILE).stat().st_size, mesh.mask.shape):.2%}")
    rows.add_row("seconds", f"{sum(model.report['seconds'].values()):.1f}")
    show(rows)
    for warning in model.report.get("lost light", ()):
        note(f"warning: {warning}")


@app.command()
def evaluate(
    folder: _Folder,
    views: Annotated[int, typer.Option(min=1, max=4096, help="Cameras around the mesh; as many inside.")] = _VIEWS,
    resolution: Annotated[int, typer.Option(min=16, max=16384, help="Pixels along a side of a view.")] = _RESOLUTION,
    json_path: ReportFile = None,
    html_path: PageFile = None,
    mesh: Annotated[Path | None, typer.Option(help="The mesh; default where it was.")] = None,
    lightmap: Annotated[Path | None, typer.Option(help="The lightmap; default where it was.")] = None,
    mask: Annotated[Path | None, typer.Option(help="The mask; default where it was, if there was one.")] = None,
    device: Device = "cpu",
    trust: Trust = False,
) -> None:
    """Compare with the original lightmap on views of the mesh."""
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.atlas.scene.exporter import is_scene

    if is_scene(folder):
        given = {"html": html_path, "mesh": mesh, "lightmap": lightmap, "mask": mask}
        for name, value in given.items():
            if value is not None:
                raise WlmError(f"--{name}: expected with one lightmap alone, not with a scene")
        from wlm.cli.atlas_scene import evaluate_scene

        evaluate_scene(folder, views, resolution, json_path, device, trust)
        return
    from wlm.atlas.evaluation import evaluate
    from wlm.atlas.exporter import read_folder, read_inputs
    from wlm.interop import check_device

    output = read_folder(folder)
    original = read_inputs(output, mesh, lightmap, mask, trust)
    device = check_device(device)
    options = {"views": views, "resolution": resolution, "device": device}
    with running("evaluate") as progress:
        report = evaluate(output.model, original, **options, progress=progress, file_bytes=output.model_bytes)
    if not report.views:
        raise WlmError(
            f"{folder}: cannot be scored: neither a camera around the mesh nor a viewer inside sees its charts"
        )
    if html_path is not None:
        from wlm.view.reports import atlas_report

        atlas_report(html_path, output.model, original, report, views)
    if json_path is not None:
        settings = {"cameras": views, "resolution": resolution, "device": device}
        write_json(json_path, report.to_json() | settings)
    rows = table(f"{folder}: {report.views} views", ["", "value"])
    rows.add_row("CR (eq. 9)", f"{report.cr:.2%}")
    rows.add_row("CR on disk", f"{report.cr_disk:.2%}")
    for label, name, form in _ROWS:
        rows.add_row(label, number(getattr(report, name), form))
    show(rows)


# Label in the table, attribute of a report, format.
_ROWS = (
    ("PSNR dB", "psnr", ".2f"),
    ("peak", "peak", ".4g"),
    ("brightest", "brightest", ".4g"),
    ("PSNR dB, from around", "around_psnr", ".2f"),
    ("PSNR dB, from inside", "inside_psnr", ".2f"),
    ("PSNR dB, worst view", "psnr_worst", ".2f"),
    ("worst view", "worst_view", "d"),
    ("1 - SSIM", "one_minus_ssim", ".5f"),
    ("error at seams / elsewhere", "seam_ratio", ".2f"),
    ("PSNR dB of texels", "texel_psnr", ".2f"),
    ("PSNR dB, tone mapped", "tone_psnr", ".2f"),
    ("FLIP", "flip", ".4f"),
)


@app.command()
def decode(
    folder: _Folder,
    output: Annotated[Path, output_option("OUT", "A .exr; of a view also a .png.")],
    view: Annotated[
        int | None,
        typer.Option(min=0, help="Draw the mesh from this camera of evaluate instead; those inside come last."),
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=1, max=4096, help="Of a --view: cameras that evaluate has; default 50.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(min=16, max=16384, help="Of a --view: pixels along a side; default 512.")
    ] = None,
    device: Device = "cpu",
) -> None:
    """Rebuild the lightmap in its original layout, or draw a view of the mesh. The inputs aren't needed."""
    check_output(output, ".exr", ".png")
    if view is None:
        if output.suffix.lower() == ".png":
            raise WlmError(f"{output}: a lightmap is written as .exr; a .png is of a --view")
        for option, value in (("views", views), ("resolution", resolution)):
            if value is not None:
                raise WlmError(f"--{option}: expected with --view alone: a lightmap has its own size")
    views = _VIEWS if views is None else views
    resolution = _RESOLUTION if resolution is None else resolution
    quiet_warp()
    from wlm.atlas.exporter import geometry, read_folder
    from wlm.formats.exr import write_exr

    content = read_folder(folder)
    mesh = geometry(content)
    decoder = content.model.decoder(device)
    if view is None:
        picture, covered = decoder.lightmap(mesh), mesh.mask
        write_exr(output, picture)
    else:
        from wlm.atlas.views import mesh_views
        from wlm.view.atlas import draw
        from wlm.view.display import white_of
        from wlm.view.pictures import encode, save_png

        cameras = mesh_views(mesh, views)
        if view >= len(cameras):
            raise WlmError(f"--view: expected 0 to {len(cameras) - 1}, got {view}")
        pictures, covered = draw(mesh, {"ours": decoder}, cameras[view], resolution, decoder.device)
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
def export(
    folder: _Folder,
    output: Annotated[Path, output_option("OUT", "The folder to write to.")],
    engine: EngineOrRaw = "raw",
    shader: ShaderLanguage = None,
    exact: ExactShader = False,
) -> None:
    """Write what an engine needs of a folder that compress wrote: textures, the mesh, a material or a shader.

    Of raw these are the folder's own textures, and the shader in any language.
    """
    language = shader_of(engine, shader, exact)
    quiet_warp()
    from wlm.atlas.exporter import read_folder
    from wlm.atlas.scene.exporter import is_scene
    from wlm.export.engines.atlas import export_atlas
    from wlm.export.engines.scene import export_scene

    if is_scene(folder):
        if exact:
            raise WlmError("--exact: expected with one lightmap alone, not with a scene")
        paths = export_scene(folder, output, engine, shader=language)
    else:
        paths = export_atlas(read_folder(folder), output, engine, shader=language, exact=exact)
    rows = table(str(output), ["file", "bytes"])
    for path in paths:
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


@app.command()
def info(
    path: Annotated[Path, typer.Argument(metavar="DIR|FILE.wlm", help="A folder that compress wrote, or its .wlm.")],
    as_json: AsJson = False,
) -> None:
    """Say what a compressed lightmap holds, without decoding it."""
    quiet_warp()
    from wlm.atlas.exporter import describe
    from wlm.atlas.scene.exporter import is_scene

    if is_scene(path):
        from wlm.cli.atlas_scene import show_scene

        show_scene(path, as_json)
        return
    facts = describe(path)
    if as_json:
        show_json(facts)
        return
    rows = table(str(path), ["", "value"])
    rows.add_row("name", escape(facts["name"]))
    rows.add_row("method", facts["method"])
    rows.add_row("bytes", f"{facts['bytes']:,}")
    sizes = {"lightmap": "size", "colour texture": "colour_size", "its blocks": "block_size", "table": "lut_size"}
    for label, key in sizes.items():
        rows.add_row(label, "x".join(map(str, facts[key])) if facts[key][0] else "none")
    rows.add_row("colour stored as", facts["colour"])
    rows.add_row("UVs", f"new, of {facts['new_uvs']:,} triangles" if facts["new_uvs"] else "the mesh's own")
    rows.add_row("CR of the textures", f"{facts['cr']:.2%}")
    rows.add_row("CR on disk", f"{facts['cr_disk']:.2%}")
    rows.add_row("source", escape(facts["source"]))
    rows.add_row("profile", escape(facts["profile"]["name"]))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    show(rows)
