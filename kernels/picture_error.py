"""How far one picture is from another: the sum of squared differences of their 8-bit codes. Beside the frame.

Used by `warp_deferred.fit`, which compares many pictures and needs one number of each. Sums are whole numbers, so they
are the same in any order, on CPU and CUDA. One thread for every `THREADS`-th pixel, block size 256. Bytes a pixel: 8.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: Threads of a launch; each adds once to the result.
THREADS = 1 << 16


@wp.func
def squared_difference(a: wp.uint32, b: wp.uint32, shift: wp.uint32):
    """Square of the difference of two words' bytes at a place [code^2]."""
    d = wp.int32((a >> shift) & wp.uint32(255)) - wp.int32((b >> shift) & wp.uint32(255))
    return wp.int64(d * d)


@wp.kernel
def sum_squares_kernel(
    # In
    first: wp.array[wp.uint32],
    second: wp.array[wp.uint32],
    # Out
    out_sum: wp.array[wp.int64],
):
    """Add up the squared differences of R, G and B [code^2]."""
    total = wp.int64(0)
    for i in range(wp.tid(), first.shape[0], THREADS):
        a, b = first[i], second[i]
        total += squared_difference(a, b, wp.uint32(0))
        total += squared_difference(a, b, wp.uint32(8))
        total += squared_difference(a, b, wp.uint32(16))
    if total > wp.int64(0):
        wp.atomic_add(out_sum, 0, total)
