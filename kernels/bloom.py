"""Bloom: the bright part of every pixel's light, spread by a pyramid of half sizes or a small window.

The lens scatters a share of b, the part of exposed radiance above a threshold with a soft start (`bright_part`), by a
sum of blurs. Level k has texels of 2^k pixels. `bright` makes level 1 from the picture: taps 1 3 3 1 along each axis,
the narrowest ones that neither shift nor favour a pixel, each weighted by 1 / (1 + luminance / limit) so that a lone
bright pixel does not flicker (Karis 2013, "Tone Mapping", where the limit is 1). `downsample` is the filter of 13
bilinear taps of Jimenez 2014, "Next Generation Post Processing in Call of Duty: Advanced Warfare", written out as the
6 x 6 texels they touch; `upsample` is his 3 x 3 tent, 4 x 4 texels, mixed into the level below. Display interpolates
level 1 itself.
All weights are sums of powers of two and add up to 1 exactly. Beyond the picture's edge the picture is mirrored.

Levels are half4 and hold exposed radiance in [0, 65504]. One thread a texel over 8 x 8 blocks of a level, block size
64. Every texel is written by one thread in a fixed order of + - * /: bit-identical on all devices.

Bytes for P pixels: `bright` reads 8 P (12 P in float32) and writes 2 P; the levels below are read and written once
downwards and once upwards, 2/3 P and 10/3 P, all of it within the L2 cache at 1080p. Display reads 2 P more.
Operations: a block of `bright` evaluates its 18 x 18 pixels once, 1.27 a pixel, into 5 KiB of shared memory: about 50
operations where a pixel is dark and 80, two divisions among them, where it is not; then 16 taps a texel, 4 a pixel, of
10 operations. The 13 taps read 36 texels for 16 pixels and the tent 16 for 4.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import any_lane, from_lane, load_double_word, load_vec4i, pack_half4, unpack_half3, warp_width
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, Bloom, BloomLevel, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
Six = wp.types.vector(length=6, dtype=wp.int32)
#: Largest finite half: levels hold no more, nor does display show more.
MOST = wp.constant(65504.0)
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


@wp.func
def mirrored(i: wp.int32, count: wp.int32, edge: wp.int32):
    """Index of a texel in the picture continued by mirrors at 0 and at edge / 2 texels; count is at least 1."""
    # Two operations for i, or -1 - i where i < 0.
    j = i ^ (i >> 31)
    return wp.max(wp.where(j >= count, edge - 1 - j, j), 0)


@wp.func
def word_value(texels: wp.array[wp.uint64], i: wp.int32):
    """Value of the texel at an index of the buffer."""
    return unpack_half3(load_double_word(texels, i))


@wp.func
def texel(texels: wp.array[wp.uint64], level: BloomLevel, x: wp.int32, y: wp.int32):
    """Value of a level at whole texels, mirrored."""
    row = mirrored(y, level.height, level.edge_y) * level.width
    return word_value(texels, level.first + row + mirrored(x, level.width, level.edge_x))


@wp.func
def half_texel(v: wp.vec3):
    """A value >= 0 as half4, at most half's largest."""
    return pack_half4(wp.min(v[0], MOST), wp.min(v[1], MOST), wp.min(v[2], MOST))


@wp.struct
class SixSums:
    """Six texels of a row, summed with the weights of both kinds of box."""

    spread: wp.vec3  # 1 1 2 2 1 1
    middle: wp.vec3  # 0 4 4 4 4 0


@wp.func
def six_sums(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, e: wp.vec3, f: wp.vec3):
    """Sum six texels; pairs first, so that mirrored pictures agree."""
    sums = SixSums()
    inner = c + d
    near = b + e
    sums.spread = (a + f) + near + inner * 2.0
    sums.middle = (near + inner) * 4.0
    return sums


@wp.func
def thirteen_taps(a: SixSums, b: SixSums, c: SixSums, d: SixSums, e: SixSums, f: SixSums):
    """Jimenez's 13 bilinear taps from the six rows they touch.

    The taps are five boxes of 4 x 4 texels: one in the middle of weight 1/2, four a texel off in both directions of
    1/8 each, which is half of a a' + s s' with a = (0 1 1 1 1 0) / 4 and s = (1 1 2 2 1 1) / 8.
    """
    spread = (a.spread + f.spread) + (b.spread + e.spread) + (c.spread + d.spread) * 2.0
    middle = (b.middle + e.middle) + (c.middle + d.middle)
    return (spread + middle) * (1.0 / 128.0)


@wp.func
def six_columns(level: BloomLevel, x: wp.int32):
    """Columns under texel x of the next wider level, mirrored."""
    return Six(
        mirrored(2 * x - 2, level.width, level.edge_x),
        mirrored(2 * x - 1, level.width, level.edge_x),
        mirrored(2 * x, level.width, level.edge_x),
        mirrored(2 * x + 1, level.width, level.edge_x),
        mirrored(2 * x + 2, level.width, level.edge_x),
        mirrored(2 * x + 3, level.width, level.edge_x),
    )


@wp.func
def six_texels(texels: wp.array[wp.uint64], level: BloomLevel, columns: Six, y: wp.int32):
    """Sums of one row, mirrored; columns are mirrored already."""
    row = level.first + mirrored(y, level.height, level.edge_y) * level.width
    return six_sums(
        word_value(texels, row + columns[0]),
        word_value(texels, row + columns[1]),
        word_value(texels, row + columns[2]),
        word_value(texels, row + columns[3]),
        word_value(texels, row + columns[4]),
        word_value(texels, row + columns[5]),
    )


@wp.func
def narrowed(texels: wp.array[wp.uint64], level: BloomLevel, x: wp.int32, y: wp.int32):
    """Texel (x, y) of the next wider level."""
    columns = six_columns(level, x)
    a, b = six_texels(texels, level, columns, 2 * y - 2), six_texels(texels, level, columns, 2 * y - 1)
    c, d = six_texels(texels, level, columns, 2 * y), six_texels(texels, level, columns, 2 * y + 1)
    e, f = six_texels(texels, level, columns, 2 * y + 2), six_texels(texels, level, columns, 2 * y + 3)
    return thirteen_taps(a, b, c, d, e, f)


@wp.func
def tent_ahead(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3):
    """Jimenez's tent of bilinear taps along one axis, times 16, for a texel in the further half of b's.

    A finer texel's centre lies a quarter of a texel off: 1 2 1 of interpolations 1/4 and 3/4 is 3 7 5 1. For a texel
    in the nearer half of c's the same four count in reverse.
    """
    return a * 3.0 + b * 7.0 + c * 5.0 + d


@wp.func
def bilinear(texels: wp.array[wp.uint64], level: BloomLevel, x: wp.int32, y: wp.int32):
    """A level seen from texel (x, y) of the next finer one, interpolated between 2 x 2 texels."""
    i, j = x >> 1, y >> 1
    i1 = mirrored(i + 2 * (x & 1) - 1, level.width, level.edge_x)
    j1 = mirrored(j + 2 * (y & 1) - 1, level.height, level.edge_y)
    row, row1 = level.first + j * level.width, level.first + j1 * level.width
    near = word_value(texels, row + i) * 3.0 + word_value(texels, row + i1)
    far = word_value(texels, row1 + i) * 3.0 + word_value(texels, row1 + i1)
    return (near * 3.0 + far) * (1.0 / 16.0)


@wp.struct
class PixelPair:
    """Radiance of two pixels side by side."""

    left: wp.vec3
    right: wp.vec3


@wp.struct
class RowSums:
    """Weighted sums along two rows of pixels, and of the weights."""

    upper: wp.vec4
    lower: wp.vec4


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
    def two_rows(
        radiance: wp.array[wp.uint64], color: wp.array[wp.vec3], view: View, bloom: Bloom, columns: wp.vec4i, y: wp.int32
    ):
        """Rows y - 1 and y, each summed; all four loads are on their way before the first value is looked at."""
        row0 = pixel_index(view, 0, mirrored(y - 1, view.height, 2 * view.height))
        row1 = pixel_index(view, 0, mirrored(y, view.height, 2 * view.height))
        upper, lower = PixelPair(), PixelPair()
        upper.left = pixel(radiance, color, row0 + columns[1])
        upper.right = pixel(radiance, color, row0 + columns[2])
        lower.left = pixel(radiance, color, row1 + columns[1])
        lower.right = pixel(radiance, color, row1 + columns[2])
        most = wp.max(wp.max(upper.left, upper.right), wp.max(lower.left, lower.right))
        sums = RowSums()
        sums.upper = wp.vec4(0.0, 0.0, 0.0, 8.0)
        sums.lower = wp.vec4(0.0, 0.0, 0.0, 8.0)
        e = view.exposure
        # Where all is black the sums are known. A lone lane does not see its neighbours' pixels.
        if any_lane(may_scatter(most, e, bloom)) or warp_width() == 1:
            sums.upper = row_sum(radiance, color, row0, columns, upper, e, bloom)
            sums.lower = row_sum(radiance, color, row1, columns, lower, e, bloom)
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
        for k in range(count + 1):
            sums = two_rows(radiance, color, view, bloom, columns, 2 * (start + k))
            if k > 0 and kept:
                # 1 3 3 1 again, from both ends so that mirrored pictures agree.
                total = near + (sums.lower + sums.upper * 3.0)
                out_texels[i] = half_texel(mean(total))
                i += level.width
            near = sums.upper + sums.lower * 3.0

    return bright_kernel


@wp.kernel(grid_stride=False)
def downsample_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    levels: wp.array[BloomLevel],
    # Params
    first: wp.int32,
    # Out
    out_texels: wp.array[wp.uint64],
):
    """Fill a level from the next finer one: one thread for two texels, one below the other, which share four rows.

    A thread costs 48 loads and 258 operations.
    """
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    place = pixel_in_block(thread)
    level = levels[block[3]]
    x, y = block[1] + place[0], 2 * (block[2] + place[1])
    if x >= level.width or y >= level.height or views[block[0]].bloom <= 0.0:
        return
    finer = levels[block[3] - 1]
    columns = six_columns(finer, x)
    a, b = six_texels(out_texels, finer, columns, 2 * y - 2), six_texels(out_texels, finer, columns, 2 * y - 1)
    c, d = six_texels(out_texels, finer, columns, 2 * y), six_texels(out_texels, finer, columns, 2 * y + 1)
    e, f = six_texels(out_texels, finer, columns, 2 * y + 2), six_texels(out_texels, finer, columns, 2 * y + 3)
    g, h = six_texels(out_texels, finer, columns, 2 * y + 4), six_texels(out_texels, finer, columns, 2 * y + 5)
    # Stores come last: what is loaded after one has to wait for it.
    i = level.first + y * level.width + x
    out_texels[i] = half_texel(thirteen_taps(a, b, c, d, e, f))
    if y + 1 < level.height:
        out_texels[i + level.width] = half_texel(thirteen_taps(c, d, e, f, g, h))


@wp.struct
class TentRow:
    """Four texels of a row seen from the two finer texels between the middle ones, times 16."""

    left: wp.vec3
    right: wp.vec3


@wp.func
def tent_row(texels: wp.array[wp.uint64], level: BloomLevel, columns: wp.vec4i, y: wp.int32):
    """One row under the tent, mirrored; columns are mirrored already."""
    row = level.first + mirrored(y, level.height, level.edge_y) * level.width
    a, b = word_value(texels, row + columns[0]), word_value(texels, row + columns[1])
    c, d = word_value(texels, row + columns[2]), word_value(texels, row + columns[3])
    seen = TentRow()
    seen.left = tent_ahead(a, b, c, d)
    seen.right = tent_ahead(d, c, b, a)
    return seen


@wp.func
def mixed(own: wp.vec3, wider: wp.vec3, level: BloomLevel):
    """A texel with what the wider levels come to, times 256, mixed in."""
    return half_texel(own * (1.0 - level.wider) + (wider * (1.0 / 256.0)) * level.wider)


@wp.kernel(grid_stride=False)
def upsample_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    levels: wp.array[BloomLevel],
    # Params
    first: wp.int32,
    # Out
    out_texels: wp.array[wp.uint64],
):
    """Mix the wider levels into a level, in place: one thread for the 2 x 2 texels that see the same 4 x 4.

    Threads count the corners of the wider level's texels. A thread costs 16 + 4 loads and 228 operations for the tents.
    """
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    place = pixel_in_block(thread)
    level = levels[block[3]]
    x, y = block[1] + place[0], block[2] + place[1]
    if 2 * x > level.width or 2 * y > level.height or views[block[0]].bloom <= 0.0:
        return
    wider = levels[block[3] + 1]
    columns = wp.vec4i(
        mirrored(x - 2, wider.width, wider.edge_x),
        mirrored(x - 1, wider.width, wider.edge_x),
        mirrored(x, wider.width, wider.edge_x),
        mirrored(x + 1, wider.width, wider.edge_x),
    )
    a, b = tent_row(out_texels, wider, columns, y - 2), tent_row(out_texels, wider, columns, y - 1)
    c, d = tent_row(out_texels, wider, columns, y), tent_row(out_texels, wider, columns, y + 1)
    up, down = 2 * y > 0, 2 * y < level.height
    left, right = 2 * x > 0, 2 * x < level.width
    x0, x1 = wp.max(2 * x - 1, 0), wp.min(2 * x, level.width - 1)
    row0 = level.first + wp.max(2 * y - 1, 0) * level.width
    row1 = level.first + wp.min(2 * y, level.height - 1) * level.width
    p, q = word_value(out_texels, row0 + x0), word_value(out_texels, row0 + x1)
    r, s = word_value(out_texels, row1 + x0), word_value(out_texels, row1 + x1)
    # Stores come last: what is loaded after one has to wait for it.
    if up and left:
        out_texels[row0 + x0] = mixed(p, tent_ahead(a.left, b.left, c.left, d.left), level)
    if up and right:
        out_texels[row0 + x1] = mixed(q, tent_ahead(a.right, b.right, c.right, d.right), level)
    if down and left:
        out_texels[row1 + x0] = mixed(r, tent_ahead(d.left, c.left, b.left, a.left), level)
    if down and right:
        out_texels[row1 + x1] = mixed(s, tent_ahead(d.right, c.right, b.right, a.right), level)


@wp.kernel(grid_stride=False)
def gather_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    bright: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    # Params
    window: wp.int32,
    first: wp.int32,
    # Out
    out_texels: wp.array[wp.uint64],
):
    """Average the bright parts in a square window around each texel of level 1.

    (2 window + 1)^2 loads of 8 bytes and three additions each for every four pixels, from the L1 cache: at a window of
    3, 49 loads a texel, 25 million at 1080p.
    """
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    place = pixel_in_block(thread)
    level = levels[block[3]]
    x, y = block[1] + place[0], block[2] + place[1]
    if x >= level.width or y >= level.height or views[block[0]].bloom <= 0.0:
        return
    total = wp.vec3()
    for dy in range(-window, window + 1):
        for dx in range(-window, window + 1):
            total += texel(bright, level, x + dx, y + dy)
    side = wp.float32(2 * window + 1)
    out_texels[level.first + y * level.width + x] = half_texel(total / (side * side))
