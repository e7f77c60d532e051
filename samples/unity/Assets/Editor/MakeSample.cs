// Makes Assets/Sample.unity when the project is first opened, and opens it. See README.md.
using System.IO;
using UnityEditor;
using UnityEditor.SceneManagement;
using UnityEngine;

[InitializeOnLoad]
public static class MakeSample
{
    const string Place = "Assets/Sample.unity";

    static MakeSample()
    {
        // Nothing can be loaded before the editor has started.
        EditorApplication.delayCall += () =>
        {
            if (!File.Exists(Place))
                Make();
        };
    }

    [MenuItem("Wlm/Make the sample again")]
    static void Make()
    {
        PlayerSettings.colorSpace = ColorSpace.Linear;
        EditorSceneManager.NewScene(NewSceneSetup.EmptyScene, NewSceneMode.Single);
        var camera = new GameObject("Camera").AddComponent<Camera>();
        camera.transform.SetPositionAndRotation(new Vector3(0f, 1.5f, 5.6f), Quaternion.Euler(0f, 180f, 0f));
        camera.fieldOfView = 50f;
        camera.clearFlags = CameraClearFlags.SolidColor;
        camera.backgroundColor = Color.black;
        Room();

        var sample = new GameObject("Sample").AddComponent<Sample>();
        sample.lightmap = Lightmap();
        sample.sun = new GameObject("Sun").AddComponent<Light>();
        sample.sun.type = LightType.Directional;
        sample.smoke = Smoke(sample.sun);
        EditorSceneManager.SaveScene(EditorSceneManager.GetActiveScene(), Place);
    }

    static void Room()
    {
        var room = (GameObject)PrefabUtility.InstantiatePrefab(Load<GameObject>("room.obj"));
        foreach (MeshRenderer each in room.GetComponentsInChildren<MeshRenderer>())
        {
            Material[] materials = each.sharedMaterials;
            for (int i = 0; i < materials.Length; ++i)
            {
                var made = new Material(Load<Shader>("Room.shader")) { color = materials[i].color };
                AssetDatabase.CreateAsset(made, "Assets/Room_" + materials[i].name + ".mat");
                materials[i] = made;
            }
            each.sharedMaterials = materials;
        }
    }

    static WlmLightmap Lightmap()
    {
        var made = new GameObject("Lightmap").AddComponent<WlmLightmap>();
        made.bundle = Load<TextAsset>("Light/bundle.json");
        made.networks = Load<TextAsset>("Light/networks.bytes");
        made.hours = Load<TextAsset>("Light/hours.bytes");
        made.valid = Load<TextAsset>("Light/valid.bytes");
        made.uv = Load<TextAsset>("Light/uv.bytes");
        made.uvt = Load<TextAsset>("Light/uvt.bytes");
        made.planes = Load<TextAsset>("Light/planes.bytes");
        made.shader = Load<Shader>("Light/WlmLightmap.shader");
        made.lightmapIndex = -1;
        return Started(made);
    }

    static WlmSmoke Smoke(Light sun)
    {
        GameObject quad = GameObject.CreatePrimitive(PrimitiveType.Quad);
        quad.name = "Smoke";
        quad.transform.position = new Vector3(-0.9f, 0.8f, 1.5f);
        var material = new Material(Load<Shader>("Smoke/WlmSmoke.shader"));
        material.SetTexture("wlm_smoke_first_map", Load<Texture2D>("Smoke/first.png"));
        material.SetTexture("wlm_smoke_second_map", Load<Texture2D>("Smoke/second.png"));
        AssetDatabase.CreateAsset(material, "Assets/Smoke.mat");
        quad.GetComponent<MeshRenderer>().sharedMaterial = material;
        WlmSmoke made = quad.AddComponent<WlmSmoke>();
        made.bundle = Load<TextAsset>("Smoke/bundle.json");
        made.lights = new[] { sun };
        made.Import();
        made.Resize();
        return Started(made);
    }

    // Components that run in the editor start as soon as they are added, which is before they have their files.
    static T Started<T>(T made) where T : Behaviour
    {
        made.enabled = false;
        made.enabled = true;
        return made;
    }

    static T Load<T>(string file) where T : Object
    {
        T found = AssetDatabase.LoadAssetAtPath<T>("Assets/" + file);
        if (found == null)
            throw new FileNotFoundException("Assets/" + file + ": not imported as " + typeof(T).Name);
        return found;
    }
}
