"""Running a plan's launches: recorded once, replayed every frame.

On CUDA the launches are captured into a graph. On the CPU they are recorded as commands and replayed by a few host
threads: pixel passes split into bands of whole blocks, and since launches release the interpreter lock, the bands run
side by side. Warp's CPU atomics are not atomic between host threads, so a launch that counts or bins runs on one.

A frame of several samples a pixel is three parts: what runs once before the samples, what runs in each, and what runs
once after them. Each is a graph, and the middle one is launched as often as there are samples; a counter on the device
tells its kernels which one it is. A frame of one sample is one graph.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import warp as wp

__all__ = ["END", "FIRST", "SAMPLE", "START", "Program", "Section"]

#: Parts of a frame.
START, SAMPLE, END = 0, 1, 2


class _First:
    """Placeholder among a launch's inputs for the first row of a band."""


FIRST = _First()
_pools: dict[int, concurrent.futures.ThreadPoolExecutor] = {}


def _pool(threads: int) -> concurrent.futures.ThreadPoolExecutor:
    if threads not in _pools:
        _pools[threads] = concurrent.futures.ThreadPoolExecutor(threads, thread_name_prefix="warp-deferred")
    return _pools[threads]


class _Command:
    """One launch: issued as it is under capture, recorded once and replayed on the CPU."""

    __slots__ = ("_arguments", "_recorded")

    def __init__(
        self, kernel: Any, dims: list[int], inputs: list[Any], outputs: list[Any], device: Any, block: int
    ) -> None:
        self._arguments = {
            "kernel": kernel, "dim": dims, "inputs": inputs, "outputs": outputs, "device": device, "block_dim": block,
            "record_tape": False,
        }  # fmt: skip
        self._recorded: Any = None

    def record(self) -> None:
        self._recorded = wp.launch(**self._arguments, record_cmd=True)

    def __call__(self) -> None:
        if self._recorded is not None:
            self._recorded.launch()
        else:
            wp.launch(**self._arguments)


@dataclasses.dataclass
class Section:
    """The commands of one pass: steps in order, each a list of callables that may run side by side.

    Attributes:
        name: The pass.
        part: START, SAMPLE or END.
        condition: Device array of one int32; while it is 0 `otherwise` runs in place of the steps.
        otherwise: Called while the section is skipped.
        beside: How many of the sections behind it run at the same time on CUDA.
        leaves_early: Whether its kernels look at the condition themselves: on CUDA they are launched in any case.
    """

    name: str
    part: int
    condition: wp.array | None = None
    otherwise: Callable[[], Any] | None = None
    beside: int = 0
    leaves_early: bool = False
    steps: list[list[Callable[[], Any]]] = dataclasses.field(default_factory=list)

    @property
    def active(self) -> bool | None:
        """Whether the condition holds, read back from the device; None without one."""
        return None if self.condition is None else bool(self.condition.numpy()[0])


class Program:
    """Collects launches pass by pass, then replays them.

    Attributes:
        device: Where it runs.
        threads: Host threads for CPU launches; 1 on CUDA.
        samples: How often the sample part runs in a frame.
        sections: The passes' sections in the order they run, all parts of the frame one after the other.
        kernels: Every kernel launched, for loading ahead and for tests.
    """

    def __init__(self, device: wp.Device, threads: int, samples: int = 1) -> None:
        self.device, self.threads, self.samples = device, max(1, threads), samples
        self.sections: list[Section] = []
        self.kernels: list[tuple[Any, int]] = []
        self._graphs: list[tuple[Any, int]] = []
        self._streams: list[wp.Stream] = []

    def begin(
        self,
        name: str,
        part: int = SAMPLE,
        condition: wp.array | None = None,
        otherwise: Callable[[], Any] | None = None,
        beside: int = 0,
        leaves_early: bool = False,
    ) -> None:
        """Start the section of a pass; parts come in order."""
        self.sections.append(Section(name, part, condition, otherwise, beside, leaves_early))

    def launch(
        self,
        kernel: Any,
        dim: int | Sequence[int],
        inputs: list[Any],
        outputs: list[Any],
        *,
        block_dim: int,
        band: int = 0,
        tiled: bool = False,
        beside: bool = False,
    ) -> None:
        """Add a launch.

        Args:
            kernel: The kernel.
            dim: Launch dimensions; the first one counts rows.
            inputs: Inputs; `FIRST` stands for the number of the band's first row.
            outputs: Outputs.
            block_dim: Threads a block.
            band: Rows a band is a multiple of; 0 runs the launch whole, on one thread.
            tiled: Launch one block of lanes per row; the kernel sees the lane as a second index.
            beside: Run it side by side with the step before, as in `call`.
        """
        dims = [dim] if isinstance(dim, int) else list(dim)
        self.kernels.append((kernel, block_dim))
        rows = dims[0]
        if rows == 0 or (len(dims) > 1 and dims[1] == 0):
            return
        parts = min(self.threads, -(-rows // band)) if band else 1
        per = -(-rows // parts)
        if band:
            per = -(-per // band) * band
        step = []
        for start in range(0, rows, per):
            count = min(per, rows - start)
            values = [start if value is FIRST else value for value in inputs]
            step.append(self._command(kernel, [count, *dims[1:]], values, outputs, block_dim, tiled))
        if beside:
            for command in step:
                self.call(command, beside=True)
        else:
            self.sections[-1].steps.append(step)

    def launch_together(self, launches: list[tuple[Any, int, list[Any], list[Any]]], *, block_dim: int) -> None:
        """Add launches that may run side by side: (kernel, dim, inputs, outputs) each."""
        step: list[Callable[[], Any]] = []
        for kernel, dim, inputs, outputs in launches:
            self.kernels.append((kernel, block_dim))
            if dim > 0:
                step.append(self._command(kernel, [dim], inputs, outputs, block_dim, False))
        if step:
            self.sections[-1].steps.append(step)

    def call(self, function: Callable[[], Any], *, beside: bool = False) -> None:
        """Add a device operation that is no kernel of ours: a memset or a scan.

        Args:
            function: Issues the operation.
            beside: Run it side by side with the step before, be it the last of the pass before; its buffer must be
                free by then (`Buffer.early`).
        """
        here = self.sections[-1]
        before = next((s for s in reversed(self.sections) if s.steps), None)
        # Not across parts, which run a different number of times, nor into or out of a section that may be skipped, nor
        # into one that may run on another stream.
        if before is not None and before is not here:
            alone = before.part != here.part or before.condition is not None or here.condition is not None
            alone = alone or any(s.beside for s in self.sections)
            before = None if alone else before
        if beside and before is not None:
            before.steps[-1].append(function)
        else:
            here.steps.append([function])

    def _command(
        self, kernel: Any, dims: list[int], inputs: list[Any], outputs: list[Any], block_dim: int, tiled: bool
    ) -> _Command:
        if tiled:
            # The CPU backend runs a block as one lane.
            block_dim = block_dim if self.device.is_cuda else 1
            dims = [*dims, block_dim]
        return _Command(kernel, dims, inputs, outputs, self.device, block_dim)

    def _run_sections(self, sections: Sequence[Section]) -> None:
        """Run sections in order, on CUDA those that may on a stream beside the one before them."""
        done = 0
        for k, section in enumerate(sections):
            if k < done:
                continue
            others = list(sections[k + 1 : k + 1 + section.beside]) if self.device.is_cuda else []
            done = k + 1 + len(others)
            if not others or any(s.condition is not None for s in (section, *others)):
                for s in (section, *others):
                    self.run_section(s)
            else:
                self._fork([lambda s=section: self.run_section(s), lambda s=others: self._run_sections(s)])

    def run_section(self, section: Section) -> None:
        """Run one pass's steps directly, or skip them."""
        if section.condition is None or (section.leaves_early and self.device.is_cuda):
            self._run_steps(section)
        elif self.device.is_cuda:
            # Under capture a node of the graph decides; else the value is waited for and read.
            wp.capture_if(section.condition, lambda: self._run_serially(section), section.otherwise)
        elif section.active:
            self._run_steps(section)
        elif section.otherwise is not None:
            section.otherwise()

    def _run_serially(self, section: Section) -> None:
        """Run steps on one stream: the body of a conditional node cannot fork."""
        for step in section.steps:
            for command in step:
                command()

    def _run_steps(self, section: Section) -> None:
        for step in section.steps:
            if len(step) == 1:
                step[0]()
            elif self.device.is_cuda:
                self._fork(step)
            elif wp.config.mode == "debug":
                # Two launches at a time crash in Warp 1.19's debug builds, of a trivial kernel over disjoint halves
                # too; one at a time runs on any thread, and release builds run both. Why was not established.
                for command in step:
                    command()
            else:
                others = [_pool(self.threads).submit(command) for command in step[1:]]
                step[0]()
                for other in others:
                    other.result()

    def _fork(self, step: list[Callable[[], Any]]) -> None:
        """Issue commands on streams of their own, joined before the next step; in a graph they become branches."""
        while len(self._streams) < len(step) - 1:
            self._streams.append(wp.Stream(self.device))
        main = wp.get_stream(self.device)
        start = main.record_event()
        ends = []
        for command, stream in zip(step[1:], self._streams, strict=False):
            stream.wait_event(start)
            with wp.ScopedStream(stream, sync_enter=False):
                command()
            ends.append(stream.record_event())
        step[0]()
        for end in ends:
            main.wait_event(end)

    def load(self, progress: Callable[[str, int, int], None] | None = None) -> None:
        """Compile and load every kernel the program launches, so that capturing and replaying never do.

        Args:
            progress: Called with (a kernel that is being loaded, done, all): before the first and after each.
        """
        pending: dict[tuple[str, int], Any] = {}
        for kernel, block_dim in self.kernels:
            # Without cooperative CPU blocks a launch on the CPU is resolved to a block of one.
            size = 1 if self.device.is_cpu and not wp.config.enable_cpu_blocks else block_dim
            pending[(kernel.module.name, size)] = kernel
        names = [kernel.key.split("__")[-1].removesuffix("_kernel") for kernel in pending.values()]
        if progress and names:
            progress(names[0], 0, len(names))
        loads = [functools.partial(kernel.module.load, self.device, size) for (_, size), kernel in pending.items()]
        for done, _ in enumerate(self._all(loads), 1):
            if progress:
                progress(names[done] if done < len(names) else "", done, len(names))
        if self.device.is_cpu:
            for command in (c for section in self.sections for step in section.steps for c in step):
                if isinstance(command, _Command):
                    command.record()

    def _all(self, loads: list[Callable[[], Any]]) -> Iterator[None]:
        """Load modules, on the CPU as many at a time as there are threads; one step for each that is done.

        The compiler runs without the interpreter's lock, and Warp keeps a lock of its own where it generates code.
        """
        if self.device.is_cuda or self.threads == 1 or wp.config.mode == "debug":
            for load in loads:
                load()
                yield
            return
        futures = [_pool(self.threads).submit(load) for load in loads]
        try:
            for future in concurrent.futures.as_completed(futures):
                future.result()
                yield
        finally:
            for future in futures:
                future.cancel()

    @property
    def parts(self) -> list[tuple[list[Section], int]]:
        """Sections of each part of the frame that has any, and how often the part runs; one part for one sample."""
        if self.samples == 1:
            return [(self.sections, 1)]
        parts = [([s for s in self.sections if s.part == part], 1) for part in (START, SAMPLE, END)]
        return [(sections, self.samples if sections[0].part == SAMPLE else 1) for sections, _ in parts if sections]

    def capture(self) -> None:
        """On CUDA: record each part into a graph."""
        graphs = []
        for sections, count in self.parts:
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                self._run_sections(sections)
            graphs.append((capture.graph, count))
        self._graphs = graphs

    def ready(self) -> None:
        """Capture what the first replay would, so that it takes no longer than the next."""
        if self.device.is_cuda and not self._graphs:
            self.capture()

    def replay(self) -> None:
        """Run the whole program once: the graphs on CUDA, captured by the first call, or the commands on the CPU."""
        self.ready()
        for graph, count in self._graphs:
            for _ in range(count):
                wp.capture_launch(graph)
        if not self._graphs:
            self.run()

    def run(self, stop: int | None = None) -> None:
        """Run the whole program once without graphs.

        Args:
            stop: Number of sections to run; a frame that ends in its sample part takes one sample only.
        """
        last = self.sections[:stop]
        for sections, count in self.parts:
            wanted = sections[: max(0, len(last))]
            last = last[len(wanted) :]
            for _ in range(count if len(wanted) == len(sections) else 1):
                self._run_sections(wanted)

    def measure(self, repeats: int = 20) -> dict[str, list[float]]:
        """Time each pass by itself: section name -> milliseconds of each repeat (device time on CUDA).

        A pass of the sample part is timed for one sample. What the passes wrote is then no frame: replay to get one.
        """
        times: dict[str, list[float]] = {section.name: [] for section in self.sections}
        if not self.device.is_cuda:
            for _ in range(repeats):
                for section in self.sections:
                    start = time.perf_counter()
                    self.run_section(section)
                    times[section.name].append((time.perf_counter() - start) * 1e3)
            return times
        graphs = []
        for section in self.sections:
            with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
                self.run_section(section)
            graphs.append(capture.graph)
        stream = wp.get_stream(self.device)
        for _ in range(repeats):
            events = [wp.Event(self.device, enable_timing=True) for _ in range(len(graphs) + 1)]
            stream.record_event(events[0])
            for k, graph in enumerate(graphs):
                wp.capture_launch(graph)
                stream.record_event(events[k + 1])
            for k, section in enumerate(self.sections):
                times[section.name].append(wp.get_event_elapsed_time(events[k], events[k + 1]))
        return times
