"""The commands for lightmaps of meshes: compress, evaluate, decode, export, info."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli import console, models
from wlm.cli import options as opt
from wlm.cli.settings import with_settings
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.atlas import AtlasModel, LightmappedScene, Report

_VIEWS, _RESOLUTION = 50, 512  # as in wlm.atlas.evaluation, which takes long to import

_Mesh = Annotated[Path, typer.Argument(metavar="MESH", help="Mesh or scene: .glb, .gltf or another mesh format.")]
_Lights = Annotated[
    Path | None,
    typer.Argument(
        metavar="LIGHTMAPS",
        help="Lightmap (EXR, HDR, PFM, TIFF, KTX2, DDS, or a PNG with --encoding), a folder of them, a .lmbake, or a "
        ".json that lists them; default those that the glTF file names.",
    ),
]
_Views = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=4096,
        help=f"Number of cameras around the scene, and as many in it; default {_VIEWS}, to score several lightmaps 24.",
    ),
]
_Resolution = Annotated[
    int | None,
    typer.Option(
        min=16,
        max=16384,
        help=f"Edge of a square view in pixels; default {_RESOLUTION}, to score several lightmaps 256.",
    ),
]


@dataclass(frozen=True)
class LightOptions:
    """Options that state how the lightmaps of a mesh are read."""

    mask: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="PNG whose texels that aren't black count; default the texels in triangles."),
    ] = None
    uv_set: Annotated[
        int | None,
        typer.Option("--uv-set", min=0, help="Number of the lightmap's UVs TEXCOORD_n; default 1 if present, else 0."),
    ] = None
    node: Annotated[str | None, typer.Option(help="Name of the node that has the lightmap; default the best fit.")] = (
        None
    )
    encoding: opt.Encoding = None
    flip: Annotated[bool, typer.Option("--flip", help="The top row of the lightmap is at v = 1 instead of v = 0.")] = (
        False
    )
    slot: Annotated[
        str | None,
        typer.Option(help="Without LIGHTMAPS: read them from this slot of the materials, occlusion or emissive."),
    ] = None
    trust: opt.Trust = False

    def load(self, mesh: Path, lightmaps: Path | None, **changes: Any) -> "LightmappedScene":
        """Reads a mesh and its lightmaps, with some of the options changed."""
        from wlm.atlas import load

        options = vars(self) | changes
        return load(mesh, lightmaps, mask_path=options.pop("mask"), **options)


@with_settings("wlm.atlas:Profile")
@console.exclusive
@opt.with_options
def compress(
    mesh: _Mesh,
    output: Annotated[Path, opt.output_option("OUT.wlm", "The file to write.")],
    settings: dict[str, Any],
    options: LightOptions,
    work: opt.FitOptions,
    lightmaps: _Lights = None,
    profile: opt.Profile = "standard",
) -> None:
    """Compress the lightmaps of a mesh or a scene, in one state or several, into one file together with the triangles.

    Finished stages are saved in OUT.wlm.partial from time to time and on Ctrl-C or SIGTERM; repeat the command with
    --resume to continue exactly.
    """
    load = lambda: options.load(mesh, lightmaps)  # noqa: E731
    _, model, facts = models.fit("atlas", load, output, profile, settings, work)
    console.show_facts(model.name, facts | _facts(model))
    console.note_warnings(model.report.get("lost light", ()))


@opt.with_options
def evaluate(
    file: opt.ModelFile,
    mesh: _Mesh,
    options: LightOptions,
    lightmaps: _Lights = None,
    views: _Views = None,
    resolution: _Resolution = None,
    json_path: opt.ReportFile = None,
    device: opt.Device = "cpu",
) -> None:
    """Compare compressed lightmaps with the originals on rendered views of the scene."""
    console.begin(json_path, ".json", inputs=[lightmaps])
    from wlm.atlas import evaluate
    from wlm.interop import check_device
    from wlm.system import load

    device = check_device(device)
    model = load(file, "atlas")
    scene = options.load(mesh, lightmaps, uv_set=model.stored.uv_set if options.uv_set is None else options.uv_set)
    with console.running("evaluate") as progress:
        report = evaluate(model, scene, views=views, resolution=resolution, device=device, progress=progress)
    if not report.views:
        raise WlmError(f"{file}: cannot be scored: no camera sees its charts, neither from around nor from inside")
    if json_path is not None:
        console.write_json(json_path, report.to_json() | {"cameras": views, "resolution": resolution, "device": device})
    _show_report(file, model, report)


def decode(
    file: opt.ModelFile,
    output: Annotated[Path, opt.output_option("OUT.exr", "The lightmap to write.")],
    sheet: Annotated[int, typer.Option(min=0, help="Number of the lightmap in the list of wlm info, from 0.")] = 0,
    state: Annotated[float, typer.Option(min=0.0, help="Number of the state, from 0; 1.5 mixes states 1 and 2.")] = 0.0,
    device: opt.Device = "cpu",
) -> None:
    """Decode a lightmap in its original layout. The original files are not needed."""
    console.begin(output, ".exr")
    from wlm.formats.exr import write_exr
    from wlm.system import load

    model = load(file, "atlas")
    for option, value, most in (("sheet", sheet, len(model.sheets)), ("state", state, len(model.states))):
        if value > most - 1:
            raise WlmError(f"--{option}: expected 0 to {most - 1}, got {value:g}")
    light, mask = model.decoder(device).lightmap(sheet, state), model.scene.sheets[sheet].mask
    write_exr(output, light)
    facts = {"file": output, "size": f"{light.shape[1]}x{light.shape[0]}", "covered": f"{mask.mean():.1%}"}
    inside = light[mask]
    if inside.size:
        facts |= {"mean": float(inside.mean()), "largest": float(inside.max())}
    console.show_facts(str(file), facts)


export = models.export_lightmaps


def info(file: opt.ModelFile, as_json: opt.AsJson = False) -> None:
    """Show what a file of mesh lightmaps contains."""
    models.describe(file, "atlas", None, as_json, _facts)


def _facts(model: "AtlasModel") -> dict[str, Any]:
    pages, height, width = model.texels.shape[:3]
    return {
        "method": model.method,
        "lightmaps": [f"{each.width}x{each.height}" for each in model.sheets],
        "states": list(model.states),
        "colour_texture": f"{width}x{height}, {pages} page{'s' if pages > 1 else ''}",
        "colour_format": model.colour,
        "lookup_texture": "x".join(map(str, model.lut.shape[1::-1])) if model.lut.size else "none",
        "UVs": f"new, for {len(model.uv):,} triangles" if len(model.uv) else "those of the mesh",
        "smaller_levels": bool(model.levels),
        "GPU_bytes": -(-model.bits // 8),
        "saved_GPU_bytes": f"{model.compression_ratio:.2%}",
    }


def _show_report(file: Path, model: "AtlasModel", report: "Report") -> None:
    rows = console.table(f"{file}: {report.views} views", ["", "value"])
    for label, value in (
        ("GPU bytes", f"{report.gpu_bytes:,}"),
        ("GPU bytes saved", f"{report.cr:.2%}"),
        ("bytes on disk, without the mesh", f"{report.bytes - report.geometry_bytes:,}"),
        ("PSNR of the views, dB", console.number(report.psnr, ".2f")),
        ("  from around, dB", console.number(report.around_psnr, ".2f")),
        ("  from inside, dB", console.number(report.inside_psnr, ".2f")),
        (f"  worst, view {report.worst_view}, dB", console.number(report.psnr_worst, ".2f")),
        ("PSNR tone mapped, dB", console.number(report.tone_psnr, ".2f")),
        ("PSNR of the texels, dB", console.number(report.texel_psnr, ".2f")),
        ("1 - SSIM", console.number(report.one_minus_ssim, ".5f")),
        ("FLIP", console.number(report.flip, ".4f")),
        ("error at seams relative to elsewhere", console.number(report.seam_ratio, ".2f")),
        ("range of the reference", console.number(report.peak, ".4g")),
        ("brightest reference", console.number(report.brightest, ".4g")),
    ):
        rows.add_row(label, value)
    if len(model.states) > 1:
        rows.add_section()
        for state, value in zip(model.states, report.psnr_by_state, strict=True):
            rows.add_row(f"PSNR, {state}, dB", console.number(value, ".2f"))
    console.show(rows)
