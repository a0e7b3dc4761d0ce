"""The plan: keeps the passes that are called for, orders them, allocates, builds the program, explains itself.

From the outputs asked for, backwards: a pass runs if something it writes is read by a pass that runs or was asked for,
and if the scene, the cameras or the settings call for it. Buffers whose lives do not overlap share memory; outputs
keep theirs until the next frame.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable

import warp as wp

from .device_scene import DeviceScene
from .errors import CapacityError, Error
from .light_store import LightStore
from .memory import enough_memory
from .passes.base import Buffer, Pass, Request
from .passes.clusters import ClustersPass
from .passes.display import DisplayPass
from .passes.light_culling import LightCullingPass
from .passes.lights import LightsPass
from .passes.raster import RasterPass, large_stored
from .passes.resolve import ResolvePass
from .passes.shade import ShadePass
from .passes.shadow import ShadowPass
from .program import Program
from .resources import Resources
from .shadow_slots import ShadowTable
from .views import ViewLayout, ViewPacker

__all__ = ["PASSES", "PassReport", "Plan"]

#: Every pass, in frame order.
PASSES: tuple[type[Pass], ...] = (
    ShadowPass, ClustersPass, RasterPass, ResolvePass, LightsPass, LightCullingPass, ShadePass, DisplayPass,
)  # fmt: skip
ALIGNMENT = 256
#: Elements of one device array.
MAX_ELEMENTS = 2**31 - 1
#: One alignment unit as an array element.
UNIT = wp.types.vector(length=32, dtype=wp.float64)


@dataclasses.dataclass(frozen=True)
class PassReport:
    """One line of `explain`."""

    name: str
    runs: bool
    reason: str
    rung: str
    milliseconds: float | None = None
    bytes: int | None = None


class Plan:
    """A frame's passes, buffers and recorded launches for one request.

    Attributes:
        request: What it was built for.
        layout: Where the views lie.
        passes: The passes that run, in order.
        packer: Writes cameras into the frame block.
        resources: Buffers and tables.

    Raises:
        CapacityError: If a buffer would not fit its ids; before anything is allocated.
    """

    def __init__(
        self,
        request: Request,
        scene: DeviceScene,
        lights: Callable[[], LightStore],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> None:
        self.request = request
        self.layout = ViewLayout(request.sizes, request.settings.light_culling.tile_size)
        self.packer = ViewPacker(self.layout, request.settings.raster.cull)
        self._reports: list[PassReport] = []
        self.passes = self._select()
        self._verify()
        self._check_counts()
        buffers, places, total = self._lay_out()
        # Nothing is allocated before this line: what cannot be held has been refused.
        with enough_memory("frame", self.bytes, scene.device, "render smaller or fewer views, or fewer outputs"):
            program = Program(scene.device, request.threads)
            self.resources = Resources.make(scene, lights(), self.layout, program, request.shadow_slots)
            self._allocate(buffers, places, total)
            for stage in self.passes:
                stage.prepare(self.resources)
                program.begin(stage.name)
                stage.run(self.resources)
        program.load(progress)
        self._captured = False

    def _select(self) -> list[Pass]:
        needed = set(self.request.outputs)
        kept: list[Pass] = []
        for kind in reversed(PASSES):
            stage = kind(self.request, self.layout)
            reason = stage.called_for()
            writes = set(stage.writes()) if reason else set()
            if reason and writes & needed:
                kept.append(stage)
                needed |= set(stage.reads())
                self._reports.append(PassReport(stage.name, True, reason, stage.rung(), bytes=stage.bytes_moved()))
            else:
                self._reports.append(PassReport(stage.name, False, self._why_not(stage, reason), "off"))
        self._reports.reverse()
        kept.reverse()
        return kept

    def _why_not(self, stage: Pass, reason: str | None) -> str:
        if reason:
            return "no output asked for reads what it writes"
        if stage.name in ("lights", "light_culling"):
            return "no light in the scene" if not self.request.features.kinds else "no lit output asked for"
        if stage.name == "clusters":
            return "the scene has no triangles"
        if stage.name == "shadow":
            return stage.why_not()
        return "no output asked for needs it"

    def _verify(self) -> None:
        written: set[str] = set()
        for stage in self.passes:
            for name in stage.reads():
                if name not in written:
                    raise Error(
                        f"{type(stage).__name__} reads {name!r}: expected an earlier pass that writes it, got none; "
                        "add the pass or ask for another output"
                    )
            written |= set(stage.writes())
        missing = self.request.outputs - written
        if missing:
            raise Error(f"outputs: expected names some pass writes, got {sorted(missing)}; leave them out")

    def _check_counts(self) -> None:
        for stage in self.passes:
            for name, buffer in stage.writes().items():
                if buffer.count > MAX_ELEMENTS:
                    raise CapacityError(
                        f"{stage.name}: expected at most {MAX_ELEMENTS} elements of {name!r}, got {buffer.count}; "
                        "render fewer views at a time"
                    )

    def _lay_out(self) -> tuple[dict[str, Buffer], dict[str, int], int]:
        """Buffers by name, offsets of the transient ones in the shared arena, and the arena's bytes."""
        buffers: dict[str, Buffer] = {}
        born: dict[str, int] = {}
        dies: dict[str, int] = {}
        for k, stage in enumerate(self.passes):
            for name, buffer in stage.writes().items():
                if buffer.dtype is not None:
                    buffers[name], born[name] = buffer, max(0, k - buffer.early) if self.request.share_memory else 0
                    dies[name] = len(self.passes) if buffer.lasting or not self.request.share_memory else k
                    if buffer.persistent:
                        born[name], dies[name] = 0, len(self.passes)
            for name in stage.reads():
                dies[name] = max(dies.get(name, k), k)
        self.memory = {n: _padded(b.count * wp.types.type_size_in_bytes(b.dtype)) for n, b in buffers.items()}
        transient = [n for n in buffers if n not in self.request.outputs]
        places, total = _place(transient, self.memory, born, dies)
        self.bytes = total + sum(self.memory[n] for n in self.request.outputs)
        return buffers, places, total

    def _allocate(self, buffers: dict[str, Buffer], places: dict[str, int], total: int) -> None:
        device, channels = self.resources.device, self.resources.channels
        # Whole alignment units as elements: an arena of bytes would end at 2 GiB.
        self.arena = wp.zeros(max(total, ALIGNMENT) // ALIGNMENT, dtype=UNIT, device=device)
        for name, offset in places.items():
            buffer = buffers[name]
            channels[name] = wp.array(
                ptr=self.arena.ptr + offset, dtype=buffer.dtype, shape=(buffer.count,), device=device, copy=False
            )
        self.outputs: dict[str, wp.array] = {}
        for name in self.request.outputs:
            buffer = buffers[name]
            channels[name] = wp.zeros(max(buffer.count, 1), dtype=buffer.dtype, device=device)
            self.outputs[name] = self._as_image(channels[name], buffer.public or buffer.dtype)

    def _as_image(self, array: wp.array, dtype: type) -> wp.array:
        sizes = [s for s in self.layout.sizes if not s.depth_only]
        if len({(s.width, s.height) for s in sizes}) != 1:
            return array
        shape = (len(sizes), sizes[0].height, sizes[0].width)
        image = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device, copy=False)
        # The memory lives for as long as someone holds the image, even when the plan is gone.
        image._ref = array
        return image

    def stage_shadows(self, table: ShadowTable, ranges: list[tuple[int, ...]]) -> None:
        """Upload which light each shadow map belongs to, and what every map draws."""
        for stage in self.passes:
            if isinstance(stage, ShadowPass):
                stage.stage(self.resources, self.packer, table, ranges)

    def replay(self) -> None:
        """Run the frame; the first call on CUDA captures it."""
        if not self._captured:
            self.resources.program.capture()
            self._captured = True
        self.resources.program.replay()

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
        """What runs and why, with the median milliseconds of each pass where asked for."""
        if not measure:
            return list(self._reports)
        times = self.resources.program.measure(repeats)
        return [
            dataclasses.replace(r, milliseconds=statistics.median(times[r.name])) if r.runs else r
            for r in self._reports
        ]


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
