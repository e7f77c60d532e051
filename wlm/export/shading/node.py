"""HLSL for Custom nodes of Unreal's materials: one function, with its textures as parameters."""

from collections.abc import Mapping

from wlm.export.shading.hlsl import HlslWriter
from wlm.export.shading.source import read_words
from wlm.export.shading.tree import Function, Node, Variable, read_shader
from wlm.export.shading.writer import FILTERS, nodes_of

_SIZE = """\
    int2 wlm_size(Texture2D<float4> image)
    {
        uint width, height;
        image.GetDimensions(width, height);
        return int2(width, height);
    }
"""


def custom_node(
    text: str, function: str, arguments: str, layers: Mapping[str, tuple[int, int]] | None = None
) -> tuple[str, list[str]]:
    """Writes a shader of this package as the code of a Custom node: a structure of functions, and a call of one.

    The functions exist only within the node, so a project needs no shader folder and no C++. The node's textures are
    parameters of each function that reads them. Integer textures become float textures, which hold their numbers
    exactly, and the layers of arrays are stacked vertically: Unreal imports neither integer textures nor arrays.

    Args:
        text: GLSL of this package; its uniforms are inputs of the node, too.
        function: Name of the function whose value the node returns.
        arguments: HLSL of the function's arguments, in terms of the node's other inputs.
        layers: For each texture array, by name: the height of a layer in texels, and the number of layers.

    Returns:
        The code, and the names of the textures and uniforms that must be inputs of the node.

    Raises:
        ValueError: The text uses GLSL that `wlm.export.shading.tree` cannot parse.
    """
    return _NodeWriter(text, layers or {}).node(function, arguments)


class _NodeWriter(HlslWriter):
    indent = "    "

    def __init__(self, text: str, layers: Mapping[str, tuple[int, int]]) -> None:
        super().__init__(read_shader(read_words(text)))
        self.layers = layers
        self.uses: dict[str, list[str]] = {}

    def node(self, function: str, arguments: str) -> tuple[str, list[str]]:
        self._drop_all_but(function)
        inputs = self.used(function)
        # All filtered textures share the sampler of one of them, linear and clamped.
        given = [f"{self.filters[0]}Sampler" if each == self.linear else each for each in inputs]
        constants = [item.name for item, _ in self.shader.items if _is_constant(item)]
        lines = [
            self.text(),
            "WlmNode wlm;\n",
            f"return wlm.{function}({', '.join([arguments, *given])});\n",
            *(f"#undef {name}\n" for name in constants),
        ]
        return "".join(lines), [each for each in inputs if each != self.linear]

    def _drop_all_but(self, function: str) -> None:
        """Removes the comment at the top, and all functions that `function` does not call, with their comments."""
        needed, found = set(), {function}
        while found - needed:
            needed |= found
            nodes = (node for name in needed for node in nodes_of(self.functions[name].body))
            found = {node.text for node in nodes if node.kind == "call"} & set(self.functions)
        kept, comments = [], []
        first = next(i for i, item in enumerate(self.shader.items) if not isinstance(item[0], str))
        for item in self.shader.items[first:]:
            if item[1]:
                kept += comments
                comments = []
            if isinstance(item[0], str):
                comments.append(item)
                continue
            if not isinstance(item[0], Function) or item[0].name in needed:
                kept += [*comments, item]
            comments = []
        self.shader.items = kept
        self.functions = self.shader.functions

    def used(self, name: str) -> list[str]:
        """Returns the names of textures, uniforms and the sampler that a function and its callees read."""
        if name not in self.uses:
            nodes = list(nodes_of(self.functions[name].body))
            names = {each.text for each in nodes if each.kind == "name"}
            called = {each.text for each in nodes if each.kind == "call"}
            found = names & set(self.bound) | ({self.linear} if called & FILTERS else set())
            for each in called & set(self.functions):
                found |= set(self.used(each))
            self.uses[name] = [each for each in (*self.bound, self.linear) if each in found]
        return self.uses[name]

    def head(self) -> list[str]:
        measured = any(each.text == "textureSize" for own in self.functions.values() for each in nodes_of(own.body))
        return ["struct WlmNode", "{", *(_SIZE.splitlines() if measured else [])]

    def foot(self) -> list[str]:
        return ["};"]

    def outer(self, variable: Variable) -> list[str]:
        # A structure within a function cannot have constants.
        if not _is_constant(variable):
            return []
        assert variable.value is not None
        return [f"#define {variable.name} ({self.write(variable.value)})"]

    def signature(self, function: Function) -> str:
        own = [self.parameter(each) for each in function.parameters]
        own += [self._declared(each) for each in self.used(function.name)]
        return f"{self.kind(function.type)} {function.name}({', '.join(own)})"

    def _declared(self, name: str) -> str:
        if name == self.linear:
            return f"SamplerState {name}"
        variable = self.bound[name]
        return f"Texture2D<float4> {name}" if "sampler" in variable.type else self.local(variable)

    def arguments(self, name: str, arguments: tuple[Node, ...]) -> list[str]:
        return super().arguments(name, arguments) + (self.used(name) if name in self.functions else [])

    def fetch(self, texture: Variable, place: Node) -> str:
        at = self.write(place)
        if texture.type == "sampler2DArray":
            row, layer = map(self.write, place.parts)
            at = f"{row} + int2(0, {self.layers[texture.name][0]} * {layer})"
        read = f"{texture.name}.Load(int3({at}, 0))"
        return f"((uint4)({read} + 0.5))" if texture.type == "usampler2D" else read

    def filtered(self, texture: Variable, place: Node, level: str) -> str:
        at = self.write(place)
        if texture.type == "sampler2DArray":
            at = f"float2({at}.x, ({at}.y + {at}.z) / {self.layers[texture.name][1]}.0)"
        return f"{texture.name}.SampleLevel({self.linear}, {at}, {level})"

    def size(self, texture: Variable) -> str:
        return f"wlm_size({texture.name})"


def _is_constant(item: object) -> bool:
    return isinstance(item, Variable) and item.way == "const"
