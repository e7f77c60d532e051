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
