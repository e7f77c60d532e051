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
