"""Operations on Warp arrays: the torch operation on the same memory, its gradient recorded on the active `wp.Tape`.

An operation is written once, for torch tensors. Called with Warp arrays it runs on tensors that share their memory, and
returns arrays that share the memory of its results. On an active tape one function is recorded, which computes the
gradients by the operation's own backward pass and adds them to the `grad` of the arrays.
"""

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import is_dataclass, replace
from typing import Any, ParamSpec, TypeVar

import torch
import warp as wp
from warp._src import context as warp_context  # Warp names the active tape nowhere else

from wlm.errors import WlmError
from wlm.interop import to_warp

P = ParamSpec("P")
R = TypeVar("R")


class NoGradientError(WlmError, ValueError):
    """An argument requires a gradient that the operation doesn't have.

    Args:
        name: The argument.
        operation: What has no gradient for it.
    """

    def __init__(self, name: str, operation: str) -> None:
        super().__init__(f"{name}: expected an argument that requires no gradient; {operation} has none for it")


def takes_arrays(*differentiable: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Makes an operation on torch tensors take Warp arrays too.

    An array's vectors or matrices are the last axes of its tensor: vec3 [N] is float [N, 3]. The results are arrays
    of numbers, or of vectors where they have five axes. They require gradients if an argument does while a tape is
    active; as after a launch, the backward pass sets the gradients of results to zero unless they have
    `retain_grad`. Work is queued on Warp's current stream.

    Args:
        differentiable: Names of the arguments that have a gradient, "argument.field" for a field of a dataclass.

    Returns:
        The decorator. The function that it returns raises, for Warp arrays:

        - NoGradientError: Another argument requires a gradient while a tape is active.
        - ValueError: As the operation does; or an argument is a torch tensor, or Warp alone captures a graph.
    """

    def decorate(operation: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(operation)

        @functools.wraps(operation)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            if torch.compiler.is_compiling():
                # The compiler ends its graph here and calls the operation as it is, forwards and backwards.
                return torch.compiler.disable(operation)(*args, **kwargs)
            # For speed.
            if args and isinstance(args[0], torch.Tensor):
                return operation(*args, **kwargs)
            array = next(_arrays((*args, *kwargs.values())), None)
            if array is None:
                return operation(*args, **kwargs)
            given = signature.bind(*args, **kwargs).arguments
            with _torch_alone(array.device) as tape:
                return _call(operation, given, differentiable, array.device, tape)

        return call

    return decorate


def _arrays(values: Iterable[Any]) -> Iterator[wp.array]:
    for value in values:
        if isinstance(value, wp.array):
            yield value
        elif is_dataclass(value):
            yield from _arrays(vars(value).values())


def _call(
    operation: Callable, given: dict[str, Any], differentiable: tuple[str, ...], device: wp.Device, tape: wp.Tape | None
) -> Any:
    leaves: list[tuple[wp.array, torch.Tensor]] = []
    results: list[tuple[wp.array, torch.Tensor]] = []

    def tensor_of(name: str, value: Any) -> Any:
        if is_dataclass(value):
            return _changed(value, lambda field, v: tensor_of(f"{name}.{field}", v))
        if isinstance(value, torch.Tensor):
            raise ValueError(f"{name}: expected a Warp array as for other arguments, got a tensor: use wp.from_torch")
        if not isinstance(value, wp.array):
            return value
        tensor = _tensor(name, value)
        if tape is not None and value.requires_grad:
            if name not in differentiable:
                raise NoGradientError(name, operation.__name__)
            # Other types than floats are refused by the operation.
            leaves.append((value, tensor.requires_grad_(tensor.is_floating_point())))
        return tensor

    def array_of(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(array_of, value))
        if is_dataclass(value):
            return _changed(value, lambda _, v: array_of(v))
        if not isinstance(value, torch.Tensor):
            return value
        # Warp's arrays have at most four axes.
        dtype = wp.types.vector(value.shape[-1], float) if value.ndim > 4 else None
        array = to_warp(value, dtype)
        if value.requires_grad:
            array.grad = to_warp(torch.zeros_like(value), dtype)
            results.append((array, value))
        return array

    def backward() -> None:
        with _torch_alone(device):
            into = [_tensor("grad", array.grad) for array, _ in results]
            outputs, inputs = ([tensor for _, tensor in pairs] for pairs in (results, leaves))
            # The tape may run backwards again.
            found = torch.autograd.grad(outputs, inputs, into, retain_graph=True, allow_unused=True)
            for (array, _), grad in zip(leaves, found, strict=True):
                if grad is not None:
                    _tensor("grad", array.grad).add_(grad)
            for (array, _), grad in zip(results, into, strict=True):
                if not array.retain_grad:
                    grad.zero_()

    arguments = {name: tensor_of(name, value) for name, value in given.items()}
    with torch.set_grad_enabled(bool(leaves)):
        returned = array_of(operation(**arguments))
    if results:
        # An array without elements has no gradient to set to zero.
        tape.record_func(backward, [array for array, _ in (*leaves, *results) if array.size])
    return returned


def _changed(record: Any, change: Callable[[str, Any], Any]) -> Any:
    return replace(record, **{field: change(field, value) for field, value in vars(record).items()})


def _tensor(name: str, array: wp.array) -> torch.Tensor:
    try:
        tensor = wp.to_torch(array, requires_grad=False)
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: cannot use an array of {array.dtype.__name__} here: {error}") from error
    # Warp's conversion omits the axis of vectors of one number.
    return tensor.view(*array.shape, *getattr(array.dtype, "_shape_", ()))


@contextmanager
def _torch_alone(device: wp.Device) -> Iterator[wp.Tape | None]:
    """Runs torch on Warp's current stream, and no launch is recorded on the active tape, which is yielded."""
    if device.is_capturing and (device.is_cpu or not torch.cuda.is_current_stream_capturing()):
        raise ValueError("wlm.ops: expected a capture by torch.cuda.graph, on the stream that is Warp's too")
    tape, warp_context.runtime.tape = warp_context.runtime.tape, None
    stream: AbstractContextManager = nullcontext()
    if device.is_cuda:
        stream = torch.cuda.stream(wp.stream_to_torch(device))
    try:
        with stream, torch.inference_mode(False):
            yield tape
    finally:
        warp_context.runtime.tape = tape
