// Sets the hour of a slider for the room's light, and a sun of the same hour for the smoke. See README.md.
using UnityEngine;

[ExecuteAlways]
public class Sample : MonoBehaviour
{
    public WlmLightmap lightmap;
    public WlmSmoke smoke;
    public Light sun;
    [Range(6f, 20f)]
    public float hour = 8f;

    void Update()
    {
        if (lightmap == null || smoke == null || sun == null)
            return;
        lightmap.time = hour;
        if (lightmap.Light != null)
            Shader.SetGlobalTexture("_SampleLight", lightmap.Light);
        // The sun goes from the east over the room to the west; after 18 h the lamp lights the smoke from above. East is
        // -x, since Unity's importer turns x round.
        float turn = Mathf.PI * (hour - 6f) / 12f;
        bool day = hour < 18f;
        sun.transform.forward = -(day ? new Vector3(-Mathf.Cos(turn), Mathf.Sin(turn), 0.6f) : new Vector3(0f, 1f, 0.1f));
        sun.intensity = day ? 1.5f * Mathf.Sin(turn) : 0.4f;
        smoke.sky = day ? new Color(0.3f, 0.35f, 0.45f) : new Color(0.1f, 0.08f, 0.06f);
    }

    void OnGUI()
    {
        GUI.Label(new Rect(20f, 16f, 80f, 24f), hour.ToString("0.0") + " h");
        hour = GUI.HorizontalSlider(new Rect(90f, 20f, Screen.width - 110f, 24f), hour, 6f, 20f);
    }
}
