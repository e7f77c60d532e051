## A room whose light changes with the hour of a slider, and smoke under a sun of the same hour. See README.md.
extends Node3D


func _ready() -> void:
	var shader: Shader = load("res://light/lit.gdshader")
	for each: Node in $Room.find_children("*", "MeshInstance3D", true, false):
		var shown: MeshInstance3D = each
		for i: int in shown.mesh.get_surface_count():
			var old: BaseMaterial3D = shown.get_active_material(i)
			var lit: ShaderMaterial = ShaderMaterial.new()
			lit.shader = shader
			lit.set_shader_parameter("colour", old.albedo_color)
			shown.set_surface_override_material(i, lit)
			$Lightmap.materials.append(lit)
	set_hour($Hour.value)


func set_hour(hour: float) -> void:
	$Lightmap.time = hour
	# The sun goes from the east, +x, over the room to the west; after 18 h the lamp lights the smoke from above.
	var turn: float = PI * (hour - 6.0) / 12.0
	var day: bool = hour < 18.0
	var toward: Vector3 = Vector3(cos(turn), sin(turn), 0.6) if day else Vector3(0.0, 1.0, 0.1)
	$Sun.look_at_from_position(toward, Vector3.ZERO)
	$Sun.light_energy = 1.5 * sin(turn) if day else 0.4
	$Smoke.sky = Color(0.3, 0.35, 0.45) if day else Color(0.1, 0.08, 0.06)
