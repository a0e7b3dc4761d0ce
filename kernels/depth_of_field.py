"""Depth of field: blur by circles of confusion, after the samples of a pixel are averaged. Block size 64.

`gather`: every pixel asks its neighbourhood whose circles cover it (scatter as gather; Jimenez 2014, "Next Generation
Post Processing in Call of Duty: Advanced Warfare", for layers, weights by area and reach by tile; weights, reduction
and fill are ours). What lies behind the plane in focus and what lies before it are two layers:

- behind: taps within the pixel's own circle. A tap reaches no farther than the smaller of its own circle and the
  pixel's, so a sharp object neither bleeds into a blurred background nor is bled over, and counts by the inverse of
  that circle's area, as its light is spread over it. The weights are normalised.
- before: taps within the largest circle of the neighbourhood before the plane in focus, which dilated tiles tell. A
  tap counts by the share of its circle that falls to the pixel; the sum is the layer's coverage. Taps nearer than the
  pixel are laid over those as near as it, and these over what fills in for the part that such a pixel hides: the mean
  of the taps farther away.

Taps of large circles come from reduced copies of the image: level l has texels of 2^l pixels, and averages only
children on one side with circles of about one size. Every texel around a pixel is one tap, at its true distance, so no
bright point falls between taps and nothing shows where the texels lie. All levels lie in tiles of 16 x 16 pixels, one
texel one load: half4 of colour and signed radius, or vec4 in float32 plans.

Bytes a pixel: 12 in, 8 + 8/3 out for the levels; image in and out 16, taps from the caches. Operations: about 30 a tap,
a pixel in focus takes none, one of a circle of n texels (2 n + 1)^2. No atomics; the same bits from run to run.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .intrinsics import load_vec4i
from .lens import circle_of_confusion, disc_point, lens_scale, through_lens
from .lens_layers import (
    NEAR_TOP,
    REDUCED_TEXELS,
    Taps,
    make_layers,
    make_taps,
    merged,
    reach_at,
    tap_index,
    texel_index,
)
from .projection import pixel_in_block, pixel_index
from .sampling import Sample
from .structs import BIN_TILE, MODULE_OPTIONS, PIXEL_BLOCK_AREA, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (rung, half image): what CI compiles.
VARIANTS = [("gather", True), ("gather", False), ("plane_lerp", True), ("plane_lerp", False)]
#: Circles smaller than this radius are points [px]: no tap of theirs leaves the pixel.
SHARP_PX = wp.constant(wp.float32(0.5))
#: Radiance that goes into sums: half's range.
HALF_MAX = wp.constant(wp.float32(65504.0))


@wp.kernel(grid_stride=False)
def lens_samples_kernel(
    # In
    samples: wp.array[Sample],
    counter: wp.array[wp.int32],
    # Out
    out_views: wp.array[View],
):
    """One thread a view: look through the sample's point of the lens."""
    v = wp.tid()
    view = out_views[v]
    if view.depth_only == 0 and lens_scale(view) > 0.0:
        lens = samples[wp.min(counter[0], samples.shape[0] - 1)].lens
        out_views[v] = through_lens(view, disc_point(lens[0], lens[1]))


@wp.func
def over(color: wp.vec3, sums: wp.vec3, weight: wp.float32):
    """A layer of that coverage, at most 1, laid over a colour."""
    return color + (sums * (1.0 / weight) - color) * wp.min(weight, 1.0)


@functools.cache
def make_depth_of_field_kernels(rung: str, half: bool):
    """Kernels of a rung: (pack, reduce, dilate, gather) or (rows, columns).

    Args:
        rung: gather or plane_lerp.
        half: Whether the plan keeps half4 images.
    """
    return make_gather(half) if rung == "gather" else make_plane_lerp(half)


@functools.cache
def make_gather(half: bool):
    """(pack, reduce, dilate, gather) kernels; `half`: whether the plan keeps half4 images."""
    load, store = make_image_codec(half)
    load_tap, store_tap = make_taps(half)
    behind, before = make_layers(half)

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
        out_near: wp.array[wp.float32],
    ):
        """One thread a square of four pixels: levels 0 and 1, and the nearest circle before the plane in focus."""
        thread = wp.tid() + first
        tile = load_vec4i(tiles, thread // 64)
        view = views[tile[0]]
        lane = thread % 64
        x, y = tile[1] + 2 * (lane & 7), tile[2] + 2 * (lane >> 3)
        if view.depth_only != 0 or x >= view.width or y >= view.height:
            # No tap reads it, but dilation looks at every square of a tile.
            out_near[thread] = 0.0
            return
        # A square that crosses the edge repeats what is inside.
        right, down = wp.min(x + 1, view.width - 1), wp.min(y + 1, view.height - 1)
        i, j = pixel_index(view, x, y), pixel_index(view, right, y)
        k, m = pixel_index(view, x, down), pixel_index(view, right, down)
        ca, cb = store_limit(load(image, i), HALF_MAX), store_limit(load(image, j), HALF_MAX)
        cc, cd = store_limit(load(image, k), HALF_MAX), store_limit(load(image, m), HALF_MAX)
        a = wp.vec4(ca[0], ca[1], ca[2], circle_of_confusion(view, depth[i], limit))
        b = wp.vec4(cb[0], cb[1], cb[2], circle_of_confusion(view, depth[j], limit))
        c = wp.vec4(cc[0], cc[1], cc[2], circle_of_confusion(view, depth[k], limit))
        d = wp.vec4(cd[0], cd[1], cd[2], circle_of_confusion(view, depth[m], limit))
        store_tap(out_taps, tap_index(view, out_taps.tiles, 0, x, y), a)
        store_tap(out_taps, tap_index(view, out_taps.tiles, 0, right, y), b)
        store_tap(out_taps, tap_index(view, out_taps.tiles, 0, x, down), c)
        store_tap(out_taps, tap_index(view, out_taps.tiles, 0, right, down), d)
        store_tap(out_taps, tap_index(view, out_taps.tiles, 1, x, y), merged(a, b, c, d))
        out_near[thread] = wp.max(0.0, -wp.min(wp.min(a[3], b[3]), wp.min(c[3], d[3])))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def reduce_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # Params
        level: wp.int32,
        first: wp.int32,
        # Out
        out_taps: Taps,
        out_near: wp.array[wp.float32],
    ):
        """One thread a texel of a level: merge four of the level below."""
        thread = wp.tid() + first
        texels = 256 >> (2 * level)
        side = 16 >> level
        tile, local = thread // texels, thread % texels
        row = load_vec4i(tiles, tile)
        view = views[row[0]]
        x, y = row[1] + ((local % side) << level), row[2] + ((local // side) << level)
        # Children in the texel order of their own level; those beyond the edge hold nothing.
        below = (2 * (local // side)) * (2 * side) + 2 * (local % side)
        # Nearest circles have no level 0, hence one level's offset less.
        n = texel_index(out_taps.tiles, tile, level - 1, below) - 256 * out_taps.tiles
        near = wp.max(wp.max(out_near[n], out_near[n + 1]), wp.max(out_near[n + 2 * side], out_near[n + 2 * side + 1]))
        out_near[texel_index(out_taps.tiles, tile, level, local) - 256 * out_taps.tiles] = near
        if view.depth_only != 0 or x >= view.width or y >= view.height:
            return
        half_side = 1 << (level - 1)
        right, down = wp.min(x + half_side, view.width - 1), wp.min(y + half_side, view.height - 1)
        a = load_tap(out_taps, tap_index(view, out_taps.tiles, level - 1, x, y))
        b = load_tap(out_taps, tap_index(view, out_taps.tiles, level - 1, right, y))
        c = load_tap(out_taps, tap_index(view, out_taps.tiles, level - 1, x, down))
        d = load_tap(out_taps, tap_index(view, out_taps.tiles, level - 1, right, down))
        store_tap(out_taps, tap_index(view, out_taps.tiles, level, x, y), merged(a, b, c, d))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def dilate_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        near: wp.array[wp.float32],
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
        base = NEAR_TOP * (near.shape[0] // wp.static(REDUCED_TEXELS))
        span = wp.int32(wp.ceil(limit * 0.0625)) + 1
        cx, cy = row[1] >> 4, row[2] >> 4
        reach = wp.float32(0.0)
        for y in range(wp.max(cy - span, 0), wp.min(cy + span, (view.height - 1) >> 4) + 1):
            for x in range(wp.max(cx - span, 0), wp.min(cx + span, view.bins_x - 1) + 1):
                n = base + 4 * (view.bin_offset + y * view.bins_x + x)
                largest = wp.max(wp.max(near[n], near[n + 1]), wp.max(near[n + 2], near[n + 3]))
                # Gap between the tiles [px], less the one tile that interpolation between tiles looks beyond.
                gap = wp.max(wp.max(wp.abs(x - cx), wp.abs(y - cy)) - 2, 0) * BIN_TILE
                if largest > wp.float32(gap):
                    reach = wp.max(reach, largest)
        out_reach[tile] = reach

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def gather_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        depth: wp.array[wp.float32],
        taps: Taps,
        reach: wp.array[wp.float32],
        # Params
        limit: wp.float32,
        texels: wp.int32,
        first: wp.int32,
        # Out
        out_image: Image,
    ):
        """One thread a pixel."""
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        color = load(image, i)
        s = circle_of_confusion(view, depth[i], limit)
        if s > SHARP_PX:
            sums = behind(taps, view, x, y, s, texels)
            if sums[3] > 0.0:
                color = wp.vec3(sums[0], sums[1], sums[2]) * (1.0 / sums[3])
        radius = reach_at(reach, view, x, y)
        if radius > SHARP_PX:
            layers = before(taps, view, x, y, radius, s, texels)
            if layers.fill_weight > 0.0 and s < 0.0:
                filled = layers.fill * (1.0 / layers.fill_weight)
                color = color + (filled - color) * wp.min(-s, 1.0)
            if layers.same_weight > 0.0:
                color = over(color, layers.same, layers.same_weight)
            if layers.front_weight > 0.0:
                color = over(color, layers.front, layers.front_weight)
        store(out_image, i, color)

    return pack_kernel, reduce_kernel, dilate_kernel, gather_kernel


@functools.cache
def make_plane_lerp(half: bool):
    """(rows, columns) kernels; `half`: whether the plan keeps half4 images."""
    load, store = make_image_codec(half)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def rows_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        weights: wp.array[wp.float32],
        # Params
        first: wp.int32,
        # Out
        out_blurred: Image,
    ):
        """One thread a pixel: blur along x; what lies beyond the edge repeats it."""
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        radius = weights.shape[0] - 1
        total = wp.vec3(0.0, 0.0, 0.0)
        for k in range(-radius, radius + 1):
            j = pixel_index(view, wp.clamp(x + k, 0, view.width - 1), y)
            total = total + store_limit(load(image, j), HALF_MAX) * weights[wp.abs(k)]
        store(out_blurred, pixel_index(view, x, y), total)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def columns_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        blurred: Image,
        depth: wp.array[wp.float32],
        weights: wp.array[wp.float32],
        # Params
        power: wp.float32,
        first: wp.int32,
        # Out
        out_image: Image,
    ):
        """One thread a pixel: blur along y, then mix by distance from the plane in focus; power < 0: the lens's."""
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        color = load(image, i)
        radius = weights.shape[0] - 1
        scale = power
        if power < 0.0:
            scale = lens_scale(view) / (view.focus_distance * wp.float32(radius))
        share = wp.min(scale * wp.abs(1.0 - view.focus_distance / depth[i]), 1.0)
        if share > 0.0 and lens_scale(view) > 0.0:
            total = wp.vec3(0.0, 0.0, 0.0)
            for k in range(-radius, radius + 1):
                j = pixel_index(view, x, wp.clamp(y + k, 0, view.height - 1))
                total = total + load(blurred, j) * weights[wp.abs(k)]
            color = color + (total - color) * share
        store(out_image, i, color)

    return rows_kernel, columns_kernel
