"""One thread at a time on a GPU, and reading its arrays.

Warp's current stream belongs to the device, not to the thread: what one thread captures, or switches to another stream,
every thread that launches sees. So renderers of all threads take turns on CUDA, a call at a time; what they started
runs on. `wp.array.numpy` switches streams, too: of two threads at once one may leave the device on the other's stream
for good, after which nothing can be captured ("unknown stream"). `host_copy` names its stream instead.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import warp as wp

__all__ = ["host_copy", "in_turn"]

Method = TypeVar("Method", bound=Callable[..., Any])
_turn = threading.RLock()


def in_turn(method: Method) -> Method:
    """Decorate a method of an object with a `device`: on CUDA one thread at a time is inside any such method."""

    @functools.wraps(method)
    def call(self: Any, *arguments: Any, **named: Any) -> Any:
        if not self.device.is_cuda:
            return method(self, *arguments, **named)
        with _turn:
            return method(self, *arguments, **named)

    return call  # type: ignore[return-value]


def host_copy(array: wp.array) -> np.ndarray:
    """Copy an array to the host once all that writes it is done, from any thread; vectors get an axis of their own."""
    if array.device.is_cpu:
        return array.numpy().copy()
    with _turn:
        host = wp.empty(array.shape, dtype=array.dtype, device="cpu")
        # The null stream waits for all others but those of other libraries that opt out.
        stream = array.device.null_stream
        wp.copy(host, array, stream=stream)
        wp.synchronize_stream(stream)
    return host.numpy()
