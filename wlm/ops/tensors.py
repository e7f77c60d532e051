"""Helpers shared by all operations: tensor checks, torch's stream, and gradient buffers."""

import math
from contextlib import AbstractContextManager, nullcontext
from types import EllipsisType
from typing import Any

import torch
import warp as wp

from wlm.interop import launch_on, to_warp, warp_stream

Shape = tuple[int | EllipsisType | None, ...]
"""Sizes of a tensor's axes; None allows any size, and a leading `...` any number of axes."""


def check(
    name: str, tensor: torch.Tensor, shape: Shape, device: torch.device | None = None, kind: torch.dtype = torch.float32
) -> None:
    """Checks that a tensor has the given type, shape and device; None allows any device of Warp. Raises a ValueError if
    it isn't a dense torch tensor, its shape, type or device doesn't fit, or torch.func is active."""
    _check_tensor(name, tensor, wanted := f"{kind} {_text(shape)}".removeprefix("torch."))
    if tensor.dtype != kind or not _fits(tensor, shape):
        hint = ": use its float()" if tensor.is_floating_point() and tensor.dtype != kind == torch.float32 else ""
        raise ValueError(f"{name}: expected {wanted}, got {tensor.dtype} {tuple(tensor.shape)}{hint}")
    _check_device(name, tensor, device)


def check_index(name: str, index: torch.Tensor, count: int, shape: Shape, device: torch.device) -> None:
    """Checks a tensor of indices from 0 to `count` - 1; values are not checked while a CUDA graph is captured. Raises a
    ValueError as `check` does, or if a number doesn't fit."""
    _check_tensor(name, index, wanted := f"int32 or int64 {_text(shape)}")
    if index.dtype not in (torch.int32, torch.int64) or not _fits(index, shape):
        raise ValueError(f"{name}: expected {wanted}, got {index.dtype} {tuple(index.shape)}")
    _check_device(name, index, device)
    if index.numel() and not _capturing(index):
        low, high = torch.stack(index.aminmax()).tolist()
        if low < 0 or high >= count:
            raise ValueError(f"{name}: expected numbers from 0 to {count - 1}, found {low if low < 0 else high}")


def check_finite(ranges: dict[str, tuple[float, float]] | None = None, **tensors: torch.Tensor | None) -> None:
    """Checks that tensors of one device contain finite numbers, within `ranges` by name; the check waits for the GPU
    once.

    None and empty tensors are skipped, and so is the whole check while a CUDA graph is captured. Raises a ValueError if
    a number isn't finite or in range."""
    present = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None and tensor.numel()}
    if not present or any(_capturing(tensor) for tensor in present.values()):
        return
    # Both extremes are NaN if any number is NaN.
    extremes = torch.stack([torch.stack(tensor.aminmax()) for tensor in present.values()]).tolist()
    for name, (low, high) in zip(present, extremes, strict=True):
        least, most = (ranges or {}).get(name, (-math.inf, math.inf))
        for extreme in (low, high):
            if not math.isfinite(extreme):
                raise ValueError(f"{name}: expected finite numbers, found {extreme}")
            if not least <= extreme <= most:
                raise ValueError(f"{name}: expected numbers from {least:g} to {most:g}, found {extreme:g}")


def on_stream(device: torch.device) -> AbstractContextManager:
    """Runs Warp's work inside the block on torch's current stream."""
    # Wrapping a tensor doesn't initialise Warp, unlike every other call.
    wp.init()
    if device.type == "cpu":
        return nullcontext()
    return launch_on(warp_stream(torch.cuda.current_stream(device)))


def dense(tensor: torch.Tensor) -> torch.Tensor:
    """Returns the tensor in C order, which Warp requires for vectors."""
    # torch treats an empty tensor with any strides as contiguous, Warp doesn't.
    return tensor.contiguous() if tensor.numel() else tensor.new_empty(tensor.shape)


def zeros_for(tensor: torch.Tensor, needed: bool = True) -> torch.Tensor | None:
    """Returns a zero gradient buffer in C order for a tensor of any strides; None if it isn't needed."""
    return torch.zeros_like(tensor, memory_format=torch.contiguous_format) if needed else None


def optional_array(tensor: torch.Tensor | None, dimensions: int, dtype: Any, device: torch.device) -> wp.array:
    """Wraps a buffer as a Warp array; None becomes an empty array, by which a kernel knows there is no buffer."""
    if tensor is None:
        return wp.empty((0,) * dimensions, dtype=dtype, device=wp.device_from_torch(device))
    return to_warp(tensor, dtype)


def _check_tensor(name: str, tensor: torch.Tensor, wanted: str) -> None:
    if not isinstance(tensor, torch.Tensor):
        kind = f"{type(tensor).__module__}.{type(tensor).__name__}".removeprefix("builtins.")
        raise ValueError(f"{name}: expected a torch tensor, {wanted}, got {kind}: use torch.as_tensor")
    if tensor.layout != torch.strided:
        raise ValueError(f"{name}: expected a dense tensor, got {tensor.layout}: use its to_dense()")
    # torch's own error for such a call tells nothing to a caller.
    if torch._C._are_functorch_transforms_active():
        raise ValueError("torch.func: wlm.ops supports no grad, jvp, jacrev or vmap of it: use torch.autograd.grad")


def _check_device(name: str, tensor: torch.Tensor, device: torch.device | None) -> None:
    if device is not None and tensor.device != device:
        raise ValueError(f"{name}: expected a tensor on {device}, got one on {tensor.device}")
    if tensor.device.type not in ("cpu", "cuda"):
        raise ValueError(f"{name}: expected a tensor on the CPU or a CUDA device, got one on {tensor.device}")


def _fits(tensor: torch.Tensor, shape: Shape) -> bool:
    sizes = tuple(tensor.shape)
    if shape[:1] == (...,):
        shape = shape[1:]
        sizes = sizes[max(len(sizes) - len(shape), 0) :]
    return len(sizes) == len(shape) and all(want in (None, size) for want, size in zip(shape, sizes, strict=True))


def _text(shape: Shape) -> str:
    return f"[{', '.join({None: 'any', ...: '...'}.get(size, str(size)) for size in shape)}]"


def _capturing(tensor: torch.Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()
