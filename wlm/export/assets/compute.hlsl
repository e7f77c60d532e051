
RWTexture2D<float4> wlm_target;

[numthreads(@columns@, @rows@, 1)]
void main(uint3 group : SV_GroupID, uint3 place : SV_GroupThreadID, uint index : SV_GroupIndex)
{
    int2 first = int2(group.xy) * int2(@columns@, 2 * @rows@);
    wlm_lightmap_begin(first, int(index));
    int2 texel = first + int2(place.xy);
    float3 light[2];
    wlm_lightmap_pair(texel, light);
    for (int i = 0; i < 2; i++) {
        if (texel.x < @width@ && texel.y < @height@)
            wlm_target[texel] = float4(light[i], 1.0);
        texel.y += @rows@;
    }
}
