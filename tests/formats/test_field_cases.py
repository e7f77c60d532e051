"""Inputs that people report in trackers of other software: each gives its light, a doubt, or the cause in one line."""

import json
import re
import struct
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR
import pytest
from builders.checks import error_of
from builders.exr import exr_header
from builders.textures import make_ktx2
from PIL import Image

import wlm
from wlm.formats.channels import read_encoded
from wlm.formats.light import read_light
from wlm.formats.meshes import read_mesh

CORPUS = Path(__file__).resolve().parents[1] / "fuzz" / "corpus"
SQUARE = "v 0 0 {z}\nv 1 0 {z}\nv 0 1 {z}\nv 1 1 {z}\nvt 0 0\nvt 0.5 0\nvt 0 1\nvt 0.5 1\n"
ONE, TWO = SQUARE.format(z=0), SQUARE.format(z=1)
FACE, BACK = "f 1/1 2/2 4/4\n", "f -4/-4 -3/-3 -1/-1\n"


@pytest.mark.parametrize(
    ("text", "heights"),
    [
        (
            ONE + BACK + TWO + BACK,
            [0, 1],
        ),  # counted back from the last vertex before the face, not from that of the file
        ("o a\n" + ONE + BACK + "o b\n" + TWO + BACK, [0, 1]),
        (ONE + TWO + "vn 0 0 1\nf -4/-4/1 \\\n -3/-3/-1 -1/-1/1\n" + FACE, [1, 0]),
        ("\ufeff" + ONE + "v 9 9 9\n" + FACE, [0]),
        ((ONE + FACE).replace(" ", "\t"), [0]),
        ((ONE + BACK).replace("\n", "\r\n"), [0]),
        ("mtllib gone.mtl\nusemtl x\n" + ONE + FACE, [0]),
    ],
)
def test_an_obj_of_another_writer(tmp_path, text, heights):
    (tmp_path / "a.obj").write_text(text, newline="")
    mesh = read_mesh(tmp_path / "a.obj")
    corners = mesh.position[mesh.triangle]
    assert sorted(corners[:, 0, 2].tolist()) == sorted(heights)
    np.testing.assert_array_equal(corners[..., :2], [[[0, 0], [1, 0], [1, 1]]] * len(heights))
    np.testing.assert_array_equal(mesh.uv[mesh.triangle], [[[0, 1], [0.5, 1], [0.5, 0]]] * len(heights))


@pytest.mark.parametrize(
    ("face", "reason"),
    [
        ("f 0/0 1/1 2/2\n", "vertices counted from 1, found 0"),
        ("f 1/0 2/1 3/2\n", "vertices counted from 1, found 0"),
        ("f -5/-4 -3/-3 -1/-1\n", "at most 4 earlier vertices, found -5"),
        ("f 1/1 2/2 9/4\n", "malformed OBJ: "),
    ],
)
def test_an_obj_that_names_vertices_that_are_not_there(tmp_path, face, reason):
    (tmp_path / "a.obj").write_text(ONE + face)
    assert re.search(reason, error_of(read_mesh, tmp_path / "a.obj"))


def png(*chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of 2 x 1 grey levels of 16 bits with the chunks before its pixels."""
    head = (b"IHDR", struct.pack(">2I5B", 2, 1, 16, 0, 0, 0, 0))
    parts = (head, *chunks, (b"IDAT", zlib.compress(b"\0" + struct.pack(">2H", 0x8000, 0xFFFF))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in parts
    )


GAMMA, SRGB = (b"gAMA", struct.pack(">I", 100_000)), (b"sRGB", b"\0")


@pytest.mark.parametrize(
    ("chunks", "encoding", "stated"),
    [((GAMMA,), "srgb", "linear"), ((SRGB,), "linear", "srgb"), ((GAMMA,), "linear", ""), ((), "srgb", "")],
)
def test_a_png_that_states_another_encoding(tmp_path, chunks, encoding, stated):
    (tmp_path / "a.png").write_bytes(png(*chunks))
    notes: list[str] = []
    light = read_encoded(tmp_path / "a.png", encoding, notes)
    assert light[0, 0, 0] == pytest.approx(0.5 if encoding == "linear" else 0.214, abs=1e-3)
    said = [line for line in notes if "the PNG says" in line]
    asked = f"the PNG says that its levels are {stated}: is its encoding {stated}, not {encoding}?"
    assert said == [asked] * bool(stated)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "found an empty file"),
        (make_ktx2(0, 4, 4, [bytes(128)]), re.escape("found 0 (none of Vulkan's, as of Basis Universal)")),
        (make_ktx2(43, 4, 4, [bytes(64)]), "found 43 .8-bit sRGB with alpha"),
    ],
)
def test_light_that_is_none_is_named(tmp_path, content, reason):
    (tmp_path / "a.ktx2").write_bytes(content)
    assert re.search(reason, error_of(read_light, tmp_path / "a.ktx2"))


def test_an_environment_map_is_doubted(tmp_path):
    planes = {channel: np.ones((2, 4), np.float32) for channel in "RGB"}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_LATLONG}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    notes: list[str] = []
    assert (read_light(tmp_path / "a.exr", notes)[0] == 1).all()
    assert notes == ["its header says that it is an environment map: is it a lightmap?"]


def test_a_table_in_utf_16_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,sh0,sh1,sh2\n0,0,0,1,1,1\n", "utf-16")
    assert "expected a table in UTF-8, found UTF-16" in error_of(wlm.probe.load, tmp_path / "a.csv")


def test_directions_beside_light_are_not_times_of_it(tmp_path):
    for name in ("LMA0_final", "LMA0_L1x"):
        planes = {channel: np.ones((2, 4), np.float32) for channel in "RGB"}
        OpenEXR.File({}, planes).write(str(tmp_path / f"{name}.exr"))
    lines = wlm.lightmap.load(tmp_path, times=[0, 1]).warnings
    assert any("LMA0_L1x.exr: by their names no light of a time" in line for line in lines), lines


def test_subsampled_channels_are_refused(tmp_path):
    head = exr_header(names=["Y"], window=(0, 0, 7, 7), kind=2, sampling=2, compression=0)
    rows = [struct.pack("<2i", y, 16 * (y % 2 == 0)) + np.ones(4 * (y % 2 == 0), "<f4").tobytes() for y in range(8)]
    starts = np.cumsum([len(head) + 64, *map(len, rows[:-1])]).astype("<u8")
    (tmp_path / "a.exr").write_bytes(head + starts.tobytes() + b"".join(rows))
    assert "channel Y: expected 8x8 pixels in the data window, found 4x4" in error_of(read_light, tmp_path / "a.exr")


LIGHT = np.array([[[0.25, 0.5, 1.0], [2.0, 0.125, 0.0]], [[4.0, 3.0, 0.75], [1.5, 8.0, 0.0625]]], np.float32)


def exr(path, channels, **header) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(header, channels).write(str(path))


def planes(*names):
    return {name: np.ascontiguousarray(LIGHT[..., i % 3]) for i, name in enumerate(names)}


@pytest.mark.parametrize(
    ("channels", "header", "note"),
    [
        # Houdini's planes, in lower case behind the name of the layer, with a depth beside them.
        (planes("C.r", "C.g", "C.b", "Pz"), {}, "the light is taken from 'C', its only layer of colour"),
        # An identifier of objects in whole numbers beside the colours.
        (planes("R", "G", "B") | {"id": np.ones((2, 2), np.uint32)}, {}, None),
        (planes("red", "green", "blue"), {}, None),
        ({"RGB": LIGHT}, {"lineOrder": OpenEXR.DECREASING_Y}, None),
        ({"RGB": LIGHT}, {"pixelAspectRatio": 2.0}, None),
        # A name of a view before the layer.
        (planes("left.Bake.R", "left.Bake.G", "left.Bake.B"), {}, "the light is taken from 'left.Bake'"),
    ],
)
def test_an_exr_of_another_writer(tmp_path, channels, header, note):
    exr(tmp_path / "a.exr", channels, **header)
    notes: list[str] = []
    np.testing.assert_array_equal(read_light(tmp_path / "a.exr", notes)[0], LIGHT)
    assert [line.startswith(note) for line in notes] == [True] if note else notes == []


def test_radiance_and_pfm_of_another_writer(tmp_path):
    codes = imagecodecs.rgbe_encode(LIGHT, header=True)
    for name, content in {"up": codes.replace(b"-Y 2 +X 2", b"+Y 2 +X 2"), "rgbe": b"#?RGBE" + codes[10:]}.items():
        (tmp_path / f"{name}.hdr").write_bytes(content)
        light = read_light(tmp_path / f"{name}.hdr")[0]
        np.testing.assert_allclose(light, LIGHT[::-1] if name == "up" else LIGHT, rtol=0.02, atol=0.04)
    for head, values, note in (
        (b"PF\n2 2\n2.0\n", LIGHT[::-1].astype(">f4"), "the scale of its header, 2, is not applied"),
        (b"Pf\n2 2\n-1\n", LIGHT[::-1, :, :1].repeat(1, 2).astype("<f4"), "its only channel is taken as grey light"),
    ):
        (tmp_path / "a.pfm").write_bytes(head + values.tobytes())
        notes: list[str] = []
        light = read_light(tmp_path / "a.pfm", notes)[0]
        np.testing.assert_array_equal(light, LIGHT if head[1:2] == b"F" else LIGHT[..., :1].repeat(3, 2))
        assert notes == [note]


def test_pictures_of_levels_that_state_what_is_not_applied(tmp_path):
    picture = Image.fromarray(np.arange(12, dtype=np.uint8).reshape(2, 2, 3) * 20)
    turned = Image.Exif()
    turned[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=turned)
    picture.save(tmp_path / "profile.png", icc_profile=b"Display P3".rjust(128, b"\0"))
    picture.save(tmp_path / "srgb.png", icc_profile="sRGB IEC61966-2.1".encode("utf-16-be").rjust(128, b"\0"))
    for name, said in (
        ("turned.jpg", ["its EXIF orientation, 6, is ignored: rows are read as they are stored"]),
        ("profile.png", ["its ICC profile is not applied: the primaries are taken as Rec. 709"]),
        ("srgb.png", []),
    ):
        notes: list[str] = []
        assert read_encoded(tmp_path / name, "srgb", notes).shape == (2, 2, 3)
        assert notes == said


@pytest.mark.parametrize(
    ("names", "hours"),
    [
        (("lm-6AM", "lm-12PM", "lm-6PM"), [6.0, 12.0, 18.0]),
        (("Lightmap_06h00", "Lightmap_18h30"), [6.0, 18.5]),
        (("night_00_00h", "late_23_59h", "noon_12_00h"), None),
    ],
)
def test_hours_in_names_of_another_project(tmp_path, names, hours):
    for i, name in enumerate(names):
        exr(tmp_path / f"{name}.exr", {"RGB": LIGHT * (i + 1)})
    lightmaps = wlm.lightmap.load(tmp_path)
    assert lightmaps.light.period == 24
    if hours is not None:
        assert lightmaps.light.times.tolist() == hours
    assert any("hours from the names: " in line for line in lightmaps.warnings)


def test_a_gltf_that_requires_what_is_not_read(tmp_path):
    content = json.loads((CORPUS / "mesh.gltf").read_bytes())
    for name in ("light.exr", "mask-grey.png"):
        (tmp_path / name.replace("mask-grey", "image")).write_bytes((CORPUS / name).read_bytes())
    for required, said in (("VENDOR_displaced", True), ("KHR_materials_unlit", False), ("MOZ_lightmap", False)):
        content["extensionsUsed"] = content["extensionsRequired"] = [required]
        (tmp_path / "a.gltf").write_text(json.dumps(content))
        lines = wlm.atlas.load(tmp_path / "a.gltf", tmp_path / "light.exr").warnings
        assert any("requires VENDOR_displaced, which is not read" in line for line in lines) == said
