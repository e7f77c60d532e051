# Of the sample, run without its editor: makes what the editor imports, and prints the light of the room, and smoke.
extends Node

var kept: Array[Resource] = []


func keep(path: String, made: Resource) -> void:
	made.take_over_path(path)
	kept.append(made)


func frames() -> void:
	for i: int in 3:
		await RenderingServer.frame_post_draw


func show(view: SubViewport) -> void:
	view.render_target_update_mode = SubViewport.UPDATE_ALWAYS
	add_child(view)
	await frames()
	print("FOUND ", Marshalls.raw_to_base64(view.get_texture().get_image().get_data()))


func _init() -> void:
	for path: String in ["res://smoke/first.png", "res://smoke/second.png"]:
		keep(path, ImageTexture.create_from_image(Image.load_from_file(path)))
	var document: GLTFDocument = GLTFDocument.new()
	var state: GLTFState = GLTFState.new()
	document.append_from_file("res://room.glb", state)
	var room: PackedScene = PackedScene.new()
	room.pack(document.generate_scene(state))
	keep("res://room.glb", room)


func _ready() -> void:
	await frames()
	var main: Node = get_tree().current_scene
	var shader: Shader = Shader.new()
	shader.code = "shader_type canvas_item; render_mode blend_disabled;
uniform sampler2D early : filter_nearest; uniform sampler2D late : filter_nearest; uniform float share;
void fragment() { COLOR = vec4(mix(texture(early, UV), texture(late, UV), share).rgb, 1.0); }"
	for hour: float in [8.0, 13.7, 20.0]:
		main.get_node("Hour").value = hour
		await frames()
		var lit: ShaderMaterial = main.get_node("Lightmap").materials[0]
		var view: SubViewport = SubViewport.new()
		view.size = Vector2i(128, 128)
		var drawn: ColorRect = ColorRect.new()
		drawn.size = view.size
		drawn.material = ShaderMaterial.new()
		drawn.material.shader = shader
		for key: String in ["early", "late", "share"]:
			drawn.material.set_shader_parameter(key, lit.get_shader_parameter("wlm_" + key))
		view.add_child(drawn)
		await show(view)
	var air: SubViewport = SubViewport.new()
	air.size = Vector2i(64, 64)
	air.own_world_3d = true
	air.transparent_bg = true
	var smoke: Node3D = load("res://smoke/wlm_smoke.gd").new()
	smoke.playing = false
	smoke.time = 0.5
	var camera: Camera3D = Camera3D.new()
	camera.set_orthogonal(1.0, 0.1, 10.0)
	camera.position.z = 5.0
	var sun: DirectionalLight3D = DirectionalLight3D.new()
	sun.look_at_from_position(Vector3(0.48, 0.6, 0.64), Vector3.ZERO)
	sun.light_energy = 4.0
	for each: Node in [smoke, camera, sun]:
		air.add_child(each)
	await show(air)
	print("DONE")
