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

Arithmetic is + - * /, fused multiply-adds, bit casts and table look-ups, no library functions: CPU and CUDA write the
same bits. View space is x right, y up, z backward. Block size 64, one thread a pixel; deterministic.

Cost at 1920 x 1080 with 2 slices of 2 x 3 samples: reads 4 (depth) + 4 (normal) + about 2 (pyramid) bytes a pixel,
writes 4: 29 MB, 7 us at 4.2 TB/s. Arithmetic rules: the binary for sm_90 has 1400 instructions, of which a fifth are
paths that are hardly ever taken; a sample takes 47 whether it counts or not, what two of them share 25. 1100 a pixel
are 77 us at 29.6 T/s where surfaces fill the picture.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from .depth_pyramid import LEVELS, level_start, pyramid_index
from .encoding import make_gbuffer_codec, pack_unorm
from .intrinsics import bits_float, float_bits, fma, fnma, load_either, load_float, load_vec4, load_vec4i, saturated_fma
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (block, least blocks a multiprocessor): 56 registers and none spilled, where without it 64 are taken.
BOUNDS = (BLOCK_DIM, 18)
#: Squared distance, as a share of the squared radius, from which a sample counts less.
FALLOFF_START = wp.constant(0.9)
#: Radius of the ball that samples are taken from, as a multiple of the radius asked for.
RADIUS_SCALE = wp.constant(1.4)
#: A sample counts wholly from a sine of 1 / 8 (7 degrees) above the tangent plane on.
ELEVATION = wp.constant(8.0)
#: Nearest sample [px]: one that lands on the pixel itself would say nothing.
NEAREST_PX = wp.constant(1.3)
#: A sample's place is rounded by adding and taking away 1.5 * 2^23: views are narrower than 2^22 pixels.
ROUNDER = wp.constant(12582912.0)
ROUNDER_BITS = wp.constant(wp.uint32(0x4B400000))
#: Bits of a word that hold depth; the low 8 hold 255ths of what is blocked.
DEPTH_MASK = wp.constant(wp.uint32(0xFFFFFF00))
CODE_MASK = wp.constant(wp.uint32(0xFF))
#: Word of the background: as a float its depth, +inf, and nothing blocked.
OPEN_WORD = wp.constant(wp.uint32(0x7F800000))
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


def falloff_of(radius: float) -> float:
    """How fast a sample's weight falls with its squared distance, for a radius [m]: 1/m^2, at most float32's last."""
    square = (radius * float(RADIUS_SCALE)) ** 2
    steepest = float(np.finfo(np.float32).max)
    return min(1.0 / (1.0 - float(FALLOFF_START)) / square, steepest) if square > 0.0 else steepest


@wp.func
def dot3(a: wp.vec3, b: wp.vec3):
    """Dot product, each term but the first rounded with its sum."""
    return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0]))


@wp.func
def fast_rsqrt(x: wp.float32):
    """1 / sqrt(x) within 5e-6 by halving the exponent and two Newton steps; x = 0 gives something large.

    Source: Lomont 2003, "Fast Inverse Square Root".
    """
    y = bits_float(wp.uint32(0x5F375A86) - (float_bits(x) >> wp.uint32(1)))
    half = 0.5 * x
    y = y * fnma(half * y, y, 1.5)
    return y * fnma(half * y, y, 1.5)


@wp.func
def rough_rsqrt(x: wp.float32):
    """1 / sqrt(x) within 1e-3 by one Newton step; x = 0 gives something large.

    After Kadlec 2010, "Improving the fast inverse square root"; both numbers are a fit of ours with one factor fewer.
    """
    y = bits_float(wp.uint32(0x5F0B3800) - (float_bits(x) >> wp.uint32(1)))
    return y * fnma(x * y, y, 1.891)


@wp.func
def arc_part(c: wp.float32):
    """The odd function asin c + c sqrt(1 - c^2) within 6e-4 for c in [-1, 1], odd to the bit.

    Least maximum error among odd polynomials of degree 9, a fit of ours. It is pi / 2 less what an arc adds to the
    integral, acos c - c sqrt(1 - c^2).
    """
    s = c * c
    return c * fma(s, fma(s, fma(s, fma(s, -0.28212488, 0.48553474), -0.37033505), -0.25680352), 1.99503783)


@wp.func
def affine_depth(view: View, depth: wp.float32):
    """What is linear across a plane's pixels: 1 / depth, or depth itself for orthographic views."""
    if view.projection == ORTHOGRAPHIC:
        return depth
    return 1.0 / depth


@wp.func
def pack_visibility(affine: wp.float32, visibility: wp.float32):
    """Word of an affine depth (15 bits of mantissa) and what a visibility leaves blocked (8 bits, rounded)."""
    return (float_bits(affine) & DEPTH_MASK) | (CODE_MASK - pack_unorm(visibility, 255.0))


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

    eye: wp.vec3  # from the point to the eye, view space [m]; orthographic: to its origin
    towards: wp.vec3  # unit vector to the viewer
    normal: wp.vec3  # ELEVATION long
    inverse: wp.vec2  # 1 / view.scale
    ray: wp.vec2  # x / depth, y / depth of the pixel; orthographic: x, y [m]
    x: wp.float32  # pixel + ROUNDER
    y: wp.float32
    fade: wp.float32  # falloff per squared metre, times the squared radius
    slope: wp.float32  # falloff per squared metre, times -1


@wp.struct
class Level:
    """Where the depths of a level lie."""

    shift: wp.uint32  # the level, 0 to LEVELS; 0: the depths themselves
    keep: wp.uint32  # mask of a float's bits, and what is then set: a texel's pixel
    half: wp.uint32
    start: wp.int32  # index of the texel that covers pixel (0, 0)
    pitch: wp.int32  # texels from one row to the next


@wp.func
def level_at(view: View, x: wp.float32, y: wp.float32):
    """Level to fetch from at an offset [px]."""
    level = Level()
    k = sample_level(x, y)
    level.shift = wp.uint32(k)
    side = wp.uint32(1) << level.shift
    level.keep = wp.uint32(0) - side
    level.half = side >> wp.uint32(1)
    level.pitch = wp.where(k == 0, view.row_pitch, view.bins_x << 4)
    level.start = wp.where(k == 0, wp.int32(view.pixel_offset), level_start(view, k))
    return level


@wp.func
def sample_horizon(
    view: View,
    depth: wp.array[wp.float32],
    pyramid: wp.array[wp.float32],
    g: Gather,
    x: wp.float32,
    y: wp.float32,
    level: Level,
    low: wp.float32,
    minus_low: wp.float32,
    highest: wp.float32,
):
    """Cosine of the horizon, up to rounding at most 1, after one more sample, at pixel (x, y) + ROUNDER.

    No sample leaves the view. What lies outside, the background and whatever is not finite weigh 0 or give a NaN, which
    the maximum drops: no branch keeps the next loads waiting.
    """
    bits_x, bits_y = float_bits(x), float_bits(y)
    column, row = bits_x - ROUNDER_BITS, bits_y - ROUNDER_BITS
    # Unsigned, what is left of 0 is large, and so is what comes of offsets beyond any integer.
    inside = column < wp.uint32(view.width) and row < wp.uint32(view.height)
    index = wp.int32(row >> level.shift) * level.pitch + (level.start + wp.int32(column >> level.shift))
    z = load_either(depth, pyramid, level.shift != wp.uint32(0), index, inside)
    # Pixels from the own one to the texel's: exact.
    px = bits_float((bits_x & level.keep) | level.half) - g.x
    py = bits_float((bits_y & level.keep) | level.half) - g.y
    spread = wp.where(view.projection == ORTHOGRAPHIC, 1.0, z)
    dx = fma(fma(px, g.inverse[0], g.ray[0]), spread, g.eye[0])
    dy = fma(fma(py, g.inverse[1], g.ray[1]), spread, g.eye[1])
    d = wp.vec3(dx, dy, g.eye[2] - z)
    square = dot3(d, d)
    inverse = rough_rsqrt(square)
    weight = saturated_fma(square, g.slope, g.fade) * saturated_fma(dot3(d, g.normal), inverse, 0.0)
    return wp.max(highest, fma(fma(dot3(d, g.towards), inverse, minus_low), weight, low))


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
        v, n = g.towards, g.normal * wp.static(1.0 / float(ELEVATION))
        facing = wp.dot(n, v)
        # An interpolated normal may face away: the formula holds up to a right angle.
        nv = wp.max(facing, 0.0)
        total, open_total = wp.float32(0.0), wp.float32(0.0)
        for k in range(wp.static(slices)):
            row = load_vec4(pattern, k * 16 + phase)
            # The tangent is the slice's direction less its part along v; the unit direction lies in the image plane.
            along = fma(row[1], v[1], row[0] * v[0])
            across = fnma(along, facing, fma(row[1], n[1], row[0] * n[0]))
            nt = across * rough_rsqrt(wp.max(fnma(along, along, 1.0), 1.0e-6))
            sine = wp.clamp(nt * rough_rsqrt(fma(nt, nt, nv * nv)), -1.0, 1.0)
            # Towards +t the tangent plane stands at n + 90 degrees, towards -t at 90 - n.
            negative = wp.float32(0.0) - sine
            c1, c0 = wp.float32(negative), wp.float32(sine)
            to_x, to_y = row[0] * view.scale[0], row[1] * view.scale[1]
            for step in range(wp.static(steps)):
                share = (wp.float32(step) + row[2]) * wp.static(1.0 / steps)
                # Denser near the pixel.
                far = fma(reach, share * fma(share, 0.6, 0.4), nearest)
                x, y = to_x * far, to_y * far
                level = level_at(view, x, y)
                c1 = sample_horizon(view, depth, pyramid, g, g.x + x, g.y + y, level, negative, sine, c1)
                c0 = sample_horizon(view, depth, pyramid, g, g.x - x, g.y - y, level, sine, negative, c0)
            c1, c0 = wp.min(c1, 1.0), wp.min(c0, 1.0)
            total = fma(nv, fnma(c1, c1, fnma(c0, c0, 2.0)), fma(nt, arc_part(c0) - arc_part(c1), total))
            open_total = fma(2.0 * nv, fnma(sine, sine, 1.0), fma(2.0 * nt, arc_part(sine), open_total))
        # No slice sees the normal, or something was not finite: nothing is known to block.
        if not (open_total > 0.0 and wp.isfinite(total)):
            return wp.float32(1.0)
        return wp.clamp(total / open_total, 0.0, 1.0)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False, launch_bounds=BOUNDS)
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
        falloff: wp.float32,
        first: wp.int32,
        # Out
        out_words: wp.array[wp.uint32],
    ):
        thread = wp.tid() + first
        tile = load_vec4i(tiles, pixel_block(thread))
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
        d = load_float(gbuffer.depth, i)
        if not wp.isfinite(d):
            out_words[target] = OPEN_WORD
            return
        affine = affine_depth(view, d)
        g = Gather()
        g.x = wp.float32(x) + ROUNDER
        g.y = wp.float32(y) + ROUNDER
        g.inverse = wp.vec2(1.0 / view.scale[0], 1.0 / view.scale[1])
        right, up = wp.float32(x) + 0.5 - view.center[0], wp.float32(y) + 0.5 - view.center[1]
        g.ray = wp.vec2(right * g.inverse[0], up * g.inverse[1])
        g.eye = wp.vec3(-g.ray[0], -g.ray[1], d)
        ball = RADIUS_SCALE * radius
        g.slope = -falloff
        g.fade = ball * ball * falloff
        g.towards = wp.vec3(0.0, 0.0, 1.0)
        reach = wp.float32(ball)
        if view.projection != ORTHOGRAPHIC:
            g.eye = wp.vec3(g.eye[0] * d, g.eye[1] * d, d)
            g.towards = g.eye * fast_rsqrt(dot3(g.eye, g.eye))
            reach = ball * affine
        # Where the radius exceeds the view, its samples would miss it.
        reach = wp.min(reach, 0.5 * wp.float32(wp.max(view.width, view.height)) * wp.abs(g.inverse[0]))
        g.normal = view.rotation * decode(gbuffer, i).normal * ELEVATION
        nearest = NEAREST_PX * wp.abs(g.inverse[0])
        v = visibility_of(view, gbuffer.depth, pyramid, pattern, g, reach, nearest, phase)
        out_words[target] = pack_visibility(affine, v)

    return ambient_visibility_kernel
