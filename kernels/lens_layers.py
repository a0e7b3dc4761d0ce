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
#: Texels before level 3, the nearest circles', which have no level 0.
NEAR_TOP = wp.constant(80)


@wp.struct
class Taps:
    """The reduced image, in the plan's format; the other array is one element long and never touched."""

    half: wp.array[wp.uint64]  # half4: colour, signed radius [px]
    full: wp.array[wp.vec4]
    tiles: wp.int32  # 16 x 16 tiles of all views


@wp.struct
class Layer:
    """What the taps of one layer come to."""

    color: wp.vec3  # weighted sum
    weight: wp.float32
    fill: wp.vec3  # of the taps that are not of the layer
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
def level_of(radius: wp.float32, rings: wp.int32):
    """Level whose texels are about as far apart as the taps of a circle of that radius."""
    spacing = radius / wp.float32(rings)
    return wp.where(spacing <= 1.0, 0, wp.where(spacing <= 2.0, 1, wp.where(spacing <= 4.0, 2, 3)))


@wp.func
def covers(radius: wp.float32, distance: wp.float32, inverse_step: wp.float32):
    """Share of a tap's place that lies within its circle: 1 inside, 0 outside, a slope of one step between."""
    return wp.clamp((radius - distance) * inverse_step + 0.5, 0.0, 1.0)


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
def largest_circle(a: wp.float32, b: wp.float32):
    """The signed radius whose circle is larger; of equal ones the first."""
    return wp.where(wp.abs(b) > wp.abs(a), b, a)


@wp.func
def alike(radius: wp.float32, chosen: wp.float32):
    """1 where a child's circle is about like the chosen one, so that their colours may be averaged, else 0."""
    return wp.where(wp.abs(radius - chosen) <= wp.max(1.0, 0.25 * wp.abs(chosen)), 1.0, 0.0)


@wp.func
def merged(a: wp.vec4, b: wp.vec4, c: wp.vec4, d: wp.vec4):
    """One texel out of four: mean colour of those with a circle like the largest, and that circle."""
    chosen = largest_circle(largest_circle(a[3], b[3]), largest_circle(c[3], d[3]))
    wa, wb, wc, wd = alike(a[3], chosen), alike(b[3], chosen), alike(c[3], chosen), alike(d[3], chosen)
    mean = (a * wa + b * wb + c * wc + d * wd) * (1.0 / (wa + wb + wc + wd))
    return wp.vec4(mean[0], mean[1], mean[2], chosen)


@functools.cache
def make_layers(half: bool):
    """(behind, before) functions: what the taps around a pixel come to."""
    load = make_taps(half)[0]

    @wp.func
    def behind(taps: Taps, ring: wp.array[wp.vec4], view: View, x: wp.int32, y: wp.int32, radius: wp.float32):
        """Taps within the pixel's circle; `ring` ends with the number of rings."""
        level = level_of(radius, wp.int32(ring[0][3]))
        rings = wp.clamp(wp.int32(wp.ceil(radius / wp.float32(1 << level))), 1, wp.int32(ring[0][3]))
        step = radius / wp.float32(rings)
        inverse = 1.0 / step
        shape = circle_shape(view) * step
        smallest = 0.25 * step * step
        layer = Layer()
        color = wp.vec3(0.0, 0.0, 0.0)
        weight = wp.float32(0.0)
        for k in range(1 + 3 * rings * (rings + 1)):
            tap = load_vec4(ring, k)
            tx = x + wp.int32(wp.round(tap[0] * shape[0]))
            ty = y + wp.int32(wp.round(tap[1] * shape[1]))
            value = load(taps, tap_index(view, taps.tiles, level, tx, ty))
            s = value[3]
            reach = wp.clamp(s, 0.0, radius)
            # What lies before the plane in focus is the other layer's.
            share = covers(reach, tap[2] * step, inverse) * wp.clamp(1.0 + s, 0.0, 1.0)
            w = wp.where(k == 0, 0.75, 1.0) * share / wp.max(reach * reach, smallest)
            color = color + wp.vec3(value[0], value[1], value[2]) * w
            weight = weight + w
        layer.color = color
        layer.weight = weight
        return layer

    @wp.func
    def before(taps: Taps, ring: wp.array[wp.vec4], view: View, x: wp.int32, y: wp.int32, radius: wp.float32):
        """Taps before the plane in focus, and what fills in behind them."""
        level = level_of(radius, wp.int32(ring[0][3]))
        rings = wp.clamp(wp.int32(wp.ceil(radius / wp.float32(1 << level))), 1, wp.int32(ring[0][3]))
        step = radius / wp.float32(rings)
        inverse = 1.0 / step
        shape = circle_shape(view) * step
        area = step * step * 0.333333333
        smallest = 0.25 * step * step
        layer = Layer()
        color = wp.vec3(0.0, 0.0, 0.0)
        fill = wp.vec3(0.0, 0.0, 0.0)
        weight = wp.float32(0.0)
        fill_weight = wp.float32(0.0)
        for k in range(1 + 3 * rings * (rings + 1)):
            tap = load_vec4(ring, k)
            tx = x + wp.int32(wp.round(tap[0] * shape[0]))
            ty = y + wp.int32(wp.round(tap[1] * shape[1]))
            value = load(taps, tap_index(view, taps.tiles, level, tx, ty))
            c = wp.vec3(value[0], value[1], value[2])
            far = wp.clamp(1.0 + value[3], 0.0, 1.0)
            reach = wp.max(-value[3], 0.0)
            # A pixel covers itself, however small its circle.
            share = wp.where(k == 0, 0.75, covers(reach, tap[2] * step, inverse)) * (1.0 - far)
            w = share * area / wp.max(reach * reach, smallest)
            color = color + c * w
            weight = weight + w
            nearness = far / (0.25 + tap[2] * tap[2])
            fill = fill + c * nearness
            fill_weight = fill_weight + nearness
        layer.color = color
        layer.weight = weight
        layer.fill = fill
        layer.fill_weight = fill_weight
        return layer

    return behind, before
