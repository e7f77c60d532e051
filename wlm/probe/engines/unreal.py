"""Exports light to Unreal, packed like the bricks of its volumetric lightmap: 28 bytes per probe.

A texel of a brick has the ambient colour, the coefficient L00, as R11G11B10F, and the other 8 coefficients in 8 bits,
divided by the ambient colour and by the largest ratio that light can have to it. Coefficients 1 to 4 and 5 to 8 of red,
green and blue are in six RGBA textures (VolumetricLightmapShared.ush, without sky occlusion and shadowing). Only Unreal
itself can build such bricks, so the export has seven volume textures over a lattice, and functions for materials that
read them.
"""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.probe.conventions import from_canonical
from wlm.probe.engines.lattice import Lattice, lattice_kit

AMBIENT_FILE = "ambient.dds"
SH_FILES = tuple(f"sh{number}.dds" for number in range(6))
_MOST_CELLS = 128
_AMBIENT, _RATIOS = "R11G11B10_FLOAT", "R8G8B8A8_UNORM"

# Ranges of coefficients 1 to 8 over the ambient one, as in the engine: sqrt(3) for L1, the bound for non-negative
# light, and twice the bound for L2.
RANGE = np.sqrt([3.0, 3.0, 3.0, 15.0, 15.0, 20.0, 15.0, 15.0])
# Largest finite numbers with 6, 6 and 5 bits of mantissa and half float's exponent.
_PACKED_MAX = np.array([65024.0, 65024.0, 64512.0])
# Low bits of a half float's mantissa that R11G11B10F drops.
_DROPPED = np.array([4, 4, 5], np.uint32)
_SHIFT = np.array([0, 11, 22], np.uint32)

_ABOUT = (
    "ambient.dds and sh0.dds to sh5.dds are volume textures of one size, with a probe at the centre of each texel, x "
    "along rows, then y, then z. ambient has the first coefficient of radiance; the others are ratios to it and to "
    "their ranges, 1 to 4 and 5 to 8 of red, of green and of blue, with Unreal's signs, in the axes and the unit of "
    "the scene. WlmProbes.usf explains how to read them; box has the two corners of the lattice."
)

_SHADER = """\
// Light of probes for Unreal, in the packing of its volumetric lightmaps.
//
// 1. Import ambient.dds and sh0.dds to sh5.dds as volume textures: sRGB off, no compression (ambient as half floats),
//    no mips, clamped, bilinear filter.
// 2. Put this file into a folder of shaders that the project maps (AddShaderSourceDirectoryMapping("/Wlm", ...)), and
//    "/Wlm/WlmProbes.usf" under Include File Paths of a material's Custom node, with the inputs Ambient, Sh0 to Sh5
//    (texture objects), Position and Normal, and this code:
//
//        return WlmProbeDiffuse(Ambient, Sh0, Sh1, Sh2, Sh3, Sh4, Sh5, AmbientSampler, Position, Normal);
//
// Position and Normal are in the axes and the unit of the probes. In a scene that came in as glTF, with y up and in
// metres, they are Absolute World Position's xzy / 100 and the world normal's xzy.

static const float3 WlmCorner = float3(@CORNER@);
static const float3 WlmSize = float3(@SIZE@);

// Coefficients of radiance, orthonormal, in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2 and with the signs of
// FSHVector3: y, x, yz and xz have a minus.
void WlmProbeSh(Texture3D ambient, Texture3D sh0, Texture3D sh1, Texture3D sh2, Texture3D sh3, Texture3D sh4,
                Texture3D sh5, SamplerState state, float3 position, out float3 sh[9])
{
    float3 uvw = (position - WlmCorner) / WlmSize;
    float4 low = float4(1.7320508, 1.7320508, 1.7320508, 3.8729833);
    float4 high = float4(3.8729833, 4.4721360, 3.8729833, 3.8729833);
    float3 mean = ambient.SampleLevel(state, uvw, 0).xyz;
    float4 r0 = (sh0.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * low * mean.x;
    float4 r1 = (sh1.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * high * mean.x;
    float4 g0 = (sh2.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * low * mean.y;
    float4 g1 = (sh3.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * high * mean.y;
    float4 b0 = (sh4.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * low * mean.z;
    float4 b1 = (sh5.SampleLevel(state, uvw, 0) * 2.0 - 1.0) * high * mean.z;
    sh[0] = mean;
    sh[1] = float3(r0.x, g0.x, b0.x);
    sh[2] = float3(r0.y, g0.y, b0.y);
    sh[3] = float3(r0.z, g0.z, b0.z);
    sh[4] = float3(r0.w, g0.w, b0.w);
    sh[5] = float3(r1.x, g1.x, b1.x);
    sh[6] = float3(r1.y, g1.y, b1.y);
    sh[7] = float3(r1.z, g1.z, b1.z);
    sh[8] = float3(r1.w, g1.w, b1.w);
}

// The radiance of a white diffuse surface with a unit normal: irradiance over pi.
float3 WlmProbeDiffuse(Texture3D ambient, Texture3D sh0, Texture3D sh1, Texture3D sh2, Texture3D sh3, Texture3D sh4,
                       Texture3D sh5, SamplerState state, float3 position, float3 normal)
{
    float3 sh[9];
    WlmProbeSh(ambient, sh0, sh1, sh2, sh3, sh4, sh5, state, position, sh);
    float x = normal.x;
    float y = normal.y;
    float z = normal.z;
    float3 light = sh[0] * 0.2820948;
    light += (sh[2] * z - sh[1] * y - sh[3] * x) * 0.3257350;
    light += (sh[4] * (x * y) - sh[5] * (y * z) - sh[7] * (x * z)) * 0.2731371;
    light += sh[6] * (0.0788479 * (3.0 * z * z - 1.0)) + sh[8] * (0.1365686 * (x * x - y * y));
    return max(light, float3(0.0, 0.0, 0.0));
}
"""


def _write(folder: Path, lattice: Lattice, values: np.ndarray) -> dict[str, Any]:
    """Writes seven volume textures in Unreal's packing, and a reader, `WlmProbes.usf`.

    A coefficient beyond the bound of non-negative light is clamped, and a negative ambient colour becomes 0.
    """
    corner, size = lattice.low, lattice.count * lattice.size
    sh = from_canonical(values.reshape(-1, 9, 3).astype(np.float64), "unreal")
    if not np.abs(sh[:, 0]).max() <= _PACKED_MAX.min():
        found = np.abs(sh[:, 0]).max()
        raise WlmError(
            f"{lattice.name}: expected light within {_PACKED_MAX.min():g}, as R11G11B10F holds, got {found:.3g}"
        )
    width, height, depth = (int(count) for count in lattice.count)
    ambient, level = packed(sh)
    ratios = level.reshape(-1, 6, 4)  # of each colour coefficients 1 to 4, then 5 to 8
    textures = {AMBIENT_FILE: (ambient, _AMBIENT)}
    textures |= {name: (np.ascontiguousarray(ratios[:, i]), _RATIOS) for i, name in enumerate(SH_FILES)}
    for name, (texels, form) in textures.items():
        write_dds(folder / name, texels.tobytes(), width, height, form, depth)
    text = _SHADER
    for mark, numbers in (("@CORNER@", corner), ("@SIZE@", size)):
        text = text.replace(mark, ", ".join(f"{number:.9e}" for number in numbers))
    (folder / "WlmProbes.usf").write_text(text, encoding="utf-8")
    return {"box": [corner.tolist(), (corner + size).tolist()]}


write_kit = lattice_kit("wlm-unreal-light", "light.json", _ABOUT, _MOST_CELLS, _write)


def packed(sh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Packs coefficients, float64 [N, C, 3], to ambient colours, uint32 [N], and ratios, uint8 [N, 3, C - 1]."""
    colour = np.clip(sh[:, 0], 0.0, _PACKED_MAX)
    step = np.exp2(np.maximum(np.frexp(colour)[1] - 1, -14) - 10.0 + _DROPPED)
    code = (np.rint(colour / step) * step).astype(np.float16).view(np.uint16).astype(np.uint32) >> _DROPPED
    ambient = np.bitwise_or.reduce(code << _SHIFT, axis=1).astype("<u4")
    others = sh[:, 1:].transpose(0, 2, 1)
    # Ratios to the decoded ambient colour are more exact, at no cost.
    unit = ambient_colour(ambient)[:, :, None] * RANGE[: others.shape[2]]
    ratio = np.divide(others, unit, out=np.zeros_like(others), where=unit > 0.0)
    return ambient, np.rint((np.clip(ratio, -1.0, 1.0) * 0.5 + 0.5) * 255.0).astype(np.uint8)


def ambient_colour(code: np.ndarray) -> np.ndarray:
    """Converts packed R11G11B10F colours to float64 [N, 3]."""
    part = (code[:, None] >> _SHIFT) & ((1 << (15 - _DROPPED)) - 1)
    return (part << _DROPPED).astype(np.uint16).view(np.float16).astype(np.float64)
