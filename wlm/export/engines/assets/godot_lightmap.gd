# Lightmaps over time, decoded by a compute shader on the rendering device. See README.md.
extends Node

@export_dir var folder := "res://lightmap"
@export var material: ShaderMaterial  # of lit.gdshader
@export var time := 12.0

const NAMES: Array[String] = [@NAMES@]
const FORMATS := {
	49: RenderingDevice.DATA_FORMAT_R8G8_UNORM,
	61: RenderingDevice.DATA_FORMAT_R8_UNORM,
	98: RenderingDevice.DATA_FORMAT_BC7_UNORM_BLOCK,
}

var _content: Dictionary
var _device: RenderingDevice
var _textures := {}
var _passes := {}
var _sampler: RID
var _hours: PackedByteArray
var _raw: RID
var _maps: Array[RID] = []
var _shown: Array[Texture2DRD] = []
var _hour_of := [-1, -1]
var _drawn := NAN


func _ready() -> void:
	_content = JSON.parse_string(FileAccess.get_file_as_string(folder.path_join("bundle.json")))
	_device = RenderingServer.get_rendering_device()
	if _device == null:
		push_error("wlm_lightmap.gd: expected the Forward+ or Mobile renderer")
		set_process(false)
		return
	var state := RDSamplerState.new()
	state.min_filter = RenderingDevice.SAMPLER_FILTER_LINEAR
	state.mag_filter = RenderingDevice.SAMPLER_FILTER_LINEAR
	_sampler = _device.sampler_create(state)
	_hours = FileAccess.get_file_as_bytes(folder.path_join("hours.bin"))
	for name in NAMES:
		if name == "networks":
			_textures[name] = _fours(FileAccess.get_file_as_bytes(folder.path_join("networks.bin")))
		elif name != "hour":
			_textures[name] = _read_dds(folder.path_join(name + ".dds"), name == "frames")
	var file: RDShaderFile = load(folder.path_join("lightmap.glsl"))
	for name in ["decode", "fill"]:
		var shader := _device.shader_create_from_spirv(file.get_spirv(name))
		_passes[name] = [shader, _device.compute_pipeline_create(shader)]
	_raw = _target()
	for i in 2:
		_maps.append(_target())
		var shown := Texture2DRD.new()
		shown.texture_rd_rid = _maps[i]
		_shown.append(shown)


func _process(_delta: float) -> void:
	if time == _drawn or material == null:
		return
	_drawn = time
	var around := _around(time)
	var early := _map_of(around[0], around[1])
	var late := _map_of(around[1], around[0]) if around[2] > 0.0 else early
	material.set_shader_parameter("wlm_early", _shown[early])
	material.set_shader_parameter("wlm_late", _shown[late])
	material.set_shader_parameter("wlm_share", around[2])


func _exit_tree() -> void:
	for shown in _shown:
		shown.texture_rd_rid = RID()
	for each in [_raw] + _maps + _textures.values() + [_sampler] + _passes.values().map(func(made): return made[0]):
		if each.is_valid():
			_device.free_rid(each)


# The stored times before and after a time, and the weight of the later one.
func _around(t: float) -> Array:
	var times: Array = _content["times"]
	var period = _content["period"]
	var count := times.size()
	t = fposmod(t, period) if period else clampf(t, times[0], times[-1])
	var before := -1
	for i in count:
		if times[i] <= t:
			before = i
	var after := before + 1
	if not period:
		after = mini(after, count - 1)
		return [before, after, (t - times[before]) / (times[after] - times[before]) if after > before else 0.0]
	before = posmod(before, count)
	after = after % count
	var gap := fposmod(times[after] - times[before], period)
	return [before, after, fposmod(t - times[before], period) / (gap if gap > 0.0 else float(period))]


func _map_of(hour: int, other: int) -> int:
	var place := _hour_of.find(hour)
	if place >= 0:
		return place
	place = 1 if _hour_of[0] == other else 0
	var size: int = 16 * int(_content["hour_fours"])
	_textures["hour"] = _fours(_hours.slice(size * hour, size * (hour + 1)))
	_run("decode", _raw, RID())
	_run("fill", _maps[place], _raw)
	_device.free_rid(_textures["hour"])
	_textures.erase("hour")
	_hour_of[place] = hour
	return place


func _run(name: String, target: RID, source: RID) -> void:
	var bound: Array[RDUniform] = []
	for i in NAMES.size():
		# Textures that a pass does not read are not in its layout.
		if name == "decode" and NAMES[i] != "valid" or name == "fill" and NAMES[i] == "valid":
			bound.append(_uniform(RenderingDevice.UNIFORM_TYPE_SAMPLER_WITH_TEXTURE, i, [_sampler, _textures[NAMES[i]]]))
	bound.append(_uniform(RenderingDevice.UNIFORM_TYPE_IMAGE, 8, [target]))
	if source.is_valid():
		bound.append(_uniform(RenderingDevice.UNIFORM_TYPE_SAMPLER_WITH_TEXTURE, 9, [_sampler, source]))
	var made: Array = _passes[name]
	var uniforms := _device.uniform_set_create(bound, made[0], 0)
	var list := _device.compute_list_begin()
	_device.compute_list_bind_compute_pipeline(list, made[1])
	_device.compute_list_bind_uniform_set(list, uniforms, 0)
	_device.compute_list_dispatch(list, (int(_content["width"]) + 7) / 8, (int(_content["height"]) + 7) / 8, 1)
	_device.compute_list_end()
	_device.free_rid(uniforms)


func _uniform(kind: int, binding: int, ids: Array) -> RDUniform:
	var uniform := RDUniform.new()
	uniform.uniform_type = kind
	uniform.binding = binding
	for id in ids:
		uniform.add_id(id)
	return uniform


func _texture(width: int, height: int, layers: int, format: int, array: bool, data: Array[PackedByteArray]) -> RID:
	var made := RDTextureFormat.new()
	made.width = width
	made.height = height
	made.array_layers = layers
	made.format = format
	made.texture_type = RenderingDevice.TEXTURE_TYPE_2D_ARRAY if array else RenderingDevice.TEXTURE_TYPE_2D
	made.usage_bits = RenderingDevice.TEXTURE_USAGE_SAMPLING_BIT
	if data.is_empty():
		made.usage_bits |= RenderingDevice.TEXTURE_USAGE_STORAGE_BIT
	return _device.texture_create(made, RDTextureView.new(), data)


func _target() -> RID:
	var format := RenderingDevice.DATA_FORMAT_R16G16B16A16_SFLOAT
	return _texture(int(_content["width"]), int(_content["height"]), 1, format, false, [])


# Makes a texture of RGBA floats, 1,024 texels a row.
func _fours(bytes: PackedByteArray) -> RID:
	var rows := (bytes.size() + 16383) / 16384
	bytes.resize(16384 * rows)
	return _texture(1024, rows, 1, RenderingDevice.DATA_FORMAT_R32G32B32A32_SFLOAT, false, [bytes])


func _read_dds(path: String, array: bool) -> RID:
	var bytes := FileAccess.get_file_as_bytes(path)
	var layers := bytes.decode_u32(140)
	var size := (bytes.size() - 148) / layers
	var data: Array[PackedByteArray] = []
	for i in layers:
		data.append(bytes.slice(148 + size * i, 148 + size * (i + 1)))
	return _texture(bytes.decode_u32(16), bytes.decode_u32(12), layers, FORMATS[bytes.decode_u32(128)], array, data)
