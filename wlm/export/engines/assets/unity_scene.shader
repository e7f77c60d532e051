// A surface under the compressed lightmaps of a scene, for the built-in pipeline and URP: albedo times the light.
Shader "Wlm/Scene"
{
    Properties
    {
        _MainTex ("Albedo", 2D) = "white" {}
        _Color ("Colour", Color) = (1, 1, 1, 1)
        [Toggle(WLM_V_DOWN)] _Down ("UVs are v down, as glTF's", Float) = 0
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" }
        Pass
        {
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex vert
            #pragma fragment frag
            #pragma shader_feature WLM_V_DOWN
            #include "UnityCG.cginc"
            #include "WlmScene.hlsl"

            sampler2D _MainTex;
            float4 _MainTex_ST, _Color;
            float4 wlm_place;
            float wlm_sheet, wlm_state;

            struct Varying
            {
                float4 position : SV_Position;
                float2 uv : TEXCOORD0;
                float2 place : TEXCOORD1;
            };

            Varying vert(float4 position : POSITION, float2 first : TEXCOORD0, float2 second : TEXCOORD@SET@)
            {
                Varying made;
                made.position = UnityObjectToClipPos(position);
                made.uv = TRANSFORM_TEX(first, _MainTex);
                made.place = second;
            #ifndef WLM_V_DOWN
                // Importers flip v of glTF.
                made.place.y = 1.0 - made.place.y;
            #endif
                return made;
            }

            float4 frag(Varying at) : SV_Target
            {
                float4 albedo = tex2D(_MainTex, at.uv) * _Color;
                float3 light = wlm_object(at.place, wlm_place, int(wlm_sheet + 0.5), wlm_state);
                return float4(albedo.rgb * light, albedo.a);
            }
            ENDHLSL
        }
    }
}
