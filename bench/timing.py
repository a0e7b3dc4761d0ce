"""Times of a program's passes: device time from graph replays on CUDA, wall-clock time on the CPU.

Replays are queued without waiting for one another, so that the device never idles between them and no launch from the
host is in the figure; short programs are replayed several times between two events, since an event's clock has a
resolution of half a microsecond. Warm-up is outside: it loads, fills caches and lets clocks rise.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_deferred.checks import check_choice, check_count, input_error
from warp_deferred.program import SAMPLE, Program

__all__ = [
    "REPEATS", "Timing", "copy_bandwidth", "run_until", "sample_sections", "time_calls", "time_launches",
    "time_moving", "time_passes", "time_program", "warm_up",
]  # fmt: skip

REPEATS = 50
#: Seconds a warm-up takes at least, on CUDA.
WARM_UP_S = 0.2
#: Milliseconds between two events at least, as far as `MAX_BATCH` replays make them.
BATCH_MS = 1.0
MAX_BATCH = 20
#: Seconds after which a measurement on the CPU stops, once it has `MIN_REPEATS`.
CPU_BUDGET_S = 10.0
MIN_REPEATS = 3
#: Calls before the first that counts, in `time_moving`.
WARM_CALLS = 2
#: Copies that keep a device busy while the host queues a frame: some milliseconds of them.
BUSY_BYTES, BUSY_COPIES = 1 << 28, 48


@dataclasses.dataclass(frozen=True)
class Timing:
    """Median and spread of repeated measurements [ms].

    Attributes:
        median: Median.
        p5: 5th percentile.
        p95: 95th percentile.
        repeats: Number of measurements.
    """

    median: float
    p5: float
    p95: float
    repeats: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Timing:
        """Summarise measurements in milliseconds."""
        low, middle, high = np.percentile(np.asarray(values, np.float64), (5, 50, 95))
        return cls(float(middle), float(low), float(high), len(values))

    def times(self, count: int) -> Timing:
        """Time of so many runs, had all of them been as the one that was measured."""
        return Timing(count * self.median, count * self.p5, count * self.p95, self.repeats)

    def metrics(self, name: str) -> dict[str, float]:
        """Dotted metrics: `name.ms`, `name.ms_p5`, `name.ms_p95`, to 10 ns, and `name.repeats`."""
        return {
            f"{name}.ms": round(self.median, 5),
            f"{name}.ms_p5": round(self.p5, 5),
            f"{name}.ms_p95": round(self.p95, 5),
            f"{name}.repeats": self.repeats,
        }


def _selected(program: Program, sections: Sequence[str] | None) -> tuple[int, int]:
    """First and last + 1 of the passes asked for, which must lie side by side in frame order."""
    names = [section.name for section in program.sections]
    if sections is None:
        return 0, len(names)
    if not sections:
        raise input_error("time_program.sections", "at least one pass", "<none>", "leave it out for all passes")
    places = [names.index(check_choice("time_program.sections", name, names)) for name in sections]
    if places != list(range(places[0], places[0] + len(places))):
        raise input_error(
            "time_program.sections",
            f"passes side by side in frame order ({', '.join(names)})",
            list(sections),
            "buffers of passes left out between them would be stale",
        )
    return places[0], places[-1] + 1


def run_until(program: Program, name: str) -> None:
    """Run the passes up to and including `name` once, so that what it wrote can be read back.

    Later passes may lay their buffers over those of earlier ones; after a whole frame only outputs are sure to be left.
    """
    _, stop = _selected(program, [name])
    program.run(stop)


def sample_sections(program: Program) -> list[str]:
    """Names of the passes that run once a sample, in frame order; none where a frame takes one sample a pixel."""
    return [s.name for s in program.sections if s.part == SAMPLE] if program.samples > 1 else []


def time_program(program: Program, sections: Sequence[str] | None = None, *, repeats: int = REPEATS) -> Timing:
    """Time a whole frame, all its samples included, or passes that follow one another, as one graph.

    Args:
        program: A plan's program, after its first frame (views and lights are uploaded).
        sections: Names of passes that lie side by side, in frame order; all of them if left out. Those that run once
            a sample are timed for one sample; `sample_sections` names them.
        repeats: Measurements.

    Returns:
        Time of one frame, or of one replay of these passes [ms].

    Raises:
        InputError: If there is no such pass, or the passes do not lie side by side, or some of them run once a sample
            and others once a frame.
    """
    check_count("time_program.repeats", repeats, 1, 100_000)
    start, stop = _selected(program, sections)
    wanted = program.sections[start:stop]
    if len(wanted) == len(program.sections):
        measure = _device_times if program.device.is_cuda else lambda _, run, count: _host_times(run, count)
        return Timing.of(measure(program.device, program.replay, repeats))
    if program.samples > 1 and len({section.part for section in wanted}) > 1:
        raise input_error(
            "time_program.sections",
            f"passes that all run once a frame or all once a sample ({', '.join(sample_sections(program))})",
            list(sections or ()),
            "leave it out to time the whole frame",
        )
    program.run(start)

    def run() -> None:
        for section in wanted:
            program.run_section(section)

    if not program.device.is_cuda:
        return Timing.of(_host_times(run, repeats))
    graph = _capture(program.device, run)
    return Timing.of(_device_times(program.device, lambda: wp.capture_launch(graph), repeats))


def time_launches(
    device: wp.Device, run: Callable[[], Any], *, repeats: int = REPEATS, captured: bool = True
) -> Timing:
    """Time launches that are not a program's: as one graph on CUDA, wall-clock time on the CPU [ms].

    Args:
        device: Device of all launches.
        run: Issues them; what it allocates on its first call is allocated before it is captured.
        repeats: Measurements.
        captured: Whether to capture them on CUDA; else they are issued anew each time, and the device waits for the
            host where that is slower.
    """
    check_count("time_launches.repeats", repeats, 1, 100_000)
    if not device.is_cuda:
        return Timing.of(_host_times(run, repeats))
    run()  # modules are loaded by a first launch, which a capture does not allow
    wp.synchronize_device(device)
    if not captured:
        return Timing.of(_device_times(device, run, repeats))
    graph = _capture(device, run)
    return Timing.of(_device_times(device, lambda: wp.capture_launch(graph), repeats))


def time_passes(program: Program, *, repeats: int = REPEATS) -> dict[str, Timing]:
    """Time every pass as a graph of its own, in frame order, so that caches are as a frame leaves them.

    The sum exceeds the whole frame's graph by what starting a graph costs, about 2 µs a pass. Passes that run once a
    sample are timed for one sample.
    """
    check_count("time_passes.repeats", repeats, 1, 100_000)
    runs = [(s.name, lambda s=s: program.run_section(s)) for s in program.sections]
    if not program.device.is_cuda:
        times: dict[str, list[float]] = {name: [] for name, _ in runs}
        started = time.perf_counter()
        for k in range(repeats + 1):
            for name, run in runs:
                begun = time.perf_counter()
                run()
                if k:  # the first round warms up
                    times[name].append((time.perf_counter() - begun) * 1e3)
            if k >= MIN_REPEATS and time.perf_counter() - started > CPU_BUDGET_S:
                break
        return {name: Timing.of(values) for name, values in times.items()}
    graphs = [_capture(program.device, run) for _, run in runs]
    warm_up(program.device, lambda: [wp.capture_launch(graph) for graph in graphs])
    stream = wp.get_stream(program.device)
    # Rounds ahead of the measured ones keep the host in front of the device.
    for _ in range(3):
        for graph in graphs:
            wp.capture_launch(graph)
    events = [[wp.Event(program.device, enable_timing=True) for _ in range(len(graphs) + 1)] for _ in range(repeats)]
    for row in events:
        stream.record_event(row[0])
        for graph, event in zip(graphs, row[1:], strict=True):
            wp.capture_launch(graph)
            stream.record_event(event)
    wp.synchronize_device(program.device)
    return {
        name: Timing.of([wp.get_event_elapsed_time(row[k], row[k + 1]) for row in events])
        for k, (name, _) in enumerate(runs)
    }


def time_calls(device: wp.Device, call: Callable[[int], Any], count: int, *, ahead: int | None = None) -> Timing:
    """Time host calls that only queue work, such as `render`: wall-clock time of each call [ms].

    The clock stops after every call. A host far ahead of the device is made to wait by a full queue, and the figure
    is then the device's; with `ahead` the device is waited for now and then, outside the clock.

    Args:
        device: Device the calls queue work on.
        call: Function of the call's number.
        count: Calls.
        ahead: Calls after which the device is waited for; only at the end if left out.
    """
    values = []
    for k in range(count):
        begun = time.perf_counter()
        call(k)
        values.append((time.perf_counter() - begun) * 1e3)
        if ahead is not None and (k + 1) % ahead == 0:
            wp.synchronize_device(device)
    wp.synchronize_device(device)
    return Timing.of(values)


def time_moving(device: wp.Device, call: Callable[[int], Any], repeats: int = REPEATS) -> Timing:
    """Time frames each of which differs from the one before, uploads included: device time, wall-clock on the CPU [ms].

    On CUDA the device is kept busy with copies while the host queues the frame, so that it never waits for the host
    between the two events.

    Args:
        device: Device the calls queue work on.
        call: Function of the call's number, which moves the scene and renders it.
        repeats: Measurements.
    """
    check_count("time_moving.repeats", repeats, 1, 100_000)
    values: list[float] = []
    block = wp.zeros(BUSY_BYTES if device.is_cuda else 1, dtype=wp.uint8, device=device)
    other = wp.empty_like(block)
    events = [wp.Event(device, enable_timing=True) for _ in range(2)] if device.is_cuda else []
    started = time.perf_counter()
    for k in range(repeats + WARM_CALLS):
        if events:
            for _ in range(BUSY_COPIES):
                wp.copy(other, block)
            wp.record_event(events[0])
        begun = time.perf_counter()
        call(k)
        value = (time.perf_counter() - begun) * 1e3
        if events:
            wp.record_event(events[1])
            wp.synchronize_device(device)
            value = wp.get_event_elapsed_time(*events)
        if k >= WARM_CALLS:
            values.append(value)
        if device.is_cpu and len(values) >= MIN_REPEATS and time.perf_counter() - started > CPU_BUDGET_S:
            break
    return Timing.of(values)


def copy_bandwidth(device: wp.Device, *, repeats: int = 20, size: int | None = None) -> float:
    """Measure a copy within the device's memory [bytes per second], bytes read and bytes written both counted.

    It is the yardstick of a memory floor: what a pass must move, over this, is the least time it could take.

    Args:
        device: The device.
        repeats: Measurements, the median of which counts.
        size: Bytes of the block; well past any cache if left out.
    """
    count = size or (1 << 30 if device.is_cuda else 1 << 26)
    source = wp.full(count // 4, 1.0, dtype=wp.float32, device=device)
    target = wp.zeros(count // 4, dtype=wp.float32, device=device)
    measure = _device_times if device.is_cuda else lambda _, run, n: _host_times(run, n)
    return 2.0 * source.capacity / (Timing.of(measure(device, lambda: wp.copy(target, source), repeats)).median * 1e-3)


def _capture(device: wp.Device, run: Callable[[], Any]) -> Any:
    with wp.ScopedCapture(device=device, force_module_load=False) as capture:
        run()
    return capture.graph


def warm_up(device: wp.Device, run: Callable[[], Any]) -> float:
    """Run for a while, so that caches are full and clocks are up; return the seconds one run takes, roughly."""
    run()
    wp.synchronize_device(device)
    started, count = time.perf_counter(), 0
    while count < 3 or time.perf_counter() - started < WARM_UP_S:
        for _ in range(5):
            run()
        count += 5
        wp.synchronize_device(device)
    return (time.perf_counter() - started) / count


def _device_times(device: wp.Device, run: Callable[[], Any], repeats: int) -> list[float]:
    once_ms = warm_up(device, run) * 1e3
    batch = max(1, min(MAX_BATCH, math.ceil(BATCH_MS / max(once_ms, 1e-6))))
    stream = wp.get_stream(device)
    events = [wp.Event(device, enable_timing=True) for _ in range(repeats + 1)]
    run()
    stream.record_event(events[0])
    for event in events[1:]:
        for _ in range(batch):
            run()
        stream.record_event(event)
    wp.synchronize_device(device)
    return [wp.get_event_elapsed_time(a, b) / batch for a, b in itertools.pairwise(events)]


def _host_times(run: Callable[[], Any], repeats: int) -> list[float]:
    run()
    values: list[float] = []
    started = time.perf_counter()
    while len(values) < repeats:
        begun = time.perf_counter()
        run()
        values.append((time.perf_counter() - begun) * 1e3)
        if len(values) >= MIN_REPEATS and time.perf_counter() - started > CPU_BUDGET_S:
            break
    return values
