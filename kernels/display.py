"""Display: exposure, tone curve and sRGB encoding to 8 bits. One thread a pixel, block size 64; last in the frame."""

from __future__ import annotations

import functools

import warp as wp

from .color import CURVES, clamp_radiance, srgb_code, tone_curve
from .intrinsics import load_vec4i, unpack_half3
from .projection import pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, PIXEL_BLOCK_AREA, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Alpha 255 in the highest byte.
OPAQUE = wp.constant(wp.uint32(0xFF000000))
#: (tone curve, half radiance): what CI compiles.
VARIANTS = [(curve, half) for curve in CURVES for half in (False, True)]


@functools.cache
def make_display_kernel(curve: str, half: bool):
    """Kernel that turns radiance into sRGB bytes.

    Args:
        curve: Name of the tone curve.
        half: Read the half4 radiance, else the float32 colour.
    """
    tone = tone_curve(curve)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def display_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        radiance: wp.array[wp.uint64],
        color: wp.array[wp.vec3],
        thresholds: wp.array[wp.float32],
        # Params
        first: wp.int32,
        # Out
        out_display: wp.array[wp.uint32],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        value = wp.vec3()
        if wp.static(half):
            value = unpack_half3(radiance[i])
        else:
            value = color[i]
        mapped = tone(clamp_radiance(value * view.exposure))
        r = srgb_code(mapped[0], thresholds)
        g = srgb_code(mapped[1], thresholds)
        b = srgb_code(mapped[2], thresholds)
        # One store a pixel: red in the lowest byte.
        out_display[i] = r | (g << wp.uint32(8)) | (b << wp.uint32(16)) | OPAQUE

    return display_kernel
