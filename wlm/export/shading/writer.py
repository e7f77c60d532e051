"""Base class of writers that turn a parsed shader into source text of a shading language."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

from wlm.export.shading.tree import LEVELS, SAMPLERS, SCALARS, VECTORS, Function, Node, Shader, Statement, Variable

_STRENGTH = {mark: strength for strength, marks in enumerate(LEVELS) for mark in marks}
# Pairs of outer and inner operator that need no brackets in any language, WGSL included.
_PLAIN = {("+", "*"), ("+", "/"), ("-", "*"), ("-", "/"), ("+", "%"), ("-", "%")}
FILTERS = {"textureLod", "textureGrad"}
"""Functions that read a texture through its filter."""

ATOMICS = ("atomicAdd", "atomicXor")
"""Functions that change an entry of a buffer of uint in one step, and return its value before."""

_COMPARED = ("<", ">", "<=", ">=", "==", "!=")


def nodes_of(body: tuple[Statement, ...]) -> Iterator[Node]:
    """Iterates over all nodes of all expressions in a function body."""

    def within(node: Node) -> Iterator[Node]:
        yield node
        for part in node.parts:
            yield from within(part)

    for statement in body:
        for part in statement.parts:
            yield from within(part)
        if statement.variable is not None and statement.variable.value is not None:
            yield from within(statement.variable.value)
        for inner in statement.bodies:
            yield from nodes_of(inner)


class Writer(ABC):
    """Writes a parsed shader in a C-like language; subclasses override the differences. `linear` is the name of the
    sampler that reads all filtered textures."""

    names: dict[str, str] = {}
    """Names of types and functions that differ from GLSL."""

    indent = ""
    linear = "wlm_linear_clamp_sampler"

    def __init__(self, shader: Shader) -> None:
        self.shader, self.functions, self.bound = shader, shader.functions, shader.bound
        self.scope: dict[str, Variable] = {}

    def text(self) -> str:
        """Returns the source text of the whole shader."""
        lines: list[str] = []
        for item, blank in self.shader.items:
            if blank and lines:
                lines.append("")
            if isinstance(item, str):
                lines.append(self.indent + item)
            elif isinstance(item, Function):
                lines += [self.indent + line if line else line for line in self.function(item)]
            else:
                lines += [self.indent + line for line in self.outer(item)]
        return "\n".join([*self.head(), *lines, *self.foot()]) + "\n"

    def head(self) -> list[str]:
        """Returns the lines before the first declaration: none, unless a subclass overrides this."""
        return []

    def foot(self) -> list[str]:
        """Returns the lines after the last declaration: none, unless a subclass overrides this."""
        return []

    @abstractmethod
    def outer(self, variable: Variable) -> list[str]:
        """Returns the lines that declare a global constant, texture, uniform or buffer."""

    def signature(self, function: Function) -> str:
        """Returns the first line of a function's definition."""
        return f"{self.kind(function.type)} {function.name}({', '.join(map(self.parameter, function.parameters))})"

    @abstractmethod
    def parameter(self, variable: Variable) -> str:
        """Returns the declaration of a parameter."""

    def kind(self, name: str) -> str:
        """Returns the language's name of a GLSL type."""
        return self.names.get(name, name)

    def function(self, function: Function) -> list[str]:
        """Returns the lines of a function."""
        self.scope = {each.name: each for each in function.parameters}
        return [self.signature(function), "{", *self.block(function.body, "    "), "}"]

    def block(self, body: tuple[Statement, ...], indent: str) -> list[str]:
        """Returns the lines of statements, indented by `indent`."""
        lines: list[str] = []
        for statement in body:
            if statement.blank and lines:
                lines.append("")
            lines += [indent + line for line in self.statement(statement)]
        return lines

    def statement(self, statement: Statement) -> list[str]:
        """Returns the lines of a statement."""
        tail = f" {statement.tail}" if statement.tail else ""
        if statement.kind == "comment":
            return [statement.text]
        if statement.kind == "block":
            return ["{", *self.block(statement.bodies[0], "    "), "}"]
        if statement.kind == "declare":
            assert statement.variable is not None
            return [f"{self.local(statement.variable)};{tail}"]
        if statement.kind == "expression":
            return [f"{self.write(statement.parts[0])};{tail}"]
        if statement.kind == "return":
            return [f"return{''.join(' ' + self.write(part) for part in statement.parts)};{tail}"]
        if statement.kind == "if":
            lines = [f"if ({self.write(statement.parts[0])}) {{", *self.block(statement.bodies[0], "    ")]
            if len(statement.bodies) == 2:
                lines += ["} else {", *self.block(statement.bodies[1], "    ")]
            return [*lines, "}"]
        assert statement.variable is not None
        condition, step = map(self.write, statement.parts)
        head = f"for ({self.local(statement.variable)}; {condition}; {step}) {{"
        return [head, *self.block(statement.bodies[0], "    "), "}"]

    def local(self, variable: Variable) -> str:
        """Returns the declaration of a local variable."""
        size = "" if variable.size is None else f"[{self.write(variable.size)}]"
        value = "" if variable.value is None else f" = {self.write(variable.value)}"
        return f"{self.kind(variable.type)} {variable.name}{size}{value}"

    def write(self, node: Node) -> str:
        """Returns the text of an expression."""
        if node.kind in ("number", "name"):
            return self.plain(node)
        if node.kind == "call":
            return self.call(node)
        if node.kind == "member":
            return f"{self.inside(node.parts[0])}.{node.text}"
        if node.kind == "index":
            return f"{self.inside(node.parts[0])}[{self.write(node.parts[1])}]"
        if node.kind == "unary":
            return node.text + self.inside(node.parts[0])
        if node.kind == "step":
            return f"{self.inside(node.parts[0])}{node.text}"
        if node.kind == "assign":
            return f"{self.write(node.parts[0])} {node.text} {self.write(node.parts[1])}"
        if node.kind == "choice":
            return " ".join(
                [self.inside(node.parts[0]), "?", self.inside(node.parts[1]), ":", self.inside(node.parts[2])]
            )
        left, right = node.parts
        return f"{self.side(node.text, left)} {node.text} {self.side(node.text, right, right=True)}"

    def plain(self, node: Node) -> str:
        """Returns the text of a name or a number."""
        return node.text

    def inside(self, node: Node) -> str:
        """Returns the text of an operand, in brackets if it is itself a unary, binary, ?:, assignment or ++."""
        text = self.write(node)
        return f"({text})" if node.kind in ("binary", "choice", "assign", "unary", "step") else text

    def side(self, mark: str, node: Node, right: bool = False) -> str:
        """Returns the text of a binary operator's operand, in brackets where required or easier to read."""
        if node.kind != "binary":
            return f"({self.write(node)})" if node.kind in ("choice", "assign") else self.write(node)
        inner = node.text
        alike = _STRENGTH[inner] == _STRENGTH[mark] and not right and mark not in ("<<", ">>", *_COMPARED)
        compared = mark in _COMPARED and _STRENGTH[inner] >= _STRENGTH["+"]
        joined = mark in ("&&", "||") and inner in _COMPARED
        if alike or compared or joined or (mark, inner) in _PLAIN:
            return self.write(node)
        return f"({self.write(node)})"

    def call(self, node: Node) -> str:
        """Returns the text of a call, a texture read or a constructor."""
        arguments = node.parts
        name = node.text
        if name in ("texelFetch", "textureLod"):
            texture = self.bound[arguments[0].text]
            if name == "texelFetch":
                return self.fetch(texture, arguments[1])
            return self.filtered(texture, arguments[1], self.write(arguments[2]))
        if name == "textureGrad":
            return self.graded(self.bound[arguments[0].text], *(self.write(each) for each in arguments[1:]))
        if name == "textureSize":
            return self.size(self.bound[arguments[0].text])
        if name in VECTORS or name in SCALARS:
            return self.make(name, [self.write(each) for each in arguments])
        return f"{self.names.get(name, name)}({', '.join(self.arguments(name, arguments))})"

    def arguments(self, name: str, arguments: tuple[Node, ...]) -> list[str]:
        """Returns the texts of the arguments of a call."""
        return [self.write(each) for each in arguments]

    def make(self, name: str, values: list[str]) -> str:
        """Returns the text of a constructor of a vector or scalar."""
        return f"{self.kind(name)}({', '.join(values)})"

    @abstractmethod
    def fetch(self, texture: Variable, place: Node) -> str:
        """Returns the text that reads one texel of a texture without the filter."""

    @abstractmethod
    def filtered(self, texture: Variable, place: Node, level: str) -> str:
        """Returns the text that reads a texture with filtering at a mip level."""

    @abstractmethod
    def graded(self, texture: Variable, place: str, dx: str, dy: str) -> str:
        """Returns the text that reads a texture with filtering; the derivatives dx, dy choose the mip level."""

    @abstractmethod
    def size(self, texture: Variable) -> str:
        """Returns the text of an expression for a texture's size in texels, two integers."""

    @property
    def textures(self) -> list[Variable]:
        """Returns the variables of all textures that the shader declares."""
        return [each for each in self.bound.values() if each.type in SAMPLERS]

    @property
    def atomics(self) -> set[tuple[str, str]]:
        """Returns the function and the buffer of the calls of atomic functions."""
        nodes = (node for function in self.functions.values() for node in nodes_of(function.body))
        calls = (node for node in nodes if node.kind == "call" and node.text in ATOMICS)
        return {(node.text, node.parts[0].parts[0].text) for node in calls}

    @property
    def filters(self) -> list[str]:
        """Returns the names of the textures that are read with filtering, one name for each read."""
        nodes = (node for function in self.functions.values() for node in nodes_of(function.body))
        return [node.parts[0].text for node in nodes if node.kind == "call" and node.text in FILTERS]
