"""Writes WGSL: functions, and declarations of textures and buffers in bind group 0."""

import functools

from wlm.export.shading.tree import SAMPLERS, VECTORS, Function, Node, Statement, Variable
from wlm.export.shading.writer import ATOMICS, Writer, nodes_of

_TEXTURES = {"sampler2D": "texture_2d<f32>", "usampler2D": "texture_2d<u32>", "sampler2DArray": "texture_2d_array<f32>"}
_SCALARS = {"float": "f32", "int": "i32", "uint": "u32", "bool": "bool"}


class WgslWriter(Writer):
    """Writes WGSL. Bindings are numbered in the order of the textures and buffers; the sampler is the last."""

    names = {
        **{name: f"vec{n}{kind[0]}" for name, (kind, n) in VECTORS.items()},
        **_SCALARS,
        "unpackHalf2x16": "unpack2x16float",
        "barrier": "workgroupBarrier",
        "packHalf2x16": "pack2x16float",
    }
    linear = "wlm_linear_clamp"

    def _bind(self, name: str) -> str:
        return f"@group(0) @binding({[*self.bound, self.linear].index(name)}) var"

    def foot(self) -> list[str]:
        return ["", f"{self._bind(self.linear)} {self.linear}: sampler;"] if self.filters else []

    def type_of(self, variable: Variable) -> str:
        """Returns the WGSL type of a variable; an array's type includes its size."""
        kind = self.kind(variable.type)
        return kind if variable.size is None else f"array<{kind}, {self.write(variable.size)}>"

    def outer(self, variable: Variable) -> list[str]:
        if variable.type in SAMPLERS:
            return [f"{self._bind(variable.name)} {variable.name}: {_TEXTURES[variable.type]};"]
        if variable.way == "buffer":
            return [f"{self._bind(variable.name)}<storage, read> {variable.name}: array<{self.kind(variable.type)}>;"]
        if variable.way == "storage":
            kind = self.kind(variable.type)
            kind = f"atomic<{kind}>" if variable.name in self._atomic else kind
            return [f"{self._bind(variable.name)}<storage, read_write> {variable.name}: array<{kind}>;"]
        if variable.way == "uniform":
            return [f"{self._bind(variable.name)}<uniform> {variable.name}: {self.type_of(variable)};"]
        if variable.way == "shared":
            return [f"var<workgroup> {variable.name}: {self.type_of(variable)};"]
        assert variable.value is not None
        return [f"const {variable.name}: {self.type_of(variable)} = {self.write(variable.value)};"]

    def signature(self, function: Function) -> str:
        answer = "" if function.type == "void" else f" -> {self.kind(function.type)}"
        return f"fn {function.name}({', '.join(map(self.parameter, function.parameters))}){answer}"

    def parameter(self, variable: Variable) -> str:
        kind = self.type_of(variable)
        if variable.way != "in":
            return f"{variable.name}: ptr<function, {kind}>"
        return f"{variable.name}{'_given' if variable.name in self._changed else ''}: {kind}"

    def function(self, function: Function) -> list[str]:
        # WGSL parameters are immutable.
        names = {each.name for each in function.parameters if each.way == "in"}
        self._changed = sorted(names & _assigned(function.body))
        self.scope = {each.name: each for each in function.parameters}
        copies = [f"    var {name} = {name}_given;" for name in self._changed]
        return [self.signature(function), "{", *copies, *self.block(function.body, "    "), "}"]

    def local(self, variable: Variable) -> str:
        value = "" if variable.value is None else f" = {self.write(variable.value)}"
        self.scope.pop(variable.name, None)
        return f"var {variable.name}: {self.type_of(variable)}{value}"

    def plain(self, node: Node) -> str:
        variable = self.scope.get(node.text)
        return f"(*{node.text})" if variable is not None and variable.way != "in" else node.text

    @functools.cached_property
    def _atomic(self) -> set[str]:
        """The names of the buffers whose entries are atomic, because some function changes them in one step."""
        return {name for _, name in self.atomics}

    def write(self, node: Node) -> str:
        entry = node.parts[0] if node.kind == "assign" else node
        if entry.kind == "index" and entry.parts[0].text in self._atomic:
            place = f"&{super().write(entry)}"
            return f"atomicLoad({place})" if entry is node else f"atomicStore({place}, {self.write(node.parts[1])})"
        if node.kind == "choice":
            condition, chosen, other = map(self.write, node.parts)
            return f"select({other}, {chosen}, {condition})"
        return super().write(node)

    def inside(self, node: Node) -> str:
        return self.write(node) if node.kind == "choice" else super().inside(node)

    def side(self, mark: str, node: Node, right: bool = False) -> str:
        return self.write(node) if node.kind == "choice" else super().side(mark, node, right)

    def call(self, node: Node) -> str:
        if node.text == "uintBitsToFloat":
            return f"bitcast<f32>({self.write(node.parts[0])})"
        if node.text == "floatBitsToUint":
            return f"bitcast<u32>({self.write(node.parts[0])})"
        if node.text in ATOMICS:
            return f"{node.text}(&{super().write(node.parts[0])}, {self.write(node.parts[1])})"
        return super().call(node)

    def arguments(self, name: str, arguments: tuple[Node, ...]) -> list[str]:
        called = self.functions.get(name)
        if called is None:
            return super().arguments(name, arguments)
        out = []
        for given, parameter in zip(arguments, called.parameters, strict=True):
            if parameter.way == "in":
                out.append(self.write(given))
                continue
            own = self.scope.get(given.text)
            # A parameter of the caller is already a pointer.
            out.append(given.text if own is not None and own.way != "in" else f"&{given.text}")
        return out

    def fetch(self, texture: Variable, place: Node) -> str:
        at = self.inside(place)
        where = f"{at}.xy, {at}.z" if texture.type == "sampler2DArray" else self.write(place)
        return f"textureLoad({texture.name}, {where}, 0)"

    def filtered(self, texture: Variable, place: Node, level: str) -> str:
        at = self.inside(place)
        where = f"{at}.xy, i32({at}.z)" if texture.type == "sampler2DArray" else self.write(place)
        return f"textureSampleLevel({texture.name}, {self.linear}, {where}, {level})"

    def graded(self, texture: Variable, place: str, dx: str, dy: str) -> str:
        return f"textureSampleGrad({texture.name}, {self.linear}, {place}, {dx}, {dy})"

    def size(self, texture: Variable) -> str:
        return f"vec2i(textureDimensions({texture.name}, 0))"


def _assigned(body: tuple[Statement, ...]) -> set[str]:
    """Returns the names of the variables that the statements assign to."""
    found = set()
    for node in nodes_of(body):
        if node.kind in ("assign", "step"):
            while node.parts:
                node = node.parts[0]
            found.add(node.text)
    return found
