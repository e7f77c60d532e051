"""Unity's lighting data: probes and rectangles by the layout that UnityPy gives, and what is said of others."""

import struct
import sys
import tracemalloc
from types import ModuleType

import numpy as np
import pytest
from builders import unity_assets
from builders.unity_assets import lighting, node, probes

from wlm.errors import WlmError
from wlm.formats import unity_asset, unity_child
from wlm.formats.unity_asset import read_lighting_data
from wlm.inspection import inspect
from wlm.probe.conventions import from_canonical
from wlm.probe.data import load

PLACES = np.array([[1.0, 2, 3], [4, 5, 6]])
SH = np.arange(2 * 9 * 3, dtype=float).reshape(2, 9, 3) / 128 + 1.0
RECTANGLE = (0.5, 0.25, 0.125, 0.0)


@pytest.fixture
def unity(monkeypatch, tmp_path):
    """Writes a file in which UnityPy finds some objects."""
    monkeypatch.setitem(sys.modules, "UnityPy", ModuleType("UnityPy"))

    def give(*objects):
        size = sum(len(each[2]) for each in objects)
        monkeypatch.setattr(unity_asset, "run_child", lambda reader, data: unity_child.encode(objects, size))
        path = tmp_path / "LightingData.asset"
        path.write_bytes(b"".join(each[2] for each in objects) or b"none")
        return path

    return give


@pytest.mark.parametrize("order", ["<", ">"])
def test_probes(unity, order):
    path = unity(probes(PLACES, SH, order), ("LightingDataAssetParent", None, b"", "<"))
    data = read_lighting_data(path)
    assert (data.values == SH).all() and (data.position == PLACES).all() and not data.rectangles
    assert from_canonical(load(path).values.reshape(2, 9, 3), "unity") == pytest.approx(SH, rel=1e-6)


def test_rectangles_are_counted_and_probes_have_their_command(unity):
    path = unity(probes(PLACES, SH), lighting([(0, RECTANGLE), (65535, RECTANGLE), (1, RECTANGLE)]))
    rectangles = read_lighting_data(path).rectangles
    assert [(each.lightmap, each.scale_offset) for each in rectangles] == [(0, RECTANGLE), (1, RECTANGLE)]
    found = inspect(path)[0]
    assert "2 light probes of 9 RGB coefficients" in found.what and "2 rectangles of renderers" in found.what
    assert found.command == f"wlm compress {path} -o OUT.wlm"


def test_what_has_no_probes_says_so(unity):
    path = unity(lighting([(0, RECTANGLE)]))
    assert "no light probes" in inspect(path)[0].what
    with pytest.raises(WlmError, match="LightingData.asset: expected light probes, found none"):
        load(path)


def cut(item, size):
    return (item[0], item[1], item[2][:size], item[3])


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        ([("Texture2D", None, b"", "<")], "found neither"),
        ([probes(PLACES, SH[:1])], "light for each of 2 probes, found light for 1"),
        ([cut(probes(PLACES, SH), -1)], "damaged, or UnityPy cannot read its version.*: expected 216 bytes"),
        ([("LightProbes", node("LightProbes", "Base"), b"", "<")], "m_BakedCoefficients is missing"),
        ([("LightProbes", None, b"", "<")], "does not contain the layout of its objects"),
        (
            [("LightingDataAsset", unity_assets.LIGHTING, struct.pack("<2i", 0, -1), "<")],
            "an array of 0 or more values, found -1",
        ),
    ],
)
def test_others_are_refused(unity, objects, said):
    path = unity(*objects)
    with pytest.raises(WlmError, match=said):
        read_lighting_data(path)


def test_no_room_is_made_for_what_a_file_claims(unity, monkeypatch):
    monkeypatch.setattr(unity_child, "_MOST_STEPS", 1 << 12)
    kind, tree, content, order = probes(PLACES, SH)
    many = struct.pack("<i", 2**31 - 1)
    # A name of that many bytes; then that many empty arrays, each of which takes four bytes.
    for damaged in (many + content[4:], content[:12] + many + bytes(1 << 20)):
        path = unity((kind, tree, damaged, order))
        tracemalloc.start()
        with pytest.raises(WlmError, match="damaged, or UnityPy cannot read its version"):
            read_lighting_data(path)
        assert tracemalloc.get_traced_memory()[1] < 5e7
        tracemalloc.stop()


def test_text_and_bundles_are_named(unity):
    path = unity()
    for head, said in ((b"%YAML 1.1\n", "found nothing"), (b"UnityFS\0", "found an asset bundle")):
        path.write_bytes(head)
        with pytest.raises(WlmError, match=said):
            read_lighting_data(path)


def test_without_the_extra(monkeypatch, tmp_path):
    path = tmp_path / "LightingData.asset"
    path.write_bytes(bytes(64))
    monkeypatch.setitem(sys.modules, "UnityPy", None)
    with pytest.raises(WlmError, match="UnityPy is missing; needs the extra: pip install 'wlm\\[unity\\]'"):
        load(path)
    assert inspect(path)[0].problems == ("unity: UnityPy is missing; needs the extra: pip install 'wlm[unity]'",)


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import os; os.abort()", "UnityPy crashed"),
        ("print('no array'); raise EOFError('no more')", "EOFError: no more"),
        ("while True: pass", "exceeded its limits of 1 s"),
        ("return {'a': bytes(1 << 40)}", "MemoryError"),
    ],
)
def test_a_reader_that_ends_is_told(tmp_path, monkeypatch, program, said):
    path, child = tmp_path / "LightingData.asset", tmp_path / "child.py"
    path.write_bytes(bytes(64))
    monkeypatch.setitem(sys.modules, "UnityPy", ModuleType("UnityPy"))
    for name, value in (("__file__", str(child)), ("PACKAGE", "UnityPy"), ("SECONDS", 1)):
        monkeypatch.setattr(unity_child, name, value)
    child.write_text(f"PACKAGE, MEMORY, SECONDS = 'json', 1 << 28, 1\ndef main(data):\n    {program}\n")
    with pytest.raises(WlmError, match=f"damaged, or UnityPy cannot read its version.*{said}"):
        read_lighting_data(path)


def test_layouts_are_walked_once_and_objects_count_once():
    """A layout of 40 levels, each twice the one below by reference, and an object that the file has many times."""
    deep = node("float", "x")
    for _ in range(40):
        deep = node("Pair", "data", deep, deep)
    with pytest.raises((ValueError, OverflowError)):
        unity_child.encode(
            [("LightingDataAsset", node("L", "Base", unity_assets.vector("m_Odd", deep)), bytes(64), "<")], 64
        )
    item = probes(PLACES, SH)
    assert unity_child.encode([item], len(item[2]))
    with pytest.raises(ValueError, match="expected objects at different places"):
        unity_child.encode([item, item], len(item[2]))
