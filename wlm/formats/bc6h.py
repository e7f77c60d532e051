"""The layout of unsigned BC6H blocks of all fourteen modes.

A block of 128 bits stores 4 x 4 texels of RGB half floats: one line in colour space, or two lines and the number of the
partition that assigns texels to them. From the lowest bit, a block contains the mode's number; the endpoints w and x of
the first line, y and z of the second, in a bit order that depends on the mode; the partition's number; the indices.
Most modes store x, y and z as differences to w. The index of a line's anchor texel (texel 0 for the first line) has one
bit less.

Khronos' Data Format Specification 1.3, chapter 20.2 ("BC6H"), specifies the format.
"""

import numpy as np

from wlm.formats.bc7 import ANCHORS, PARTITIONS

# For each mode, from the format's mode 1 to mode 14: its number; bits of w; bits of the others' red, green and blue;
# and the fields after the number, from the lowest bit. "rw0-9" is bits 0 to 9 of w's red, "rw15-10" is bits 15 down to
# 10.
_WX = "rw0-9 gw0-9 bw0-9"
_MODES = [
    ([int(word, 0) for word in mode.split()[:5]], mode.split()[5:])
    for mode in f"""
0x00 10 5 5 5 gy4 by4 bz4 {_WX} rx0-4 gz4 gy0-3 gx0-4 bz0 gz0-3 bx0-4 bz1 by0-3 ry0-4 bz2 rz0-4 bz3;
0x01 7 6 6 6 gy5 gz4 gz5 rw0-6 bz0 bz1 by4 gw0-6 by5 bz2 gy4 bw0-6 bz3 bz5 bz4 rx0-5 gy0-3 gx0-5 gz0-3 bx0-5 by0-3 ry0-5
rz0-5;
0x02 11 5 4 4 {_WX} rx0-4 rw10 gy0-3 gx0-3 gw10 bz0 gz0-3 bx0-3 bw10 bz1 by0-3 ry0-4 bz2 rz0-4 bz3;
0x06 11 4 5 4 {_WX} rx0-3 rw10 gz4 gy0-3 gx0-4 gw10 gz0-3 bx0-3 bw10 bz1 by0-3 ry0-3 bz0 bz2 rz0-3 gy4 bz3;
0x0A 11 4 4 5 {_WX} rx0-3 rw10 by4 gy0-3 gx0-3 gw10 bz0 gz0-3 bx0-4 bw10 by0-3 ry0-3 bz1 bz2 rz0-3 bz4 bz3;
0x0E 9 5 5 5 rw0-8 by4 gw0-8 gy4 bw0-8 bz4 rx0-4 gz4 gy0-3 gx0-4 bz0 gz0-3 bx0-4 bz1 by0-3 ry0-4 bz2 rz0-4 bz3;
0x12 8 6 5 5 rw0-7 gz4 by4 gw0-7 bz2 gy4 bw0-7 bz3 bz4 rx0-5 gy0-3 gx0-4 bz0 gz0-3 bx0-4 bz1 by0-3 ry0-5 rz0-5;
0x16 8 5 6 5 rw0-7 bz0 by4 gw0-7 gy5 gy4 bw0-7 gz5 bz4 rx0-4 gz4 gy0-3 gx0-5 gz0-3 bx0-4 bz1 by0-3 ry0-4 bz2 rz0-4 bz3;
0x1A 8 5 5 6 rw0-7 bz1 by4 gw0-7 by5 gy4 bw0-7 bz5 bz4 rx0-4 gz4 gy0-3 gx0-4 bz0 gz0-3 bx0-5 by0-3 ry0-4 bz2 rz0-4 bz3;
0x1E 6 6 6 6 rw0-5 gz4 bz0 bz1 by4 gw0-5 gy5 by5 bz2 gy4 bw0-5 gz5 bz3 bz5 bz4 rx0-5 gy0-3 gx0-5 gz0-3 bx0-5 by0-3 ry0-5
rz0-5;
0x03 10 10 10 10 {_WX} rx0-9 gx0-9 bx0-9;
0x07 11 9 9 9 {_WX} rx0-8 rw10 gx0-8 gw10 bx0-8 bw10;
0x0B 12 8 8 8 {_WX} rx0-7 rw11-10 gx0-7 gw11-10 bx0-7 bw11-10;
0x0F 16 4 4 4 {_WX} rx0-3 rw15-10 gx0-3 gw15-10 bx0-3 bw15-10""".split(";")
]

_TWO_LINES = 10  # modes before this one have two lines
_PARTITION = 12  # the number of the partition's field


def _fields(tokens: list[str]) -> list[int]:
    """Parses the order of a mode's bits, such as "rw0-9 gx4", to numbers: 16 times the field, plus the bit in it."""
    codes = []
    for token in tokens:
        field = 4 * "rgb".index(token[0]) + "wxyz".index(token[1])
        first, _, last = token[2:].partition("-")
        first, last = int(first), int(last or first)
        step = 1 if last >= first else -1
        codes += [field << 4 | bit for bit in range(first, last + step, step)]
    return codes


def _layout() -> np.ndarray:
    layout = np.full((len(_MODES), 82), -1, np.int32)
    for row, ((number, *_), tokens) in enumerate(_MODES):
        codes = _fields(tokens)
        if row < _TWO_LINES:
            codes += [_PARTITION << 4 | bit for bit in range(5)]
        begin = 2 if number < 2 else 5
        layout[row, begin : begin + len(codes)] = codes
    return layout


TABLES = {
    "modes": np.array([[n, 2 if n < 2 else 5, n not in (0x03, 0x1E), *bits] for (n, *bits), _ in _MODES], np.int32),
    "layout": _layout(),
    "masks": np.array([sum((int(word) >> 2 * i & 1) << i for i in range(16)) for word in PARTITIONS[1, :32]], np.int32),
    "anchors": np.ascontiguousarray(ANCHORS[1, :32, 0]),
}
"""The tables of `wlm_kernels.bc6h.Tables`, int32, by name."""
