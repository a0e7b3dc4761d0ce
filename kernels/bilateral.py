"""Edge-aware averages of visibility words (see ambient_visibility.py): a 5 x 5 blur in two passes, and a doubling of
size.

**Blur.** Weights 1/2 1 1 1 1/2 along rows, then columns: any 4 x 4 neighbours count alike, so a pattern that repeats
every 4 pixels averages out. A neighbour counts by how far its affine depth (linear across a plane, whatever its tilt)
lies from the line through the pixel, whose slope is the smaller of the two differences to its direct neighbours: 1 on
the line, 0 at the tolerance. The tolerance is a share of the radius, since visibility varies over lengths of the
radius.

Where the radius covers many pixels, samples lie far apart and thin things leave streaks. There a wide blur follows,
with the same weights for every third pixel, which again meets all of the 4 x 4 pattern alike (3 and 4 have no common
factor). It counts a neighbour less the more its visibility differs, so that streaks go and the dark foot of a small
thing stays.

**Upsampling.** A pixel takes the bilinear weights of its up to four half-size neighbours times how near their points
lie to the plane through its point across its normal (after Kopf et al. 2007, "Joint Bilateral Upsampling").

Block size 64, one thread a pixel; deterministic. At 1920 x 1080 a blur pass moves 8 bytes a pixel, 17 MB, 4 us at 4.2
TB/s. Arithmetic: about 200 instructions a pixel, 14 us at 29.6 T/s, among them two divisions; a third of that where all
five visibilities are the same.
"""

from __future__ import annotations

import functools

import warp as wp

from .ambient_visibility import DEPTH_MASK, OPEN_WORD, half_index, point_in_view
from .encoding import make_gbuffer_codec
from .intrinsics import bits_float, load_float, load_vec4i, load_word
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Radius on the screen from which a wide blur follows the narrow one [px]: twice its own footprint.
WIDE_PX = wp.constant(26.0)
#: A wide blur counts nothing whose visibility lies 1 / 8 away, for codes in 255ths.
SHARP = wp.constant(8.0 / 255.0)
#: Distance from the line or plane, as a share of the radius, at which a neighbour no longer counts.
TOLERANCE = wp.constant(0.15)
#: What a neighbour counts for that lies on another surface: it decides only where all do.
STRANGER = wp.constant(1.0e-4)
#: Codecs of the G-buffer: what CI compiles.
VARIANTS = [(("compact", "oct24", True),), (("full", "float32", True),)]


@wp.func
def word_depth(word: wp.uint32):
    """Affine depth of a word; +inf on the background."""
    return bits_float(word & DEPTH_MASK)


@wp.func
def word_code(word: wp.uint32):
    """Visibility of a word in 255ths."""
    return wp.float32(wp.int32(word & wp.uint32(255)))


@wp.func
def word_visibility(word: wp.uint32):
    """Visibility of a word."""
    # A constant multiplication; exact for codes 0 and 255.
    return word_code(word) * (1.0 / 255.0)


@wp.func
def final_visibility(visibility: wp.float32, power: wp.float32):
    """Visibility to a power; exact for powers 0 and 1, where no library function is called."""
    v = wp.min(visibility, 1.0)
    if power == 1.0:
        return v
    if power == 0.0:
        return wp.float32(1.0)
    return wp.pow(v, power)


@wp.func
def smaller_slope(before: wp.float32, after: wp.float32):
    """The one of two differences that is nearer to 0; one that is not finite loses."""
    if wp.abs(before) < wp.abs(after):
        return before
    return after


@wp.func
def add_neighbour(
    sums: wp.vec2,
    word: wp.uint32,
    line: wp.float32,
    tightness: wp.float32,
    share: wp.float32,
    own: wp.float32,
    sharp: wp.float32,
):
    """(weighted difference of codes, weight) after one more neighbour; `line` is a flat surface's affine depth.

    A neighbour counts nothing 1 / tightness or more off the line, nor where its code lies 1 / sharp or more from the
    pixel's `own`; sharp 0: always.
    """
    near = 1.0 - wp.abs(word_depth(word) - line) * tightness
    # Also false for the background, and where something is not finite.
    if near > 0.0:
        difference = word_code(word) - own
        weight = share * near * wp.max(1.0 - sharp * wp.abs(difference), 0.0)
        return sums + wp.vec2(weight * difference, weight)
    return sums


@wp.func
def blurred(
    view: View,
    words: wp.array[wp.uint32],
    i: wp.int32,
    centre: wp.uint32,
    pitch: wp.int32,
    at: wp.int32,
    count: wp.int32,
    step: wp.int32,
    radius: wp.float32,
):
    """Code of the visibility averaged along a line of pixels, `pitch` words apart; word i, `centre`, is the at-th.

    Every step-th pixel is met; from a step above 1 on, visibility has to be like the pixel's own.
    """
    # Outside the image stands the background, which counts for nothing.
    b2, b1, f1, f2 = OPEN_WORD, OPEN_WORD, OPEN_WORD, OPEN_WORD
    stride = step * pitch
    if at >= step:
        b1 = load_word(words, i - stride)
    if at >= 2 * step:
        b2 = load_word(words, i - 2 * stride)
    if at + step < count:
        f1 = load_word(words, i + stride)
    if at + 2 * step < count:
        f2 = load_word(words, i + 2 * stride)
    # An average of equals needs no weights: open surfaces end here.
    apart = (b2 ^ centre) | (b1 ^ centre) | (f1 ^ centre) | (f2 ^ centre)
    v = word_code(centre)
    if (apart & wp.uint32(255)) == wp.uint32(0):
        return v
    a = word_depth(centre)
    slope = smaller_slope(a - word_depth(b1), word_depth(f1) - a)
    tolerance = TOLERANCE * radius
    if view.projection != ORTHOGRAPHIC:
        # d(1/z) = dz / z^2.
        tolerance = tolerance * a * a
    tightness = 1.0 / tolerance
    sharp = wp.where(step > 1, SHARP, 0.0)
    # Differences from the pixel's own: an average of equals is exact.
    sums = wp.vec2(0.0, 1.0)
    sums = add_neighbour(sums, b2, a - 2.0 * slope, tightness, 0.5, v, sharp)
    sums = add_neighbour(sums, b1, a - slope, tightness, 1.0, v, sharp)
    sums = add_neighbour(sums, f1, a + slope, tightness, 1.0, v, sharp)
    sums = add_neighbour(sums, f2, a + 2.0 * slope, tightness, 0.5, v, sharp)
    return v + sums[0] / sums[1]


@wp.func
def is_narrow(view: View, affine: wp.float32, radius: wp.float32):
    """Whether the radius covers too few pixels for a wide blur."""
    if view.projection == ORTHOGRAPHIC:
        return radius * view.scale[0] < WIDE_PX
    return radius * affine * view.scale[0] < WIDE_PX


@wp.kernel(grid_stride=False)
def blur_words_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    words: wp.array[wp.uint32],
    # Params
    radius: wp.float32,
    columns: wp.int32,
    wide: wp.int32,
    half: wp.int32,
    first: wp.int32,
    # Out
    out_words: wp.array[wp.uint32],
):
    """Blur along rows (columns = 0) or columns (1), of the full image over 8 x 8 blocks or the half one over bins.

    A wide blur takes every third pixel and leaves alone what has a small radius.
    """
    thread = wp.tid() + first
    tile = load_vec4i(tiles, pixel_block(thread))
    view = views[tile[0]]
    place = pixel_in_block(thread)
    x, y = (tile[1] >> half) + place[0], (tile[2] >> half) + place[1]
    width, height = (view.width + half) >> half, (view.height + half) >> half
    if x >= width or y >= height or view.depth_only != 0:
        return
    i, pitch = pixel_index(view, x, y), wp.int32(view.row_pitch)
    if half != 0:
        i, pitch = half_index(view, x, y), view.bins_x * 8
    centre = load_word(words, i)
    step = wp.int32(1 + 2 * wide)
    if centre == OPEN_WORD or (wide != 0 and is_narrow(view, word_depth(centre), radius)):
        out_words[i] = centre
        return
    # One call for rows and columns: two would be two copies of everything.
    at, count = wp.int32(x), wp.int32(width)
    if columns != 0:
        at, count = wp.int32(y), wp.int32(height)
    else:
        pitch = 1
    code = blurred(view, words, i, centre, pitch, at, count, step, radius)
    out_words[i] = (centre & DEPTH_MASK) | wp.uint32(wp.int32(code + 0.5))


@wp.kernel(grid_stride=False)
def blur_final_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    words: wp.array[wp.uint32],
    # Params
    radius: wp.float32,
    power: wp.float32,
    first: wp.int32,
    # Out
    out_visibility: wp.array[wp.float32],
):
    """Wide blur along columns of the full image, and finish: visibility in [0, 1], 1 on the background."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    view = views[block[0]]
    place = pixel_in_block(thread)
    x, y = block[1] + place[0], block[2] + place[1]
    if x >= view.width or y >= view.height:
        return
    i = pixel_index(view, x, y)
    centre = load_word(words, i)
    code = word_code(centre)
    if centre != OPEN_WORD and not is_narrow(view, word_depth(centre), radius):
        code = blurred(view, words, i, centre, view.row_pitch, y, view.height, 3, radius)
    out_visibility[i] = final_visibility(code * (1.0 / 255.0), power)


@functools.cache
def make_upsample_kernel(codec: tuple):
    """Kernel that doubles the size of a half-size image of words.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
    """
    decode = make_gbuffer_codec(*codec)[1]

    @wp.func
    def add_point(
        view: View,
        word: wp.uint32,
        share: wp.float32,
        across: wp.float32,
        plane: wp.vec2,
        tightness: wp.float32,
        sums: wp.vec2,
    ):
        """(weighted visibility, weight) after a half-size pixel.

        across is the normal's x and y parts times the pixel's x / depth and y / depth (orthographic: x and y); plane is
        the normal's z and the plane's offset.
        """
        if share == 0.0:
            return sums
        weight = STRANGER * share
        if word != OPEN_WORD:
            affine = word_depth(word)
            height = across - plane[0] * affine
            if view.projection != ORTHOGRAPHIC:
                height = (across - plane[0]) * (1.0 / affine)
            near = 1.0 - wp.abs(height - plane[1]) * tightness
            if near > 0.0:
                weight += share * near
        return sums + wp.vec2(weight * word_visibility(word), weight)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def upsample_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        gbuffer: GBuffer,
        words: wp.array[wp.uint32],
        # Params
        radius: wp.float32,
        power: wp.float32,
        first: wp.int32,
        # Out
        out_visibility: wp.array[wp.float32],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, pixel_block(thread))
        view = views[block[0]]
        place = pixel_in_block(thread)
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        d = load_float(gbuffer.depth, i)
        if not wp.isfinite(d):
            out_visibility[i] = 1.0
            return
        # Half-size pixel k is pixel 2 k: an odd pixel stands midway between two, if there are two.
        pitch, k = view.bins_x * 8, half_index(view, x >> 1, y >> 1)
        right = wp.where((x & 1) != 0 and x + 1 < view.width, 1, 0)
        below = wp.where((y & 1) != 0 and y + 1 < view.height, 1, 0)
        w00, w10 = load_word(words, k), load_word(words, k + right)
        w01, w11 = load_word(words, k + below * pitch), load_word(words, k + below * pitch + right)
        v = word_visibility(w00)
        # As in the blur: an average of equals needs no weights.
        if (((w10 ^ w00) | (w01 ^ w00) | (w11 ^ w00)) & wp.uint32(255)) != wp.uint32(0):
            inverse = wp.vec2(1.0 / view.scale[0], 1.0 / view.scale[1])
            n = view.rotation * decode(gbuffer, i).normal
            point = point_in_view(view, wp.float32(x) + 0.5, wp.float32(y) + 0.5, d, inverse)
            plane = wp.vec2(n[2], wp.dot(n, point))
            tx, ty = n[0] * inverse[0], n[1] * inverse[1]
            px, py = wp.float32(x & -2) + 0.5 - view.center[0], wp.float32(y & -2) + 0.5 - view.center[1]
            left, up = tx * px, ty * py
            rim, foot = tx * (px + 2.0), ty * (py + 2.0)
            sx, sy = 0.5 * wp.float32(right), 0.5 * wp.float32(below)
            # A depth's 16 bits are no nearer than this.
            tightness = 1.0 / (TOLERANCE * radius + 2.0e-4 * wp.abs(d))
            sums = wp.vec2(0.0, 0.0)
            sums = add_point(view, w00, (1.0 - sx) * (1.0 - sy), left + up, plane, tightness, sums)
            sums = add_point(view, w10, sx * (1.0 - sy), rim + up, plane, tightness, sums)
            sums = add_point(view, w01, (1.0 - sx) * sy, left + foot, plane, tightness, sums)
            sums = add_point(view, w11, sx * sy, rim + foot, plane, tightness, sums)
            v = sums[0] / sums[1]
        out_visibility[i] = final_visibility(v, power)

    return upsample_kernel
