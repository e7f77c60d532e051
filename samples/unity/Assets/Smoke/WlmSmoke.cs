// Plays six-way smoke on a quad, and gives its material the lights. See README.md.
using System;
using UnityEngine;

[ExecuteAlways]
[RequireComponent(typeof(MeshRenderer))]
public class WlmSmoke : MonoBehaviour
{
    [Tooltip("bundle.json.")]
    public TextAsset bundle;
    [Tooltip("Up to four directional lights; if empty, the scene's sun.")]
    public Light[] lights = Array.Empty<Light>();
    [Tooltip("Radiance of a uniform sky.")]
    public Color sky = Color.black;
    public bool playing = true;
    [Tooltip("Whether to start again after the last frame instead of stopping there.")]
    public bool loop = true;
    [Tooltip("Seconds since the first frame.")]
    public float time;

    [Serializable]
    class Info
    {
        public int frames, levels;
        public float rate;
        public float[] extent;
    }

    const int Most = 4;
    readonly Vector4[] toward = new Vector4[Most], irradiance = new Vector4[Most];
    Info read;
    MaterialPropertyBlock block;

    void OnEnable()
    {
        read = bundle == null ? null : JsonUtility.FromJson<Info>(bundle.text);
        block = new MaterialPropertyBlock();
        // The bounds contain the billboard for any rotation of the quad.
        GetComponent<MeshRenderer>().localBounds = new Bounds(Vector3.zero, 1.5f * Vector3.one);
    }

    [ContextMenu("Size of the simulation")]
    public void Resize()
    {
        OnEnable();
        if (read != null)
            transform.localScale = new Vector3(read.extent[0], read.extent[1], 1f);
    }

    void LateUpdate()
    {
        if (read == null)
            return;
        if (playing && Application.isPlaying)
            time += Time.deltaTime;
        float frame = Mathf.Max(time, 0f) * read.rate;
        frame = loop ? Mathf.Repeat(frame, read.frames) : Mathf.Min(frame, read.frames - 1);
        Array.Clear(irradiance, 0, Most);
        int count = 0;
        foreach (Light each in lights.Length > 0 ? lights : new[] { RenderSettings.sun })
        {
            if (each == null || !each.isActiveAndEnabled || count == Most)
                continue;
            // A light of intensity 1 makes a white surface that faces it appear as 1, so its irradiance is pi.
            Color colour = each.color.linear * (Mathf.PI * each.intensity);
            toward[count] = -each.transform.forward;
            irradiance[count++] = new Vector4(colour.r, colour.g, colour.b, 0f);
        }
        MeshRenderer shown = GetComponent<MeshRenderer>();
        shown.GetPropertyBlock(block);
        block.SetFloat("_WlmFrame", frame);
        block.SetColor("_WlmSky", sky);
        block.SetVectorArray("_WlmToward", toward);
        block.SetVectorArray("_WlmIrradiance", irradiance);
        shown.SetPropertyBlock(block);
    }

#if UNITY_EDITOR
    // Imports linear, uncompressed, at the original size: the defaults for colour pictures would change the light.
    [ContextMenu("Import the textures as they are")]
    public void Import()
    {
        OnEnable();
        Material material = GetComponent<MeshRenderer>().sharedMaterial;
        foreach (string name in material.GetTexturePropertyNames())
        {
            string path = UnityEditor.AssetDatabase.GetAssetPath(material.GetTexture(name));
            if (UnityEditor.AssetImporter.GetAtPath(path) is not UnityEditor.TextureImporter importer)
                continue;
            importer.sRGBTexture = false;
            importer.alphaIsTransparency = false;
            importer.alphaSource = UnityEditor.TextureImporterAlphaSource.FromInput;
            importer.npotScale = UnityEditor.TextureImporterNPOTScale.None;
            importer.textureCompression = UnityEditor.TextureImporterCompression.Uncompressed;
            importer.maxTextureSize = 16384;
            importer.wrapMode = TextureWrapMode.Clamp;
            importer.filterMode = FilterMode.Trilinear;
            importer.mipmapEnabled = read != null && read.levels > 0;
            importer.SaveAndReimport();
        }
    }
#endif
}
