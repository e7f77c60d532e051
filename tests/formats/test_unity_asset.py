"""Unity's lighting data: probes and rectangles as UnityPy gives them, and what is said where they can't be read."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.formats.unity_asset import read_lighting_data
from wlm.inspection import inspect
from wlm.probe.conventions import from_canonical
from wlm.probe.data import load

SH = np.arange(2 * 9 * 3, dtype=float).reshape(2, 9, 3) / 100 + 1.0


def item(kind: str, content: dict) -> SimpleNamespace:
    return SimpleNamespace(type=SimpleNamespace(name=kind), read_typetree=lambda: content)


def probes(sh: np.ndarray = SH) -> SimpleNamespace:
    """Two probes as Unity keeps them: nine numbers of red, then of green, then of blue."""
    rows = [{f"sh[{i:2d}]": value for i, value in enumerate(each.T.reshape(-1).tolist())} for each in sh]
    places = [{"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 4.0, "y": 5.0, "z": 6.0}]
    return item("LightProbes", {"m_Data": {"m_Positions": places}, "m_BakedCoefficients": rows})


def lighting() -> SimpleNamespace:
    rows = [{"lightmapIndex": n, "lightmapST": {"x": 0.5, "y": 0.25, "z": 0.125, "w": 0.0}} for n in (0, 65535, 1)]
    return item("LightingDataAsset", {"m_LightmappedRendererData": rows})


@pytest.fixture
def unity(monkeypatch):
    """Has UnityPy find some objects in whatever file."""

    def give(*objects) -> None:
        fake = SimpleNamespace(load=lambda data: SimpleNamespace(objects=objects))
        monkeypatch.setitem(sys.modules, "UnityPy", fake)

    return give


@pytest.fixture
def path(tmp_path):
    (tmp_path / "LightingData.asset").write_bytes(bytes(64))
    return tmp_path / "LightingData.asset"


def test_probes_and_rectangles(unity, path):
    unity(probes(), lighting(), item("LightingDataAssetParent", {}))
    data = read_lighting_data(path)
    assert (data.values == SH).all() and data.position.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert [(each.lightmap, each.scale_offset) for each in data.rectangles] == [
        (0, (0.5, 0.25, 0.125, 0.0)),
        (1, (0.5, 0.25, 0.125, 0.0)),
    ]
    assert from_canonical(load(path).values.reshape(2, 9, 3), "unity") == pytest.approx(SH, rel=1e-6)
    found = inspect(path)[0]
    assert "2 light probes of 9 RGB coefficients" in found.what and "2 renderers' rectangles" in found.what
    assert found.command == f"wlm probe compress {path} -o OUT.wlm"


def test_what_has_no_probes_says_so(unity, path):
    unity(lighting())
    assert "no light probes" in inspect(path)[0].what
    with pytest.raises(WlmError, match="LightingData.asset: expected light probes, found none"):
        load(path)


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        ([item("Texture2D", {})], "found neither"),
        ([probes(SH[:1])], "light for each of 2 light probes, found that of 1"),
        ([item("LightProbes", {"m_Data": {}})], "damaged, or of a version"),
    ],
)
def test_others_are_refused(unity, path, objects, said):
    unity(*objects)
    with pytest.raises(WlmError, match=said):
        read_lighting_data(path)


def test_text_and_bundles_are_named(unity, path):
    unity()
    for head, said in ((b"%YAML 1.1\n", "found YAML"), (b"UnityFS\0", "found an asset bundle")):
        path.write_bytes(head)
        with pytest.raises(WlmError, match=said):
            read_lighting_data(path)


def test_without_the_extra(monkeypatch, path):
    monkeypatch.setitem(sys.modules, "UnityPy", None)
    with pytest.raises(WlmError, match="UnityPy is missing; needs the extra: pip install 'wlm\\[unity\\]'"):
        load(path)
    assert inspect(path)[0].problems == ("unity: UnityPy is missing; needs the extra: pip install 'wlm[unity]'",)
