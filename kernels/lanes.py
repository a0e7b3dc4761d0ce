"""What the lanes of a warp see of each other, and memory that those of a block share, for double words.

On the CPU a warp and a block are one lane. Functions only.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def warp_width() -> wp.int32:
    """Lanes that run in step, a constant of the device: 32; 1 on the CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int lane = (threadIdx.x + offset) & 31;
    return wp::vec_t<4, wp::float32>(
        __shfl_sync(0xffffffffu, value[0], lane), __shfl_sync(0xffffffffu, value[1], lane),
        __shfl_sync(0xffffffffu, value[2], lane), __shfl_sync(0xffffffffu, value[3], lane)
    );
#else
    return value;
#endif
""")
def from_lane(value: wp.vec4, offset: wp.int32) -> wp.vec4:
    """Value of the lane `offset` further on in the warp, around its end; all its lanes must call it.

    The CPU, where a warp is one lane, gives `value` back.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
""")
def any_lane(flag: wp.bool) -> wp.bool:
    """Whether the flag is set in any lane of the warp; all its lanes must call it."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ wp::uint64 words[128];
    if (storing) {
        words[index] = value;
        return value;
    }
    return words[index];
#else
    if (storing)
        scratch.data[base + index] = value;
    return scratch.data[base + index];
#endif
""")
def shared_double_words(
    scratch: wp.array[wp.uint64], storing: wp.bool, base: wp.int32, index: wp.int32, value: wp.uint64
) -> wp.uint64:
    """Store to, or read from, 1 KiB of memory that the block's lanes share; sync between the two.

    The CPU, where a block is one lane, uses 128 elements of `scratch` from `base` on instead.
    """
    ...
