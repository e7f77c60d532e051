"""Probes as other writers lay them out, and numbers that cannot be light: the right light, a warning or a refusal."""

import json

import numpy as np
import pytest
from builders import probe_layouts
from builders.checks import error_of
from builders.probe_layouts import COUNT, canonical, unity_numbers, unity_text, write_json
from builders.probe_sets import synthetic

from wlm.inspection.files import inspect_file
from wlm.probe.conventions import from_canonical
from wlm.probe.data import from_arrays, load, load_positions
from wlm.probe.sphere import basis, fibonacci_sphere

JSON = probe_layouts.json_files()
TABLES = probe_layouts.tables()


def _is_light(probes, rtol=3e-6):
    expected = canonical()
    np.testing.assert_allclose(probes.position, expected.position, rtol=rtol, atol=1e-6)
    np.testing.assert_allclose(probes.values, expected.values, rtol=rtol, atol=1e-5)


@pytest.mark.parametrize("name", JSON)
def test_json_of_other_writers(tmp_path, name):
    content, convention = JSON[name]
    path = write_json(tmp_path, name, content)
    probes = load(path, convention=convention)
    _is_light(probes)
    np.testing.assert_allclose(load_positions(path), probes.position)
    assert ("as given" if convention else "as the file states") in probes.reading
    assert load(path).reading.count("assumed: --convention") == (convention is not None)
    found = inspect_file(path)
    assert found.what.startswith(f"{COUNT} light probes of 9 RGB coefficients") and found.command.endswith("-o OUT.wlm")
    assert load(path).reading in found.what


@pytest.mark.parametrize("name", TABLES)
def test_tables(tmp_path, name):
    path = tmp_path / name
    path.write_text(TABLES[name], newline="")
    probes = load(path, convention="unity")
    _is_light(probes)
    assert load(path, convention="unity", order="channel").warnings == ()
    assert ("without the columns id, radius" in probes.reading) == (name == "named.csv") == (not probes.warnings)
    assert inspect_file(path).what.startswith(f"{COUNT} light probes")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected columns of a position and of light"),
        ("1,2,3\n", "expected columns of a position and of light"),
        ("1,2,3,4\n1,2,3\n", "not a table of numbers"),
        ("1;2;3;0,5\n", "found 1, 2, 3, 0,5"),
        ("name,light\nhall,3\n", "or without names; found name, light"),
        ("x,y,z,r0,g0\n1,2,3,4,5\n", "expected columns of a position and of light, named x"),
        ("x,y,z,sh0,sh0\n1,2,3,4,5\n", "expected columns of a position and of light, named x"),
        ("x,y,z,sh0,sh1,sh2\n", "expected at least one probe"),
        ("x,y,z,sh0,sh1,sh2\n1,2,3,4,5,six\n", "not a table of numbers"),
        ("1," * 5000 + "1\n", "expected at most 4099 columns"),
    ],
)
def test_what_is_no_table_of_probes(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    found = error_of(load, path)
    assert found.startswith(f"{path}: ") and message in found


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_a_text_asset_of_unity(tmp_path, ending):
    path = tmp_path / "LightProbes.asset"
    path.write_text(unity_text(), newline=ending)
    probes = load(path)
    _is_light(probes)
    assert "convention unity, as the file states" in probes.reading and probes.warnings == ()
    assert inspect_file(path).what.startswith(f"lighting data of Unity: {COUNT} light probes")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("LightProbes:", "LightingDataAsset:", "found LightingDataAsset, MonoBehaviour (the light of Adaptive Probe"),
        ("m_Positions", "m_Places", "m_Positions is missing"),
        ("sh[ 3]: ", "sh[ 3]: 0x", "the asset is damaged"),
        ("sh[ 3]", "sh[ 4]", "in this order"),
        ("    sh[26]: ", "    sh: ", "expected 27 coefficients for each of 40 probes, found 1040"),
        ("sh[ 0]: ", "sh[ 0]: 0.00000000000000000000000000000000000", "expected 27 coefficients"),
    ],
)
def test_a_damaged_text_asset(tmp_path, old, new, message):
    path = tmp_path / "a.asset"
    path.write_text(unity_text().replace(old, new))
    found = error_of(load, path)
    assert found.startswith(f"{path}: ") and message in found


def test_the_order_of_numbers(tmp_path):
    position, light = unity_numbers()
    flat, unity = light.reshape(COUNT, 27), {"convention": "unity"}
    np.savez(tmp_path / "a.npz", position=position, sh=flat)
    found = load(tmp_path / "a.npz", **unity)
    _is_light(found)
    assert "channel by channel" in found.reading and "--order coefficient overrides" in found.warnings[0]
    told = load(tmp_path / "a.npz", **unity, order="channel")
    assert told.warnings == () and "assumed" not in told.reading and told.source == found.source
    # What the caller or the shape states is kept; a warning names the order that fits.
    for wrong in (
        load(tmp_path / "a.npz", **unity, order="coefficient"),
        from_arrays(position, flat.reshape(COUNT, 9, 3), **unity),
        from_arrays(position, light.transpose(0, 2, 1).reshape(COUNT, 3, 9), **unity, order="channel"),
    ):
        assert np.abs(wrong.values - canonical().values).max() > 1.0
        assert len(wrong.warnings) == 1 and "Then add --order" in wrong.warnings[0]
    right = from_arrays(position, light.transpose(0, 2, 1), **unity)
    assert right.warnings == ()
    assert from_arrays(position, light, **unity).source == right.source
    for order, values in (("rows", flat), ("channel", flat[:, :5])):
        assert "order: expected coefficient or channel" in error_of(from_arrays, position, values, order=order)


def test_white_and_red_light_in_each_order():
    """Neither exceeds the bound of light in the wrong order where only the mean is lit."""
    position = synthetic(20).position
    white = np.zeros((20, 9, 3))
    white[:, 0] = np.linspace(1.0, 2.0, 20)[:, None]
    red = synthetic(20).values.reshape(20, 9, 3) * [1.0, 0.0, 0.0]
    for light in (white, red, white[:, :4]):
        by_coefficient = from_arrays(position, light.reshape(20, -1))
        by_channel = from_arrays(position, light.transpose(0, 2, 1).reshape(20, -1))
        assert by_coefficient.warnings == () and by_coefficient.source == by_channel.source
        assert "--order coefficient" in by_channel.warnings[0]


def test_the_first_coefficient_against_the_others():
    probes = synthetic(200)
    light = probes.values.reshape(200, 9, 3)
    assert from_arrays(probes.position, light).warnings == ()
    # Light from one direction reaches the bound, and exceeds it after division by Unity's factors.
    beam = basis(fibonacci_sphere(200), 9)[..., None] * [1.0, 0.9, 0.8]
    assert from_arrays(probes.position, beam).warnings == ()
    assert from_arrays(probes.position, from_canonical(beam, "unity"), convention="unity").warnings == ()
    (warning,) = from_arrays(probes.position, beam, convention="unity", name="yard").warnings
    assert warning.startswith("yard: sh: ") and "too small for the others" in warning
    assert "--convention threejs or godot or unreal fits" in warning
    for wrong in (-light, light - [0.0, 0.0, 9.0], np.random.default_rng(3).normal(size=light.shape)):
        (warning,) = from_arrays(probes.position, wrong).warnings
        assert "is it another order, basis or convention?" in warning
    few = light.copy()
    few[0, 0] = 0.0
    assert from_arrays(probes.position, few).warnings == ()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"probes": [{"position": {"a": 1, "b": 2}, "sh": [1]}]}, "position[0]: expected numbers"),
        ([{"position": [0, 0, 0], "r": [1, 2, 3, 4], "g": [1, 2, 3, 4], "b": [1]}], "expected as many numbers in each"),
        ([{"pos": [0, 0, 0], "light": "bright"}], "begins with sh"),
        # The constants of Unity's shaders mix bands.
        ([{"pos": [0, 0, 0]} | {f"SH{x}{c}": [1, 2, 3, 4] for x in "AB" for c in "rgb"}], "begins with sh"),
        ([{"pos": [0, 0, 0], "coefficients": "bright"}], 'numbers, as many as coefficients[0] has, got "bright"'),
        ([{"irradianceCoefficients": [[1, 1, 1]] * 9}], "expected a JSON object, got [{"),
        ({"lights": [{"irradianceCoefficients": [[1, 1, 1]] * 9}]}, "position is missing; found lights"),
    ],
)
def test_json_that_is_refused(tmp_path, content, message):
    path = write_json(tmp_path, "a", content)
    found = error_of(load, path)
    assert found.startswith(f"{path}: ") and message in found


def test_a_scene_that_is_refused(tmp_path):
    for change, message in (
        ({"matrix": [1, 2]}, "matrix: expected 16 numbers"),
        ({"sh": None}, "sh[0]: expected numbers"),
        ({"intensity": "high"}, "intensity[0]: expected numbers"),
        ({"children": 3}, "children: expected a list of objects"),
        ({"sh": [1.0] * 12}, "expected as many SH coefficients in each LightProbe"),
        ({"matrix": [1e308, 1e999] * 8}, "expected finite numbers"),
    ):
        scene = probe_layouts.three_scene()
        scene["object"]["children"][0]["children"][0].update(change)
        found = error_of(load, write_json(tmp_path, "a", scene))
        assert message in found, found
    scene["object"]["children"] = []
    assert "expected at least one probe" in error_of(load, write_json(tmp_path, "a", scene))


def test_json_nested_deeply(tmp_path):
    for content in ('{"a":' * 400 + "1" + "}" * 400, '[{"pos": ' + '{"a": ' * 400 + "1" + "}" * 400 + ', "sh": [1]}]'):
        (tmp_path / "a.json").write_text(content)
        json.loads(content)
        assert str(tmp_path) in error_of(load, tmp_path / "a.json")
        inspect_file(tmp_path / "a.json")


def test_what_inspect_takes_for_probes(tmp_path):
    for content, what in (
        ([{"position": [0, 0, 0], "fov": 60}], "unknown JSON"),
        ({"cameras": [{"location": [0, 0, 0], "fov": 60}]}, "unknown JSON"),
        ({"center": [0, 0, 0], "radius": 2}, "unknown JSON"),
        ([{"x": 1, "y": 2, "z": 3}], "unknown JSON"),
        ([], "unknown JSON"),
        ([{"pos": [0, 0, 0], "coefs": [1, 1, 1]}], "1 light probes of 1 RGB coefficients, 1 of them lit"),
    ):
        path = write_json(tmp_path, "a", content)
        assert inspect_file(path).what.startswith(what), content
    points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    vectors = [dict(zip("xyz", point, strict=True)) for point in points]
    for content in (vectors, {"cameras": [{"location": point, "fov": 60} for point in vectors]}):
        np.testing.assert_array_equal(load_positions(write_json(tmp_path, "a", content)), points)
