"""Bloom's levels from 2 on, all in one launch: on a GPU a launch of a few thousand texels is nearly all waiting.

**Chain.** The work is cut into items, one a block, listed step by step: down the pyramid, then up. A block takes the
next one off a counter, waits until all blocks of the step before are done, works and says so. Work is taken in order,
so whatever a block waits for is in the hands of blocks that run already: any number of blocks may be resident, in any
order, and none waits for ever. (The decoupled look-back of prefix sums rests on the same; Merrill and Garland 2016,
"Single-pass Parallel Prefix Scan with Decoupled Look-back".) The last block done sets the counters back to 0. Counting
releases what a block wrote, and the end of waiting acquires it. Where shade saw nothing bright every block leaves at
once: cheaper than a conditional node around the launches, which takes about 10 us of an H200 whether it skips them or
not.

**Together.** A step waits some microseconds on an H200, so that there are few: each on the way down makes three levels,
and the last goes all the way up, after it has made the one or two levels that no three are left for. What several
blocks need each makes again, in memory that its lanes share. Every texel is the one that `downsample_kernel` and
`upsample_kernel` make, to the bit.

Down: a block makes w x h texels of the widest of its levels, (2 w + 4) x (2 h + 4) of the one before, and
(4 w + 12) x (4 h + 12) of the first. A warp walks down 30 columns of a level, a column a lane and an edge at either
side: each lane loads two texels of a row, has four from its neighbours, and keeps the sums of the rows that the next
texel sees, too. Up: texels come in quads around the corners of the wider level's texels. N quads along an axis see
N / 2 + 2 of the wider level, so that many levels come to little: a block of 32 x 16 quads has 18 x 10, 11 x 7, 8 x 6,
6 x 5, and 5 x 5 of all others.

At 1080p, six levels, two steps: 132 blocks make levels 2 to 4, 2.05, 1.5 and 1.07 times over; 255 blocks make level 5,
6 and all mixtures: of level 2 1.4 times over, of level 3 2.4 times. Before, six steps took 37 us.
The CPU, where a block is one lane, takes the items one after the other, on one thread.
"""

from __future__ import annotations

import warp as wp

from .bloom import Six, half_texel, mirrored, six_columns, six_sums, six_texels, thirteen_taps, upsample_quads
from .intrinsics import block_sync, load_double_word, load_vec4i, store_double_word, unpack_half3
from .lanes import block_levels, block_memory, either, finish_step, next_turn, wait_for_step, warp_width, word_from_lane
from .structs import Bloom, BloomLevel, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: Levels that an item of the way down makes, and its texels of the widest one.
DOWN = wp.constant(3)
DOWN_WIDTH = wp.constant(11)
DOWN_HEIGHT = wp.constant(6)
#: Quads of level 1 of an item of the way up; the last ones of a row or a column have one more, at the edge.
UP_WIDTH = wp.constant(32)
UP_HEIGHT = wp.constant(16)
#: Words of memory that a block's lanes share, and those of its first part: levels take turns between the two.
SHARED = 2752
PART = wp.constant(2304)
#: What an item is.
NARROW, WIDEN = (wp.constant(kind) for kind in range(2))


# ---- down


@wp.struct
class RowPair:
    """A lane's own two texels of two rows."""

    upper_left: wp.uint64
    upper_right: wp.uint64
    lower_left: wp.uint64
    lower_right: wp.uint64


@wp.func
def load_rows(texels: wp.array[wp.uint64], level: BloomLevel, left: wp.int32, right: wp.int32, y: wp.int32):
    """Texels of rows y and y + 1, mirrored; columns are mirrored already."""
    upper = level.first + mirrored(y, level.height, level.edge_y) * level.pitch
    lower = level.first + mirrored(y + 1, level.height, level.edge_y) * level.pitch
    rows = RowPair()
    rows.upper_left = load_double_word(texels, upper + left)
    rows.upper_right = load_double_word(texels, upper + right)
    rows.lower_left = load_double_word(texels, lower + left)
    rows.lower_right = load_double_word(texels, lower + right)
    return rows


@wp.func
def sums_of_six(left: wp.uint64, right: wp.uint64):
    """Sums of the lane's own two texels of a row and two of either neighbour; all lanes of the warp must call it."""
    return six_sums(
        unpack_half3(word_from_lane(left, -1)),
        unpack_half3(word_from_lane(right, -1)),
        unpack_half3(left),
        unpack_half3(right),
        unpack_half3(word_from_lane(left, 1)),
        unpack_half3(word_from_lane(right, 1)),
    )


@wp.struct
class Target:
    """Where texels go: all to the block's memory, those of a box (x0, y0, x1, y1) to the buffer of all levels."""

    first: wp.int32
    pitch: wp.int32
    own_first: wp.int32
    own_pitch: wp.int32
    own: wp.vec4i


@wp.func
def row_sums(
    texels: wp.array[wp.uint64], level: BloomLevel, columns: Six, y: wp.int32, left: wp.uint64, right: wp.uint64
):
    """Sums of one row from a lane's own two texels of it; the CPU, where a warp is one lane, loads all six."""
    if warp_width() > 1:
        return sums_of_six(left, right)
    return six_texels(texels, level, columns, y)


@wp.func
def narrow_column(
    source: wp.array[wp.uint64],
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    x: wp.int32,
    rows: wp.vec2i,
    made: wp.bool,
):
    """Walk down one column of a level; all lanes of a warp must come, and walk as far, be their columns made or not."""
    columns = six_columns(finer, x)
    left, right = columns[2], columns[3]
    before = load_rows(source, finer, left, right, 2 * rows[0] - 2)
    here = load_rows(source, finer, left, right, 2 * rows[0])
    ahead = load_rows(source, finer, left, right, 2 * rows[0] + 2)
    y = 2 * rows[0]
    a = row_sums(source, finer, columns, y - 2, before.upper_left, before.upper_right)
    b = row_sums(source, finer, columns, y - 1, before.lower_left, before.lower_right)
    c = row_sums(source, finer, columns, y, here.upper_left, here.upper_right)
    d = row_sums(source, finer, columns, y + 1, here.lower_left, here.lower_right)
    for row in range(rows[0], rows[1]):
        y = 2 * row
        e = row_sums(source, finer, columns, y + 2, ahead.upper_left, ahead.upper_right)
        f = row_sums(source, finer, columns, y + 3, ahead.lower_left, ahead.lower_right)
        # The next rows are on their way while these are summed; the last ones once more at the end.
        ahead = load_rows(source, finer, left, right, 2 * wp.min(row + 1, rows[1] - 1) + 2)
        word = half_texel(thirteen_taps(a, b, c, d, e, f))
        if made:
            store_double_word(memory, to.first + row * to.pitch + x, word)
            if x >= to.own[0] and x < to.own[2] and row >= to.own[1] and row < to.own[3]:
                store_double_word(texels, to.own_first + row * to.own_pitch + x, word)
        a, b, c, d = c, d, e, f


@wp.func
def narrow(
    source: wp.array[wp.uint64],
    finer: BloomLevel,
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    to: Target,
    box: wp.vec4i,
    lane: wp.int32,
):
    """Fill a box (x0, y0, x1, y1), not empty, of a level from the next finer one; all lanes of the block must come.

    Every warp has a strip of it, as high as leaves none without one.
    """
    wide = warp_width() > 1
    warps, width = wp.where(wide, BLOCK_DIM // 32, 1), wp.where(wide, 30, 1)
    groups = (box[2] - box[0] + width - 1) // width
    strips = wp.max(warps // groups, 1)
    height = (box[3] - box[1] + strips - 1) // strips
    for job in range(lane // 32, groups * strips, warps):
        # An edge at either side.
        column = wp.where(wide, (lane & 31) - 1, 0)
        x = box[0] + job % groups * width + column
        made = column >= 0 and column < width and x < box[2]
        y = box[1] + job // groups * height
        rows = wp.vec2i(wp.min(y, box[3]), wp.min(y + height, box[3]))
        # Lanes further out than the edge have nothing to give either.
        if rows[0] < rows[1]:
            narrow_column(source, finer, texels, memory, to, wp.min(x, box[2]), rows, made)


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
def part_of(depth: wp.int32):
    """Where the block's memory keeps a level."""
    return wp.where((depth & 1) != 0, 0, PART)


@wp.func
def kept_level(level: BloomLevel, kept: wp.bool, square: wp.vec4i, first: wp.int32):
    """A level, or what the block's memory keeps of it from `first` on, a square (x, y, width, height).

    All that is asked for, once mirrored, is within the square.
    """
    out = BloomLevel()
    out.first = wp.where(kept, first - square[1] * square[2] - square[0], level.first)
    out.pitch = wp.where(kept, square[2], level.pitch)
    out.width = level.width
    out.height = level.height
    out.edge_x = level.edge_x
    out.edge_y = level.edge_y
    out.wider = level.wider
    out.last = level.last
    return out


@wp.func
def narrow_levels(
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    depth: wp.int32,
    count: wp.int32,
    tile: wp.vec4i,
    shared: wp.bool,
    lane: wp.int32,
):
    """Make some levels from one, up to a tile (x, y, width, height) of the widest; all lanes of the block must come.

    All are kept in memory; the buffer of all levels gets what is above the tile, if it is the block's alone.
    """
    for k in range(count):
        steps = count - 1 - k
        finer, level = levels[depth + k], levels[depth + k + 1]
        square = narrow_square(tile, steps)
        source = kept_level(finer, k > 0, narrow_square(tile, steps + 1), part_of(depth + k))
        kept = kept_level(level, True, square, part_of(depth + k + 1))
        to = Target()
        to.first = kept.first
        to.pitch = kept.pitch
        to.own_first = level.first
        to.own_pitch = level.pitch
        if not shared:
            to.own = wp.vec4i(tile[0], tile[1], tile[0] + tile[2], tile[1] + tile[3]) * (1 << steps)
        box = wp.vec4i(
            wp.max(square[0], 0),
            wp.max(square[1], 0),
            wp.min(square[0] + square[2], level.width),
            wp.min(square[1] + square[3], level.height),
        )
        narrow(either(k > 0, memory, texels), source, texels, memory, to, box, lane)
        block_sync()


# ---- up


@wp.func
def seen(quads: wp.vec4i, levels: wp.int32):
    """Quads (x, y, width, height) of a level some levels wider that quads of a level see."""
    return wp.vec4i(
        ((quads[0] + 1) >> levels) - 1,
        ((quads[1] + 1) >> levels) - 1,
        4 - ((4 - quads[2]) >> levels),
        4 - ((4 - quads[3]) >> levels),
    )


@wp.func
def quads_of(level: BloomLevel, item: wp.vec4i):
    """Quads (x, y, width, height) of an item; the last ones of a level have no lone row or column left beside them."""
    right, below = level.width // 2, level.height // 2
    width = wp.where(item[1] + UP_WIDTH < right, UP_WIDTH, right + 1 - item[1])
    height = wp.where(item[2] + UP_HEIGHT < below, UP_HEIGHT, below + 1 - item[2])
    return wp.vec4i(item[1], item[2], width, height)


@wp.func
def quad_square(quads: wp.vec4i):
    """Square (x, y, width, height) of the texels of quads."""
    return wp.vec4i(2 * quads[0] - 1, 2 * quads[1] - 1, 2 * quads[2], 2 * quads[3])


@wp.func
def upsample_square(
    wider_texels: wp.array[wp.uint64],
    wider: BloomLevel,
    own_texels: wp.array[wp.uint64],
    own: BloomLevel,
    texels: wp.array[wp.uint64],
    level: BloomLevel,
    quads: wp.vec4i,
    lane: wp.int32,
):
    """Mix some quads (x, y, width, height) of a level, those that the picture has, with the wider levels."""
    lanes = wp.where(warp_width() > 1, BLOCK_DIM, 1)
    x0, y0 = wp.max(quads[0], 0), wp.max(quads[1], 0)
    width = wp.min(quads[0] + quads[2], level.width // 2 + 1) - x0
    end = wp.min(quads[1] + quads[3], level.height // 2 + 1)
    # As many lanes as there are, each a few quads down a column.
    height = (width * (end - y0) + lanes - 1) // lanes
    strips = (end - y0 + height - 1) // height
    for k in range(lane, width * strips, lanes):
        x, y = x0 + k % width, y0 + k // width * height
        count = wp.min(height, end - y)
        upsample_quads(wider_texels, wider, own_texels, own, texels, level, x, y, count)


@wp.func
def widen_levels(
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    count: wp.int32,
    quads: wp.vec4i,
    made: wp.int32,
    tile: wp.vec4i,
    lane: wp.int32,
):
    """Mix all wider levels into quads of a level; all lanes of the block must come.

    Memory keeps the widest levels, as many as were made there from a tile of the widest, and of all others but the
    finest what they are mixed to.
    """
    for k in range(count):
        depth = count - 1 - k
        level, wider = levels[depth], levels[depth + 1]
        own_made, wider_made = depth > count - made, depth + 1 > count - made
        square = quad_square(seen(quads, depth))
        if own_made:
            square = narrow_square(tile, count - depth)
        wider_square = quad_square(seen(quads, depth + 1))
        if wider_made:
            wider_square = narrow_square(tile, count - depth - 1)
        upsample_square(
            either(wider_made or k > 0, memory, texels),
            kept_level(wider, wider_made or k > 0, wider_square, part_of(depth + 1)),
            either(own_made, memory, texels),
            kept_level(level, own_made, square, part_of(depth)),
            either(depth > 0, memory, texels),
            kept_level(level, depth > 0, square, part_of(depth)),
            seen(quads, depth),
            lane,
        )
        block_sync()


@wp.kernel(grid_stride=False, launch_bounds=(BLOCK_DIM, 3))
def chain_kernel(
    # Frame
    views: wp.array[View],
    items: wp.array[wp.vec4i],
    steps: wp.array[wp.vec4i],
    # In
    bloom: Bloom,
    # Params
    scratch: wp.array[wp.uint64],
    # Out
    out_counters: wp.array[wp.int32],
    out_texels: wp.array[wp.uint64],
):
    """Turn level 1 into bloom: a block an item.

    Items are view, x, y and row of `levels`: of the finest level seen and the texel of the widest made on the way down,
    of level 1 and its quad on the way up. `steps` has for each block the number of its step, what it is, the blocks of
    the step before, and those of its own, negative in the last step.
    """
    # The same for the whole block, as all that follows.
    if bloom.bright[0] == 0:
        return
    thread = wp.tid()
    lane = thread % BLOCK_DIM
    turn = next_turn(out_counters, thread // BLOCK_DIM)
    if warp_width() == 1 and lane > 0:
        return
    item, step = load_vec4i(items, turn), load_vec4i(steps, turn)
    # What does not change is on its way while the block waits.
    up = step[1] == WIDEN
    share = views[item[0]].bloom
    finest = bloom.levels[item[3]]
    wider = finest.last - item[3]
    memory = block_memory(scratch)
    # Levels from the finest on that the block sees, and that it makes the next wider ones of.
    depth, count = wp.int32(0), wp.min(wider, DOWN)
    tile = wp.vec4i(item[1], item[2], DOWN_WIDTH, DOWN_HEIGHT)
    quads = quads_of(finest, item)
    if up:
        # Of level 1 nothing is made: other blocks may have mixed it already.
        count = wp.where(wider > DOWN, wider % DOWN, 0)
        depth = wider - count
        last = seen(quads, wider - 1)
        tile = wp.vec4i(last[0] - 2, last[1] - 2, last[2] + 3, last[3] + 3)
    levels = block_levels(bloom.levels, item[3], wp.where(up, wider, count) + 1)
    wait_for_step(out_counters, step[0], step[2])
    if share > 0.0:
        narrow_levels(out_texels, memory, levels, depth, count, tile, up, lane)
        if up:
            widen_levels(out_texels, memory, levels, wider, quads, count, tile, lane)
    finish_step(out_counters, step[0], step[3])
