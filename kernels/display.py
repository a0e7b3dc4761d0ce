"""Display: exposure, bloom, tone curve and sRGB encoding to 8 bits. One thread 2 x 2 pixels, block size 64; last.

With bloom in the plan a pixel gives up the scattered share of its bright part and takes in bloom's; the pyramid is
interpolated here, at 2 bytes a pixel, where a full-size bloom image would be 8 written and 8 read. Four pixels share
what they see of it, 9 loads in place of 16, and the look-ups of view and level.
"""

from __future__ import annotations

import functools

import warp as wp

from .color import CURVES, clamp_radiance, srgb_code, tone_curve
from .intrinsics import load_double_word, load_vec4i, unpack_half3
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, Bloom, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Alpha 255 in the highest byte.
OPAQUE = wp.constant(wp.uint32(0xFF000000))
#: Kinds of bloom: none, a pyramid whose first level has half the size, one value a pixel.
BLOOMS = ("", "levels", "full")
#: (tone curve, half radiance, bloom): what CI compiles.
VARIANTS = [(curve, half, "") for curve in CURVES for half in (False, True)]
VARIANTS += [("pbr_neutral", half, bloom) for half in (False, True) for bloom in BLOOMS[1:]]


@functools.cache
def make_gathered(bloom: str):
    """Return the function that reads bloom at 2 x 2 pixels, from (x, y) even; 0 where there is none.

    Args:
        bloom: One of BLOOMS; the file with its kernels is imported only where there is one.
    """
    from .bloom import Quad, bilinear_quad

    @wp.func
    def gathered(view: View, index: wp.int32, x: wp.int32, y: wp.int32, near: wp.vec4i, source: Bloom):
        quad = Quad()
        if view.bloom > 0.0 and source.bright[0] != 0:
            if wp.static(bloom == "full"):
                quad.nw = source.full[near[0]]
                quad.ne = source.full[near[1]]
                quad.sw = source.full[near[2]]
                quad.se = source.full[near[3]]
            else:
                quad = bilinear_quad(source.texels, source.levels[index * source.level_count], x >> 1, y >> 1)
        return quad

    return gathered


@functools.cache
def make_scatter(bloom: str):
    """Return the function that moves scattered light: out of a pixel's exposed radiance, and in from bloom.

    Args:
        bloom: One of BLOOMS but none.
    """
    from .bloom import MOST
    from .bloom_bright import bright_of

    scale = 1.0 if bloom == "full" else 1.0 / 16.0

    @wp.func
    def scatter(v: wp.vec3, value: wp.vec3, gained: wp.vec3, view: View, source: Bloom):
        share = view.bloom
        if share <= 0.0 or source.bright[0] == 0:
            return v
        lost = bright_of(value, view.exposure, source)
        # All is finite here, so that bounds are two operations and no branch.
        mixed = (v - lost * share) + gained * (share * wp.static(scale))
        return wp.max(wp.min(mixed, wp.vec3(MOST)), wp.vec3())

    return scatter


@wp.func
def quad_indices(view: View, x: wp.int32, y: wp.int32):
    """Indices of 2 x 2 pixels in the arena; those outside the view are those beside them."""
    i = pixel_index(view, x, y)
    right, below = wp.where(x + 1 < view.width, 1, 0), wp.where(y + 1 < view.height, view.row_pitch, 0)
    return wp.vec4i(i, i + right, i + below, i + below + right)


@functools.cache
def make_display_kernel(curve: str, half: bool, bloom: str):
    """Kernel that turns radiance into sRGB bytes.

    Args:
        curve: Name of the tone curve.
        half: Read the half4 radiance, else the float32 colour.
        bloom: One of BLOOMS.
    """
    tone = tone_curve(curve)
    if bloom:
        gathered, scatter = make_gathered(bloom), make_scatter(bloom)

    @wp.func
    def pixel(radiance: wp.array[wp.uint64], color: wp.array[wp.vec3], i: wp.int32):
        if wp.static(half):
            return unpack_half3(load_double_word(radiance, i))
        else:
            return color[i]

    @wp.func
    def encoded(v: wp.vec3, thresholds: wp.array[wp.float32]):
        """Exposed radiance as bytes, red in the lowest one: one store a pixel."""
        mapped = tone(v)
        r = srgb_code(mapped[0], thresholds)
        g = srgb_code(mapped[1], thresholds)
        b = srgb_code(mapped[2], thresholds)
        return r | (g << wp.uint32(8)) | (b << wp.uint32(16)) | OPAQUE

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def display_kernel(
        # Frame
        views: wp.array[View],
        bin_tiles: wp.array[wp.vec4i],
        # In
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        thresholds: wp.array[wp.float32],
        scattered: Bloom,
        # Params
        first: wp.int32,
        # Out
        out_display: wp.array[wp.uint32],
    ):
        thread = wp.tid() + first
        tile = load_vec4i(bin_tiles, pixel_block(thread))
        view = views[tile[0]]
        place = pixel_in_block(thread)
        x, y = tile[1] + 2 * place[0], tile[2] + 2 * place[1]
        if x >= view.width or y >= view.height or view.depth_only != 0:
            return
        near = quad_indices(view, x, y)
        a, b = pixel(radiance, color, near[0]), pixel(radiance, color, near[1])
        c, d = pixel(radiance, color, near[2]), pixel(radiance, color, near[3])
        va, vb = clamp_radiance(a * view.exposure), clamp_radiance(b * view.exposure)
        vc, vd = clamp_radiance(c * view.exposure), clamp_radiance(d * view.exposure)
        if wp.static(bloom != ""):
            quad = gathered(view, tile[0], x, y, near, scattered)
            va = scatter(va, a, quad.nw, view, scattered)
            vb = scatter(vb, b, quad.ne, view, scattered)
            vc = scatter(vc, c, quad.sw, view, scattered)
            vd = scatter(vd, d, quad.se, view, scattered)
        # Outside the view they are the same pixel's once more.
        out_display[near[0]] = encoded(va, thresholds)
        if near[1] != near[0]:
            out_display[near[1]] = encoded(vb, thresholds)
        if near[2] != near[0]:
            out_display[near[2]] = encoded(vc, thresholds)
            if near[1] != near[0]:
                out_display[near[3]] = encoded(vd, thresholds)

    return display_kernel
