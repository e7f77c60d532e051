"""WGSL whose functions take their buffers as pointers, for node materials of three.js."""

from wlm.export.shading.source import read_words
from wlm.export.shading.tree import Function, Node, Variable, read_shader
from wlm.export.shading.wgsl import WgslWriter
from wlm.export.shading.writer import nodes_of


def wgsl_with_pointers(text: str) -> str:
    """Translates a shader of this package to WGSL; each function has the buffers that it reads as its last parameters.
    Raises a ValueError if the text uses GLSL that `wlm.export.shading.tree` cannot parse."""
    return _PointerWriter(read_shader(read_words(text))).text()


class _PointerWriter(WgslWriter):
    def _buffers(self, name: str) -> list[str]:
        """The names of the buffers that a function and the functions that it calls read."""
        nodes = list(nodes_of(self.functions[name].body))
        called = {node.text for node in nodes if node.kind == "call"} & set(self.functions)
        found = {node.text for node in nodes if node.kind == "name"}.union(*map(self._buffers, called))
        return [each for each in self.bound if each in found]

    def outer(self, variable: Variable) -> list[str]:
        return super().outer(variable) if variable.way == "const" else []

    def signature(self, function: Function) -> str:
        given = [
            f"{name}: ptr<storage, array<{self.kind(self.bound[name].type)}>, read>"
            for name in self._buffers(function.name)
        ]
        answer = "" if function.type == "void" else f" -> {self.kind(function.type)}"
        return f"fn {function.name}({', '.join([*map(self.parameter, function.parameters), *given])}){answer}"

    def plain(self, node: Node) -> str:
        return f"(*{node.text})" if node.text in self.bound else super().plain(node)

    def arguments(self, name: str, arguments: tuple[Node, ...]) -> list[str]:
        return super().arguments(name, arguments) + (self._buffers(name) if name in self.functions else [])
