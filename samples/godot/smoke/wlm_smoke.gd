## Plays six-way smoke on a billboard. See README.md.
@tool
extends MeshInstance3D

## The folder of the export.
@export_dir var folder: String = "res://smoke"
@export var playing: bool = true
## Whether to start again after the last frame instead of stopping there.
@export var loop: bool = true
## Seconds since the first frame.
@export var time: float = 0.0: set = set_time
## Radiance of a uniform sky.
@export var sky: Color = Color.BLACK: set = set_sky

var _info: Dictionary = {}
var _material: ShaderMaterial = null


func _ready() -> void:
	_info = JSON.parse_string(FileAccess.get_file_as_string(folder.path_join("bundle.json")))
	_material = ShaderMaterial.new()
	_material.shader = load(folder.path_join("smoke.gdshader"))
	for key: String in _info["textures"]:
		_material.set_shader_parameter("wlm_smoke_" + key + "_map", load(folder.path_join(_info["textures"][key]["file"])))
	var quad: QuadMesh = QuadMesh.new()
	quad.size = Vector2(_info["extent"][0], _info["extent"][1])
	mesh = quad
	material_override = _material
	cast_shadow = GeometryInstance3D.SHADOW_CASTING_SETTING_OFF
	# The bounds hold for any rotation.
	var reach: float = 0.5 * quad.size.length()
	custom_aabb = AABB(Vector3.ONE * -reach, Vector3.ONE * 2.0 * reach)
	set_time(time)
	set_sky(sky)


func _process(delta: float) -> void:
	if playing and not Engine.is_editor_hint():
		set_time(time + delta)


func set_time(seconds: float) -> void:
	time = seconds
	if _material == null:
		return
	var frames: float = _info["frames"]
	var frame: float = maxf(seconds, 0.0) * float(_info["rate"])
	_material.set_shader_parameter("wlm_frame", fmod(frame, frames) if loop else minf(frame, frames - 1.0))


func set_sky(colour: Color) -> void:
	sky = colour
	if _material != null:
		_material.set_shader_parameter("wlm_sky", colour)
