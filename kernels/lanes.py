"""What the lanes of a warp see of each other, memory that those of a block share, and steps of blocks in one launch.

On the CPU a warp and a block are one lane. Functions only.
"""

from __future__ import annotations

import warp as wp

from .structs import BloomLevel

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
    return __shfl_sync(0xffffffffu, value, (threadIdx.x + offset) & 31);
#else
    return value;
#endif
""")
def word_from_lane(value: wp.uint64, offset: wp.int32) -> wp.uint64:
    """`from_lane` of a double word."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ wp::uint64 words[4352];
    return wp::array_t<wp::uint64>(words, 4352);
#else
    return scratch;
#endif
""")
def block_memory(scratch: wp.array[wp.uint64]) -> wp.array[wp.uint64]:
    """Memory that the lanes of a block share, 34 KiB, as an array; `block_sync` between stores and loads.

    The CPU, where a block is one lane, uses `scratch` instead, in launches of one thread.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int place = __cvta_generic_to_shared(memory.data + to);
    asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" : : "r"(place), "l"(words.data + source) : "memory");
#else
    memory.data[to] = words.data[source];
#endif
""")
def copy_to_block(words: wp.array[wp.uint64], source: wp.int32, memory: wp.array[wp.uint64], to: wp.int32):
    """Copy a double word to the block's memory; it is there after `wait_for_copies` and `block_sync`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("cp.async.wait_all;" : : : "memory");
#endif
""")
def wait_for_copies():
    """Wait for all that the lane has called `copy_to_block` for."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int sink[32];
    const unsigned int place = __cvta_generic_to_shared(sink + (threadIdx.x & 31));
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" : : "r"(place), "l"(words.data + index) : "memory");
#endif
""")
def touch(words: wp.array[wp.uint64], index: wp.int32):
    """Have the 32 bytes around a double word fetched into the L1 cache; no register waits for them.

    The prefetching instruction is but a hint. A copy of four bytes to where nobody looks is none.
    """
    ...


@wp.func_native("""
    auto rows = levels;
#if defined(__CUDA_ARCH__)
    __shared__ wp::uint64 words[32 * sizeof(*levels.data) / sizeof(wp::uint64)];
    rows.data = reinterpret_cast<decltype(rows.data)>(words);
    const int lane = threadIdx.x, lanes = blockDim.x;
#else
    rows.data = reinterpret_cast<decltype(rows.data)>(scratch.data + 4352);
    const int lane = 0, lanes = 1;
#endif
    for (int k = lane; k < count; k += lanes)
        rows.data[k] = rows.data[k + 16] = levels.data[first + k];
    return rows;
""")
def block_levels(
    levels: wp.array[BloomLevel], first: wp.int32, count: wp.int32, scratch: wp.array[wp.uint64]
) -> wp.array[BloomLevel]:
    """Two copies of some rows, at most 16, that a block's lanes share, one from 0 on and one from 16 on.

    All lanes must call it, then `block_sync`; lane k writes row k. The CPU has them behind the block's memory.
    """
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
        // An acquiring load drops what the L1 cache holds: from the blocks at work beside, were it to poll.
        while (true) {
            asm volatile("ld.relaxed.gpu.global.s32 %0, [%1];" : "=r"(seen) : "l"(done) : "memory");
            if (seen >= count)
                break;
            __nanosleep(40);
        }
        asm volatile("ld.acquire.gpu.global.s32 %0, [%1];" : "=r"(seen) : "l"(done) : "memory");
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
        // Nobody waits for what the last step wrote but the launch's end.
        asm volatile("atom.relaxed.gpu.global.add.s32 %0, [%1], 1;" : "=r"(before) : "l"(done) : "memory");
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
