"""Bins: large triangles per 16 x 16 screen tile, in three steps: count, (scan,) fill, draw.

A team of lanes per triangle, a whole block where its box has many tiles, tests the tiles exactly. A tile's 256 threads
stage 256 entries at a time in shared memory and loop over them with the best key in a register, so no atomics and one
wait a batch. An entry that does not fit the lists is drawn by the lane that found it, with atomics: overflow costs time
and never a pixel. Edge values are 64-bit once a tile, 32-bit inside it: an edge that neither accepts nor rejects the
whole tile has |q| <= 2^29, and pixel steps are multiples of 256, so the shift loses nothing. The order of the lists
depends on the run, the keys do not. Block size 256.
"""

from __future__ import annotations

import functools

import warp as wp

from .coverage import accept_depth, edge_threshold, first_pixel, fragment_depth, huge_first, last_pixel, make_draw
from .intrinsics import bits_float, block_sync, block_width, float_bits, load_vec4i, shared_words
from .projection import pixel_index
from .structs import ALL_BITS, BIN_TILE, BIN_TILE_AREA, MODULE_OPTIONS, LargeTriangle, RasterTarget, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: In place of q: every pixel of the tile is inside the edge; no step inside a tile, at most 2^29, takes it below 0.
ACCEPTED = wp.constant(1073741824)
#: Words of four integers that a staged entry takes.
STAGED = wp.constant(5)
#: (depth_views, behind): what CI compiles.
VARIANTS = [(False, False), (True, False), (False, True), (True, True)]


@wp.struct
class Bins:
    """Lists of large triangles a tile."""

    counts: wp.array[wp.int32]  # entries found a tile; after the scan, the fill's cursors start from offsets
    offsets: wp.array[wp.int32]
    cursors: wp.array[wp.int32]
    entries: wp.array[wp.vec4i]  # triangle, and q of its three edges at the tile's first pixel, or ACCEPTED
    scratch: wp.array[wp.vec4i]  # stands in for shared memory on the CPU: 1280 elements


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
def edge_in_tile(a: wp.vec2i, b: wp.vec2i, x: wp.int32, y: wp.int32):
    """Q of an edge at a tile's first pixel centre: inside is q + a i + b j >= 0 for pixel steps i and j.

    The threshold is folded in before the shift. An edge that crosses the tile has |q| <= 15 (|a| + |b|) <= 2^29.
    """
    sx, sy = a[1] - b[1], b[0] - a[0]
    q = (edge_at(a, b, x, y) - wp.int64(edge_threshold(sx, sy))) >> wp.int64(8)
    if q + wp.int64(wp.min(sx, 0)) * wp.int64(15) + wp.int64(wp.min(sy, 0)) * wp.int64(15) >= wp.int64(0):
        return ACCEPTED
    return wp.int32(q)


@wp.func
def stage_edge(scratch: wp.array[wp.vec4i], slot: wp.int32, a: wp.vec2i, b: wp.vec2i, q: wp.int32, extra: wp.int32):
    """Share what the 32-bit test of an edge needs: q, its steps, and one more number."""
    shared_words(scratch, True, slot, wp.vec4i(q, a[1] - b[1], b[0] - a[0], extra))


@wp.func
def stage_entry(
    scratch: wp.array[wp.vec4i], lane: wp.int32, entry: wp.vec4i, t: LargeTriangle, x: wp.int32, y: wp.int32
):
    """Share an entry with the block: per edge (q, steps), exact edge values at the tile's first pixel, depth and id."""
    e0, e1, e2 = edge_at(t.p1, t.p2, x, y), edge_at(t.p2, t.p0, x, y), edge_at(t.p0, t.p1, x, y)
    area = wp.float32(edge_at(t.p0, t.p1, t.p2[0], t.p2[1]))
    slot = lane * STAGED
    stage_edge(scratch, slot, t.p1, t.p2, entry[1], high_word(e0))
    stage_edge(scratch, slot + 1, t.p2, t.p0, entry[2], high_word(e1))
    stage_edge(scratch, slot + 2, t.p0, t.p1, entry[3], high_word(e2))
    shared_words(
        scratch, True, slot + 3, wp.vec4i(wp.int32(e0), wp.int32(e1), wp.int32(e2), wp.int32(float_bits(area)))
    )
    bits = wp.vec3i(wp.int32(float_bits(t.z[0])), wp.int32(float_bits(t.z[1])), wp.int32(float_bits(t.z[2])))
    shared_words(scratch, True, slot + 4, wp.vec4i(bits[0], bits[1], bits[2], wp.int32(t.id)))


@wp.func
def high_word(value: wp.int64):
    """Upper 32 bits."""
    return wp.int32(value >> wp.int64(32))


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
    c0: wp.vec4i,
    c1: wp.vec4i,
    c2: wp.vec4i,
    s: wp.vec3i,
    z: wp.vec3,
):
    """Depth of a covered pixel; s holds the three edges' steps to it."""
    low = shared_words(scratch, False, slot + 3, wp.vec4i())
    e0 = edge_value(c0[3], low[0], s[0])
    e1 = edge_value(c1[3], low[1], s[1])
    e2 = edge_value(c2[3], low[2], s[2])
    return accept_depth(view, fragment_depth(e0, e1, e2, bits_float(wp.uint32(low[3])), z))


@wp.func
def triangle_misses(t: LargeTriangle, x: wp.int32, y: wp.int32, dx: wp.int32, dy: wp.int32):
    """Whether an edge alone shows that a tile has no pixel of a triangle."""
    return (
        edge_misses(t.p1, t.p2, x, y, dx, dy)
        or edge_misses(t.p2, t.p0, x, y, dx, dy)
        or edge_misses(t.p0, t.p1, x, y, dx, dy)
    )


@functools.cache
def make_bin_kernels(depth_views: bool, behind: bool):
    """(count, fill, draw) kernels."""
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
                        cx, cy = tx * (BIN_TILE * 256) + 128, ty * (BIN_TILE * 256) + 128
                        q0 = edge_in_tile(t.p1, t.p2, cx, cy)
                        q1 = edge_in_tile(t.p2, t.p0, cx, cy)
                        q2 = edge_in_tile(t.p0, t.p1, cx, cy)
                        bins.entries[place] = wp.vec4i(index, q0, q1, q2)
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

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def draw_bins_kernel(
        # Frame
        views: wp.array[View],
        bin_tiles: wp.array[wp.vec4i],
        # In
        bins: Bins,
        # Out
        out_target: RasterTarget,
    ):
        thread = wp.tid()
        b = thread // BIN_TILE_AREA
        lane = thread % BIN_TILE_AREA
        first = bins.offsets[b]
        last = wp.min(first + bins.counts[b], bins.entries.shape[0])
        if first >= last:
            return
        tile = bin_tiles[b]
        view = views[tile[0]]
        i, j = lane % BIN_TILE, lane // BIN_TILE
        x, y = tile[1] + i, tile[2] + j
        inside = x < view.width and y < view.height
        pixel = wp.int32(0)
        best = wp.uint64(0)
        limit = wp.uint64(0)
        best_bits = wp.uint32(0)
        if inside:
            pixel = pixel_index(view, x, y)
            if wp.static(depth_views):
                if view.depth_only != 0:
                    best_bits = out_target.depth_keys[pixel]
                else:
                    best = out_target.keys[pixel]
            else:
                best = out_target.keys[pixel]
            if wp.static(behind):
                if view.depth_only == 0:
                    limit = out_target.behind[pixel]
        corner_x, corner_y = tile[1] * 256 + 128, tile[2] * 256 + 128
        base = first
        none = wp.vec4i()
        while base < last:
            block_sync()
            mine = base + lane % block_width()
            if mine < last:
                entry = load_vec4i(bins.entries, mine)
                stage_entry(bins.scratch, lane % block_width(), entry, out_target.large[entry[0]], corner_x, corner_y)
            block_sync()
            for k in range(wp.min(block_width(), last - base)):
                slot = k * STAGED
                c0 = shared_words(bins.scratch, False, slot, none)
                c1 = shared_words(bins.scratch, False, slot + 1, none)
                c2 = shared_words(bins.scratch, False, slot + 2, none)
                s0, s1, s2 = c0[1] * i + c0[2] * j, c1[1] * i + c1[2] * j, c2[1] * i + c2[2] * j
                if inside and wp.min(c0[0] + s0, wp.min(c1[0] + s1, c2[0] + s2)) >= 0:
                    tail = shared_words(bins.scratch, False, slot + 4, none)
                    corners = wp.vec3(
                        bits_float(wp.uint32(tail[0])), bits_float(wp.uint32(tail[1])), bits_float(wp.uint32(tail[2]))
                    )
                    z = staged_depth(view, bins.scratch, slot, c0, c1, c2, wp.vec3i(s0, s1, s2), corners)
                    if z >= 0.0:
                        bits = float_bits(z)
                        key = (wp.uint64(bits) << wp.uint64(32)) | wp.uint64(ALL_BITS - wp.uint32(tail[3]))
                        taken = True
                        if wp.static(behind):
                            taken = view.depth_only != 0 or key < limit
                        if taken:
                            best = wp.max(best, key)
                            best_bits = wp.max(best_bits, bits)
            base += block_width()
        if inside:
            if wp.static(depth_views):
                if view.depth_only != 0:
                    out_target.depth_keys[pixel] = best_bits
                else:
                    out_target.keys[pixel] = best
            else:
                out_target.keys[pixel] = best

    return bin_triangles_kernel, draw_bins_kernel
