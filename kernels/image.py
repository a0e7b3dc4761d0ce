"""The HDR image as passes hand it on: float32, or half4 packed in 64 bits. Functions and a struct only."""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import pack_half4, unpack_half3

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Image:
    """An HDR image in the plan's format; the other array is one element long and never touched."""

    full: wp.array[wp.vec3]
    half: wp.array[wp.uint64]


@wp.func
def finite_radiance(value: wp.float32, limit: wp.float32):
    """NaN and negative become 0, what is too large the limit: nothing non-finite leaves a pass."""
    if not (value > 0.0):
        return wp.float32(0.0)
    return wp.min(value, limit)


@wp.func
def store_limit(v: wp.vec3, limit: wp.float32):
    """Apply `finite_radiance` to a colour."""
    return wp.vec3(finite_radiance(v[0], limit), finite_radiance(v[1], limit), finite_radiance(v[2], limit))


@wp.func
def to_half(v: wp.vec3):
    """Radiance as half4, clamped to half's range before the cast."""
    c = store_limit(v, 65504.0)
    return pack_half4(c[0], c[1], c[2])


@functools.cache
def make_image_codec(half: bool):
    """(load, store) functions of a pixel of an `Image`; what is stored is finite and not negative.

    Args:
        half: Whether the plan keeps half4 images.
    """

    @wp.func
    def load_full(image: Image, i: wp.int32):
        return image.full[i]

    @wp.func
    def load_half(image: Image, i: wp.int32):
        return unpack_half3(image.half[i])

    @wp.func
    def store_full(image: Image, i: wp.int32, v: wp.vec3):
        image.full[i] = store_limit(v, 3.0e38)

    @wp.func
    def store_half(image: Image, i: wp.int32, v: wp.vec3):
        image.half[i] = to_half(v)

    return (load_half, store_half) if half else (load_full, store_full)
