"""Merge: join the keys that several host threads drew privately, by maximum. CPU only; block size 256."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256


@wp.kernel
def merge_keys_kernel(
    # In
    slices: wp.array[wp.uint64],
    # Params
    count: wp.int32,
    slice_count: wp.int32,
    first: wp.int32,
    # Out
    out_keys: wp.array[wp.uint64],
):
    """Keep the largest key of each pixel."""
    i = wp.tid() + first
    key = out_keys[i]
    for k in range(slice_count):
        key = wp.max(key, slices[k * count + i])
    out_keys[i] = key


@wp.kernel
def merge_depth_keys_kernel(
    # In
    slices: wp.array[wp.uint32],
    # Params
    count: wp.int32,
    slice_count: wp.int32,
    first: wp.int32,
    # Out
    out_keys: wp.array[wp.uint32],
):
    """Keep the largest depth key of each pixel."""
    i = wp.tid() + first
    key = out_keys[i]
    for k in range(slice_count):
        key = wp.max(key, slices[k * count + i])
    out_keys[i] = key
