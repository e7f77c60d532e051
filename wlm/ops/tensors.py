"""What all operations share: the checks of their tensors, torch's stream, and buffers for gradients."""

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp

from wlm.interop import to_warp, warp_stream

Shape = tuple[int | None, ...]
"""Sizes of a tensor's axes; None: any."""


def check(name: str, tensor: torch.Tensor, shape: Shape, device: torch.device | None = None) -> None:
    """Checks a float32 tensor.

    Args:
        name: What the message calls it.
        tensor: On `device`, or on any that Warp has.
        shape: Its sizes.
        device: Where it has to be.

    Raises:
        ValueError: Its shape, type or device doesn't fit.
    """
    if tensor.dtype != torch.float32 or not _fits(tensor, shape):
        raise ValueError(f"{name}: expected float32 {_text(shape)}, got {tensor.dtype} {tuple(tensor.shape)}")
    _check_device(name, tensor, device)


def check_index(name: str, index: torch.Tensor, count: int, shape: Shape, device: torch.device) -> None:
    """Checks an integer tensor of numbers from 0 to `count` - 1; the numbers not while a CUDA graph is captured.

    Raises:
        ValueError: Its shape, type, device or a number doesn't fit.
    """
    if index.dtype not in (torch.int32, torch.int64) or not _fits(index, shape):
        raise ValueError(f"{name}: expected int32 or int64 {_text(shape)}, got {index.dtype} {tuple(index.shape)}")
    _check_device(name, index, device)
    if index.numel() and not _capturing(index):
        low, high = torch.stack(index.aminmax()).tolist()
        if low < 0 or high >= count:
            raise ValueError(f"{name}: expected numbers from 0 to {count - 1}, found {low if low < 0 else high}")


def check_finite(ranges: dict[str, tuple[float, float]] | None = None, **tensors: torch.Tensor | None) -> None:
    """Checks that tensors of one device hold finite numbers; not while a CUDA graph is captured.

    Args:
        ranges: The least and the greatest number that some may hold.
        **tensors: By the names that the message calls them; None and empty ones are left out.

    Raises:
        ValueError: A number isn't finite or in range. Finding that out waits for the GPU, once for all tensors.
    """
    present = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None and tensor.numel()}
    if not present or any(_capturing(tensor) for tensor in present.values()):
        return
    # Both extremes are NaN where a number is.
    extremes = torch.stack([torch.stack(tensor.aminmax()) for tensor in present.values()]).tolist()
    for name, (low, high) in zip(present, extremes, strict=True):
        least, most = (ranges or {}).get(name, (-math.inf, math.inf))
        for extreme in (low, high):
            if not math.isfinite(extreme):
                raise ValueError(f"{name}: expected finite numbers, found {extreme}")
            if not least <= extreme <= most:
                raise ValueError(f"{name}: expected numbers from {least:g} to {most:g}, found {extreme:g}")


def on_stream(device: torch.device) -> AbstractContextManager:
    """Puts Warp's work on torch's current stream."""
    # Wrapping a tensor, unlike all else in Warp, doesn't start it.
    wp.init()
    if device.type == "cpu":
        return nullcontext()
    return wp.ScopedStream(warp_stream(torch.cuda.current_stream(device)), sync_enter=False)


def dense(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor in C order, as Warp wants it for vectors."""
    # To torch a tensor of nothing is contiguous whatever its strides, to Warp it isn't.
    return tensor.contiguous() if tensor.numel() else tensor.new_empty(tensor.shape)


def zeros_for(tensor: torch.Tensor, needed: bool = True) -> torch.Tensor | None:
    """A gradient to add to, in C order whatever the tensor's strides; None where it isn't needed."""
    return torch.zeros_like(tensor, memory_format=torch.contiguous_format) if needed else None


def optional_array(tensor: torch.Tensor | None, dimensions: int, dtype: Any, device: torch.device) -> wp.array:
    """A buffer as Warp's, or the empty array that tells a kernel that there is none."""
    if tensor is None:
        return wp.empty((0,) * dimensions, dtype=dtype, device=wp.device_from_torch(device))
    return to_warp(tensor, dtype)


def _check_device(name: str, tensor: torch.Tensor, device: torch.device | None) -> None:
    if device is not None and tensor.device != device:
        raise ValueError(f"{name}: expected a tensor on {device}, got one on {tensor.device}")
    if tensor.device.type not in ("cpu", "cuda"):
        raise ValueError(f"{name}: expected a tensor on the CPU or a CUDA device, got one on {tensor.device}")


def _fits(tensor: torch.Tensor, shape: Shape) -> bool:
    sizes = tuple(tensor.shape)
    return len(sizes) == len(shape) and all(want in (None, size) for want, size in zip(shape, sizes, strict=True))


def _text(shape: Shape) -> str:
    return f"[{', '.join('any' if size is None else str(size) for size in shape)}]"


def _capturing(tensor: torch.Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()
