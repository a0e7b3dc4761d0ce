"""Bloom's levels on the way down, several in one block: what `bloom_chain` makes its first step of.

A block makes w x h texels of the widest of its levels, (2 w + 4) x (2 h + 4) of the one before, and
(4 w + 12) x (4 h + 12) of the first. The first comes from memory that all blocks see: a warp walks down 60 columns of
it, two a lane and an edge at either side; each lane loads four texels of a row, has four from its neighbours, and keeps
the sums of the rows that the next texels see, too. The others come from the block's own memory, a column a lane.
Functions only.
"""

from __future__ import annotations

import warp as wp

from .bloom import SixSums, half_texel, mirrored, six_columns, six_sums, six_texels, thirteen_taps
from .intrinsics import fast_reciprocal, load_double_word, store_double_word, unpack_half3
from .lanes import touch, warp_width, word_from_lane
from .structs import BloomLevel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def quotient(a: wp.int32, b: wp.int32):
    """Whole part of a / b of 0 <= a < 2^16 and 0 < b < 2^8: as exact as, and a fifth of, a whole division."""
    return wp.int32((wp.float32(a) + 0.5) * fast_reciprocal(wp.float32(b)))


@wp.struct
class Four:
    """A lane's own four texels of a row."""

    a: wp.uint64
    b: wp.uint64
    c: wp.uint64
    d: wp.uint64


@wp.struct
class TwoSums:
    """Sums of a row that two texels side by side see."""

    left: SixSums
    right: SixSums


@wp.func
def load_four(texels: wp.array[wp.uint64], level: BloomLevel, columns: wp.vec4i, y: wp.int32):
    """Texels of a row, mirrored; columns are mirrored already."""
    row = level.first + mirrored(y, level.height, level.edge_y) * level.pitch
    four = Four()
    four.a = load_double_word(texels, row + columns[0])
    four.b = load_double_word(texels, row + columns[1])
    four.c = load_double_word(texels, row + columns[2])
    four.d = load_double_word(texels, row + columns[3])
    return four


@wp.func
def two_sums(texels: wp.array[wp.uint64], level: BloomLevel, x: wp.int32, y: wp.int32, own: Four):
    """Sums of row y for texels x and x + 1 from the lane's own four and two of either neighbour.

    All lanes of the warp must call it. The CPU, where a warp is one lane, loads all twelve.
    """
    sums = TwoSums()
    if warp_width() > 1:
        a, b = unpack_half3(word_from_lane(own.c, -1)), unpack_half3(word_from_lane(own.d, -1))
        c, d, e, f = unpack_half3(own.a), unpack_half3(own.b), unpack_half3(own.c), unpack_half3(own.d)
        g, h = unpack_half3(word_from_lane(own.a, 1)), unpack_half3(word_from_lane(own.b, 1))
        sums.left = six_sums(a, b, c, d, e, f)
        sums.right = six_sums(c, d, e, f, g, h)
    else:
        sums.left = six_texels(texels, level, six_columns(level, x), y)
        sums.right = six_texels(texels, level, six_columns(level, x + 1), y)
    return sums


@wp.struct
class Target:
    """Where texels of a level go: all to the block's memory, those of a box (x0, y0, x1, y1) to all levels' buffer."""

    first: wp.int32
    pitch: wp.int32
    own_first: wp.int32
    own_pitch: wp.int32
    own: wp.vec4i


@wp.func
def store_texel(
    texels: wp.array[wp.uint64], memory: wp.array[wp.uint64], to: Target, x: wp.int32, y: wp.int32, word: wp.uint64
):
    """Keep a texel, and hand it on if it is the block's own."""
    store_double_word(memory, to.first + y * to.pitch + x, word)
    if x >= to.own[0] and x < to.own[2] and y >= to.own[1] and y < to.own[3]:
        store_double_word(texels, to.own_first + y * to.own_pitch + x, word)


@wp.func
def narrow_two_columns(
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    x: wp.int32,
    rows: wp.vec2i,
    made: wp.vec2i,
):
    """Walk down columns x and x + 1 of a level, from `made[0]` to before `made[1]` those that are made.

    All lanes of a warp must come, and walk as far, be their columns made or not.
    """
    columns = wp.vec4i(
        mirrored(2 * x, finer.width, finer.edge_x),
        mirrored(2 * x + 1, finer.width, finer.edge_x),
        mirrored(2 * x + 2, finer.width, finer.edge_x),
        mirrored(2 * x + 3, finer.width, finer.edge_x),
    )
    y = 2 * rows[0]
    before0, before1 = load_four(texels, finer, columns, y - 2), load_four(texels, finer, columns, y - 1)
    here0, here1 = load_four(texels, finer, columns, y), load_four(texels, finer, columns, y + 1)
    ahead0, ahead1 = load_four(texels, finer, columns, y + 2), load_four(texels, finer, columns, y + 3)
    a, b = two_sums(texels, finer, x, y - 2, before0), two_sums(texels, finer, x, y - 1, before1)
    c, d = two_sums(texels, finer, x, y, here0), two_sums(texels, finer, x, y + 1, here1)
    for row in range(rows[0], rows[1]):
        e = two_sums(texels, finer, x, 2 * row + 2, ahead0)
        f = two_sums(texels, finer, x, 2 * row + 3, ahead1)
        # The next rows are on their way while these are summed; the last ones once more at the end.
        y = 2 * wp.min(row + 1, rows[1] - 1) + 2
        ahead0, ahead1 = load_four(texels, finer, columns, y), load_four(texels, finer, columns, y + 1)
        left = half_texel(thirteen_taps(a.left, b.left, c.left, d.left, e.left, f.left))
        right = half_texel(thirteen_taps(a.right, b.right, c.right, d.right, e.right, f.right))
        if x >= made[0] and x < made[1]:
            store_texel(texels, memory, to, x, row, left)
            if x + 1 < made[1]:
                store_texel(texels, memory, to, x + 1, row, right)
        a, b, c, d = c, d, e, f


@wp.func
def narrow_first(
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    box: wp.vec4i,
    lane: wp.int32,
    lanes: wp.int32,
):
    """Fill a box (x0, y0, x1, y1), not empty, of a level from the next finer one in the buffer of all levels.

    All lanes of the block must come. Every warp has a strip of it, as high as leaves none without one.
    """
    wide = warp_width() > 1
    warps, width = wp.where(wide, lanes // 32, 1), wp.where(wide, 60, 2)
    groups = (box[2] - box[0] + width - 1) // width
    strips = wp.max(warps // groups, 1)
    height = (box[3] - box[1] + strips - 1) // strips
    for job in range(lane // 32, groups * strips, warps):
        # An edge at either side: a lane of the first has no texel of its own, nor one of the last.
        column = wp.where(wide, 2 * (lane & 31) - 2, 0)
        left = box[0] + job % groups * width
        made = wp.vec2i(left, wp.min(left + width, box[2]))
        y = box[1] + job // groups * height
        rows = wp.vec2i(wp.min(y, box[3]), wp.min(y + height, box[3]))
        # Lanes further out than the edge have nothing to give either.
        if rows[0] < rows[1]:
            narrow_two_columns(finer, texels, memory, to, wp.min(left + column, box[2]), rows, made)


@wp.func
def narrow_kept_column(
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    x: wp.int32,
    rows: wp.vec2i,
):
    """Walk down one column of a level, from one that the block keeps."""
    columns, y = six_columns(finer, x), 2 * rows[0]
    a, b = six_texels(memory, finer, columns, y - 2), six_texels(memory, finer, columns, y - 1)
    c, d = six_texels(memory, finer, columns, y), six_texels(memory, finer, columns, y + 1)
    for row in range(rows[0], rows[1]):
        e, f = six_texels(memory, finer, columns, 2 * row + 2), six_texels(memory, finer, columns, 2 * row + 3)
        store_texel(texels, memory, to, x, row, half_texel(thirteen_taps(a, b, c, d, e, f)))
        a, b, c, d = c, d, e, f


@wp.func
def narrow_kept(
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    box: wp.vec4i,
    lane: wp.int32,
    lanes: wp.int32,
):
    """Fill a box (x0, y0, x1, y1), not empty, of a level from the next finer one that the block keeps."""
    width, rows = box[2] - box[0], box[3] - box[1]
    # As many lanes as there are, each a few texels down a column.
    height = (width * rows + lanes - 1) // lanes
    strips = quotient(rows + height - 1, height)
    for k in range(lane, width * strips, lanes):
        strip = quotient(k, width)
        y = box[1] + strip * height
        narrow_kept_column(
            finer, texels, memory, to, box[0] + k - strip * width, wp.vec2i(y, wp.min(y + height, box[3]))
        )


@wp.func
def narrow_square(tile: wp.vec4i, steps: wp.int32):
    """Square (x, y, width, height) of a level that a square of the level some steps wider is made from."""
    edge = 2 * (1 << steps) - 2
    return wp.vec4i(
        (tile[0] << steps) - edge,
        (tile[1] << steps) - edge,
        (tile[2] << steps) + 2 * edge,
        (tile[3] << steps) + 2 * edge,
    )


@wp.func
def box_of(square: wp.vec4i, level: BloomLevel):
    """What of a square (x, y, width, height) is in the picture, as a box (x0, y0, x1, y1)."""
    return wp.vec4i(
        wp.max(square[0], 0),
        wp.max(square[1], 0),
        wp.min(square[0] + square[2], level.width),
        wp.min(square[1] + square[3], level.height),
    )


@wp.func
def touch_square(texels: wp.array[wp.uint64], level: BloomLevel, square: wp.vec4i, lane: wp.int32, lanes: wp.int32):
    """Have a square, up to 128 texels wide, on its way to the L1 cache at once: later loads wait for nothing else."""
    if warp_width() > 1:
        box = box_of(square, level)
        x = wp.min(box[0] + 4 * (lane & 31), box[2] - 1)
        for y in range(box[1] + lane // 32, box[3], lanes // 32):
            touch(texels, level.first + y * level.pitch + x)
