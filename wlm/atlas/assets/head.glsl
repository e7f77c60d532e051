// Light from a compressed lightmap: @what@
// (Lightmap Compression with Color-Coherent UV Clustering and Cascade Texture Optimization, eq. 7).
// For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES below the
// precision statements of the types that it declares. Call wlm_atlas with @coordinate@: u to the right, v down, (0, 0)
// at the first texel of the first row.
//
@textures@
// They have one mip level. Where WLM_ATLAS_EXACT is defined four texels are fetched and mixed in floats; else the
// sampler mixes four texels, in one fetch, with the 8 or so bits that a GPU gives to a place between two of them.

