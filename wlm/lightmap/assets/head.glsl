// Decodes a temporal lightmap: feature maps and a small network for each tile of 128 x 128 texels (Neural Dynamic GI,
// sections 3.2 to 3.4). For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES
// below `precision highp` of float, int, sampler2D and sampler2DArray.
//
@use@//
// Textures; row 0 is v = 0. Filters are linear, without mip levels.
@textures@//
// If WLM_LIGHTMAP_EXACT is defined, four texels are fetched and mixed in floats; otherwise the filter unit mixes four
// texels, with about 8 bits for a position between two of them.
//
// wlm_lightmap_four(i) and wlm_lightmap_entry(i) read four floats of networks and of the table: if these are in
// buffers change them, or define WLM_LIGHTMAP_NET(i) and WLM_LIGHTMAP_HOUR_AT(i) before this file.

@samplers@@reads@
const int WLM_LIGHTMAP_COLUMNS = @columns@; // tiles in a row of the map
const int WLM_LIGHTMAP_RECORD = @record@; // fours of a tile in the table, after @head@ of all
