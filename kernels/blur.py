"""Separable Gaussian blur of an HDR image or of a channel: one launch along the rows, one along the columns.

One thread a pixel over 8 x 8 blocks of the pixel table, block size 64. A result is the middle plus the weighted
differences of its neighbours from it, so that a constant comes back to the bit, whatever the weights' rounding. Beyond
the edge of its view a pixel sees the pixel at the edge. A neighbour that is not finite counts as the middle, and a
middle that is not finite is kept: depth's +inf neither spreads nor is lost. HDR images are clamped to [0, 65504].
Bytes a pixel and launch: the pixel in and out (8, 12 or 4), its neighbours from cache; 2 radius loads and, a component,
4 radius additions and 2 radius multiplications.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .projection import pixel_index, pixel_of
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: What is blurred: a half4 image, a float32 image, a channel of vectors, a channel of numbers.
KINDS = ("half", "color", "vec3", "float32")
#: (kind, along columns): what CI compiles.
VARIANTS = [(kind, columns) for kind in KINDS for columns in (False, True)]


@wp.struct
class Plane:
    """Pixels of one of KINDS; arrays of the other kinds are one element long and never touched."""

    image: Image
    vectors: wp.array[wp.vec3]
    scalars: wp.array[wp.float32]


@wp.func
def difference(value: wp.float32, middle: wp.float32):
    """Value less the middle; 0 where either is not finite, or so large that the difference is not."""
    d = value - middle
    if not wp.isfinite(d):
        return wp.float32(0.0)
    return d


@wp.func
def differences(value: wp.vec3, middle: wp.vec3):
    """Apply `difference` to the components."""
    return wp.vec3(difference(value[0], middle[0]), difference(value[1], middle[1]), difference(value[2], middle[2]))


@functools.cache
def make_plane_codec(kind: str):
    """(load, store, difference) functions of a kind."""
    load_image, store_image = make_image_codec(kind == "half")

    @wp.func
    def load_clamped(plane: Plane, i: wp.int32):
        return store_limit(load_image(plane.image, i), 65504.0)

    @wp.func
    def store_clamped(plane: Plane, i: wp.int32, value: wp.vec3):
        store_image(plane.image, i, value)

    @wp.func
    def load_vector(plane: Plane, i: wp.int32):
        return plane.vectors[i]

    @wp.func
    def store_vector(plane: Plane, i: wp.int32, value: wp.vec3):
        plane.vectors[i] = value

    @wp.func
    def load_scalar(plane: Plane, i: wp.int32):
        return plane.scalars[i]

    @wp.func
    def store_scalar(plane: Plane, i: wp.int32, value: wp.float32):
        plane.scalars[i] = value

    if kind == "float32":
        return load_scalar, store_scalar, difference
    return (load_vector, store_vector, differences) if kind == "vec3" else (load_clamped, store_clamped, differences)


@functools.cache
def make_blur_kernel(kind: str, columns: bool):
    """Kernel that blurs along one axis.

    Args:
        kind: One of KINDS.
        columns: Along y, else along x.
    """
    load, store, away = make_plane_codec(kind)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def blur_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        source: Plane,
        weights: wp.array[wp.float32],
        # Params
        first: wp.int32,
        # Out
        out_target: Plane,
    ):
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        middle = load(source, i)
        total = away(middle, middle)
        for k in range(1, weights.shape[0]):
            before, after = i, i
            if wp.static(columns):
                before = pixel_index(view, x, wp.max(y - k, 0))
                after = pixel_index(view, x, wp.min(y + k, view.height - 1))
            else:
                before = i - x + wp.max(x - k, 0)
                after = i - x + wp.min(x + k, view.width - 1)
            total = total + (away(load(source, before), middle) + away(load(source, after), middle)) * weights[k]
        store(out_target, i, middle + total)

    return blur_kernel
