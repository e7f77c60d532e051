// Passes of WlmLightmap.cs: decode, fill the gaps, mix two hours.
Shader "Hidden/Wlm/Lightmap/cornell"
{
    SubShader
    {
        Cull Off ZWrite Off ZTest Always
        HLSLINCLUDE
        #pragma target 4.5
        #pragma vertex vert
        #pragma fragment frag
        #include "WlmLightmap.hlsl"

        Texture2D<float4> _WlmMap, _WlmEarly, _WlmLate;
        float _WlmShare, _WlmDown;

        float4 vert(uint id : SV_VertexID) : SV_Position
        {
            return float4(float2(id & 1, id >> 1) * 4.0 - 1.0, 0.0, 1.0);
        }
        ENDHLSL
        Pass
        {
            HLSLPROGRAM
            float4 frag(float4 at : SV_Position) : SV_Target { return float4(wlm_radiance(int2(at.xy)), 1.0); }
            ENDHLSL
        }
        Pass
        {
            HLSLPROGRAM
            float4 frag(float4 at : SV_Position) : SV_Target { return _WlmMap.Load(int3(wlm_source(int2(at.xy)), 0)); }
            ENDHLSL
        }
        Pass
        {
            HLSLPROGRAM
            float4 frag(float4 at : SV_Position) : SV_Target
            {
                uint width, height;
                _WlmEarly.GetDimensions(width, height);
                int3 texel = int3(at.xy, 0);
                // The light's first row is its picture's top, which is v = 1 in Unity; a texture's first row is v = 0.
                if (_WlmDown < 0.5)
                    texel.y = int(height) - 1 - texel.y;
                return lerp(_WlmEarly.Load(texel), _WlmLate.Load(texel), _WlmShare);
            }
            ENDHLSL
        }
    }
}
