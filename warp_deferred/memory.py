"""Device memory that runs out is told as a `CapacityError`, with what was wanted and what the device has."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

import warp as wp

from .errors import CapacityError

__all__ = ["enough_memory"]


@contextlib.contextmanager
def enough_memory(
    what: str, size: int, device: wp.Device, mend: str, fitting: Callable[[float], str] | None = None
) -> Iterator[None]:
    """Turn a failed allocation in the block into a `CapacityError`.

    Args:
        what: What is allocated, for the message.
        size: Bytes it takes altogether.
        device: Where.
        mend: What to do about it.
        fitting: Says what would fit if there is that share of the memory.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # Warp has no kind of its own for this; anything else it raises is passed on.
        if isinstance(error, RuntimeError) and "Failed to allocate" not in str(error):
            raise
        free = _free_bytes(device)
        got = "less" if free is None else f"{free / 1e9:.2f} GB free"
        # What is free comes in pieces; the rest of the plan takes a little, too.
        share = 0.0 if free is None else 0.9 * free / max(size, 1)
        if fitting is not None and 0.0 < share < 1.0:
            mend = f"{fitting(share)} would about fit: {mend}"
        raise CapacityError(f"{what}: expected {size / 1e9:.2f} GB of memory on {device}, got {got}; {mend}") from error


def _free_bytes(device: wp.Device) -> int | None:
    """Free memory of a device; None where the system does not tell."""
    if device.is_cuda:
        return device.free_memory
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None
