"""What a folder holds as a whole, and the files in it that belong to nothing else."""

import os
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from PIL import Image

from wlm.errors import WlmError
from wlm.formats.godot import read_users
from wlm.formats.light import SUFFIXES
from wlm.inspection.files import BAKED, document_of, inspect_file
from wlm.inspection.finding import Finding, quoted
from wlm.inspection.pictures import picture_of, said
from wlm.inspection.sets import UNREADABLE, compress_command, inspect_set, named, together
from wlm.lightmap.listing import SET_FILE, count_of, list_set, natural, state_folders, time_of_name

MOST = 256
"""Findings that are told, and folders that are looked into."""

_DEEPEST = 4
_ENTRIES = 20_000  # of one folder
_DOCUMENTS = 64  # of one folder, that are read to see whether they are of all that is in it
_SILENT = {".md", ".txt", ".meta", ".import", ".uid", ".html", ".pdf", ".py", ".js", ".cs", ".glsl", ".hlsl", ".bin"}
# The channels of the two textures, as their names have them.
_BOOKS = (("rlt", "bbf", "o3de"), ("tlr", "bbf", "embergen"), ("rtb", "lbf", "unity"), ("tlrb", "fb", "o3de-tlrb"))
_SILENT_NAMES = ("license", "licence", "readme", "copying")


def inspect(path: str | os.PathLike[str]) -> list[Finding]:
    """Says what a file holds, or a folder and those in it, in 256 lines at most.

    Args:
        path: The file or the folder.

    Raises:
        WlmError: There is none, or a folder can't be read.
    """
    path = Path(path)
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    if not path.is_dir():
        return [inspect_file(path)]
    _entries(path)
    found: list[Finding] = []
    waiting = [(path, 0)]
    for _ in range(MOST):
        if not waiting or len(found) >= MOST:
            break
        folder, depth = waiting.pop()
        findings, inside = _folder(folder, MOST - len(found))
        found += findings
        if depth < _DEEPEST:
            waiting += [(each, depth + 1) for each in reversed(inside)]
    return found or [Finding(path, "nothing that is known here")]


def _folder(folder: Path, most: int) -> tuple[list[Finding], list[Path]]:
    """What is in a folder itself, so many findings at most, and the folders in it that belong to none of them."""
    findings: list[Finding] = []
    taken: set[Path] = set()
    try:
        entries = _entries(folder)
        files = [entry for entry in entries if entry.is_file()]
        for whole in (_documents, _unity, _godot, _flip_books, _pictures):
            for finding, its in whole(folder, [file for file in files if file not in taken]):
                findings.append(finding)
                taken |= its
    except WlmError as error:
        return [Finding(folder, "can't be read", problems=(said(error, folder),))], []
    rest = (file for file in files if file not in taken and not _is_silent(file))
    findings += map(inspect_file, islice(rest, max(most - len(findings), 0)))
    inside = [entry for entry in entries if entry not in taken and entry.is_dir() and not entry.is_symlink()]
    return findings[:most], inside


def _entries(folder: Path) -> list[Path]:
    try:
        found = [Path(entry.path) for entry in islice(os.scandir(folder), _ENTRIES) if entry.name[0] != "."]
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error
    return sorted(found, key=lambda path: (natural(path.name), path.name))


def _is_silent(file: Path) -> bool:
    return file.suffix.lower() in _SILENT or file.name.lower().startswith(_SILENT_NAMES)


_Found = list[tuple[Finding, set[Path]]]


def _documents(folder: Path, files: Sequence[Path]) -> _Found:
    """What a JSON of ours says that the folder is; a `set.json`."""
    documents = [file for file in files if file.suffix.lower() == ".json"]
    for file in sorted(documents, key=lambda file: file.name != SET_FILE)[:_DOCUMENTS]:
        if file.name == SET_FILE:
            finding = inspect_set(file)
            listed = set() if finding.what == UNREADABLE else {file, *named(file, files)}
            if any(document_of(each) == BAKED for each in documents):
                listed = set(files)
            return [(finding, listed | {file})]
        stated = document_of(file)
        if stated is not None:
            # All of it is that output's.
            return [(Finding(folder, stated, _next(folder, stated)), set(files) | set(_entries(folder)))]
    return []


def _next(folder: Path, stated: str) -> str:
    return f"wlm smoke bake {quoted(folder)} -o DIR" if "frames of smoke" in stated else ""


def _unity(folder: Path, files: Sequence[Path]) -> _Found:
    """States of light as Unity bakes them, the folder's own or those of folders in it."""
    states = state_folders(folder)
    if not states or (folder / SET_FILE).is_file():
        return []
    held = {state: [entry for entry in _entries(state) if "_comp_" in entry.name.lower()] for state in states}
    times = [time_of_name(state.name) for state in states]
    problems, option = [], ""
    if len(states) > 1 and None in times:
        option = f" --times {','.join(str(i) for i in range(len(states)))}"
        problems.append(f"the hours of {', '.join(state.name for state in states[:8])} aren't known: say them")
    stated: list[float] = [float(i) for i in range(len(states))]
    layers = ""
    try:
        listing = list_set(folder, stated)
    except WlmError as error:
        problems.append(said(error, folder))
        shared = ["light", *(name for name in ("dir", "shadowmask") if _lists(folder, stated, ["light", name]))]
        layers, listing = f" --layers {','.join(shared)}", list_set(folder, stated, shared)
    sizes = []
    for atlas in listing.atlases:
        paths = [one[atlas.name, "light"].path for one in listing.states]
        heads = [picture_of(path) for path in paths]
        sizes += sorted({head.size for head in heads if head is not None})
        problems += [f"{atlas.name}: {text}" for text in together(paths, heads).problems]
    names = ", ".join(layer.name for layer in listing.layers)
    size = " and ".join(dict.fromkeys(sizes))
    maps = f"{count_of(listing.atlases, 'map')} of {size}, with {names}"
    what = f"{count_of(states, 'state')} of Unity's light, {maps}"
    finding = Finding(folder, what, compress_command(folder, option + layers), tuple(problems))
    its = {path for paths in held.values() for path in paths}
    if states == [folder]:
        return [(finding, its)]
    # What else lies in the states' folders is told here: they aren't looked into again.
    rest = [
        entry
        for state in states
        for entry in _entries(state)
        if entry not in its and entry.is_file() and not _is_silent(entry)
    ]
    return [(finding, set(states)), *((inspect_file(entry), set()) for entry in rest)]


def _lists(folder: Path, times: list[float], layers: list[str]) -> bool:
    try:
        list_set(folder, times, layers)
    except WlmError:
        return False
    return True


def _godot(folder: Path, files: Sequence[Path]) -> _Found:
    """Bakes of Godot, with the textures that their meshes read by rectangles."""
    found: _Found = []
    for file in files:
        if file.suffix.lower() != ".lmbake":
            continue
        try:
            textures = {texture.rsplit("/", 1)[-1] for texture in read_users(file).textures}
        except WlmError:
            continue  # told by itself
        found.append((inspect_file(file), {file, *(each for each in files if each.name in textures)}))
    return found


def _flip_books(folder: Path, files: Sequence[Path]) -> _Found:
    """Pairs of textures of six-way lightmaps, as engines name them."""
    found: _Found = []
    for file in files:
        for first, second, layout in _BOOKS:
            match = re.search(rf"(^|[_.-]){first}([_.-]|$)", file.name, re.IGNORECASE)
            if match is None or file.suffix.lower() not in (".png", ".tga", ".exr"):
                continue
            name = file.name[: match.start()] + match[1] + second + match[2] + file.name[match.end() :]
            other = next((each for each in files if each.name.lower() == name.lower()), None)
            if other is None:
                continue
            stated = re.search(r"(\d+)x(\d+)", file.stem)
            cells = "ROWSxCOLUMNS" if stated is None else f"{stated[2]}x{stated[1]}"
            book = f"{quoted(file)} --with {quoted(other)} --from {layout} --cells {cells}"
            what = f"a flip book of six-way lightmaps of smoke, with {other.name}"
            told = Finding(file, what, f"wlm smoke shade {book} -o DIR")
            if not any(map(_may_have_alpha, (file, other))):
                lacking = "no opacity: wlm smoke shade needs the texture that has it, by a second --with"
                told = Finding(file, what, f"wlm smoke flipbook {book} -o OUT.png --layout unity", (lacking,))
            found.append((told, {file, other}))
    return found


def _may_have_alpha(file: Path) -> bool:
    """Whether a texture has an alpha; true of one that can't be read, of which its reader says what is wrong."""
    try:
        head = picture_of(file)
        if head is not None and head.kind == "EXR":
            return "A" in head.channels
        with Image.open(file, formats=["PNG", "TGA"]) as image:
            return "A" in image.getbands()
    except (WlmError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return True


def _pictures(folder: Path, files: Sequence[Path]) -> _Found:
    """Two or more pictures of light: times of one atlas, frames of smoke, or lightmaps of several meshes."""
    heads = {}
    for file in files:
        if file.suffix.lower() in SUFFIXES:
            try:
                heads[file] = picture_of(file)
            except WlmError:
                continue  # told by itself
    heads = {file: head for file, head in heads.items() if head is not None and not head.is_cube and head.kind != "PNG"}
    smoke = [file for file, head in heads.items() if head.is_six_way]
    if smoke:
        what = f"six-way lightmaps of smoke, {count_of(smoke, 'frame')} of {heads[smoke[0]].size}"
        return [(Finding(folder, what, f"wlm smoke flipbook {quoted(folder)} -o OUT.png"), set(smoke))]
    pictures = [file for file in heads if "_comp_" not in file.name.lower()]
    if len(pictures) < 2:
        return []
    problems, alike = together(pictures, [heads[file] for file in pictures])
    if not alike:
        what = f"{count_of(pictures, 'lightmap')} of different atlases: no times of one"
        command = f"wlm atlas compress MESH.glb {quoted(folder)} -o OUT.wlm"
        meshes = [file for file in files if file.suffix.lower() in (".glb", ".gltf")]
        if len(meshes) == 1:
            # The charts tell which lightmap is whose.
            command, what = command.replace("MESH.glb", quoted(meshes[0])), f"{what}, with {meshes[0].name}"
        return [
            (
                Finding(folder, what, command, tuple(problems)),
                {*pictures, *meshes} if len(meshes) == 1 else set(pictures),
            )
        ]
    option = ""
    if any(time_of_name(file.stem) is None for file in pictures):
        option = " --times ..."
        problems.append("no hours in the names: are they one atlas at several times? then say them")
    what = f"{count_of(pictures, 'lightmap')} of {heads[pictures[0]].size}"
    mask = folder / "mask.png"
    taken = {*pictures, mask} & set(files)
    return [(Finding(folder, what, compress_command(folder, option), tuple(problems)), taken)]
