"""Bloom's levels from 2 on, all in one launch: on a GPU a launch of a few thousand texels is nearly all waiting.

**Chain.** The work is cut into items, one a block, listed step by step: down the pyramid, then up. A block takes the
next one off a counter, waits until all blocks of the step before are done, works and says so. Work is taken in order,
so whatever a block waits for is in the hands of blocks that run already: any number of blocks may be resident, in any
order, and none waits for ever. (The decoupled look-back of prefix sums rests on the same; Merrill and Garland 2016,
"Single-pass Parallel Prefix Scan with Decoupled Look-back".) The last block done sets the counters back to 0. Counting
releases what a block wrote, and the end of waiting acquires it. Where shade saw nothing bright every block leaves at
once: cheaper than a conditional node around the launches, which takes about 10 us of an H200 whether it skips them or
not.

**Together.** A step waits some microseconds on an H200, so that there are few: each on the way down makes three levels
(`bloom_narrow`), and the last goes all the way up, after it has made the one or two levels that no three are left for.
What several blocks need each makes again, in memory that its lanes share. Every texel is the one that
`downsample_kernel` and `upsample_kernel` make, to the bit.

Up: texels come in quads around the corners of the wider level's texels. N quads along an axis see N / 2 + 2 of the
wider level, so that many levels come to little: a block of 32 x 16 quads has 18 x 10, 11 x 7, 8 x 6, 6 x 5, and 5 x 5
of all others. With so few texels a level takes as long as one lane's instructions one after the other. So all that a
block needs of the levels is fetched at once, places are told before the wait, and two lanes share a quad, but for those
of level 1.

At 1080p, six levels, two steps: 132 blocks make levels 2 to 4, 2.05, 1.5 and 1.07 times over; 255 blocks make level 5,
6 and all mixtures: of level 2 1.4 times over, of level 3 2.4 times. Before, six steps took 32 us.
The CPU, where a block is one lane, takes the items one after the other, on one thread.
"""

from __future__ import annotations

import warp as wp

from .bloom import mirrored, mixed, tent_ahead, tent_ahead_of_halves, upsample_quads, word_value
from .bloom_narrow import Target, box_of, narrow_first, narrow_kept, narrow_square, quotient, touch_square
from .intrinsics import block_sync, load_vec4i, store_double_word
from .lanes import (
    block_levels,
    block_memory,
    copy_to_block,
    finish_step,
    next_turn,
    wait_for_copies,
    wait_for_step,
    warp_width,
)
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
#: Words of memory that a block's lanes share: all levels that it keeps, but for the finest.
SHARED = 4352
#: Words that the CPU has behind them, for rows of levels.
ROWS = 128
#: Row of `block_levels` from which on levels are those that the block keeps.
KEPT = wp.constant(16)
#: What an item is.
NARROW, WIDEN = (wp.constant(kind) for kind in range(2))


@wp.func
def block_lanes():
    """Lanes of a block, one on the CPU."""
    return wp.where(warp_width() > 1, BLOCK_DIM, 1)


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


# ---- what a block keeps


@wp.func
def kept_square(quads: wp.vec4i, tile: wp.vec4i, depth: wp.int32, made: wp.int32, widest: wp.int32):
    """Square (x, y, width, height) that a block keeps of the level at a depth.

    Of levels from depth `made` on it is what a tile of the widest is made from, of finer ones what quads see.
    """
    if depth >= made:
        return narrow_square(tile, widest - depth)
    return quad_square(seen(quads, depth))


@wp.func
def keep_levels(
    levels: wp.array[BloomLevel],
    quads: wp.vec4i,
    tile: wp.vec4i,
    made: wp.int32,
    widest: wp.int32,
    lane: wp.int32,
):
    """Give all levels but the finest places in the block's memory, one after the other, a level a lane.

    All that is asked for, once mirrored, is within their squares.
    """
    for depth in range(lane, widest + 1, block_lanes()):
        first = wp.int32(0)
        for finer in range(1, depth):
            square = kept_square(quads, tile, finer, made, widest)
            first += square[2] * square[3]
        square = kept_square(quads, tile, depth, made, widest)
        levels[KEPT + depth].first = first - square[1] * square[2] - square[0]
        levels[KEPT + depth].pitch = square[2]


@wp.func
def fetch_levels(
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    quads: wp.vec4i,
    tile: wp.vec4i,
    made: wp.int32,
    widest: wp.int32,
    lane: wp.int32,
):
    """Fetch what a block keeps of levels from depth 1 to `made`; all its lanes must come."""
    for depth in range(1, made + 1):
        level, kept = levels[depth], levels[KEPT + depth]
        box = box_of(kept_square(quads, tile, depth, made, widest), level)
        width = box[2] - box[0]
        source, to = level.first + box[1] * level.pitch + box[0], kept.first + box[1] * kept.pitch + box[0]
        for k in range(lane, width * (box[3] - box[1]), block_lanes()):
            y = quotient(k, width)
            x = k - y * width
            copy_to_block(texels, source + y * level.pitch + x, memory, to + y * kept.pitch + x)
    wait_for_copies()
    block_sync()


@wp.func
def narrow_levels(
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    tile: wp.vec4i,
    made: wp.int32,
    widest: wp.int32,
    up: wp.bool,
    lane: wp.int32,
):
    """Make the levels wider than the one at depth `made`, up to a tile (x, y, width, height) of the widest.

    All are kept; the buffer of all levels gets what is above the tile, on the way down, where it is the block's alone.
    All lanes of the block must come.
    """
    for depth in range(made + 1, widest + 1):
        steps = widest - depth
        level, kept = levels[depth], levels[KEPT + depth]
        to = Target()
        to.first = kept.first
        to.pitch = kept.pitch
        to.own_first = level.first
        to.own_pitch = level.pitch
        if not up:
            to.own = wp.vec4i(tile[0], tile[1], tile[0] + tile[2], tile[1] + tile[3]) * (1 << steps)
        box = box_of(narrow_square(tile, steps), level)
        if depth == 1:
            narrow_first(levels[0], texels, memory, to, box, lane, BLOCK_DIM)
        else:
            narrow_kept(levels[KEPT + depth - 1], texels, memory, to, box, lane, block_lanes())
        block_sync()


# ---- up


@wp.func
def tent_side(memory: wp.array[wp.uint64], wider: BloomLevel, columns: wp.vec4i, y: wp.int32):
    """One row of a kept level under the tent, mirrored, seen from one side; columns are mirrored already."""
    row = wider.first + mirrored(y, wider.height, wider.edge_y) * wider.pitch
    return tent_ahead_of_halves(
        word_value(memory, row + columns[0]),
        word_value(memory, row + columns[1]),
        word_value(memory, row + columns[2]),
        word_value(memory, row + columns[3]),
    )


@wp.func
def mix_kept(memory: wp.array[wp.uint64], wider: BloomLevel, level: BloomLevel, quads: wp.vec4i, lane: wp.int32):
    """Mix quads (x, y, width, height) of a kept level, those that the picture has, with the kept wider one, in place.

    A lane has half a quad, left or right: two texels, which see the same 16.
    """
    x0, y0 = wp.max(quads[0], 0), wp.max(quads[1], 0)
    width = 2 * (wp.min(quads[0] + quads[2], level.width // 2 + 1) - x0)
    height = wp.min(quads[1] + quads[3], level.height // 2 + 1) - y0
    for k in range(lane, width * height, block_lanes()):
        row, side = quotient(k, width), k & 1
        x, y = x0 + (k - row * width) // 2, y0 + row
        # The right half sees the columns in reverse.
        first, step = x - 2 + 3 * side, 1 - 2 * side
        columns = wp.vec4i(
            mirrored(first, wider.width, wider.edge_x),
            mirrored(first + step, wider.width, wider.edge_x),
            mirrored(first + 2 * step, wider.width, wider.edge_x),
            mirrored(first + 3 * step, wider.width, wider.edge_x),
        )
        a, b = tent_side(memory, wider, columns, y - 2), tent_side(memory, wider, columns, y - 1)
        c, d = tent_side(memory, wider, columns, y), tent_side(memory, wider, columns, y + 1)
        own = 2 * x - 1 + side
        upper = level.first + wp.max(2 * y - 1, 0) * level.pitch + own
        lower = level.first + wp.min(2 * y, level.height - 1) * level.pitch + own
        if own >= 0 and own < level.width:
            p, q = word_value(memory, upper), word_value(memory, lower)
            if y > 0:
                store_double_word(memory, upper, mixed(p, tent_ahead(a, b, c, d), level))
            if 2 * y < level.height:
                store_double_word(memory, lower, mixed(q, tent_ahead(d, c, b, a), level))


@wp.func
def mix_finest(
    memory: wp.array[wp.uint64],
    wider: BloomLevel,
    texels: wp.array[wp.uint64],
    level: BloomLevel,
    quads: wp.vec4i,
    lane: wp.int32,
):
    """Mix quads (x, y, width, height) of a level, those that the picture has, with the kept wider one, in place."""
    x0, y0 = wp.max(quads[0], 0), wp.max(quads[1], 0)
    width = wp.min(quads[0] + quads[2], level.width // 2 + 1) - x0
    end = wp.min(quads[1] + quads[3], level.height // 2 + 1)
    # As many lanes as there are, each a few quads down a column.
    height = (width * (end - y0) + block_lanes() - 1) // block_lanes()
    strips = quotient(end - y0 + height - 1, height)
    for k in range(lane, width * strips, block_lanes()):
        strip = quotient(k, width)
        x, y = x0 + k - strip * width, y0 + strip * height
        upsample_quads(memory, wider, texels, level, texels, level, x, y, wp.min(height, end - y))


@wp.func
def widen_levels(
    texels: wp.array[wp.uint64],
    memory: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    quads: wp.vec4i,
    widest: wp.int32,
    lane: wp.int32,
):
    """Mix all wider levels, kept, into quads of a level; all lanes of the block must come."""
    for k in range(1, widest):
        depth = widest - k
        mix_kept(memory, levels[KEPT + depth + 1], levels[KEPT + depth], seen(quads, depth), lane)
        block_sync()
    mix_finest(memory, levels[KEPT + 1], texels, levels[0], quads, lane)


@wp.kernel(grid_stride=False, launch_bounds=(BLOCK_DIM, 2))
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
    # What does not change is told before the block waits.
    up = step[1] == WIDEN
    share = views[item[0]].bloom
    finest = bloom.levels[item[3]]
    memory = block_memory(scratch)
    # Levels from the finest on: the widest that the block sees, and the one that it makes the wider ones of.
    widest, made = wp.min(finest.last - item[3], DOWN), wp.int32(0)
    tile = wp.vec4i(item[1], item[2], DOWN_WIDTH, DOWN_HEIGHT)
    quads = quads_of(finest, item)
    if up:
        # Level 1 is not among them: other blocks may have mixed it already.
        widest = finest.last - item[3]
        made = wp.where(widest > DOWN, widest - widest % DOWN, widest)
        last = seen(quads, widest - 1)
        tile = wp.vec4i(last[0] - 2, last[1] - 2, last[2] + 3, last[3] + 3)
    levels = block_levels(bloom.levels, item[3], widest + 1, scratch)
    keep_levels(levels, quads, tile, made, widest, lane)
    wait_for_step(out_counters, step[0], step[2])
    if share > 0.0:
        if up:
            fetch_levels(out_texels, memory, levels, quads, tile, made, widest, lane)
        else:
            touch_square(out_texels, levels[0], narrow_square(tile, widest), lane, BLOCK_DIM)
        narrow_levels(out_texels, memory, levels, tile, made, widest, up, lane)
        if up:
            widen_levels(out_texels, memory, levels, quads, widest, lane)
    finish_step(out_counters, step[0], step[3])
