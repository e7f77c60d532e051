
// Reads both textures at a place of the billboard: (0, 0) is the top left, (1, 1) the bottom right. The time is in
// frames, counted from 0; between two frames both are mixed. The width of a screen pixel is given in texels.
void wlm_smoke_texels(vec2 place, float time, float texels, out vec4 first, out vec4 second)
{
    float frame = clamp(floor(time), 0.0, @last@.0);
    float share = clamp(time - frame, 0.0, 1.0);
    float mip = wlm_smoke_level(texels);
    vec2 early = wlm_smoke_uv(place, frame);
    vec2 late = wlm_smoke_uv(place, frame + 1.0);
    first = mix(textureLod(WLM_SMOKE_FIRST_MAP, early, mip), textureLod(WLM_SMOKE_FIRST_MAP, late, mip), share);
    second = mix(textureLod(WLM_SMOKE_SECOND_MAP, early, mip), textureLod(WLM_SMOKE_SECOND_MAP, late, mip), share);
}

// Returns the light that the smoke scatters to the viewer under a light of an irradiance; see wlm_smoke_light.
vec3 wlm_smoke_lit(vec4 first, vec4 second, vec3 toward, vec3 irradiance)
{
    return irradiance * (wlm_smoke_light(first, second, toward) * @share@);
}

// Returns the scattered light under a sky of constant radiance: the mean of the six lightmaps.
vec3 wlm_smoke_sky(vec4 first, vec4 second, vec3 radiance)
{
    vec3 x = vec3(1.0, 0.0, 0.0);
    vec3 y = vec3(0.0, 1.0, 0.0);
    vec3 z = vec3(0.0, 0.0, 1.0);
    float sum = wlm_smoke_light(first, second, x) + wlm_smoke_light(first, second, -x);
    sum += wlm_smoke_light(first, second, y) + wlm_smoke_light(first, second, -y);
    sum += wlm_smoke_light(first, second, z) + wlm_smoke_light(first, second, -z);
    return radiance * (sum / 6.0);
}

// Returns the light that the smoke emits.
vec3 wlm_smoke_glow(vec4 first, vec4 second)
{
@glow@
}

// Returns all light under one light and the sky, and the opacity: pixel = rgb + behind * (1 - opacity).
vec4 wlm_smoke_pixel(vec2 place, float time, float texels, vec3 toward, vec3 irradiance, vec3 sky)
{
    vec4 first;
    vec4 second;
    wlm_smoke_texels(place, time, texels, first, second);
    vec3 light = wlm_smoke_lit(first, second, toward, irradiance) + wlm_smoke_sky(first, second, sky);
    return vec4(light + wlm_smoke_glow(first, second), wlm_smoke_alpha(first, second));
}
