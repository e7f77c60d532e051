"""Checks that many tests make: of an error that is meant for the user, and of two models that should be equal."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse


def error_of(call: Callable, *args: Any, **options: Any) -> str:
    """The error that a call must end with; it is one line."""
    return _line_of(WlmError, call, *args, **options)


def misuse_of(call: Callable, *args: Any, **options: Any) -> str:
    """The error of a call that no program should make."""
    return _line_of(ValueError, call, *args, **options)


def _line_of(kind: type[Exception], call: Callable, *args: Any, **options: Any) -> str:
    with pytest.raises(kind) as caught:
        call(*args, **options)
    text = str(caught.value)
    assert "\n" not in text
    return text


def assert_same(a: Any, b: Any) -> None:
    """Compares two models field by field; of a report all but the times, which aren't saved."""
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        _assert_same(getattr(a, field.name), getattr(b, field.name), field.name)


def _assert_same(x: Any, y: Any, name: str) -> None:
    if isinstance(x, np.ndarray):
        assert x.shape == y.shape and x.dtype == y.dtype, name
        np.testing.assert_array_equal(x, y, err_msg=name)
    elif name == "report":
        assert x == {key: value for key, value in y.items() if key != "seconds"}
    elif dataclasses.is_dataclass(x) and type(x).__eq__ is object.__eq__:
        assert_same(x, y)
    elif isinstance(x, dict) and any(dataclasses.is_dataclass(part) for part in x.values()):
        assert list(x) == list(y), name
        for key, part in x.items():
            _assert_same(part, y[key], f"{name} {key}")
    elif isinstance(x, tuple) and any(isinstance(part, np.ndarray) for part in x):
        for mine, other in zip(x, y, strict=True):
            _assert_same(mine, other, name)
    else:
        assert x == y, name


def psnr(reference: np.ndarray, decoded: np.ndarray) -> float:
    """PSNR of all numbers together, with the range of the reference as the peak."""
    return psnr_from_mse(float(np.mean(np.square(reference - decoded))), float(np.ptp(reference)))


def put(index: Any, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    """A change of an array: a copy with a value put in."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[index] = value
        return array

    return change
