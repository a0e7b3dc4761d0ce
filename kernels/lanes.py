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
    __shared__ wp::uint64 words[512];
    wp::uint64* own = words + (threadIdx.x >> 6) * 128;
    if (storing) {
        own[index] = value;
        return value;
    }
    return own[index];
#else
    if (storing)
        scratch.data[index] = value;
    return scratch.data[index];
#endif
""")
def shared_double_words(scratch: wp.array[wp.uint64], storing: wp.bool, index: wp.int32, value: wp.uint64) -> wp.uint64:
    """Store to, or read from, 1 KiB of memory that 64 lanes of a block of 256 share; `group_sync` between the two.

    The CPU, where a block is one lane, uses `scratch` instead, at least 128 elements, in launches of one thread.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("bar.sync %0, 64;" : : "r"(1 + (threadIdx.x >> 6)) : "memory");
#endif
""")
def group_sync():
    """Wait for the 64 lanes of a group, all of which must arrive; a block of 256 has four."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int turn;
    if (threadIdx.x == 0)
        turn = atomicAdd(counters.data, 1);
    __syncthreads();
    return turn;
#else
    return block;
#endif
""")
def next_turn(counters: wp.array[wp.int32], block: wp.int32) -> wp.int32:
    """Number of the work that the block takes, once a launch; all its lanes must call it.

    Blocks begin in no promised order, so they are counted by `counters[0]`; the CPU runs `block` after block.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (threadIdx.x == 0 && step > 0) {
        const int* done = counters.data + 32 * step;
        int seen;
        do
            // Orders what follows behind it, and drops what the L1 cache held before.
            asm volatile("ld.acquire.gpu.global.s32 %0, [%1];" : "=r"(seen) : "l"(done) : "memory");
        while (seen < count);
    }
    __syncthreads();
#endif
""")
def wait_for_step(counters: wp.array[wp.int32], step: wp.int32, count: wp.int32):
    """Wait until `count` blocks have finished the step before and what they wrote is visible; all lanes must call it.

    Blocks of step k count in `counters[32 (k + 1)]`, each in a cache line of its own. On the CPU they are done.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (threadIdx.x == 0) {
        int* done = counters.data + 32 * (step + 1);
        if (count > 0) {
            asm volatile("red.release.gpu.global.add.s32 [%0], 1;" : : "l"(done) : "memory");
            return;
        }
        int before;
        asm volatile("atom.acq_rel.gpu.global.add.s32 %0, [%1], 1;" : "=r"(before) : "l"(done) : "memory");
        if (before + 1 == -count)
            for (int k = 0; k < step + 2; ++k)
                counters.data[32 * k] = 0;
    }
#endif
""")
def finish_step(counters: wp.array[wp.int32], step: wp.int32, count: wp.int32):
    """Count the block as done, with all that it wrote; all lanes must call it.

    A negative count stands for that many blocks of the last step: the last one of them sets all counters back to 0.
    """
    ...
