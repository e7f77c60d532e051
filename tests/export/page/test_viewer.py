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
from wlm.probe.glsl import buffer_glsl
from wlm.system import load

STREET = Path(__file__).parents[3] / "demos" / "data" / "street"


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


def code_of(shader: str) -> str:
    """The words of a shader, without comments, buffers and the bindings of Vulkan, which the browser lacks."""
    for part, name in (("probe", "gaussians"), ("probe", "network"), ("probe", "probes")):
        for number in (0, 1):
            shader = shader.replace(buffer_glsl(part, name, number), "")
    shader = re.sub(r"#ifdef WLM_PROBE_LIST.*?#endif", "", re.sub(r"//[^\n]*", "", shader), flags=re.S)
    shader = re.sub(
        r"#ifndef (\w+)\n#ifndef \1_BINDING\n(uniform [^\n]*\n)#else\n.*\n#endif\n(#define [^\n]*\n)#endif",
        r"\2\3",
        shader,
    )
    return " ".join(shader.split())


def check_content(page, files, **options) -> None:
    """Compares the arrays and shaders of the open file with those of the page that Python makes."""
    made = make_page(files, **options)
    assert set(page.evaluate("wlm.then(({page, manifest}) => Object.keys(page.arrays))")) == set(made.arrays)
    same = {"colour", "blocks"} if made.kind == "atlas" else set()  # stored as they are in the file
    for name, expected in made.arrays.items():
        if name in same:
            continue
        read = f"wlm.then(({{page}}) => Array.from(page.array('{name}', Uint8Array)))"
        found = np.array(page.evaluate(read), np.uint8).tobytes()
        stored = np.ascontiguousarray(expected)
        if made.kind == "smoke" or name == "places":
            kind = np.uint8 if made.kind == "smoke" else np.float32
            np.testing.assert_allclose(np.frombuffer(found, kind), stored.view(kind).ravel(), atol=1, rtol=1e-6)
        else:
            assert found == stored.tobytes(), name
    manifest = page.evaluate("wlm.then(({manifest}) => ({...manifest}))")
    groups = made.manifest.get("groups", [made.manifest])
    for own, expected in zip(manifest.get("groups", [manifest]), groups, strict=True):
        assert "shader" not in expected or code_of(own["shader"]) == code_of(expected["shader"])
    assert [len(manifest[name]) for name in ("title", "note")] > [0, 0]
    # All but a hundredth of the light is below white.
    assert made.manifest["exposure"] / 3 < manifest["exposure"] < made.manifest["exposure"] * 3


def check_light(page, path) -> None:
    """Compares the light that the page decodes with Python's."""
    model = load(path)
    decoder, kind = model.decoder(), model.SYSTEM
    if kind == "lightmap":
        for time in (0.0, 9.1):
            expected, gamma = decoder.frame(time), model.light.profile.gamma
            found = numbers(page, f"kind.read({time})").reshape(*expected.shape[:2], 4)[..., :3]
            apart = np.maximum(found, 0.0) ** (1 / gamma) - np.maximum(expected, 0.0) ** (1 / gamma)
            assert np.abs(apart).max() < 2 / 255 * expected.max() ** (1 / gamma)
    elif kind == "atlas":
        uv = atlas_models.off_borders(model, np.random.default_rng(1).random((500, 2)).astype(np.float32))
        expected = decoder.read(torch.from_numpy(uv)).numpy()
        found = numbers(page, f"kind.read({json.dumps(uv.ravel().tolist())})").reshape(-1, 4)[:, :3]
        assert np.abs(found - expected).max() < 2 / 255 * expected.max()
    else:
        decoder = model.at(12.0 if len(model.times) else None).decoder()
        expected = decoder.decode_probes()[model.live][:, :27]
        found = numbers(page, "kind.read()").reshape(len(expected), 27)
        assert np.abs(found[:, : expected.shape[1]] - expected).max() < 2 / 255 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["lightmap", "lightmap-frames", "lightmap-groups", "lightmap-layers", "atlas-tiles"])
def test_files_of_lightmaps(name, view):
    page = view(FILES / f"{name}.wlm")
    check_content(page, [FILES / f"{name}.wlm"])
    check_light(page, FILES / f"{name}.wlm")


@pytest.mark.parametrize(
    "settings",
    [
        {"hidden": 18, "plane_rows": 5, "time_axis": "paper", "gelu": "exact"},
        {"interpolation": "network", "gamma": 1.8},
    ],
)
def test_lightmaps_of_other_settings(settings, tmp_path, view):
    synthetic.random_model((3, 3, 4, 1, 3, 3), 3, **settings).save(tmp_path / "random.wlm")
    page = view(tmp_path / "random.wlm")
    check_content(page, [tmp_path / "random.wlm"])
    check_light(page, tmp_path / "random.wlm")


def test_sizes_along_time_follow_the_number_of_times(view):
    for profile in (
        Profile(name="", follow_times=True),
        Profile(name="", follow_times=True, uvt_slices=1, plane_rows=13),
    ):
        expected = [profile.for_times(count) for count in range(1, 200)]
        script = "(profile) => Array.from({length: 199}, (_, i) => sheetProfile(profile, i + 1, 'radiance'))"
        found = view.page.evaluate(script, profile.model_dump())
        assert [(each["uvt_slices"], each["plane_rows"]) for each in found] == [
            (each.uvt_slices, each.plane_rows) for each in expected
        ]


@pytest.mark.parametrize(
    ("kind", "colour"),
    [("tiles", "bc6h"), ("tiles mixed", "mixed"), ("cascade", "half"), ("plain", "rgb9e5"), ("plain with uv", "bc6h")],
)
def test_lightmaps_of_meshes(kind, colour, tmp_path, view):
    atlas_models.random_model(atlas_meshes.charts(), kind, colour).save(tmp_path / "cube.wlm")
    page = view(tmp_path / "cube.wlm")
    check_content(page, [tmp_path / "cube.wlm"])
    check_light(page, tmp_path / "cube.wlm")


@pytest.mark.parametrize("name", ["gaussians", "spheres", "components", "hours", "unit vectors"])
def test_probes(name, tmp_path, view):
    path = {"components": FILES / "probe-pca.wlm", "hours": STREET / "probes.wlm"}.get(name, tmp_path / "probe.wlm")
    if name in ("gaussians", "spheres"):
        settings = {"latent": 4} if name == "gaussians" else {"support": "sphere", "error": "absolute", "outputs": 12}
        probe_models.whole_model(positions=True, **settings).save(path)
    if name == "unit vectors":
        probes = wlm.probe.from_arrays(np.eye(4, 3), np.random.default_rng(2).random((4, 27)))
        wlm.probe.compress(probes, "pca", positions=True).save(path)
    page = view(path)
    check_content(page, [path], **({"time": 12.0} if name == "hours" else {}))
    check_light(page, path)


def test_a_file_without_positions_and_a_mesh(tmp_path, view):
    probe_models.whole_model().save(tmp_path / "bare.wlm")
    cube = tmp_path / "cube"
    cube.mkdir()
    atlas_meshes.write_files(cube, atlas_meshes.charts())
    page = view(tmp_path / "bare.wlm", *cube.glob("*.glb"))
    assert "lattice" in page.locator("#panel p").first.inner_text()
    assert len(numbers(page, "kind.read(1)")) > 0, "the mesh is lit"


def test_frames_of_smoke(view):
    frames = sorted((STREET / "smoke").glob("*.exr"))[:3]
    page = view(*reversed(frames))
    check_content(page, frames)


def test_files_that_are_damaged_or_of_another_kind(tmp_path, view):
    data = (FILES / "lightmap.wlm").read_bytes()
    (tmp_path / "old.wlm").write_bytes(data.replace(b'"3 lightmap', b'"2 lightmap'))
    for name, at in (("index", 108 + data[0] + 256 * data[1]), ("piece", len(data) - 9)):
        (tmp_path / f"{name}.wlm").write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    (tmp_path / "cut.wlm").write_bytes(data[:300])
    (tmp_path / "empty.wlm").write_bytes(b"")
    cases = [
        (tmp_path / f"{name}.wlm", words)
        for name, words in (
            ("old", "compress the input again"),
            ("index", "digest"),
            ("piece", "piece 1 is damaged"),
            ("cut", "cut short"),
            ("empty", "expected a .wlm file"),
        )
    ]
    cases += [(FILES / "smoke.wlm", "expected lightmaps predicted"), (FILES / "atlas-shared.wlm", "one lightmap")]
    for path, words in cases:
        message = view(path).locator("#message").inner_text()
        assert words in message and "\n" not in message and path.name in message
    assert view(FILES / "probe.wlm").locator("#message").is_hidden(), "the next file opens"
    view.errors.clear()  # the page also throws them, for the console


def test_zstd_frames(view):
    """Frames of all levels and kinds of data, among them bytes that no code makes smaller, and of several blocks."""
    random = np.random.default_rng(0)
    data = [b"", b"a", bytes(200_000), random.bytes(5000), b"the quick brown fox " * 9000, Path(__file__).read_bytes()]
    data += [
        random.integers(0, 4, 30_000).astype("u1").tobytes(),
        (random.normal(size=90_000) * 9).astype("i1").tobytes(),
    ]
    data += [
        np.cumsum(random.integers(-2, 3, 90_000)).astype("<i2").tobytes(),
        random.geometric(0.03, 9000).astype("u1").tobytes(),
    ]
    cases = [(zstandard.compress(each, level), each) for each in data for level in (-5, 1, 3, 6, 9, 14, 19, 22)]
    cases += [
        (zstandard.ZstdCompressor(write_checksum=True, write_content_size=False).compress(each), each) for each in data
    ]
    sent = [[base64.b64encode(frame).decode(), len(each)] for frame, each in cases]
    script = """(cases) => cases.map(([text, size]) => {
        try {
            return hexadecimals(blake2b([unzstd(Uint8Array.from(atob(text), (x) => x.charCodeAt(0)), size)], 64));
        } catch (error) { return error.message; }
    })"""
    assert view.page.evaluate(script, sent) == [hashlib.blake2b(each).hexdigest() for _, each in cases]
    # A frame that is cut short, or has another size.
    wrong = [[base64.b64encode(frame[:-2]).decode(), len(each)] for frame, each in cases]
    wrong += [[text, size + 1] for text, size in sent]
    assert all("zstd" in text for text in view.page.evaluate(script, wrong))
