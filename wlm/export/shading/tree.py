"""Parser of our GLSL: functions, constants, textures and buffers. It covers the subset that our shaders use."""

from dataclasses import dataclass, field

from wlm.export.shading.source import Word

VECTORS = {
    f"{kind}vec{n}": ({"": "float", "i": "int", "u": "uint"}[kind], n) for kind in ("", "i", "u") for n in (2, 3, 4)
}
SCALARS = ("float", "int", "uint", "bool", "void")
SAMPLERS = ("sampler2D", "usampler2D", "sampler2DArray")
_TYPES = {*VECTORS, *SCALARS, *SAMPLERS}
LEVELS = tuple(map(str.split, ("||", "&&", "|", "^", "&", "== !=", "< > <= >=", "<< >>", "+ -", "* / %")))
_ASSIGN = ("=", "+=", "-=", "*=", "/=", "%=", "&=", "|=", "^=")


@dataclass(frozen=True)
class Node:
    """A node of an expression tree: its kind (`number`, `name`, `call`, `member`, `index`, `unary`, `binary`, `choice`
    (?:), `assign` or `step` (++)); the text of the number, name, member or operator; and its operands."""

    kind: str
    text: str
    parts: tuple["Node", ...] = ()


@dataclass(frozen=True)
class Variable:
    """A parameter, constant, local or shared variable, texture, uniform or buffer of a GLSL type. `size` is the
    length of an array, else None; `way` is `in`, `out` or `inout` of a parameter or local variable, or `const`,
    `uniform`, `shared`, `buffer` or, of a buffer that is written, `storage`; `value` is the initial value, or None."""

    type: str
    name: str
    size: Node | None = None
    way: str = "in"
    value: Node | None = None


@dataclass(frozen=True)
class Statement:
    """A statement: `comment`, `declare`, `expression`, `return`, `if`, `for` or `block`.

    It has the text of a comment, expressions, the variable of a declaration or a loop, and blocks: one or two of `if`,
    one of `for` and `block`. `tail` is the comment at the end of its line; `blank` tells whether a blank line precedes
    it.
    """

    kind: str
    text: str = ""
    parts: tuple[Node, ...] = ()
    variable: Variable | None = None
    bodies: tuple[tuple["Statement", ...], ...] = ()
    tail: str = ""
    blank: bool = False


@dataclass(frozen=True)
class Function:
    """A function of a shader."""

    type: str
    name: str
    parameters: tuple[Variable, ...]
    body: tuple[Statement, ...]


@dataclass
class Shader:
    """The declarations of a shader: comments (text), variables and functions in order, each with a flag, whether a
    blank line precedes it."""

    items: list[tuple[str | Variable | Function, bool]] = field(default_factory=list)

    @property
    def functions(self) -> dict[str, Function]:
        """Returns the shader's functions by name."""
        return {item.name: item for item, _ in self.items if isinstance(item, Function)}

    @property
    def bound(self) -> dict[str, Variable]:
        """Returns the shader's textures, uniforms and buffers by name."""
        found = [
            item
            for item, _ in self.items
            if isinstance(item, Variable) and item.way in ("uniform", "buffer", "storage")
        ]
        return {item.name: item for item in found}


class _Reader:
    def __init__(self, words: list[Word]) -> None:
        self.words, self.at = [*words, Word("end", "")], 0

    @property
    def word(self) -> Word:
        return self.words[self.at]

    def take(self, *expected: str) -> Word:
        word = self.word
        if expected and word.text not in expected:
            raise ValueError(f"GLSL: expected {' or '.join(expected)}, got {word.text!r}")
        self.at += 1
        return word

    def taken(self, text: str) -> bool:
        if self.word.text != text or self.word.kind == "comment":
            return False
        self.at += 1
        return True

    def quiet(self) -> None:
        """Skips the comments before the next token of an expression."""
        while self.word.kind == "comment":
            self.at += 1

    def shader(self) -> Shader:
        shader = Shader()
        while self.word.kind != "end":
            blank = self.word.blank
            if self.word.kind == "comment":
                shader.items.append((self.take().text, blank))
            elif self.taken("layout"):
                self._skip_round()
                shader.items.append((self._buffer(), blank))
            elif self.word.text in ("uniform", "const", "shared"):
                variable = self._variable(self.take().text)
                tail = self._end()
                if tail:
                    shader.items.append((tail, blank))
                shader.items.append((variable, blank and not tail))
            else:
                shader.items.append((self._function(), blank))
        return shader

    def _skip_round(self) -> None:
        self.take("(")
        while not self.taken(")"):
            self.at += 1

    def _buffer(self) -> Variable:
        way = "buffer" if self.taken("readonly") else "storage"
        self.take("buffer")
        self.take()
        self.take("{")
        kind, name = self.take().text, self.take().text
        for mark in ("[", "]", ";", "}", ";"):
            self.take(mark)
        return Variable(kind, name, way=way)

    def _variable(self, way: str) -> Variable:
        kind, name = self.take().text, self.take().text
        if kind not in _TYPES:
            raise ValueError(f"GLSL: expected a type, got {kind!r}")
        size = value = None
        if self.taken("["):
            size = self.expression()
            self.take("]")
        if self.taken("="):
            value = self.expression()
        return Variable(kind, name, size, way, value)

    def _function(self) -> Function:
        kind, name = self.take().text, self.take().text
        if kind not in _TYPES:
            raise ValueError(f"GLSL: expected a type, got {kind!r}")
        self.take("(")
        parameters = []
        while not self.taken(")"):
            way = self.take().text if self.word.text in ("in", "out", "inout") else "in"
            parameters.append(self._variable(way))
            self.taken(",")
        return Function(kind, name, tuple(parameters), self._block())

    def _block(self) -> tuple[Statement, ...]:
        self.take("{")
        body = []
        while not self.taken("}"):
            body.append(self._statement())
        return tuple(body)

    def _body(self) -> tuple[Statement, ...]:
        self.quiet()
        return self._block() if self.word.text == "{" else (self._statement(),)

    def _statement(self) -> Statement:
        word, blank = self.word, self.word.blank
        if word.kind == "comment":
            return Statement("comment", self.take().text, blank=blank)
        if word.text == "{":
            return Statement("block", bodies=(self._block(),), blank=blank)
        if self.taken("if"):
            self.take("(")
            condition = self.expression()
            self.take(")")
            bodies = [self._body()]
            if self.taken("else"):
                bodies.append(self._body())
            return Statement("if", parts=(condition,), bodies=tuple(bodies), blank=blank)
        if self.taken("for"):
            self.take("(")
            variable = self._variable("in")
            self.take(";")
            condition = self.expression()
            self.take(";")
            step = self.expression()
            self.take(")")
            return Statement("for", parts=(condition, step), variable=variable, bodies=(self._body(),), blank=blank)
        if self.taken("return"):
            parts = () if self.word.text == ";" else (self.expression(),)
            return Statement("return", parts=parts, tail=self._end(), blank=blank)
        if word.text in _TYPES and self.words[self.at + 1].kind == "name":
            variable = self._variable("in")
            return Statement("declare", variable=variable, tail=self._end(), blank=blank)
        return Statement("expression", parts=(self.expression(),), tail=self._end(), blank=blank)

    def _end(self) -> str:
        self.take(";")
        return self.take().text if self.word.kind == "comment" and not self.word.alone else ""

    def expression(self) -> Node:
        left = self._choice()
        if self.word.text in _ASSIGN:
            mark = self.take().text
            return Node("assign", mark, (left, self.expression()))
        return left

    def _choice(self) -> Node:
        condition = self._binary(0)
        if not self.taken("?"):
            return condition
        chosen = self.expression()
        self.take(":")
        return Node("choice", "?", (condition, chosen, self.expression()))

    def _binary(self, level: int) -> Node:
        if level == len(LEVELS):
            return self._unary()
        left = self._binary(level + 1)
        self.quiet()
        while self.word.text in LEVELS[level]:
            mark = self.take().text
            left = Node("binary", mark, (left, self._binary(level + 1)))
            self.quiet()
        return left

    def _unary(self) -> Node:
        self.quiet()
        if self.word.text in ("++", "--"):
            return Node("step", self.take().text, (self._unary(),))
        if self.word.text in ("-", "!", "~"):
            return Node("unary", self.take().text, (self._unary(),))
        return self._behind(self._first())

    def _first(self) -> Node:
        word = self.take()
        if word.text == "(":
            inner = self.expression()
            self.quiet()
            self.take(")")
            return inner
        if word.kind == "number":
            return Node("number", word.text)
        if word.kind != "name":
            raise ValueError(f"GLSL: expected an expression, got {word.text!r}")
        return Node("name", word.text)

    def _behind(self, node: Node) -> Node:
        while True:
            if self.taken("("):
                arguments = []
                while not self.taken(")"):
                    arguments.append(self.expression())
                    self.quiet()
                    self.taken(",")
                    self.quiet()
                node = Node("call", node.text, tuple(arguments))
            elif self.taken("["):
                node = Node("index", "", (node, self.expression()))
                self.take("]")
            elif self.taken("."):
                node = Node("member", self.take().text, (node,))
            elif self.word.text in ("++", "--"):
                node = Node("step", self.take().text, (node,))
            else:
                return node


def read_shader(words: list[Word]) -> Shader:
    """Parses the tokens of a shader. Raises a ValueError if the text uses GLSL that this parser does not support."""
    return _Reader(words).shader()
