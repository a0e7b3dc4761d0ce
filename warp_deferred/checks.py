"""The only makers of input errors: small checks that return the value in its canonical form."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from .errors import InputError

__all__ = ["check_array", "check_choice", "check_count", "check_finite", "check_range", "input_error"]


def input_error(name: str, expected: str, got: object, mend: str = "") -> InputError:
    """Build the one message shape: name, expectation, what came, and the mend."""
    text = f"{name}: expected {expected}, got {_short(got)}"
    return InputError(f"{text}; {mend}" if mend else text)


def _short(value: object) -> str:
    text = value if isinstance(value, str) and value.startswith("<") else repr(value)
    return text if len(text) <= 120 else text[:117] + "..."


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> Any:
    """Return `value` if it is one of `choices`; otherwise name the nearest one."""
    options = list(choices)
    if value in options:
        return value
    near = difflib.get_close_matches(str(value), [str(o) for o in options], 1, 0.4)
    listed = ", ".join(repr(o) for o in options)
    raise input_error(name, f"one of {listed}", value, f"did you mean {near[0]!r}?" if near else "choose one of these")


def check_count(name: str, value: Any, low: int, high: int, mend: str = "") -> int:
    """Return `value` as an int within [low, high]; bool and fractional numbers are refused."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise input_error(name, f"a whole number from {low} to {high}", value, mend)
    return int(value)


def check_range(name: str, value: Any, low: float, high: float = math.inf, *, unit: str = "", mend: str = "") -> float:
    """Return `value` as a finite float within [low, high]."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and low <= number <= high):
        bounds = f"a finite number from {low:g} to {high:g}" if math.isfinite(high) else f"a finite number >= {low:g}"
        raise input_error(name, bounds + (f" [{unit}]" if unit else ""), value, mend)
    return number


def check_finite(name: str, array: np.ndarray, mend: str = "") -> np.ndarray:
    """Return `array` if every element is finite; otherwise name the first that is not."""
    finite = np.isfinite(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise input_error(
            name, "finite numbers", f"<{array[where]} at index {where}>", mend or "replace or drop that element"
        )
    return array


def check_array(name: str, value: Any, shape: tuple[int | None, ...], dtype: Any, *, finite: bool = True) -> np.ndarray:
    """Return `value` as a contiguous array of `dtype` and `shape` (None: any length), all elements finite.

    Raises:
        InputError: If the shape, the kind of number or an element does not fit.
    """
    try:
        array = np.asarray(value)
        if array.dtype == object or array.dtype.kind not in "fiub":
            raise TypeError
        if array.size == 0:
            array = array.reshape([0 if n is None else n for n in shape])
    except (TypeError, ValueError):
        raise input_error(name, f"an array of numbers of shape {_shape(shape)}", type(value).__name__) from None
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise input_error(name, f"shape {_shape(shape)}", f"<shape {array.shape}>", "reshape or transpose the array")
    if np.dtype(dtype).kind in "iu" and array.dtype.kind == "f":
        raise input_error(name, "whole numbers", f"<{array.dtype} array>", "cast the indices to int32")
    if finite and array.dtype.kind == "f":
        check_finite(name, array)
    if np.dtype(dtype).kind in "iu" and array.size:
        info = np.iinfo(dtype)
        if int(array.min()) < info.min or int(array.max()) > info.max:
            raise input_error(name, f"values from {info.min} to {info.max}", f"<{array.min()} to {array.max()}>")
    with np.errstate(over="ignore"):
        result = np.ascontiguousarray(array, dtype=dtype)
    if finite and result.dtype.kind == "f":
        check_finite(name, result, "the value is too large for 32-bit floats; choose larger units")
    return result


def _shape(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("n" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
