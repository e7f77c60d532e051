"""Several hours of probes in files: a compact artifact whose body is the places, and then hour after hour.

The body, with fields as in `wlm.probe.fields`:

==========  ===========================================================================================================
field       content
==========  ===========================================================================================================
flags       U16: 64 times `HOURS`; 1024 and 8192 as there
N, D        as there
source      as there
T           a number of any size
times       F64 x T, increasing
places      as there, or check U32
hours       in an order in which each comes after those that it is predicted from
==========  ===========================================================================================================

An hour:

==========  ===========================================================================================================
number      U8, the place in `times`
references  U8 and as many U8, the hours that it is predicted from
gain        F32, the range of its numbers
flags       U16, as of a file of one hour: those of its head, 2048 and 4096
dead        a bit for each probe that is dead in this hour or in the one before it here, but not in both; as there
step        U16
matrix      where there are references a length, and the numbers of their matrices, coded by themselves
stream      a length, and so many bytes
==========  ===========================================================================================================
"""

import struct
from itertools import pairwise
from typing import Any

import numpy as np

from wlm.formats.artifact import Artifact
from wlm.formats.compact import BODY
from wlm.probe import fields
from wlm.probe.day import REFERENCES, WIDEST, DayModel, Hour, Told, matrix_shape
from wlm.probe.entropy import unpack
from wlm.probe.hours import PERIOD, TIMES
from wlm.probe.model import live_probes
from wlm.probe.transform import step_of

_STATES = 1 << 27  # probes times hours: a byte each tells who is dead
_GAIN = struct.Struct("<f")


def encode_day(model: DayModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file."""
    flags, places = fields.pack_own(np.zeros(0, bool), model.places)
    content = [
        fields.begin_bytes(flags | fields.HOURS << fields.HEAD_SHIFT, model),
        fields.number_bytes(len(model.times)),
    ]
    content += [np.array(model.times, "<f8").tobytes(), places]
    if model.places is None:
        content.append(fields.CHECK.pack(model.check))
    before = np.zeros(model.probes, bool)
    for hour in model.hours:
        dead = ~live_probes(hour.dead, model.probes)
        flags, change = fields.pack_own(dead ^ before, None)
        before = dead
        content += [bytes([hour.number, len(hour.told.references), *hour.told.references]), _GAIN.pack(hour.told.gain)]
        content += [fields.SHORT.pack(fields.head_flags(hour.head) | flags), change, fields.step_bytes(hour.head.step)]
        blocks = [hour.told.packed()] if hour.told.references else []
        for block in (*blocks, hour.stream.tobytes()):
            content += [fields.number_bytes(len(block)), block]
    return {}, {BODY: np.frombuffer(b"".join(content), np.uint8)}, ""


def decode_day(artifact: Artifact) -> DayModel:
    """Makes the model of a file, at its first time; what `encode_day` gave comes back bit for bit, but for the name.

    Raises:
        WlmError, ValueError: The body is damaged.
    """
    body = artifact.tensors[BODY]
    reader = fields.Fields(body)
    flags, probes, outputs, source = reader.begin()
    fields.check_flags(not flags & ~(fields.HOURS << fields.HEAD_SHIFT | fields.OUTPUTS | fields.PLACED), flags)
    count = reader.number("hours", TIMES)
    if probes * count > _STATES:
        raise ValueError(f"part {BODY}: expected at most {_STATES // probes} hours of {probes} probes, found {count}")
    fields.check_numbers(probes, outputs * count, len(body))
    times = tuple(np.frombuffer(reader.take(8 * count).tobytes(), "<f8").tolist())
    if not all(0.0 <= time < PERIOD for time in times) or any(a >= b for a, b in pairwise(times)):
        raise ValueError(f"part hours: expected increasing times of day, from 0 to below {PERIOD:g}")
    _, places = reader.own(flags, probes)
    check = reader.check(places)
    hours: list[Hour] = []
    for _ in times:
        hours.append(_read_hour(reader, hours, count, probes, outputs, check))
    if len(rest := reader.rest()):
        raise ValueError(f"part hours: expected {len(body) - len(rest)} bytes, found {len(body)}")
    fields.check_counts(probes, outputs, [hour.dead for hour in hours], len(body))
    model = DayModel(fields.name_of(artifact), source, probes, outputs, places, times, tuple(hours), times[0])
    if places is not None:
        # What can be unpacked here is, so that whatever is wrong with it is said of the file.
        for time in times:
            _ = model.at(time).stored_values
    return model


def _read_hour(reader: fields.Fields, hours: list[Hour], count: int, probes: int, outputs: int, check: int) -> Hour:
    """The hour that follows those that are read, of so many."""
    number, told = reader.take(2).tolist()
    references = tuple(reader.take(told).tolist())
    known = {hour.number for hour in hours}
    if number >= count or number in known or not known.issuperset(references) or len(set(references)) != told:
        raise ValueError(f"part hours: expected each hour once, and after those it is predicted from, at {number}")
    if told > (REFERENCES if outputs <= WIDEST else 0):
        raise ValueError(f"part hours: expected at most {REFERENCES} references, found {told}")
    gain = reader.fields(_GAIN)[0]
    if not 0.0 < gain < np.inf:
        raise ValueError(f"part hours: expected a positive gain, found {gain:g}")
    flags = reader.fields(fields.SHORT)[0]
    fields.check_flags(
        not flags & (fields.OUTPUTS | fields.PLACED) and flags & (fields.DEAD | fields.DEFLATED) != fields.DEFLATED,
        flags,
    )
    change, _ = reader.own(flags, probes)
    dead = hours[-1].dead if hours else np.zeros(0, bool)
    if change.size:
        dead = change ^ dead if dead.size else change
        dead = dead if dead.any() else np.zeros(0, bool)
    head = fields.head_of(flags, step_of(reader.fields(fields.SHORT)[0]), check)
    matrix = np.zeros((0, outputs), np.int64)
    if told:
        try:
            (matrix,) = unpack(reader.block().tobytes(), matrix_shape(told, outputs))
        except ValueError as error:
            raise ValueError(f"part hours: {error}") from error
    stream = reader.block()
    return Hour(number, Told(references, gain, matrix), dead, head.checked(outputs, len(stream)), stream)
