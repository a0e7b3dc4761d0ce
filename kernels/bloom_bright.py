"""Bloom's bright parts: which part of a pixel's light scatters, and level 1, which gathers it from the picture.

A pixel scatters what it has above a threshold with a soft start (`bright_part`). A texel of level 1 sees 4 x 4 pixels
with taps 1 3 3 1 along each axis, the narrowest ones that neither shift nor favour a pixel, each pixel weighted by
1 / (1 + luminance / limit) so that a lone bright one does not flicker (Karis 2013, "Tone Mapping", where the limit is
1).

A warp makes a strip of 30 x 4 texels, two strips a block of 64: each lane walks down a column, two rows of two pixels
at a time, and has its neighbours' pixels from their lanes. So a pixel is loaded and weighed 1.33 times, edges and all.
Where none of a warp's 128 pixels scatters, which 13 operations a lane tell, their sums are known.

Bytes for P pixels: 8 P read (12 P in float32) once and a third again from the caches, 2 P written.
Instructions a pixel of a strip (PTX): about 30 where the warp's are dark, up to 90 more where they are not, a
reciprocal among them.
"""

from __future__ import annotations

import functools

import warp as wp

from .bloom import MOST, half_texel, mirrored, word_value
from .intrinsics import load_vec4i, pack_half4, store_double_word
from .lanes import any_lane, from_lane, warp_width
from .projection import pixel_block, pixel_index
from .structs import MODULE_OPTIONS, Bloom, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Smallest peak that is told from smaller ones: its reciprocal is a normal number.
LEAST_PEAK = wp.constant(2.0**-100)
MAX_FLOAT = wp.constant(3.4028234e38)
#: Lanes of a warp. Each but the first and the last makes a column of level 1, which needs both neighbours' pixels.
LANES = wp.constant(32)
STRIP_WIDTH = LANES - 2
#: Texels down a column; a block has two strips, one below the other.
STRIP_HEIGHT = wp.constant(4)
#: (half radiance, weighted against fireflies): what CI compiles.
VARIANTS = [(half, weighted) for half in (True, False) for weighted in (True, False)]


@wp.func
def exposed(value: wp.vec3, exposure: wp.float32):
    """Exposed radiance in [0, 65504]; a pixel with a component that is negative, infinite or NaN is black."""
    # One comparison sees NaN and infinity in any component; min drops NaN, but the sum does not.
    lowest = wp.min(value[0], wp.min(value[1], value[2]))
    if not (wp.where(lowest < 0.0, wp.inf, value[0] + value[1] + value[2]) <= MAX_FLOAT):
        return wp.vec3()
    v = value * exposure
    return wp.vec3(wp.min(v[0], MOST), wp.min(v[1], MOST), wp.min(v[2], MOST))


@wp.func
def highest(v: wp.vec3):
    """Largest component."""
    return wp.max(v[0], wp.max(v[1], v[2]))


@wp.func
def part_above(peak: wp.float32, bloom: Bloom):
    """How much of a peak scatters: max(clamp(p - t + k, 0, 2 k)^2 / (4 k), p - t) with threshold t and knee k."""
    above = peak - bloom.threshold
    start = wp.clamp(above + bloom.knee, 0.0, 2.0 * bloom.knee)
    return wp.max(start * start * bloom.soft, above)


@wp.func
def bright_part(v: wp.vec3, bloom: Bloom):
    """Part of exposed radiance that scatters: all above the threshold, a parabola around it, its hue kept.

    The share is continuous in value and slope, exactly 0 up to t - k and exactly 1 where t = 0.
    """
    peak = highest(v)
    part = part_above(peak, bloom)
    if part <= 0.0:
        return wp.vec3()
    return v * (part / peak)


@wp.func
def weighted_part(v: wp.vec3, bloom: Bloom):
    """`bright_part` b times its weight 1 / (1 + luminance(b) / limit), and the weight, by one division.

    With part q of peak p, both are fractions of p + luminance(v) q / limit; peaks below 2^-100 count as that.
    """
    peak = wp.max(highest(v), LEAST_PEAK)
    part = part_above(peak, bloom)
    if part <= 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 1.0)
    luminance = 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]
    scale = 1.0 / (peak + luminance * part * bloom.firefly)
    b = v * (part * scale)
    return wp.vec4(b[0], b[1], b[2], peak * scale)


@wp.func
def may_scatter(value: wp.vec3, exposure: wp.float32, bloom: Bloom):
    """Whether a pixel may have a bright part: false wherever it is 0, but for bad values and rounding; six operations.

    It is `bright_part`'s own start of the curve, rounded alike: the product with the exposure is monotone.
    """
    above = highest(value) * exposure - bloom.threshold
    return above + bloom.knee > 0.0


@wp.func
def bright_of(value: wp.vec3, exposure: wp.float32, bloom: Bloom):
    """Bright part of a pixel's radiance, exposed."""
    if not may_scatter(value, exposure, bloom):
        return wp.vec3()
    return bright_part(exposed(value, exposure), bloom)


@wp.struct
class PixelPair:
    """Radiance of two pixels side by side."""

    left: wp.vec3
    right: wp.vec3


@wp.struct
class Rows:
    """Two pixels of each of two rows, and the indices of the rows' first pixels."""

    upper: PixelPair
    lower: PixelPair
    upper_index: wp.int32
    lower_index: wp.int32


@wp.struct
class RowSums:
    """Weighted sums along two rows of pixels, and of the weights."""

    upper: wp.vec4
    lower: wp.vec4
    lit: wp.bool  # whether any of the warp's pixels may scatter; the sums are those of black pixels where none does


@functools.cache
def make_bright_kernel(half: bool, weighted: bool):
    """Kernel that makes level 1 from the picture.

    Args:
        half: Read the half4 radiance, else the float32 colour.
        weighted: Weigh pixels by 1 / (1 + luminance / limit) of their bright part.
    """

    @wp.func
    def pixel(radiance: wp.array[wp.uint64], color: wp.array[wp.vec3], i: wp.int32):
        if wp.static(half):
            return word_value(radiance, i)
        else:
            return color[i]

    @wp.func
    def weighed(value: wp.vec3, exposure: wp.float32, bloom: Bloom):
        """Bright part of a pixel times its weight, and the weight."""
        if wp.static(weighted):
            if not may_scatter(value, exposure, bloom):
                return wp.vec4(0.0, 0.0, 0.0, 1.0)
            return weighted_part(exposed(value, exposure), bloom)
        else:
            b = bright_of(value, exposure, bloom)
            return wp.vec4(b[0], b[1], b[2], 1.0)

    @wp.func
    def row_sum(
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        row: wp.int32,
        columns: wp.vec4i,
        pair: PixelPair,
        exposure: wp.float32,
        bloom: Bloom,
    ):
        """Four pixels of a row, weighed and summed by 1 3 3 1: the lane's own pair and one of either neighbour's."""
        a, b = weighed(pair.left, exposure, bloom), weighed(pair.right, exposure, bloom)
        if warp_width() > 1:
            return (from_lane(b, -1) + from_lane(a, 1)) + (a + b) * 3.0
        before = weighed(pixel(radiance, color, row + columns[0]), exposure, bloom)
        after = weighed(pixel(radiance, color, row + columns[3]), exposure, bloom)
        return (before + after) + (a + b) * 3.0

    @wp.func
    def load_rows(radiance: wp.array[wp.uint64], color: wp.array[wp.vec3], view: View, columns: wp.vec4i, y: wp.int32):
        """Pixels of rows y - 1 and y that are the lane's own."""
        rows = Rows()
        rows.upper_index = pixel_index(view, 0, mirrored(y - 1, view.height, 2 * view.height))
        rows.lower_index = pixel_index(view, 0, mirrored(y, view.height, 2 * view.height))
        rows.upper.left = pixel(radiance, color, rows.upper_index + columns[1])
        rows.upper.right = pixel(radiance, color, rows.upper_index + columns[2])
        rows.lower.left = pixel(radiance, color, rows.lower_index + columns[1])
        rows.lower.right = pixel(radiance, color, rows.lower_index + columns[2])
        return rows

    @wp.func
    def sum_rows(
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        view: View,
        bloom: Bloom,
        columns: wp.vec4i,
        rows: Rows,
    ):
        """Both rows, each summed."""
        upper, lower = rows.upper, rows.lower
        most = wp.max(wp.max(upper.left, upper.right), wp.max(lower.left, lower.right))
        sums = RowSums()
        sums.upper = wp.vec4(0.0, 0.0, 0.0, 8.0)
        sums.lower = wp.vec4(0.0, 0.0, 0.0, 8.0)
        e = view.exposure
        # A lone lane does not see its neighbours' pixels.
        sums.lit = any_lane(may_scatter(most, e, bloom)) or warp_width() == 1
        if sums.lit:
            sums.upper = row_sum(radiance, color, rows.upper_index, columns, upper, e, bloom)
            sums.lower = row_sum(radiance, color, rows.lower_index, columns, lower, e, bloom)
        return sums

    @wp.func
    def mean(total: wp.vec4):
        """Weighted mean of the 4 x 4 pixels; most are black and spare the division."""
        if total[0] + total[1] + total[2] == 0.0:
            return wp.vec3()
        scale = wp.float32(1.0 / 64.0)
        if wp.static(weighted):
            scale = 1.0 / total[3]
        return wp.vec3(total[0], total[1], total[2]) * scale

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def bright_kernel(
        # Frame
        views: wp.array[View],
        strips: wp.array[wp.vec4i],
        # In
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        bloom: Bloom,
        # Params
        first: wp.int32,
        # Out
        out_texels: wp.array[wp.uint64],
    ):
        # Where shade saw nothing bright all of bloom is skipped; display looks at the same flag.
        if bloom.bright[0] == 0:
            return
        thread = wp.tid() + first
        strip = load_vec4i(strips, pixel_block(thread))
        level = bloom.levels[strip[3]]
        view = views[strip[0]]
        lane = thread & (LANES - 1)
        x = strip[1] + lane - 1
        start = strip[2] + (thread & LANES) // LANES * STRIP_HEIGHT
        count = wp.min(level.height - start, STRIP_HEIGHT)
        # Both are the same for the whole warp, of which no lane may leave before the others.
        if view.bloom <= 0.0 or count <= 0:
            return
        kept = lane > 0 and lane < LANES - 1 and x < level.width
        if warp_width() == 1 and not kept:
            return
        columns = wp.vec4i(
            mirrored(2 * x - 1, view.width, 2 * view.width),
            mirrored(2 * x, view.width, 2 * view.width),
            mirrored(2 * x + 1, view.width, 2 * view.width),
            mirrored(2 * x + 2, view.width, 2 * view.width),
        )
        i = level.first + start * level.width + x
        near = wp.vec4()
        lit = wp.bool(False)
        rows = load_rows(radiance, color, view, columns, 2 * start)
        for k in range(count + 1):
            # The next rows are on their way while these are summed; mirrored, there is always another.
            ahead = load_rows(radiance, color, view, columns, 2 * (start + k + 1))
            sums = sum_rows(radiance, color, view, bloom, columns, rows)
            rows = ahead
            if k > 0 and kept:
                # 1 3 3 1 again, from both ends so that mirrored pictures agree.
                word = pack_half4(0.0, 0.0, 0.0)
                if lit or sums.lit:
                    word = half_texel(mean(near + (sums.lower + sums.upper * 3.0)))
                store_double_word(out_texels, i, word)
                i += level.width
            near = sums.upper + sums.lower * 3.0
            lit = sums.lit

    return bright_kernel
