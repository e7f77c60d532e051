// Light from a virtual texture of lightmaps (NDGI, sections 3.5 and 9): a page table, and a physical texture that holds
// the pages that are in view. For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version,
// in ES below the precision statements of the types that it declares.
//
// wlm_virtual_pages: the physical texture, sampler2DArray of RGB9E5, filter linear, a page in each layer.
// wlm_virtual_table: the page table, usampler2D of R32UI, filter nearest, 1,024 pages in a row.
// wlm_virtual_sheets: sizes and page numbers, usampler2D of R32UI, filter nearest; they never change. The first words
//   are the texels along a side of a page without its border, and of its border. From word @head@ on, a sheet has
//   @sheet@ words: height, width, levels, 0, and for @levels@ levels the first page and the pages in a row.

@pages@@table@@sheets@
int wlm_virtual_word(int i)
{
    return int(texelFetch(WLM_VIRTUAL_SHEETS, ivec2(i & @row_mask@, i >> @row_bits@), 0).r);
}

// The page of a level at a point, and the point in texels from the page's corner.
int wlm_virtual_page(int sheet, int level, vec2 uv, out vec2 at)
{
    int head = @head@ + @sheet@ * sheet;
    float side = float(wlm_virtual_word(0));
    vec2 size = vec2(float(wlm_virtual_word(head + 1)), float(wlm_virtual_word(head))) / exp2(float(level));
    vec2 place = clamp(uv, vec2(0.0, 0.0), vec2(1.0, 1.0)) * size;
    vec2 cell = min(floor(place / side), ceil(size / side) - vec2(1.0, 1.0));
    at = place - cell * side;
    int first = wlm_virtual_word(head + 4 + level);
    return first + int(cell.y) * wlm_virtual_word(head + @columns@ + level) + int(cell.x);
}

// Light of one level, from the page that the table refers to, which may be of a coarser level.
vec3 wlm_virtual_level(int sheet, int level, vec2 uv)
{
    vec2 at;
    int page = wlm_virtual_page(sheet, level, uv, at);
    int entry = int(texelFetch(WLM_VIRTUAL_TABLE, ivec2(page & 1023, page >> 10), 0).r);
    page = wlm_virtual_page(sheet, entry & 15, uv, at);
    float border = float(wlm_virtual_word(1));
    float edge = float(wlm_virtual_word(0)) + 2.0 * border;
    at = (at + vec2(border, border)) / edge;
    return textureLod(WLM_VIRTUAL_PAGES, vec3(at, float(entry >> 4)), 0.0).rgb;
}

// Light of a sheet; u to the right, v down; dx and dy are dFdx(uv) and dFdy(uv). Of a lightmap with light groups, add
// the light of the sheet of each group, times the group's weight.
vec3 wlm_virtual_light(int sheet, vec2 uv, vec2 dx, vec2 dy)
{
    int head = @head@ + @sheet@ * sheet;
    vec2 size = vec2(float(wlm_virtual_word(head + 1)), float(wlm_virtual_word(head)));
    float texels = max(length(dx * size), length(dy * size)); // along the pixel
    float level = min(log2(max(texels, 1.0)), float(wlm_virtual_word(head + 2) - 1));
    int fine = int(level);
    vec3 light = wlm_virtual_level(sheet, fine, uv);
    float share = level - float(fine);
    if (share <= 0.0)
        return light;
    return mix(light, wlm_virtual_level(sheet, fine + 1, uv), share);
}
