"""Warp and torch together: devices, arrays, streams and CUDA graphs."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
import warp as wp

from wlm.errors import WlmError

_TENSORS = {
    int: (torch.int32, ()),
    wp.uint8: (torch.uint8, ()),
    float: (torch.float32, ()),
    wp.int64: (torch.int64, ()),
    wp.vec2: (torch.float32, (2,)),
    wp.vec4: (torch.float32, (4,)),
}
"""Warp's types as torch holds them: its own, and the length of its last axis."""


def available_devices() -> list[str]:
    """Lists the devices that both Warp and torch can use: "cpu", then "cuda:0" and so on."""
    count = min(wp.get_cuda_device_count(), torch.cuda.device_count())
    return ["cpu", *(f"cuda:{index}" for index in range(count))]


def check_device(name: str) -> str:
    """Checks that a device exists. It never falls back to another one.

    Args:
        name: "cpu", "cuda" (the first GPU) or "cuda:N".

    Returns:
        The name that Warp and torch both take: "cpu" or "cuda:N".

    Raises:
        WlmError: No such device; the line lists those that there are.
    """
    full_name = "cuda:0" if name == "cuda" else name
    devices = available_devices()
    if full_name not in devices:
        hint = ""
        if full_name.startswith("cuda") and wp.get_cuda_device_count() > torch.cuda.device_count():
            hint = "; Warp sees a GPU that this build of torch does not"
        raise WlmError(f"device '{name}': expected one of: {', '.join(devices)}{hint}")
    return full_name


def device_name(device: torch.device) -> str:
    """The name of a tensor's device as `check_device` returns it and `stream` takes it."""
    return "cpu" if device.type == "cpu" else f"cuda:{device.index or 0}"


def free_memory(device: wp.Device) -> int:
    """Bytes that can be allocated on a device.

    Raises:
        WlmError: The machine doesn't tell.
    """
    if device.is_cuda:
        return device.free_memory
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise WlmError("/proc/meminfo: MemAvailable: expected it, found none")


def to_warp(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """Wraps a tensor as a Warp array, without a copy and without a gradient of its own.

    Wrap once and keep the array: a raw tensor as a launch argument costs three times as much at every launch.
    A gradient buffer is wrapped by a call of its own, `to_warp(tensor.grad)`.

    Args:
        tensor: Any strides; those of the trailing dimensions that a vector or matrix type takes up must be
            contiguous.
        dtype: The Warp type of an element, a vector or matrix type for example; default the tensor's scalar.

    Returns:
        An array that shares the tensor's memory and keeps it alive.

    Raises:
        ValueError: The tensor doesn't fit the type.
    """
    # Wrapping a tensor, unlike all else in Warp, doesn't start it.
    wp.init()
    try:
        return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"tensor {tuple(tensor.shape)} of {tensor.dtype} as {dtype}: {error}") from error


@contextmanager
def stream(device: str) -> Iterator[torch.cuda.Stream | None]:
    """Runs torch and Warp on one CUDA stream inside the block; on the CPU it does nothing.

    The stream isn't the default one, since CUDA can't capture that one in a graph, and it is the same one at
    every use. It waits for what both had queued before the block, and what both queue after the block
    waits for it.

    Args:
        device: As `check_device` returns it.

    Yields:
        The torch stream, or None on the CPU.
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
    with torch.cuda.stream(side), wp.ScopedStream(warp_side, sync_enter=True, sync_exit=True):
        yield side
    outer.wait_stream(side)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keeps the garbage collector off inside the block: in a capture it could free an older graph, which breaks it."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def torch_memory(device: torch.device) -> Callable[[tuple[int, ...], Any], wp.array]:
    """Makes the buffers of kernels, `empty(shape, dtype)`, in torch's memory.

    That may be freed while torch's stream still uses it, and a graph may capture it; Warp's own it may not.
    """

    def empty(shape: tuple[int, ...], dtype: Any) -> wp.array:
        kind, tail = _TENSORS[dtype]
        if 0 in shape:
            return wp.empty(shape, dtype=dtype, device=wp.device_from_torch(device))
        return to_warp(torch.empty((*shape, *tail), dtype=kind, device=device), dtype if tail else None)

    return empty


class StepGraph:
    """A step that runs many times: captured once as a graph and replayed on CUDA, just called on the CPU.

    Each call does the step exactly once on either device. On CUDA the first `warmup` calls run it eagerly,
    which loads Warp's modules and lets torch allocate its workspaces and optimiser state; the next one
    captures it and replays it, and the later ones replay.

    The step takes and returns nothing. It reads and writes tensors that stay in place: what changes between
    steps (a learning rate, a batch) is copied into them beforehand. It must not synchronise, allocate Warp
    arrays or branch on values that lie on the device.

    Args:
        step: The work, in torch and Warp, on `device`.
        device: As `check_device` returns it.
        warmup: How many calls run eagerly first, at least 1.

    Raises:
        ValueError: `warmup` is less than 1.
    """

    def __init__(self, step: Callable[[], None], device: str, warmup: int = 3) -> None:
        if warmup < 1:
            raise ValueError(f"warmup: expected at least 1, got {warmup}")
        self._step = step
        self._device = device
        self._eager_left = warmup
        self._graph: torch.cuda.CUDAGraph | None = None

    @property
    def captured(self) -> bool:
        """Whether later calls replay a graph."""
        return self._graph is not None

    def __call__(self) -> None:
        """Does the step once; on CUDA it is queued, not awaited."""
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
        # torch opens the capture; Warp is told of it, so that it frees nothing in the middle of it. Both use
        # the thread-local mode, which lets other threads (a loader, say) allocate meanwhile.
        with (
            no_collection(),
            torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"),
            wp.ScopedCapture(stream=warp_side, external=True),
        ):
            self._step()
        return graph


@cache
def _side_stream(device: str) -> tuple[torch.cuda.Stream, wp.Stream]:
    """Makes the one side stream of a device, as torch and as Warp know it.

    One for all uses: torch's allocator keeps a pool of memory for every stream.
    """
    # Warp looks a stream's device up in a table that it makes when it starts, and this may be its first call.
    wp.init()
    side = torch.cuda.Stream(device)
    return side, warp_stream(side)


@cache
def warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """A stream of torch as Warp knows it, the same one at every use.

    One for all uses: when a second wrapper of a stream is deleted, Warp forgets the stream and can't capture on it.
    """
    return wp.stream_from_torch(stream)
