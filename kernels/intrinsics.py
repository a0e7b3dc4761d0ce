"""What Warp's language has no word for: bit casts, whole-vector loads, and lanes of a warp working together.

On the CPU a warp is one lane: `ballot` sees one bit, `shuffle` returns the lane's own value. Functions only.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func_native("return *reinterpret_cast<wp::uint32*>(&value);")
def float_bits(value: wp.float32) -> wp.uint32:
    """Reinterpret a float's bits as an integer; monotone for values >= 0."""
    ...


@wp.func_native("return *reinterpret_cast<wp::float32*>(&bits);")
def bits_float(bits: wp.uint32) -> wp.float32:
    """Reinterpret an integer's bits as a float."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: wp.uint32) -> wp.int32:
    """Index of the lowest set bit; bits must not be 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def warp_width() -> wp.int32:
    """Lanes that work together."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, predicate != 0);
#else
    return predicate != 0 ? 1u : 0u;
#endif
""")
def ballot(predicate: wp.int32) -> wp.uint32:
    """One bit a lane: where the predicate is not 0. Every lane of the warp must arrive."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;
#endif
""")
def shuffle(value: wp.int32, lane: wp.int32) -> wp.int32:
    """Value of another lane. Every lane of the warp must arrive."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = reinterpret_cast<const float4*>(values.data)[index];
    return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
    return values.data[index];
#endif
""")
def load_vec4(values: wp.array[wp.vec4], index: wp.int32) -> wp.vec4:
    """Load four floats in one access; Warp's own load of a vector takes one a component."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int4 v = reinterpret_cast<const int4*>(values.data)[index];
    return wp::vec_t<4, wp::int32>(v.x, v.y, v.z, v.w);
#else
    return values.data[index];
#endif
""")
def load_vec4i(values: wp.array[wp.vec4i], index: wp.int32) -> wp.vec4i:
    """Load four integers in one access."""
    ...


@wp.func_native("""
    const wp::half x(r), y(g), z(b), w(1.0f);
    return static_cast<wp::uint64>(x.u) | (static_cast<wp::uint64>(y.u) << 16) | (static_cast<wp::uint64>(z.u) << 32)
        | (static_cast<wp::uint64>(w.u) << 48);
""")
def pack_half4(r: wp.float32, g: wp.float32, b: wp.float32) -> wp.uint64:
    """Three floats and 1 as half4 in one word; the caller clamps to half's range."""
    ...


@wp.func_native("""
    wp::half x, y, z;
    x.u = static_cast<unsigned short>(word);
    y.u = static_cast<unsigned short>(word >> 16);
    z.u = static_cast<unsigned short>(word >> 32);
    return wp::vec_t<3, wp::float32>(wp::float32(x), wp::float32(y), wp::float32(z));
""")
def unpack_half3(word: wp.uint64) -> wp.vec3:
    """First three components of a half4."""
    ...
