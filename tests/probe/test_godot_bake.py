"""Bakes for Godot: what its own lookup finds in them, and what stays of a bake that gets other light."""

import struct

import numpy as np
import pytest
from builders.godot_bakes import Writer, bake
from builders.probe_models import random_model

import wlm
from wlm.errors import WlmError
from wlm.export import export
from wlm.formats.godot import read_lmbake, relit
from wlm.probe.data import from_arrays


def packed(data: bytes, key: str, kind: int, form: str, each: int) -> np.ndarray:
    """A packed array of the dictionary, found by its key."""
    mark = struct.pack("<I", len(key) + 1) + key.encode() + b"\0" + struct.pack("<I", kind)
    at = data.index(mark) + len(mark)
    return np.frombuffer(data, form, struct.unpack_from("<I", data, at)[0] * each, at + 4)


def tap(data: bytes, place: np.ndarray) -> np.ndarray:
    """The light at a place as Godot's renderer finds it, in floats (lightmap_tap_sh_light); None outside."""
    points = packed(data, "points", 35, "<f4", 3).reshape(-1, 3)
    corners, tree = packed(data, "tetrahedra", 32, "<i4", 1).reshape(-1, 4), packed(data, "bsp", 32, "<i4", 1)
    light, tree = packed(data, "sh", 36, "<f4", 4).reshape(-1, 9, 4), tree.reshape(-1, 6)
    planes, place, node = tree[:, :4].view("<f4"), place.astype(np.float32), 0
    while node >= 0:
        over = planes[node, :3] @ place > planes[node, 3]
        following = tree[node, 4 if over else 5]
        assert following < 0 or following > node
        node = following
    corner = corners[-node - 1]
    frame = np.concatenate([points[corner].T, np.ones((1, 4))])
    weight = np.linalg.solve(frame.astype(np.float64), np.append(place, 1.0))
    assert (weight > -1e-4).all(), "the place isn't in its tetrahedron"
    return np.einsum("k,kcb->cb", weight.clip(0.0, 1.0), light[corner])


@pytest.mark.parametrize("cells", [1, 5])
def test_godot_finds_the_light_at_any_place(cells, tmp_path):
    model = random_model()
    export(model, tmp_path / "out", "godot", cells=cells)
    path = tmp_path / "out" / "light.lmbake"
    data, (points, light) = path.read_bytes(), read_lmbake(path)
    np.testing.assert_allclose(light.reshape(-1, 27) * np.pi, model.decoder().decode(points), rtol=1e-4, atol=1e-5)
    side, low, high = 8.0 / cells, points.min(0), points.max(0)
    assert (low <= model.origin).all() and (high >= model.origin + model.extent * model.size).all()
    random = np.random.default_rng(cells)
    for place in low + random.random((200, 3)) * (high - low):
        found = tap(data, place)
        assert (found[:, 3] == 0).all()
        # Between the corners of its cell, and their mix along the path of Kuhn's tetrahedron.
        at = ((place - low) / side).astype(int)
        rest = (place - low) / side - at
        order = np.argsort(-rest)
        step, expected, previous = np.zeros(3, int), 0.0, 1.0
        for axis in (*order, None):
            follow = rest[axis] if axis is not None else 0.0
            nearest = np.abs(points - (low + side * (at + step))).sum(1).argmin()
            expected = expected + (previous - follow) * light[nearest]
            previous = follow
            if axis is not None:
                step[axis] = 1
        np.testing.assert_allclose(found[:, :3], expected, atol=1e-4 * np.abs(light).max())


@pytest.mark.parametrize(("order", "double"), [("<", False), (">", True)])
def test_a_bake_keeps_all_but_its_light(order, double, tmp_path):
    random = np.random.default_rng(0)
    points, light = random.random((40, 3)) * 8.0, random.random((40, 9, 3)).astype(np.float32)
    light[3] = 0.0
    writer, path = Writer(order, double), tmp_path / "room.lmbake"
    path.write_bytes(writer.file(bake(writer, points, light)))
    probes = wlm.probe.load(path)
    model = wlm.probe.compress(probes)
    export(model, tmp_path / "out", "godot", original=path)
    made = tmp_path / "out" / "light.lmbake"
    old, new = path.read_bytes(), made.read_bytes()
    differ = np.flatnonzero(np.frombuffer(old, "u1") != np.frombuffer(new, "u1"))
    colours = old.index(b"sh\0") + 3 + 8
    assert len(old) == len(new) and colours <= differ.min() and differ.max() < colours + 40 * 9 * 16
    again = wlm.probe.load(made)
    np.testing.assert_array_equal(again.live, probes.live)
    expected = model.decoder(position=probes.position).decode_probes()
    np.testing.assert_allclose(again.values, expected, rtol=1e-6)
    np.testing.assert_array_equal(relit(made, read_lmbake(path)[1]), old)


def test_what_is_refused(tmp_path):
    writer, random = Writer(), np.random.default_rng(0)
    points, path = random.random((9, 3)), tmp_path / "a.lmbake"
    path.write_bytes(writer.file(bake(writer, points, np.ones((9, 9, 3)))))
    model = wlm.probe.compress(from_arrays(points[::-1] + 1.0, np.ones((9, 27))))
    for refused, settings, message in [
        (random_model(outputs=12), {}, "expected L2 in RGB"),
        (random_model(outputs=12), {"original": path}, "expected L2 in RGB"),
        (random_model(), {"cells": 65}, "cells: expected 1 to 64"),
        (random_model(), {"cells": 4, "original": path}, "cells: expected none"),
        (model, {"original": path}, "a.lmbake: expected the 9 probes"),
        (model, {}, "stores no positions"),
    ]:
        with pytest.raises(WlmError, match=message):
            export(refused, tmp_path / "out", "godot", **settings)
    assert not (tmp_path / "out").exists()
