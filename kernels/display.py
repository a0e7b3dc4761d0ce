"""Display: exposure, bloom, tone curve and sRGB encoding to 8 bits. One thread a pixel, block size 64; last.

With bloom in the plan a pixel gives up the scattered share of its bright part and takes in bloom's; the pyramid is
interpolated here, at 2 bytes a pixel, where a full-size bloom image would be 8 written and 8 read.
"""

from __future__ import annotations

import functools

import warp as wp

from .color import CURVES, clamp_radiance, srgb_code, tone_curve
from .intrinsics import load_double_word, unpack_half3
from .projection import pixel_index, pixel_of
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
def make_scatter(bloom: str):
    """Return the function that moves scattered light: out of a pixel's exposed radiance, and in from bloom.

    Args:
        bloom: One of BLOOMS; the file with its kernels is imported only where there is one.
    """
    if not bloom:

        @wp.func
        def nothing(
            v: wp.vec3, value: wp.vec3, view: View, index: wp.int32, place: wp.vec2i, i: wp.int32, source: Bloom
        ):
            return v

        return nothing
    from .bloom import MOST, bilinear
    from .bloom_bright import bright_of

    @wp.func
    def scatter(v: wp.vec3, value: wp.vec3, view: View, index: wp.int32, place: wp.vec2i, i: wp.int32, source: Bloom):
        share = view.bloom
        if share <= 0.0 or source.bright[0] == 0:
            return v
        gained = wp.vec3()
        if wp.static(bloom == "full"):
            gained = source.full[i] * share
        else:
            level = source.levels[index * source.level_count]
            gained = bilinear(source.texels, level, place[0], place[1]) * (share * (1.0 / 16.0))
        lost = bright_of(value, view.exposure, source)
        # All is finite here, so that bounds are two operations and no branch.
        mixed = (v - lost * share) + gained
        return wp.max(wp.min(mixed, wp.vec3(MOST)), wp.vec3())

    return scatter


@functools.cache
def make_display_kernel(curve: str, half: bool, bloom: str):
    """Kernel that turns radiance into sRGB bytes.

    Args:
        curve: Name of the tone curve.
        half: Read the half4 radiance, else the float32 colour.
        bloom: One of BLOOMS.
    """
    tone, scatter = tone_curve(curve), make_scatter(bloom)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def display_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
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
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        value = wp.vec3()
        if wp.static(half):
            value = unpack_half3(load_double_word(radiance, i))
        else:
            value = color[i]
        v = clamp_radiance(value * view.exposure)
        mapped = tone(scatter(v, value, view, pixel[0], wp.vec2i(x, y), i, scattered))
        r = srgb_code(mapped[0], thresholds)
        g = srgb_code(mapped[1], thresholds)
        b = srgb_code(mapped[2], thresholds)
        # One store a pixel: red in the lowest byte.
        out_display[i] = r | (g << wp.uint32(8)) | (b << wp.uint32(16)) | OPAQUE

    return display_kernel
