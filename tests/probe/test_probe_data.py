"""What comes in: every stated behaviour of `wlm.probe.data`."""

import json
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of, misuse_of
from builders.godot_bakes import Writer, bake
from builders.probe_sets import synthetic

from wlm.probe.conventions import CONVENTIONS, from_canonical
from wlm.probe.data import LARGEST, ProbeSet, from_arrays, load, load_positions, save_probes

N = 6


def _position(count: int = N) -> np.ndarray:
    return np.arange(3.0 * count).reshape(count, 3) / 8.0 - 1.0


def _values(*shape: int) -> np.ndarray:
    """Numbers that float16 holds, none zero, no two alike, both signs; plausible light if they are SH."""
    numbers = np.arange(1, np.prod(shape) + 1) / 16.0
    rows = (numbers * np.where(np.arange(len(numbers)) % 3, 1.0, -1.0)).reshape(-1, int(np.prod(shape[1:])))
    if rows.shape[1] in (12, 27, 48):
        rows[:, :3] = np.abs(rows[:, :3]) + 64.0
    return rows.reshape(shape).astype(np.float32)


def _write(path: Path, **arrays: object) -> Path:
    np.savez(path, **{"position": _position(), "sh": _values(N, 9, 3)} | arrays)
    return path


def _write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def _same(a: ProbeSet, b: ProbeSet) -> None:
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.values, b.values)
    np.testing.assert_array_equal(a.live, b.live)
    assert a.source == b.source


@pytest.mark.parametrize("shape", [(N, 1), (N, 5), (N, 7, 3), (N, 1, 3), (N, 4, 3), (N, 16, 3), (1, 27), (1, 1)])
def test_any_count_of_probes_and_numbers(shape):
    probes = from_arrays(_position(shape[0]), _values(*shape))
    assert (probes.probes, probes.outputs) == (shape[0], np.prod(shape[1:]))
    _same(probes, from_arrays(_position(shape[0]), _values(*shape).reshape(shape[0], -1)))
    np.testing.assert_array_equal(probes.values, _values(*shape).reshape(shape[0], -1))


def test_several_arrays_need_a_key(tmp_path):
    path = _write(tmp_path / "a.npz", **{"sh": _values(N, 3), "sh_09.00": _values(N, 12), "sh_12.00": _values(N, 27)})
    assert "choose one by its key: sh, sh_09.00, sh_12.00" in error_of(load, path)
    for key, outputs, name in (("12.00", 27, "sh_12.00"), ("sh_09.00", 12, "sh_09.00"), ("sh", 3, "sh")):
        loaded = load(path, key=key)
        assert (loaded.outputs, loaded.key) == (outputs, name)
    message = error_of(load, path, key="21.00")
    assert str(path) in message and "21.00" in message and "sh, sh_09.00, sh_12.00" in message
    assert "expected values named position" in error_of(load, path, key="position")


def test_normals_and_validity(tmp_path):
    normal, valid = np.zeros((N, 3)), np.ones(N)
    normal[0], normal[1], valid[:3] = [0.0, 1e200, 0.0], [3.0, 0.0, 4.0], [0.0, 0.49, 0.5]
    values = _values(N, 9, 3)
    rows = {"position": _position(), "sh": values, "normal": normal, "valid": valid}
    fields = {name: array.tolist() for name, array in rows.items()}
    each = [dict(zip(fields, probe, strict=True)) for probe in zip(*fields.values(), strict=True)]
    whole = from_arrays(_position(), values, normal=normal, valid=valid)
    for probes in (
        whole,
        load(_write(tmp_path / "a.npz", **rows)),
        load(_write(tmp_path / "b.npz", **rows | {"valid": valid >= 0.5})),
        load(_write_json(tmp_path / "a.json", fields)),
        load(_write_json(tmp_path / "b.json", {"probes": each})),
    ):
        _same(probes, whole)
        np.testing.assert_allclose(probes.normal[:3], [[0, 1, 0], [0.6, 0, 0.8], [0, 0, 0]])
        assert probes.live.tolist() == [False, False] + [True] * (N - 2) and not probes.values[:2].any()
    assert from_arrays(_position(), values).normal is None
    normal[1, 1], valid[2] = np.inf, 1.5
    for field, array, message in (
        ("normal", normal, "normal[1]: expected finite"),
        ("normal", normal[:, 0], "normal: expected numbers"),
        ("valid", valid, "valid[2]: expected true"),
        ("valid", valid[1:], "valid: expected numbers"),
        ("valid", np.zeros(N), "not valid"),
    ):
        assert message in error_of(from_arrays, _position(), values, **{field: array})


def test_an_exact_name_goes_before_one_with_sh(tmp_path):
    path = _write(tmp_path / "a.npz", noon=_values(N, 1), sh_noon=_values(N, 2))
    assert load(path, key="noon").outputs == 1
    np.savez(path, position=_position(), noon=_values(N, 1))
    assert "begins with sh" in error_of(load, path) and "noon" in error_of(load, path)
    assert load(path, key="noon").key == "noon"
    np.savez(path, sh=_values(N, 3))
    assert "position is missing; found sh" in error_of(load, path)
    np.savez(path, position=_position())
    assert "found nothing" in error_of(load, path)


def test_both_forms_of_json(tmp_path):
    values = _values(N, 4, 3)
    lists = {"position": _position().tolist(), "sh": values.tolist(), "author": "me"}
    probes = [{"position": p, "sh": v, "room": 3} for p, v in zip(lists["position"], lists["sh"], strict=True)]
    for content in (lists, {"probes": probes, "made": "by hand"}):
        loaded = load(_write_json(tmp_path / "hall.json", content))
        assert (loaded.name, loaded.key) == ("hall", "sh")
        _same(loaded, from_arrays(_position(), values))
    flat = {"position": lists["position"], "sh_9": values.reshape(N, 12).tolist(), "sh_12": [[1]] * N}
    _same(load(_write_json(tmp_path / "flat.json", flat), key="9"), from_arrays(_position(), values))


def test_a_convention_from_the_file_or_the_caller(tmp_path):
    canonical = from_arrays(_position(), _values(N, 9, 3))
    for name in CONVENTIONS:
        engine = from_canonical(_values(N, 9, 3), name)
        rounded = from_arrays(_position(), engine, convention=name)
        np.testing.assert_allclose(rounded.values, canonical.values, rtol=2e-7)
        content = {"position": _position().tolist(), "sh": engine.tolist(), "convention": name}
        _same(load(_write_json(tmp_path / "a.json", content)), rounded)
        _same(load(_write(tmp_path / "a.npz", sh=engine, convention=np.array(name))), rounded)
        _same(load(_write(tmp_path / "a.npz", sh=engine.reshape(N, 27)), convention=name), rounded)
        # The caller's word goes before the file's.
        wrong = CONVENTIONS[CONVENTIONS.index(name) - 1]
        _same(load(_write(tmp_path / "a.npz", sh=engine, convention=np.array(wrong)), convention=name), rounded)


def test_conventions_that_do_not_fit(tmp_path):
    path = _write(tmp_path / "a.npz", sh=_values(N, 16, 3))
    assert load(path, convention="godot").outputs == 48
    message = error_of(load, path, convention="unity")
    assert str(path) in message and "expected bands L0 to L2, got L3" in message
    for values in (_values(N, 5), _values(N, 6), _values(N, 5, 3)):
        assert from_arrays(_position(), values).outputs == np.prod(values.shape[1:])
        assert "expected spherical harmonics" in error_of(from_arrays, _position(), values, convention="unreal")
    for call in (
        lambda: load(path, convention="Unity"),
        lambda: save_probes(path, _position(), _values(N, 5), convention="Unity"),
    ):
        message = error_of(call)
        assert str(path) in message and "expected threejs, godot, unreal, unity, got 'Unity'" in message
    for wrong in (np.array(3), np.array(["unity"])):
        message = error_of(load, _write(tmp_path / "b.npz", convention=wrong))
        assert "b.npz: convention: expected a string, got" in message
    content = {"position": [[0, 0, 0]], "sh": [[1]], "convention": {}}
    assert "expected a string, got an object" in error_of(load, _write_json(tmp_path / "b.json", content))


def test_godot_file(tmp_path):
    path = tmp_path / "level.lmbake"
    path.write_bytes(Writer().file(bake(Writer(), _position(), _values(N, 9, 3))))
    loaded = load(path)
    assert (loaded.name, loaded.key) == ("level", "sh")
    _same(loaded, from_arrays(_position(), _values(N, 9, 3), convention="godot"))
    np.testing.assert_allclose(loaded.values.ravel(), _values(N, 27).ravel() * np.pi, rtol=2e-7)
    assert load(path, key="sh").outputs == 27
    assert "expected values named 12.00" in error_of(load, path, key="12.00")
    _same(load(path, convention="threejs"), from_arrays(_position(), _values(N, 9, 3)))


def test_suffix_and_path(tmp_path):
    (tmp_path / "damaged.npz").write_bytes(b"PK\3\4")
    assert "damaged.npz: cannot read the arrays" in error_of(load, tmp_path / "damaged.npz")
    assert "or .lmbake or .res or .asset or .csv" in error_of(load, tmp_path / "a.exr")
    assert "found none" in error_of(load, tmp_path / "a")
    assert "missing.json: cannot read the probes: No such file" in error_of(load, tmp_path / "missing.json")
    (tmp_path / "folder.npz").mkdir()
    assert "expected a file, found a folder" in error_of(load, tmp_path / "folder.npz")


def test_source_names_positions_values_and_live():
    base = from_arrays(_position(), _values(N, 9, 3))
    assert len(base.source) == 16 and int(base.source, 16) >= 0
    assert from_arrays(_position(), _values(N, 27), name="other", key="other").source == base.source
    moved, brighter, dead = _position(), _values(N, 27), _values(N, 27)
    moved[3, 1] += 1e-9
    brighter[5, 26] *= 1.0 + 2.0**-22
    dead[2] = 0.0
    others = [from_arrays(moved, _values(N, 27)), from_arrays(_position(), brighter), from_arrays(_position(), dead)]
    others += [from_arrays(_position(27)[:N], _values(N, 26)), from_arrays(_position(), _values(N, 54)[:, ::2])]
    assert len({base.source, *(each.source for each in others)}) == 6


def test_dead_probes():
    values = _values(N, 9, 3)
    values[1] = 0.0
    values[3] = -0.0
    loaded = from_arrays(_position(), values)
    assert loaded.warnings == () and loaded.live.tolist() == [True, False, True, False, True, True]
    values[2, 4, 1] = np.nan
    values[5, 0, 0] = -np.inf
    loaded = from_arrays(_position(), values, name="yard")
    assert loaded.live.tolist() == [True, False, False, False, True, False]
    (warning,) = loaded.warnings
    assert warning == "yard: 2 probes with a NaN or infinite number in sh, first probe 2: set to zero and left out"
    np.testing.assert_array_equal(loaded.values[[1, 2, 3, 5]], 0.0)
    np.testing.assert_array_equal(loaded.values[[0, 4]], values[[0, 4]].reshape(2, 27))
    assert np.isnan(values[2, 4, 1])  # the caller's array is left alone


def test_no_live_probe_and_no_probe(tmp_path):
    for values in (np.zeros((N, 27)), np.full((N, 27), np.nan), np.full((N, 27), 1e-60)):
        assert "array: sh: every probe is zero, not finite or not valid" in error_of(from_arrays, _position(), values)
    path = _write(tmp_path / "a.npz", position=np.zeros((0, 3)), sh=np.zeros((0, 9, 3)))
    assert "a.npz: position: expected at least one probe, found none" in error_of(load, path)
    for content in ({"probes": []}, {"position": [], "sh": []}):
        path = _write_json(tmp_path / "a.json", content)
        assert "position: expected at least one probe, found none" in error_of(load, path)


def test_positions_far_away_are_kept():
    position = _position() + [1e9, -3e12, 0.0]
    loaded = from_arrays(position, _values(N, 27))
    np.testing.assert_array_equal(loaded.position, position)
    assert loaded.warnings == ()
    position[0, 0], position[1, 0] = -1.5e308, 1.5e308
    assert "expected positions within 1e+150 of each other" in error_of(from_arrays, position, _values(N, 27))


def test_coincident_positions():
    position = _position()
    position[4] = position[2] = position[1]
    position[5] = 0.0
    position[3] = -0.0
    loaded = from_arrays(position, _values(N, 27), name="yard")
    assert loaded.warnings == ("yard: 3 probes at the position of another: Gaussians decode them to one value",)
    np.testing.assert_array_equal(loaded.values, _values(N, 27))
    assert loaded.live.all()
    pair = from_arrays(np.zeros((2, 3)), np.abs(_values(2, 3)))
    assert pair.warnings == ("array: 1 probe at the position of another: Gaussians decode them to one value",)
    # One coordinate alike is no coincidence.
    position = _position()
    position[:, 1] = 7.0
    assert from_arrays(position, _values(N, 27)).warnings == ()


def test_numbers_as_large_and_as_small_as_float32_allows():
    values = _values(N, 27)
    values[3, 8], values[4, 0], values[5] = LARGEST, -LARGEST, -1e-44
    loaded = from_arrays(_position(), values)
    np.testing.assert_array_equal(loaded.values, values)
    assert loaded.live.all() and len(loaded.warnings) == 1, "light is not negative"
    with np.errstate(over="raise"):
        assert np.isfinite(np.square(loaded.values)).all()
    for bad in (LARGEST * 1.001, -1e30, 1e300, 1.7e308):
        wide = values.astype(np.float64)
        wide[3, 8], wide[5, 1] = bad, np.inf
        for convention in ("threejs", "godot"):
            message = error_of(from_arrays, _position(), wide, convention=convention)
            assert "sh[3]: expected numbers of at most 1.8e+19, got " in message


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int16, np.uint8, ">f4", np.longdouble])
def test_number_types_are_converted(tmp_path, dtype):
    values = np.arange(1, N * 27 + 1).reshape(N, 9, 3).astype(dtype)
    position = np.arange(3 * N).reshape(N, 3).astype(dtype)
    loaded = load(_write(tmp_path / "a.npz", position=position, sh=values))
    assert (loaded.position.dtype, loaded.values.dtype) == (np.float64, np.float32)
    np.testing.assert_array_equal(loaded.values.reshape(N, 9, 3), values)
    np.testing.assert_array_equal(loaded.position, position)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"position": np.zeros((N, 2))}, "position: expected the shape (N, 3), got (6, 2)"),
        ({"position": np.float64(3)}, "position: expected at least one probe, found none"),
        ({"position": np.full((N, 3), "a")}, "position: expected numbers, got <U1"),
        ({"sh": _values(N - 1, 9, 3)}, "sh: expected the shape (6, C, 3) with RGB last or (6, D), a row for each"),
        ({"sh": _values(N, 3, 5)}, "got (6, 3, 5)"),
        ({"sh": _values(N, 9, 1)}, "got (6, 9, 1)"),
        ({"sh": np.zeros((N, 0))}, "got (6, 0)"),
        ({"sh": np.ones((N, 4097))}, "sh: expected at most 4096 numbers a probe, got 4097"),
        ({"sh": np.ones((N, 27), bool)}, "sh: expected numbers, got bool"),
        ({"sh": np.ones((N, 27), complex)}, "sh: expected numbers, got complex128"),
        ({"sh": np.full((N, 27), None)}, "sh: expected an array of plain values, found object"),
    ],
)
def test_wrong_shapes_and_types(tmp_path, changes, expected):
    path = _write(tmp_path / "a.npz", **changes)
    message = error_of(load, path)
    assert message.startswith(f"{path}: ") and expected in message


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("[1]", "expected a JSON object, got [1]"),
        ('"sh"', 'expected a JSON object, got "sh"'),
        ("\xff\xfe\x00", "not valid JSON"),
        ('{"position": [[0, 0, 0]], "sh": [[1]]', "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ("{}", "position is missing; found nothing"),
        ('{"position": 3, "sh": [[1]]}', "position: expected a list, got 3"),
        ('{"position": [[0, 0, 0]], "sh": {"a": 1}}', "sh: expected a list, got an object"),
        ('{"position": [[0, 0, 0], [1, 1]], "sh": [[1], [2]]}', "position[1]: expected numbers, as many as"),
        ('{"position": [[0, 0, 0]], "sh": [["1"]]}', 'numbers, as many as sh[0] has, got ["1"]'),
        ('{"position": [[0, 0, 0], [1, 1, 1]], "sh": [[1], [null]]}', "sh[1]: expected numbers"),
        ('{"position": [[0, 0, 0]], "sh": [[true]]}', "sh[0]: expected numbers"),
        ('{"position": [[0, 0, 0]], "sh": [[1%s, 0.5]]}' % ("0" * 400), "expected integers within 64 bits"),
        ('{"position": [[0, 0, 0]], "sh": [[1%s]]}' % ("0" * 5000), "not valid JSON"),
        ('{"position": [[0, 0, NaN]], "sh": [[1]]}', "position[0]: expected finite numbers"),
        ('{"position": [[0, 0, 0]], "sh": [' + "[" * 80 + "1" + "]" * 80 + "]}", "sh[0]: expected numbers"),
        ('{"probes": {}}', "probes: expected a list, got an object"),
        ('{"probes": [3]}', "probes[0]: expected an object (position, sh), got 3"),
        ('{"probes": [{"position": [0, 0, 0], "sh": [1]}, {"sh": [1]}]}', "probes[1].position is missing"),
        ('{"probes": [{"position": [0, 0, 0], "sh": [1]}, {"position": 1, "sh": [1]}]}', "position[1]: expected"),
        ('{"probes": [{"position": [0, 0, 0]}]}', "begins with sh"),
    ],
)
def test_malformed_json_names_the_field(tmp_path, content, expected):
    path = tmp_path / "a.json"
    path.write_bytes(content.encode("latin-1"))
    message = error_of(load, path)
    assert message.startswith(f"{path}: ") and expected in message


def test_positions_of_any_file(tmp_path):
    points = _position().tolist()
    lists = {"a.json": points, "b.json": {"position": points}, "c.txt": {"probes": [{"position": x} for x in points]}}
    paths = [_write_json(tmp_path / name, content) for name, content in lists.items()]
    np.savez(tmp_path / "d.npz", position=_position().astype(np.float32), other=1)
    (tmp_path / "e.lmbake").write_bytes(Writer().file(bake(Writer(), _position(), _values(N, 9, 3))))
    for path in (*paths, tmp_path / "d.npz", tmp_path / "e.lmbake"):
        position = load_positions(path)
        assert position.dtype == np.float64
        np.testing.assert_array_equal(position, _position())


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("3", "expected a JSON object, got 3"),
        ("{}", "position: expected a list, got null"),
        ('{"probes": [{"sh": 3}]}', "probes[0].position is missing"),
        ("[]", "position: expected at least one probe, found none"),
        ("[[1, 2]]", "position: expected the shape (N, 3), got (1, 2)"),
        ('[[0, 0, 0], [0, 1, "2"]]', "position[1]: expected numbers, as many as position[0] has, got [0, 1, "),
        ("[[0, 1, 1e999]]", "position[0]: expected finite numbers"),
        ({"path": np.zeros((2, 3))}, "position is missing; found path"),
        ({"position": np.zeros((0, 3))}, "position: expected at least one probe, found none"),
    ],
)
def test_what_holds_no_positions(tmp_path, content, expected):
    path = tmp_path / ("a.json" if isinstance(content, str) else "a.npz")
    if isinstance(content, str):
        path.write_bytes(content.encode("latin-1"))
    else:
        np.savez(path, **content)
    message = error_of(load_positions, path)
    assert message.startswith(f"{path}: ") and expected in message
    assert "No such file" in error_of(load_positions, tmp_path / "absent.npz")


@pytest.mark.parametrize("suffix", [".npz", ".json", ".JSON"])
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("coefficients", [1, 4, 9])
def test_what_was_written_is_read(tmp_path, suffix, convention, coefficients):
    probes = synthetic(40, coefficients=coefficients, dead=2)
    path = tmp_path / f"a{suffix}"
    save_probes(path, probes.position, probes.values, key="sh_9", convention=convention)
    loaded = load(path)
    assert loaded.key == "sh_9"
    np.testing.assert_array_equal(loaded.position, probes.position)
    np.testing.assert_array_equal(loaded.live, probes.live)
    if convention in ("threejs", "unreal"):
        _same(loaded, probes)
    np.testing.assert_allclose(loaded.values, probes.values, rtol=3e-7)
    if suffix == ".npz":
        expected = from_canonical(probes.values.reshape(40, -1, 3), convention).astype(np.float32)
        with np.load(path, allow_pickle=False) as file:
            assert sorted(file.files) == ["convention", "position", "sh_9"] and file["convention"] == convention
            np.testing.assert_array_equal(file["sh_9"], expected)


def test_writing_is_refused_without_touching_the_file(tmp_path):
    for flat in (tmp_path / "flat.npz", tmp_path / "flat.json"):
        save_probes(flat, _position(), _values(N, 6))
        _same(load(flat), from_arrays(_position(), _values(N, 6)))
        flat.unlink()
    path = tmp_path / "a.npz"
    path.write_bytes(b"precious")
    arguments = path, _position(), _values(N, 27)
    for key in ("position", "convention", "probes", "file", "allow_pickle"):
        assert "no other field" in error_of(save_probes, *arguments, key=key)
    assert "expected spherical harmonics" in error_of(save_probes, path, _position(), _values(N, 5), convention="unity")
    assert "ends in .npz or .json, found .lmbake" in error_of(save_probes, tmp_path / "a.lmbake", *arguments[1:])
    assert "does not exist" in error_of(save_probes, tmp_path / "no" / "a.json", *arguments[1:])
    for position, values in (
        (_position()[:4], _values(N, 27)),
        (_position()[:, :2], _values(N, 27)),
        (_position(), _values(N, 9, 3)),
        (_position()[:0], _values(N, 27)[:0]),
        (_position(), np.full((N, 27), np.nan)),
        (np.full((N, 3), np.inf), _values(N, 27)),
    ):
        assert "expected" in misuse_of(save_probes, path, position, values)
    assert path.read_bytes() == b"precious" and [p.name for p in tmp_path.iterdir()] == ["a.npz"]
