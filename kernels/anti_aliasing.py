"""Anti-aliasing of the finished picture: FXAA. One thread a pixel, block size 64; last in the frame, after display.

Method: fast approximate anti-aliasing (Lottes 2009, "FXAA", NVIDIA white paper, and the notes on its version 3.11,
2011). Where luma among a pixel and its four neighbours differs enough, second differences of the 3 x 3 pixels tell
whether an edge runs along x or along y; the steeper neighbour across it is the pixel's partner, and the mean luma of
the two is followed both ways along the edge until it changes. How far the nearer of these ends is says how much of the
pixel lies beyond the edge, and as much of the partner is mixed in. A low pass over the 3 x 3 pixels finds what is
smaller than that, such as lone pixels and lines.

Departures, each for exactness. Ends are looked for pixel by pixel, 16 each way. A step between rows lies at the border
of two pixels, so an end k pixels away is k - 1/2 from the centre; then an edge whose steps are found is mixed by its
exact mean coverage. The low pass counts only past what an edge along an axis gives (a third of the contrast); from
there it grows as a square root, like the mean coverage at stairs of one pixel, lines and lone pixels, but to a quarter
and not to the half that would fit them: a lone pixel may as well be texture.
Luma is that of the codes (Rec. 709 weights in 256ths), so every decision is made in integers and is the same on every
device; colours are mixed in linear light and encoded as display does.

What stays as it is to the bit: alpha; flat surroundings; every picture that is constant along x, or along y, and never
rises after it fell (or the other way) across, up to its borders. A corner of such edges is rounded, a line gets softer.
Views are clamped at their borders and never see one another.

Bytes a pixel: 4 in, 4 out; the neighbours come from the cache. Operations: about 60 where nothing is done; at edges
up to 64 cached loads more.
"""

from __future__ import annotations

import warp as wp

from .color import srgb_code
from .intrinsics import load_vec4i, load_word, weigh_bytes
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Alpha is in the highest byte.
ALPHA_BITS = wp.constant(wp.uint32(0xFF000000))
#: Weights 54, 183, 19 and 0 of red, green, blue and alpha, red's in the lowest byte.
LUMA_WEIGHTS = wp.constant(wp.uint32(0x0013B736))
#: Pixels each way within which an end of an edge is looked for.
STEPS = wp.constant(16)
#: Contrast below which nothing is done, in 256ths of a code: a twelfth of white, version 3.11's usual choice.
LEAST_CONTRAST = wp.constant(21 * 256)
#: Contrast below which nothing is done: the brightest luma over this; likewise.
RELATIVE_CONTRAST = wp.constant(6)
#: Most that the low pass may mix in.
MOST_LOW_PASS = wp.constant(wp.float32(0.25))


@wp.func
def luma(picture: wp.array[wp.uint32], i: wp.int32):
    """Luma of a pixel's codes, 0 to 65280."""
    return weigh_bytes(load_word(picture, i), LUMA_WEIGHTS)


@wp.func
def channel(code: wp.uint32, shift: wp.uint32):
    """One 8-bit channel of a pixel."""
    return wp.int32((code >> shift) & wp.uint32(255))


@wp.func
def low_pass_share(difference: wp.int32, contrast: wp.int32):
    """How much the low pass mixes in, 0 up to what a monotone edge along an axis gives.

    Args:
        difference: 12 times the distance of the pixel's luma from the low pass.
        contrast: Largest less smallest luma of the pixel and its four neighbours, > 0.
    """
    past = wp.min(wp.abs(difference), 12 * contrast) - 4 * contrast
    if past <= 0:
        return wp.float32(0.0)
    return MOST_LOW_PASS * wp.sqrt(wp.float32(past) / wp.float32(8 * contrast))


@wp.func
def find_end(
    picture: wp.array[wp.uint32],
    start: wp.int32,
    partner: wp.int32,
    step: wp.int32,
    room: wp.int32,
    level: wp.int32,
    limit: wp.int32,
):
    """(pixels to the end of an edge, change of luma there); (STEPS + 1, 0) where none is found.

    A view's border is no end: the edge goes on behind it.

    Args:
        picture: The picture.
        start: Index of the pixel.
        partner: What leads from a pixel to its partner across the edge.
        step: What leads to the next pixel along the edge.
        room: Pixels up to the view's border.
        level: Sum of luma of the pixel and its partner.
        limit: Half the change of that sum that makes an end.
    """
    pixels = wp.int32(STEPS + 1)
    change = wp.int32(0)
    i = wp.int32(start)
    for k in range(1, wp.min(room, STEPS) + 1):
        i += step
        here = luma(picture, i) + luma(picture, i + partner) - level
        if 2 * wp.abs(here) >= limit:
            pixels = k
            change = here
            break
    return wp.vec2i(pixels, change)


@wp.func
def edge_share(picture: wp.array[wp.uint32], i: wp.int32, partner: wp.int32, step: wp.int32, rooms: wp.vec2i):
    """How much of the pixel lies beyond the edge between it and its partner, in [0, 1/2).

    The true edge crosses the one we see in the middle of its run of n pixels and is half a pixel off at its ends, so
    the pixel k from the nearer end has 1/2 - (k - 1/2) / n of it on the other side, on the one side that the sign of
    the change at that end tells.
    """
    own = luma(picture, i)
    other = luma(picture, i + partner)
    limit = wp.abs(other - own)
    back = find_end(picture, i, partner, -step, rooms[0], own + other, limit)
    ahead = find_end(picture, i, partner, step, rooms[1], own + other, limit)
    change = back[1]
    if ahead[0] < back[0]:
        change = ahead[1]
    # At an end that gets like the pixel itself its edge turns away from it.
    if change * (wp.where(own > other, 1, -1)) >= 0:
        return wp.float32(0.0)
    return wp.float32(wp.abs(ahead[0] - back[0])) / wp.float32(2 * (ahead[0] + back[0] - 1))


@wp.func
def mix_codes(
    code: wp.uint32,
    other: wp.uint32,
    share: wp.float32,
    linear: wp.array[wp.float32],
    thresholds: wp.array[wp.float32],
):
    """Mix two pixels in linear light; alpha stays the first one's."""
    mixed = code & ALPHA_BITS
    for k in range(3):
        shift = wp.uint32(8 * k)
        own = linear[channel(code, shift)]
        mixed |= srgb_code(own + (linear[channel(other, shift)] - own) * share, thresholds) << shift
    return mixed


@wp.kernel(grid_stride=False)
def anti_aliasing_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    picture: wp.array[wp.uint32],
    linear: wp.array[wp.float32],
    thresholds: wp.array[wp.float32],
    # Params
    first: wp.int32,
    # Out
    out_display: wp.array[wp.uint32],
):
    """One thread a pixel, over the table of blocks."""
    thread = wp.tid() + first
    block = load_vec4i(blocks, pixel_block(thread))
    place = pixel_in_block(thread)
    view = views[block[0]]
    x, y = block[1] + place[0], block[2] + place[1]
    if x >= view.width or y >= view.height:
        return
    i = pixel_index(view, x, y)
    code = load_word(picture, i)
    right_room, down_room = view.width - 1 - x, view.height - 1 - y
    left, right = -wp.min(x, 1), wp.min(right_room, 1)
    up, down = -wp.min(y, 1) * view.row_pitch, wp.min(down_room, 1) * view.row_pitch
    m = weigh_bytes(code, LUMA_WEIGHTS)
    n, s = luma(picture, i + up), luma(picture, i + down)
    w, e = luma(picture, i + left), luma(picture, i + right)
    brightest = wp.max(m, wp.max(wp.max(n, s), wp.max(w, e)))
    contrast = brightest - wp.min(m, wp.min(wp.min(n, s), wp.min(w, e)))
    if contrast < LEAST_CONTRAST or contrast * RELATIVE_CONTRAST < brightest:
        out_display[i] = code
        return
    nw, ne = luma(picture, i + up + left), luma(picture, i + up + right)
    sw, se = luma(picture, i + down + left), luma(picture, i + down + right)
    across_y = wp.abs(nw + sw - 2 * w) + 2 * wp.abs(n + s - 2 * m) + wp.abs(ne + se - 2 * e)
    across_x = wp.abs(nw + ne - 2 * n) + 2 * wp.abs(w + e - 2 * m) + wp.abs(sw + se - 2 * s)
    partner = wp.where(wp.abs(w - m) >= wp.abs(e - m), left, right)
    step = view.row_pitch
    rooms = wp.vec2i(y, down_room)
    if across_y >= across_x:
        partner = wp.where(wp.abs(n - m) >= wp.abs(s - m), up, down)
        step = 1
        rooms = wp.vec2i(x, right_room)
    share = low_pass_share(2 * (n + s + w + e) + nw + ne + sw + se - 12 * m, contrast)
    if luma(picture, i + partner) != m:
        share = wp.max(share, edge_share(picture, i, partner, step, rooms))
    if share > 0.0:
        code = mix_codes(code, picture[i + partner], share, linear, thresholds)
    out_display[i] = code
