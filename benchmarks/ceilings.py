"""The ceilings of a device, measured: how fast it copies, computes and adds atomically.

Each ceiling is a kernel, or a call of torch, that does hardly anything but one kind of work, at a size that fills the
device. Published peaks are higher: a copy reaches 85 to 93% of the memory's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import warp as wp

from benchmarks.runner import Bench
from wlm.interop import to_warp

wp.set_module_options({"enable_backward": False})

KINDS = {
    "copy": "bytes of memory read and written",
    "L2": "bytes read and written by a copy of arrays that fit the second-level cache; on a CPU the last-level cache",
    "fma": "float32 operations, of which a fused multiply-add is two",
    "tensor": "operations of a matrix product in 16 bits; on a CPU in 32",
    "special": "exponentials in float32",
    "atomics": "atomic additions of float32 to random places in 16 MB",
}
"""The kinds of work, each with what it counts."""

_ROUNDS = wp.constant(256)
_SHORT_ROUNDS = wp.constant(64)
_CHAINS = 8  # independent chains of operations in a thread
_Chains = wp.types.vector(length=_CHAINS, dtype=float)


@wp.kernel
def _fma(out: wp.array1d[float]):
    i = wp.tid()
    x = _Chains(float(i) * 1.0e-9)
    half = _Chains(0.5)
    for _ in range(_ROUNDS):
        x = 0.999 * x + half
    out[i] = wp.dot(x, half)


@wp.kernel
def _special(out: wp.array1d[float]):
    i = wp.tid()
    a = float(i) * 1.0e-9
    b = a + 0.1
    c = a + 0.2
    d = a + 0.3
    for _ in range(_SHORT_ROUNDS):
        a = wp.exp(-a)
        b = wp.exp(-b)
        c = wp.exp(-c)
        d = wp.exp(-d)
    out[i] = a + b + c + d


@wp.kernel
def _atomics(place: wp.array1d[int], out: wp.array1d[float]):
    i = wp.tid()
    wp.atomic_add(out, place[i], 1.0)


@dataclass(frozen=True)
class Ceiling:
    """A measured ceiling: a rate per second of one of `KINDS`, and the milliseconds of the call that measured it."""

    kind: str
    rate: float
    ms: float


def measure_ceilings(bench: Bench) -> dict[str, Ceiling]:
    """Measures all ceilings of the bench's device, by kind."""
    device, cuda = bench.device, bench.device != "cpu"
    bench.note("measuring the ceilings")
    floats, small, side, threads = (1 << 28, 1 << 20, 8192, 1 << 22) if cuda else (1 << 24, 1 << 16, 1024, 1 << 12)
    source, target = torch.zeros(floats, device=device), torch.ones(floats, device=device)
    few, copied = torch.zeros(small, device=device), torch.ones(small, device=device)
    left = torch.randn(side, side, device=device, dtype=torch.float16 if cuda else torch.float32)
    product = torch.empty_like(left)
    out = wp.zeros(threads, dtype=float, device=device)
    generator = torch.Generator().manual_seed(0)
    place = torch.randint(0, 1 << 22, (threads,), generator=generator, dtype=torch.int32).to(device)
    sums = wp.zeros(1 << 22, dtype=float, device=device)

    def launched(kernel: wp.Kernel, *inputs: wp.array) -> Callable[[], None]:
        return lambda: wp.launch(kernel, threads, inputs=[*inputs, out], device=device)

    repeats = 16

    def cached() -> None:
        for _ in range(repeats):
            torch.neg(few, out=copied)

    calls: dict[str, tuple[Callable[[], object], float]] = {
        "copy": (lambda: torch.neg(source, out=target), 8.0 * floats),
        "L2": (cached, 8.0 * small * repeats),
        "fma": (launched(_fma), 2.0 * _CHAINS * 256 * threads),
        "tensor": (lambda: torch.mm(left, left, out=product), 2.0 * side**3),
        "special": (launched(_special), 4.0 * 64 * threads),
        "atomics": (lambda: wp.launch(_atomics, threads, inputs=[to_warp(place), sums], device=device), float(threads)),
    }
    times = bench.time({kind: bench.replay(call) for kind, (call, _) in calls.items()})
    return {
        kind: Ceiling(kind, work / (1e-3 * times[kind].median_ms), times[kind].median_ms)
        for kind, (_, work) in calls.items()
    }
