"""The viewer makes of a file in the browser what Python makes of it for a page, and decodes the same light."""

import base64
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from builders import atlas_meshes, atlas_models, probe_models, synthetic
from builders.contract import FILES
from builders.page_numbers import numbers

import wlm
from wlm.export import make_page, write_viewer
from wlm.lightmap.profile import Profile
from wlm.system import load

HOUR = 11.0  # the hour that is nearest to noon
STREET = Path(__file__).parents[3] / "demos" / "data" / "street"
STORED = ["lightmap", "lightmap-frames", "lightmap-groups", "lightmap-layers", "atlas-tiles", "probe", "probe-pca"]
ATLASES = {"tiles": "bc6h", "tiles mixed": "mixed", "cascade": "half", "plain": "rgb9e5", "plain with uv": "bc6h"}
MADE = {
    "paper": lambda: synthetic.random_model((3, 3, 4, 1), hidden=18, plane_rows=5, time_axis="paper", gelu="exact"),
    "network": lambda: synthetic.random_model((3, 3, 3, 1, 3, 0), 3, interpolation="network", gamma=1.8),
    "spheres": lambda: probe_models.whole_model(positions=True, support="sphere", error="absolute", outputs=12),
    "units": lambda: _components(np.random.default_rng(2).random((4, 27))),
    "hours": lambda: _components(np.random.default_rng(3).random((2, 30, 27)), times=(3.0, HOUR)),
}
MADE |= {
    f"{kind} {colour}": lambda kind=kind, colour=colour: atlas_models.random_model(atlas_meshes.charts(), kind, colour)
    for kind, colour in ATLASES.items()
}


def _components(values, **options):
    place = np.random.default_rng(1).random((values.shape[-2], 3))
    return wlm.probe.compress(wlm.probe.from_arrays(place, values, **options), "pca", positions=True)


# Comments, what the preprocessor reads, declarations of textures and buffers, and functions that no page calls.
SKIPPED = r"#ifdef WLM_PROBE_LIST.*?#endif|layout\(std430.*?};|//[^\n]*|#[^\n]*|layout[^\n]*|uniform[^\n]*"


@pytest.fixture
def view(tmp_path, show):
    """Opens files in the viewer."""
    write_viewer(tmp_path / "viewer.html")
    page = show(tmp_path / "viewer.html")

    def open_files(*paths):
        page.locator("#file").set_input_files(paths)
        page.evaluate("wlm.then(() => 0, () => 1)")
        return page

    open_files.page, open_files.errors = page, show.errors
    return open_files


def check_content(page, files, **options) -> None:
    """Compares the arrays and shaders of the open file with those of the page that Python makes."""
    made = make_page(files, **options)
    stored = {"colour", "blocks"} if made.kind == "atlas" else set()  # as they are in the file
    assert set(page.evaluate("wlm.then(({page}) => Object.keys(page.arrays))")) == set(made.arrays)
    for name in set(made.arrays) - stored:
        read = f"wlm.then(({{page}}) => Array.from(page.array('{name}', Uint8Array)))"
        found, expected = np.array(page.evaluate(read), np.uint8), np.ascontiguousarray(made.arrays[name])
        apart = np.abs(found.astype(int) - expected.reshape(-1).view(np.uint8))
        assert apart.max(initial=0) <= (made.kind == "smoke"), name  # of smoke roundings of square roots differ
    manifest = page.evaluate("wlm.then(({manifest}) => ({...manifest}))")
    groups = made.manifest.get("groups", [made.manifest])
    for own, expected in zip(manifest.get("groups", [manifest]), groups, strict=True):
        found, wanted = (re.sub(SKIPPED, "", each.get("shader", ""), flags=re.S).split() for each in (own, expected))
        assert found == wanted
    # All but a hundredth of the light is below white.
    assert made.manifest["exposure"] / 3 < manifest["exposure"] < made.manifest["exposure"] * 3


def check_light(page, path) -> None:
    """Compares the light that the page decodes with Python's."""
    model = load(path)
    if model.SYSTEM == "lightmap":
        for time in (0.0, 9.1):
            expected, power = model.decoder().frame(time), 1 / model.light.profile.gamma
            found = numbers(page, f"kind.read({time})").reshape(*expected.shape[:2], 4)[..., :3]
            assert np.abs(np.maximum(found, 0.0) ** power - expected**power).max() < 2 / 255 * expected.max() ** power
        return
    if model.SYSTEM == "atlas":
        uv = atlas_models.off_borders(model, np.random.default_rng(1).random((500, 2)).astype(np.float32))
        expected = model.decoder().read(torch.from_numpy(uv)).numpy()
        found = numbers(page, f"kind.read({json.dumps(uv.ravel().tolist())})").reshape(-1, 4)[:, :3]
    else:
        expected = model.at(HOUR if len(model.times) else None).decoder().decode_probes()[model.live][:, :27]
        found = numbers(page, "kind.read()").reshape(len(expected), 27)[:, : expected.shape[1]]
    assert np.abs(found - expected).max() < 2 / 255 * np.abs(expected).max()


FIRST = {"lightmap", "lightmap-frames", "tiles mixed mixed", "probe"}
"""Tested always; the others in the long run, since a page takes seconds."""


@pytest.mark.parametrize(
    "name",
    [name if name in FIRST else pytest.param(name, marks=pytest.mark.slow) for name in (*STORED, *MADE)],
)
def test_a_file_is_shown_as_by_python(name, tmp_path, view):
    path = FILES / f"{name}.wlm" if name in STORED else tmp_path / "made.wlm"
    if name in MADE:
        MADE[name]().save(path)
    page = view(path)
    check_content(page, [path], **({"time": HOUR} if name == "hours" else {}))
    check_light(page, path)


def test_frames_of_smoke(view):
    frames = sorted((STREET / "smoke").glob("*.exr"))[:3]
    check_content(view(*reversed(frames)), frames)


def test_a_file_without_positions_and_a_mesh(tmp_path, view):
    probe_models.whole_model().save(tmp_path / "bare.wlm")
    atlas_meshes.write_files(tmp_path, atlas_meshes.charts())
    page = view(tmp_path / "bare.wlm", *tmp_path.glob("*.glb"))
    assert "lattice" in page.locator("#panel p").first.inner_text()
    assert len(numbers(page, "kind.read(1)")) > 0, "the mesh is lit"


def test_sizes_along_time_follow_the_number_of_times(view):
    for profile in (Profile(name="", follow_times=True), Profile(name="", follow_times=True, uvt_slices=1)):
        script = "(profile) => Array.from({length: 99}, (_, i) => sheetProfile(profile, i + 1, 'radiance').uvt_slices)"
        expected = [profile.for_times(count).uvt_slices for count in range(1, 100)]
        assert view.page.evaluate(script, profile.model_dump()) == expected


def test_files_that_are_damaged_or_of_another_kind(tmp_path, view):
    data = (FILES / "lightmap.wlm").read_bytes()
    index, piece = 108 + data[0] + 256 * data[1], len(data) - 9
    for name, content, words in (
        ("old.wlm", data.replace(b'"3 lightmap', b'"2 lightmap'), "compress the input again"),
        ("index.wlm", data[:index] + bytes([data[index] ^ 1]) + data[index + 1 :], "digest"),
        ("piece.wlm", data[:piece] + bytes([data[piece] ^ 1]) + data[piece + 1 :], "piece 1 is damaged"),
        ("cut.wlm", data[:300], "cut short"),
        ("empty.wlm", b"", "expected a .wlm file"),
        ("network.wlm", (FILES / "smoke.wlm").read_bytes(), "expected lightmaps predicted"),
        ("several.wlm", (FILES / "atlas-shared.wlm").read_bytes(), "one lightmap"),
        ("smoke.exr", next((STREET / "smoke").glob("*.exr")).read_bytes()[:3000], "damaged"),
    ):
        (tmp_path / name).write_bytes(content)
        message = view(tmp_path / name).locator("#message").inner_text()
        assert message.startswith(f"{name}: ") and words in message and "\n" not in message
    assert view(FILES / "probe.wlm").locator("#message").is_hidden(), "the next file opens"
    view.errors.clear()  # the page also throws them, for the console


def test_zstd_frames(view):
    """Frames of all levels and kinds of data, among them bytes that no code makes smaller, and of several blocks."""
    random = np.random.default_rng(0)
    data = [b"", b"a", bytes(200_000), random.bytes(5000), b"the quick brown fox " * 9000, Path(__file__).read_bytes()]
    data.append((random.normal(size=90_000) * 9).astype("i1").tobytes())
    data.append(np.cumsum(random.integers(-2, 3, 90_000)).astype("<i2").tobytes())
    cases = [(zstandard.compress(each, level), each) for each in data for level in (-5, 1, 3, 6, 9, 14, 19, 22)]
    unsized = zstandard.ZstdCompressor(write_checksum=True, write_content_size=False)
    cases += [(unsized.compress(each), each) for each in data]
    script = """(cases) => cases.map(([text, size]) => {
        try {
            return hexadecimals(blake2b([unzstd(Uint8Array.from(atob(text), (x) => x.charCodeAt(0)), size)], 64));
        } catch (error) { return error.message; }
    })"""
    sent = [[base64.b64encode(frame).decode(), len(each)] for frame, each in cases]
    assert view.page.evaluate(script, sent) == [hashlib.blake2b(each).hexdigest() for _, each in cases]
    # A frame that is cut short, or has another size.
    wrong = [[base64.b64encode(frame[:-2]).decode(), len(each)] for frame, each in cases]
    wrong += [[text, size + 1] for text, size in sent]
    assert all("zstd" in text for text in view.page.evaluate(script, wrong))
