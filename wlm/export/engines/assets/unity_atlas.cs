// Sets the textures of a compressed lightmap on the renderers below this object. See README.md.
using System;
using UnityEngine;
using UnityEngine.Experimental.Rendering;

[ExecuteAlways]
public class WlmAtlas : MonoBehaviour
{
    [Tooltip("The .bytes files of the same names; leave the fields without a file empty.")]
    public TextAsset colour, lut, blocks;

    readonly System.Collections.Generic.List<Texture> made = new();

    void OnEnable()
    {
        foreach (Renderer each in GetComponentsInChildren<Renderer>())
        {
            var block = new MaterialPropertyBlock();
            each.GetPropertyBlock(block);
            Put(block, "colour", colour);
            Put(block, "lut", lut);
            Put(block, "blocks", blocks);
            each.SetPropertyBlock(block);
        }
    }

    void OnDisable()
    {
        foreach (Texture each in made)
            DestroyImmediate(each);
        made.Clear();
    }

    void Put(MaterialPropertyBlock block, string name, TextAsset asset)
    {
        if (asset == null)
            return;
        Texture texture = made.Find(each => each.name == name);
        if (texture == null)
        {
            texture = ReadDds(asset, false);
            texture.name = name;
            made.Add(texture);
        }
        block.SetTexture("wlm_atlas_" + name, texture);
    }

@DDS@
}
