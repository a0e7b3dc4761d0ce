"""Colours for numbers: heat, ids, and what is not a number. Functions only; results are sRGB codes / 255 in [0, 1].

Heat is Turbo (Mikhailov 2019, "Turbo, An Improved Rainbow Colormap for Visualization"), by the polynomials of degree 5
that Ruofei Du fitted to it (Apache 2.0): blue for little, red for much, lightness highest in the middle, so that both
ends stand out. Id colours come from an integer hash, in hue, saturation and value by steps that are the same on every
device.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

HASH_FIRST = wp.constant(wp.uint32(0x85EBCA6B))
HASH_SECOND = wp.constant(wp.uint32(0xC2B2AE35))


@wp.func
def heat_channel(
    t: wp.float32,
    c0: wp.float32,
    c1: wp.float32,
    c2: wp.float32,
    c3: wp.float32,
    c4: wp.float32,
    c5: wp.float32,
):
    """Polynomial of degree 5, clamped to [0, 1]."""
    return wp.clamp(((((c5 * t + c4) * t + c3) * t + c2) * t + c1) * t + c0, 0.0, 1.0)


@wp.func
def heat(value: wp.float32):
    """Turbo of a share in [0, 1], clamped; NaN counts as 0."""
    t = wp.float32(0.0)
    if value > 0.0:
        t = wp.min(value, 1.0)
    return wp.vec3(
        heat_channel(t, 0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943),
        heat_channel(t, 0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604),
        heat_channel(t, 0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973),
    )


@wp.func
def heat_of_count(count: wp.int32):
    """Heat of a count on a fixed scale by doublings: 0 is black, 1 blue, 4 green, 8 yellow, 64 and more dark red."""
    if count <= 0:
        return wp.vec3()
    return heat((1.0 + wp.log2(wp.float32(count))) / 7.0)


@wp.func
def hash_bits(value: wp.uint32):
    """Mix an integer's bits (the finaliser of MurmurHash3, Appleby, public domain)."""
    h = value
    h = (h ^ (h >> wp.uint32(16))) * HASH_FIRST
    h = (h ^ (h >> wp.uint32(13))) * HASH_SECOND
    return h ^ (h >> wp.uint32(16))


@wp.func
def hue_channel(hue: wp.float32, shift: wp.float32, saturation: wp.float32):
    """One channel of a hue in [0, 1), at value 1."""
    h = hue + shift
    h = (h - wp.floor(h)) * 6.0
    return 1.0 - saturation + saturation * wp.clamp(wp.abs(h - 3.0) - 1.0, 0.0, 1.0)


@wp.func
def id_color(value: wp.uint32):
    """Colour of an id: neighbouring numbers get unlike ones, and none is dark."""
    bits = hash_bits(value + wp.uint32(1))
    hue = wp.float32(bits & wp.uint32(0xFFFF)) / 65536.0
    saturation = 0.35 + 0.5 * wp.float32((bits >> wp.uint32(16)) & wp.uint32(0xFF)) / 255.0
    level = 0.55 + 0.45 * wp.float32(bits >> wp.uint32(24)) / 255.0
    return (
        wp.vec3(
            hue_channel(hue, 0.0, saturation),
            hue_channel(hue, 2.0 / 3.0, saturation),
            hue_channel(hue, 1.0 / 3.0, saturation),
        )
        * level
    )
