"""The reduced image of depth of field, and how far circles before the plane in focus reach. Block size 64.

depth_of_field.py says what they are for. `pack` is one thread a square of four pixels, one block a tile of 16 x 16:
the levels of a tile hang together, so that the block makes all of them, each from what it stored of the one before.
Bytes a pixel: 12 in, 8/3 out for the levels in half4 plans, 2 for the circles. `near_rows` and `near_columns` dilate
the tiles' largest circles along one axis after the other: a circle that spans both gaps passes both, so the result is
that of the square. One thread a tile, 2 n + 1 loads each. No atomics; the same bits from run to run.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .intrinsics import block_sync, block_width, load_float, load_vec4i, warp_largest
from .lens import circle_of_confusion, lens_terms
from .lens_layers import Taps, make_taps, merged, rows_of
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import BIN_TILE, MODULE_OPTIONS, PIXEL_BLOCK_AREA, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half image,): what CI compiles.
VARIANTS = [(True,), (False,)]
#: Radiance that goes into sums: half's range.
HALF_MAX = wp.constant(wp.float32(65504.0))


@wp.func
def reach_span(limit: wp.float32):
    """Tiles to either side whose circles may reach a tile or one next to it."""
    return wp.int32(wp.ceil(limit * 0.0625)) + 1


@wp.func
def farther_reaching(reach: wp.float32, largest: wp.float32, offset: wp.int32):
    """The larger of a reach and a tile's largest circle, if that spans the gap to a tile so many tiles away.

    The gap is less by one tile, which interpolation between tiles looks beyond.
    """
    gap = wp.max(wp.abs(offset) - 2, 0) * BIN_TILE
    return wp.where(largest > wp.float32(gap), wp.max(reach, largest), reach)


@wp.kernel(grid_stride=False)
def near_rows_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    nearest: wp.array[wp.float32],
    # Params
    limit: wp.float32,
    first: wp.int32,
    # Out
    out_rows: wp.array[wp.float32],
):
    """One thread a tile: the largest circle before the plane in focus of its row that reaches its column."""
    tile = wp.tid() + first
    row = load_vec4i(tiles, tile)
    view = views[row[0]]
    span = reach_span(limit)
    c = row[1] >> 4
    reach = wp.float32(0.0)
    for x in range(wp.max(c - span, 0), wp.min(c + span, view.bins_x - 1) + 1):
        n = 2 * (tile + x - c)
        largest = wp.max(load_float(nearest, n), load_float(nearest, n + 1))
        reach = farther_reaching(reach, largest, x - c)
    out_rows[tile] = reach


@wp.kernel(grid_stride=False)
def near_columns_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    rows: wp.array[wp.float32],
    # Params
    limit: wp.float32,
    first: wp.int32,
    # Out
    out_reach: wp.array[wp.float32],
):
    """One thread a tile: the largest circle before the plane in focus that reaches it or a tile next to it."""
    tile = wp.tid() + first
    row = load_vec4i(tiles, tile)
    view = views[row[0]]
    span = reach_span(limit)
    c = row[2] >> 4
    reach = wp.float32(0.0)
    for y in range(wp.max(c - span, 0), wp.min(c + span, (view.height - 1) >> 4) + 1):
        reach = farther_reaching(reach, load_float(rows, tile + (y - c) * view.bins_x), y - c)
    out_reach[tile] = reach


@functools.cache
def make_depth_of_field_pack_kernel(half: bool):
    """Kernel that makes the levels; `half`: whether the plan keeps half4 images."""
    load = make_image_codec(half)[0]
    load_tap, store_tap = make_taps(half)

    @wp.func
    def merge_four(taps: Taps, view: View, level: wp.int32, x: wp.int32, y: wp.int32):
        """Make texel (x, y) of a level from the level below; what crosses the edge repeats what is inside."""
        rows, below = rows_of(view, taps.tiles, level), rows_of(view, taps.tiles, level - 1)
        left, right = 2 * x, wp.min(2 * x + 1, below.last_x)
        upper = below.first + 2 * y * below.pitch
        lower = below.first + wp.min(2 * y + 1, below.last_y) * below.pitch
        a, b = load_tap(taps, upper + left), load_tap(taps, upper + right)
        c, d = load_tap(taps, lower + left), load_tap(taps, lower + right)
        store_tap(taps, rows.first + y * rows.pitch + x, merged(a, b, c, d))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def pack_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        image: Image,
        depth: wp.array[wp.float32],
        # Params
        limit: wp.float32,
        first: wp.int32,
        # Out
        out_taps: Taps,
        out_far: wp.array[wp.float32],
        out_near: wp.array[wp.float32],
        out_nearest: wp.array[wp.float32],
    ):
        """One thread a square of four pixels, one block a tile: all levels, and the largest circles on either side."""
        thread = wp.tid() + first
        row = pixel_block(thread)
        tile = load_vec4i(tiles, row)
        view = views[tile[0]]
        lane = thread & (PIXEL_BLOCK_AREA - 1)
        place = pixel_in_block(thread)
        x, y = tile[1] + 2 * place[0], tile[2] + 2 * place[1]
        far, near = wp.float32(0.0), wp.float32(0.0)
        if view.depth_only == 0 and x < view.width and y < view.height:
            # A square that crosses the edge repeats what is inside.
            right = wp.where(x + 1 < view.width, 1, 0)
            i = pixel_index(view, x, y)
            k = i + wp.where(y + 1 < view.height, view.row_pitch, 0)
            ca, cb = store_limit(load(image, i), HALF_MAX), store_limit(load(image, i + right), HALF_MAX)
            cc, cd = store_limit(load(image, k), HALF_MAX), store_limit(load(image, k + right), HALF_MAX)
            lens = lens_terms(view)
            sa = circle_of_confusion(lens, load_float(depth, i), limit)
            sb = circle_of_confusion(lens, load_float(depth, i + right), limit)
            sc = circle_of_confusion(lens, load_float(depth, k), limit)
            sd = circle_of_confusion(lens, load_float(depth, k + right), limit)
            rows = rows_of(view, out_taps.tiles, 1)
            texel = merged(
                wp.vec4(ca[0], ca[1], ca[2], sa),
                wp.vec4(cb[0], cb[1], cb[2], sb),
                wp.vec4(cc[0], cc[1], cc[2], sc),
                wp.vec4(cd[0], cd[1], cd[2], sd),
            )
            store_tap(out_taps, rows.first + (y >> 1) * rows.pitch + (x >> 1), texel)
            far = wp.max(0.0, wp.max(wp.max(sa, sb), wp.max(sc, sd)))
            near = wp.max(0.0, -wp.min(wp.min(sa, sb), wp.min(sc, sd)))
        out_far[thread] = far
        out_near[thread] = near
        alone = block_width() == 1
        half_tile = 2 * row + (lane >> 5)
        largest = warp_largest(near)
        if alone and (lane & 31) != 0:
            largest = wp.max(largest, out_nearest[half_tile])
        out_nearest[half_tile] = largest
        block_sync()
        # On the CPU, where lanes come one after the other, the last one does it all.
        if alone and lane < 63:
            return
        begin, step = wp.where(alone, 0, lane), wp.where(alone, 1, PIXEL_BLOCK_AREA)
        for k in range(begin, 16, step):
            x2, y2 = (tile[1] >> 2) + (k & 3), (tile[2] >> 2) + (k >> 2)
            if view.depth_only == 0 and 4 * x2 < view.width and 4 * y2 < view.height:
                merge_four(out_taps, view, 2, x2, y2)
        block_sync()
        for k in range(begin, 4, step):
            x3, y3 = (tile[1] >> 3) + (k & 1), (tile[2] >> 3) + (k >> 1)
            if view.depth_only == 0 and 8 * x3 < view.width and 8 * y3 < view.height:
                merge_four(out_taps, view, 3, x3, y3)

    return pack_kernel
