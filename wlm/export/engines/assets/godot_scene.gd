## Lights the meshes below this node with their parts of a scene's compressed lightmaps. See README.md.
@tool
extends Node

## The folder of the export.
@export_dir var folder: String = "res://scene"
## Index of a state; between two states they are mixed.
@export var state: float = 0.0: set = set_state

var _info: Dictionary = {}
var _materials: Array[ShaderMaterial] = []


func _ready() -> void:
	_info = JSON.parse_string(FileAccess.get_file_as_string(folder.path_join("bundle.json")))
	var shader: Shader = load(folder.path_join("scene.gdshader"))
	var textures: Dictionary = {}
	for key: String in _info["textures"]:
		textures[key] = load(folder.path_join(_info["textures"][key]["file"]))
	for key: String in _info["layer_heights"]:
		textures[key] = _layers(textures[key], int(_info["layer_heights"][key]))
	for each: Dictionary in _info["objects"]:
		var label: String = each["label"]
		var found: MeshInstance3D = find_child(label.validate_node_name(), true, false) as MeshInstance3D
		if found == null:
			push_warning("no mesh below this node is named %s" % label)
			continue
		for i: int in found.mesh.get_surface_count():
			var material: ShaderMaterial = _lit(shader, each, found.get_active_material(i) as BaseMaterial3D)
			for key: String in textures:
				material.set_shader_parameter("wlm_scene_" + key, textures[key])
			found.set_surface_override_material(i, material)
			_materials.append(material)
	set_state(state)


func set_state(value: float) -> void:
	state = value
	for material: ShaderMaterial in _materials:
		material.set_shader_parameter("wlm_state", value)


func _lit(shader: Shader, object: Dictionary, old: BaseMaterial3D) -> ShaderMaterial:
	var material: ShaderMaterial = ShaderMaterial.new()
	material.shader = shader
	if old != null:
		material.set_shader_parameter("albedo", old.albedo_texture)
		material.set_shader_parameter("colour", old.albedo_color)
	var place: Array = object["scale_offset"]
	material.set_shader_parameter("wlm_place", Vector4(place[0], place[1], place[2], place[3]))
	material.set_shader_parameter("wlm_sheet", int(object["sheet"]))
	return material


## Splits a picture into layers, which are stacked from top to bottom.
func _layers(picture: Texture2D, height: int) -> Texture2DArray:
	var image: Image = picture.get_image()
	var images: Array[Image] = []
	for top: int in range(0, image.get_height(), height):
		images.append(image.get_region(Rect2i(0, top, image.get_width(), height)))
	var made: Texture2DArray = Texture2DArray.new()
	made.create_from_images(images)
	return made
