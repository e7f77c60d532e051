// The compressed lightmaps of a scene: gives the renderers below this object their parts. See README.md.
using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Experimental.Rendering;

[ExecuteAlways]
public class WlmScene : MonoBehaviour
{
    [Tooltip("scene.json, and the files of bytes.")]
    public TextAsset info, colour, lut, factors;
    [Tooltip("A state's number; between two they are mixed.")]
    public float state;

    [Serializable]
    class Sheet
    {
        public int width, height, row, column, rows, columns, page;
    }

    [Serializable]
    class Place
    {
        public string label;
        public int sheet;
        public float[] scale_offset;
    }

    [Serializable]
    class Info
    {
        public string[] states;
        public Sheet[] sheets;
        public Place[] objects;
    }

    readonly Dictionary<Renderer, Place> places = new();
    Info read;
    Texture colours, table;
    float shown = float.NaN;

    void OnEnable()
    {
        read = JsonUtility.FromJson<Info>(info.text);
        colours = ReadDds(colour, true);
        table = ReadDds(lut, false);
        foreach (Renderer each in GetComponentsInChildren<Renderer>())
        {
            // A node of several primitives is an object with one below it for each.
            Place found = null;
            for (Transform at = each.transform; found == null && at != null && at != transform.parent; at = at.parent)
                found = Array.Find(read.objects, place => place.label == at.name);
            if (found != null)
                places[each] = found;
        }
        shown = float.NaN;
    }

    void OnDisable()
    {
        foreach (Renderer each in places.Keys)
            if (each != null)
                each.SetPropertyBlock(null);
        places.Clear();
        DestroyImmediate(colours);
        DestroyImmediate(table);
    }

    void Update()
    {
        if (state == shown)
            return;
        shown = state;
        Vector4[] mixed = Mixed();
        foreach (KeyValuePair<Renderer, Place> each in places)
        {
            var block = new MaterialPropertyBlock();
            each.Key.GetPropertyBlock(block);
            Sheet sheet = read.sheets[each.Value.sheet];
            float[] place = each.Value.scale_offset;
            block.SetTexture("wlm_scene_colour", colours);
            block.SetTexture("wlm_scene_lut", table);
            block.SetVector("wlm_place", new Vector4(place[0], place[1], place[2], place[3]));
            block.SetVector("wlm_sheet", new Vector4(sheet.width, sheet.height, sheet.column, sheet.row));
            block.SetVector("wlm_tiles", new Vector4(sheet.columns, sheet.rows, sheet.page, 0));
            block.SetVectorArray("wlm_factors", mixed);
            each.Key.SetPropertyBlock(block);
        }
    }

    // A factor for each component: four floats each, state after state.
    Vector4[] Mixed()
    {
        byte[] bytes = factors.bytes;
        int last = read.states.Length - 1, count = bytes.Length / 16 / read.states.Length;
        float at = Mathf.Clamp(state, 0, last);
        int low = (int)at, high = Mathf.Min(low + 1, last);
        Vector4 Of(int number, int i)
        {
            int start = 16 * (number * count + i);
            return new Vector4(BitConverter.ToSingle(bytes, start), BitConverter.ToSingle(bytes, start + 4),
                BitConverter.ToSingle(bytes, start + 8), 0);
        }
        var mixed = new Vector4[count];
        for (int i = 0; i < count; ++i)
            mixed[i] = Vector4.Lerp(Of(low, i), Of(high, i), at - low);
        return mixed;
    }

@DDS@
}
