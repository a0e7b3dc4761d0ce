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

__all__ = ["Spread", "frames", "replays", "warm_up"]

#: Replays of a price: at least so many, then until so many milliseconds, and no more than so many.
LEAST, ENOUGH_MS, MOST = 5, 6.0, 16
#: A frame that takes longer than this is replayed once, on CUDA and on the CPU [ms].
SLOW_MS = (20.0, 300.0)
#: Copies that keep a device busy while the host queues a frame: a millisecond and a half of a fast card's.
BUSY_BYTES, BUSY_COPIES = 1 << 28, 12
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


def frames(device: wp.Device, count: int, prepare: Callable[[int], Any], render: Callable[[], Any]) -> list[float]:
    """Time frames that differ [ms].

    Args:
        device: Where they are rendered.
        count: How many.
        prepare: Called with a frame's number before its clock starts: moves the scene.
        render: Renders it: uploads and launches.
    """
    values = []
    events, block, other = [], None, None
    if device.is_cuda:
        block = wp.zeros(BUSY_BYTES, dtype=wp.uint8, device=device)
        other = wp.empty_like(block)
        events = [wp.Event(device, enable_timing=True) for _ in range(2)]
    for k in range(count):
        prepare(k)
        for _ in range(BUSY_COPIES if events else 0):
            wp.copy(other, block)
        if events:
            wp.get_stream(device).record_event(events[0])
        begun = time.perf_counter()
        render()
        values.append((time.perf_counter() - begun) * 1e3)
        if events:
            wp.get_stream(device).record_event(events[1])
            wp.synchronize_device(device)
            values[-1] = wp.get_event_elapsed_time(*events)
    return values
