"""Probe files as other writers lay them out: each holds the light of `canonical`, in Unity's numbers if not said."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from builders.probe_sets import synthetic

from wlm.probe.conventions import from_canonical
from wlm.probe.data import ProbeSet

COUNT = 40


def canonical() -> ProbeSet:
    return synthetic(COUNT, seed=5)


def unity_numbers() -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3], and Unity's numbers channel by channel, [N, 3, 9]."""
    probes = canonical()
    values = from_canonical(probes.values.reshape(COUNT, 9, 3), "unity")
    return probes.position, values.transpose(0, 2, 1)


def vci(place: np.ndarray, light: np.ndarray) -> dict[str, Any]:
    names = (f"sphericalHarmonicsCoefficients{channel}" for channel in ("Red", "Green", "Blue"))
    channels = dict(zip(names, light.tolist(), strict=True))
    return {"position": (place * [-1.0, 1.0, 1.0]).tolist(), **channels}


def vector(place: np.ndarray, names: str = "xyz") -> dict[str, float]:
    return dict(zip(names, place.tolist(), strict=True))


def three_scene() -> dict[str, Any]:
    """Probes in two groups, the second one moved, with twice the intensity and half the numbers."""
    probes = canonical()
    groups = []
    for shift, intensity, rows in (((0.0, 0.0, 0.0), 1.0, slice(0, 25)), ((4.0, -1.0, 2.0), 2.0, slice(25, COUNT))):
        children = []
        for place, light in zip(probes.position[rows], probes.values[rows], strict=True):
            matrix = np.eye(4)
            matrix[3, :3] = place - shift
            numbers = (light.astype(float) / intensity).tolist()
            child = {"type": "LightProbe", "intensity": intensity, "matrix": matrix.ravel().tolist(), "sh": numbers}
            children.append(child | ({"intensity": 1} if intensity == 1.0 else {}))
        matrix = np.eye(4)
        matrix[3, :3] = shift
        groups.append({"type": "Group", "name": "probes", "matrix": matrix.ravel().tolist(), "children": children})
    mesh = {"type": "Mesh", "matrix": np.eye(4).ravel().tolist()}
    scene = {"type": "Scene", "uuid": "a", "children": [*groups, mesh]}
    return {"metadata": {"version": 4.6, "type": "Object", "generator": "Object3D.toJSON"}, "object": scene}


def unity_text(count: int = COUNT) -> str:
    """A text asset of `LightProbes`, after another object."""
    position, light = unity_numbers()
    head = "%YAML 1.1\n%TAG !u! tag:unity3d.com,2011:\n"
    lines = ["--- !u!114 &11400000", "MonoBehaviour:", "  m_Name: day"]
    lines += ["--- !u!258 &25800000", "LightProbes:", "  m_Name: LightProbes", "  m_Data:", "    m_ProbeSets: []"]
    lines += ["    m_Positions:", *(f"    - {{x: {x:.9g}, y: {y:.9g}, z: {z:.9g}}}" for x, y, z in position[:count])]
    lines += ["    m_NonTetrahedralizedProbeSetIndexMap: {}", "  m_BakedCoefficients:"]
    for probe in light.reshape(COUNT, 27)[:count]:
        lines += [f"  {' ' if i else '-'} sh[{i:2d}]: {number:.9g}" for i, number in enumerate(probe)]
    return head + "\n".join([*lines, "  m_BakedLightOcclusion: []", ""])


def json_files() -> dict[str, tuple[Any, str | None]]:
    """Contents of JSON files by name, and the convention that has to be given, None if the file tells it."""
    position, light = unity_numbers()
    rows = list(zip(position, light, strict=True))
    flat = light.reshape(COUNT, 27)
    canon = canonical().values.reshape(COUNT, 9, 3).tolist()
    unreal = from_canonical(canonical().values.reshape(COUNT, 9, 3), "unreal").transpose(0, 2, 1)
    vectors = [vector(place) for place in position]
    return {
        "vci": ([vci(*row) for row in rows], None),
        "vci in a glTF extension": (
            {"VCAST_vci_location_lighting": {"locationLighting": {"lightProbes": [vci(*row) for row in rows]}}},
            None,
        ),
        "JsonUtility": ({"probes": [{"position": vector(p), "sh": v.ravel().tolist()} for p, v in rows]}, "unity"),
        "three lists": ({"probes": [{"position": p.tolist(), "sh": v.tolist()} for p, v in rows]}, "unity"),
        "numbered members": (
            [
                {"pos": vector(p), "sh": {f"sh[{i:2d}]": x for i, x in enumerate(v.ravel().tolist())}, "cell": 1}
                for p, v in rows
            ],
            "unity",
        ),
        "shr0 beside x, y, z": (
            [
                vector(p)
                | {f"sh{channel}{i}": float(v[c, i]) for c, channel in enumerate("rgb") for i in range(9)}
                | {"group": "hall"}
                for p, v in rows
            ],
            None,
        ),
        "flat lists": ({"positions": position.ravel().tolist(), "coefficients": flat.ravel().tolist()}, "unity"),
        "lists of vectors": (
            {"Positions": vectors, "sphericalHarmonics": [[vector(c, "rgb") for c in np.array(v)] for v in canon]},
            "threejs",
        ),
        "a member for each channel": (
            {
                "scene": {
                    "nodes": [{"location": p.tolist(), **dict(zip("rgb", v.tolist(), strict=True))} for p, v in rows]
                }
            },
            "unity",
        ),
        "Unreal's samples": (
            {
                "HighQualitySamples": [
                    {
                        "Position": vector(p, "XYZ"),
                        "Radius": 50.0,
                        "Lighting": {channel: {"V": v[i].tolist()} for i, channel in enumerate("RGB")},
                    }
                    for p, v in zip(position, unreal, strict=True)
                ]
            },
            "unreal",
        ),
        "three.js scene": (three_scene(), None),
    }


def tables() -> dict[str, str]:
    """Texts of tables by name, all of Unity's numbers channel by channel."""
    position, light = unity_numbers()
    rows = np.concatenate([position, light.reshape(COUNT, 27)], 1)
    named = ["id,pos_x,pos_y,pos_z," + ",".join(f"{c}{i}" for i in range(9) for c in "rgb") + ",radius"]
    mixed = np.concatenate([position, light.transpose(0, 2, 1).reshape(COUNT, 27), np.ones((COUNT, 1))], 1)
    named += [f"{i}," + ",".join(f"{x:.9g}" for x in row) for i, row in enumerate(mixed)]
    spaced = ["# x y z and SH", *(" ".join(f"{x:.9g}" for x in row) for row in rows)]
    tabs = "x\ty\tz\t" + "\t".join(f"sh_{i + 1}" for i in range(27))
    tabs = [tabs, *("\t".join(f"{x:.9g}" for x in r) for r in rows)]
    return {
        "commas.csv": "\n".join(",".join(f"{x:.9g}" for x in row) for row in rows),
        "named.csv": "\ufeff" + "\r\n".join(named),
        "spaces.csv": "\n".join(spaced),
        "tabs.tsv": "\n".join(tabs),
        "semicolons.csv": "\n".join(";".join(f"{x:.9g}" for x in row) for row in rows) + "\n\n",
    }


def write_json(folder: Path, name: str, content: Any) -> Path:
    path = folder / f"{name.replace(' ', '-').replace(',', '')}.json"
    path.write_text(json.dumps(content))
    return path
