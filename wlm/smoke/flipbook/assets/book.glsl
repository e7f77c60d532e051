// Six-way smoke of @count@ frames, in @rows@ x @columns@ cells, in the channels of "@layout@".
// (Neural Six-way Lightmaps for Real-time Smoke Rendering, eq. 4; weights are squares, as in engines.)
// For GLSL 3.30, GLSL ES 3.00 and later; include it below #version.
// Both textures are linear, not sRGB; sample both at wlm_smoke_uv, clamped to their edge.
//
//     light = sum over lights of irradiance / (4 pi) * wlm_smoke_light(first, second, toward)
//     pixel = light + colour * wlm_smoke_emission(first, second) + behind * (1 - wlm_smoke_alpha(first, second))

// Returns the texture coordinates of a frame, counted from 0, at a place on the billboard: (0, 0) is the top left,
// (1, 1) the bottom right.
vec2 wlm_smoke_uv(vec2 place, float frame)
{
    float cell = clamp(floor(frame), 0.0, @last@.0);
    float row = floor((cell + 0.5) / @columns@.0);
    float column = cell - @columns@.0 * row;
    float x = column + @inset_x@ + place.x * @share_x@;
    float y = row + @inset_y@ + place.y * @share_y@;
    return vec2(x / @columns@.0, y / @rows@.0);
}

// Returns the scattered light of a light of irradiance 4 pi. The direction to it has length 1: x to the billboard's
// right, y up, z to the viewer.
float wlm_smoke_light(vec4 first, vec4 second, vec3 toward)
{
    float x = toward.x > 0.0 ? @right@ : @left@;
    float y = toward.y > 0.0 ? @top@ : @bottom@;
    float z = toward.z > 0.0 ? @front@ : @back@;
    return (toward.x * toward.x * x + toward.y * toward.y * y + toward.z * toward.z * z) * @factor@;
}

float wlm_smoke_alpha(vec4 first, vec4 second)
{
    return @alpha@;
}

float wlm_smoke_emission(vec4 first, vec4 second)
{
    return @emission@;
}

// Returns the level for textureLod from the width of a screen pixel in texels. The largest is @levels@: beyond it
// frames show their neighbours.
float wlm_smoke_level(float texels)
{
    return clamp(log2(max(texels, 1.0)), 0.0, @levels@.0);
}
