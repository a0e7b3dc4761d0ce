"""Finite check: the first number of a channel that is not finite, for `Settings(check_finite=True)`. A debugging aid.

A channel is seen as rows of float32 or half numbers. `look` finds the smallest index of a bad one, `keep` its value
before a later pass or sample can write over it. One thread a row, block size 256; the first does not depend on order.
Reads every byte of the channel once.
"""

from __future__ import annotations

import functools

import warp as wp

from .structs import MODULE_OPTIONS

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: Numbers of a row, at most: an index is 4 row + column.
COLUMNS = wp.constant(4)
#: What indices are subtracted from, so that the first one is the largest key, and 0 says that all is finite.
LAST = wp.constant(wp.int64(2**62))
#: (half,): what CI compiles.
VARIANTS = [(False,), (True,)]


@functools.cache
def make_finite_check_kernels(half: bool):
    """(look, keep) kernels over rows of halves or of float32."""
    Number = wp.float16 if half else wp.float32

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def look_kernel(
        # In
        numbers: wp.array2d[Number],
        values: wp.array[wp.float32],
        # Params
        infinite: wp.int32,
        slot: wp.int32,
        # Out
        out_first: wp.array[wp.int64],
    ):
        """Find the first bad number, unless an earlier sample's is kept; `infinite`: +inf is a value like others."""
        row = wp.tid()
        # Number is named in the body, too: a deferred annotation alone would not capture it.
        if wp.static(Number is not None) and not wp.isfinite(values[slot]):
            return
        for column in range(numbers.shape[1]):
            value = wp.float32(numbers[row, column])
            if not wp.isfinite(value) and not (infinite != 0 and value > 0.0):
                wp.atomic_max(out_first, slot, LAST - wp.int64(row) * wp.int64(COLUMNS) - wp.int64(column))
                return

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def keep_kernel(
        # In
        numbers: wp.array2d[Number],
        first: wp.array[wp.int64],
        # Params
        slot: wp.int32,
        # Out
        out_values: wp.array[wp.float32],
    ):
        """Keep the value that was found; one thread. What is not finite in `out_values` says that it is known."""
        index = LAST - first[slot]
        if wp.static(Number is not None) and index < LAST and wp.isfinite(out_values[slot]):
            row, column = wp.int32(index / wp.int64(COLUMNS)), wp.int32(index % wp.int64(COLUMNS))
            out_values[slot] = wp.float32(numbers[row, column])

    return look_kernel, keep_kernel
