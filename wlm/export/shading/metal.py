"""Writes the Metal shading language: a structure with textures and buffers as members and functions as methods."""

from wlm.export.shading.tree import VECTORS, Function, Node, Variable
from wlm.export.shading.writer import Writer

_TEXTURES = {
    "sampler2D": "texture2d<float>",
    "usampler2D": "texture2d<uint>",
    "sampler2DArray": "texture2d_array<float>",
}


class MetalWriter(Writer):
    """Writes a structure, since Metal has no global textures or buffers: the user fills it in and calls its methods."""

    names = {
        **{name: f"{kind}{n}" for name, (kind, n) in VECTORS.items()},
        "uintBitsToFloat": "as_type<float>",
    }
    indent = "    "

    def text(self) -> str:
        # Constants and the head comment stay outside of the structure.
        items = self.shader.items
        first = next(i for i, (item, _) in enumerate(items) if not isinstance(item, str))
        self._top = [str(item) for item, _ in items[:first]]
        self._constants = [item for item, _ in items if isinstance(item, Variable) and item.way == "const"]
        self.shader.items = [each for each in items[first:] if each[0] not in self._constants]
        text = super().text()
        self.shader.items = items
        return text

    def head(self) -> list[str]:
        prefix = "_".join((self.textures[0].name if self.textures else next(iter(self.functions))).split("_")[:2])
        name = "".join(part.title() for part in prefix.split("_"))
        lines = [*self._top, "", "#include <metal_stdlib>", "using namespace metal;", ""]
        lines += [f"constexpr constant {self.local(each)};" for each in self._constants]
        if self.filters:
            state = "filter::linear, mip_filter::linear, address::clamp_to_edge"
            lines.append(f"constexpr sampler {self.linear}({state});")
        return [*lines, "", f"struct {name}", "{"]

    def foot(self) -> list[str]:
        return ["};"]

    def outer(self, variable: Variable) -> list[str]:
        kind = self.kind(variable.type)
        if variable.type in _TEXTURES:
            return [f"{_TEXTURES[variable.type]} {variable.name};"]
        if variable.way == "buffer":
            return [f"device const {kind}* {variable.name};"]
        return [f"constant {kind}* {variable.name};"]

    def signature(self, function: Function) -> str:
        return f"{super().signature(function)} const"

    def parameter(self, variable: Variable) -> str:
        kind = self.kind(variable.type)
        if variable.size is not None:
            return f"thread {kind} (&{variable.name})[{self.write(variable.size)}]"
        return f"thread {kind}& {variable.name}" if variable.way != "in" else f"{kind} {variable.name}"

    def call(self, node: Node) -> str:
        if node.text == "unpackHalf2x16":
            return f"float2(as_type<half2>({self.write(node.parts[0])}))"
        return super().call(node)

    def fetch(self, texture: Variable, place: Node) -> str:
        at = self.inside(place)
        if texture.type == "sampler2DArray":
            return f"{texture.name}.read(uint2({at}.xy), uint({at}.z), 0)"
        return f"{texture.name}.read(uint2({self.write(place)}), 0)"

    def filtered(self, texture: Variable, place: Node, level: str) -> str:
        at = self.inside(place)
        if texture.type == "sampler2DArray":
            return f"{texture.name}.sample({self.linear}, {at}.xy, uint({at}.z), level({level}))"
        return f"{texture.name}.sample({self.linear}, {self.write(place)}, level({level}))"

    def graded(self, texture: Variable, place: str, dx: str, dy: str) -> str:
        return f"{texture.name}.sample({self.linear}, {place}, gradient2d({dx}, {dy}))"

    def size(self, texture: Variable) -> str:
        return f"int2({texture.name}.get_width(), {texture.name}.get_height())"
