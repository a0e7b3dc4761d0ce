"""Device memory that runs out is told as a `CapacityError`, with what was wanted and what the device has."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import warp as wp

from .errors import CapacityError

__all__ = ["enough_memory"]


@contextlib.contextmanager
def enough_memory(what: str, size: int, device: wp.Device, mend: str) -> Iterator[None]:
    """Turn a failed allocation in the block into a `CapacityError`.

    Args:
        what: What is allocated, for the message.
        size: Bytes it takes altogether.
        device: Where.
        mend: What to do about it.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # Warp has no kind of its own for this; anything else it raises is passed on.
        if isinstance(error, RuntimeError) and "Failed to allocate" not in str(error):
            raise
        free = f"{device.free_memory / 1e9:.2f} GB free" if device.is_cuda else "less"
        raise CapacityError(
            f"{what}: expected {size / 1e9:.2f} GB of memory on {device}, got {free}; {mend}"
        ) from error
