"""Depth codecs of the G-buffer: what lighting reads of depth as a whole number, a pair of functions for each format.

`float32` stores the linear depth itself, at no loss. The others store a code of the key's z (1 at the near plane, 0
infinitely far; orthographic: 1 near, 0 far): larger is nearer, 0 is the background, and a surface has at least 1.

- `unorm16`, `unorm24`: z in steps of 1 / L, L = 2^bits - 1, as Direct3D's D16 and D24 would keep a reversed z. Off by
  at most 0.5 / L + 2^-23 z where z >= 0.5 / L; what lies deeper, beyond 2 L near planes, comes back at L of them.
- `ufloat16`: the upper part of z's own float32, 5 bits of exponent and 11 of fraction without a sign, rounded. Off by
  at most 2^-12 z down to z = 2^-32, 4 billion near planes away. Integers alone: the same code on every device.

In a perspective z = near / depth, so that a share of z is the same share of depth: at depth d unorm is off by the share
d / (2 L near) (1e-4 at 1 km and 24 bits for a near plane of 0.3 m), ufloat16 by 2.5e-4 anywhere. In an orthographic
view depth is linear in z, and these are shares of its range. A fixed-point *linear* depth is no codec of a perspective
here: its far plane is infinitely far.

Only lighting reads codes (shade, the depth bounds of light tiles): one surface for culling and lighting, so that masks
miss no light. Outputs, and effects that look at a pixel's surroundings (ambient visibility, depth of field, motion
blur), keep `float32`, stored beside it where they are called for. The output `depth` is public, and the same bits on
every device. Ambient visibility compares neighbours: steps would be edges to it, and a plane would occlude itself.

Shadow look-ups start where a code says that a point is, so they lift it by what that may be off its plane
(`make_depth_slack`): else surfaces would shadow themselves, in stripes.
"""

from __future__ import annotations

import functools

import warp as wp

from .encoding import pack_unorm, unpack_unorm
from .intrinsics import bits_float, float_bits
from .projection import linear_depth
from .structs import ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Formats from coarse to exact, with the type of a pixel's number.
DEPTH_CODECS: dict[str, type] = {
    "unorm16": wp.uint16, "ufloat16": wp.uint16, "unorm24": wp.uint32, "float32": wp.float32,
}  # fmt: skip
#: Code 65535 of ufloat16 is z = 1, whose upper 20 bits are 0x3F800.
UFLOAT_BASE = 0x3F800 - 0xFFFF
#: Sine that a quantised normal may be off: 1.2 degrees.
SINE = wp.constant(0.02)


@functools.cache
def make_depth_codec(name: str):
    """(encode, decode) between z and a code.

    Raises:
        ValueError: If the format has no codes.
    """
    if name in ("unorm16", "unorm24"):
        levels = float(2 ** int(name[5:]) - 1)

        @wp.func
        def encode(z: wp.float32):
            # Next to the near plane adding one half rounds 2^24 - 1 up in float32: past the last code.
            return wp.clamp(pack_unorm(z, wp.static(levels)), wp.uint32(1), wp.uint32(wp.static(int(levels))))

        @wp.func
        def decode(code: wp.uint32):
            return unpack_unorm(code, wp.static(levels))

    elif name == "ufloat16":

        @wp.func
        def encode(z: wp.float32):
            code = wp.int32(1)
            if z > 0.0:
                # Half of the last place kept, so that dropping the rest rounds to the nearest.
                upper = (float_bits(wp.min(z, 1.0)) + wp.uint32(0x800)) >> wp.uint32(12)
                code = wp.max(wp.int32(upper) - wp.static(UFLOAT_BASE), 1)
            return wp.uint32(code)

        @wp.func
        def decode(code: wp.uint32):
            if code == wp.uint32(0):
                return wp.float32(0.0)
            return bits_float((code + wp.uint32(wp.static(UFLOAT_BASE))) << wp.uint32(12))

    else:
        raise ValueError(f"make_depth_codec: expected a format of codes, got {name!r}")
    return encode, decode


@functools.cache
def make_depth_slack(name: str):
    """Function that bounds how far off its plane a point may be for its depth's format [m].

    A depth that is off by e moves the point by e / depth of its way from the eye, and off the plane by that times the
    cosine; SINE more for what the normal is off. unorm is off by d^2 / (2 L near), with a tenth added for the square of
    a depth that is itself decoded, which suffices up to a tenth of 2 L near planes.
    """
    small = name == "ufloat16"
    step = 2.0**-12 if small else 0.55 / (2.0 ** int(name.removeprefix("unorm")) - 1.0)

    @wp.func
    def depth_slack(view: View, point: wp.vec3, normal: wp.vec3, depth: wp.float32):
        if view.projection == ORTHOGRAPHIC:
            return wp.static(step) * (view.far - view.near)
        share = wp.float32(wp.static(step))
        if wp.static(not small):
            share *= depth / view.near
        return share * (wp.abs(wp.dot(normal, point)) + SINE * wp.length(point))

    return depth_slack


@wp.func
def coded_depth(view: View, code: wp.uint32, z: wp.float32):
    """Linear depth [m] of a code that stands for z: +inf on the background."""
    if code == wp.uint32(0):
        return wp.float32(wp.inf)
    return linear_depth(view, z)


@functools.cache
def make_depth_access(name: str):
    """(store, clear, load) functions of a pixel's depth in a G-buffer: z in, linear depth [m] out, +inf if cleared."""
    if name == "float32":

        @wp.func
        def store(g: GBuffer, view: View, i: wp.int32, z: wp.float32):
            g.depth[i] = linear_depth(view, z)

        @wp.func
        def clear(g: GBuffer, i: wp.int32):
            g.depth[i] = wp.inf

        @wp.func
        def load(g: GBuffer, view: View, i: wp.int32):
            return g.depth[i]

        return store, clear, load
    encode, decode = make_depth_codec(name)
    short = DEPTH_CODECS[name] is wp.uint16

    @wp.func
    def store_code(g: GBuffer, view: View, i: wp.int32, z: wp.float32):
        if wp.static(short):
            g.depth16[i] = wp.uint16(encode(z))
        else:
            g.depth32[i] = encode(z)

    @wp.func
    def clear_code(g: GBuffer, i: wp.int32):
        if wp.static(short):
            g.depth16[i] = wp.uint16(0)
        else:
            g.depth32[i] = wp.uint32(0)

    @wp.func
    def load_code(g: GBuffer, view: View, i: wp.int32):
        code = wp.uint32(0)
        if wp.static(short):
            code = wp.uint32(g.depth16[i])
        else:
            code = g.depth32[i]
        return coded_depth(view, code, decode(code))

    return store_code, clear_code, load_code
