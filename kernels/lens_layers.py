"""Layers of depth of field: the reduced image that taps read, and what the taps around a pixel come to.

Functions and structs only; depth_of_field.py says what the layers are.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import load_vec4, pack_half4, unpack_half3
from .lens import circle_shape
from .structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Texels of a 16 x 16 tile over all levels, 256 + 64 + 16 + 4, and without the first.
TILE_TEXELS = 340
REDUCED_TEXELS = 84
INVERSE_PI = wp.constant(wp.float32(0.3183098861837907))
#: Texels before level 3, the nearest circles', which have no level 0.
NEAR_TOP = wp.constant(80)


@wp.struct
class Taps:
    """The reduced image, in the plan's format; the other array is one element long and never touched."""

    half: wp.array[wp.uint64]  # half4: colour, signed radius [px]
    full: wp.array[wp.vec4]
    tiles: wp.int32  # 16 x 16 tiles of all views


@wp.struct
class Layers:
    """Weighted sums of the taps before the plane in focus."""

    front: wp.vec3  # nearer than the pixel
    front_weight: wp.float32
    same: wp.vec3  # as near as it
    same_weight: wp.float32
    fill: wp.vec3  # what lies behind it
    fill_weight: wp.float32


@wp.func
def level_base(level: wp.int32):
    """Texels of a tile in the levels before one: 0, 256, 320, 336."""
    return (1024 - (1024 >> (2 * level))) // 3


@wp.func
def texel_index(tiles: wp.int32, tile: wp.int32, level: wp.int32, local: wp.int32):
    """Index of a tile's texel: levels one after the other, each tile after tile."""
    return tiles * level_base(level) + tile * (256 >> (2 * level)) + local


@wp.func
def tap_index(view: View, tiles: wp.int32, level: wp.int32, x: wp.int32, y: wp.int32):
    """Index of the texel of a level that a pixel of the view lies in; beyond the edge, the edge's."""
    px, py = wp.clamp(x, 0, view.width - 1), wp.clamp(y, 0, view.height - 1)
    tile = view.bin_offset + (py >> 4) * view.bins_x + (px >> 4)
    return texel_index(tiles, tile, level, (((py & 15) >> level) << (4 - level)) + ((px & 15) >> level))


@wp.func
def reach_at(reach: wp.array[wp.float32], view: View, x: wp.int32, y: wp.int32):
    """Reach of circles before the plane in focus at a pixel [px], smooth from tile to tile and never too small."""
    fx, fy = (wp.float32(x) - 7.5) * 0.0625, (wp.float32(y) - 7.5) * 0.0625
    x0, y0 = wp.int32(wp.floor(fx)), wp.int32(wp.floor(fy))
    tx, ty = fx - wp.float32(x0), fy - wp.float32(y0)
    last_x, last_y = view.bins_x - 1, (view.height - 1) >> 4
    left, right = wp.max(x0, 0), wp.min(x0 + 1, last_x)
    upper = view.bin_offset + wp.max(y0, 0) * view.bins_x
    lower = view.bin_offset + wp.min(y0 + 1, last_y) * view.bins_x
    a, b = reach[upper + left], reach[upper + right]
    c, d = reach[lower + left], reach[lower + right]
    above, below = a + (b - a) * tx, c + (d - c) * tx
    return above + (below - above) * ty


@wp.func
def level_of(radius: wp.float32, reach: wp.int32):
    """Lowest level at which a radius is at most so many texels, or the highest."""
    texel = radius / wp.float32(reach)
    return wp.where(texel <= 1.0, 0, wp.where(texel <= 2.0, 1, wp.where(texel <= 4.0, 2, 3)))


@wp.func
def texels_of(radius: wp.float32, level: wp.int32):
    """Texels to either side that a circle around any pixel of a texel may touch, half a texel of slope included."""
    return wp.int32(radius / wp.float32(1 << level) + 1.0)


@wp.func
def covers(radius: wp.float32, distance: wp.float32, inverse_texel: wp.float32):
    """Share of a tap's place that lies within its circle: 1 inside, 0 outside, a slope of one texel between."""
    return wp.clamp((radius - distance) * inverse_texel + 0.5, 0.0, 1.0)


@functools.cache
def make_taps(half: bool):
    """(load, store) functions of a texel: colour and signed radius."""

    @wp.func
    def load_half(taps: Taps, i: wp.int32):
        word = taps.half[i]
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
def belongs(radius: wp.float32, near: wp.bool, inverse: wp.float32):
    """Weight of a child in a texel of that side: 0 on the other side, or where its circle is much the smaller."""
    if (radius < 0.0) != near:
        return wp.float32(0.0)
    return wp.clamp(2.0 * wp.abs(radius) * inverse - 0.5, 0.0, 1.0)


@wp.func
def merged(a: wp.vec4, b: wp.vec4, c: wp.vec4, d: wp.vec4):
    """One texel out of four: the side of the plane in focus that most lie on, and their mean colour and circle.

    A sharp child is left out of a blurred texel, so its colour is not spread.
    """
    sides = wp.sign(a[3]) + wp.sign(b[3]) + wp.sign(c[3]) + wp.sign(d[3])
    near = sides < 0.0 or (sides == 0.0 and a[3] < 0.0)
    turn = wp.where(near, -1.0, 1.0)
    largest = wp.max(wp.max(a[3] * turn, b[3] * turn), wp.max(c[3] * turn, d[3] * turn))
    if largest < 1.0:
        return (a + b + c + d) * 0.25
    inverse = 1.0 / largest
    wa, wb = belongs(a[3], near, inverse), belongs(b[3], near, inverse)
    wc, wd = belongs(c[3], near, inverse), belongs(d[3], near, inverse)
    return (a * wa + b * wb + c * wc + d * wd) * (1.0 / (wa + wb + wc + wd))


@functools.cache
def make_layers(half: bool):
    """(behind, before) functions: what the texels around a pixel come to. `reach` is the most texels of a radius."""
    load = make_taps(half)[0]

    @wp.func
    def behind(taps: Taps, view: View, x: wp.int32, y: wp.int32, radius: wp.float32, reach: wp.int32):
        """Weighted sum of the colours of the taps within the pixel's circle, and their weight."""
        level = level_of(radius, reach)
        size = 1 << level
        shape = circle_shape(view)
        nx, ny = texels_of(radius * shape[0], level), texels_of(radius * shape[1], level)
        inverse = 1.0 / wp.float32(size)
        smallest = 0.25 * wp.float32(size * size)
        fx, fy = 1.0 / shape[0], 1.0 / shape[1]
        left, top = (x >> level) - nx, (y >> level) - ny
        color = wp.vec3(0.0, 0.0, 0.0)
        weight = wp.float32(0.0)
        for j in range(2 * ny + 1):
            ty = (top + j) << level
            dy = (wp.float32(ty - y) + 0.5 * wp.float32(size - 1)) * fy
            for i in range(2 * nx + 1):
                tx = (left + i) << level
                dx = (wp.float32(tx - x) + 0.5 * wp.float32(size - 1)) * fx
                distance = wp.sqrt(dx * dx + dy * dy)
                value = load(taps, tap_index(view, taps.tiles, level, tx, ty))
                circle = wp.clamp(value[3], 0.0, radius)
                # What lies before the plane in focus is the other layer's.
                share = covers(circle, distance, inverse) * wp.clamp(1.0 + value[3], 0.0, 1.0)
                w = share / wp.max(circle * circle, smallest)
                color = color + wp.vec3(value[0], value[1], value[2]) * w
                weight = weight + w
        return wp.vec4(color[0], color[1], color[2], weight)

    @wp.func
    def before(taps: Taps, view: View, x: wp.int32, y: wp.int32, radius: wp.float32, own: wp.float32, reach: wp.int32):
        """Taps before the plane in focus: nearer than the pixel, as near as it, and what fills in behind it."""
        level = level_of(radius, reach)
        size = 1 << level
        shape = circle_shape(view)
        nx, ny = texels_of(radius * shape[0], level), texels_of(radius * shape[1], level)
        inverse = 1.0 / wp.float32(size)
        area = wp.float32(size * size) * INVERSE_PI
        smallest = 0.25 * wp.float32(size * size)
        fx, fy = 1.0 / shape[0], 1.0 / shape[1]
        left, top = (x >> level) - nx, (y >> level) - ny
        side = wp.min(own, 0.0)
        contrast = 2.0 / wp.max(-side, 1.0)
        layers = Layers()
        for j in range(2 * ny + 1):
            ty = (top + j) << level
            dy = (wp.float32(ty - y) + 0.5 * wp.float32(size - 1)) * fy
            for i in range(2 * nx + 1):
                tx = (left + i) << level
                dx = (wp.float32(tx - x) + 0.5 * wp.float32(size - 1)) * fx
                # A pixel covers itself, however small its circle.
                distance = wp.where(i == nx and j == ny, 0.0, wp.sqrt(dx * dx + dy * dy))
                value = load(taps, tap_index(view, taps.tiles, level, tx, ty))
                s = value[3]
                c = wp.vec3(value[0], value[1], value[2])
                circle = wp.max(-s, 0.0)
                # It counts by area over its circle's, which is widened where it is smaller than a texel.
                w = covers(wp.where(distance == 0.0, wp.float32(size), circle), distance, inverse)
                w = w * wp.min(circle, 1.0) * area / wp.max(circle * circle, smallest)
                nearer = w * wp.clamp(2.0 * (side - s) / wp.max(circle, 1.0) - 0.5, 0.0, 1.0)
                farther = wp.clamp((s - side) * contrast - 0.5, 0.0, 1.0)
                layers.front = layers.front + c * nearer
                layers.front_weight = layers.front_weight + nearer
                w = (w - nearer) * (1.0 - farther)
                layers.same = layers.same + c * w
                layers.same_weight = layers.same_weight + w
                w = farther * covers(radius, distance, inverse)
                layers.fill = layers.fill + c * w
                layers.fill_weight = layers.fill_weight + w
        return layers

    return behind, before
