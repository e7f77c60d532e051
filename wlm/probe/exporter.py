"""Writing bundles of probes as folders: buffers, shader, document and reference as plain files."""

import os
from pathlib import Path

from wlm.bundle import Bundle
from wlm.export.shading import ENDINGS, check_language, translate
from wlm.formats.folder import made_parents, staged, write_index
from wlm.probe.bundle import bundle, volume_bundle
from wlm.probe.model import ProbeModel
from wlm.probe.volume.cascade import Volume

FORMAT, VOLUME_FORMAT = "wlm-probe-export", "wlm-probe-volume"
_VERSION = 2
_REFERENCE = "reference.json"


def export(
    model: ProbeModel, directory: str | os.PathLike[str], *, device: str = "cpu", shader: str = "glsl"
) -> list[Path]:
    """Writes a model's bundle: a `.bin` for each buffer, `probe.glsl`, `reference.json` and `probe.json`.

    Args:
        model: The model.
        directory: The folder; it is created if it does not exist. A new export replaces an earlier one.
        device: Where the reference is decoded.
        shader: One of `wlm.export.shading.LANGUAGES`.

    Returns:
        The files written, `probe.json` last.

    Raises:
        WlmError: The folder has other content or cannot be written, or the model cannot be exported.
    """
    check_language(shader)
    return _write(bundle(model, device=device), Path(directory), "probe", FORMAT, (shader,))


def export_volume(volume: Volume, directory: str | os.PathLike[str]) -> list[Path]:
    """Writes a volume's bundle, with the shader in GLSL and HLSL; arguments and errors as for `export`."""
    return _write(volume_bundle(volume), Path(directory), "volume", VOLUME_FORMAT, ("glsl", "hlsl"))


def _write(made: Bundle, folder: Path, stem: str, form: str, languages: tuple[str, ...]) -> list[Path]:
    files = {f"{name}.bin": buffer.tobytes() for name, buffer in made.buffers.items()}
    files |= {stem + ENDINGS[language]: translate(made.shader, language).encode() for language in languages}
    document = {"format": form, "version": _VERSION} | dict(made.document)
    document |= {"bytes": {name: len(content) for name, content in files.items()}}
    index = f"{stem}.json"
    ours = {*files, index, _REFERENCE, "positions.bin", *(stem + ending for ending in ENDINGS.values())}
    with made_parents(folder), staged(folder, index, form, ours.__contains__) as temporary:
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        write_index(temporary / _REFERENCE, {name: array.tolist() for name, array in made.reference.items()})
        write_index(temporary / index, document)
    return [folder / name for name in (*files, _REFERENCE, index)]
