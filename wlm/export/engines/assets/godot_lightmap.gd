## Lightmaps over time: viewports decode them into half floats, in Forward+ and Compatibility. See README.md.
extends Node

## The folder of the export.
@export_dir var folder: String = "res://lightmap"
## Materials of lit.gdshader.
@export var materials: Array[ShaderMaterial] = []
@export var time: float = 12.0

const NAMES: Array[String] = [@NAMES@]
const FORMATS: Dictionary = {49: Image.FORMAT_RG8, 61: Image.FORMAT_R8, 98: Image.FORMAT_BPTC_RGBA}

## A map of one stored hour: a viewport decodes it, the next fills the gaps between its charts.
class Map:
	var hour: int = -1
	var decoded: SubViewport
	var filled: SubViewport
	var material: ShaderMaterial

var _content: Dictionary = {}
var _textures: Dictionary = {}
var _hours: PackedByteArray
var _maps: Array[Map] = []
var _drawn: float = NAN


func _ready() -> void:
	_content = JSON.parse_string(FileAccess.get_file_as_string(folder.path_join("bundle.json")))
	_hours = FileAccess.get_file_as_bytes(folder.path_join("hours.bin"))
	for key: String in NAMES:
		if key == "networks":
			_textures[key] = _fours(FileAccess.get_file_as_bytes(folder.path_join("networks.bin")))
		elif key != "hour":
			_textures[key] = _read_dds(folder.path_join(key + ".dds"), key == "frames")
	for i: int in 2:
		var map: Map = Map.new()
		var fill: ShaderMaterial = _material()
		map.filled = _viewport(fill, self)
		map.material = _material()
		# A viewport within another is drawn before it.
		map.decoded = _viewport(map.material, map.filled)
		fill.set_shader_parameter("wlm_filling", true)
		fill.set_shader_parameter("wlm_decoded", map.decoded.get_texture())
		_maps.append(map)


func _process(_delta: float) -> void:
	if time == _drawn or materials.is_empty():
		return
	_drawn = time
	var around: Array = _around(time)
	var early: Map = _map_of(around[0], around[1])
	var late: Map = _map_of(around[1], around[0]) if around[2] > 0.0 else early
	for material: ShaderMaterial in materials:
		material.set_shader_parameter("wlm_early", early.filled.get_texture())
		material.set_shader_parameter("wlm_late", late.filled.get_texture())
		material.set_shader_parameter("wlm_share", around[2])


## The stored times before and after a time, and the weight of the later one.
func _around(t: float) -> Array:
	var times: Array = _content["times"]
	var period: Variant = _content["period"]
	var count: int = times.size()
	t = fposmod(t, period) if period else clampf(t, times[0], times[-1])
	var before: int = -1
	for i: int in count:
		if times[i] <= t:
			before = i
	var after: int = before + 1
	if not period:
		after = mini(after, count - 1)
		return [before, after, (t - times[before]) / (times[after] - times[before]) if after > before else 0.0]
	before = posmod(before, count)
	after = after % count
	var gap: float = fposmod(times[after] - times[before], period)
	return [before, after, fposmod(t - times[before], period) / (gap if gap > 0.0 else float(period))]


## The map of a stored hour. If it is not in memory, it replaces the map that is not needed now.
func _map_of(hour: int, other: int) -> Map:
	for map: Map in _maps:
		if map.hour == hour:
			return map
	var map: Map = _maps[1 if _maps[0].hour == other else 0]
	var size: int = 16 * int(_content["hour_fours"])
	map.material.set_shader_parameter("wlm_lightmap_hour", _fours(_hours.slice(size * hour, size * (hour + 1))))
	map.decoded.render_target_update_mode = SubViewport.UPDATE_ONCE
	map.filled.render_target_update_mode = SubViewport.UPDATE_ONCE
	map.hour = hour
	return map


func _material() -> ShaderMaterial:
	var made: ShaderMaterial = ShaderMaterial.new()
	made.shader = load(folder.path_join("lightmap.gdshader"))
	for key: String in _textures:
		made.set_shader_parameter("wlm_lightmap_" + key, _textures[key])
	return made


func _viewport(material: ShaderMaterial, parent: Node) -> SubViewport:
	var made: SubViewport = SubViewport.new()
	made.size = Vector2i(int(_content["width"]), int(_content["height"]))
	made.use_hdr_2d = true
	made.disable_3d = true
	made.render_target_update_mode = SubViewport.UPDATE_DISABLED
	var drawn: ColorRect = ColorRect.new()
	drawn.size = made.size
	drawn.material = material
	made.add_child(drawn)
	parent.add_child(made)
	return made


## A texture of RGBA floats, 1,024 texels a row.
func _fours(bytes: PackedByteArray) -> ImageTexture:
	var rows: int = (bytes.size() + 16383) / 16384
	bytes.resize(16384 * rows)
	return ImageTexture.create_from_image(Image.create_from_data(1024, rows, false, Image.FORMAT_RGBAF, bytes))


func _read_dds(path: String, array: bool) -> Texture:
	var bytes: PackedByteArray = FileAccess.get_file_as_bytes(path)
	var layers: int = bytes.decode_u32(140)
	var size: int = (bytes.size() - 148) / layers
	var images: Array[Image] = []
	for i: int in layers:
		var data: PackedByteArray = bytes.slice(148 + size * i, 148 + size * (i + 1))
		var format: Image.Format = FORMATS[bytes.decode_u32(128)]
		images.append(Image.create_from_data(bytes.decode_u32(16), bytes.decode_u32(12), false, format, data))
	if not array:
		return ImageTexture.create_from_image(images[0])
	var made: Texture2DArray = Texture2DArray.new()
	made.create_from_images(images)
	return made
