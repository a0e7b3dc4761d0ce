"""Edge-aware averages of occlusion words (see ambient_visibility.py), a tile of pixels a block.

**Narrow blur.** Weights 1/2 1 1 1 1/2 along rows, then columns: any 4 x 4 neighbours count alike, so a pattern that
repeats every 4 pixels averages out. A neighbour counts by how far its affine depth (linear across a plane, whatever its
tilt) lies from the line through the pixel, whose slope is the smaller of the two differences to its direct neighbours:
1 on the line, 0 at the tolerance. The tolerance is a share of the radius, since visibility varies over lengths of the
radius.

**Wide blur.** Where the radius covers many pixels, samples lie far apart and thin things leave streaks. There the same
weights follow for every third pixel, which again meets all of the 4 x 4 pattern alike (3 and 4 have no common factor).
A neighbour counts less the more its visibility differs, so that streaks go and the dark foot of a small thing stays.

A block of 64 lanes has 16 x 16 pixels of the full image, or 8 x 8 of the half-size one, which is a raster bin either
way. It stages them and what lies around them as words in shared memory, then what blurring their rows makes of them;
where no word is darkened, that is all. The CPU, where a block is one lane, reads the image instead, and blurs the rows
anew for each pixel. The low bits of a word's depth are its code: 3e-5 of the depth, far below the tolerance.
Deterministic; arithmetic is + - * and fused multiply-adds, the same bits on all devices.

Cost at 1920 x 1080: each blur moves 8 bytes a pixel, 17 MB, 4 us at 4.2 TB/s. For a pixel of the full image the narrow
blur takes 1.56 loads, 1.25 averages along rows and one along columns, the wide one 3.06, 1.75 and one; an average is
about 75 instructions, a wide one 90.
"""

from __future__ import annotations

import functools

import warp as wp

from .ambient_visibility import CODE_MASK, DEPTH_MASK, OPEN_WORD, half_index
from .intrinsics import (
    bits_float,
    block_any,
    block_is_lane,
    block_sync,
    float_bits,
    fma,
    fnma,
    load_vec4i,
    load_word_or,
    saturated_fma,
    shared_single,
)
from .projection import pixel_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Radius on the screen from which a wide blur follows the narrow one [px]: twice its own footprint.
WIDE_PX = wp.constant(26.0)
#: A wide blur counts nothing whose visibility lies 1 / 8 away, for codes in 255ths.
SHARP = wp.constant(-8.0 / 255.0)
#: Distance from the line or plane, as a share of the radius, at which a neighbour no longer counts.
TOLERANCE = wp.constant(0.15)
#: Bits of 2^23, whose low ones hold a whole number that is added.
WHOLE_BITS = wp.constant(wp.uint32(0x4B000000))
#: Words from one staged row to the next: two rows of 16 meet different banks.
PITCH = wp.constant(48)
#: First staged word of what blurring the rows makes.
ROWS = wp.constant(1344)
#: (half, wide): what CI compiles.
VARIANTS = [(False, False), (False, True), (True, False), (True, True)]


@wp.func
def word_depth(word: wp.uint32):
    """Affine depth of a word; +inf on the background."""
    return bits_float(word & DEPTH_MASK)


@wp.func
def word_visibility(word: wp.uint32):
    """Visibility of a word; exactly 1 for code 0 and 0 for code 255."""
    return 1.0 - wp.float32(wp.int32(word & CODE_MASK)) * (1.0 / 255.0)


@wp.func
def final_visibility(visibility: wp.float32, power: wp.float32):
    """Visibility to a power; exact for powers 0 and 1, where no library function is called."""
    v = wp.clamp(visibility, 0.0, 1.0)
    if power == 1.0:
        return v
    if power == 0.0:
        return wp.float32(1.0)
    return wp.pow(v, power)


@wp.func
def rough_reciprocal(x: wp.float32):
    """1 / x within 3e-4 for x from 1e-37 to 1e37, by two Newton steps; x = 0 gives infinity."""
    y = bits_float(wp.uint32(0x7EF311C7) - float_bits(x))
    y = y * fnma(x, y, 2.0)
    return y * fnma(x, y, 2.0)


@wp.func
def whole_code(word: wp.uint32):
    """2^23 and the code of a word: differences are exact, and a sum is rounded to a code in its low bits."""
    return bits_float((word & CODE_MASK) | WHOLE_BITS)


@wp.func
def smaller_slope(before: wp.float32, after: wp.float32):
    """The one of two differences that is nearer to 0; one that is not finite loses."""
    if wp.abs(before) < wp.abs(after):
        return before
    return after


@wp.func
def tolerance_of(view: View, affine: wp.float32, radius: wp.float32):
    """Difference of affine depths at which a neighbour no longer counts."""
    if view.projection == ORTHOGRAPHIC:
        return TOLERANCE * radius
    # d(1/z) = dz / z^2.
    return TOLERANCE * radius * affine * affine


@wp.func
def is_narrow(view: View, affine: wp.float32, radius: wp.float32):
    """Whether the radius covers too few pixels for a wide blur."""
    if view.projection == ORTHOGRAPHIC:
        return radius * view.scale[0] < WIDE_PX
    return radius * affine * view.scale[0] < WIDE_PX


@functools.cache
def make_blur_kernel(half: bool, wide: bool):
    """Kernel that blurs an image of words, narrowly or widely.

    Args:
        half: Blur the half-size image.
        wide: Blur widely. Of the full image this is the end, visibility in [0, 1], 1 on the background.
    """
    side, step = 8 if half else 16, 3 if wide else 1
    reach, staged, final = 2 * step, side + 4 * step, wide and not half
    written = wp.float32 if final else wp.uint32

    @wp.func
    def add_neighbour(
        sums: wp.vec2, word: wp.uint32, line: wp.float32, tolerance: wp.float32, share: float, own: wp.float32
    ):
        """(weighted difference of codes, weight) after one more neighbour; `line` is a flat surface's affine depth."""
        difference = whole_code(word) - own
        # The maximum is 0 for the background and whatever is not finite.
        weight = share * wp.max(tolerance - wp.abs(bits_float(word) - line), 0.0)
        if wp.static(wide):
            weight = weight * saturated_fma(wp.abs(difference), SHARP, 1.0)
        return wp.vec2(fma(weight, difference, sums[0]), sums[1] + weight)

    @wp.func
    def average(
        view: View, b2: wp.uint32, b1: wp.uint32, centre: wp.uint32, f1: wp.uint32, f2: wp.uint32, radius: wp.float32
    ):
        """What a pixel's code differs by from its average with two before and two after it along a row or column."""
        # An average of equals is itself: open surfaces end here.
        apart = (b2 ^ centre) | (b1 ^ centre) | (f1 ^ centre) | (f2 ^ centre)
        a = bits_float(centre)
        still = centre == OPEN_WORD or (apart & CODE_MASK) == wp.uint32(0)
        if wp.static(wide):
            still = still or is_narrow(view, a, radius)
        if still:
            return wp.float32(0.0)
        own = whole_code(centre)
        slope = smaller_slope(a - bits_float(b1), bits_float(f1) - a)
        tolerance = tolerance_of(view, a, radius)
        sums = wp.vec2(0.0, tolerance)
        sums = add_neighbour(sums, b2, a - (slope + slope), tolerance, 0.5, own)
        sums = add_neighbour(sums, b1, a - slope, tolerance, 1.0, own)
        sums = add_neighbour(sums, f1, a + slope, tolerance, 1.0, own)
        sums = add_neighbour(sums, f2, a + (slope + slope), tolerance, 0.5, own)
        change = sums[0] * rough_reciprocal(sums[1])
        # Depths whose squares leave float32 give a NaN, whose bits differ between devices.
        return wp.where(wp.abs(change) <= 255.0, change, 0.0)

    @wp.func
    def word_at(view: View, words: wp.array[wp.uint32], x: wp.int32, y: wp.int32):
        """Word of a pixel; outside the image stands the background."""
        width, height = wp.int32(view.width), wp.int32(view.height)
        i = pixel_index(view, x, y)
        if wp.static(half):
            width, height = (width + 1) >> 1, (height + 1) >> 1
            i = half_index(view, x, y)
        inside = wp.uint32(x) < wp.uint32(width) and wp.uint32(y) < wp.uint32(height)
        return load_word_or(words, i, inside, OPEN_WORD)

    @wp.func
    def tap(view: View, words: wp.array[wp.uint32], corner: wp.vec2i, x: wp.int32, y: wp.int32):
        """Word (x, y) of the staged ones."""
        word = wp.uint32(0)
        if block_is_lane():
            word = word_at(view, words, corner[0] + x, corner[1] + y)
        return shared_single(False, y * PITCH + x, word)

    @wp.func
    def row_word(
        view: View, words: wp.array[wp.uint32], corner: wp.vec2i, x: wp.int32, y: wp.int32, radius: wp.float32
    ):
        """Word blurred along its row; x = 0 is the tile's first column, y = 0 the first staged row."""
        b2, b1 = tap(view, words, corner, x, y), tap(view, words, corner, x + wp.static(step), y)
        centre = tap(view, words, corner, x + wp.static(2 * step), y)
        f1 = tap(view, words, corner, x + wp.static(3 * step), y)
        f2 = tap(view, words, corner, x + wp.static(4 * step), y)
        code = whole_code(centre) + average(view, b2, b1, centre, f1, f2, radius)
        return (centre & DEPTH_MASK) | (float_bits(code) & CODE_MASK)

    @wp.func
    def row_tap(view: View, words: wp.array[wp.uint32], corner: wp.vec2i, x: wp.int32, y: wp.int32, radius: wp.float32):
        """`row_word` of what the block has made already."""
        word = wp.uint32(0)
        if block_is_lane():
            word = row_word(view, words, corner, x, y, radius)
        return shared_single(False, ROWS + y * wp.static(side) + x, word)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def blur_kernel(
        # Frame
        views: wp.array[View],
        bin_tiles: wp.array[wp.vec4i],
        # In
        words: wp.array[wp.uint32],
        # Params
        radius: wp.float32,
        power: wp.float32,
        first: wp.int32,
        # Out
        out_values: wp.array[written],
    ):
        thread = wp.tid() + first
        lane = thread & (BLOCK_DIM - 1)
        tile = load_vec4i(bin_tiles, pixel_block(thread))
        view = views[tile[0]]
        # The same for the whole block; no lane leaves before all have staged.
        if view.depth_only != 0:
            return
        corner = wp.vec2i(tile[1] - wp.static(reach), tile[2] - wp.static(reach))
        width, height = wp.int32(view.width), wp.int32(view.height)
        if wp.static(half):
            corner = wp.vec2i((tile[1] >> 1) - wp.static(reach), (tile[2] >> 1) - wp.static(reach))
            width, height = (width + 1) >> 1, (height + 1) >> 1
        dark = wp.bool(True)
        if not block_is_lane():
            column, codes = lane & 31, wp.uint32(0)
            if column < wp.static(staged):
                for row in range(lane >> 5, wp.static(staged), 2):
                    word = word_at(view, words, corner[0] + column, corner[1] + row)
                    shared_single(True, row * PITCH + column, word)
                    codes = codes | word
            dark = block_any((codes & CODE_MASK) != wp.uint32(0))
            if dark:
                for k in range(lane, wp.static(staged * side), BLOCK_DIM):
                    x, y = k & wp.static(side - 1), k // wp.static(side)
                    shared_single(True, ROWS + k, row_word(view, words, corner, x, y, radius))
                block_sync()
        for j in range(wp.static(side * side // BLOCK_DIM)):
            k = lane + j * BLOCK_DIM
            x, y = k & wp.static(side - 1), k // wp.static(side)
            px, py = corner[0] + wp.static(reach) + x, corner[1] + wp.static(reach) + y
            if px < width and py < height:
                i = pixel_index(view, px, py)
                if wp.static(half):
                    i = half_index(view, px, py)
                word, change = wp.uint32(0), wp.float32(0.0)
                if dark:
                    b2 = row_tap(view, words, corner, x, y, radius)
                    b1 = row_tap(view, words, corner, x, y + wp.static(step), radius)
                    word = row_tap(view, words, corner, x, y + wp.static(2 * step), radius)
                    f1 = row_tap(view, words, corner, x, y + wp.static(3 * step), radius)
                    f2 = row_tap(view, words, corner, x, y + wp.static(4 * step), radius)
                    change = average(view, b2, b1, word, f1, f2, radius)
                else:
                    word = tap(view, words, corner, x + wp.static(reach), y + wp.static(reach))
                if wp.static(final):
                    code = wp.float32(wp.int32(word & CODE_MASK)) + change
                    out_values[i] = written(final_visibility(1.0 - code * (1.0 / 255.0), power))
                else:
                    code = whole_code(word) + change
                    out_values[i] = written((word & DEPTH_MASK) | (float_bits(code) & CODE_MASK))

    return blur_kernel
