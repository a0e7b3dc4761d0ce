"""Ambient visibility by horizons (gtao): the share of cosine-weighted ambient light that reaches a pixel's surface.

    V = 1/pi * integral over the hemisphere of (1 if nothing blocks within the radius else 0) cos(theta) d omega

The hemisphere is cut into slices that contain the view direction v. In a slice with tangent t, the highest horizon on
each side is searched among depths along a line of pixels, and the cosine-weighted integral between the horizons is
closed (Jimenez et al. 2016, "Practical Real-Time Strategies for Accurate Indirect Occlusion", 4.1 to 4.3; numerics
after Intel's notes on XeGTAO, 2021). With the normal's parts nv = n.v and nt = n.t, and horizon angles a1, a0 from v
towards +t and -t, the paper's projected normal length times its two arcs is

    ( nv (sin^2 a0 + sin^2 a1) + nt ((a1 - sin a1 cos a1) - (a0 - sin a0 cos a0)) ) / 2

The sum over a few slices is divided by the same sum with both horizons on the tangent plane. The quotient has the same
mean as slices grow, is exactly 1 on an open plane of any tilt, and stays in [0, 1] before any denoising.

**Falloff.** Few samples meet a wall below the height at which the radius cuts it, so they are taken from a ball
RADIUS_SCALE times as large; both numbers fit creases, steps and slopes of known visibility. A sample's cosine sinks
towards the tangent plane's over the last tenth of the squared radius, so that nothing pops there. It also counts in
proportion to its elevation above the tangent plane up to 1 / ELEVATION: samples lie on pixel centres, off their slice,
which at grazing angles would lift a plane above itself. **Thickness.** Depths are taken for a height field: what lies
behind the first surface is solid. Thin things therefore block too much; the reference rung shows how much.

Arithmetic is + - * /, bit casts and table look-ups, no library functions: CPU and CUDA write the same bits. View space
is x right, y up, z backward. Block size 64, one thread a pixel; deterministic.

Cost at 1920 x 1080 with 2 slices of 2 x 3 samples: reads 4 (depth) + 4 (normal) + about 2 (pyramid) bytes a pixel,
writes 4: 29 MB, 7 us at 4.2 TB/s. Arithmetic rules: about 800 instructions a pixel, 55 us at 29.6 T/s.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import warp as wp

from .depth_pyramid import LEVELS, pyramid_index
from .encoding import make_gbuffer_codec, pack_unorm
from .intrinsics import bits_float, float_bits, load_vec4, load_vec4i
from .projection import pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, PIXEL_BLOCK_AREA, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Squared distance, as a share of the squared radius, from which a sample counts less.
FALLOFF_START = wp.constant(0.9)
#: Radius of the ball that samples are taken from, as a multiple of the radius asked for.
RADIUS_SCALE = wp.constant(1.4)
#: A sample counts wholly from a sine of 1 / 8 (7 degrees) above the tangent plane on.
ELEVATION = wp.constant(8.0)
#: Nearest sample [px]: one that lands on the pixel itself would say nothing.
NEAREST_PX = wp.constant(1.3)
HALF_PI = wp.constant(math.pi / 2.0)
PI = wp.constant(math.pi)
#: Bits of a word that hold depth; the low 8 hold visibility.
DEPTH_MASK = wp.constant(wp.uint32(0xFFFFFF00))
#: Word of the background: depth +inf, visibility 1.
OPEN_WORD = wp.constant(wp.uint32(0x7F8000FF))
#: (codec, slices, steps, half): what CI compiles.
VARIANTS = [
    (("compact", "oct24", True), 2, 3, False),
    (("compact", "oct24", True), 2, 3, True),
    (("full", "float32", True), 2, 3, False),
    (("compact", "oct24", False), 4, 8, False),
]


def slice_pattern(slices: int) -> np.ndarray:
    """Directions and jitters of a 4 x 4 pattern of pixels; a mean over any 4 x 4 of them sees all.

    The pixel's rank in a Bayer matrix turns its slices by 16ths of the angle between two slices, so that neighbours
    differ much; a permutation of the rank (times 7 modulo 16) shifts the samples along the line.

    Returns:
        (16 slices, 4) float32, [slice * 16 + phase]: cosine and sine of the slice's angle, jitter in (0, 1), 0.
    """
    bayer = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])
    table = np.zeros((slices, 16, 4))
    for k in range(slices):
        angle = np.pi * (k + (bayer + 0.5) / 16.0) / slices
        table[k, :, 0], table[k, :, 1] = np.cos(angle), np.sin(angle)
        table[k, :, 2] = ((7 * bayer + 5 * k) % 16 + 0.5) / 16.0
    return table.reshape(-1, 4).astype(np.float32)


@wp.func
def fast_rsqrt(x: wp.float32):
    """1 / sqrt(x) within 5e-6 by halving the exponent and two Newton steps; x = 0 gives something large.

    Source: Lomont 2003, "Fast Inverse Square Root".
    """
    y = bits_float(wp.uint32(0x5F375A86) - (float_bits(x) >> wp.uint32(1)))
    half = 0.5 * x
    y = y * (1.5 - half * y * y)
    return y * (1.5 - half * y * y)


@wp.func
def fast_root(x: wp.float32):
    """Square root of x >= 0 within 5e-6; exactly 0 for 0."""
    return x * fast_rsqrt(x)


@wp.func
def fast_acos(x: wp.float32):
    """Angle of a cosine in [-1, 1] within 8e-5; acos(-x) is pi - acos(x) to the bit before the subtraction rounds.

    Source: Abramowitz and Stegun 1964, 4.4.45.
    """
    u = wp.abs(x)
    a = fast_root(1.0 - u) * (1.5707288 + u * (-0.2121144 + u * (0.0742610 - 0.0187293 * u)))
    return wp.where(x < 0.0, PI - a, a)


@wp.func
def affine_depth(view: View, depth: wp.float32):
    """What is linear across a plane's pixels: 1 / depth, or depth itself for orthographic views."""
    if view.projection == ORTHOGRAPHIC:
        return depth
    return 1.0 / depth


@wp.func
def pack_visibility(affine: wp.float32, visibility: wp.float32):
    """Word of an affine depth (15 bits of mantissa) and a visibility (8 bits, rounded)."""
    return (float_bits(affine) & DEPTH_MASK) | pack_unorm(visibility, 255.0)


@wp.func
def half_index(view: View, x: wp.int32, y: wp.int32):
    """Index of a pixel of the half-size image: 8 x 8 of them a raster bin."""
    return view.bin_offset * 64 + y * (view.bins_x * 8) + x


@wp.func
def point_in_view(view: View, px: wp.float32, py: wp.float32, depth: wp.float32, inverse: wp.vec2):
    """View-space point [m] of a pixel at a linear depth; inverse is 1 / scale."""
    x = (px - view.center[0]) * inverse[0]
    y = (py - view.center[1]) * inverse[1]
    if view.projection == ORTHOGRAPHIC:
        return wp.vec3(x, y, -depth)
    return wp.vec3(x * depth, y * depth, -depth)


@wp.func
def sample_level(x: wp.float32, y: wp.float32):
    """Level to fetch from at an offset [px]: 0 nearer than 16 px, then one more each time the distance doubles."""
    exponent = wp.int32(float_bits(wp.max(wp.abs(x), wp.abs(y))) >> wp.uint32(23))
    return wp.clamp(exponent - 130, 0, LEVELS)


@wp.func
def fetch_point(
    view: View,
    depth: wp.array[wp.float32],
    pyramid: wp.array[wp.float32],
    inverse: wp.vec2,
    x: wp.int32,
    y: wp.int32,
    level: wp.int32,
):
    """View-space point [m] on the surface at, or on a smaller level near, pixel (x, y); not finite where none is."""
    z = wp.float32(0.0)
    px, py = wp.int32(x), wp.int32(y)
    if level == 0:
        z = depth[pixel_index(view, x, y)]
    else:
        z = pyramid[pyramid_index(view, level, x, y)]
        half = 1 << (level - 1)
        px = ((x >> level) << level) + half
        py = ((y >> level) << level) + half
    return point_in_view(view, wp.float32(px) + 0.5, wp.float32(py) + 0.5, z, inverse)


@wp.struct
class Gather:
    """A pixel's surface and what its samples are measured by."""

    point: wp.vec3  # view space [m]
    towards: wp.vec3  # unit vector to the viewer
    normal: wp.vec3
    inverse: wp.vec2  # 1 / view.scale
    px: wp.float32
    py: wp.float32
    radius2: wp.float32  # squared radius [m^2]
    slope: wp.float32  # falloff per squared metre


@wp.func
def sample_horizon(
    view: View,
    depth: wp.array[wp.float32],
    pyramid: wp.array[wp.float32],
    g: Gather,
    offset_x: wp.float32,
    offset_y: wp.float32,
    level: wp.int32,
    low: wp.float32,
    highest: wp.float32,
):
    """Cosine of the horizon after one more sample, `offset` pixels away; no sample leaves the view."""
    fx, fy = g.px + offset_x, g.py + offset_y
    # Compared as floats: offsets may exceed any integer.
    if not (fx >= 0.0 and fy >= 0.0 and fx < wp.float32(view.width) and fy < wp.float32(view.height)):
        return highest
    d = fetch_point(view, depth, pyramid, g.inverse, wp.int32(fx), wp.int32(fy), level) - g.point
    square = wp.dot(d, d)
    # Also false for the background and whatever is not finite.
    if square < g.radius2:
        inverse = fast_rsqrt(square)
        cosine = wp.min(wp.dot(d, g.towards) * inverse, 1.0)
        weight = wp.min((g.radius2 - square) * g.slope, 1.0)
        weight *= wp.clamp(wp.dot(d, g.normal) * inverse * ELEVATION, 0.0, 1.0)
        return wp.max(highest, low + (cosine - low) * weight)
    return highest


@functools.cache
def make_ambient_visibility_kernel(codec: tuple, slices: int, steps: int, half: bool):
    """Kernel that searches horizons and writes a word a pixel: affine depth and noisy visibility.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
        slices: Slices a pixel.
        steps: Samples on each side of a slice.
        half: One thread for every second pixel a side, over raster bins, into the half-size image.
    """
    decode = make_gbuffer_codec(*codec)[1]

    @wp.func
    def pixel_of(view: View, tile: wp.vec4i, thread: wp.int32):
        """(x, y) in the image that is written, full or half."""
        place = pixel_in_block(thread)
        if wp.static(half):
            return wp.vec2i((tile[1] >> 1) + place[0], (tile[2] >> 1) + place[1])
        return wp.vec2i(tile[1] + place[0], tile[2] + place[1])

    @wp.func
    def visibility_of(
        view: View,
        depth: wp.array[wp.float32],
        pyramid: wp.array[wp.float32],
        pattern: wp.array[wp.vec4],
        g: Gather,
        reach: wp.float32,
        nearest: wp.float32,
        phase: wp.int32,
    ):
        v = g.towards
        # An interpolated normal may face away: the formula holds up to a right angle.
        nv = wp.max(wp.dot(g.normal, v), 0.0)
        total, open_total = wp.float32(0.0), wp.float32(0.0)
        for k in range(wp.static(slices)):
            row = load_vec4(pattern, k * 16 + phase)
            along = row[0] * v[0] + row[1] * v[1]
            t = wp.vec3(row[0] - v[0] * along, row[1] - v[1] * along, -v[2] * along)
            nt = wp.dot(g.normal, t) * fast_rsqrt(wp.dot(t, t))
            sine = wp.clamp(nt * fast_rsqrt(nv * nv + nt * nt), -1.0, 1.0)
            # Towards +t the tangent plane stands at n + 90 degrees, towards -t at 90 - n.
            c1, c0 = -sine, wp.float32(sine)
            for step in range(wp.static(steps)):
                share = (wp.float32(step) + row[2]) * wp.static(1.0 / steps)
                # Denser near the pixel.
                share = share * (0.4 + 0.6 * share) + nearest
                x = row[0] * view.scale[0] * (reach * share)
                y = row[1] * view.scale[1] * (reach * share)
                level = sample_level(x, y)
                c1 = sample_horizon(view, depth, pyramid, g, x, y, level, -sine, c1)
                c0 = sample_horizon(view, depth, pyramid, g, -x, -y, level, sine, c0)
            q1, q0, q = wp.max(1.0 - c1 * c1, 0.0), wp.max(1.0 - c0 * c0, 0.0), wp.max(1.0 - sine * sine, 0.0)
            arc1 = fast_acos(c1) - fast_root(q1) * c1
            arc0 = fast_acos(c0) - fast_root(q0) * c0
            open1 = fast_acos(-sine) + fast_root(q) * sine
            open0 = fast_acos(sine) - fast_root(q) * sine
            total += nv * (q1 + q0) + nt * (arc1 - arc0)
            open_total += nv * (q + q) + nt * (open1 - open0)
        result = total / open_total
        # No slice sees the normal, or something was not finite: nothing is known to block.
        return wp.where(result >= 0.0 and open_total > 0.0, wp.min(result, 1.0), 1.0)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def ambient_visibility_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        gbuffer: GBuffer,
        pyramid: wp.array[wp.float32],
        pattern: wp.array[wp.vec4],
        # Params
        radius: wp.float32,
        first: wp.int32,
        # Out
        out_words: wp.array[wp.uint32],
    ):
        thread = wp.tid() + first
        tile = load_vec4i(tiles, thread // PIXEL_BLOCK_AREA)
        view = views[tile[0]]
        place = pixel_of(view, tile, thread)
        phase = (place[1] & 3) * 4 + (place[0] & 3)
        x, y = place[0], place[1]
        target = wp.int32(0)
        if wp.static(half):
            x, y = 2 * place[0], 2 * place[1]
            target = half_index(view, place[0], place[1])
        if x >= view.width or y >= view.height or view.depth_only != 0:
            return
        i = pixel_index(view, x, y)
        if wp.static(not half):
            target = i
        d = gbuffer.depth[i]
        if not wp.isfinite(d):
            out_words[target] = OPEN_WORD
            return
        g = Gather()
        g.px = wp.float32(x) + 0.5
        g.py = wp.float32(y) + 0.5
        g.inverse = wp.vec2(1.0 / view.scale[0], 1.0 / view.scale[1])
        g.point = point_in_view(view, g.px, g.py, d, g.inverse)
        ball = RADIUS_SCALE * radius
        g.radius2 = ball * ball
        g.slope = wp.static(1.0 / (1.0 - float(FALLOFF_START))) / g.radius2
        g.towards = wp.vec3(0.0, 0.0, 1.0)
        reach = wp.float32(ball)
        if view.projection != ORTHOGRAPHIC:
            g.towards = g.point * (-fast_rsqrt(wp.dot(g.point, g.point)))
            reach = ball / d
        # Where the radius exceeds the view, its samples would miss it.
        reach = wp.min(reach, 0.5 * wp.float32(wp.max(view.width, view.height)) * wp.abs(g.inverse[0]))
        nearest = NEAREST_PX * wp.abs(g.inverse[0]) / reach
        g.normal = view.rotation * decode(gbuffer, i).normal
        v = visibility_of(view, gbuffer.depth, pyramid, pattern, g, reach, nearest, phase)
        out_words[target] = pack_visibility(affine_depth(view, d), v)

    return ambient_visibility_kernel
