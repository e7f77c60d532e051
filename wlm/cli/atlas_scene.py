"""`wlm atlas compress` and `evaluate` of whole scenes."""

from pathlib import Path
from typing import Any

from wlm.cli.console import escape, note, number, running, show, show_json, table, write_json
from wlm.errors import WlmError


def compress_scene(
    scene_path: Path,
    lights_path: Path | None,
    output: Path,
    *,
    uv_set: int | None,
    profile: str,
    overrides: dict[str, Any],
    seed: int,
    device: str,
    trust: bool,
) -> None:
    """Compresses all lightmaps of a scene into a folder, and shows what was written."""
    from wlm.atlas.scene.data import load_scene
    from wlm.atlas.scene.exporter import FORMAT, REPORT_FILE, export_scene
    from wlm.atlas.scene.fit import compress_scene
    from wlm.atlas.scene.model import SceneProfile
    from wlm.formats.folder import claim
    from wlm.interop import check_device

    settings = SceneProfile.load(profile).override(overrides, "--")
    device = check_device(device)
    claim(output, REPORT_FILE, FORMAT)
    scene = load_scene(scene_path, lights_path, uv_set=uv_set, trust=trust)
    for warning in scene.warnings:
        note(f"warning: {warning}")
    inputs = {"scene": scene_path, "lights": lights_path}
    facts = {
        "inputs": {name: path and str(path.resolve()) for name, path in inputs.items()} | {"uv_set": uv_set},
        "seed": seed,
        "device": device,
    }
    with running("compress") as progress:
        model = compress_scene(scene, settings, seed=seed, device=device, progress=progress)
        files = export_scene(model, output, scene, facts)
    rows = table(str(output), ["file", "bytes"])
    for path in files:
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    rows.add_section()
    rows.add_row("objects", f"{len(scene.objects):,}")
    rows.add_row("sheets", f"{len(scene.sheets):,}")
    rows.add_row("states", f"{len(scene.states):,}")
    counts = model.report["components"]
    mean = sum(int(count) * tiles for count, tiles in counts.items()) / sum(counts.values())
    rows.add_row("components of a tile", f"{mean:.1f} of {model.report['mixtures']} mixtures")
    rows.add_row("CR of all textures", f"{model.compression_ratio:.2%}")
    rows.add_row("seconds", f"{sum(model.report['seconds'].values()):.1f}")
    show(rows)


def show_scene(path: Path, as_json: bool) -> None:
    """Shows what a scene's folder or model holds."""
    from wlm.atlas.scene.exporter import describe_scene

    facts = describe_scene(path)
    if as_json:
        show_json(facts)
        return
    rows = table(str(path), ["", "value"])
    rows.add_row("name", escape(facts["name"]))
    rows.add_row("bytes", f"{facts['bytes']:,}")
    rows.add_row("states", escape(", ".join(facts["states"])))
    rows.add_row("sheets", f"{len(facts['sheets']):,}")
    rows.add_row("smaller levels", f"{facts['levels']:,}")
    rows.add_row("tiles", "of each state apart" if facts["apart"] else "shared by the states")
    rows.add_row("colour texture", _pages(*facts["colour_size"]))
    if facts["colour"] == "mixed":
        rows.add_row("texture of blocks", _pages(*facts["block_size"]))
    rows.add_row("table", "x".join(map(str, facts["lut_size"])))
    rows.add_row("factors of a state", f"{facts['factors']:,}")
    rows.add_row("CR of all textures", f"{facts['cr']:.2%}")
    rows.add_row("CR on disk", f"{facts['cr_disk']:.2%}")
    rows.add_row("source", escape(facts["source"]))
    rows.add_row("profile", escape(facts["profile"]["name"]))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    show(rows)


def _pages(width: int, height: int, pages: int) -> str:
    return f"{width}x{height}, {pages} page{'' if pages == 1 else 's'}"


def evaluate_scene(folder: Path, views: int, resolution: int, json_path: Path | None, device: str, trust: bool) -> None:
    """Scores a folder against the original lightmaps."""
    from wlm.atlas.scene.data import load_scene
    from wlm.atlas.scene.evaluation import evaluate_scene
    from wlm.atlas.scene.exporter import REPORT_FILE, read_scene

    model, report = read_scene(folder)
    inputs = report.get("inputs")
    if not isinstance(inputs, dict) or not isinstance(inputs.get("scene"), str):
        raise WlmError(f"{folder / REPORT_FILE}: inputs.scene: expected a path")
    lights, uv_set = inputs.get("lights"), inputs.get("uv_set")
    if not isinstance(lights, str | None) or not isinstance(uv_set, int | None):
        raise WlmError(f"{folder / REPORT_FILE}: inputs: expected a path as lights and a number as uv_set")
    scene = load_scene(inputs["scene"], lights, uv_set=uv_set, trust=trust)
    with running("evaluate") as progress:
        options = {"views": views, "resolution": resolution, "device": device}
        score = evaluate_scene(model, scene, **options, progress=progress)
    if json_path is not None:
        write_json(json_path, score.to_json() | {"cameras": views, "resolution": resolution, "device": device})
    rows = table(f"{folder}: {score.views} views, {len(model.states)} states", ["", "value"])
    rows.add_row("CR (eq. 9)", f"{score.cr:.2%}")
    rows.add_row("CR on disk", f"{score.cr_disk:.2%}")
    for label, value in (
        ("PSNR dB", score.psnr),
        ("PSNR dB, from around", score.around_psnr),
        ("PSNR dB, from inside", score.inside_psnr),
        ("PSNR dB, worst", score.psnr_worst),
        ("PSNR dB of texels", score.texel_psnr),
    ):
        rows.add_row(label, number(value, ".2f"))
    for state, value, peak in zip(model.states, score.psnr_by_state, score.peaks, strict=True):
        rows.add_row(f"PSNR dB, {escape(state)}", f"{number(value, '.2f')} (peak {number(peak, '.4g')})")
    show(rows)
