"""Bloom's levels from 2 on, all in one launch: on a GPU a launch of a few thousand texels is nearly all waiting.

**Chain.** The work is cut into items of 64 lanes, four a block, listed step by step: down the pyramid, then up. A block
takes the next four off a counter, waits until all blocks of the step before are done, works and says so. Work is taken
in order, so whatever a block waits for is in the hands of blocks that run already: any number of blocks may be
resident, in any order, and none waits for ever. (The decoupled look-back of prefix sums rests on the same; Merrill and
Garland 2016, "Single-pass Parallel Prefix Scan with Decoupled Look-back".) The last block done sets the counters back
to 0. Counting releases what a block wrote, and the end of waiting acquires it. Where shade saw nothing bright every
block leaves at once: cheaper than a conditional node around the launches, which takes about 10 us of an H200 whether
it skips them or not.

**Together.** A step waits at least 5 us on an H200, so small levels share steps; what several blocks need each makes
again. Every texel is the one that `downsample_kernel` and `upsample_kernel` make, to the bit. A block keeps a square of
8 x 8 texels of a level in memory that its lanes share. That is what 2 x 2 texels see on the way down. On the way up it
is what 8 x 8 texels see, and a square of 8 x 8 again sees no more than 8 x 8 of the level after: one square a level,
however many levels there are.

`narrow_square` makes two levels, each texel of the finer one four times over: 4 x 36 loads a texel. `widen_square`
mixes all wider levels into one; its block makes its square of the widest level, 64 x 36 loads, and mixes once a level,
64 x 16 reads of shared memory. At 1080p either has 510 blocks: level 4 is 32 640 texels instead of 8160, and levels 6,
5, 4 and 3 on the way up are four squares a block, 130 560 texels instead of 43 110.
The CPU, where a block is one lane, takes the items one after the other, on one thread.
"""

from __future__ import annotations

import warp as wp

from .bloom import (
    downsample_pair,
    half_texel,
    mirrored,
    mixed,
    narrowed,
    six_sums,
    tent_ahead,
    thirteen_taps,
    upsample_quad,
    word_value,
)
from .intrinsics import load_vec4i, unpack_half3
from .lanes import finish_step, group_sync, next_turn, shared_double_words, wait_for_step, warp_width
from .projection import pixel_in_block
from .structs import Bloom, BloomLevel, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 256
#: Texels of an item's square, and along its side.
SQUARE = wp.constant(64)
SIDE = wp.constant(8)
#: Items of a block: fewer blocks wait, and there are fewer to count.
ITEMS = wp.constant(4)
#: Words of memory that an item's lanes share: two squares.
SHARED = 128
#: What an item is.
DOWNSAMPLE, NARROW, WIDEN, UPSAMPLE = (wp.constant(kind) for kind in range(4))


@wp.func
def lane_step():
    """Texels from one of a lane's to its next."""
    return wp.where(warp_width() > 1, SQUARE, 1)


@wp.func
def kept(scratch: wp.array[wp.uint64], slot: wp.int32):
    """Value of a slot of the block's memory."""
    return unpack_half3(shared_double_words(scratch, False, slot, wp.uint64(0)))


@wp.func
def six_kept(scratch: wp.array[wp.uint64], slot: wp.int32):
    """Sums of six slots in a row."""
    return six_sums(
        kept(scratch, slot),
        kept(scratch, slot + 1),
        kept(scratch, slot + 2),
        kept(scratch, slot + 3),
        kept(scratch, slot + 4),
        kept(scratch, slot + 5),
    )


@wp.func
def narrow_square(
    texels: wp.array[wp.uint64],
    finer: BloomLevel,
    level: BloomLevel,
    wider: BloomLevel,
    scratch: wp.array[wp.uint64],
    square: wp.vec4i,
    lane: wp.int32,
):
    """Fill two levels from the next finer one: 2 x 2 texels of the second; all lanes of the block must come."""
    for k in range(lane, SQUARE, lane_step()):
        i, j = k & (SIDE - 1), k // SIDE
        x, y = 2 * square[1] - 2 + i, 2 * square[2] - 2 + j
        mx, my = mirrored(x, level.width, level.edge_x), mirrored(y, level.height, level.edge_y)
        word = half_texel(narrowed(texels, finer, mx, my))
        shared_double_words(scratch, True, k, word)
        # The middle is the block's own.
        if wp.min(i, j) >= 2 and wp.max(i, j) < SIDE - 2 and x < level.width and y < level.height:
            texels[level.first + y * level.width + x] = word
    group_sync()
    for k in range(lane, 4, lane_step()):
        i, j = k & 1, k // 2
        x, y = square[1] + i, square[2] + j
        if x < wider.width and y < wider.height:
            slot = 2 * (j * SIDE + i)
            a, b = six_kept(scratch, slot), six_kept(scratch, slot + SIDE)
            c, d = six_kept(scratch, slot + 2 * SIDE), six_kept(scratch, slot + 3 * SIDE)
            e, f = six_kept(scratch, slot + 4 * SIDE), six_kept(scratch, slot + 5 * SIDE)
            texels[wider.first + y * wider.width + x] = half_texel(thirteen_taps(a, b, c, d, e, f))


@wp.func
def square_start(x: wp.int32, levels: wp.int32):
    """First texel of the square that a square from x on sees some levels wider."""
    start = wp.int32(x)
    for _ in range(levels):
        start = (start >> 1) - 2
    return start


@wp.func
def four_slots(x: wp.int32, start: wp.int32):
    """Places in the wider level's square that texel x sees, its own side's first, as `tent_ahead` takes them.

    Texels outside the level see too far; no one looks at them.
    """
    step = 2 * (x & 1) - 1
    place = (x >> 1) - start
    return wp.vec4i(
        wp.clamp(place - step, 0, SIDE - 1),
        wp.clamp(place, 0, SIDE - 1),
        wp.clamp(place + step, 0, SIDE - 1),
        wp.clamp(place + 2 * step, 0, SIDE - 1),
    )


@wp.func
def tent_kept(scratch: wp.array[wp.uint64], slot: wp.int32, columns: wp.vec4i):
    """One row under the tent."""
    return tent_ahead(
        kept(scratch, slot + columns[0]),
        kept(scratch, slot + columns[1]),
        kept(scratch, slot + columns[2]),
        kept(scratch, slot + columns[3]),
    )


@wp.func
def widened(
    texels: wp.array[wp.uint64],
    scratch: wp.array[wp.uint64],
    half: wp.int32,
    level: BloomLevel,
    at: wp.vec2i,
    start: wp.vec2i,
):
    """Texel of a level, mixed with the wider one, whose square begins at start and is in a half of the memory."""
    columns, rows = four_slots(at[0], start[0]), four_slots(at[1], start[1]) * SIDE
    own = word_value(texels, level.first + at[1] * level.width + at[0])
    a = tent_kept(scratch, half + rows[0], columns)
    b = tent_kept(scratch, half + rows[1], columns)
    c = tent_kept(scratch, half + rows[2], columns)
    d = tent_kept(scratch, half + rows[3], columns)
    return mixed(own, tent_ahead(a, b, c, d), level)


@wp.func
def widen_square(
    texels: wp.array[wp.uint64],
    levels: wp.array[BloomLevel],
    scratch: wp.array[wp.uint64],
    square: wp.vec4i,
    lane: wp.int32,
):
    """Mix all wider levels, at least two, into 8 x 8 texels of a level; all lanes of the block must come.

    The widest level is made here and kept nowhere.
    """
    last = levels[square[3]].last
    widest, finer = levels[last], levels[last - 1]
    start = wp.vec2i(square_start(square[1], last - square[3]), square_start(square[2], last - square[3]))
    for k in range(lane, SQUARE, lane_step()):
        mx = mirrored(start[0] + (k & (SIDE - 1)), widest.width, widest.edge_x)
        my = mirrored(start[1] + k // SIDE, widest.height, widest.edge_y)
        shared_double_words(scratch, True, k, half_texel(narrowed(texels, finer, mx, my)))
    half = wp.int32(0)
    for n in range(last - square[3]):
        steps = last - square[3] - 1 - n
        level = levels[square[3] + steps]
        wider_start = wp.vec2i(square_start(square[1], steps + 1), square_start(square[2], steps + 1))
        x0, y0 = square_start(square[1], steps), square_start(square[2], steps)
        group_sync()
        for k in range(lane, SQUARE, lane_step()):
            x, y = x0 + (k & (SIDE - 1)), y0 + k // SIDE
            at = wp.vec2i(mirrored(x, level.width, level.edge_x), mirrored(y, level.height, level.edge_y))
            word = widened(texels, scratch, half, level, at, wider_start)
            if steps > 0:
                shared_double_words(scratch, True, (SQUARE - half) + k, word)
            elif x < level.width and y < level.height:
                texels[level.first + y * level.width + x] = word
        half = SQUARE - half


@wp.kernel(grid_stride=False)
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
    """Turn level 1 into bloom: a block four items.

    Items are view, x, y and row of `levels`, with view -1 where a step has no fourth one; `steps` has for each block
    the number of its step, what it is, the blocks of the step before, and those of its own, negative in the last step.
    """
    # The same for the whole block, as all that follows up to its items.
    if bloom.bright[0] == 0:
        return
    thread = wp.tid()
    lane = thread & (SQUARE - 1)
    turn = next_turn(out_counters, thread // BLOCK_DIM)
    item = load_vec4i(items, turn * ITEMS + (thread & (BLOCK_DIM - 1)) // SQUARE)
    step = load_vec4i(steps, turn)
    # What does not change is on its way while the block waits.
    kind, row = step[1], wp.max(item[3], 0)
    share = wp.float32(0.0)
    if item[0] >= 0:
        share = views[item[0]].bloom
    level = bloom.levels[row]
    other = bloom.levels[wp.where(kind == UPSAMPLE, row + 1, wp.max(row - 1, 0))]
    finest = bloom.levels[wp.max(row - 2, 0)]
    wait_for_step(out_counters, step[0], step[2])
    if share > 0.0:
        if kind == DOWNSAMPLE:
            downsample_pair(out_texels, level, other, item, pixel_in_block(thread))
        elif kind == UPSAMPLE:
            upsample_quad(out_texels, level, other, item, pixel_in_block(thread))
        elif lane == 0 or warp_width() > 1:
            if kind == NARROW:
                narrow_square(out_texels, finest, other, level, scratch, item, lane)
            else:
                widen_square(out_texels, bloom.levels, scratch, item, lane)
    finish_step(out_counters, step[0], step[3])
