
@group(1) @binding(0) var wlm_target: texture_storage_2d<rgba16float, write>;

@compute @workgroup_size(@columns@, @rows@)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_id) place: vec3u,
    @builtin(local_invocation_index) index: u32,
)
{
    let first = vec2i(group.xy) * vec2i(@columns@, 2 * @rows@);
    wlm_lightmap_begin(first, i32(index));
    var texel = first + vec2i(place.xy);
    var light: array<vec3f, 2>;
    wlm_lightmap_pair(texel, &light);
    for (var i = 0; i < 2; i++) {
        if (texel.x < @width@ && texel.y < @height@) {
            textureStore(wlm_target, texel, vec4f(light[i], 1.0));
        }
        texel.y += @rows@;
    }
}
