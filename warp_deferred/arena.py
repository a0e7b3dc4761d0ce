"""Where a plan's transient buffers lie: one arena, shared by those whose lives do not overlap.

A life is the stretch of passes from a buffer's first writer to its last reader. The passes of the sample part run once
a sample, so what comes into that part from before lives to its end, and what is carried from sample to sample lives
from its start. Passes that run side by side share no memory.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import warp as wp

from .passes.base import Buffer, Pass, Request
from .passes.image import all_reads, all_writes

__all__ = ["ALIGNMENT", "Arena", "lay_out", "run_together"]

ALIGNMENT = 256


@dataclasses.dataclass(frozen=True)
class Arena:
    """Buffers of a plan.

    Attributes:
        buffers: Name -> buffer, of all that have memory in the plan.
        sizes: Name -> bytes the buffer needs by itself.
        places: Name -> offset in the arena, of the transient ones.
        total: Bytes of the arena.
    """

    buffers: dict[str, Buffer]
    sizes: dict[str, int]
    places: dict[str, int]
    total: int


def run_together(stages: Sequence[Pass], loop: range) -> list[int]:
    """For each pass, how many of those right behind it run beside it: those it names, as far as they share nothing."""
    counts = []
    for k, stage in enumerate(stages):
        reads, writes, count = set(all_reads(stage)), set(all_writes(stage)), 0
        for other, follower in enumerate(stages[k + 1 :], k + 1):
            clash = writes & set(all_reads(follower)) or set(all_writes(follower)) & (reads | writes)
            if follower.name not in stage.beside or clash or (k in loop) != (other in loop):
                break
            count += 1
        counts.append(count)
    return counts


def lay_out(stages: Sequence[Pass], request: Request, loop: range, together: Sequence[int] | None = None) -> Arena:
    """Place buffers.

    Args:
        stages: The passes in the order they run.
        request: Its outputs have memory of their own; it says whether the others may share theirs.
        loop: Indices of the passes that run once a sample, where there are several; else empty.
        together: For each pass the number of those behind it that run beside it; none if left out.
    """
    # First and last index of what runs at the same time as each pass.
    spans = [(k, k) for k in range(len(stages))]
    for k, count in enumerate(together or ()):
        for j in range(k, k + count + 1) if count else ():
            spans[j] = (k, k + count)
    buffers: dict[str, Buffer] = {}
    born: dict[str, int] = {}
    dies: dict[str, int] = {}
    for k, stage in enumerate(stages):
        for name, buffer in all_writes(stage).items():
            if buffer.dtype is None:
                continue
            buffers.setdefault(name, buffer)
            start, end = spans[k]
            first = loop.start if buffer.carried and k in loop else max(0, start - buffer.early)
            born[name] = min(born.get(name, first), first)
            dies[name] = max(dies.get(name, end), len(stages) if buffer.lasting else end)
            if buffer.carried and k in loop:
                dies[name] = max(dies[name], loop.stop - 1)
            if buffer.persistent:
                born[name], dies[name] = 0, len(stages)
        for name in all_reads(stage):
            # Written before the samples and read in one of them: the next sample reads it again.
            again = k in loop and born.get(name, k) < loop.start
            dies[name] = max(dies.get(name, k), loop.stop - 1 if again else spans[k][1])
    sizes = {n: _padded(b.count * wp.types.type_size_in_bytes(b.dtype)) for n, b in buffers.items()}
    transient = [n for n in buffers if n not in request.outputs]
    if not request.share_memory:
        born, dies = dict.fromkeys(buffers, 0), dict.fromkeys(buffers, len(stages))
    places, total = _place(transient, sizes, born, dies)
    return Arena(buffers, sizes, places, total)


def _padded(size: int) -> int:
    return -(-max(size, 1) // ALIGNMENT) * ALIGNMENT


def _place(
    names: list[str], sizes: dict[str, int], born: dict[str, int], dies: dict[str, int]
) -> tuple[dict[str, int], int]:
    """Offsets in one arena, largest first, each at the lowest place free for its whole life."""
    places: dict[str, int] = {}
    total = 0
    for name in sorted(names, key=lambda n: -sizes[n]):
        overlapping = sorted(
            (places[o], places[o] + sizes[o]) for o in places if born[o] <= dies[name] and born[name] <= dies[o]
        )
        offset = 0
        for low, high in overlapping:
            if offset + sizes[name] <= low:
                break
            offset = max(offset, high)
        places[name] = offset
        total = max(total, offset + sizes[name])
    return places, total
