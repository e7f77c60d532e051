"""Unity's lighting data: probes as UnityPy gives them, and what is said of others."""

import re
import sys
from types import ModuleType

import numpy as np
import pytest
from builders.checks import error_of

from wlm.formats import unity_asset, unity_child
from wlm.formats.unity_asset import read_lighting_data
from wlm.inspection import inspect
from wlm.probe.conventions import from_canonical
from wlm.probe.data import load

PLACES = np.array([[1.0, 2, 3], [4, 5, 6]])
SH = np.arange(2 * 9 * 3, dtype=float).reshape(2, 9, 3) / 128 + 1.0


def probes(position=PLACES, sh=SH):
    """Light probes [N, 3] with numbers [N, 9, 3]: nine of red, then of green, then of blue."""
    light = [{f"sh[{i:2d}]": value for i, value in enumerate(each.T.ravel())} for each in sh]
    places = [dict(zip("xyz", each, strict=True)) for each in position.tolist()]
    return "LightProbes", lambda: {"m_Data": {"m_Positions": places}, "m_BakedCoefficients": light}


@pytest.fixture
def unity(monkeypatch, tmp_path):
    """Writes a file in which UnityPy finds some objects."""
    monkeypatch.setitem(sys.modules, "UnityPy", ModuleType("UnityPy"))

    def give(*objects):
        monkeypatch.setattr(unity_asset, "run_child", lambda reader, data: unity_child.encode(objects))
        path = tmp_path / "LightingData.asset"
        path.write_bytes(bytes(64))
        return path

    return give


def test_probes(unity):
    path = unity(probes(), ("LightingDataAssetParent", None))
    data = read_lighting_data(path)
    assert (data.values == SH).all() and (data.position == PLACES).all()
    assert from_canonical(load(path).values.reshape(2, 9, 3), "unity") == pytest.approx(SH, rel=1e-6)
    both = read_lighting_data(unity(probes(), probes(PLACES + 1.0)))
    assert (both.position == np.concatenate([PLACES, PLACES + 1.0])).all() and len(both.values) == 4


def test_probes_have_their_command(unity):
    path = unity(probes(), ("LightingDataAsset", None))
    found = inspect(path)[0]
    assert "2 light probes of 9 RGB coefficients" in found.what
    assert found.command == f"wlm compress {path} -o OUT.wlm"


def test_what_has_no_probes_says_so(unity):
    path = unity(("LightingDataAsset", None))
    assert "no light probes" in inspect(path)[0].what
    assert "LightingData.asset: expected light probes, found none" in error_of(load, path)


@pytest.mark.parametrize(
    ("objects", "said"),
    [([("Texture2D", None)], "found neither"), ([probes(PLACES, SH[:1])], "of 2 probes, found light for 1")],
)
def test_others_are_refused(unity, objects, said):
    assert re.search(said, error_of(read_lighting_data, unity(*objects)))


def test_without_the_extra(monkeypatch, tmp_path):
    path = tmp_path / "LightingData.asset"
    path.write_bytes(bytes(64))
    monkeypatch.setitem(sys.modules, "UnityPy", None)
    assert "UnityPy is missing; needs the extra: pip install 'wlm[unity]'" in error_of(load, path)
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
    assert re.search(f"damaged, or UnityPy cannot read its version.*{said}", error_of(read_lighting_data, path))
