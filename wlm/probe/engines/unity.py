"""Exports light to Unity: the numbers of `SphericalHarmonicsL2` in JSON, and a component that applies them to a scene.

Unity creates `LightProbes` only by baking, but scripts may replace the baked light, `LightProbes.bakedProbes`. Before a
bake, the component places a `LightProbeGroup` at the model's positions; after the bake, it gives each of the
scene's probes the light of the model's probe at its place. `sh[channel, coefficient]` follows the convention "unity".
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.formats.folder import compact_json, rounded
from wlm.probe.axes import read_axes, turned
from wlm.probe.conventions import from_canonical
from wlm.probe.places import positions_of
from wlm.probe.sphere import sh_count

FORMAT = "wlm-unity-probes"
_VERSION = 1
INFO_FILE = "probes.json"
SCRIPT_FILE = "WlmLightProbes.cs"
_L2 = 9
_MOST_PROBES = 1 << 17  # the JSON stays short enough to be read as an index
_ABOUT = (
    "position: x, y, z of each probe, in Unity's units and axes. sh: of each probe 27 numbers, 9 of red, 9 of green, 9 "
    "of blue, as SphericalHarmonicsL2 has them. Put this folder into Assets; the script's head says the rest."
)

_SCRIPT = """\
// Puts the light probes of probes.json into a scene. For Unity 2019.4 and later, in any render pipeline.
//
// 1. Put this folder into Assets, and this component on an object of the scene; give it probes.json.
// 2. In its menu (three dots) take "Place a group": a LightProbeGroup at the probes' places. Not needed where the scene
//    has the group that the probes came from.
// 3. Bake once (Window > Rendering > Lighting > Generate Lighting), so that Unity has tetrahedra between them.
// 4. From then on the light is replaced when the scene is opened or played; "Apply" in the menu does it again.
using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Rendering;

[ExecuteAlways]
public class WlmLightProbes : MonoBehaviour
{
    [Tooltip("probes.json")]
    public TextAsset probes;

    [Tooltip("How far one of the scene's probes may be from one of the file's")]
    public float tolerance = 0.01f;

    [Serializable]
    class Content
    {
        public string format;
        public int version;
        public float[] position;
        public float[] sh;
    }

    void OnEnable()
    {
        if (probes != null)
            Apply();
    }

    Content Read()
    {
        Content content = probes == null ? null : JsonUtility.FromJson<Content>(probes.text);
        if (content == null || content.format != "wlm-unity-probes" || content.version != 1)
            throw new FormatException("WlmLightProbes: expected probes.json of wlm, version 1");
        if (content.sh.Length != 9 * content.position.Length)
            throw new FormatException("WlmLightProbes: expected 27 numbers for each position");
        return content;
    }

    [ContextMenu("Apply")]
    public void Apply()
    {
        Content content = Read();
        LightProbes scene = LightmapSettings.lightProbes;
        if (scene == null || scene.count == 0)
        {
            Debug.LogWarning("WlmLightProbes: the scene has no baked probes yet; place a group and bake once", this);
            return;
        }
        float side = Mathf.Max(tolerance, 1e-6f);
        var cells = new Dictionary<Vector3Int, List<int>>();
        for (int i = 0; i < content.position.Length / 3; ++i)
        {
            Vector3Int cell = Vector3Int.FloorToInt(Place(content, i) / side);
            if (!cells.TryGetValue(cell, out List<int> list))
                cells[cell] = list = new List<int>();
            list.Add(i);
        }
        Vector3[] places = scene.positions;
        SphericalHarmonicsL2[] light = scene.bakedProbes;
        int missing = 0;
        for (int p = 0; p < light.Length; ++p)
        {
            int nearest = Nearest(content, cells, places[p], side);
            if (nearest < 0)
            {
                ++missing;
                continue;
            }
            for (int channel = 0; channel < 3; ++channel)
                for (int c = 0; c < 9; ++c)
                    light[p][channel, c] = content.sh[27 * nearest + 9 * channel + c];
        }
        scene.bakedProbes = light;
        if (missing > 0)
            Debug.LogWarning($"WlmLightProbes: {missing} of {light.Length} probes are at no place of the file", this);
    }

    static Vector3 Place(Content content, int i)
    {
        return new Vector3(content.position[3 * i], content.position[3 * i + 1], content.position[3 * i + 2]);
    }

    static int Nearest(Content content, Dictionary<Vector3Int, List<int>> cells, Vector3 place, float side)
    {
        int nearest = -1;
        float least = side * side;
        Vector3Int middle = Vector3Int.FloorToInt(place / side);
        for (int x = -1; x <= 1; ++x)
            for (int y = -1; y <= 1; ++y)
                for (int z = -1; z <= 1; ++z)
                {
                    if (!cells.TryGetValue(middle + new Vector3Int(x, y, z), out List<int> list))
                        continue;
                    foreach (int i in list)
                    {
                        float apart = (Place(content, i) - place).sqrMagnitude;
                        if (apart > least)
                            continue;
                        least = apart;
                        nearest = i;
                    }
                }
        return nearest;
    }

#if UNITY_EDITOR
    [ContextMenu("Place a group")]
    void PlaceGroup()
    {
        Content content = Read();
        var places = new Vector3[content.position.Length / 3];
        for (int i = 0; i < places.Length; ++i)
            places[i] = transform.InverseTransformPoint(Place(content, i));
        LightProbeGroup group = GetComponent<LightProbeGroup>();
        if (group == null)
            group = gameObject.AddComponent<LightProbeGroup>();
        group.probePositions = places;
        UnityEditor.EditorUtility.SetDirty(group);
    }
#endif
}
"""


def write_kit(
    bundle: Bundle,
    folder: Path,
    engine: str,
    *,
    axes: str | None = None,
    original: str | os.PathLike[str] | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Writes a model's probes for Unity: `WlmLightProbes.cs`, and `probes.json`, which it reads.

    Unity is left-handed: importers mirror a glTF scene along x or z, hence `axes` "-x,y,z" or "x,y,-z"
    (`wlm.probe.axes`), or None for a scene that came from Unity. The positions are read from `original`, the file that
    was compressed; if it is None, the stored positions are used.

    Raises:
        WlmError: The numbers are not spherical harmonics of order 0 to 2, there are over 131,072 probes, the axis does
            not exist, the positions are unknown or of other probes, a number exceeds float32, or the device does not
            exist.
    """
    model, position = bundle.model.at(), positions_of(bundle.model, original)
    coefficients = sh_count(model.outputs)
    if coefficients is None or coefficients > _L2:
        raise WlmError(f"{model.name}: expected 3, 12 or 27 numbers per probe (RGB SH, up to L2), got {model.outputs}")
    if model.probes > _MOST_PROBES:
        raise WlmError(f"{model.name}: expected at most {_MOST_PROBES} probes, got {model.probes}")
    matrix = read_axes(axes)
    place = model.stored_positions() if position is None else np.array(position, np.float64)
    values = turned(model.decoder(device, position=place).decode_probes(), matrix)
    place = place @ matrix.T
    light = np.zeros((len(values), _L2, 3))
    light[:, :coefficients] = from_canonical(values.reshape(len(values), coefficients, 3), "unity")
    if not max(np.abs(place).max(), np.abs(light).max()) < np.finfo(np.float32).max:
        raise WlmError(f"{model.name}: expected positions and light within the range of float32")
    document = {
        "format": FORMAT,
        "version": _VERSION,
        "about": _ABOUT,
        "name": model.name,
        "position": rounded(place.astype(np.float32).reshape(-1)),
        # [N, C, 3] to channel after channel.
        "sh": rounded(light.astype(np.float32).swapaxes(1, 2).reshape(-1)),
    }
    (folder / SCRIPT_FILE).write_text(_SCRIPT, encoding="utf-8")
    (folder / INFO_FILE).write_text(compact_json(document), encoding="utf-8")
    return {"about": _ABOUT}
