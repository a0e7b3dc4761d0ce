"""Bloom, the reference: a sum of Gaussians of the bright part, each summed over the pixels at full size in float32.

A Gaussian is sampled at whole pixels out to five standard deviations and its weights are divided by their sum, along
rows, then along columns. Beyond the picture's edge the picture is mirrored as often as it takes, so that light is
neither lost nor made. Block size 64, one thread a pixel; the order of sums is fixed: bit-identical on all devices.
Reads for each Gaussian of deviation s: 20 s a pixel of 12 bytes, from the caches.
"""

from __future__ import annotations

import functools

import warp as wp

from .bloom_bright import bright_of
from .intrinsics import load_vec4i, unpack_half3
from .projection import pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, PIXEL_BLOCK_AREA, Bloom, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half radiance): what CI compiles.
VARIANTS = [(True,), (False,)]


@wp.struct
class Gaussian:
    """One Gaussian of a view."""

    first: wp.int32  # first weight: that of the middle pixel, then outwards
    radius: wp.int32  # pixels to each side
    share: wp.float32  # of all Gaussians' light


@wp.func
def folded(i: wp.int32, count: wp.int32):
    """Index of a pixel in the picture mirrored at both edges without end."""
    j = i % (2 * count)
    if j < 0:
        j += 2 * count
    if j >= count:
        j = 2 * count - 1 - j
    return j


@wp.func
def blurred(
    values: wp.array[wp.vec3],
    g: Gaussian,
    weights: wp.array[wp.float32],
    start: wp.int32,
    step: wp.int32,
    at: wp.int32,
    count: wp.int32,
):
    """Sum of a line of pixels, mirrored, under a Gaussian around one of them.

    Args:
        values: The picture.
        g: The Gaussian.
        weights: Weights of all Gaussians.
        start: Index of the line's first pixel.
        step: What leads from one to the next.
        at: Pixel of the line.
        count: Pixels of the line.
    """
    total = wp.vec3()
    # From outside inwards: small terms first.
    for k in range(g.radius):
        d = g.radius - k
        pair = values[start + folded(at - d, count) * step] + values[start + folded(at + d, count) * step]
        total += pair * weights[g.first + d]
    return total + values[start + at * step] * weights[g.first]


@functools.cache
def make_bright_pixels_kernel(half: bool):
    """Kernel that keeps the bright part of every pixel.

    Args:
        half: Read the half4 radiance, else the float32 colour.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def bright_pixels_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        bloom: Bloom,
        # Params
        first: wp.int32,
        # Out
        out_bright: wp.array[wp.vec3],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height or view.bloom <= 0.0:
            return
        i = pixel_index(view, x, y)
        if wp.static(half):
            out_bright[i] = bright_of(unpack_half3(radiance[i]), view.exposure, bloom)
        else:
            out_bright[i] = bright_of(color[i], view.exposure, bloom)

    return bright_pixels_kernel


@wp.kernel(grid_stride=False)
def blur_rows_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    bright: wp.array[wp.vec3],
    gaussians: wp.array[Gaussian],
    weights: wp.array[wp.float32],
    # Params
    per_view: wp.int32,
    index: wp.int32,
    first: wp.int32,
    # Out
    out_rows: wp.array[wp.vec3],
):
    """Blur along rows by one Gaussian."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
    place = pixel_in_block(thread)
    view = views[block[0]]
    x, y = block[1] + place[0], block[2] + place[1]
    g = gaussians[block[0] * per_view + index]
    if x >= view.width or y >= view.height or view.bloom <= 0.0 or g.share <= 0.0:
        return
    row = pixel_index(view, 0, y)
    out_rows[row + x] = blurred(bright, g, weights, row, 1, x, view.width)


@wp.kernel(grid_stride=False)
def blur_columns_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    rows: wp.array[wp.vec3],
    gaussians: wp.array[Gaussian],
    weights: wp.array[wp.float32],
    # Params
    per_view: wp.int32,
    index: wp.int32,
    first: wp.int32,
    # Out
    out_bloom: wp.array[wp.vec3],
):
    """Blur along columns by one Gaussian and add its share to the sum; the first one begins it."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
    place = pixel_in_block(thread)
    view = views[block[0]]
    x, y = block[1] + place[0], block[2] + place[1]
    g = gaussians[block[0] * per_view + index]
    if x >= view.width or y >= view.height or view.bloom <= 0.0 or g.share <= 0.0:
        return
    total = blurred(rows, g, weights, pixel_index(view, x, 0), view.row_pitch, y, view.height) * g.share
    i = pixel_index(view, x, y)
    if index > 0:
        total += out_bloom[i]
    out_bloom[i] = total
