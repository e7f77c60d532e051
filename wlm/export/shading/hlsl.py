"""Writes HLSL of shader model 5 and later."""

from wlm.export.shading.tree import VECTORS, Node, Variable
from wlm.export.shading.writer import Writer

_TEXTURES = {
    "sampler2D": "Texture2D<float4>",
    "usampler2D": "Texture2D<uint4>",
    "sampler2DArray": "Texture2DArray<float4>",
}
_HALVES = """\
float2 wlm_halves(uint word)
{
    return float2(f16tof32(word & 65535u), f16tof32(word >> 16));
}
"""
_PACK = """\
uint wlm_pack_halves(float2 pair)
{
    return f32tof16(pair.x) | (f32tof16(pair.y) << 16);
}
"""
_SIZE = """\
int2 wlm_size_of_{name}()
{{
    uint width, height;
    {name}.GetDimensions(width, height);
    return int2(width, height);
}}
"""


_ATOMIC = """\
uint wlm_{function}_{name}(int i, uint value)
{{
    uint before;
    {own}({name}[i], value, before);
    return before;
}}"""
_ATOMICS = {"atomicAdd": "InterlockedAdd", "atomicXor": "InterlockedXor"}


class HlslWriter(Writer):
    """Writes HLSL functions for an include file. One sampler reads all textures; Unity creates it from its name."""

    names = {
        **{name: f"{kind}{n}" for name, (kind, n) in VECTORS.items()},
        "mix": "lerp",
        "uintBitsToFloat": "asfloat",
        "floatBitsToUint": "asuint",
        "unpackHalf2x16": "wlm_halves",
        "barrier": "GroupMemoryBarrierWithGroupSync",
        "packHalf2x16": "wlm_pack_halves",
    }

    def head(self) -> list[str]:
        return [f"SamplerState {self.linear};"] if self.filters else []

    def outer(self, variable: Variable) -> list[str]:
        if variable.type in _TEXTURES:
            return [f"{_TEXTURES[variable.type]} {variable.name};"]
        if variable.way == "buffer":
            return [f"StructuredBuffer<{self.kind(variable.type)}> {variable.name};"]
        if variable.way == "storage":
            own = sorted(function for function, name in self.atomics if name == variable.name)
            helpers = [_ATOMIC.format(function=each, name=variable.name, own=_ATOMICS[each]) for each in own]
            return [f"RWStructuredBuffer<{self.kind(variable.type)}> {variable.name};", *helpers]
        if variable.way == "uniform":
            # A float3 in an array of a constant buffer takes the space of a float4.
            return [f"cbuffer {variable.name}_values", "{", f"    {self.local(variable)};", "};"]
        return [f"{'groupshared' if variable.way == 'shared' else 'static const'} {self.local(variable)};"]

    def parameter(self, variable: Variable) -> str:
        way = "" if variable.way == "in" else f"{variable.way} "
        return way + self.local(variable)

    def make(self, name: str, values: list[str]) -> str:
        # HLSL has no vector constructor with one argument; a cast does the same.
        if len(values) == 1 and name in VECTORS:
            return f"(({self.kind(name)})({values[0]}))"
        return super().make(name, values)

    def call(self, node: Node) -> str:
        if node.text in _ATOMICS:
            buffer, i = node.parts[0].parts
            return f"wlm_{node.text}_{buffer.text}({self.write(i)}, {self.write(node.parts[1])})"
        return super().call(node)

    def fetch(self, texture: Variable, place: Node) -> str:
        whole = "int4" if texture.type == "sampler2DArray" else "int3"
        return f"{texture.name}.Load({whole}({self.write(place)}, 0))"

    def filtered(self, texture: Variable, place: Node, level: str) -> str:
        return f"{texture.name}.SampleLevel({self.linear}, {self.write(place)}, {level})"

    def graded(self, texture: Variable, place: str, dx: str, dy: str) -> str:
        return f"{texture.name}.SampleGrad({self.linear}, {place}, {dx}, {dy})"

    def size(self, texture: Variable) -> str:
        self._measured.setdefault(texture.name, texture)
        return f"wlm_size_of_{texture.name}()"

    def text(self) -> str:
        self._measured: dict[str, Variable] = {}
        text = super().text()
        for texture in self._measured.values():
            declared = f"{_TEXTURES[texture.type]} {texture.name};\n"
            text = text.replace(declared, declared + _SIZE.format(name=texture.name), 1)
        for name, helper in (("wlm_pack_halves(", _PACK), ("wlm_halves(", _HALVES)):
            text = f"{helper}\n{text}" if name in text else text
        return text
