"""Layers of depth of field: the reduced image that taps read, and what the taps around a texel come to.

Functions and structs only; depth_of_field.py says what the layers are. Levels and layers lie row by row: a view's rows
of a level are as long as its tiles are wide, so that a tap's address is its row's and its column.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import (
    add_weighted,
    fast_inverse_root,
    fast_root,
    fma,
    load_double_word,
    load_float,
    load_vec4,
    pack_half4,
    unpack_half3,
)
from .lens import circle_shape
from .structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Texels of a 16 x 16 tile in levels 1, 2 and 3, and in one layer, which is as fine as level 1.
LEVEL_TEXELS = 84
LAYER_TEXELS = 64
#: Layers: what lies behind the plane in focus, what lies before it, and what that hides.
BEHIND, BEFORE, HIDDEN = wp.constant(0), wp.constant(1), wp.constant(2)
LAYERS = 3
INVERSE_PI = wp.constant(wp.float32(0.3183098861837907))
#: Squares of the smallest circles that texels are drawn with [texels]: behind as themselves, before over neighbours.
LEAST_BEHIND, LEAST_BEFORE = wp.constant(wp.float32(0.25)), wp.constant(wp.float32(0.5625))
#: Circles larger than these, behind the plane in focus and before it, are drawn by layers too, from one pixel more by
#: layers alone [px].
FAR_PX, NEAR_PX = wp.constant(wp.float32(2.5)), wp.constant(wp.float32(1.5))
#: Circles smaller than this radius are points [px]: no tap of theirs leaves the pixel.
SHARP_PX = wp.constant(wp.float32(0.5))


@wp.struct
class Taps:
    """Texels in the plan's format; the other array is one element long and never touched."""

    half: wp.array[wp.uint64]  # half4: colour, and a radius [px] or a coverage
    full: wp.array[wp.vec4]
    tiles: wp.int32  # 16 x 16 tiles of all views


@wp.struct
class Rows:
    """Where a view's texels of a level lie."""

    first: wp.int32  # its first texel
    pitch: wp.int32  # texels from one row to the next
    last_x: wp.int32  # last texel that holds a pixel of the view
    last_y: wp.int32


@wp.struct
class Layers:
    """Weighted sums of colours, and their weights, of taps before the plane in focus and of what they hide."""

    before: wp.vec4  # the weight is the coverage
    hidden: wp.vec4


@wp.func
def rows_of(view: View, tiles: wp.int32, level: wp.int32):
    """Rows of a level, 1 to 3; those of level 1 are also a layer's, whose first texel is `layer_first` more."""
    rows = Rows()
    # Texels of a tile in the levels before: 0, 64, 80.
    before = (256 - (1024 >> (2 * level))) // 3
    rows.first = tiles * before + view.bin_offset * (256 >> (2 * level))
    rows.pitch = view.bins_x << (4 - level)
    rows.last_x = (view.width - 1) >> level
    rows.last_y = (view.height - 1) >> level
    return rows


@wp.func
def layer_first(tiles: wp.int32, layer: wp.int32):
    """Texels of all layers before one."""
    return tiles * wp.static(LAYER_TEXELS) * layer


@wp.func
def reach_at(reach: wp.array[wp.float32], view: View, x: wp.float32, y: wp.float32):
    """Reach of circles before the plane in focus at a place [px], smooth from tile to tile and never too small."""
    fx, fy = (x - 8.0) * 0.0625, (y - 8.0) * 0.0625
    x0, y0 = wp.int32(wp.floor(fx)), wp.int32(wp.floor(fy))
    tx, ty = fx - wp.float32(x0), fy - wp.float32(y0)
    last_x, last_y = view.bins_x - 1, (view.height - 1) >> 4
    left, right = wp.max(x0, 0), wp.min(x0 + 1, last_x)
    upper = view.bin_offset + wp.max(y0, 0) * view.bins_x
    lower = view.bin_offset + wp.min(y0 + 1, last_y) * view.bins_x
    a, b = load_float(reach, upper + left), load_float(reach, upper + right)
    c, d = load_float(reach, lower + left), load_float(reach, lower + right)
    above, below = a + (b - a) * tx, c + (d - c) * tx
    return above + (below - above) * ty


@wp.func
def level_of(radius: wp.float32, reach: wp.int32):
    """Lowest level from 1 on at which a radius is at most so many texels, or the highest."""
    texel = radius / wp.float32(reach)
    return wp.where(texel <= 2.0, 1, wp.where(texel <= 4.0, 2, 3))


@wp.func
def spread_of(inverse: wp.float32):
    """How much the square of a circle's radius grows by itself [texels], for texels of 1 / inverse pixels.

    A texel is a square, as wide as a disc of a third of its side squared, and layers are interpolated between texels
    of two pixels, which is as much as a disc of 8/3 square pixels.
    """
    return 0.33333334 + 2.6666667 * inverse * inverse


@wp.struct
class Disc:
    """Texels of a level around a place; lengths in texels along the axis with more pixels to a metre."""

    rows: Rows
    inverse: wp.float32  # of a texel's side [px]
    spread: wp.float32
    u: wp.float32  # the place, from the middle of the first texel
    v: wp.float32
    step_x: wp.float32  # distance from one texel to the next
    step_y: wp.float32
    narrow: wp.float32  # 1 / step_x
    rim: wp.float32  # distance from which on no tap counts
    first: wp.int32  # rows it reaches
    last: wp.int32


@wp.func
def disc_around(
    view: View, tiles: wp.int32, x: wp.float32, y: wp.float32, radius: wp.float32, texels: wp.int32, least: wp.float32
):
    """The texels in a circle [px], at the level at which it has at most so many to its rim; `least`: one of LEAST_*."""
    level = level_of(radius, texels)
    shape = circle_shape(view)
    disc = Disc()
    disc.rows = rows_of(view, tiles, level)
    disc.inverse = 1.0 / wp.float32(1 << level)
    disc.spread = spread_of(disc.inverse)
    disc.u = x * disc.inverse - 0.5
    disc.v = y * disc.inverse - 0.5
    disc.step_x = 1.0 / shape[0]
    disc.step_y = 1.0 / shape[1]
    disc.narrow = shape[0]
    r = radius * disc.inverse
    disc.rim = wp.sqrt(wp.max(r * r - disc.spread, least)) + 0.5
    tall = disc.rim * shape[1]
    disc.first = wp.int32(wp.ceil(disc.v - tall))
    disc.last = wp.int32(wp.floor(disc.v + tall))
    return disc


@functools.cache
def make_taps(half: bool):
    """(load, store) functions of a texel: colour and signed radius, or colour and coverage."""

    @wp.func
    def load_half(taps: Taps, i: wp.int32):
        word = load_double_word(taps.half, i)
        c = unpack_half3(word)
        s = unpack_half3(word >> wp.uint64(48))
        return wp.vec4(c[0], c[1], c[2], s[0])

    @wp.func
    def load_full(taps: Taps, i: wp.int32):
        return load_vec4(taps.full, i)

    @wp.func
    def store_half(taps: Taps, i: wp.int32, v: wp.vec4):
        colour = pack_half4(v[0], v[1], v[2]) & wp.uint64(0xFFFFFFFFFFFF)
        taps.half[i] = colour | (pack_half4(v[3], 0.0, 0.0) << wp.uint64(48))

    @wp.func
    def store_full(taps: Taps, i: wp.int32, v: wp.vec4):
        taps.full[i] = v

    return (load_half, store_half) if half else (load_full, store_full)


@wp.func
def side(radius: wp.float32):
    """-1 before the plane in focus, 1 behind it and where a circle hardly leaves its pixel: what is sharp votes too."""
    return wp.clamp(2.0 * radius + 2.0, -1.0, 1.0)


@wp.func
def belongs(radius: wp.float32, near: wp.bool, inverse: wp.float32):
    """Weight of a child in a texel of that side: 0 on the other side, or where its circle is much the smaller."""
    if (side(radius) < 0.0) != near:
        return wp.float32(0.0)
    # Where the largest is a point, all are.
    return wp.where(inverse > 1.0, 1.0, wp.clamp(2.0 * wp.abs(radius) * inverse - 0.5, 0.0, 1.0))


@wp.func
def merged(a: wp.vec4, b: wp.vec4, c: wp.vec4, d: wp.vec4):
    """One texel out of four: the side of the plane in focus that most lie on, and their mean colour and circle.

    A sharp child is left out of a blurred texel, so its colour is not spread. Two against two lie before it: a bright
    edge must not be lost.
    """
    sides = side(a[3]) + side(b[3]) + side(c[3]) + side(d[3])
    near = sides <= 0.0
    turn = wp.where(near, -1.0, 1.0)
    largest = wp.max(wp.max(a[3] * turn, b[3] * turn), wp.max(c[3] * turn, d[3] * turn))
    if largest < 1.0 and wp.min(wp.min(a[3], b[3]), wp.min(c[3], d[3])) > -1.5:
        return (a + b + c + d) * 0.25
    inverse = 1.0 / wp.max(largest, 0.01)
    wa, wb = belongs(a[3], near, inverse), belongs(b[3], near, inverse)
    wc, wd = belongs(c[3], near, inverse), belongs(d[3], near, inverse)
    return (a * wa + b * wb + c * wc + d * wd) * (1.0 / (wa + wb + wc + wd))


@functools.cache
def make_layers(half: bool):
    """(behind, before) functions: what the texels around a place [px] come to. `texels` is the most of a radius."""
    load = make_taps(half)[0]

    @wp.func
    def behind(taps: Taps, view: View, x: wp.float32, y: wp.float32, radius: wp.float32, texels: wp.int32):
        """Weighted sum of the colours of the taps within a circle, and their weight."""
        disc = disc_around(view, taps.tiles, x, y, radius, texels, LEAST_BEHIND)
        r = radius * disc.inverse
        sums = wp.vec4()
        for j in range(disc.first, disc.last + 1):
            dy = (wp.float32(j) - disc.v) * disc.step_y
            dy2 = dy * dy
            wide = fast_root(wp.max(fma(disc.rim, disc.rim, -dy2), 0.0)) * disc.narrow
            row = disc.rows.first + wp.clamp(j, 0, disc.rows.last_y) * disc.rows.pitch
            left = wp.ceil(disc.u - wide)
            dx = (left - disc.u) * disc.step_x
            for i in range(wp.int32(left), wp.int32(wp.floor(disc.u + wide)) + 1):
                value = load(taps, row + wp.clamp(i, 0, disc.rows.last_x))
                distance = fast_root(fma(dx, dx, dy2))
                dx = dx + disc.step_x
                circle = wp.min(value[3] * disc.inverse, r)
                square = wp.max(fma(circle, circle, -disc.spread), LEAST_BEHIND)
                turned = fast_inverse_root(square)
                share = wp.clamp(square * turned - distance + 0.5, 0.0, 1.0) * wp.clamp(value[3] - SHARP_PX, 0.0, 1.0)
                sums = add_weighted(sums, value, share * turned * turned)
        return sums

    @wp.func
    def before(
        taps: Taps,
        view: View,
        x: wp.float32,
        y: wp.float32,
        radius: wp.float32,
        own: wp.float32,
        texels: wp.int32,
    ):
        """What lies before the plane in focus, and what lies farther away than a circle of that radius there."""
        disc = disc_around(view, taps.tiles, x, y, radius, texels, LEAST_BEFORE)
        # What lies farther away than the place itself, from a quarter of its circle on.
        contrast = wp.float32(0.0)
        if own > 1.0:
            contrast = 2.0 / own
        level_with = own * contrast - 0.5
        sums = wp.vec4()
        hidden = wp.vec4()
        for j in range(disc.first, disc.last + 1):
            dy = (wp.float32(j) - disc.v) * disc.step_y
            dy2 = dy * dy
            wide = fast_root(wp.max(fma(disc.rim, disc.rim, -dy2), 0.0)) * disc.narrow
            row = disc.rows.first + wp.clamp(j, 0, disc.rows.last_y) * disc.rows.pitch
            left = wp.ceil(disc.u - wide)
            dx = (left - disc.u) * disc.step_x
            for i in range(wp.int32(left), wp.int32(wp.floor(disc.u + wide)) + 1):
                value = load(taps, row + wp.clamp(i, 0, disc.rows.last_x))
                distance = fast_root(fma(dx, dx, dy2))
                dx = dx + disc.step_x
                # It counts by its share of the light of its circle, which is spread over the circle's area.
                circle = value[3] * disc.inverse
                square = wp.max(fma(circle, circle, -disc.spread), LEAST_BEFORE)
                turned = fast_inverse_root(square)
                share = wp.clamp(square * turned - distance + 0.5, 0.0, 1.0) * wp.clamp(-NEAR_PX - value[3], 0.0, 1.0)
                sums = add_weighted(sums, value, share * turned * turned)
                farther = wp.clamp(fma(value[3], contrast, level_with), 0.0, 1.0)
                hidden = add_weighted(hidden, value, farther)
        layers = Layers()
        layers.before = sums * (INVERSE_PI * disc.step_x * disc.step_y)
        layers.hidden = hidden
        return layers

    return behind, before
