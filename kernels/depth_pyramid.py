"""A pyramid of depths for passes that look far around a pixel: smaller levels keep far fetches in the caches.

A level holds every second, fourth, eighth or sixteenth depth a side, untouched: averages would invent surfaces between
near and far ones, and would need a rule beside the background (McGuire et al. 2012, "Scalable Ambient Obscurance", 2.2,
takes single samples too). So each texel is the depth of one known pixel, and a point rebuilt from it lies on the
surface.

Texel (X, Y) of level k is pixel (X << k) + half, (Y << k) + half with half = 1 << (k - 1); +inf where that pixel is
outside the view. All levels of a view lie side by side in one rectangle, W = 16 `bins_x` wide and half as high: level k
begins W - (W >> (k - 1)) texels to the right. Two bytes a pixel in all. Block size 64, one thread a texel of level 1
and at most one other; deterministic, every texel has one writer.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import load_either, load_vec4i
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Levels beside the depths themselves: a raster bin of 16 x 16 pixels holds whole texels of all of them.
LEVELS = wp.constant(4)
#: Words of the pyramid a bin takes.
BIN_WORDS = 128


@wp.func
def level_start(view: View, level: wp.int32):
    """Index of the texel of a level, 1 to LEVELS, that covers pixel (0, 0)."""
    # The level below is twice as wide: no level 0 is asked for a shift by -1.
    return (view.bin_offset << 7) + (view.bins_x << 4) - ((view.bins_x << 5) >> level)


@wp.func
def pyramid_index(view: View, level: wp.int32, x: wp.int32, y: wp.int32):
    """Index of the texel of a level, 1 to LEVELS, that covers pixel (x, y)."""
    return level_start(view, level) + (y >> level) * (view.bins_x << 4) + (x >> level)


@wp.func
def fill_texel(
    view: View,
    depth: wp.array[wp.float32],
    level: wp.int32,
    x: wp.int32,
    y: wp.int32,
    out_pyramid: wp.array[wp.float32],
):
    """Write the texel of a level that covers pixel (x, y), a multiple of its size."""
    half = (1 << level) >> 1
    inside = x + half < view.width and y + half < view.height
    index = pixel_index(view, x + half, y + half)
    value = load_either(depth, depth, False, index, inside)
    # What is no depth counts as background.
    out_pyramid[pyramid_index(view, level, x, y)] = wp.where(wp.isfinite(value), value, wp.inf)


@wp.kernel(grid_stride=False)
def fill_pyramid_kernel(
    # Frame
    views: wp.array[View],
    bin_tiles: wp.array[wp.vec4i],
    # In
    depth: wp.array[wp.float32],
    # Params
    first: wp.int32,
    # Out
    out_pyramid: wp.array[wp.float32],
):
    """Depths of all levels. Reads a third of the depths' sectors at least once, writes 1.33 bytes a pixel."""
    thread = wp.tid() + first
    tile = load_vec4i(bin_tiles, pixel_block(thread))
    place = pixel_in_block(thread)
    view = views[tile[0]]
    if view.depth_only != 0:
        return
    fill_texel(view, depth, 1, tile[1] + 2 * place[0], tile[2] + 2 * place[1], out_pyramid)
    # The other levels of a bin have 16, 4 and 1 texels, for 21 of the 64 threads.
    lane = thread & (BLOCK_DIM - 1)
    if lane < 21:
        level = 2 + wp.where(lane >= 16, 1, 0) + wp.where(lane >= 20, 1, 0)
        last = (16 >> level) - 1
        x, y = (lane & last) << level, ((lane >> (4 - level)) & last) << level
        fill_texel(view, depth, level, tile[1] + x, tile[2] + y, out_pyramid)
