"""Imports six-way smoke into Unreal 5.1 or later. Run it in the editor; see README.md."""

import json
from pathlib import Path

import unreal

PLACE = "/Game/Wlm/smoke"
INFO = json.loads((Path(__file__).resolve().parent / "bundle.json").read_text(encoding="utf-8"))
CODE = r"""
struct WlmNode
{
    float2 wlm_smoke_uv(float2 place, float frame)
    {
        float cell = clamp(floor(frame), 0.0, 11.0);
        float row = floor((cell + 0.5) / 4.0);
        float column = cell - 4.0 * row;
        float x = column + 0.0151515152 + place.x * 0.96969697;
        float y = row + 0.0151515152 + place.y * 0.96969697;
        return float2(x / 4.0, y / 3.0);
    }

    // Returns the scattered light of a light of irradiance 4 pi. The direction to it has length 1: x to the billboard's
    // right, y up, z to the viewer.
    float wlm_smoke_light(float4 first, float4 second, float3 toward)
    {
        float x = (toward.x > 0.0) ? first.r : second.r;
        float y = (toward.y > 0.0) ? first.g : second.g;
        float z = (toward.z > 0.0) ? second.b : first.b;
        return (toward.x * toward.x * x + toward.y * toward.y * y + toward.z * toward.z * z) * 0.817871094;
    }

    float wlm_smoke_alpha(float4 first, float4 second)
    {
        return first.a;
    }

    // Returns the level for textureLod from the width of a screen pixel in texels. The largest is 1: beyond it
    // frames show their neighbours.
    float wlm_smoke_level(float texels)
    {
        return clamp(log2(max(texels, 1.0)), 0.0, 1.0);
    }



    // Reads both textures at a place of the billboard: (0, 0) is the top left, (1, 1) the bottom right. The time is in
    // frames, counted from 0; between two frames both are mixed. The width of a screen pixel is given in texels.
    void wlm_smoke_texels(float2 place, float time, float texels, out float4 first, out float4 second, Texture2D<float4> wlm_smoke_first_map, Texture2D<float4> wlm_smoke_second_map, SamplerState wlm_linear_clamp_sampler)
    {
        float frame = clamp(floor(time), 0.0, 11.0);
        float share = clamp(time - frame, 0.0, 1.0);
        float mip = wlm_smoke_level(texels);
        float2 early = wlm_smoke_uv(place, frame);
        float2 late = wlm_smoke_uv(place, frame + 1.0);
        first = lerp(wlm_smoke_first_map.SampleLevel(wlm_linear_clamp_sampler, early, mip), wlm_smoke_first_map.SampleLevel(wlm_linear_clamp_sampler, late, mip), share);
        second = lerp(wlm_smoke_second_map.SampleLevel(wlm_linear_clamp_sampler, early, mip), wlm_smoke_second_map.SampleLevel(wlm_linear_clamp_sampler, late, mip), share);
    }

    // Returns the light that the smoke scatters to the viewer under a light of an irradiance; see wlm_smoke_light.
    float3 wlm_smoke_lit(float4 first, float4 second, float3 toward, float3 irradiance)
    {
        return irradiance * (wlm_smoke_light(first, second, toward) * 0.0795774715);
    }

    // Returns the scattered light under a sky of constant radiance: the mean of the six lightmaps.
    float3 wlm_smoke_sky(float4 first, float4 second, float3 radiance)
    {
        float3 x = float3(1.0, 0.0, 0.0);
        float3 y = float3(0.0, 1.0, 0.0);
        float3 z = float3(0.0, 0.0, 1.0);
        float sum = wlm_smoke_light(first, second, x) + wlm_smoke_light(first, second, -x);
        sum += wlm_smoke_light(first, second, y) + wlm_smoke_light(first, second, -y);
        sum += wlm_smoke_light(first, second, z) + wlm_smoke_light(first, second, -z);
        return radiance * (sum / 6.0);
    }

    // Returns the light that the smoke emits.
    float3 wlm_smoke_glow(float4 first, float4 second)
    {
        return float3(0.0, 0.0, 0.0);
    }

    // Returns all light under one light and the sky, and the opacity: pixel = rgb + behind * (1 - opacity).
    float4 wlm_smoke_pixel(float2 place, float time, float texels, float3 toward, float3 irradiance, float3 sky, Texture2D<float4> wlm_smoke_first_map, Texture2D<float4> wlm_smoke_second_map, SamplerState wlm_linear_clamp_sampler)
    {
        float4 first;
        float4 second;
        wlm_smoke_texels(place, time, texels, first, second, wlm_smoke_first_map, wlm_smoke_second_map, wlm_linear_clamp_sampler);
        float3 light = wlm_smoke_lit(first, second, toward, irradiance) + wlm_smoke_sky(first, second, sky);
        return float4(light + wlm_smoke_glow(first, second), wlm_smoke_alpha(first, second));
    }
};
WlmNode wlm;
return wlm.wlm_smoke_pixel(UV, fmod(max(Frame, 0.0), 12.0), max(length(ddx(UV) * float2(64.0, 64.0)), length(ddy(UV) * float2(64.0, 64.0))), float3(Toward.xy, -Toward.z), Irradiance, Sky, wlm_smoke_first_map, wlm_smoke_second_map, wlm_smoke_first_mapSampler);
"""

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


def colour(material, name, *values):
    """Adds a colour parameter: its red, green and blue."""
    kind = unreal.MaterialExpressionVectorParameter
    return node(material, kind, parameter_name=name, default_value=unreal.LinearColor(*values, 0.0))


def masked(material, source, channels):
    """Adds a selection of a node's four channels."""
    values = {name: name in channels for name in "rgba"}
    made = node(material, unreal.MaterialExpressionComponentMask, **values)
    link(source, made, "")
    return made


def main():
    """Imports the textures, and makes the billboard material."""
    width, height = INFO["frame_size"]
    size = [INFO["columns"] * (width + 2 * INFO["padding"]), INFO["rows"] * (height + 2 * INFO["padding"])]
    material = unlit_material("M_Smoke")
    material.set_editor_property("blend_mode", unreal.BlendMode.BLEND_ALPHA_COMPOSITE)
    material.set_editor_property("two_sided", True)
    clock = node(material, unreal.MaterialExpressionTime)
    rate = node(material, unreal.MaterialExpressionScalarParameter, parameter_name="Rate", default_value=6)
    start = node(material, unreal.MaterialExpressionScalarParameter, parameter_name="Start", default_value=0.0)
    frame = node(material, unreal.MaterialExpressionAdd)
    link(times(material, clock, rate), frame, "A")
    link(start, frame, "B")
    toward = node(
        material,
        unreal.MaterialExpressionTransform,
        transform_source_type=unreal.MaterialVectorCoordTransformSource.TRANSFORMSOURCE_WORLD,
        transform_type=unreal.MaterialVectorCoordTransform.TRANSFORM_VIEW,
    )
    link(colour(material, "Toward", 0.0, 0.0, 1.0), toward, "")
    inputs = {
        "UV": coordinates(material, 0),
        "Frame": frame,
        "Toward": toward,
        "Irradiance": colour(material, "Irradiance", 10.0, 10.0, 10.0),
        "Sky": colour(material, "Sky", 0.0, 0.0, 0.0),
    }
    for name, entry in INFO["textures"].items():
        texture = imported_texture(entry["file"], "bytes", size, mips=True)
        inputs[f"wlm_smoke_{name}_map"] = texture_node(material, texture)
    shown = custom(material, CODE, inputs, unreal.CustomMaterialOutputType.CMOT_FLOAT4)
    finish(material, masked(material, shown, "rgb"), masked(material, shown, "a"))
    unreal.EditorAssetLibrary.save_directory(PLACE)


main()
