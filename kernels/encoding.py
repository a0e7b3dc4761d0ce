"""G-buffer codecs and packed numbers: pairs of encode and decode functions.

Unsigned normalised integers follow Direct3D's rule (functional specification 3.2.3.6): NaN becomes 0, clamp, scale,
add one half, truncate. Unit vectors: octahedral (Cigolle et al. 2014, "Survey of Efficient Representations for
Independent Unit Vectors", JCGT 3-2), plain rounding; `rgb8` stores the three components in 8 bits each; `xy16` stores
x and y in 16 bits, rebuilds z and keeps its sign in x's lowest bit. A zero or non-finite normal is stored as +Z.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import bits_float, float_bits
from .structs import MODEL_BLINN_PHONG, MODEL_GGX, MODEL_PHONG, GBuffer

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NORMAL_CODECS = ("rgb8", "xy16", "oct16", "oct24", "oct32", "float32")
FLAG_EMISSIVE = wp.constant(4)


@wp.struct
class Surface:
    """What the lighting needs to know about a pixel."""

    normal: wp.vec3
    albedo: wp.vec3
    specular: wp.vec3
    roughness: wp.float32
    metallic: wp.float32
    shininess: wp.float32
    occlusion: wp.float32
    model: wp.int32
    flags: wp.int32


@wp.func
def pack_unorm(value: wp.float32, levels: wp.float32):
    """Integer code of a value in [0, 1]; levels is the largest code. NaN becomes 0."""
    if not (value > 0.0):
        return wp.uint32(0)
    return wp.uint32(wp.min(value, 1.0) * levels + 0.5)


@wp.func
def unpack_unorm(code: wp.uint32, levels: wp.float32):
    """Value in [0, 1] of an integer code."""
    return wp.float32(code) / levels


@wp.func
def sign_not_zero(value: wp.float32):
    """1 or -1; zero counts as positive."""
    return wp.where(value >= 0.0, 1.0, -1.0)


@wp.func
def usable_normal(n: wp.vec3):
    """The vector itself, or +Z where it is zero or not finite."""
    total = wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2])
    if not (total > 0.0 and wp.isfinite(total)):
        return wp.vec3(0.0, 0.0, 1.0)
    return n


@wp.func
def encode_octahedral(n: wp.vec3, levels: wp.float32):
    """Two codes of a direction on the unfolded octahedron; levels is even, so that the axes are exact."""
    v = usable_normal(n)
    v = v * (1.0 / (wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])))
    x, y = v[0], v[1]
    if v[2] < 0.0:
        x = (1.0 - wp.abs(v[1])) * sign_not_zero(v[0])
        y = (1.0 - wp.abs(v[0])) * sign_not_zero(v[1])
    return wp.vec2ui(pack_unorm(x * 0.5 + 0.5, levels), pack_unorm(y * 0.5 + 0.5, levels))


@wp.func
def decode_octahedral(code: wp.vec2ui, levels: wp.float32):
    """Unit vector of two codes."""
    # Whole numbers first: the middle code is exactly 0, the ends exactly 1, and the reciprocal is a constant.
    half = levels * 0.5
    x = (wp.float32(code[0]) - half) * (1.0 / half)
    y = (wp.float32(code[1]) - half) * (1.0 / half)
    z = 1.0 - wp.abs(x) - wp.abs(y)
    fold = wp.max(-z, 0.0)
    v = wp.vec3(x - sign_not_zero(x) * fold, y - sign_not_zero(y) * fold, z)
    return v * (1.0 / wp.length(v))


@functools.cache
def make_normal_codec(name: str):
    """(encode, decode) of a unit vector to 32 bits; 24 bits for rgb8, oct16 and oct24.

    Raises:
        ValueError: If the codec has no 32-bit form.
    """
    if name.startswith("oct"):
        bits = int(name[3:]) // 2
        # An even number of levels puts 0 on a code: the axes come back exactly.
        levels = float(2**bits - 2)

        @wp.func
        def encode(n: wp.vec3):
            code = encode_octahedral(n, wp.static(levels))
            return code[0] | (code[1] << wp.uint32(wp.static(bits)))

        @wp.func
        def decode(code: wp.uint32):
            mask = wp.uint32(wp.static(2**bits - 1))
            return decode_octahedral(
                wp.vec2ui(code & mask, (code >> wp.uint32(wp.static(bits))) & mask), wp.static(levels)
            )

    elif name == "rgb8":

        @wp.func
        def encode(n: wp.vec3):
            v = usable_normal(n)
            r = pack_unorm(v[0] * 0.5 + 0.5, 254.0)
            g = pack_unorm(v[1] * 0.5 + 0.5, 254.0)
            b = pack_unorm(v[2] * 0.5 + 0.5, 254.0)
            return r | (g << wp.uint32(8)) | (b << wp.uint32(16))

        @wp.func
        def decode(code: wp.uint32):
            x = wp.float32(code & wp.uint32(255)) / 127.0 - 1.0
            y = wp.float32((code >> wp.uint32(8)) & wp.uint32(255)) / 127.0 - 1.0
            z = wp.float32((code >> wp.uint32(16)) & wp.uint32(255)) / 127.0 - 1.0
            return wp.normalize(wp.vec3(x, y, z))

    elif name == "xy16":

        @wp.func
        def encode(n: wp.vec3):
            v = usable_normal(n)
            x = pack_unorm(v[0] * 0.5 + 0.5, 32766.0)
            y = pack_unorm(v[1] * 0.5 + 0.5, 65534.0)
            return wp.uint32(wp.where(v[2] < 0.0, 1, 0)) | (x << wp.uint32(1)) | (y << wp.uint32(16))

        @wp.func
        def decode(code: wp.uint32):
            x = wp.float32((code & wp.uint32(65535)) >> wp.uint32(1)) / 16383.0 - 1.0
            y = wp.float32(code >> wp.uint32(16)) / 32767.0 - 1.0
            z = wp.sqrt(wp.max(1.0 - x * x - y * y, 0.0))
            if (code & wp.uint32(1)) != wp.uint32(0):
                z = -z
            return wp.normalize(wp.vec3(x, y, z))

    else:
        raise ValueError(f"make_normal_codec: expected a codec of at most 32 bits, got {name!r}")
    return encode, decode


@wp.func
def pack_root(color: wp.vec3):
    """Three 8-bit codes of the square root of a colour: dark tones keep enough steps."""
    r = pack_unorm(wp.sqrt(wp.max(color[0], 0.0)), 255.0)
    g = pack_unorm(wp.sqrt(wp.max(color[1], 0.0)), 255.0)
    b = pack_unorm(wp.sqrt(wp.max(color[2], 0.0)), 255.0)
    return r | (g << wp.uint32(8)) | (b << wp.uint32(16))


@wp.func
def unpack_root(code: wp.uint32):
    """Colour of three 8-bit square-root codes."""
    r = wp.float32(code & wp.uint32(255)) * (1.0 / 255.0)
    g = wp.float32((code >> wp.uint32(8)) & wp.uint32(255)) * (1.0 / 255.0)
    b = wp.float32((code >> wp.uint32(16)) & wp.uint32(255)) * (1.0 / 255.0)
    return wp.vec3(r * r, g * g, b * b)


@functools.cache
def make_gbuffer_codec(rung: str, normal: str, extra: bool):
    """(encode, decode) of a surface.

    Args:
        rung: `compact`, 16 bytes a pixel with depth, or `full`, float32 throughout.
        normal: Normal codec of the compact rung; 32-bit codecs use the wide array, float32 the full one.
        extra: Whether some material needs the words for metalness, occlusion or a specular colour.
    """
    if rung == "full":
        return _full_codec(extra)
    wide = normal in ("xy16", "oct32")
    exact = normal == "float32"
    encode_normal, decode_normal = make_normal_codec("oct24" if exact else normal)

    @wp.func
    def encode(g: GBuffer, i: wp.int32, s: Surface):
        head = wp.uint32(s.model + s.flags) << wp.uint32(24)
        if wp.static(wide):
            g.normal_wide[i] = encode_normal(s.normal)
            g.normal[i] = head
        elif wp.static(exact):
            n = usable_normal(s.normal)
            g.full_normal[i] = wp.vec4(n[0], n[1], n[2], 0.0)
            g.normal[i] = head
        else:
            g.normal[i] = encode_normal(s.normal) | head
        rough = s.roughness
        if wp.static(extra):
            if s.model == MODEL_PHONG or s.model == MODEL_BLINN_PHONG:
                # log2 of the exponent in 8 bits, 1 to 8192: 3.6 % a step.
                rough = wp.log2(s.shininess) / 13.0
            tail = pack_unorm(s.metallic, 255.0)
            if s.model != MODEL_GGX:
                tail = pack_root(s.specular)
            g.extra[i] = tail | (pack_unorm(s.occlusion, 255.0) << wp.uint32(24))
        g.albedo[i] = pack_root(s.albedo) | (pack_unorm(rough, 255.0) << wp.uint32(24))

    @wp.func
    def decode(g: GBuffer, i: wp.int32):
        s = Surface()
        word = g.normal[i]
        s.model = wp.int32((word >> wp.uint32(24)) & wp.uint32(3))
        s.flags = wp.int32(word >> wp.uint32(24)) & 252
        if wp.static(wide):
            s.normal = decode_normal(g.normal_wide[i])
        elif wp.static(exact):
            n = g.full_normal[i]
            s.normal = wp.vec3(n[0], n[1], n[2])
        else:
            s.normal = decode_normal(word)
        albedo = g.albedo[i]
        s.albedo = unpack_root(albedo)
        s.roughness = wp.float32(albedo >> wp.uint32(24)) * (1.0 / 255.0)
        s.occlusion = 1.0
        s.shininess = 1.0
        if wp.static(extra):
            tail = g.extra[i]
            s.occlusion = wp.float32(tail >> wp.uint32(24)) * (1.0 / 255.0)
            if s.model == MODEL_GGX:
                s.metallic = wp.float32(tail & wp.uint32(255)) * (1.0 / 255.0)
            else:
                s.specular = unpack_root(tail)
                s.shininess = wp.pow(2.0, s.roughness * 13.0)
        return s

    return encode, decode


def _full_codec(extra: bool):
    @wp.func
    def encode(g: GBuffer, i: wp.int32, s: Surface):
        n = usable_normal(s.normal)
        g.full_normal[i] = wp.vec4(n[0], n[1], n[2], bits_float(wp.uint32(s.model + s.flags)))
        rough = s.roughness
        if s.model == MODEL_PHONG or s.model == MODEL_BLINN_PHONG:
            rough = s.shininess
        g.full_albedo[i] = wp.vec4(s.albedo[0], s.albedo[1], s.albedo[2], rough)
        if wp.static(extra):
            if s.model == MODEL_GGX:
                g.full_extra[i] = wp.vec4(s.metallic, 0.0, 0.0, s.occlusion)
            else:
                g.full_extra[i] = wp.vec4(s.specular[0], s.specular[1], s.specular[2], s.occlusion)

    @wp.func
    def decode(g: GBuffer, i: wp.int32):
        s = Surface()
        n = g.full_normal[i]
        head = wp.int32(float_bits(n[3]))
        s.model = head & 3
        s.flags = head & 252
        s.normal = wp.vec3(n[0], n[1], n[2])
        a = g.full_albedo[i]
        s.albedo = wp.vec3(a[0], a[1], a[2])
        s.roughness = a[3]
        s.shininess = a[3]
        s.occlusion = 1.0
        if wp.static(extra):
            e = g.full_extra[i]
            s.occlusion = e[3]
            if s.model == MODEL_GGX:
                s.metallic = e[0]
            else:
                s.specular = wp.vec3(e[0], e[1], e[2])
        return s

    return encode, decode
