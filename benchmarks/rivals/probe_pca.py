"""Affine subspaces for parts of a probe set: how the set is divided, and what is stored.

A probe y in part c is the part's mean plus a weighted sum of its basis vectors, y ~ m_c + sum_j w_j b_cj. The methods
of the PCA family of gaussian-probe-compression, section 5.1, differ only in how they divide the set. For N probes of D
numbers, with K basis vectors for each of C parts, this is stored, in this order and little-endian:

====================  =====================================================================================
part                  content
====================  =====================================================================================
header                kind of the partition, bits of a weight (0: half float), D, K, C, scale (float32)
partition             nothing (one part); the centres (uint16 [C, 3] over the box);
                      or each probe's part in ceil(log2 C) bits
means, bases          float16 [C, D] and [C, K, D], in units of the scale
lowest, highest       float16 [C, K, 2], only with weights in bits
weights               [N, K], float16 or in bits
====================  =====================================================================================

An engine has the positions anyway, so parts that follow from them need no index for each probe. Values are divided by
the largest magnitude among them first: no half float overflows, and values near 1e-6 keep their digits.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError

HEADER = struct.Struct("<BBHHIf")
HALF_MAX = 65504.0
# How a decoder finds the parts.
WHOLE, PLACE, SIGNAL = range(3)
_CENTRE_LEVELS = 65535
# Cells along the longest side of the box, at most: three such numbers fit into one 64-bit key.
MAX_CELLS = 1 << 20
_PLACE_ROUNDS = 30
_SIGNAL_ROUNDS = 12
# A round that lowers the error by less than this share is the last.
_SETTLED = 1e-3
# Numbers at once in a comparison of probes with all parts: 32 MiB, whatever the set's size.
_CHUNK = 1 << 22


@dataclass(frozen=True, eq=False)
class Partition:
    """Probes divided into parts, none of them empty.

    Attributes:
        kind: How a decoder finds the parts.
        label: int64 [N], the part of each probe, from 0.
        count: C, the number of parts.
        stored: Bytes that a decoder needs to find the parts, besides the positions.
    """

    kind: int
    label: np.ndarray
    count: int
    stored: bytes

    @property
    def members(self) -> list[np.ndarray]:
        """The indices of the probes of each part, in ascending order."""
        return _members(self.label, self.count)


def whole(position: np.ndarray) -> Partition:
    """Returns a partition with all probes in one part."""
    return Partition(WHOLE, np.zeros(len(position), np.int64), 1, b"")


def by_place(position: np.ndarray, clusters: int, seed: int) -> Partition:
    """Divides probes by k-means on the positions (gaussian-probe-compression, section 5.1).

    Args:
        position: float64 [N, 3].
        clusters: Largest number of parts. There are fewer if fewer positions are distinct, or if no probe is nearest
            to a stored centre.
        seed: Seed of the initial centres.
    """
    low, extent = position.min(0), extent_of(position)
    points = (position - low) / extent
    centre = _seeds(points, clusters, np.random.default_rng(seed))
    label = cKDTree(centre).query(points)[1]
    for _ in range(_PLACE_ROUNDS):
        label, count = compact(label)
        centre = _sums(points, label, count) / np.bincount(label, minlength=count)[:, None]
        before, label = label, cKDTree(centre).query(points)[1]
        if np.array_equal(before, label):
            break
    # The parts are those of the centres as stored, and a centre that nobody is nearest to changes no part.
    code = np.rint(centre * _CENTRE_LEVELS).astype("<u2")
    label = _nearest(position, code)
    used = np.unique(label)
    return Partition(PLACE, np.searchsorted(used, label), len(used), code[used].tobytes())


def by_signal(values: np.ndarray, clusters: int, components: int, seed: int) -> Partition:
    """Divides probes by clustered PCA (Sloan et al. 2003): each probe has the affine subspace of least error.

    It is Lloyd's iteration with subspaces in place of centres, first without basis vectors, which is k-means on the
    values, then with all basis vectors. A part that loses all its probes is dropped.

    Args:
        values: D numbers of each probe, float64 [N, D].
        clusters: Largest number of parts; there are fewer if fewer probes are distinct.
        components: K, number of basis vectors of a subspace.
        seed: Seed of the initial centres.
    """
    values = values / scale_of(values)
    centre = _seeds(values, clusters, np.random.default_rng(seed))
    label, _ = _closest(values, centre, np.empty((len(centre), 0, values.shape[1])))
    for rank in (0, components):
        error = np.inf
        for _ in range(_SIGNAL_ROUNDS):
            label, count = compact(label)
            mean, basis = fit_subspaces(values, _members(label, count), rank)
            label, now = _closest(values, mean, basis)
            if now >= error * (1.0 - _SETTLED):
                break
            error = now
    label, count = compact(label)
    return Partition(SIGNAL, label, count, _pack_numbers(label, _index_bits(count)))


def fit_subspaces(values: np.ndarray, members: Sequence[np.ndarray], components: int) -> tuple[np.ndarray, np.ndarray]:
    """Computes the mean and the principal directions of each part.

    Args:
        values: D numbers of each probe, float64 [N, D].
        members: For each of C parts the indices of its probes, at least one; parts may share probes.
        components: K, the number of directions of a part, 0 to D.

    Returns:
        float64 [C, D] means and [C, K, D] orthonormal directions, those of the largest variance first. A part
        without enough variance gets arbitrary further directions.
    """
    width = values.shape[1]
    mean = np.empty((len(members), width))
    basis = np.empty((len(members), components, width))
    for part, probes in enumerate(members):
        mean[part] = values[probes].mean(0)
        if components:
            centred = values[probes] - mean[part]
            # Ascending eigenvalues, and a whole orthonormal set even of a matrix of zeros.
            basis[part] = np.linalg.eigh(centred.T @ centred)[1].T[::-1][:components]
    return mean, basis


def encode(values: np.ndarray, partition: Partition, components: int, bits: int | None) -> bytes:
    """Fits the subspaces of all parts and packs them.

    Args:
        values: D numbers of each probe, float64 [N, D].
        partition: Partition of the N probes.
        components: K, the number of basis vectors of a part, 1 to D.
        bits: Bits of a weight, 1 to 16, over the range of each part and component; None for half floats.

    Returns:
        The bytes, in the layout that the module's docstring describes.
    """
    scale = scale_of(values)
    values = values / scale
    mean, basis = fit_subspaces(values, partition.members, components)
    mean, basis = mean.astype("<f2"), basis.astype("<f2")
    # Weights are fitted to the subspace as decoded, which compensates the rounding of means and bases.
    inverse = np.linalg.pinv(basis.astype(np.float64))
    weight = np.empty((len(values), components))
    for part, probes in enumerate(partition.members):
        weight[probes] = (values[probes] - mean[part].astype(np.float64)) @ inverse[part]
    weights = write_weights(weight, partition.label, partition.count, bits)
    head = HEADER.pack(partition.kind, bits or 0, values.shape[1], components, partition.count, scale)
    return b"".join((head, partition.stored, mean.tobytes(), basis.tobytes(), weights))


def decode(payload: bytes, position: np.ndarray) -> np.ndarray:
    """Reconstructs the numbers of all probes from their parts' subspaces and weights, the bytes that `encode` returned.

    Args:
        payload: Bytes that `encode` returned.
        position: Positions of the probes that were encoded, float64 [N, 3].

    Returns:
        float32 [N, D].

    Raises:
        WlmError: `payload` does not have the layout, or is of another number of probes.
    """
    probes = len(position)
    try:
        kind, bits, width, components, count, scale = HEADER.unpack_from(payload)
        size = payload_bytes(kind, probes, width, components, count, bits or None)
    except (struct.error, KeyError) as error:
        raise WlmError(f"probes: expected probes compressed by PCA, got {len(payload)} other bytes") from error
    if size != len(payload):
        raise WlmError(f"probes: expected a payload of {size} bytes for {probes} probes, got {len(payload)}")
    start = HEADER.size + _PARTITION_BYTES[kind](probes, count)
    label = _read_partition(kind, payload[HEADER.size : start], position, count)
    mean = np.frombuffer(payload, "<f2", count * width, start).reshape(count, width).astype(np.float32)
    start += mean.size * 2
    basis = np.frombuffer(payload, "<f2", count * components * width, start).reshape(count, components, width)
    start += basis.size * 2
    weight = read_weights(payload[start:], label, count, components, bits or None)
    decoded = mean[label]
    for part, indices in enumerate(_members(label, count)):
        decoded[indices] += weight[indices] @ basis[part].astype(np.float32)
    return rescale(decoded, scale)


def part_count(payload: bytes) -> int:
    """Returns the number of parts in a result of `encode`."""
    return HEADER.unpack_from(payload)[4]


def payload_bytes(kind: int, probes: int, width: int, components: int, count: int, bits: int | None) -> int:
    """Returns how many bytes `encode` makes, for `width` numbers per probe, `count` parts and `bits` per weight."""
    size = HEADER.size + _PARTITION_BYTES[kind](probes, count) + count * (components + 1) * width * 2
    return size + weight_bytes(probes, components, count, bits)


def scale_of(values: np.ndarray) -> float:
    """Returns the largest magnitude of values, rounded to float32; 1 if all values are zero."""
    return float(np.float32(np.abs(values).max())) or 1.0


def rescale(decoded: np.ndarray, scale: float) -> np.ndarray:
    """Multiplies decoded values [N, D] by the scale. The result is float32; values beyond its range are clipped."""
    limit = float(np.finfo(np.float32).max)
    return np.clip(decoded.astype(np.float64) * scale, -limit, limit).astype(np.float32)


def weight_bytes(probes: int, components: int, count: int, bits: int | None) -> int:
    """Returns the number of bytes that `write_weights` makes for N probes with K weights each, in C parts."""
    if bits is None:
        return probes * components * 2
    return count * components * 4 + -(-probes * components * bits // 8)


def write_weights(weight: np.ndarray, label: np.ndarray, count: int, bits: int | None) -> bytes:
    """Packs weights as half floats, or as integers of a few bits after the range of each part and component.

    Args:
        weight: K weights of each probe, float64 [N, K]; clipped to the range of half floats.
        label: Number of each probe's part, int [N].
        count: C, the number of parts.
        bits: Bits of a weight, 1 to 16; None for half floats.

    Returns:
        The packed weights; `weight_bytes` returns their length.
    """
    weight = np.clip(weight, -HALF_MAX, HALF_MAX)
    if bits is None:
        return weight.astype("<f2").tobytes()
    bounds = np.empty((count, 2, weight.shape[1]), "<f2")
    for bound, reduce, outside in ((0, np.minimum, -np.inf), (1, np.maximum, np.inf)):
        edge = np.full((count, weight.shape[1]), -outside)
        reduce.at(edge, label, weight)
        near = edge.astype(np.float16)
        # Rounded outwards: an end that is rounded inwards would cut off the weights there.
        bounds[:, bound] = np.where(reduce(near, edge) == near, near, np.nextafter(near, np.float16(outside)))
    low, step = _levels(bounds, bits)
    # A range of zero has steps of zero, and level 0 is its value.
    level = np.divide(weight - low[label], step[label], out=np.zeros_like(weight), where=step[label] > 0)
    level = np.clip(np.rint(level), 0, 2**bits - 1).astype(np.int64)
    return bounds.tobytes() + _pack_numbers(level, bits)


def read_weights(data: bytes, label: np.ndarray, count: int, components: int, bits: int | None) -> np.ndarray:
    """Unpacks the result of `write_weights` to float32 [N, K]."""
    probes = len(label)
    if bits is None:
        return np.frombuffer(data, "<f2", probes * components).reshape(probes, components).astype(np.float32)
    bounds = np.frombuffer(data, "<f2", count * 2 * components).reshape(count, 2, components)
    level = _read_numbers(data[bounds.nbytes :], probes * components, bits).reshape(probes, components)
    low, step = _levels(bounds, bits)
    return (low[label] + level * step[label]).astype(np.float32)


def _pack_numbers(numbers: np.ndarray, bits: int) -> bytes:
    """Packs integers of `bits` bits each without gaps, the lowest bit first."""
    return np.packbits((numbers[..., None] >> np.arange(bits) & 1).astype(np.uint8), bitorder="little").tobytes()


def _read_numbers(data: bytes, count: int, bits: int) -> np.ndarray:
    """Reads `count` numbers of `bits` bits each, int64."""
    if len(data) != -(-count * bits // 8):
        raise ValueError(f"expected {count} numbers of {bits} bits each, found {len(data)} bytes")
    columns = np.unpackbits(np.frombuffer(data, np.uint8), count=count * bits, bitorder="little").reshape(count, bits)
    return columns @ (1 << np.arange(bits))


_PARTITION_BYTES = {
    WHOLE: lambda probes, count: 0,
    PLACE: lambda probes, count: 6 * count,
    SIGNAL: lambda probes, count: -(-probes * _index_bits(count) // 8),
}


def _read_partition(kind: int, data: bytes, position: np.ndarray, count: int) -> np.ndarray:
    if kind == WHOLE:
        return np.zeros(len(position), np.int64)
    if kind == PLACE:
        return _nearest(position, np.frombuffer(data, "<u2").reshape(count, 3))
    return _read_numbers(data, len(position), _index_bits(count))


def _levels(bounds: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns minimum and quantisation step [C, K] for the bounds [C, 2, K] of C parts and K components."""
    low, high = bounds.astype(np.float64).transpose(1, 0, 2)
    return low, (high - low) / (2**bits - 1)


def _index_bits(count: int) -> int:
    return (count - 1).bit_length()


def extent_of(position: np.ndarray) -> float:
    """Returns the longest side of the box of the probes; 1 if all have one position."""
    return float(np.ptp(position, axis=0).max()) or 1.0


def cell_keys(cell: np.ndarray) -> np.ndarray:
    """Returns one int64 key for each cell [..., 3] of a grid, whose indices are integers from 0 to MAX_CELLS."""
    x, y, z = np.moveaxis(cell.astype(np.int64), -1, 0)
    return (x << 42) | (y << 21) | z


def _members(label: np.ndarray, count: int) -> list[np.ndarray]:
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


def compact(label: np.ndarray) -> tuple[np.ndarray, int]:
    """Renumbers labels from 0 without gaps, in the same order. Returns new labels, int64, and their number."""
    used, compact = np.unique(label, return_inverse=True)
    return compact.astype(np.int64), len(used)


def _nearest(position: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Returns the index of the nearest stored centre for each of N positions, int64 [N]."""
    centre = position.min(0) + code.astype(np.float64) * (extent_of(position) / _CENTRE_LEVELS)
    return cKDTree(centre).query(position)[1].astype(np.int64)


def _sums(values: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(label, column, count) for column in values.T], 1)


def _seeds(points: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Draws initial centres by k-means++: a point's chance grows as its squared distance to the nearest centre."""
    chosen = [points[random.integers(len(points))]]
    distance = np.square(points - chosen[0]).sum(1)
    while len(chosen) < count and distance.sum() > 0.0:
        chosen.append(points[random.choice(len(points), p=distance / distance.sum())])
        distance = np.minimum(distance, np.square(points - chosen[-1]).sum(1))
    return np.array(chosen)


def _closest(values: np.ndarray, mean: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns the index of each value's subspace of least error, int64 [N], and the total squared error."""
    count, rank, width = basis.shape
    flat = basis.reshape(count * rank, width)
    offset = np.einsum("ckd,cd->ck", basis, mean)
    label, total = np.empty(len(values), np.int64), 0.0
    chunk = max(1, _CHUNK // (count * (rank + 1)))
    for start in range(0, len(values), chunk):
        part = values[start : start + chunk]
        inside = (part @ flat.T).reshape(len(part), count, rank) - offset
        away = np.square(part).sum(1)[:, None] - 2.0 * part @ mean.T + np.square(mean).sum(1)
        error = away - np.square(inside).sum(2)
        label[start : start + chunk] = error.argmin(1)
        total += float(np.maximum(error.min(1), 0.0).sum())
    return label, total
