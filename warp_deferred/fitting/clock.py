"""Times of frames: device time on CUDA, wall-clock time on the CPU.

Two kinds. `replays`: the same frame again and again, queued without waiting, for prices. `frames`: frames that differ,
with what the host uploads for each; on CUDA the device is kept busy while the host queues one, so that it never waits
for the host between the two events.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import warp as wp

from ..program import Program

__all__ = ["SLOW_MS", "Spread", "busy_blocks", "frames", "replays", "warm_up"]

#: Replays of a price: at least so many, then until so many milliseconds, and no more than so many.
LEAST, ENOUGH_MS, MOST = 5, 6.0, 16
#: A frame that takes longer than this is replayed once, on CUDA and on the CPU [ms].
SLOW_MS = (20.0, 300.0)
#: Copies that keep a device busy while the host queues a frame: first a millisecond and a half of a fast card's, then
#: twice as many as often as the host was slower.
BUSY_BYTES, BUSY_COPIES, MOST_COPIES = 1 << 28, 12, 1 << 10
#: Seconds until clocks have risen.
WARM_UP_S = 0.15


@dataclasses.dataclass(frozen=True)
class Spread:
    """Median and spread of repeated measurements [ms].

    Attributes:
        median: Median.
        p5: 5th percentile.
        p95: 95th percentile.
        count: Number of measurements.
    """

    median: float
    p5: float
    p95: float
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """Summarise measurements [ms]."""
        array = np.asarray(list(values), np.float64)
        low, middle, high = np.percentile(array, (5, 50, 95))
        return cls(float(middle), float(low), float(high), len(array))

    def __str__(self) -> str:
        return f"{self.median:.3g} ms ({self.p5:.3g} to {self.p95:.3g})"


def warm_up(program: Program) -> None:
    """Replay a frame until the device's clocks have risen; a single time on the CPU."""
    begun = time.perf_counter()
    while True:
        program.replay()
        wp.synchronize_device(program.device)
        if program.device.is_cpu or time.perf_counter() - begun > WARM_UP_S:
            return


def replays(program: Program) -> Spread:
    """Time a frame that was rendered before, by replaying it."""
    device = program.device
    once_ms = _once(program)
    if once_ms > SLOW_MS[device.is_cpu]:
        return Spread.of([once_ms])
    if device.is_cpu:
        values: list[float] = []
        while len(values) < LEAST or (sum(values) < 20.0 * ENOUGH_MS and len(values) < MOST):
            values.append(_once(program))
        return Spread.of(values)
    count = int(min(MOST, max(LEAST, ENOUGH_MS / max(once_ms, 1e-3))))
    events = [wp.Event(device, enable_timing=True) for _ in range(count + 1)]
    # One ahead, so that the device does not wait for the host at the first.
    program.replay()
    stream = wp.get_stream(device)
    for event in events:
        stream.record_event(event)
        if event is not events[-1]:
            program.replay()
    wp.synchronize_device(device)
    return Spread.of(wp.get_event_elapsed_time(a, b) for a, b in itertools.pairwise(events))


def _once(program: Program) -> float:
    """Replay and wait; wall-clock time [ms]."""
    wp.synchronize_device(program.device)
    begun = time.perf_counter()
    program.replay()
    wp.synchronize_device(program.device)
    return (time.perf_counter() - begun) * 1e3


def busy_blocks(device: wp.Device) -> tuple[wp.array, wp.array]:
    """Memory that is copied to keep a device busy: to be made once, for it is large."""
    block = wp.zeros(BUSY_BYTES, dtype=wp.uint8, device=device)
    return block, wp.empty_like(block)


def frames(
    device: wp.Device,
    count: int,
    prepare: Callable[[int], Any],
    render: Callable[[], Any],
    blocks: tuple[wp.array, wp.array] | None = None,
) -> list[float]:
    """Time frames that differ [ms].

    On CUDA a frame does not count that the device began before the host had queued it, for it may have waited.

    Args:
        device: Where they are rendered.
        count: How many that count.
        prepare: Called with a frame's number, 0, 1, ..., before its clock starts: moves the scene.
        render: Renders it: uploads and launches.
        blocks: Of `busy_blocks`, on CUDA; made here if left out.
    """
    if not device.is_cuda:
        return [_host_frame(k, prepare, render) for k in range(count)]
    values: list[float] = []
    (block, other), copies = blocks or busy_blocks(device), BUSY_COPIES
    stream = wp.get_stream(device)
    begin, end = (wp.Event(device, enable_timing=True) for _ in range(2))
    numbers = itertools.count()
    while len(values) < count:
        prepare(next(numbers))
        for _ in range(copies):
            wp.copy(other, block)
        stream.record_event(begin)
        render()
        late = begin.is_complete and copies < MOST_COPIES
        stream.record_event(end)
        wp.synchronize_device(device)
        if late:
            copies *= 2
        else:
            values.append(wp.get_event_elapsed_time(begin, end))
    return values


def _host_frame(k: int, prepare: Callable[[int], Any], render: Callable[[], Any]) -> float:
    prepare(k)
    begun = time.perf_counter()
    render()
    return (time.perf_counter() - begun) * 1e3
