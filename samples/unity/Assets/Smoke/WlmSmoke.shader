// Six-way smoke on a billboard that faces the viewer, for the built-in pipeline and URP. See README.md.
Shader "Wlm/Smoke/smoke"
{
    Properties
    {
        wlm_smoke_first_map ("First", 2D) = "black" {}
        wlm_smoke_second_map ("Second", 2D) = "black" {}
        _WlmFrame ("Frame", Float) = 0
        _WlmSky ("Sky", Color) = (0, 0, 0, 1)
    }
    SubShader
    {
        Tags { "Queue" = "Transparent" "RenderType" = "Transparent" "IgnoreProjector" = "True" "DisableBatching" = "True" }
        Pass
        {
            Blend One OneMinusSrcAlpha
            Cull Off
            ZWrite Off
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex vert
            #pragma fragment frag
            #include "UnityCG.cginc"
            #include "WlmSmoke.hlsl"

            float _WlmFrame;
            float4 _WlmSky;
            // Of the component WlmSmoke: directions to lights in the world, and their irradiance; black where there are fewer.
            float4 _WlmToward[4], _WlmIrradiance[4];

            struct Varying
            {
                float4 position : SV_Position;
                float2 place : TEXCOORD0;
            };

            Varying vert(float4 position : POSITION, float2 uv : TEXCOORD0)
            {
                float3x3 turned = (float3x3)unity_ObjectToWorld;
                float2 scale = float2(length(mul(turned, float3(1.0, 0.0, 0.0))), length(mul(turned, float3(0.0, 1.0, 0.0))));
                float4 centre = mul(UNITY_MATRIX_V, mul(unity_ObjectToWorld, float4(0.0, 0.0, 0.0, 1.0)));
                Varying made;
                made.position = mul(UNITY_MATRIX_P, centre + float4(position.xy * scale, 0.0, 0.0));
                made.place = float2(uv.x, 1.0 - uv.y);
                return made;
            }

            float4 frag(Varying at) : SV_Target
            {
                float2 size = float2(64.0, 64.0);
                float texels = max(length(ddx(at.place) * size), length(ddy(at.place) * size));
                float4 first, second;
                wlm_smoke_texels(at.place, _WlmFrame, texels, first, second);
                float3 light = wlm_smoke_glow(first, second) + wlm_smoke_sky(first, second, _WlmSky.rgb);
                // The view's axes are the billboard's: x to the right, y up, z to the viewer.
                for (int i = 0; i < 4; ++i)
                {
                    float3 toward = mul((float3x3)UNITY_MATRIX_V, _WlmToward[i].xyz);
                    light += wlm_smoke_lit(first, second, toward, _WlmIrradiance[i].rgb);
                }
                return float4(light, wlm_smoke_alpha(first, second));
            }
            ENDHLSL
        }
    }
}
