"""Depth of field by mixing with an equally blurred copy: the rung `plane_lerp`. Block size 64.

The share of the copy grows with the distance from the plane in focus, power * |z - f| / z; the copy is a Gaussian blur
along one axis after the other. One thread a pixel. Bytes a pixel and launch: image in and out, 16 or 24, the second
one reads both images and depth; neighbours from the caches. Deterministic.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .lens import lens_scale
from .projection import pixel_index, pixel_of
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half image,): what CI compiles.
VARIANTS = [(True,), (False,)]
#: Radiance that goes into sums: half's range.
HALF_MAX = wp.constant(wp.float32(65504.0))


@functools.cache
def make_depth_of_field_plane_kernels(half: bool):
    """(rows, columns) kernels; `half`: whether the plan keeps half4 images."""
    load, store = make_image_codec(half)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def rows_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        weights: wp.array[wp.float32],
        # Params
        first: wp.int32,
        # Out
        out_blurred: Image,
    ):
        """One thread a pixel: blur along x; what lies beyond the edge repeats it."""
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        radius = weights.shape[0] - 1
        total = wp.vec3(0.0, 0.0, 0.0)
        for k in range(-radius, radius + 1):
            j = pixel_index(view, wp.clamp(x + k, 0, view.width - 1), y)
            total = total + store_limit(load(image, j), HALF_MAX) * weights[wp.abs(k)]
        store(out_blurred, pixel_index(view, x, y), total)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def columns_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        blurred: Image,
        depth: wp.array[wp.float32],
        weights: wp.array[wp.float32],
        # Params
        power: wp.float32,
        first: wp.int32,
        # Out
        out_image: Image,
    ):
        """One thread a pixel: blur along y, then mix by distance from the plane in focus; power < 0: the lens's."""
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        color = load(image, i)
        radius = weights.shape[0] - 1
        scale = power
        if power < 0.0:
            scale = lens_scale(view) / (view.focus_distance * wp.float32(radius))
        share = wp.min(scale * wp.abs(1.0 - view.focus_distance / depth[i]), 1.0)
        if share > 0.0 and lens_scale(view) > 0.0:
            total = wp.vec3(0.0, 0.0, 0.0)
            for k in range(-radius, radius + 1):
                j = pixel_index(view, x, wp.clamp(y + k, 0, view.height - 1))
                total = total + load(blurred, j) * weights[wp.abs(k)]
            color = color + (total - color) * share
        store(out_image, i, color)

    return rows_kernel, columns_kernel
