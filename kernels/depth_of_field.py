"""Depth of field: blur by circles of confusion, after the samples of a pixel are averaged. Block size 64.

`gather`: every texel of two by two pixels asks its neighbourhood whose circles cover it (scatter as gather; Jimenez
2014, "Next Generation Post Processing in Call of Duty: Advanced Warfare", for layers, weights by area, reach by tile
and half size; weights, reduction, fill and composite are ours). What lies behind the plane in focus and what lies
before it are two layers:

- behind: taps within the texel's own circle. A tap reaches no farther than the smaller of its own circle and the
  texel's, so a sharp object neither bleeds into a blurred background nor is bled over, and counts by the inverse of
  that circle's area, as its light is spread over it. The weights are normalised.
- before: taps within the largest circle of the neighbourhood before the plane in focus, which dilated tiles tell. A
  tap counts by the share of its circle that falls to the texel; the sum is the layer's coverage.
- hidden, where the texel itself lies before: the mean of the taps farther away, which shows where coverage ends.

Taps of large circles come from reduced copies of the image: level l has texels of 2^l pixels, and averages only
children on one side with circles of about one size. Every texel around a place is one tap, at its true distance, so no
bright point falls between taps. Circles are drawn smaller by what texels and interpolation spread by themselves.

`composite` brings the layers up to whole pixels: a pixel in focus keeps its colour, one of a small circle takes the
mean of the whole pixels in it, one of a larger circle its own layer's four texels, those of circles like its own first;
over all of them lies what is before the plane in focus.

Bytes a pixel: `pack` 12 in, 8/3 and 2 out; `gather` 4 + 6 out, taps from the caches; `composite` 12 in, 8 out, layers
from L2. Operations (PTX for sm_90): `gather` about 40 a tap of either layer, 75 taps for a circle of 5 texels, by a
quarter of the pixels; `composite` 150 for a pixel in focus, 350 where both layers show, and 60 a tap, 9 to 37 of them,
where a circle is small. A pixel in focus near which nothing lies before it takes no tap. No atomics; the same bits
from run to run.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .intrinsics import add_weighted, fast_reciprocal, fast_root, load_float, load_vec4i
from .lens import circle_of_confusion, circle_shape, disc_point, lens_scale, lens_terms, through_lens
from .lens_layers import (
    BEFORE,
    BEHIND,
    FAR_PX,
    HIDDEN,
    NEAR_PX,
    SHARP_PX,
    Taps,
    layer_first,
    make_layers,
    make_taps,
    reach_at,
    rows_of,
)
from .projection import pixel_block, pixel_in_block, pixel_index, pixel_of
from .sampling import Sample
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half image,): what CI compiles.
VARIANTS = [(True,), (False,)]
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
def mean_of(sums: wp.vec4, radius: wp.float32):
    """Mean colour of weighted sums, with a circle's radius."""
    mean = sums * (1.0 / sums[3])
    return wp.vec4(mean[0], mean[1], mean[2], radius)


@functools.cache
def make_gather(half: bool):
    """Kernel that gathers the layers; `half`: whether the plan keeps half4 images."""
    store_tap = make_taps(half)[1]
    behind, before = make_layers(half)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def gather_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        taps: Taps,
        far: wp.array[wp.float32],
        near: wp.array[wp.float32],
        reach: wp.array[wp.float32],
        # Params
        texels: wp.int32,
        first: wp.int32,
        # Out
        out_layers: Taps,
    ):
        """One thread a texel of level 1: the layers as its middle sees them."""
        thread = wp.tid() + first
        tile = load_vec4i(tiles, pixel_block(thread))
        place = pixel_in_block(thread)
        view = views[tile[0]]
        x, y = (tile[1] >> 1) + place[0], (tile[2] >> 1) + place[1]
        if view.depth_only != 0 or 2 * x >= view.width or 2 * y >= view.height:
            return
        rows = rows_of(view, taps.tiles, 1)
        i = rows.first + y * rows.pitch + x
        # Where the texel's four pixels meet.
        px, py = wp.float32(2 * x + 1), wp.float32(2 * y + 1)
        texel = wp.vec4()
        radius = far[thread]
        if radius > FAR_PX:
            sums = behind(taps, view, px, py, radius, texels)
            if sums[3] > 0.0:
                texel = mean_of(sums, radius)
        store_tap(out_layers, i + layer_first(taps.tiles, BEHIND), texel)
        cover, hidden = wp.vec4(), wp.vec4()
        radius = reach_at(reach, view, px, py)
        if radius > NEAR_PX:
            own = near[thread]
            layers = before(taps, view, px, py, radius, own, texels)
            cover = layers.before * (1.0 / wp.max(layers.before[3], 1.0))
            if layers.hidden[3] > 0.0:
                hidden = mean_of(layers.hidden, own)
        store_tap(out_layers, i + layer_first(taps.tiles, BEFORE), cover)
        store_tap(out_layers, i + layer_first(taps.tiles, HIDDEN), hidden)

    return gather_kernel


@functools.cache
def make_composite(half: bool):
    """Kernel that lays the layers over the image; `half`: whether the plan keeps half4 images."""
    load, store = make_image_codec(half)
    load_tap = make_taps(half)[0]

    @wp.func
    def sharp_mean(
        image: Image,
        depth: wp.array[wp.float32],
        view: View,
        x: wp.int32,
        y: wp.int32,
        lens: wp.vec2,
        own: wp.float32,
    ):
        """Mean of the pixels in the small circle of a pixel, signed as it is, and the sum of their weights."""
        radius = wp.abs(own)
        shape = circle_shape(view)
        fx, fy = 1.0 / shape[0], 1.0 / shape[1]
        rim = radius + 0.5
        ny = wp.int32(rim * shape[1])
        sums = wp.vec4()
        for j in range(-ny, ny + 1):
            dy = wp.float32(j) * fy
            nx = wp.int32(fast_root(wp.max(rim * rim - dy * dy, 0.0)) * shape[0])
            row = pixel_index(view, 0, wp.clamp(y + j, 0, view.height - 1))
            dx = -wp.float32(nx) * fx
            for tx in range(x - nx, x + nx + 1):
                i = row + wp.clamp(tx, 0, view.width - 1)
                s = circle_of_confusion(lens, load_float(depth, i), FAR_PX + 1.0)
                c = store_limit(load(image, i), HALF_MAX)
                distance = fast_root(dx * dx + dy * dy)
                dx = dx + fx
                # Behind as `behind` takes it; before the plane in focus all that is farther away shows through.
                circle = wp.where(own < 0.0, radius, wp.min(wp.abs(s), radius))
                # What belongs to the layer before the plane in focus is left to it.
                share = wp.clamp(circle - distance + 0.5, 0.0, 1.0) * wp.clamp(NEAR_PX + 1.0 + s, 0.0, 1.0)
                w = share * fast_reciprocal(wp.max(circle * circle, 0.25))
                sums = add_weighted(sums, wp.vec4(c[0], c[1], c[2], 0.0), w)
        return sums

    @wp.func
    def alike(sums: wp.vec4, texel: wp.vec4, weight: wp.float32, inverse: wp.float32):
        """Sums with a layer's texel, which counts by how near its circle comes to the pixel's, 1 / inverse."""
        w = wp.where(texel[3] > 0.0, weight * wp.max(1.0 - 2.0 * wp.abs(texel[3] * inverse - 1.0), 0.001), 0.0)
        return add_weighted(sums, texel, w)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def composite_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        depth: wp.array[wp.float32],
        layers: Taps,
        reach: wp.array[wp.float32],
        # Params
        limit: wp.float32,
        first: wp.int32,
        # Out
        out_image: Image,
    ):
        """One thread a pixel: from its own colour over its own layer's to what lies before it."""
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        color = load(image, i)
        lens = lens_terms(view)
        s = circle_of_confusion(lens, load_float(depth, i), limit)
        circle = wp.abs(s)
        # The four texels around the pixel's middle: weights 9, 3, 3, 1 of 16.
        rows = rows_of(view, layers.tiles, 1)
        tx, ty = x >> 1, y >> 1
        upper = rows.first + ty * rows.pitch
        lower = rows.first + wp.clamp(ty + 2 * (y & 1) - 1, 0, rows.last_y) * rows.pitch
        ux = wp.clamp(tx + 2 * (x & 1) - 1, 0, rows.last_x)
        cover = wp.vec4()
        if load_float(reach, view.bin_offset + (y >> 4) * view.bins_x + (x >> 4)) > NEAR_PX:
            k = layer_first(layers.tiles, BEFORE)
            cover = load_tap(layers, k + upper + tx) * 9.0 + load_tap(layers, k + upper + ux) * 3.0
            cover = cover + load_tap(layers, k + lower + tx) * 3.0 + load_tap(layers, k + lower + ux)
        if circle > SHARP_PX:
            wide = wp.clamp(circle - wp.where(s > 0.0, FAR_PX, NEAR_PX), 0.0, 1.0)
            small = wide < 1.0
            if s < 0.0:
                # Of a circle's share in the layer before it, what is not covered there is hidden by the pixel itself.
                left = 1.0 - 0.0625 * cover[3]
                wide = wp.max(wide - 0.0625 * cover[3], 0.0) * fast_reciprocal(wp.max(left, 0.001))
            if small:
                sums = sharp_mean(image, depth, view, x, y, lens, s)
                if sums[3] > 0.0:
                    color = wp.vec3(sums[0], sums[1], sums[2]) * (1.0 / sums[3])
            if wide > 0.0:
                k = layer_first(layers.tiles, wp.where(s > 0.0, BEHIND, HIDDEN))
                inverse = fast_reciprocal(circle)
                sums = alike(wp.vec4(), load_tap(layers, k + upper + tx), 9.0, inverse)
                sums = alike(sums, load_tap(layers, k + upper + ux), 3.0, inverse)
                sums = alike(sums, load_tap(layers, k + lower + tx), 3.0, inverse)
                sums = alike(sums, load_tap(layers, k + lower + ux), 1.0, inverse)
                if sums[3] > 0.0:
                    mean = wp.vec3(sums[0], sums[1], sums[2]) * (1.0 / sums[3])
                    color = color + (mean - color) * wp.min(wide, 1.0)
        if cover[3] > 0.0:
            mean = wp.vec3(cover[0], cover[1], cover[2]) * (1.0 / cover[3])
            color = color + (mean - color) * wp.min(0.0625 * cover[3], 1.0)
        store(out_image, i, color)

    return composite_kernel


@functools.cache
def make_depth_of_field_kernels(half: bool):
    """(gather, composite) kernels; `half`: whether the plan keeps half4 images."""
    return make_gather(half), make_composite(half)
