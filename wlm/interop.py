"""Interoperation of Warp and torch: devices, arrays, streams and CUDA graphs."""

import gc
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
import warp as wp

from wlm.errors import WlmError

alone = threading.RLock()
"""To be held while kernels are loaded or launched for the first time and while a graph is captured: Warp's tables of
kernels and captures are not made for several threads."""

_TENSORS = {
    int: (torch.int32, ()),
    wp.uint8: (torch.uint8, ()),
    float: (torch.float32, ()),
    wp.int64: (torch.int64, ()),
    wp.float16: (torch.float16, ()),
    wp.vec2: (torch.float32, (2,)),
    wp.vec4: (torch.float32, (4,)),
}
"""Torch representation of Warp types: the torch type and the length of the last axis."""


def available_devices() -> list[str]:
    """Lists the devices that both Warp and torch can use: "cpu", then "cuda:0" and so on."""
    count = min(wp.get_cuda_device_count(), torch.cuda.device_count())
    return ["cpu", *(f"cuda:{index}" for index in range(count))]


def check_device(name: str) -> str:
    """Checks that the device "cpu", "cuda" (the first GPU) or "cuda:N" exists, without falling back to another one.
    Returns the name that both Warp and torch accept: "cpu" or "cuda:N"."""
    full_name = "cuda:0" if name == "cuda" else name
    devices = available_devices()
    if full_name not in devices:
        hint = ""
        if full_name.startswith("cuda") and wp.get_cuda_device_count() > torch.cuda.device_count():
            hint = "; Warp sees a GPU that this build of torch does not"
        raise WlmError(f"device '{name}': expected one of: {', '.join(devices)}{hint}")
    return full_name


def device_name(device: torch.device) -> str:
    """Returns the name of a tensor's device, "cpu" or "cuda:N", which Warp accepts too."""
    return "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"


def moved(value: Any, device: str | torch.device) -> Any:
    """Returns a copy of a dataclass with its tensors on a device."""
    parts = ((each.name, getattr(value, each.name)) for each in fields(value))
    return replace(value, **{name: part.to(device) for name, part in parts if isinstance(part, torch.Tensor)})


def free_memory(device: wp.Device) -> int:
    """Returns the number of bytes that can be allocated on a device."""
    if device.is_cuda:
        return device.free_memory
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise WlmError("/proc/meminfo: expected an entry MemAvailable, found none")


@contextmanager
def one_thread(device: str = "cpu") -> Iterator[None]:
    """Limits torch to one thread on the CPU. Short calls of torch take up to ten times as long with a second thread on
    a busy machine, and threads that call torch side by side need no others."""
    threads = torch.get_num_threads()
    try:
        if device == "cpu":
            torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(threads)


def to_warp(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """Wraps a tensor as a Warp array, without a copy and without a gradient array; it keeps the tensor's memory alive.

    Wrap once and keep the array: a raw tensor as a launch argument makes every launch three times as expensive. A
    gradient buffer is wrapped by a separate call, `to_warp(tensor.grad)`. The tensor may have any strides, but trailing
    dimensions that become a vector or matrix, by the Warp type `dtype` of an element, must be contiguous.
    """
    # Wrapping a tensor doesn't initialise Warp, unlike every other call.
    wp.init()
    try:
        return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
    except (RuntimeError, TypeError) as error:
        text = f"tensor {tuple(tensor.shape)} of {tensor.dtype}"
        if "data pointer" in str(error) or "Batching rule" in str(error):
            text += ": expected one with memory, which torch.export, vmap and batched gradients do not pass"
            raise ValueError(text) from error
        raise ValueError(f"cannot use a {text} as {dtype}: {error}") from error


@contextmanager
def stream(device: str) -> Iterator[torch.cuda.Stream | None]:
    """Runs torch and Warp on one CUDA stream inside the block, and yields the torch stream; does nothing on the CPU.

    The stream isn't the default stream, which CUDA can't capture in a graph, and it is the same one at every use. It
    waits for the work that both libraries queued before the block, and work that they queue after the block waits for
    it.
    """
    if device == "cpu":
        yield None
        return
    side, warp_side = _side_stream(device)
    outer = torch.cuda.current_stream(device)
    if outer == side:
        # Already inside, perhaps within a capture, where waiting for another stream is an error.
        yield side
        return
    side.wait_stream(outer)
    with torch.cuda.stream(side), launch_on(warp_side, sync=True):
        yield side
    outer.wait_stream(side)


@contextmanager
def launch_on(stream: wp.Stream, sync: bool = False) -> Iterator[None]:
    """Runs Warp's work for a stream's device on the stream; with `sync` both the stream and the one before wait for the
    work of the other. Unlike `wp.ScopedStream` it does not change Warp's default device, which all threads share."""
    device, before = stream.device, stream.device.stream
    device.set_stream(stream, sync)
    try:
        yield
    finally:
        device.set_stream(before, sync)


@contextmanager
def no_collection() -> Iterator[None]:
    """Disables garbage collection inside the block, in which a graph is captured, `alone`: freeing an older graph would
    invalidate a running capture."""
    with alone:
        collecting = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if collecting:
                gc.enable()


def torch_memory(device: torch.device) -> Callable[[tuple[int, ...], Any], wp.array]:
    """Returns an allocator for kernel buffers, `empty(shape, dtype)`, that uses torch's memory. Unlike Warp's memory,
    it may be freed while torch's stream still uses it, and a graph may capture it."""

    def empty(shape: tuple[int, ...], dtype: Any) -> wp.array:
        kind, tail = _TENSORS[dtype]
        if 0 in shape:
            return wp.empty(shape, dtype=dtype, device=wp.device_from_torch(device))
        return to_warp(torch.empty((*shape, *tail), dtype=kind, device=device), dtype if tail else None)

    return empty


class StepGraph:
    """A repeated step: captured once as a graph and replayed on CUDA, called directly on the CPU.

    Each call executes the step exactly once on either device. On CUDA the first `warmup` calls run it eagerly,
    which loads Warp's modules and lets torch allocate its workspaces and optimiser state; the next one
    captures it and replays it, and the later ones replay.

    The step has no arguments and no result. It reads and writes tensors at fixed addresses: values that change
    between steps (a learning rate, a batch) are copied into them beforehand. It must not synchronise, allocate Warp
    arrays or branch on values in device memory.

    Args:
        step: The work, in torch and Warp, on `device`.
        device: A result of `check_device`.
        warmup: Number of eager calls before the capture, at least 1.
    """

    def __init__(self, step: Callable[[], None], device: str, warmup: int = 3) -> None:
        if warmup < 1:
            raise ValueError(f"warmup: expected at least 1, got {warmup}")
        self._step = step
        self._device = device
        self._eager_left = warmup
        self._graph: torch.cuda.CUDAGraph | None = None
        self._launches: wp.Graph | None = None

    @property
    def captured(self) -> bool:
        """Whether the step has been captured, so that further calls replay a graph."""
        return self._graph is not None

    def __call__(self) -> None:
        """Executes the step once; on CUDA it is queued and the call returns immediately."""
        if self._device == "cpu":
            self._step()
            return
        with stream(self._device) as side:
            if self._graph is None and self._eager_left > 0:
                self._eager_left -= 1
                self._step()
                return
            if self._graph is None:
                self._graph = self._capture(side)
            self._graph.replay()

    def _capture(self, side: torch.cuda.Stream) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        warp_side = _side_stream(self._device)[1]
        # torch starts the capture and Warp is notified, so that it frees no memory during it. Both use
        # the thread-local mode, which lets other threads (a loader, say) allocate meanwhile.
        with (
            no_collection(),
            torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
            wp.ScopedCapture(stream=warp_side, external=True),
        ):
            self._step()
        return graph


class LaunchGraph(StepGraph):
    """A repeated step of Warp launches without torch. It runs on Warp's current stream: to change streams, as `stream`
    does, takes longer than many a step."""

    def __call__(self) -> None:
        """Executes the step once; on CUDA it is queued and the call returns immediately."""
        if self._device == "cpu" or self._eager_left > 0:
            self._eager_left -= 1
            self._step()
            return
        if self._launches is None:
            self.capture()
        wp.capture_launch(self._launches)

    def capture(self) -> None:
        """Captures the step on CUDA, before its first call, which then replays it; its modules must be loaded."""
        if self._device != "cpu":
            with no_collection(), wp.ScopedCapture(self._device, force_module_load=False) as capture:
                self._step()
            self._launches, self._eager_left = capture.graph, 0


def fork(device: str, works: Sequence[Callable[[], None]]) -> None:
    """Runs works that do not depend on each other, inside `stream`: on CUDA each on a stream of its own, so that they
    may overlap, also within a graph. What is queued afterwards waits for all of them."""
    if len(works) == 1 or device == "cpu":
        for work in works:
            work()
        return
    outer = torch.cuda.current_stream(device)
    branches = [_side_stream(device, 1 + number) for number in range(len(works))]
    for work, (side, warp_side) in zip(works, branches, strict=True):
        side.wait_stream(outer)
        with torch.cuda.stream(side), launch_on(warp_side):
            work()
    for side, _ in branches:
        outer.wait_stream(side)


@cache
def _side_stream(device: str, number: int = 0) -> tuple[torch.cuda.Stream, wp.Stream]:
    """Creates (once) a stream of a device for graphs; torch's allocator keeps separate memory for every stream."""
    # Warp looks up a stream's device in a table created at initialisation, and this may be the first Warp call.
    wp.init()
    side = torch.cuda.Stream(device)
    return side, warp_stream(side)


@cache
def warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """Returns the Warp object of a torch stream, the same object at every use: if a second object were deleted, Warp
    would forget the stream and could not capture a graph on it."""
    return wp.stream_from_torch(stream)
