"""Bins, drawn: the pixels of a 16 x 16 screen tile loop over the tile's list of large triangles.

A block of 64 lanes a tile, four pixels a lane, stages 64 entries at a time in shared memory and loops over them with
the best keys in registers: no atomics, and one wait a batch. What an entry needs is set up once a tile and read once
for four pixels. Edge values are 64-bit once a tile and 32-bit inside it: an edge that neither accepts nor rejects the
whole tile has |q| <= 2^29, and pixel steps are multiples of 256, so the shift loses nothing. Where even the exact edge
values of a tile fit 32 bits, as for all but the largest triangles, depth is made of 32-bit numbers too, with the same
bits. Tiles that keep ids and tiles of shadow maps have kernels of their own. The order of the lists depends on the run,
the keys do not. Block size 64.
"""

from __future__ import annotations

import functools
from typing import Any

import warp as wp

from .bins import Bins, edge_at
from .coverage import accept_depth, edge_threshold, fragment_depth
from .intrinsics import bits_float, block_sync, block_width, float_bits, load_vec4i, shared_words
from .projection import pixel_index
from .structs import ALL_BITS, BIN_TILE, MODULE_OPTIONS, LargeTriangle, RasterTarget, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Rows between the four pixels of a lane.
ROWS = wp.constant(4)
#: Words of four integers that a staged entry takes.
STAGED = wp.constant(5)
#: In place of q: every pixel of the tile is inside the edge; no step inside a tile, at most 2^29, takes it below 0.
ACCEPTED = wp.constant(1073741824)
#: Edge values of a tile, and their steps across it, stay below this where 32 bits do.
NARROW = wp.constant(wp.int64(1 << 30))
#: (depth_only, behind): what CI compiles.
VARIANTS = [(False, False), (True, False), (False, True)]


@wp.func
def edge_in_tile(a: wp.vec2i, b: wp.vec2i, e: wp.int64):
    """Q of an edge whose value at a tile's first pixel is e: inside is q + a i + b j >= 0 for pixel steps i and j.

    The threshold is folded in before the shift. An edge that crosses the tile has |q| <= 15 (|a| + |b|) <= 2^29.
    """
    sx, sy = a[1] - b[1], b[0] - a[0]
    q = (e - wp.int64(edge_threshold(sx, sy))) >> wp.int64(8)
    if q + wp.int64(wp.min(sx, 0)) * wp.int64(15) + wp.int64(wp.min(sy, 0)) * wp.int64(15) >= wp.int64(0):
        return ACCEPTED
    return wp.int32(q)


@wp.func
def is_narrow(a: wp.vec2i, b: wp.vec2i, e: wp.int64):
    """Whether an edge's values at all pixels of a tile fit 32 bits, e being the first one."""
    step = wp.int64(wp.max(wp.abs(a[1] - b[1]), wp.abs(b[0] - a[0]))) * wp.int64(256 * 15)
    return wp.abs(e) < NARROW and step < NARROW / wp.int64(2)


@wp.func
def stage_edge(scratch: wp.array[wp.vec4i], slot: wp.int32, a: wp.vec2i, b: wp.vec2i, e: wp.int64):
    """Share what the test of an edge needs: q, its steps, and the lower word of its value."""
    shared_words(scratch, True, slot, wp.vec4i(edge_in_tile(a, b, e), a[1] - b[1], b[0] - a[0], wp.int32(e)))


@wp.func
def high_word(value: wp.int64):
    """Upper 32 bits."""
    return wp.int32(value >> wp.int64(32))


@wp.func
def stage_entry(scratch: wp.array[wp.vec4i], lane: wp.int32, t: LargeTriangle, x: wp.int32, y: wp.int32):
    """Share a triangle with the block: per edge (q, steps, value), upper words and id, depths and 1 / area.

    (x, y) is the tile's first pixel centre [1/256 px]; 1 / area is negative where 32 bits do not hold the values.
    """
    e0, e1, e2 = edge_at(t.p1, t.p2, x, y), edge_at(t.p2, t.p0, x, y), edge_at(t.p0, t.p1, x, y)
    inverse = 1.0 / wp.float32(edge_at(t.p0, t.p1, t.p2[0], t.p2[1]))
    if not (is_narrow(t.p1, t.p2, e0) and is_narrow(t.p2, t.p0, e1) and is_narrow(t.p0, t.p1, e2)):
        inverse = -inverse
    slot = lane * STAGED
    stage_edge(scratch, slot, t.p1, t.p2, e0)
    stage_edge(scratch, slot + 1, t.p2, t.p0, e1)
    stage_edge(scratch, slot + 2, t.p0, t.p1, e2)
    shared_words(scratch, True, slot + 3, wp.vec4i(high_word(e0), high_word(e1), high_word(e2), wp.int32(t.id)))
    bits = wp.vec3i(wp.int32(float_bits(t.z[0])), wp.int32(float_bits(t.z[1])), wp.int32(float_bits(t.z[2])))
    shared_words(scratch, True, slot + 4, wp.vec4i(bits[0], bits[1], bits[2], wp.int32(float_bits(inverse))))


@wp.func
def edge_value(high: wp.int32, low: wp.int32, step: wp.int32):
    """Exact edge value at a pixel as float32, from the two words of the value at the tile's first pixel."""
    word = (wp.int64(high) << wp.int64(32)) | wp.int64(wp.uint32(low))
    return wp.float32(word + wp.int64(step) * wp.int64(256))


@wp.func
def staged_depth(
    view: View,
    scratch: wp.array[wp.vec4i],
    slot: wp.int32,
    low: wp.vec3i,
    s: wp.vec3i,
    tail: wp.vec4i,
):
    """Depth of a covered pixel; `low` holds the edges' lower words, s their steps to the pixel, tail the last words."""
    z = wp.vec3(bits_float(wp.uint32(tail[0])), bits_float(wp.uint32(tail[1])), bits_float(wp.uint32(tail[2])))
    inverse = bits_float(wp.uint32(tail[3]))
    if inverse > 0.0:
        e0, e1, e2 = low[0] + 256 * s[0], low[1] + 256 * s[1], low[2] + 256 * s[2]
        return accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), inverse, z))
    high = shared_words(scratch, False, slot + 3, wp.vec4i())
    f0, f1, f2 = edge_value(high[0], low[0], s[0]), edge_value(high[1], low[1], s[1]), edge_value(high[2], low[2], s[2])
    return accept_depth(view, fragment_depth(f0, f1, f2, -inverse, z))


@functools.cache
def make_draw_bins_kernel(depth_only: bool, behind: bool):
    """Kernel that draws the tiles from a first one on, of one kind of views.

    Args:
        depth_only: Of views that keep 32-bit depth keys only, else of those that keep ids.
        behind: Draw only what lies behind given keys.
    """
    word = wp.uint32 if depth_only else wp.uint64

    @wp.func
    def load_key(target: RasterTarget, view: View, x: wp.int32, y: wp.int32):
        key = wp.static(word(0))
        if x < view.width and y < view.height:
            if wp.static(depth_only):
                key = target.depth_keys[pixel_index(view, x, y)]
            else:
                key = target.keys[pixel_index(view, x, y)]
        return key

    @wp.func
    def store_key(target: RasterTarget, view: View, x: wp.int32, y: wp.int32, key: Any):
        if x < view.width and y < view.height:
            if wp.static(depth_only):
                target.depth_keys[pixel_index(view, x, y)] = key
            else:
                target.keys[pixel_index(view, x, y)] = key

    @wp.func
    def nearer(
        best: Any,
        target: RasterTarget,
        view: View,
        scratch: wp.array[wp.vec4i],
        slot: wp.int32,
        low: wp.vec3i,
        s: wp.vec3i,
        x: wp.int32,
        y: wp.int32,
    ):
        """The better of a key and that of a staged triangle at a pixel it covers."""
        tail = shared_words(scratch, False, slot + 4, wp.vec4i())
        z = staged_depth(view, scratch, slot, low, s, tail)
        result = best
        if z >= 0.0:
            if wp.static(depth_only):
                result = wp.max(best, float_bits(z))
            else:
                identity = wp.uint32(shared_words(scratch, False, slot + 3, wp.vec4i())[3])
                key = (wp.uint64(float_bits(z)) << wp.uint64(32)) | wp.uint64(ALL_BITS - identity)
                taken = True
                if wp.static(behind):
                    taken = x < view.width and y < view.height
                    if taken:
                        taken = key < target.behind[pixel_index(view, x, y)]
                if taken:
                    result = wp.max(best, key)
        return result

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def draw_bins_kernel(
        # Frame
        views: wp.array[View],
        bin_tiles: wp.array[wp.vec4i],
        # In
        bins: Bins,
        # Params
        first_tile: wp.int32,
        # Out
        out_target: RasterTarget,
    ):
        thread = wp.tid()
        b = first_tile + thread // BLOCK_DIM
        lane = thread % BLOCK_DIM
        first = bins.offsets[b]
        last = wp.min(first + bins.counts[b], bins.entries.shape[0])
        if first >= last:
            return
        tile = load_vec4i(bin_tiles, b)
        view = views[tile[0]]
        if (view.depth_only != 0) != wp.static(depth_only):
            return
        i, j = lane % BIN_TILE, lane // BIN_TILE
        x, y = tile[1] + i, tile[2] + j
        best0, best1 = load_key(out_target, view, x, y), load_key(out_target, view, x, y + ROWS)
        best2, best3 = load_key(out_target, view, x, y + 2 * ROWS), load_key(out_target, view, x, y + 3 * ROWS)
        corner_x, corner_y = tile[1] * 256 + 128, tile[2] * 256 + 128
        base = first
        none = wp.vec4i()
        while base < last:
            block_sync()
            mine = base + lane % block_width()
            if mine < last:
                large = out_target.large[bins.entries[mine]]
                stage_entry(bins.scratch, lane % block_width(), large, corner_x, corner_y)
            block_sync()
            for k in range(wp.min(block_width(), last - base)):
                slot = k * STAGED
                c0 = shared_words(bins.scratch, False, slot, none)
                c1 = shared_words(bins.scratch, False, slot + 1, none)
                c2 = shared_words(bins.scratch, False, slot + 2, none)
                low = wp.vec3i(c0[3], c1[3], c2[3])
                s = wp.vec3i(c0[1] * i + c0[2] * j, c1[1] * i + c1[2] * j, c2[1] * i + c2[2] * j)
                step = wp.vec3i(c0[2], c1[2], c2[2]) * ROWS
                if wp.min(c0[0] + s[0], wp.min(c1[0] + s[1], c2[0] + s[2])) >= 0:
                    best0 = nearer(best0, out_target, view, bins.scratch, slot, low, s, x, y)
                s = s + step
                if wp.min(c0[0] + s[0], wp.min(c1[0] + s[1], c2[0] + s[2])) >= 0:
                    best1 = nearer(best1, out_target, view, bins.scratch, slot, low, s, x, y + ROWS)
                s = s + step
                if wp.min(c0[0] + s[0], wp.min(c1[0] + s[1], c2[0] + s[2])) >= 0:
                    best2 = nearer(best2, out_target, view, bins.scratch, slot, low, s, x, y + 2 * ROWS)
                s = s + step
                if wp.min(c0[0] + s[0], wp.min(c1[0] + s[1], c2[0] + s[2])) >= 0:
                    best3 = nearer(best3, out_target, view, bins.scratch, slot, low, s, x, y + 3 * ROWS)
            base += block_width()
        store_key(out_target, view, x, y, best0)
        store_key(out_target, view, x, y + ROWS, best1)
        store_key(out_target, view, x, y + 2 * ROWS, best2)
        store_key(out_target, view, x, y + 3 * ROWS, best3)

    return draw_bins_kernel
