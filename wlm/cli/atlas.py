"""`wlm atlas`: compress the lightmaps of a scene, decode them, score them, say what is in a file."""

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

app = typer.Typer(help="The lightmaps of a scene: a small colour texture, read through a small lookup texture.")

_File = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="A file that compress wrote.")]
_Mesh = Annotated[Path, typer.Argument(metavar="MESH", help="A .glb, .gltf, .obj or .ply file.")]
_Lights = Annotated[
    Path | None,
    typer.Argument(
        metavar="LIGHTS",
        help="Its lightmap: EXR, Radiance .hdr, KTX2, DDS, or PNG; or for a scene a folder, a .lmbake, or a .json that "
        "lists all lightmaps; default the materials' lightmaps.",
    ),
]
_Mask = Annotated[
    Path | None,
    typer.Option(metavar="PNG", help="The texels that belong to a chart; default by the triangles."),
]
_UvSet = Annotated[
    int | None, typer.Option("--uv-set", min=0, help="n of TEXCOORD_n, the lightmap's UVs; default 1, else 0.")
]
_Node = Annotated[
    str | None, typer.Option(help="The node that the lightmap belongs to; default the one that it fits best.")
]
_Encoding = Annotated[str | None, typer.Option(help="The meaning of a PNG's bytes: linear, srgb, rgbm, dldr or rgbe.")]
_Flip = Annotated[bool, typer.Option("--flip", help="The lightmap is upside down: its top row is v = 1.")]


@app.command()
@exclusive
def compress(
    mesh_path: _Mesh,
    output: Annotated[Path, output_option("FILE.wlm", "The file to write.")],
    lights_path: _Lights = None,
    mask: _Mask = None,
    uv_set: _UvSet = None,
    node: _Node = None,
    encoding: _Encoding = None,
    flip: _Flip = False,
    profile: Annotated[str, typer.Option(help="standard, bc6h, astc, cascade, paper, or a YAML file.")] = "standard",
    budget: Annotated[
        float | None, typer.Option(help="Bits of the textures as a fraction of the lightmaps' at 48 per texel.")
    ] = None,
    colour: Annotated[
        str | None, typer.Option(help="Format of the colour texture: half, rgb9e5, bc6h, astc or mixed.")
    ] = None,
    mips: Annotated[
        bool, typer.Option("--mips", help="Smaller levels for far surfaces, in 1.4% of the lightmap's bits.")
    ] = False,
    views: Annotated[
        int | None, typer.Option(min=1, help="Random views; a texel counts by the pixels that show it.")
    ] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    resume: Resume = False,
    checkpoint_every: CheckpointEveryIfKept = None,
    trust: Trust = False,
) -> None:
    """Compress the lightmaps of a mesh or scene into one file with their triangles.

    Long stages are kept in FILE.wlm.partial from time to time, and on Ctrl-C and SIGTERM; the same command with
    --resume continues exactly.
    """
    from wlm.atlas.model import Profile

    check_output(output, ".wlm")
    settings = Profile.load(profile).override(
        {"budget": budget, "colour": colour, "mips": mips or None, "views": views}, "--"
    )
    quiet_warp()
    from wlm.atlas import codec
    from wlm.atlas.data import load
    from wlm.atlas.fit import compress, open_checkpoint
    from wlm.interop import check_device

    device = check_device(device)
    reading = {"mask_path": mask, "uv_set": uv_set, "node": node, "encoding": encoding, "flip": flip}
    scene = load(mesh_path, lights_path, trust=trust, **reading)
    for warning in scene.warnings:
        note(f"warning: {warning}")
    options = {"seed": seed, "device": device}
    every = seconds_between(checkpoint_every)
    checkpoint = open_checkpoint(output, scene, settings, resume=resume, every=every, **options)
    note_start(checkpoint, resume, "at the first stage")
    with running("compress", checkpoint.path) as progress:
        model = compress(scene, settings, progress=progress, checkpoint=checkpoint, **options)
        size = model.save(output)
        checkpoint.remove()
    geometry = codec.sizes(model)[1]
    rows = table(str(output), ["", "value"])
    rows.add_row("bytes", f"{size:,}")
    rows.add_row("bytes of triangles and masks", f"{geometry:,}")
    rows.add_row("bytes on a GPU", f"{-(-model.bits // 8):,}")
    rows.add_row("method", model.method)
    rows.add_row("lightmaps", f"{len(model.sheets)} in {len(model.states)} states")
    rows.add_row("CR of the textures", f"{model.compression_ratio:.2%}")
    rows.add_row("CR on disk", f"{model.disk_ratio(size - geometry):.2%}")
    rows.add_row("seconds", f"{sum(model.report['seconds'].values()):.1f}")
    show(rows)
    for warning in model.report.get("lost light", ()):
        note(f"warning: {warning}")


@app.command()
def evaluate(
    file: _File,
    mesh_path: _Mesh,
    lights_path: _Lights = None,
    mask: _Mask = None,
    uv_set: _UvSet = None,
    node: _Node = None,
    encoding: _Encoding = None,
    flip: _Flip = False,
    views: Annotated[
        int | None,
        typer.Option(min=1, max=4096, help="Cameras around the scene, and as many inside; default 50, or 24."),
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(min=16, max=16384, help="Pixels along a side of a view; default 512, or 256.")
    ] = None,
    json_path: ReportFile = None,
    html_path: PageFile = None,
    device: Device = "cpu",
    trust: Trust = False,
) -> None:
    """Compare a file with the original lightmaps on views of the scene."""
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.atlas.data import load
    from wlm.atlas.evaluation import VIEWS, evaluate
    from wlm.interop import check_device
    from wlm.system import load as load_model

    model = load_model(file, "atlas")
    uv_set = model.stored.uv_set if uv_set is None else uv_set
    reading = {"mask_path": mask, "uv_set": uv_set, "node": node, "encoding": encoding, "flip": flip}
    scene = load(mesh_path, lights_path, trust=trust, **reading)
    options = {"views": views, "resolution": resolution, "device": check_device(device)}
    with running("evaluate") as progress:
        report = evaluate(model, scene, **options, progress=progress)
    if not report.views:
        raise WlmError(f"{file}: cannot be scored: no camera around the scene and no viewer inside sees a chart")
    if html_path is not None:
        from wlm.view.reports import atlas_report

        atlas_report(html_path, model, scene, report, VIEWS if views is None else views)
    if json_path is not None:
        write_json(json_path, report.to_json() | options)
    rows = table(f"{file}: {report.views} views, {len(model.states)} states", ["", "value"])
    rows.add_row("bytes on a GPU", f"{report.gpu_bytes:,}")
    rows.add_row("CR (eq. 9)", f"{report.cr:.2%}")
    rows.add_row("CR on disk", f"{report.cr_disk:.2%}")
    for label, name, form in _ROWS:
        rows.add_row(label, number(getattr(report, name), form))
    for state, value in zip(model.states, report.psnr_by_state, strict=True) if len(model.states) > 1 else ():
        rows.add_row(f"PSNR dB, {escape(state)}", number(value, ".2f"))
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
    file: _File,
    output: Annotated[Path, output_option("OUT", "A .exr; for a view also a .png.")],
    sheet: Annotated[int, typer.Option(min=0, help="The number of the lightmap's sheet.")] = 0,
    state: Annotated[float, typer.Option(min=0, help="The number of the state; 0.5 is between the first two.")] = 0.0,
    view: Annotated[
        int | None,
        typer.Option(min=0, help="Draw the scene from this camera of evaluate instead; those inside come last."),
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=1, max=4096, help="With --view: cameras that evaluate has; default 50.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(min=16, max=16384, help="With --view: pixels along a side; default 512.")
    ] = None,
    device: Device = "cpu",
) -> None:
    """Rebuild a lightmap in its original layout, or draw a view of the scene. The inputs aren't needed."""
    check_output(output, ".exr", ".png")
    if view is None:
        if output.suffix.lower() == ".png":
            raise WlmError(f"{output}: a lightmap is written as .exr; a .png needs --view")
        for option, value in (("views", views), ("resolution", resolution)):
            if value is not None:
                raise WlmError(f"--{option}: expected with --view alone: a lightmap has its own size")
    quiet_warp()
    from wlm.formats.exr import write_exr
    from wlm.system import load

    model = load(file, "atlas")
    if sheet >= len(model.sheets) or state > len(model.states) - 1:
        raise WlmError(
            f"{file}: expected a sheet below {len(model.sheets)} and a state up to {len(model.states) - 1}, got "
            f"{sheet} and {state:g}"
        )
    decoder = model.decoder(device)
    if view is None:
        picture, covered = decoder.lightmap(sheet, state), model.scene.sheets[sheet].mask
        write_exr(output, picture)
    else:
        from wlm.atlas.evaluation import RESOLUTION, VIEWS
        from wlm.atlas.views import scene_views
        from wlm.view.atlas import draw
        from wlm.view.display import white_of
        from wlm.view.pictures import encode, save_png

        cameras = scene_views(model.scene, VIEWS if views is None else views)
        if view >= len(cameras):
            raise WlmError(f"--view: expected 0 to {len(cameras) - 1}, got {view}")
        side = RESOLUTION if resolution is None else resolution
        pictures, covered = draw(model.scene, {"ours": decoder}, cameras[view], side, decoder.device, state)
        picture = pictures["ours"]
        if output.suffix.lower() == ".png":
            save_png(output, encode(picture, covered, white_of(picture[covered])))
        else:
            write_exr(output, picture)
    rows = table(str(file), ["file", "size", "covered", "mean", "largest"])
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
    file: _File,
    output: Annotated[Path, output_option("OUT", "The folder to write to.")],
    engine: EngineOrRaw = "raw",
    shader: ShaderLanguage = None,
    exact: ExactShader = False,
) -> None:
    """Write what an engine needs of a file: textures, the mesh, a material or a shader."""
    language = shader_of(engine, shader, exact)
    quiet_warp()
    from wlm.export import export
    from wlm.system import load

    kit = None if engine == "raw" else engine
    paths = export(load(file, "atlas"), output, kit, shader=language, exact=exact)
    rows = table(str(output), ["file", "bytes"])
    for path in paths:
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


@app.command()
def info(file: _File, as_json: AsJson = False) -> None:
    """Say what a compressed lightmap holds, without decoding it."""
    quiet_warp()
    from wlm.formats.artifact import read_artifact
    from wlm.system import load, plain

    model, artifact = load(file, "atlas"), read_artifact(file, "atlas")
    own = artifact.file_bytes - sum(artifact.parts.get(name, 0) for name in ("mesh", "mask"))
    pages = [("colour texture", model.texels), ("second texture", model.block_texels)]
    facts = {
        "name": model.name,
        "method": model.method,
        "colour": model.colour,
        "states": list(model.states),
        "sheets": [{"name": each.name, "size": [each.width, each.height]} for each in model.sheets],
        "levels": len(model.levels),
        "separate": bool(model.later),
        "bytes": artifact.file_bytes,
        "gpu_bytes": -(-model.bits // 8),
        "lut_size": list(model.lut.shape[1::-1]),
        **{name.replace(" ", "_"): list(texels.shape[2::-1]) for name, texels in pages},
        "new_uvs": len(model.uv),
        "cr": model.compression_ratio,
        "cr_disk": model.disk_ratio(own),
        "source": model.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "found": plain(model.report),
        "profile": model.profile.model_dump(mode="json"),
    }
    if as_json:
        show_json(facts)
        return
    rows = table(str(file), ["", "value"])
    for name in ("name", "method", "colour", "source"):
        rows.add_row(name, escape(facts[name]))
    rows.add_row("states", escape(", ".join(model.states)))
    rows.add_row("sheets", f"{len(model.sheets):,}")
    if model.method == "shared":
        rows.add_row("tiles", "separate for each state" if model.later else "shared by the states")
    rows.add_row("first lightmap", "x".join(map(str, facts["sheets"][0]["size"])))
    for name, texels in pages:
        if texels.size:
            count, height, width, _ = texels.shape
            rows.add_row(name, f"{width}x{height}" + (f", {count} pages" if count > 1 else ""))
    rows.add_row("lookup texture", "x".join(map(str, facts["lut_size"])) if model.lut.size else "none")
    rows.add_row("UVs", f"new, of {len(model.uv):,} triangles" if len(model.uv) else "the mesh's own")
    for name in ("bytes", "gpu_bytes"):
        rows.add_row(name.replace("_", " ").replace("gpu", "GPU"), f"{facts[name]:,}")
    rows.add_row("CR of the textures", f"{facts['cr']:.2%}")
    rows.add_row("CR on disk", f"{facts['cr_disk']:.2%}")
    rows.add_row("profile", escape(model.profile.name))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    show(rows)
