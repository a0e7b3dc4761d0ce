"""Bloom: the bright part of every pixel's light, spread by a pyramid of half sizes or a small window.

The lens scatters a share of b, the part of exposed radiance above a threshold, by a sum of blurs. Level k has texels of
2^k pixels; level 1 comes from the picture (`bloom_bright`). `downsample` is the filter of 13 bilinear taps of Jimenez
2014, "Next Generation Post Processing in Call of Duty: Advanced Warfare", written out as the 6 x 6 texels they touch;
`upsample` is his 3 x 3 tent, 4 x 4 texels, mixed into the level below. Display interpolates level 1 itself.
All weights are sums of powers of two and add up to 1 exactly. Beyond the picture's edge the picture is mirrored.

Levels are half4 and hold exposed radiance in [0, 65504]. Block size 64, over 8 x 8 blocks of threads. Every texel comes
from one thread in a fixed order of + - * /: bit-identical on all devices, and in `bloom_chain`, which makes all levels
in one launch.

Bytes for P pixels: levels are read and written once downwards and once upwards, 2/3 P and 10/3 P, all of it within the
L2 cache at 1080p. Display reads 2 P more. Operations: `downsample` makes two texels a thread, 24 loads and 129
operations each; `upsample` four, 5 loads and 75 operations each.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import load_double_word, load_vec4i, pack_half4, store_double_word, unpack_half3
from .projection import pixel_block, pixel_in_block
from .structs import Bloom, BloomLevel, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
Six = wp.types.vector(length=6, dtype=wp.int32)
#: Largest finite half: levels hold no more, nor does display show more.
MOST = wp.constant(65504.0)


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


@wp.struct
class Quad:
    """One value for each of 2 x 2 pixels."""

    nw: wp.vec3
    ne: wp.vec3
    sw: wp.vec3
    se: wp.vec3


@wp.struct
class Pair:
    """What two pixels side by side see of a row of texels, times 4."""

    left: wp.vec3
    right: wp.vec3


@wp.func
def bilinear_pair(texels: wp.array[wp.uint64], level: BloomLevel, columns: wp.vec3i, y: wp.int32):
    """One row, mirrored, under the pixels above the middle one of three columns."""
    row = level.first + mirrored(y, level.height, level.edge_y) * level.width
    middle = word_value(texels, row + columns[1]) * 3.0
    pair = Pair()
    pair.left = middle + word_value(texels, row + columns[0])
    pair.right = middle + word_value(texels, row + columns[2])
    return pair


@wp.func
def bilinear_quad(texels: wp.array[wp.uint64], level: BloomLevel, i: wp.int32, j: wp.int32):
    """A level seen from the 2 x 2 texels of the next finer one above texel (i, j), times 16.

    Each is interpolated between 2 x 2 texels; the four share nine of them.
    """
    columns = wp.vec3i(mirrored(i - 1, level.width, level.edge_x), i, mirrored(i + 1, level.width, level.edge_x))
    above, here = bilinear_pair(texels, level, columns, j - 1), bilinear_pair(texels, level, columns, j)
    below = bilinear_pair(texels, level, columns, j + 1)
    left, right = here.left * 3.0, here.right * 3.0
    quad = Quad()
    quad.nw = left + above.left
    quad.ne = right + above.right
    quad.sw = left + below.left
    quad.se = right + below.right
    return quad


@wp.func
def downsample_pair(
    texels: wp.array[wp.uint64], level: BloomLevel, finer: BloomLevel, block: wp.vec4i, place: wp.vec2i
):
    """Fill two texels, one below the other, which share four rows, from the next finer level.

    48 loads and 258 operations.
    """
    x, y = block[1] + place[0], 2 * (block[2] + place[1])
    if x < level.width and y < level.height:
        columns = six_columns(finer, x)
        a, b = six_texels(texels, finer, columns, 2 * y - 2), six_texels(texels, finer, columns, 2 * y - 1)
        c, d = six_texels(texels, finer, columns, 2 * y), six_texels(texels, finer, columns, 2 * y + 1)
        e, f = six_texels(texels, finer, columns, 2 * y + 2), six_texels(texels, finer, columns, 2 * y + 3)
        g, h = six_texels(texels, finer, columns, 2 * y + 4), six_texels(texels, finer, columns, 2 * y + 5)
        # Stores come last: what is loaded after one has to wait for it.
        i = level.first + y * level.width + x
        store_double_word(texels, i, half_texel(thirteen_taps(a, b, c, d, e, f)))
        if y + 1 < level.height:
            store_double_word(texels, i + level.width, half_texel(thirteen_taps(c, d, e, f, g, h)))


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
    """Fill a level from the next finer one: one thread for two texels."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    if views[block[0]].bloom > 0.0:
        level, finer = levels[block[3]], levels[block[3] - 1]
        downsample_pair(out_texels, level, finer, block, pixel_in_block(thread))


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
    return half_texel(own * (1.0 - level.wider) + wider * (level.wider * (1.0 / 256.0)))


@wp.func
def upsample_quad(texels: wp.array[wp.uint64], level: BloomLevel, wider: BloomLevel, block: wp.vec4i, place: wp.vec2i):
    """Mix the wider levels into the 2 x 2 texels that see the same 4 x 4; x and y count the wider texels' corners.

    16 + 4 loads and 228 operations for the tents.
    """
    x, y = block[1] + place[0], block[2] + place[1]
    if 2 * x <= level.width and 2 * y <= level.height:
        columns = wp.vec4i(
            mirrored(x - 2, wider.width, wider.edge_x),
            mirrored(x - 1, wider.width, wider.edge_x),
            mirrored(x, wider.width, wider.edge_x),
            mirrored(x + 1, wider.width, wider.edge_x),
        )
        a, b = tent_row(texels, wider, columns, y - 2), tent_row(texels, wider, columns, y - 1)
        c, d = tent_row(texels, wider, columns, y), tent_row(texels, wider, columns, y + 1)
        up, down = 2 * y > 0, 2 * y < level.height
        left, right = 2 * x > 0, 2 * x < level.width
        x0, x1 = wp.max(2 * x - 1, 0), wp.min(2 * x, level.width - 1)
        row0 = level.first + wp.max(2 * y - 1, 0) * level.width
        row1 = level.first + wp.min(2 * y, level.height - 1) * level.width
        p, q = word_value(texels, row0 + x0), word_value(texels, row0 + x1)
        r, s = word_value(texels, row1 + x0), word_value(texels, row1 + x1)
        # Stores come last: what is loaded after one has to wait for it.
        if up and left:
            store_double_word(texels, row0 + x0, mixed(p, tent_ahead(a.left, b.left, c.left, d.left), level))
        if up and right:
            store_double_word(texels, row0 + x1, mixed(q, tent_ahead(a.right, b.right, c.right, d.right), level))
        if down and left:
            store_double_word(texels, row1 + x0, mixed(r, tent_ahead(d.left, c.left, b.left, a.left), level))
        if down and right:
            store_double_word(texels, row1 + x1, mixed(s, tent_ahead(d.right, c.right, b.right, a.right), level))


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
    """Mix the wider levels into a level, in place: one thread for 2 x 2 texels."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    if views[block[0]].bloom > 0.0:
        level, wider = levels[block[3]], levels[block[3] + 1]
        upsample_quad(out_texels, level, wider, block, pixel_in_block(thread))


@wp.kernel(grid_stride=False)
def gather_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    bright: wp.array[wp.uint64],
    bloom: Bloom,
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
    level = bloom.levels[block[3]]
    x, y = block[1] + place[0], block[2] + place[1]
    if bloom.bright[0] == 0 or x >= level.width or y >= level.height or views[block[0]].bloom <= 0.0:
        return
    total = wp.vec3()
    for dy in range(-window, window + 1):
        for dx in range(-window, window + 1):
            total += texel(bright, level, x + dx, y + dy)
    side = wp.float32(2 * window + 1)
    out_texels[level.first + y * level.width + x] = half_texel(total / (side * side))
