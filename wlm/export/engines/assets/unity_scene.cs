// Lights the renderers below this object with their parts of a scene's compressed lightmaps. See README.md.
using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Experimental.Rendering;

[ExecuteAlways]
public class WlmScene : MonoBehaviour
{
    [Tooltip("bundle.json and the .bytes files of the same names; not every scene has blocks.")]
    public TextAsset bundle, sheets, lut, factors, colour, blocks;
    [Tooltip("Index of a state; between two states they are mixed.")]
    public float state;

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
        public Place[] objects;
    }

    readonly Dictionary<Renderer, Place> places = new();
    readonly Dictionary<string, Texture> textures = new();
    float shown = float.NaN;

    void OnEnable()
    {
        Info read = JsonUtility.FromJson<Info>(bundle.text);
        textures["wlm_scene_sheets"] = ReadDds(sheets, false);
        textures["wlm_scene_lut"] = ReadDds(lut, false);
        textures["wlm_scene_factors"] = ReadDds(factors, false);
        textures["wlm_scene_colour"] = ReadDds(colour, true);
        if (blocks != null)
            textures["wlm_scene_blocks"] = ReadDds(blocks, true);
        foreach (Renderer each in GetComponentsInChildren<Renderer>())
        {
            // A node of several primitives is an object with a child for each.
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
        foreach (Texture each in textures.Values)
            DestroyImmediate(each);
        textures.Clear();
    }

    void Update()
    {
        if (state == shown)
            return;
        shown = state;
        foreach (KeyValuePair<Renderer, Place> each in places)
        {
            var block = new MaterialPropertyBlock();
            each.Key.GetPropertyBlock(block);
            float[] place = each.Value.scale_offset;
            foreach (KeyValuePair<string, Texture> texture in textures)
                block.SetTexture(texture.Key, texture.Value);
            block.SetVector("wlm_place", new Vector4(place[0], place[1], place[2], place[3]));
            block.SetFloat("wlm_sheet", each.Value.sheet);
            block.SetFloat("wlm_state", state);
            each.Key.SetPropertyBlock(block);
        }
    }

@DDS@
}
