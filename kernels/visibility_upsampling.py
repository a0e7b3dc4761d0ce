"""Doubling the size of an image of occlusion words (see ambient_visibility.py).

Half-size pixel (X, Y) is pixel (2 X, 2 Y), which keeps its visibility. A pixel between two of them, or amid four, takes
their average, weighted by how far their affine depths lie from the line through it, for each two on opposite sides as
in the blur (bilateral.py; after Kopf et al. 2007, "Joint Bilateral Upsampling"). Where none lies near, all count alike.

Block size 64, one thread a 2 x 2 of pixels over raster bins; deterministic, arithmetic is + - * / and fused
multiply-adds. A pixel moves 1 + 3 bytes in and 4 out, 17 MB at 1920 x 1080, 4 us at 4.2 TB/s, and takes about 60
instructions, a third of that where the four visibilities are the same.
"""

from __future__ import annotations

import warp as wp

from .ambient_visibility import CODE_MASK, affine_depth, half_index
from .bilateral import final_visibility, rough_reciprocal, smaller_slope, tolerance_of, whole_code, word_visibility
from .intrinsics import bits_float, fma, load_float, load_vec4i, load_word
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: What a neighbour counts for that lies on another surface, as a share of the tolerance.
STRANGER = wp.constant(1.0e-4)
#: A word's depth is no nearer than half of this, as a share of it.
SLACK = wp.constant(1.0e-4)


@wp.func
def add_pair(
    sums: wp.vec2, before: wp.uint32, after: wp.uint32, affine: wp.float32, tolerance: wp.float32, own: wp.float32
):
    """(weighted difference of codes from `own`, weight) after the words on two opposite sides of a pixel."""
    slope = smaller_slope(affine - bits_float(before), bits_float(after) - affine)
    # The maximum is 0 for the background and whatever is not finite.
    low = wp.max(tolerance - wp.abs(bits_float(before) - (affine - slope)), 0.0) + STRANGER * tolerance
    high = wp.max(tolerance - wp.abs(bits_float(after) - (affine + slope)), 0.0) + STRANGER * tolerance
    total = fma(low, whole_code(before) - own, fma(high, whole_code(after) - own, sums[0]))
    return wp.vec2(total, sums[1] + (low + high))


@wp.func
def visibility_amid(
    view: View,
    depth: wp.float32,
    nw: wp.uint32,
    ne: wp.uint32,
    sw: wp.uint32,
    se: wp.uint32,
    crossed: wp.bool,
    radius: wp.float32,
):
    """Visibility of a pixel at a linear depth between nw and se, and between sw and ne where it is crossed."""
    if not wp.isfinite(depth):
        return wp.float32(1.0)
    affine = affine_depth(view, depth)
    tolerance = fma(SLACK, wp.abs(affine), tolerance_of(view, affine, radius))
    own = whole_code(nw)
    sums = add_pair(wp.vec2(0.0, 0.0), nw, se, affine, tolerance, own)
    if crossed:
        sums = add_pair(sums, sw, ne, affine, tolerance, own)
    # Differences from one of them: an average of equals is exact.
    return word_visibility(nw) - sums[0] * rough_reciprocal(sums[1]) * (1.0 / 255.0)


@wp.func
def keep_visible(depth: wp.float32, visibility: wp.float32):
    """A visibility, or 1 on the background."""
    return wp.where(wp.isfinite(depth), visibility, 1.0)


@wp.kernel(grid_stride=False)
def upsample_kernel(
    # Frame
    views: wp.array[View],
    bin_tiles: wp.array[wp.vec4i],
    # In
    depth: wp.array[wp.float32],
    words: wp.array[wp.uint32],
    # Params
    radius: wp.float32,
    power: wp.float32,
    first: wp.int32,
    # Out
    out_visibility: wp.array[wp.float32],
):
    """Visibility in [0, 1] of the full image, 1 on the background."""
    thread = wp.tid() + first
    tile = load_vec4i(bin_tiles, pixel_block(thread))
    view = views[tile[0]]
    place = pixel_in_block(thread)
    x, y = tile[1] + 2 * place[0], tile[2] + 2 * place[1]
    if x >= view.width or y >= view.height or view.depth_only != 0:
        return
    i, k, pitch = pixel_index(view, x, y), half_index(view, x >> 1, y >> 1), view.bins_x * 8
    # Where there is no next half-size pixel, the last one stands for it.
    right, below = wp.where(x + 2 < view.width, 1, 0), wp.where(y + 2 < view.height, pitch, 0)
    nw, ne = load_word(words, k), load_word(words, k + right)
    sw, se = load_word(words, k + below), load_word(words, k + below + right)
    v = word_visibility(nw)
    alike = (((ne ^ nw) | (sw ^ nw) | (se ^ nw)) & CODE_MASK) == wp.uint32(0)
    out_visibility[i] = final_visibility(v, power)
    if x + 1 < view.width:
        d = load_float(depth, i + 1)
        east = keep_visible(d, v)
        if not alike:
            east = visibility_amid(view, d, nw, nw, ne, ne, False, radius)
        out_visibility[i + 1] = final_visibility(east, power)
    if y + 1 < view.height:
        i += view.row_pitch
        d = load_float(depth, i)
        south = keep_visible(d, v)
        if not alike:
            south = visibility_amid(view, d, nw, nw, sw, sw, False, radius)
        out_visibility[i] = final_visibility(south, power)
        if x + 1 < view.width:
            d = load_float(depth, i + 1)
            middle = keep_visible(d, v)
            if not alike:
                middle = visibility_amid(view, d, nw, ne, sw, se, True, radius)
            out_visibility[i + 1] = final_visibility(middle, power)
