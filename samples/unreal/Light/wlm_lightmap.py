"""Imports lightmaps over time into Unreal 5.1 or later. Run it in the editor; see README.md."""

import bisect
import json
from pathlib import Path

import unreal

PLACE = "/Game/Wlm/cornell"
INFO = json.loads((Path(__file__).resolve().parent / "bundle.json").read_text(encoding="utf-8"))
DECODE = r"""
struct WlmNode
{
    int2 wlm_lightmap_place(int i, float hour)
    {
        return int2(i & 1023, (i >> 10) + 1 * int(hour + 0.5));
    }
    // Decodes a temporal lightmap: feature maps and a small network for each tile of 128 x 128 texels (Neural Dynamic GI,
    // sections 3.2 to 3.4). For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES
    // below `precision highp` of float, int, sampler2D and sampler2DArray.
    //
    // For each stored hour that is needed: bind the table of the hour, draw the map into a texture of linear light with
    // wlm_radiance(texel), and draw that one into another, each texel from wlm_source(texel), which fills the gaps between
    // charts that a filter reads at their edges. Materials mix two of these by the time between both hours (eq. 2).
    //
    // Textures; row 0 is v = 0. Filters are linear, without mip levels.
    //   wlm_lightmap_hour: the hour's floats of hours.bin, RGBA32F, 1024 a row; fetched.
    //   wlm_lightmap_networks: networks.bin, RGBA32F, 1024 a row; fetched.
    //   wlm_lightmap_uv: uv.dds, BC7, 128 x 128 texels a tile; fetched.
    //   wlm_lightmap_uvt: uvt.dds, BC7, 32 x 32 texels for each of 12 slices of a tile; filtered.
    //   wlm_lightmap_planes: planes.dds, RG8, 64 x 24 texels twice a tile; filtered.
    //   wlm_lightmap_valid: valid.png, R8, 128 x 128, white inside charts; fetched.
    //
    // If WLM_LIGHTMAP_EXACT is defined, four texels are fetched and mixed in floats; otherwise the filter unit mixes four
    // texels, with about 8 bits for a position between two of them.
    //
    // wlm_lightmap_four(i) and wlm_lightmap_entry(i) read four floats of networks and of the table: if these are in
    // buffers change them, or define WLM_LIGHTMAP_NET(i) and WLM_LIGHTMAP_HOUR_AT(i) before this file.


    float4 wlm_lightmap_entry(int i, float wlm_hour, Texture2D<float4> wlm_lightmap_hour)
    {
        return wlm_lightmap_hour.Load(int3(wlm_lightmap_place(i, wlm_hour), 0));
    }

    float4 wlm_lightmap_four(int i, Texture2D<float4> wlm_lightmap_networks)
    {
        return wlm_lightmap_networks.Load(int3(int2(i & 1023, i >> 10), 0));
    }

    // tiles in a row of the map
    #define WLM_LIGHTMAP_COLUMNS (1)
    // fours of a tile in the table, after 2 of all
    #define WLM_LIGHTMAP_RECORD (7)

    // texels of a slice of F_uvt along a side
    #define WLM_LIGHTMAP_SIDE (32)

    // A slice of F_uvt at a place in its texels; texel i has its centre at i + 1/2.
    float4 wlm_lightmap_slice(int image, float2 place, Texture2D<float4> wlm_lightmap_uvt, SamplerState wlm_linear_clamp_sampler)
    {
        int2 first = int2(image % 4, image / 4) * WLM_LIGHTMAP_SIDE;
        float2 inside = clamp(place, float2(0.5, 0.5), float2(32.0, 32.0) - float2(0.5, 0.5));
        return wlm_lightmap_uvt.SampleLevel(wlm_linear_clamp_sampler, (((float2)(first)) + inside) / float2(128.0, 96.0), 0.0);
    }

    // F_uvt at the table's hour, at a place from 0 to 1.
    float4 wlm_lightmap_volume(int row, float2 place, float wlm_hour, Texture2D<float4> wlm_lightmap_hour, Texture2D<float4> wlm_lightmap_uvt, SamplerState wlm_linear_clamp_sampler)
    {
        float4 time = wlm_lightmap_entry(0, wlm_hour, wlm_lightmap_hour);
        float2 texel = place * 32.0;
        float4 early = wlm_lightmap_slice(row * 12 + int(time.x), texel, wlm_lightmap_uvt, wlm_linear_clamp_sampler);
        return lerp(early, wlm_lightmap_slice(row * 12 + int(time.y), texel, wlm_lightmap_uvt, wlm_linear_clamp_sampler), time.z);
    }

    // F_ut (an even image) or F_vt (an odd one) at a row of time.
    float2 wlm_lightmap_line(int image, float place, int time, Texture2D<float4> wlm_lightmap_planes, SamplerState wlm_linear_clamp_sampler)
    {
        int2 first = int2(image % 1 * 64, image / 1 * 24 + time);
        float inside = clamp(place * 64.0, 0.5, 64.0 - 0.5);
        float2 at = ((float2)(first)) + float2(inside, 0.5);
        return wlm_lightmap_planes.SampleLevel(wlm_linear_clamp_sampler, at / float2(64.0, 48.0), 0.0).xy;
    }

    float2 wlm_lightmap_plane(int image, float place, float wlm_hour, Texture2D<float4> wlm_lightmap_hour, Texture2D<float4> wlm_lightmap_planes, SamplerState wlm_linear_clamp_sampler)
    {
        float4 time = wlm_lightmap_entry(1, wlm_hour, wlm_lightmap_hour);
        float2 early = wlm_lightmap_line(image, place, int(time.x), wlm_lightmap_planes, wlm_linear_clamp_sampler);
        return lerp(early, wlm_lightmap_line(image, place, int(time.y), wlm_lightmap_planes, wlm_linear_clamp_sampler), time.z);
    }

    // of 16 units
    #define WLM_LIGHTMAP_FOURS (4)

    // The tanh form of GELU, which the model was trained with, as x / (1 + exp(-2 z)), since the tanh of drivers takes
    // several times as long; within 4.8e-4 of the exact form.
    float4 wlm_gelu(float4 x)
    {
        float4 z = x * (-2.3022082 - 0.10294324 * x * x); // for powers of 2, which end before a float overflows
        return x / (1.0 + exp2(min(z, float4(80.0, 80.0, 80.0, 80.0))));
    }

    // b + x W, where the rows of W are `apart` groups of four apart.
    float4 wlm_lightmap_add(float4 b, float4 x, int at, int apart, Texture2D<float4> wlm_lightmap_networks)
    {
        float4 sum = b + x.x * wlm_lightmap_four(at, wlm_lightmap_networks) + x.y * wlm_lightmap_four(at + apart, wlm_lightmap_networks);
        return sum + x.z * wlm_lightmap_four(at + 2 * apart, wlm_lightmap_networks) + x.w * wlm_lightmap_four(at + 3 * apart, wlm_lightmap_networks);
    }

    // Colour of a tile of maps: `record` is the position of its record, `inner` the texel in the tile. G of eq. 4 has two
    // hidden layers. Four units of the first at a time are added to the second, whose array has constant indices, so that
    // it is in registers.
    float3 wlm_lightmap_mapped(float4 tile, int record, int2 inner, float wlm_hour, Texture2D<float4> wlm_lightmap_hour, Texture2D<float4> wlm_lightmap_networks, Texture2D<float4> wlm_lightmap_uv, Texture2D<float4> wlm_lightmap_uvt, Texture2D<float4> wlm_lightmap_planes, SamplerState wlm_linear_clamp_sampler)
    {
        int row = int(tile.y);
        int start = int(tile.z);
        int second = start + 17 * WLM_LIGHTMAP_FOURS; // the encoded time is in the bias
        int2 at = int2(row % 1, row / 1) * 128 + inner;
        float4 uv = wlm_lightmap_uv.Load(int3(at, 0));
        float2 place = (((float2)(inner)) + float2(0.5, 0.5)) / 128.0;
        float4 uvt = wlm_lightmap_volume(row, place, wlm_hour, wlm_lightmap_hour, wlm_lightmap_uvt, wlm_linear_clamp_sampler);
        float4 planes = float4(wlm_lightmap_plane(2 * row, place.x, wlm_hour, wlm_lightmap_hour, wlm_lightmap_planes, wlm_linear_clamp_sampler), wlm_lightmap_plane(2 * row + 1, place.y, wlm_hour, wlm_lightmap_hour, wlm_lightmap_planes, wlm_linear_clamp_sampler));
        int third = second + (4 * WLM_LIGHTMAP_FOURS + 1) * WLM_LIGHTMAP_FOURS;
        float4 b[WLM_LIGHTMAP_FOURS];
        b[0] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 0, wlm_lightmap_networks);
        b[1] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 1, wlm_lightmap_networks);
        b[2] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 2, wlm_lightmap_networks);
        b[3] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 3, wlm_lightmap_networks);
        for (int i = 0; i < WLM_LIGHTMAP_FOURS; i++) {
            float4 a = wlm_lightmap_add(wlm_lightmap_entry(record + 3 + i, wlm_hour, wlm_lightmap_hour), uv, start + i, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            a = wlm_lightmap_add(a, uvt, start + 4 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            a = wlm_lightmap_add(a, planes, start + 8 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            a = wlm_gelu(a);
            int w = second + 4 * WLM_LIGHTMAP_FOURS * i;
            b[0] = wlm_lightmap_add(b[0], a, w + 0, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            b[1] = wlm_lightmap_add(b[1], a, w + 1, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            b[2] = wlm_lightmap_add(b[2], a, w + 2, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
            b[3] = wlm_lightmap_add(b[3], a, w + 3, WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
        }
        float4 y = wlm_lightmap_four(third + 4 * WLM_LIGHTMAP_FOURS, wlm_lightmap_networks);
        y = wlm_lightmap_add(y, wlm_gelu(b[0]), third + 0, 1, wlm_lightmap_networks);
        y = wlm_lightmap_add(y, wlm_gelu(b[1]), third + 4, 1, wlm_lightmap_networks);
        y = wlm_lightmap_add(y, wlm_gelu(b[2]), third + 8, 1, wlm_lightmap_networks);
        y = wlm_lightmap_add(y, wlm_gelu(b[3]), third + 12, 1, wlm_lightmap_networks);
        float3 gain = wlm_lightmap_entry(record + 1, wlm_hour, wlm_lightmap_hour).xyz;
        return max(gain + wlm_lightmap_entry(record + 2, wlm_hour, wlm_lightmap_hour).xyz * y.xyz, float3(0.0, 0.0, 0.0));
    }

    // Colour of a tile of frames, or of one colour.
    float3 wlm_lightmap_unmapped(float4 tile, int record, int2 inner, float wlm_hour, Texture2D<float4> wlm_lightmap_hour)
    {
        return wlm_lightmap_entry(record + 1, wlm_hour, wlm_lightmap_hour).xyz;
    }

    // Colour of a texel of the map in gamma space, at least 0; of an empty tile 0.
    float3 wlm_colour(int2 texel, float wlm_hour, Texture2D<float4> wlm_lightmap_hour, Texture2D<float4> wlm_lightmap_networks, Texture2D<float4> wlm_lightmap_uv, Texture2D<float4> wlm_lightmap_uvt, Texture2D<float4> wlm_lightmap_planes, SamplerState wlm_linear_clamp_sampler)
    {
        int2 place = texel / 128;
        int2 inner = texel - place * 128;
        int record = 2 + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD;
        float4 tile = wlm_lightmap_entry(record, wlm_hour, wlm_lightmap_hour);
        if (int(tile.x) == 3) {
            return wlm_lightmap_mapped(tile, record, inner, wlm_hour, wlm_lightmap_hour, wlm_lightmap_networks, wlm_lightmap_uv, wlm_lightmap_uvt, wlm_lightmap_planes, wlm_linear_clamp_sampler);
        }
        return wlm_lightmap_unmapped(tile, record, inner, wlm_hour, wlm_lightmap_hour);
    }

    // Linear radiance of a colour, at most 65504: a target of half floats would make more infinite.
    float3 wlm_lightmap_linear(float3 colour)
    {
        return min(pow(colour, float3(2.2, 2.2, 2.2)), float3(65504.0, 65504.0, 65504.0));
    }

    float3 wlm_radiance(int2 texel, float wlm_hour, Texture2D<float4> wlm_lightmap_hour, Texture2D<float4> wlm_lightmap_networks, Texture2D<float4> wlm_lightmap_uv, Texture2D<float4> wlm_lightmap_uvt, Texture2D<float4> wlm_lightmap_planes, SamplerState wlm_linear_clamp_sampler)
    {
        float3 colour = wlm_colour(texel, wlm_hour, wlm_lightmap_hour, wlm_lightmap_networks, wlm_lightmap_uv, wlm_lightmap_uvt, wlm_lightmap_planes, wlm_linear_clamp_sampler); // glslang's HLSL takes no call with textures as an argument here
        return wlm_lightmap_linear(colour);
    }
};
WlmNode wlm;
return wlm.wlm_radiance(min(int2(UV * float2(128, 128)), int2(128, 128) - 1), wlm_hour, wlm_lightmap_hour, wlm_lightmap_networks, wlm_lightmap_uv, wlm_lightmap_uvt, wlm_lightmap_planes, wlm_lightmap_uvtSampler);
#undef WLM_LIGHTMAP_COLUMNS
#undef WLM_LIGHTMAP_RECORD
#undef WLM_LIGHTMAP_SIDE
#undef WLM_LIGHTMAP_FOURS
"""
FILL = r"""
struct WlmNode
{
    // tiles in a row of the map
    #define WLM_LIGHTMAP_COLUMNS (1)
    // fours of a tile in the table, after 2 of all
    #define WLM_LIGHTMAP_RECORD (7)

    // texels of a slice of F_uvt along a side
    #define WLM_LIGHTMAP_SIDE (32)

    // of 16 units
    #define WLM_LIGHTMAP_FOURS (4)

    // The texel whose light a texel of the map shows: itself inside a chart; in a gap the nearest inside within 2
    // texels, in reading order of several as near; beyond that itself.
    int2 wlm_source(int2 texel, Texture2D<float4> wlm_lightmap_valid)
    {
        if (wlm_lightmap_valid.Load(int3(texel, 0)).x > 0.5) {
            return texel;
        }
        int2 found = texel;
        int least = 9;
        for (int y = -2; y <= 2; y++) {
            for (int x = -2; x <= 2; x++) {
                int2 at = texel + int2(x, y);
                if (x * x + y * y < least && at.x >= 0 && at.y >= 0 && at.x < 128 && at.y < 128) {
                    if (wlm_lightmap_valid.Load(int3(at, 0)).x > 0.5) {
                        least = x * x + y * y;
                        found = at;
                    }
                }
            }
        }
        return found;
    }
};
WlmNode wlm;
return Decoded.Load(int3(wlm.wlm_source(min(int2(UV * float2(128, 128)), int2(128, 128) - 1), wlm_lightmap_valid), 0)).rgb;
#undef WLM_LIGHTMAP_COLUMNS
#undef WLM_LIGHTMAP_RECORD
#undef WLM_LIGHTMAP_SIDE
#undef WLM_LIGHTMAP_FOURS
"""
UV_SET = 1  # UV channel of the lightmap in the meshes
INPUTS = {
    "uv": {"file": "uv.tga", "form": "bytes", "size": [128, 128]},
    "uvt": {"file": "uvt.tga", "form": "bytes", "size": [128, 96]},
    "planes": {"file": "planes.tga", "form": "bytes", "size": [64, 48]},
    "valid": {"file": "valid.tga", "form": "bytes", "size": [128, 128]},
    "hour": {"file": "hour.exr", "form": "floats", "size": [1024, 5]},
    "networks": {"file": "networks.exr", "form": "floats", "size": [1024, 1]},
}

FOLDER = Path(__file__).resolve().parent
LIBRARY = unreal.MaterialEditingLibrary
LINEAR = unreal.MaterialSamplerType.SAMPLERTYPE_LINEAR_COLOR
FORMATS = {
    "bytes": unreal.TextureCompressionSettings.TC_VECTOR_DISPLACEMENTMAP,
    "halves": unreal.TextureCompressionSettings.TC_HDR,
    "floats": unreal.TextureCompressionSettings.TC_HDR_F32,
}


def imported(file, kind):
    """Imports a file, and returns the imported assets of one kind."""
    task = unreal.AssetImportTask()
    given = {"filename": str(FOLDER / file), "destination_path": PLACE, "automated": True, "replace_existing": True}
    for name, value in given.items():
        task.set_editor_property(name, value)
    unreal.AssetToolsHelpers.get_asset_tools().import_asset_tasks([task])
    found = [each for each in task.get_objects() if isinstance(each, kind)]
    if not found:
        raise RuntimeError(f"{file}: not imported; the output log says why")
    return found


def imported_texture(file, form, size, mips=False):
    """Imports a texture without compression or scaling, and with mips only if asked for."""
    levels = unreal.TextureMipGenSettings
    texture = imported(file, unreal.Texture2D)[0]
    settings = {
        "compression_settings": FORMATS[form],
        "srgb": False,
        "mip_gen_settings": levels.TMGS_SIMPLE_AVERAGE if mips else levels.TMGS_NO_MIPMAPS,
        "lod_group": unreal.TextureGroup.TEXTUREGROUP_COLOR_LOOKUP_TABLE,
        "filter": unreal.TextureFilter.TF_TRILINEAR if mips else unreal.TextureFilter.TF_BILINEAR,
        "address_x": unreal.TextureAddress.TA_CLAMP,
        "address_y": unreal.TextureAddress.TA_CLAMP,
        "never_stream": True,
        "virtual_texture_streaming": False,
    }
    for name, value in settings.items():
        texture.set_editor_property(name, value)
    found = [texture.blueprint_get_size_x(), texture.blueprint_get_size_y()]
    if found != size:
        raise RuntimeError(f"{file}: expected {size} texels, found {found}: does the project limit imported textures?")
    unreal.EditorAssetLibrary.save_loaded_asset(texture)
    return texture


def asset(name, kind, factory):
    """An asset of the folder, made if it isn't there."""
    path = f"{PLACE}/{name}"
    if unreal.EditorAssetLibrary.does_asset_exist(path):
        return unreal.EditorAssetLibrary.load_asset(path)
    return unreal.AssetToolsHelpers.get_asset_tools().create_asset(name, PLACE, kind, factory)


def unlit_material(name):
    """A material without nodes, whose emission alone is seen."""
    material = asset(name, unreal.Material, unreal.MaterialFactoryNew())
    LIBRARY.delete_all_material_expressions(material)
    material.set_editor_property("shading_model", unreal.MaterialShadingModel.MSM_UNLIT)
    return material


def node(material, kind, **values):
    """Adds a node to a material."""
    made = LIBRARY.create_material_expression(material, kind)
    for name, value in values.items():
        made.set_editor_property(name, value)
    return made


def link(source, target, pin, output=""):
    """Connects two nodes."""
    if not LIBRARY.connect_material_expressions(source, output, target, pin):
        raise RuntimeError(f"{target.get_name()}: no input {pin!r} that {source.get_name()} fits")


def texture_node(material, texture):
    """Adds a texture that a Custom node reads."""
    return node(material, unreal.MaterialExpressionTextureObject, texture=texture, sampler_type=LINEAR)


def coordinates(material, number):
    """Adds the UVs of a channel."""
    return node(material, unreal.MaterialExpressionTextureCoordinate, coordinate_index=number)


def custom(material, code, inputs, output=unreal.CustomMaterialOutputType.CMOT_FLOAT3):
    """Adds a Custom node, of three floats by default, and connects its inputs."""
    pins = []
    for name in inputs:
        pins.append(unreal.CustomInput())
        pins[-1].set_editor_property("input_name", name)
    kind = unreal.MaterialExpressionCustom
    made = node(material, kind, code=code, output_type=output, inputs=pins, description="wlm")
    for name, source in inputs.items():
        link(source, made, name)
    return made


def times(material, first, second, output=""):
    """Adds the product of two nodes."""
    made = node(material, unreal.MaterialExpressionMultiply)
    link(first, made, "A")
    link(second, made, "B", output)
    return made


def surface(material, light):
    """Completes a material that emits albedo, a parameter of its instances, times light."""
    white = unreal.load_asset("/Engine/EngineResources/WhiteSquareTexture")
    albedo = unreal.MaterialExpressionTextureSampleParameter2D
    shown = node(material, albedo, parameter_name="Albedo", texture=white)
    colour = unreal.MaterialExpressionVectorParameter
    one = unreal.LinearColor(1.0, 1.0, 1.0, 1.0)
    tint = node(material, colour, parameter_name="Colour", default_value=one)
    finish(material, times(material, times(material, light, shown, "RGB"), tint))


def finish(material, emission, opacity=None):
    """Connects a material's emission and opacity, and compiles it."""
    joined = {unreal.MaterialProperty.MP_EMISSIVE_COLOR: emission}
    if opacity is not None:
        joined[unreal.MaterialProperty.MP_OPACITY] = opacity
    for place, source in joined.items():
        if not LIBRARY.connect_material_property(source, "", place):
            raise RuntimeError(f"{material.get_name()}: no {place}")
    LIBRARY.recompile_material(material)
    unreal.EditorAssetLibrary.save_loaded_asset(material)


def prepare(mesh, uv_set):
    """Keeps a mesh's UVs as floats: half floats have only 2,048 steps along a lightmap."""
    editor = unreal.get_editor_subsystem(unreal.StaticMeshEditorSubsystem)
    if editor.get_num_uv_channels(mesh, 0) <= uv_set:
        raise RuntimeError(f"{mesh.get_name()}: expected UV channel {uv_set}, the light's")
    settings = editor.get_lod_build_settings(mesh, 0)
    settings.set_editor_property("use_full_precision_u_vs", True)
    settings.set_editor_property("generate_lightmap_u_vs", False)
    editor.set_lod_build_settings(mesh, 0, settings)


def instance(name, parent, old):
    """Makes an instance of a material, with the base colour of the material that it replaces."""
    made = asset(name, unreal.MaterialInstanceConstant, unreal.MaterialInstanceConstantFactoryNew())
    LIBRARY.set_material_instance_parent(made, parent)
    if isinstance(old, unreal.MaterialInstanceConstant):
        # As the editor's importer of glTF names them.
        albedo = LIBRARY.get_material_instance_texture_parameter_value(old, "BaseColorTexture")
        if albedo is not None:
            LIBRARY.set_material_instance_texture_parameter_value(made, "Albedo", albedo)
            colour = LIBRARY.get_material_instance_vector_parameter_value(old, "BaseColorFactor")
            LIBRARY.set_material_instance_vector_parameter_value(made, "Colour", colour)
    return made


def target(name):
    """Makes a render target for light, in half floats."""
    made = asset(name, unreal.TextureRenderTarget2D, unreal.TextureRenderTargetFactoryNew())
    settings = {
        "render_target_format": unreal.TextureRenderTargetFormat.RTF_RGBA16F,
        "size_x": INFO["width"],
        "size_y": INFO["height"],
        "address_x": unreal.TextureAddress.TA_CLAMP,
        "address_y": unreal.TextureAddress.TA_CLAMP,
    }
    for key, value in settings.items():
        made.set_editor_property(key, value)
    unreal.EditorAssetLibrary.save_loaded_asset(made)
    return made


def main():
    """Imports the textures, and makes the materials that decode the light, fill its gaps and show it."""
    textures = {name: imported_texture(each["file"], each["form"], each["size"]) for name, each in INPUTS.items()}
    decode = unlit_material("M_Decode")
    hour = node(decode, unreal.MaterialExpressionScalarParameter, parameter_name="Hour")
    inputs = {"UV": coordinates(decode, 0), "wlm_hour": hour}
    decoding = [name for name in textures if name != "valid"]
    inputs |= {"wlm_lightmap_" + name: texture_node(decode, textures[name]) for name in decoding}
    finish(decode, custom(decode, DECODE, inputs))
    made = asset("MI_Decode", unreal.MaterialInstanceConstant, unreal.MaterialInstanceConstantFactoryNew())
    LIBRARY.set_material_instance_parent(made, decode)

    fill = unlit_material("M_Fill")
    inputs = {"UV": coordinates(fill, 0), "Decoded": texture_node(fill, target("RT_Decoded"))}
    inputs["wlm_lightmap_valid"] = texture_node(fill, textures["valid"])
    finish(fill, custom(fill, FILL, inputs))

    share = unreal.CollectionScalarParameter()
    share.set_editor_property("parameter_name", "Share")
    collection = asset("MPC_Time", unreal.MaterialParameterCollection, unreal.MaterialParameterCollectionFactoryNew())
    if not collection.get_editor_property("scalar_parameters"):
        collection.set_editor_property("scalar_parameters", [share])
    unreal.EditorAssetLibrary.save_loaded_asset(collection)

    lit = unlit_material("M_Lit")
    light = node(lit, unreal.MaterialExpressionLinearInterpolate)
    place = coordinates(lit, UV_SET)
    for name, pin in (("RT_Early", "A"), ("RT_Late", "B")):
        sample = node(lit, unreal.MaterialExpressionTextureSample, texture=target(name), sampler_type=LINEAR)
        link(place, sample, "")
        link(sample, light, pin, "RGB")
    mixed = node(lit, unreal.MaterialExpressionCollectionParameter, collection=collection, parameter_name="Share")
    link(mixed, light, "Alpha")
    surface(lit, light)
    unreal.EditorAssetLibrary.save_directory(PLACE)


def neighbours(hour):
    """Indices of the stored hours before and after an hour, and the weight of the second."""
    times, period = INFO["times"], INFO["period"]
    if period is None:
        hour = min(max(hour, times[0]), times[-1])
        late = min(bisect.bisect_right(times, hour), len(times) - 1)
        early = max(late - 1, 0)
        gap = times[late] - times[early]
        return early, late, (hour - times[early]) / gap if gap else 0.0
    late = bisect.bisect_right(times, hour % period)
    early, late = (late - 1) % len(times), late % len(times)
    gap = (times[late] - times[early]) % period or period
    return early, late, (hour - times[early]) % period / gap


def set_hour(hour):
    """Shows an hour in the editor. A game does the same with its own nodes; see README.md."""
    world = unreal.get_editor_subsystem(unreal.UnrealEditorSubsystem).get_editor_world()
    names = "MI_Decode", "M_Fill", "RT_Decoded", "RT_Early", "RT_Late", "MPC_Time"
    decode, fill, decoded, first, second, collection = (unreal.load_asset(f"{PLACE}/{name}") for name in names)
    draw = unreal.RenderingLibrary.draw_material_to_render_target
    early, late, share = neighbours(hour)
    for number, shown in ((early, first), (late, second)):
        LIBRARY.set_material_instance_scalar_parameter_value(decode, "Hour", number)
        LIBRARY.update_material_instance(decode)
        draw(world, decoded, decode)
        draw(world, shown, fill)
    unreal.MaterialLibrary.set_scalar_parameter_value(world, collection, "Share", share)


main()
set_hour(INFO["times"][0])
