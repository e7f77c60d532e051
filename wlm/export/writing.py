"""`export`: a model as a folder of files for other programs, or as a kit for one engine.

Folders and kits are written from the model's `Bundle`. The folder's index, `bundle.json`, holds the entries of the
bundle's `document`, and beside them:

    format, version     "wlm-bundle" and its number
    system, name        the bundle's system and name
    engine              the engine of a kit; null for a raw folder
    shader              file of the shader; null for a collection
    textures            by name: file, format, width, height, layers of an array (0: no array), mips
    buffers, reference  by name: file, dtype, shape
    parts               names of subfolders, one for each part of a collection, with an index of their own
    files               all files of the folder, except the index
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from wlm.bundle import FORMAT, INDEX_FILE, RESERVED, Bundle
from wlm.errors import WlmError
from wlm.export.compute import compute_shader
from wlm.export.engines.kit import ENGINES, PROBE_ENGINES
from wlm.export.files import write_buffer, write_reference, write_texture
from wlm.export.shading import ENDINGS, check_language, translate
from wlm.formats.folder import compact_json, made_parents, read_index, staged

_VERSION = 1
_KITS = {
    "lightmap": "wlm.export.engines.lightmap",
    "atlas": "wlm.export.engines.atlas",
    "probe": "wlm.probe.engines.{engine}",
    "smoke": "wlm.export.engines.smoke",
    "smoke-network": "wlm.export.engines.smoke",
}
"""Module of each system, whose function `write_kit` writes a bundle for an engine; probes have one per engine.

That of a system with collections has a function `write_collection`, which writes what the kits of the parts share.
"""


def export(
    model: Any,
    folder: str | os.PathLike[str],
    engine: str | None = None,
    *,
    shader: str = "glsl",
    exact: bool = False,
    device: str = "cpu",
    **options: Any,
) -> list[Path]:
    """Writes a model as a folder: raw textures, buffers and a shader, or a kit for an engine.

    All files are written beside the folder and moved in together, the index `bundle.json` last. An earlier export is
    replaced; files that were added to it stay.

    Args:
        model: A lightmap, atlas or probe model, a flip book of smoke, or any object with a method `bundle`; or the
            `Bundle` itself.
        folder: The folder; made if it does not exist.
        engine: One of `wlm.export.ENGINES`, or "bevy" for probes; None for the raw folder.
        shader: Language of the raw folder's shader, one of `wlm.export.LANGUAGES`.
        exact: Whether the raw folder's shader fetches texels and interpolates in floats, without the texture filter.
        device: Device that decodes the model for the folder's reference image, for example "cpu" or "cuda:0".
        options: Options of the kit. Probes: `original`, the file that was compressed, if the model does not store its
            positions; `cells`, the number of a grid's cells along its longest side (three, godot, unreal, bevy);
            `axes`, the scene's axes that become the engine's x, y and z, for example "-x,y,z".

    Returns:
        The files written, the index last.

    Raises:
        WlmError: Unknown engine, language or device; an option that has no meaning here; the folder holds other files
            or cannot be written; a number of the model is not finite; or a texture is larger than GPUs accept.
    """
    check_language(shader)
    if engine is not None and engine not in PROBE_ENGINES:
        raise WlmError(f"engine: expected one of {', '.join(PROBE_ENGINES)}, got {engine!r}")
    if engine is not None and (exact or shader != "glsl"):
        raise WlmError(f"engine {engine}: shader and exact have no meaning for a kit, whose language is the engine's")
    folder = Path(folder)
    with made_parents(folder), staged(folder, INDEX_FILE, FORMAT) as staging:
        bundle = model if isinstance(model, Bundle) else replace(model.bundle(device=device), model=model)
        if engine is None:
            _check_options(options, (), "a raw folder")
            _write_raw(bundle, staging, shader, exact)
        else:
            _write_kit(bundle, staging, engine, device, options)
    return [folder / name for name in (*read_index(folder / INDEX_FILE)["files"], INDEX_FILE)]


def _write_raw(bundle: Bundle, folder: Path, language: str, exact: bool) -> None:
    entries: dict[str, Any] = {"engine": None, "shader": None, "compute": None}
    if bundle.shader:
        if exact and not bundle.exact:
            raise WlmError(f"{bundle.name}: exact has no meaning here: the shader uses no texture filter")
        entries["shader"] = bundle.system + ENDINGS[language]
        text = translate(bundle.shader, language, [bundle.exact] if exact else [])
        (folder / entries["shader"]).write_bytes(text.encode())
        if bundle.compute:
            entries["compute"] = f"{bundle.system}_compute{ENDINGS[language]}"
            text = compute_shader(bundle, language, exact)
            (folder / entries["compute"]).write_bytes(text.encode())
    entries["textures"] = {name: write_texture(folder, name, each) for name, each in bundle.textures.items()}
    entries["buffers"] = {name: write_buffer(folder, name, each) for name, each in bundle.buffers.items()}
    entries["reference"] = {name: write_reference(folder, name, each) for name, each in bundle.reference.items()}
    for name, content in bundle.files.items():
        (folder / name).write_bytes(content)
    for name, part in bundle.parts.items():
        (folder / name).mkdir()
        _write_raw(part, folder / name, language, exact)
    _write_index(bundle, folder, entries | {"parts": list(bundle.parts)}, bundle.document)


def _write_kit(bundle: Bundle, folder: Path, engine: str, device: str, options: dict[str, Any]) -> None:
    """Writes the kit of a bundle, or of each part of a collection that contains light, in a subfolder each."""
    if not bundle.parts or bundle.system == "probe":  # a kit of probes decodes all regions
        module = _KITS.get(bundle.system, "")
        if not module or (engine not in ENGINES and "{engine}" not in module):
            raise WlmError(
                f"{bundle.name}: there is no kit for {engine}; export without an engine: textures, buffers and a shader"
            )
        write_kit = import_module(module.format(engine=engine)).write_kit
        known = tuple(signature(write_kit).parameters)[3:]
        _check_options(options, known, f"a {bundle.system} kit for {engine}")
        if "device" in known:
            options = options | {"device": device}
        entries = write_kit(bundle, folder, engine, **options)
        # A kit with an explanation of its own does not have the bundle's buffers, which the document describes.
        document = {} if "about" in entries else bundle.document
        _write_index(bundle, folder, {"engine": engine} | entries, document)
        return
    parts = {name: part for name, part in bundle.parts.items() if "values" not in part.document}
    if not parts:
        raise WlmError(f"{bundle.name}: cannot export for {engine}: expected a layer of light, found only others")
    import_module(_KITS[bundle.system].format(engine=engine)).write_collection(bundle, folder, engine)
    for name, part in parts.items():
        (folder / name).mkdir()
        _write_kit(part, folder / name, engine, device, options)
        for script in (folder / name).glob("*.cs"):
            # A Unity project can hold a class only once.
            os.replace(script, folder / script.name)
    _write_index(bundle, folder, {"engine": engine, "parts": list(parts)}, bundle.document)


def _check_options(options: Iterable[str], known: Sequence[str], where: str) -> None:
    for name in options:
        if name not in known:
            raise WlmError(f"option {name}: has no meaning for {where}")


def _write_index(bundle: Bundle, folder: Path, entries: dict[str, Any], document: Mapping[str, Any]) -> None:
    if wrong := RESERVED & set(document):
        raise ValueError(
            f"document: expected none of the keys that the export writes itself, got {', '.join(sorted(wrong))}"
        )
    head = {"format": FORMAT, "version": _VERSION, "system": bundle.system, "name": bundle.name}
    try:
        text = compact_json(head | entries | dict(document))
    except ValueError as error:
        raise WlmError(f"{bundle.name}: cannot export: a number is NaN or infinite") from error
    (folder / INDEX_FILE).write_bytes(text.encode())
