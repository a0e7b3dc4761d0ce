"""Depth bounds of light tiles from coded depth: extremes of codes, of which two a tile are decoded.

Larger codes are nearer and decoding keeps their order, so that these are the extremes of what shade decodes, to the
bit. `float32` depth has a kernel of its own in light_culling.py. Order of threads cannot show. Block size 64.
"""

from __future__ import annotations

import functools

import warp as wp

from .depth_encoding import DEPTH_CODECS, make_depth_codec
from .projection import linear_depth, pixel_index
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Format: what CI compiles.
VARIANTS = [("unorm16",), ("ufloat16",), ("unorm24",)]


@functools.cache
def make_coded_bounds_kernel(name: str):
    """Kernel that finds a tile's nearest and farthest depth in codes of a format."""
    decode = make_depth_codec(name)[1]
    dtype = DEPTH_CODECS[name]

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def coded_bounds_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        codes: wp.array[dtype],
        # Params
        tile_shift: wp.int32,
        first: wp.int32,
        # Out
        out_bounds: wp.array[wp.vec2],
    ):
        """Nearest and farthest depth of a tile's surfaces; (inf, 0) where there is none. One block a tile."""
        row, lane = wp.tid()
        t = row + first
        tile = tiles[t]
        view = views[tile[0]]
        side = wp.int32(1) << tile_shift
        # dtype is named here too: a deferred annotation alone would not capture it.
        largest, least = wp.int32(0), wp.int32(wp.static(1 << (16 if dtype is wp.uint16 else 24)))
        k = lane
        while k < side * side:
            x, y = tile[1] + (k & (side - 1)), tile[2] + (k >> tile_shift)
            if x < view.width and y < view.height:
                code = wp.int32(codes[pixel_index(view, x, y)])
                if code > 0:
                    largest = wp.max(largest, code)
                    least = wp.min(least, code)
            k += wp.block_dim()
        high = wp.tile_max(wp.tile(largest))
        low = wp.tile_min(wp.tile(least))
        nearest, farthest = wp.uint32(high[0]), wp.uint32(low[0])
        if lane == 0:
            bounds = wp.vec2(wp.inf, 0.0)
            if nearest > wp.uint32(0):
                bounds = wp.vec2(linear_depth(view, decode(nearest)), linear_depth(view, decode(farthest)))
            out_bounds[t] = bounds

    return coded_bounds_kernel
