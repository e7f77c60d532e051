"""Describes folders: groups of files that belong together, and single files."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

from wlm.atlas.listing import tiles_of
from wlm.errors import WlmError, counted
from wlm.formats.folder import read_index
from wlm.formats.gltf import read_gltf
from wlm.formats.godot import read_users
from wlm.formats.hours import hours_of_names
from wlm.formats.levels import SUFFIXES as LEVEL_SUFFIXES
from wlm.formats.light import SUFFIXES
from wlm.formats.meshes import SUFFIXES as MESHES
from wlm.formats.reading import system_errors
from wlm.inspection.files import (
    BAKED,
    FRAMES,
    describe_volume,
    document_of,
    file_system,
    inspect_file,
    kind_of,
    scene_command,
)
from wlm.inspection.finding import UNREADABLE, Finding, command, compress_command
from wlm.inspection.pictures import Picture, is_half, picture_of, said, size_of
from wlm.inspection.sets import UNREADABLE_SET, assumed, inspect_set, named, together
from wlm.lightmap.listing import SET_FILE, list_set, natural, state_folders
from wlm.lightmap.sheet import BASE

MOST = 256
"""Most findings of `inspect`, and most folders that it visits."""

_DEEPEST = 4
_BESIDE = 16  # folders beside a mesh that are examined for its lightmaps
_ENTRIES = 20_000  # most entries that are read of a folder
_DOCUMENTS = 64  # most JSON files that are read of a folder
_MESHES = (".glb", ".gltf", *MESHES)
_BOOKS = (".png", ".tga", ".exr")
_IGNORED = {".md", ".txt", ".meta", ".import", ".uid", ".html", ".pdf", ".py", ".js", ".cs", ".glsl", ".hlsl", ".bin"}
_IGNORED_NAMES = ("license", "licence", "readme", "copying")


def inspect(path: str | os.PathLike[str]) -> list[Finding]:
    """Describes a file, or a folder and the folders inside it, in at most 256 findings.

    Args:
        path: The file or the folder.

    Raises:
        WlmError: It does not exist, or the folder cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    if not path.is_dir():
        return [_inside(path) or inspect_file(path)]
    _entries(path)
    found, waiting = list[Finding](), [(path, 0)]
    for _ in range(MOST):
        if not waiting or len(found) >= MOST:
            break
        folder, depth = waiting.pop()
        findings, inside = _folder(folder, MOST - len(found))
        found += findings
        if depth < _DEEPEST:
            waiting += [(each, depth + 1) for each in reversed(inside)]
    return found or [Finding(path, "no known kind of file")]


def input_system(path: str | os.PathLike[str]) -> str:
    """Finds the system that compresses a file or folder, from names and headers: "lightmap", "atlas", "probe" or
    "smoke".

    Raises:
        WlmError: It does not exist, cannot be read, or is no input of these systems; the message says what to do.
    """
    path = Path(path)
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    found = _folder_system(path) if path.is_dir() else file_system(path)
    if found in _REFUSED or not found:
        reason = _REFUSED.get(found or ("" if path.is_dir() else kind_of(path)), "the kind of input is not clear")
        raise WlmError(f"{path}: {reason}; see wlm inspect, or choose with wlm compress --system NAME")
    return found


_REFUSED = {
    "model": "it is already compressed",
    "picture": "one lightmap is compressed with its mesh: wlm compress MESH LIGHTMAP",
    "meshes": "lightmaps of different sizes are compressed with their mesh: wlm compress MESH FOLDER",
    "export": "it is an export, not an input",
}


def _folder_system(folder: Path) -> str:
    """Returns "lightmap" for a folder that it compresses; "smoke", "export" or "meshes" if no system does; or ""."""
    if (folder / SET_FILE).is_file() or state_folders(folder):
        return "lightmap"
    files = [entry for entry in _entries(folder) if entry.is_file()]
    documents = [file for file in files if file.suffix.lower() == ".json"][:_DOCUMENTS]
    if stated := next(filter(None, map(document_of, documents)), None):
        return "smoke" if stated == FRAMES else "export"
    if not (pictures := _light(files)):
        kinds = {file.suffix.lower() for file in files if file.name != "mask.png" and not is_half(file)}
        if kinds & {".vdb", ".nvdb"}:
            return "smoke"
        # Pictures of integers are light once their encoding is stated.
        return "lightmap" if kinds & {*LEVEL_SUFFIXES, ".tif", ".tiff"} else ""
    sizes = {picture.size for picture in pictures.values() if picture.width}
    return "meshes" if len(sizes) > 1 else "lightmap"


def _folder(folder: Path, most: int) -> tuple[list[Finding], list[Path]]:
    """Describes a folder in at most `most` findings; also returns the subfolders that no finding covers."""
    findings, taken = list[Finding](), set[Path]()
    try:
        entries = _entries(folder)
        files = [entry for entry in entries if entry.is_file()]
        for whole in (_documents, _unity, _godot, _flip_books, _mesh_folders, _pictures, _volumes):
            for finding, its in whole(folder, [file for file in files if file not in taken]):
                findings.append(finding)
                taken |= its
    except WlmError as error:
        return [Finding(folder, UNREADABLE, problems=(said(error, folder),))], []
    rest = (file for file in files if file not in taken and not _is_ignored(file))
    findings += map(inspect_file, islice(rest, max(most - len(findings), 0)))
    inside = [entry for entry in entries if entry not in taken and entry.is_dir() and not entry.is_symlink()]
    return findings[:most], inside


def _entries(folder: Path) -> list[Path]:
    with system_errors(f"{folder}: cannot read the folder"):
        found = [Path(entry.path) for entry in islice(os.scandir(folder), _ENTRIES) if entry.name[0] != "."]
    return sorted(found, key=lambda path: (natural(path.name), path.name))


def _inside(path: Path) -> Finding | None:
    """Describes a file together with those beside it, if it is part of a flip book or of an export."""
    names = {name for back in (False, True) for name, _ in _book_names(path, back)}
    with suppress(WlmError):
        beside = [entry for entry in _entries(path.parent) if entry == path or entry.name.lower() in names]
        for finding, its in _flip_books(path.parent, beside) if names else ():
            if path in its:
                return finding
    index = path.with_name("bundle.json")
    stated, listed = document_of(index), read_index(index).get("files")
    if stated is None or not isinstance(listed, list) or path.name not in listed:
        return None
    return Finding(path, f"a file of the folder {path.parent}: {stated}")


def _book_names(file: Path, back: bool = False) -> list[tuple[str, str]]:
    """Returns possible file names, in lower case, of a flip book's second texture (`back`: first), with its layout."""
    if file.suffix.lower() not in _BOOKS:
        return []
    # This imports torch, which takes seconds.
    from wlm.smoke.flipbook.naming import second_names

    return [(f"{name}{file.suffix}".lower(), layout) for name, layout in second_names(file.stem, back)]


def _is_ignored(file: Path) -> bool:
    return file.suffix.lower() in _IGNORED or file.name.lower().startswith(_IGNORED_NAMES)


_Found = list[tuple[Finding, set[Path]]]


def _documents(folder: Path, files: Sequence[Path]) -> _Found:
    documents = [file for file in files if file.suffix.lower() == ".json"]
    for file in sorted(documents, key=lambda file: file.name != SET_FILE)[:_DOCUMENTS]:
        if file.name == SET_FILE:
            finding = inspect_set(file)
            listed = set() if finding.what == UNREADABLE_SET else {file, *named(file, files)}
            if any(document_of(each) == BAKED for each in documents):
                listed = set(files)
            return [(finding, listed | {file})]
        if (stated := document_of(file)) is not None:
            # All files of the folder belong to that output.
            its = set(files) | set(_entries(folder))
            return [(_simulated(folder) if stated == FRAMES else Finding(folder, stated), its)]
    return []


def _simulated(folder: Path) -> Finding:
    from wlm.smoke.data import load_frames

    try:
        frames = load_frames(folder)
        frames.load(frames.numbers[-1])
    except WlmError as error:
        return Finding(folder, FRAMES, problems=(said(error, folder),))
    return Finding(folder, FRAMES, command("smoke", "bake", folder, "-o", "DIR"), frames.warnings)


def _unity(folder: Path, files: Sequence[Path]) -> _Found:
    states = state_folders(folder)
    if not states or (folder / SET_FILE).is_file():
        return []
    held = {state: [entry for entry in _entries(state) if "_comp_" in entry.name.lower()] for state in states}
    problems, times, options = list[str](), None, list[str]()
    if len(states) > 1 and None in hours_of_names([state.name for state in states])[0]:
        times, options = range(len(states)), ["--times", f"0:{len(states)}:1"]
        problems.append(f"the hours of {', '.join(state.name for state in states[:8])} are unknown: change --times")
    listing = list_set(folder, times)[BASE]
    sizes, words = [], compress_command(folder, *options)
    for atlas in listing.atlases:
        paths = [one[key].path for one in listing.states for key in [(atlas.name, "light")] if key in one]
        try:
            heads = [picture_of(path) for path in paths]
            sizes += sorted({size_of(path) for path in paths})
            problems += [f"{atlas.name}: {text}" for text in together(paths, heads)[0]]
        except WlmError as error:
            words = ""
            problems.append(said(error, folder))
    problems += assumed(listing)
    names = ", ".join(layer.name for layer in listing.layers)
    size = " and ".join(dict.fromkeys(sizes))
    maps = f"{counted(len(listing.atlases), 'map')} of {size}, with {names}"
    what = f"{counted(len(states), 'state')} of light from Unity, {maps}"
    finding = Finding(folder, what, words, tuple(problems))
    its = {path for paths in held.values() for path in paths}
    if states == [folder]:
        return [(finding, its)]
    # Other files in the folders of the states are described here, because these folders are not visited again.
    rest = [
        entry
        for state in states
        for entry in _entries(state)
        if entry not in its and entry.is_file() and not _is_ignored(entry)
    ]
    return [(finding, set(states)), *((inspect_file(entry), set()) for entry in rest)]


def _godot(folder: Path, files: Sequence[Path]) -> _Found:
    found: _Found = []
    for file in files:
        if file.suffix.lower() != ".lmbake":
            continue
        try:
            textures = {texture.rsplit("/", 1)[-1] for texture in read_users(file).textures}
        except WlmError:
            continue  # described by itself
        found.append((inspect_file(file), {file, *(each for each in files if each.name in textures)}))
    return found


def _flip_books(folder: Path, files: Sequence[Path]) -> _Found:
    """Describes pairs of textures that by names, perhaps also light, are a flip book of six-way lightmaps."""
    pictures = {file.name.lower(): file for file in files if file.suffix.lower() in _BOOKS}
    found: _Found = []
    taken: set[Path] = set()
    for file in list(pictures.values())[:_DOCUMENTS]:
        for name, layout in _book_names(file):
            other = pictures.get(name, file)
            if other == file or taken & {file, other}:
                continue
            # This imports torch, which takes seconds.
            from wlm.smoke.flipbook.reading import guess_book, read_flipbook

            what, notes = f"a flip book of six-way lightmaps of smoke, with {other.name}", list[str]()
            words = ""
            try:
                if not layout and guess_book(file, other) is None:
                    continue
                frames = read_flipbook((file, other), layout or None, notes=notes)
                use = "shade"
                if frames[0].transparency is None:
                    notes.append("no opacity: wlm smoke shade needs the texture that has it as a second --with")
                    use = "flipbook"
                output = "OUT.png" if use == "flipbook" or len(frames) == 1 else "DIR"
                chosen = ("--from", layout) if layout else ()
                words = command("smoke", use, file, "--with", other, *chosen, "-o", output)
            except WlmError as error:
                if not layout:
                    continue
                notes = [said(error, file)]
            found.append((Finding(file, what, words, tuple(notes)), {file, other}))
            taken |= {file, other}
    return found


def _light(files: Sequence[Path]) -> dict[Path, Picture]:
    """Returns the headers of all readable pictures of light among the files, except reflection probes and halves of
    flip books."""
    found = {}
    for file in files:
        if file.suffix.lower() in SUFFIXES:
            with suppress(WlmError):  # an unreadable file is described by itself
                picture = picture_of(file)
                if picture is not None and not picture.is_cube and picture.is_light and not is_half(file):
                    found[file] = picture
    return found


def _pictures(folder: Path, files: Sequence[Path]) -> _Found:
    heads = _light(files)
    smoke = [file for file, head in heads.items() if head.is_six_way]
    if smoke:
        # This imports torch, which takes seconds.
        from wlm.smoke.data import six_way_files

        try:
            alike = len(six_way_files(folder)) == len(smoke)
        except WlmError:
            alike = False
        if not alike:
            return []  # each is described by itself
        what = f"six-way lightmaps of smoke, {counted(len(smoke), 'frame')} of {heads[smoke[0]].size}"
        return [(Finding(folder, what, command("smoke", "flipbook", folder, "-o", "OUT.png")), set(smoke))]
    if (folder / SET_FILE).is_file():
        return []  # it lists the lightmaps of the folder; others are described by themselves
    pictures = [file for file in heads if "_comp_" not in file.name.lower()]
    meshes = [file for file in files if file.suffix.lower() in _MESHES]
    mesh = meshes[0] if len(meshes) == 1 else None
    if mesh is not None and len(pictures) == 1:
        alone = inspect_file(mesh)
        if alone.command:  # the mesh names its lightmaps itself
            return [(alone, {mesh, *pictures})]
        light = inspect_file(pictures[0])
        if UNREADABLE in (alone.what, light.what):
            return []
        words, notes = scene_command(mesh, pictures[0])
        problems = dict.fromkeys((*alone.problems, *light.problems, *notes))
        return [(Finding(mesh, f"a mesh with the lightmap {pictures[0].name}", words, (*problems,)), {mesh, *pictures})]
    if what := _lightmaps_of(mesh, pictures):
        return [_of_mesh(folder, what, mesh, pictures)]
    if len(pictures) < 2:
        return []
    what, words, problems = counted(len(pictures), "lightmap"), "", list[str]()
    try:
        problems, size = together(pictures, [heads[file] for file in pictures])
        if not size:
            # The charts show which lightmap belongs to which mesh of the scene.
            return [_of_mesh(folder, f"{what} of different UV layouts, not times of one", mesh, pictures, problems)]
        times, options, what = None, list[str](), f"{what} of {size}"
        if None in hours_of_names([file.stem for file in pictures])[0]:
            times, options = range(len(pictures)), ["--times", f"0:{len(pictures)}:1"]
            problems.append("the names state no hours: are they one lightmap at several times? Then change --times")
        if others := [file for file in _entries(folder) if file.suffix.lower() in SUFFIXES and file not in pictures]:
            raise WlmError(
                f"{others[0].name} is no lightmap that can be read: move it away, or list the lightmaps in a {SET_FILE}"
            )
        problems += assumed(list_set(folder, times)[BASE])
        words = compress_command(folder, *options)
    except WlmError as error:
        problems.append(said(error, folder))
    taken = {*pictures, folder / "mask.png"} & set(files)
    return [(Finding(folder, what, words, tuple(problems)), taken)]


def _of_mesh(
    folder: Path, what: str, mesh: Path | None, pictures: Sequence[Path], problems: Sequence[str] = ()
) -> tuple[Finding, set[Path]]:
    """Describes a folder's lightmaps of meshes, and how to compress them if the `mesh` file is known, not None."""
    if mesh is None:
        return Finding(folder, f"{what}; compress them with their mesh", problems=tuple(problems)), set(pictures)
    words, notes = scene_command(mesh, folder)
    return Finding(folder, f"{what}, with {mesh.name}", words, (*problems, *notes)), {*pictures, mesh}


def _lightmaps_of(mesh: Path | None, pictures: Sequence[Path]) -> str:
    """Describes lightmaps that are named by UDIM tiles, or after the meshes of a file, in words; "" for others."""
    if tiles := tiles_of([file.stem for file in pictures]):
        return f"{counted(len(pictures), 'lightmap')} of the UDIM tiles {', '.join(map(str, tiles[:8]))}"
    if mesh is None or len(pictures) < 2:
        return ""
    # This imports torch.
    from wlm.atlas.matching import all_by_name

    with suppress(WlmError):  # described by itself
        if all_by_name([file.name for file in pictures], read_gltf(mesh)[1]):
            return f"{counted(len(pictures), 'lightmap')} named after the meshes of {mesh.name}"
    return ""


def _mesh_folders(folder: Path, files: Sequence[Path]) -> _Found:
    """Describes subfolders of lightmaps named by UDIM tiles or after meshes, if one glTF file lies beside them."""
    meshes = [file for file in files if file.suffix.lower() in (".glb", ".gltf")]
    if len(meshes) != 1:
        return []
    found: _Found = []
    for inside in [entry for entry in _entries(folder) if entry.is_dir() and not entry.is_symlink()][:_BESIDE]:
        pictures = list(_light([entry for entry in _entries(inside) if entry.is_file()]))
        if what := _lightmaps_of(meshes[0], pictures):
            found.append((Finding(inside, what, *scene_command(meshes[0], inside)), {inside}))
    return found


def _volumes(folder: Path, files: Sequence[Path]) -> _Found:
    volumes = [file for file in files if file.suffix.lower() in (".vdb", ".nvdb")]
    if len(volumes) < 2:
        return []
    from wlm.smoke.data import load_frames

    try:
        frames = load_frames(folder, up="y")
        last = frames.file(frames.numbers[-1])
        volume = frames.load(frames.numbers[-1])
    except WlmError:
        return []  # each file is described by itself
    if not set(frames.files.values()) <= set(volumes):
        return []
    what = f"{len(frames.files)} frames of smoke, the last of them"
    finding = describe_volume(folder, volume, last, "DIR", what)
    return [(replace(finding, problems=(*frames.warnings, *finding.problems)), set(frames.files.values()))]
