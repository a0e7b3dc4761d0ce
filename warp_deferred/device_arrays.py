"""The device that renders, and arrays that users hand in: whatever holds numbers, as float32 on that device."""

from __future__ import annotations

import math
from typing import Any

import warp as wp

from .checks import input_error
from .errors import DeviceError

__all__ = ["as_float_array", "find_device"]


def as_float_array(name: str, value: object, device: wp.Device, *shapes: tuple[int, ...]) -> wp.array:
    """See a Warp, torch or JAX array as a Warp array of plain float32 on the device, without a copy where it can be.

    Args:
        name: What the array is, for messages.
        value: The array; vectors, matrices and transforms of Warp count as further axes.
        device: Where it is needed.
        *shapes: Shapes that will do.

    Raises:
        InputError: If it holds other numbers, has another shape, or cannot be seen without a copy through the host.
    """
    if not isinstance(value, wp.array) and not hasattr(value, "__dlpack__"):
        raise input_error(name, "a Warp array, or one with __dlpack__", type(value).__name__, "wrap it with wp.array")
    array = value if isinstance(value, wp.array) else wp.from_dlpack(value)
    number = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    if number is not wp.float32:
        got = getattr(number, "__name__", str(number))
        raise input_error(name, "float32 numbers", f"<{got} array>", "convert the array to float32")
    lengths = tuple(getattr(array.dtype, "_shape_", ()))
    shape = (*array.shape, *lengths)
    if shape not in shapes:
        raise input_error(name, "shape " + " or ".join(map(str, shapes)), f"<shape {shape}>")
    if array.device != device:
        array = array.to(device)
    if not lengths:
        return array
    inner = [4 * math.prod(lengths[k + 1 :]) for k in range(len(lengths))]
    result = wp.array(
        ptr=array.ptr, dtype=wp.float32, shape=shape, strides=(*array.strides, *inner), device=device, copy=False
    )
    # A pointer keeps nothing alive: what `to` or DLPack made must outlast the launch that reads it.
    result._ref = array
    return result


def find_device(name: Any) -> wp.Device:
    """Return the Warp device of that name; the current default for None.

    Raises:
        DeviceError: If there is none.
    """
    try:
        return wp.get_device(name)
    except Exception as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"device: expected one of {known}, got {name!r}; leave it out for the default") from error
