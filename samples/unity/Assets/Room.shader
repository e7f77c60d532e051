// Albedo times the light that WlmLightmap decodes, at the mesh's first UVs, brought into the range of the screen.
Shader "Sample/Room"
{
    Properties
    {
        _Color ("Albedo", Color) = (1, 1, 1, 1)
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
            #include "UnityCG.cginc"

            sampler2D _SampleLight;
            float4 _Color;

            struct Varying
            {
                float4 position : SV_Position;
                float2 uv : TEXCOORD0;
            };

            Varying vert(float4 position : POSITION, float2 uv : TEXCOORD0)
            {
                Varying made;
                made.position = UnityObjectToClipPos(position);
                made.uv = uv;
                return made;
            }

            float4 frag(Varying at) : SV_Target
            {
                float3 light = 4.0 * _Color.rgb * tex2D(_SampleLight, at.uv).rgb;
                return float4(light / (1.0 + light), 1.0);
            }
            ENDHLSL
        }
    }
}
