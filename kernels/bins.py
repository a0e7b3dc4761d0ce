"""Bins: large triangles per 16 x 16 screen tile, in three steps: count, (scan,) fill here, draw in bin_draw.py.

A team of lanes per triangle, a whole block where its box has many tiles, tests the tiles exactly. An entry that does
not fit the lists is drawn by the lane that found it, with atomics: overflow costs time and never a pixel. The order of
the lists depends on the run, the keys do not. Block size 256.
"""

from __future__ import annotations

import functools

import warp as wp

from .coverage import edge_threshold, first_pixel, huge_first, last_pixel, make_draw
from .structs import BIN_TILE, MODULE_OPTIONS, LargeTriangle, RasterTarget, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: (depth_views, behind): what CI compiles.
VARIANTS = [(False, False), (True, False), (False, True), (True, True)]


@wp.struct
class Bins:
    """Lists of large triangles a tile."""

    counts: wp.array[wp.int32]  # entries found a tile; after the scan, the fill's cursors start from offsets
    offsets: wp.array[wp.int32]
    cursors: wp.array[wp.int32]
    entries: wp.array[wp.int32]  # places in the store of large triangles
    scratch: wp.array[wp.vec4i]  # stands in for shared memory on the CPU: 320 elements


@wp.func
def edge_at(a: wp.vec2i, b: wp.vec2i, x: wp.int32, y: wp.int32):
    """Exact edge value of a -> b at a sub-pixel position."""
    return wp.int64(a[1] - b[1]) * wp.int64(x - a[0]) + wp.int64(b[0] - a[0]) * wp.int64(y - a[1])


@wp.func
def edge_misses(a: wp.vec2i, b: wp.vec2i, x: wp.int32, y: wp.int32, dx: wp.int32, dy: wp.int32):
    """Whether no pixel centre from (x, y) to (x + dx, y + dy) [1/256 px] is inside an edge."""
    sx, sy = a[1] - b[1], b[0] - a[0]
    best = edge_at(a, b, wp.where(sx > 0, x + dx, x), wp.where(sy > 0, y + dy, y))
    return best < wp.int64(edge_threshold(sx, sy))


@wp.func
def triangle_misses(t: LargeTriangle, x: wp.int32, y: wp.int32, dx: wp.int32, dy: wp.int32):
    """Whether an edge alone shows that a tile has no pixel of a triangle."""
    return (
        edge_misses(t.p1, t.p2, x, y, dx, dy)
        or edge_misses(t.p2, t.p0, x, y, dx, dy)
        or edge_misses(t.p0, t.p1, x, y, dx, dy)
    )


@functools.cache
def make_bin_kernel(depth_views: bool, behind: bool):
    """Kernel that counts the entries of each tile, or fills the lists."""
    _, draw_direct = make_draw(depth_views, behind)

    @wp.func
    def bin_triangle(
        view: View,
        t: LargeTriangle,
        index: wp.int32,
        lane: wp.int32,
        lanes: wp.int32,
        filling: wp.int32,
        bins: Bins,
        target: RasterTarget,
    ):
        x_min = wp.max(first_pixel(wp.min(t.p0[0], wp.min(t.p1[0], t.p2[0]))), 0)
        x_max = wp.min(last_pixel(wp.max(t.p0[0], wp.max(t.p1[0], t.p2[0]))), view.width - 1)
        y_min = wp.max(first_pixel(wp.min(t.p0[1], wp.min(t.p1[1], t.p2[1]))), 0)
        y_max = wp.min(last_pixel(wp.max(t.p0[1], wp.max(t.p1[1], t.p2[1]))), view.height - 1)
        bx, by = x_min // BIN_TILE, y_min // BIN_TILE
        wide = x_max // BIN_TILE - bx + 1
        total = wide * (y_max // BIN_TILE - by + 1)
        k = lane
        while k < total:
            tx, ty = bx + k % wide, by + k // wide
            low = wp.vec2i(wp.max(tx * BIN_TILE, x_min), wp.max(ty * BIN_TILE, y_min))
            high = wp.vec2i(wp.min(tx * BIN_TILE + BIN_TILE - 1, x_max), wp.min(ty * BIN_TILE + BIN_TILE - 1, y_max))
            x, y = low[0] * 256 + 128, low[1] * 256 + 128
            if not triangle_misses(t, x, y, (high[0] - low[0]) * 256, (high[1] - low[1]) * 256):
                b = view.bin_offset + ty * view.bins_x + tx
                if filling == 0:
                    wp.atomic_add(bins.counts, b, 1)
                else:
                    place = bins.offsets[b] + wp.atomic_add(bins.cursors, b, 1)
                    if place < bins.entries.shape[0]:
                        bins.entries[place] = index
                    else:
                        draw_direct(view, target, t, low, high)
            k += lanes

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def bin_triangles_kernel(
        # Frame
        views: wp.array[View],
        # In
        target: RasterTarget,
        # Params
        teams: wp.vec4i,
        filling: wp.int32,
        # Out
        out_bins: Bins,
    ):
        # Teams: lanes and number of those for huge triangles, whose blocks come first, then of those for the others.
        thread = wp.tid()
        split = huge_first(target.large.shape[0])
        lanes, stride = teams[0], teams[1]
        index, count = split + thread // lanes, split + wp.min(target.large_count[1], target.large.shape[0] - split)
        if thread >= lanes * stride:
            thread -= lanes * stride
            lanes = teams[2]
            stride = teams[3]
            index = thread // lanes
            count = wp.min(target.large_count[0], split)
        lane = thread % lanes
        while index < count:
            t = target.large[index]
            bin_triangle(views[t.view], t, index, lane, lanes, filling, out_bins, target)
            index += stride

    return bin_triangles_kernel
