// Lightmaps over time: decodes the files of this folder into lightmaps of the scene. See README.md.
using System;
using System.IO;
using UnityEngine;
using UnityEngine.Experimental.Rendering;
using UnityEngine.Rendering;

[ExecuteAlways]
public class WlmLightmap : MonoBehaviour
{
    [Tooltip("bundle.json and the .bytes files of the same names; leave the fields without a file empty.")]
    public TextAsset bundle, networks, hours, valid, uv, uvt, planes, frames;
    public Shader shader;
    [Tooltip("Index of the scene's lightmap that this replaces; -1: none, read Light instead.")]
    public int lightmapIndex;
    [Tooltip("Time in the unit of the lightmaps' times, usually hours.")]
    public float time = 12f;
    [Tooltip("On for meshes whose UVs have v down, as in glTF. Importers flip v, and Unity's own lightmaps are v up.")]
    public bool vDown;

    /// Linear radiance at the current time; its top row is at v = 1, or with vDown at v = 0.
    public RenderTexture Light { get; private set; }

    [Serializable]
    class Content
    {
        public string format;
        public string system;
        public int version, width, height, hour_fours;
        public float period;
        public float[] times;
    }

    Content content;
    Material material;
    RenderTexture raw;
    readonly RenderTexture[] maps = new RenderTexture[2];
    readonly int[] hourOf = { -1, -1 };
    readonly System.Collections.Generic.List<UnityEngine.Object> made = new();
    Texture2D table, shown;
    float drawn;
    bool drawnDown;

    void OnEnable()
    {
        if (bundle == null || shader == null)
            return;
        content = JsonUtility.FromJson<Content>(bundle.text);
        if (content.format != "wlm-bundle" || content.version != 1 || content.system != "lightmap")
            throw new FormatException("WlmLightmap: expected bundle.json of a lightmap, version 1");
        material = Keep(new Material(shader));
        void Put(string name, TextAsset asset, bool array)
        {
            if (asset != null)
                material.SetTexture("wlm_lightmap_" + name, Keep(ReadDds(asset, array)));
        }
        Put("valid", valid, false);
        Put("uv", uv, false);
        Put("uvt", uvt, false);
        Put("planes", planes, false);
        Put("frames", frames, true);
        if (networks != null)
            material.SetTexture("wlm_lightmap_networks", Fours(Keep(Rows(networks.bytes.Length / 16)), networks.bytes, 0, networks.bytes.Length));
        table = Keep(Rows(content.hour_fours));
        material.SetTexture("wlm_lightmap_hour", table);
        RenderTexture Target() => Keep(new RenderTexture(content.width, content.height, 0, GraphicsFormat.R16G16B16A16_SFloat));
        (raw, maps[0], maps[1], Light) = (Target(), Target(), Target(), Target());
        shown = Keep(new Texture2D(content.width, content.height, GraphicsFormat.R16G16B16A16_SFloat, TextureCreationFlags.None));
        shown.wrapMode = TextureWrapMode.Clamp;
        drawn = float.NaN;
    }

    void OnDisable()
    {
        foreach (UnityEngine.Object each in made)
            DestroyImmediate(each);
        made.Clear();
        (hourOf[0], hourOf[1], content) = (-1, -1, null);
    }

    void Update()
    {
        if (content == null || (time == drawn && vDown == drawnDown))
            return;
        (drawn, drawnDown) = (time, vDown);
        (int before, int after, float share) = Around(time);
        // A new map replaces the one that is not needed now.
        int first = MapOf(before, after), second = share > 0f ? MapOf(after, before) : first;
        material.SetTexture("_WlmEarly", maps[first]);
        material.SetTexture("_WlmLate", maps[second]);
        material.SetFloat("_WlmShare", share);
        material.SetFloat("_WlmDown", vDown ? 1f : 0f);
        Draw(2, Light);
        if (lightmapIndex < 0)
            return;
        Graphics.CopyTexture(Light, shown);
        LightmapData[] all = LightmapSettings.lightmaps;
        if (lightmapIndex >= all.Length)
            Array.Resize(ref all, lightmapIndex + 1);
        for (int i = 0; i < all.Length; ++i)
            all[i] ??= new LightmapData();
        all[lightmapIndex].lightmapColor = shown;
        LightmapSettings.lightmaps = all;
    }

    // The stored times around one, and the share of the later one.
    (int, int, float) Around(float t)
    {
        float[] times = content.times;
        int count = times.Length;
        bool repeats = content.period > 0f;
        t = repeats ? Mathf.Repeat(t, content.period) : Mathf.Clamp(t, times[0], times[count - 1]);
        int before = Array.FindLastIndex(times, each => each <= t), after = before + 1;
        if (!repeats)
        {
            after = Mathf.Min(after, count - 1);
            return (before, after, after > before ? (t - times[before]) / (times[after] - times[before]) : 0f);
        }
        (before, after) = ((before + count) % count, after % count);
        float gap = Mathf.Repeat(times[after] - times[before], content.period);
        return (before, after, Mathf.Repeat(t - times[before], content.period) / (gap > 0f ? gap : content.period));
    }

    int MapOf(int hour, int other)
    {
        int place = Array.IndexOf(hourOf, hour);
        if (place >= 0)
            return place;
        place = hourOf[0] == other ? 1 : 0;
        Fours(table, hours.bytes, 16 * content.hour_fours * hour, 16 * content.hour_fours);
        Draw(0, raw);
        material.SetTexture("_WlmMap", raw);
        Draw(1, maps[place]);
        hourOf[place] = hour;
        return place;
    }

    void Draw(int pass, RenderTexture target)
    {
        var buffer = new CommandBuffer();
        buffer.SetRenderTarget(target);
        buffer.DrawProcedural(Matrix4x4.identity, material, pass, MeshTopology.Triangles, 3);
        Graphics.ExecuteCommandBuffer(buffer);
        buffer.Release();
    }

    // A texture of RGBA floats, 1,024 texels a row.
    static Texture2D Rows(int fours)
    {
        return new Texture2D(1024, (fours + 1023) / 1024, GraphicsFormat.R32G32B32A32_SFloat, TextureCreationFlags.None);
    }

    static Texture2D Fours(Texture2D texture, byte[] source, int start, int length)
    {
        byte[] padded = new byte[16 * texture.width * texture.height];
        Buffer.BlockCopy(source, start, padded, 0, length);
        texture.LoadRawTextureData(padded);
        texture.Apply(false);
        return texture;
    }

    T Keep<T>(T thing) where T : UnityEngine.Object
    {
        made.Add(thing);
        return thing;
    }

    // Reads a texture or texture array from a DDS file with the DX10 header.
    static Texture ReadDds(TextAsset asset, bool array)
    {
        byte[] bytes = asset.bytes;
        int height = BitConverter.ToInt32(bytes, 12), width = BitConverter.ToInt32(bytes, 16);
        int layers = BitConverter.ToInt32(bytes, 140);
        GraphicsFormat format = BitConverter.ToInt32(bytes, 128) switch
        {
            2 => GraphicsFormat.R32G32B32A32_SFloat,
            10 => GraphicsFormat.R16G16B16A16_SFloat,
            12 => GraphicsFormat.R16G16B16A16_UInt,
            35 => GraphicsFormat.R16G16_UNorm,
            36 => GraphicsFormat.R16G16_UInt,
            49 => GraphicsFormat.R8G8_UNorm,
            61 => GraphicsFormat.R8_UNorm,
            67 => GraphicsFormat.E5B9G9R9_UFloatPack32,
            95 => GraphicsFormat.RGB_BC6H_UFloat,
            98 => GraphicsFormat.RGBA_BC7_UNorm,
            _ => throw new FormatException(asset.name + ": this DXGI format is not supported"),
        };
        byte[] levels = new byte[bytes.Length - 148];
        Buffer.BlockCopy(bytes, 148, levels, 0, levels.Length);
        if (!array)
        {
            var texture = new Texture2D(width, height, format, TextureCreationFlags.None);
            texture.wrapMode = TextureWrapMode.Clamp;
            texture.LoadRawTextureData(levels);
            texture.Apply(false, true);
            return texture;
        }
        var stack = new Texture2DArray(width, height, layers, format, TextureCreationFlags.None);
        stack.wrapMode = TextureWrapMode.Clamp;
        for (int i = 0; i < layers; ++i)
            stack.SetPixelData(levels, 0, i, levels.Length / layers * i);
        stack.Apply(false, true);
        return stack;
    }
}
