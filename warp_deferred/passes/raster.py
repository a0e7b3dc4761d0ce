"""Raster: clusters to visibility keys, small triangles in their own lane, large ones through bins."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from ..kernels import bin_draw as draw_kernels
from ..kernels import bins as bin_kernels
from ..kernels import coverage, structs
from ..kernels import merge as merge_kernels
from ..kernels import raster as kernels
from ..program import FIRST
from ..resources import Resources
from ..shadow_maps import clear_maps, keeps_maps
from .base import Buffer, Pass

__all__ = ["RasterPass", "large_stored"]

#: Blocks of the fixed grid; measured best on an H200 (design, section 5).
GRID_BLOCKS = 8192
CAREFUL_BLOCKS = 1024
#: Lanes and number of the teams that bin: those for huge triangles, then those for the others.
HUGE_TEAM = (256, 264)
LARGE_TEAM = (8, 16896)


def large_stored(counts: Sequence[int], capacity: int) -> tuple[int, int]:
    """Numbers of large triangles that were stored and that found no room, from the two counters of a frame."""
    split = capacity - capacity // coverage.HUGE_SHARE
    return min(int(counts[0]), split) + min(int(counts[1]), capacity - split), max(0, int(counts[0]) - split)


class RasterPass(Pass):
    """Nearest surface of every pixel."""

    name = "raster"
    doc = "draw triangles into visibility keys"

    def called_for(self) -> str | None:
        """Whatever is seen goes through it."""
        return "the scene has triangles" if self.request.candidates else "clears the keys: the scene is empty"

    def reads(self) -> tuple[str, ...]:
        """The work list."""
        return ("pairs", "work_entries", "work_counts") if self.request.candidates else ()

    def rung(self) -> str:
        """Bins or not."""
        return "two paths" if self.binned else "one path"

    @property
    def binned(self) -> bool:
        """Whether large triangles go to bins; on the CPU a lane is a loop already, so only when asked for."""
        raster = self.request.settings.raster
        wanted = raster.bins == "on" or (raster.bins == "auto" and self.request.threads == 0)
        return wanted and raster.large_capacity > 0 and self.request.candidates > 0

    @property
    def slices(self) -> int:
        """Host threads that draw, each into its own keys; counters allow only one."""
        return 1 if self.binned or not self.request.candidates else max(1, self.request.threads)

    def writes(self) -> dict[str, Buffer]:
        """Keys, and the store of large triangles."""
        layout, raster = self.layout, self.request.settings.raster
        result = {"keys": Buffer(wp.uint64, max(layout.pixels, 1), early=True)}
        if layout.has_depth_views:
            # Maps that nothing moved in are kept from frame to frame.
            kept = keeps_maps(self.request)
            result["depth_keys"] = Buffer(wp.uint32, layout.depth_pixels, early=True, persistent=kept)
        if self.slices > 1:
            result["slice_keys"] = Buffer(wp.uint64, layout.pixels * (self.slices - 1), early=True)
            if layout.has_depth_views:
                result["slice_depth_keys"] = Buffer(wp.uint32, layout.depth_pixels * (self.slices - 1), early=True)
        if self.binned:
            tiles = len(layout.bin_tiles)
            result["large_triangles"] = Buffer(structs.LargeTriangle, raster.large_capacity)
            result["bin_entries"] = Buffer(wp.int32, max(raster.bin_capacity, 1))
            result["bin_offsets"] = Buffer(wp.int32, tiles, lasting=True)
            # Counts, cursors and the numbers of large and huge triangles: one memset clears them all.
            result["bin_state"] = Buffer(wp.int32, 2 * tiles + 2, lasting=True, early=True)
        return result

    def prepare(self, resources: Resources) -> None:
        """Fetch kernels, build targets."""
        depth_views, masked = self.layout.has_depth_views, self.request.features.masked
        self.plain = kernels.make_raster_kernel(False, False, depth_views, False)
        self.careful = kernels.make_raster_kernel(True, masked, depth_views, False)
        channels = resources.channels
        if self.binned:
            state, tiles = channels["bin_state"], len(self.layout.bin_tiles)
            channels["bin_counts"], channels["bin_cursors"] = state[:tiles], state[tiles : 2 * tiles]
            channels["large_count"] = state[2 * tiles :]
        none = wp.zeros(0, dtype=structs.LargeTriangle, device=resources.device)
        self.targets = []
        for k in range(self.slices):
            target = structs.RasterTarget()
            target.keys = self._slice(resources, "keys", wp.uint64, self.layout.pixels, k)
            target.depth_keys = self._slice(resources, "depth_keys", wp.uint32, self.layout.depth_pixels, k)
            target.large = resources.channels.get("large_triangles", none)
            target.large_count = channels.get("large_count", wp.zeros(2, dtype=wp.int32, device=resources.device))
            target.behind = wp.zeros(1, dtype=wp.uint64, device=resources.device)
            self.targets.append(target)
        if self.binned:
            self.bin_triangles = bin_kernels.make_bin_kernel(depth_views, False)
            self.draw_bins = [draw_kernels.make_draw_bins_kernel(False, False)]
            if depth_views:
                self.draw_bins.append(draw_kernels.make_draw_bins_kernel(True, False))
            self.bins = bin_kernels.Bins()
            for field in ("counts", "offsets", "cursors", "entries"):
                setattr(self.bins, field, resources.channels[f"bin_{field}"])
            self.bins.scratch = wp.zeros(320, dtype=wp.vec4i, device=resources.device)
            if self.request.settings.raster.bin_capacity == 0:
                self.bins.entries = wp.zeros(0, dtype=wp.int32, device=resources.device)

    @staticmethod
    def _slice(resources: Resources, name: str, dtype: type, count: int, k: int) -> wp.array:
        if count == 0:
            return wp.zeros(1, dtype=dtype, device=resources.device)
        if k == 0:
            return resources.channels[name]
        return resources.channels[f"slice_{name}"][(k - 1) * count : k * count]

    def run(self, resources: Resources) -> None:
        """Clear, draw, bin, merge."""
        program = resources.program
        for name in ("keys", "depth_keys", "slice_keys", "slice_depth_keys", "bin_state"):
            if name == "depth_keys" and keeps_maps(self.request):
                clear_maps(resources, self.request)
            elif name in resources.channels:
                program.call(resources.channels[name].zero_, beside=True)
        if not self.request.candidates:
            return
        self._draw(resources)
        if self.binned:
            self._bin(resources)
        if self.slices > 1:
            self._merge(resources)

    def _draw(self, resources: Resources) -> None:
        frame, scene, channels = resources.frame, resources.scene, resources.channels
        work = structs.WorkList()
        work.entries, work.counts = channels["work_entries"], channels["work_counts"]
        fixed = [frame.views, scene.geometry, scene.materials, channels["pairs"], work]
        cluster, candidates = int(structs.CLUSTER_SIZE), self.request.candidates
        program, block = resources.program, kernels.BLOCK_DIM
        if resources.device.is_cuda:
            # Side by side: the few clusters that need care take as long as one of them, not as their number.
            launches = []
            for kernel, grid in ((self.plain, GRID_BLOCKS), (self.careful, CAREFUL_BLOCKS)):
                blocks = min(grid, candidates)
                launches.append((kernel, blocks * cluster, [*fixed, 0, 1, blocks], [self.targets[0]]))
            program.launch_together(launches, block_dim=block)
            return
        for kernel in (self.plain, self.careful):
            launches = []
            for k, target in enumerate(self.targets):
                count = -(-(candidates - k) // self.slices)
                launches.append((kernel, count * cluster, [*fixed, k, self.slices, 2**30], [target]))
            program.launch_together(launches, block_dim=block)

    def _bin(self, resources: Resources) -> None:
        program, views, target = resources.program, resources.frame.views, self.targets[0]
        huge, large = (HUGE_TEAM, LARGE_TEAM) if resources.device.is_cuda else ((1, 1), (1, 1))
        teams = wp.vec4i(*huge, *large)
        counts, offsets = self.bins.counts, self.bins.offsets

        def bin_step(filling: int) -> None:
            program.launch(
                self.bin_triangles,
                huge[0] * huge[1] + large[0] * large[1],
                [views, target, teams, filling],
                [self.bins],
                block_dim=bin_kernels.BLOCK_DIM,
            )

        bin_step(0)
        program.call(lambda: wp.utils.array_scan(counts, offsets, inclusive=False))
        bin_step(1)
        # Tiles of views that keep ids and of shadow maps lie apart, but in plans that mix their views.
        ranges = ((0, self.layout.shown_bins), (self.layout.depth_bins, len(self.layout.bin_tiles)))
        launches = []
        for kernel, (first, last) in zip(self.draw_bins, ranges, strict=False):
            count = last - first
            inputs = [views, resources.bin_tiles, self.bins, first]
            launches.append((kernel, count * draw_kernels.BLOCK_DIM, inputs, [target]))
        # On the CPU they share the memory that stands in for a block's.
        for together in [launches] if resources.device.is_cuda else [[launch] for launch in launches]:
            program.launch_together(together, block_dim=draw_kernels.BLOCK_DIM)

    def _merge(self, resources: Resources) -> None:
        for name, count, kernel in (
            ("keys", self.layout.pixels, merge_kernels.merge_keys_kernel),
            ("depth_keys", self.layout.depth_pixels, merge_kernels.merge_depth_keys_kernel),
        ):
            if count:
                resources.program.launch(
                    kernel,
                    count,
                    [resources.channels[f"slice_{name}"], count, self.slices - 1, FIRST],
                    [resources.channels[name]],
                    block_dim=merge_kernels.BLOCK_DIM,
                    band=64,
                )

    def bytes_moved(self) -> int:
        """Keys cleared and written once; triangle indices read."""
        return self.layout.pixels * 16 + self.layout.depth_pixels * 8 + self.request.candidates * 128 * 16
