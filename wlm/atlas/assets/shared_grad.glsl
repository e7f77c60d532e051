
// Light where a pixel is large: dx and dy are dFdx(uv) and dFdy(uv). Up close it is wlm_scene(uv, sheet, state).
vec3 @name@(vec2 uv, vec2 dx, vec2 dy, int sheet, float state)
{
    vec2 size = vec2(texelFetch(WLM_SCENE_SHEETS, ivec2(0, sheet), 0).xy); // of the lightmap, in texels
    float texels = max(length(dx * size), length(dy * size)); // along the pixel
    // A bilinear read still meets all texels where a pixel is two of them. The first smaller level is a quarter.
    float level = clamp(log2(max(texels, 1.0)) - @octaves@.0, 0.0, 32.0);
    int near = sheet;
    int far = int(texelFetch(WLM_SCENE_SHEETS, ivec2(1, sheet), 0).z); // 0: there is none
    int steps = int(level);
    for (int i = 0; i < steps; i++) {
        if (far > 0) {
            near = far;
            far = int(texelFetch(WLM_SCENE_SHEETS, ivec2(1, near), 0).z);
        }
    }
    float share = level - float(steps);
    vec3 light = @read@(uv, near, state);
    if (share <= 0.0 || far == 0)
        return light;
    return mix(light, @read@(uv, far, state), share);
}
