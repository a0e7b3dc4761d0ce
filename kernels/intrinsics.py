"""What Warp's language has no word for: bit casts, whole-vector loads, memory shared by a block.

On the CPU a block is one lane. Functions only.
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
    return __fmaf_rn(a, b, c);
#else
    return __builtin_fmaf(a, b, c);
#endif
""")
def fma(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """Product and sum, a b + c, rounded once: one instruction on CUDA, not two, and the same bits on every device."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(-a, b, c);
#else
    return __builtin_fmaf(-a, b, c);
#endif
""")
def fnma(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """Difference c - a b, as `fma`; Warp's own minus sign is a subtraction from 0, one instruction more."""
    ...


@wp.func_native("""
    float value;
#if defined(__CUDA_ARCH__)
    asm("fma.rn.sat.f32 %0, %1, %2, %3;" : "=f"(value) : "f"(a), "f"(b), "f"(c));
#else
    value = __builtin_fmaf(a, b, c);
    value = value > 0.0f ? (value < 1.0f ? value : 1.0f) : 0.0f;
#endif
    return value;
""")
def saturated_fma(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """`fma` clamped to [0, 1], NaN to 0, at no cost on CUDA."""
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


@wp.func_native("return values.data[index];")
def load_float(values: wp.array[wp.float32], index: wp.int32) -> wp.float32:
    """Load a float of a dense array by an index >= 0; Warp's own load adds a length and a stride: 6 instructions."""
    ...


@wp.func_native("return present ? (second ? others.data : values.data)[index] : INFINITY;")
def load_either(
    values: wp.array[wp.float32], others: wp.array[wp.float32], second: wp.bool, index: wp.int32, present: wp.bool
) -> wp.float32:
    """Load a float of one of two arrays as `load_float` does; +inf, without an access, where it is not present."""
    ...


@wp.func_native("return values.data[index];")
def load_word(values: wp.array[wp.uint32], index: wp.int32) -> wp.uint32:
    """Load a word of a dense array by an index >= 0, as `load_float` does."""
    ...


@wp.func_native("return present ? values.data[index] : otherwise;")
def load_word_or(values: wp.array[wp.uint32], index: wp.int32, present: wp.bool, otherwise: wp.uint32) -> wp.uint32:
    """`load_word`, or another word, without an access, where it is not present."""
    ...


@wp.func_native("return values.data[index];")
def load_double_word(values: wp.array[wp.uint64], index: wp.int32) -> wp.uint64:
    """Load a double word of a dense array by an index >= 0, as `load_float` does."""
    ...


@wp.func_native("values.data[index] = word;")
def store_double_word(values: wp.array[wp.uint64], index: wp.int32, word: wp.uint64):
    """Store a double word into a dense array at an index >= 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    reinterpret_cast<uint4*>(values.data + index)[0] = make_uint4(0, 0, 0, 0);
#else
    for (int k = 0; k < 4; ++k)
        values.data[index + k] = 0;
#endif
""")
def store_zeros(values: wp.array[wp.uint32], index: wp.int32):
    """Clear four words in one access; the index is a multiple of four."""
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
#if defined(__CUDA_ARCH__)
    float r, g, b;
    asm("{.reg .b32 lo, hi; .reg .b16 x, y, z, w; mov.b64 {lo, hi}, %3; mov.b32 {x, y}, lo; mov.b32 {z, w}, hi;"
        "cvt.f32.f16 %0, x; cvt.f32.f16 %1, y; cvt.f32.f16 %2, z;}" : "=f"(r), "=f"(g), "=f"(b) : "l"(word));
    return wp::vec_t<3, wp::float32>(r, g, b);
#else
    wp::half x, y, z;
    x.u = static_cast<unsigned short>(word);
    y.u = static_cast<unsigned short>(word >> 16);
    z.u = static_cast<unsigned short>(word >> 32);
    return wp::vec_t<3, wp::float32>(wp::float32(x), wp::float32(y), wp::float32(z));
#endif
""")
def unpack_half3(word: wp.uint64) -> wp.vec3:
    """First three components of a half4."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float result;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
    return result;
#else
    return 1.0f / value;
#endif
""")
def fast_reciprocal(value: wp.float32) -> wp.float32:
    """1 / value to within an ulp, in one instruction on CUDA in place of eight."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float result;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
    return result;
#else
    return 1.0f / ::sqrtf(value);
#endif
""")
def fast_inverse_root(value: wp.float32) -> wp.float32:
    """1 / square root of a value > 0 to within 2 ulp, in one instruction on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float result;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
    return result;
#else
    return ::sqrtf(value);
#endif
""")
def fast_root(value: wp.float32) -> wp.float32:
    """Square root of a value >= 0 to within 2 ulp, in one or two instructions on CUDA in place of eight."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return wp::vec_t<4, wp::float32>(__fmaf_rn(value[0], weight, sum[0]), __fmaf_rn(value[1], weight, sum[1]),
        __fmaf_rn(value[2], weight, sum[2]), sum[3] + weight);
#else
    return wp::vec_t<4, wp::float32>(sum[0] + value[0] * weight, sum[1] + value[1] * weight,
        sum[2] + value[2] * weight, sum[3] + weight);
#endif
""")
def add_weighted(sum: wp.vec4, value: wp.vec4, weight: wp.float32) -> wp.vec4:
    """Sum of weighted colours and, last, of weights, with one more; multiply-adds round once on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def block_sync():
    """Wait for all lanes of the block; every lane must arrive."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    return value;
#elif __CUDA_ARCH__ >= 800
    return __uint_as_float(__reduce_max_sync(0xffffffffu, __float_as_uint(value)));
#else
    float largest = value;
    for (int step = 16; step > 0; step >>= 1)
        largest = ::fmaxf(largest, __shfl_xor_sync(0xffffffffu, largest, step));
    return largest;
#endif
""")
def warp_largest(value: wp.float32) -> wp.float32:
    """Largest of the values >= 0 of a warp's 32 lanes, all of which must arrive; the CPU's one lane's own."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return blockDim.x;
#else
    return 1;
#endif
""")
def block_width() -> wp.int32:
    """Lanes of the block; 1 on the CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return false;
#else
    return true;
#endif
""")
def block_is_lane() -> wp.bool:
    """Whether blocks have one lane, as `block_width` tells, but known to the compiler: the other branch is left out."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(value) != 0;
#else
    return value;
#endif
""")
def block_any(value: wp.bool) -> wp.bool:
    """Whether the value is true in any lane of the block; every lane must arrive, as for `block_sync`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int4 words[320];
    if (storing) {
        words[index] = make_int4(value[0], value[1], value[2], value[3]);
        return value;
    }
    const int4 v = words[index];
    return wp::vec_t<4, wp::int32>(v.x, v.y, v.z, v.w);
#else
    if (storing)
        scratch.data[index] = value;
    return scratch.data[index];
#endif
""")
def shared_words(scratch: wp.array[wp.vec4i], storing: wp.bool, index: wp.int32, value: wp.vec4i) -> wp.vec4i:
    """Store to, or read from, 5 KiB of memory that the block's lanes share; sync between the two.

    The CPU, where a block is one lane, uses `scratch` instead, an array of at least 320 elements.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned int staged[1792];
    if (storing) {
        staged[index] = value;
        return value;
    }
    return staged[index];
#else
    return value;
#endif
""")
def shared_single(storing: wp.bool, index: wp.int32, value: wp.uint32) -> wp.uint32:
    """Store to, or read from, 1792 words, 7 KiB, that the block's lanes share; else as `shared_pixels`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return static_cast<int>(__dp4a(word, weights, 0u));
#else
    int sum = 0;
    for (int shift = 0; shift < 32; shift += 8)
        sum += static_cast<int>((word >> shift) & 255u) * static_cast<int>((weights >> shift) & 255u);
    return sum;
#endif
""")
def weigh_bytes(word: wp.uint32, weights: wp.uint32) -> wp.int32:
    """Sum of the four bytes of a word, each times a byte of another one; one instruction on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return static_cast<int>(__dp4a(word, weights, static_cast<unsigned int>(sum)));
#else
    for (int shift = 0; shift < 32; shift += 8)
        sum += static_cast<int>((word >> shift) & 255u) * static_cast<int>((weights >> shift) & 255u);
    return sum;
#endif
""")
def add_weighed(word: wp.uint32, weights: wp.uint32, sum: wp.int32) -> wp.int32:
    """Add the four bytes of a word, each times a byte of another one, to a sum >= 0; one instruction on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 1.055f * __powf(value, 0.41666667f) - 0.055f;
#else
    const float r2 = ::sqrtf(value), r4 = ::sqrtf(r2), r8 = ::sqrtf(r4);
    return 0.65490442f * r2 + 0.68654974f * r4 - 0.31662542f * r8 - 0.02034844f * value - 0.00451258f;
#endif
""")
def srgb_guess(value: wp.float32) -> wp.float32:
    """Roughly the sRGB code / 255 of a value above 0.0031308: by the fast power on CUDA, elsewhere by roots alone.

    The roots' factors are a least-squares fit of ours, within 0.0083 codes; the power is within 0.001.
    """
    ...
