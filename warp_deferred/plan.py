"""The plan: the passes of a request with their buffers and recorded launches; it explains itself.

Buffers whose lives do not overlap share memory; outputs keep theirs until the next frame. Which passes run is decided
in selection.py.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import warp as wp

from .arena import ALIGNMENT, lay_out, run_together
from .device_scene import DeviceScene
from .errors import CapacityError, Error
from .light_store import LightStore
from .memory import enough_memory
from .passes.base import Pass, Request
from .passes.clusters import ClustersPass
from .passes.display import DisplayPass
from .passes.image import all_reads, all_writes
from .passes.light_culling import LightCullingPass
from .passes.lights import LightsPass
from .passes.raster import RasterPass, large_stored
from .passes.resolve import ResolvePass
from .passes.shade import ShadePass
from .program import END, SAMPLE, START, Program
from .resources import Resources
from .sampling import sample_count, shutter_samples
from .selection import PassReport, select, verify
from .shadow_slots import ShadowTable
from .views import ViewLayout, ViewPacker

if TYPE_CHECKING:
    from .finite_check import FiniteCheck

__all__ = ["PASSES", "Plan"]

#: Every pass a frame is made of, in order; effects.py has the optional ones.
PASSES: tuple[type[Pass], ...] = (
    ClustersPass, RasterPass, ResolvePass, LightsPass, LightCullingPass, ShadePass, DisplayPass,
)  # fmt: skip
#: Scopes of the passes that run once a sample.
LOOP = ("sample", "accumulate")
#: Passes a plan may skip by a value on the device: each costs some µs even where it is skipped.
MAX_ACTIVE = 2
#: Elements of one device array.
MAX_ELEMENTS = 2**31 - 1
#: One alignment unit as an array element.
UNIT = wp.types.vector(length=32, dtype=wp.float64)


class Plan:
    """A frame's passes, buffers and recorded launches for one request.

    Tables of where views lie, and the host's copies of what it uploads, are shared with other plans of the scene whose
    views lie alike.

    Attributes:
        request: What it was built for.
        layout: Where the views lie.
        passes: The passes that run, in order.
        packer: Writes cameras into the frame block.
        resources: Buffers and tables.
        replays: How often the passes that look at one sample run in a frame.
        outputs: Arrays of the outputs.
        shown: Those that were asked for, and not for a user's own pass alone.
        finite_check: Looks for numbers that are not finite, where the settings say so.

    Raises:
        CapacityError: If a buffer would not fit its ids; before anything is allocated.
    """

    def __init__(
        self,
        request: Request,
        scene: DeviceScene,
        lights: Callable[[], LightStore],
        progress: Callable[[str, int, int], None] | None = None,
        others: Sequence[Plan] = (),
    ) -> None:
        self.request = request
        tile_size = request.settings.light_culling.tile_size
        alike = (p.layout for p in others if p.layout.sizes == request.sizes and p.layout.tile_size == tile_size)
        self.layout = next(alike, None) or ViewLayout(request.sizes, tile_size)
        self.packer = ViewPacker(self.layout, request.settings.raster.cull)
        self.passes, self._reports = select(request, self.layout, PASSES)
        verify(self.passes, request.outputs)
        self._check_counts()
        looped = [k for k, stage in enumerate(self.passes) if stage.scope in LOOP]
        self.replays = self._replays()
        loop = range(looped[0], looped[-1] + 1) if self.replays > 1 else range(0)
        together = run_together(self.passes, loop)
        self._places = lay_out(self.passes, request, loop, together)
        self.memory = self._places.sizes
        self.bytes = self._places.total + sum(self.memory[name] for name in request.outputs)
        # Nothing is allocated before this line: what cannot be held has been refused.
        mend = "render smaller or fewer views, or fewer outputs"
        with enough_memory("frame", self.bytes, scene.device, mend, self._fitting):
            program = Program(scene.device, request.threads, self.replays)
            self.resources = Resources.make(
                scene, lights(), self.layout, program, request.shadow_slots, [p.resources for p in others]
            )
            self._allocate()
            self.finite_check = self._finite_check()
            for k, stage in enumerate(self.passes):
                part = START if k < loop.start else END if k >= loop.stop > 0 else SAMPLE
                self._build(stage, part, together[k])
        program.load(progress)

    def _replays(self) -> int:
        """How often the sample part runs: once a sample, and once more where something needs the pixel's centre."""
        sums = next((stage for stage in self.passes if stage.scope == "accumulate"), None)
        if sums is None:
            return 1
        averaged = set(all_reads(sums))
        inside = {name for stage in self.passes if stage.scope in LOOP for name in all_writes(stage)} - averaged
        after = {name for stage in self.passes if stage.scope == "frame_end" for name in all_reads(stage)}
        # The look at the centre, at the frame's own time, also puts back what samples of the shutter have moved.
        centre = inside & (after | self.request.outputs) or shutter_samples(self.request) > 1
        return sample_count(self.request) + bool(centre)

    def _build(self, stage: Pass, part: int, beside: int) -> None:
        """Prepare a pass and add its launches to the program."""
        resources = self.resources
        resources.frame.sampling = part == SAMPLE
        stage.prepare(resources)
        condition, otherwise = stage.active(resources), None
        if condition is not None and stage.image == "turn":
            target, source = resources.channels[stage.target], resources.channels[stage.source]
            otherwise = functools.partial(wp.copy, target, source)
        early = stage.leaves_early and otherwise is None
        resources.program.begin(stage.name, part, condition, otherwise, beside, early)
        stage.run(resources)
        if self.finite_check is not None:
            self.finite_check.add(stage)
        conditions = [s.name for s in resources.program.sections if s.condition is not None and not s.leaves_early]
        if len(conditions) > MAX_ACTIVE:
            raise Error(
                f"{stage.name}.active: expected at most {MAX_ACTIVE} passes with a condition on the device, got "
                f"{', '.join(conditions)}; decide on the host, or in the kernel itself"
            )

    def _fitting(self, share: float) -> str:
        """What would fit in a share of the frame's memory: fewer views, or a smaller one."""
        size, views = self.layout.sizes[0], self.request.cameras
        if int(views * share) >= 1:
            return f"{int(views * share)} of these {views} views"
        side = math.sqrt(views * share)
        return f"one view of {max(1, int(size.width * side))}x{max(1, int(size.height * side))}"

    def _check_counts(self) -> None:
        for stage in self.passes:
            for name, buffer in all_writes(stage).items():
                if buffer.count > MAX_ELEMENTS:
                    raise CapacityError(
                        f"{stage.name}: expected at most {MAX_ELEMENTS} elements of {name!r}, got {buffer.count}; "
                        "render fewer views at a time"
                    )

    def _allocate(self) -> None:
        device, channels, buffers = self.resources.device, self.resources.channels, self._places.buffers
        # Whole alignment units as elements: an arena of bytes would end at 2 GiB.
        self.arena = wp.zeros(max(self._places.total, ALIGNMENT) // ALIGNMENT, dtype=UNIT, device=device)
        for name, offset in self._places.places.items():
            buffer = buffers[name]
            channels[name] = wp.array(
                ptr=self.arena.ptr + offset, dtype=buffer.dtype, shape=(buffer.count,), device=device, copy=False
            )
        self.outputs: dict[str, wp.array] = {}
        for name in self.request.outputs:
            buffer = buffers[name]
            channels[name] = wp.zeros(max(buffer.count, 1), dtype=buffer.dtype, device=device)
            self.outputs[name] = self._as_image(channels[name], buffer.public or buffer.dtype, name == "display")
        self.shown = {name: array for name, array in self.outputs.items() if name not in self.request.hidden}

    def _as_image(self, array: wp.array, dtype: type, shown: bool) -> wp.array:
        sizes = [s.shown if shown else (s.width, s.height) for s in self.layout.sizes if not s.depth_only]
        if len(set(sizes)) != 1:
            return array
        shape = (len(sizes), sizes[0][1], sizes[0][0])
        image = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device, copy=False)
        # The memory lives for as long as someone holds the image, even when the plan is gone.
        image._ref = array
        return image

    def stage_shadows(self, table: ShadowTable, ranges: list[tuple[int, ...]]) -> None:
        """Upload which light each shadow map belongs to, and what every map draws."""
        for stage in self.passes:
            if stage.name == "shadow":
                stage.stage(self.resources, self.packer, table, ranges)

    def _finite_check(self) -> FiniteCheck | None:
        if not self.request.settings.check_finite:
            return None
        from .finite_check import FiniteCheck

        return FiniteCheck(self.request, self.resources)

    def replay(self) -> None:
        """Run the frame; the first call on CUDA captures it.

        Raises:
            Error: If the settings have it checked and a number in it is not finite.
        """
        if self.finite_check is None:
            self.resources.program.replay()
            return
        self.finite_check.begin()
        self.resources.program.replay()
        self.finite_check.end()

    def forget(self) -> None:
        """Forget the frame before: another plan's frame, or another scene's, came between."""
        for name in ("motion_known", "shutter_known"):
            if name in self.resources.channels:
                self.resources.channels[name].zero_()

    def counters(self) -> list[str]:
        """Counts read back from the last frame: what overflowed its capacity, in words; nothing if nothing did."""
        channels, raster, result = self.resources.channels, self.request.settings.raster, []
        if "large_count" in channels:
            stored, over = large_stored(channels["large_count"].numpy(), raster.large_capacity)
            result.append(f"{stored:,} large triangles of {raster.large_capacity:,} that fit the store")
            if over:
                result.append(f"{over:,} drawn by the slower path: raise raster.large_capacity")
            used = int(channels["bin_offsets"].numpy()[-1]) + int(channels["bin_counts"].numpy()[-1])
            result.append(f"{used:,} bin entries of {raster.bin_capacity:,} that fit")
            if used > raster.bin_capacity:
                result.append(f"{used - raster.bin_capacity:,} drawn by the slower path: raise raster.bin_capacity")
        return result

    def reports(self, measure: bool, repeats: int = 20) -> list[PassReport]:
        """What runs and why; where asked for with the median milliseconds, over all samples, and what was active."""
        program = self.resources.program
        times = program.measure(repeats) if measure else {}
        if measure:
            # The passes left their buffers as no frame would.
            self.replay()
        sections = {section.name: section for section in program.sections}
        doubts = {stage.name: stage.active_if or "its condition holds" for stage in self.passes}
        result = []
        for report in self._reports:
            section = sections.get(report.name)
            if section is not None:
                count = self.replays if section.part == SAMPLE else 1
                reason = report.reason
                if section.condition is not None:
                    reason += f"; active if {doubts[report.name]}"
                report = dataclasses.replace(
                    report,
                    reason=reason,
                    bytes=report.bytes * count,
                    milliseconds=statistics.median(times[report.name]) * count if measure else None,
                    active=section.active if measure else None,
                )
            result.append(report)
        return result
