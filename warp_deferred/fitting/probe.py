"""A renderer to measure with: pictures, their distance, and times, at any settings.

It keeps count of what is no measurement: the seconds in which kernels were compiled, once on a machine, and those in
which they were loaded from the cache, once a process.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import time
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..camera import Camera
from ..kernels import picture_error
from ..plan import Plan
from ..renderer import Renderer
from ..settings import Settings
from .clock import SLOW_MS, Spread, busy_blocks, frames, replays, warm_up

__all__ = ["FRAME_S", "Probe"]

#: Time from one frame to the next of a scene that moves [s].
FRAME_S = 1.0 / 30.0
#: A frame that takes longer than this on the CPU is its own price [ms]: memory that is new to it then matters little.
CPU_ONCE_MS = 2_000.0
#: Ends of the names of folders that Warp builds modules in: process and thread.
UNFINISHED = re.compile(r"_p\d+_t\d+$")
#: Frames as they come that make a price.
FEW = 5


class Probe:
    """Looks at a scene from fixed cameras.

    Attributes:
        renderer: The renderer; its settings change with every look.
        cameras: The cameras.
        now_s: The scene's time: pictures and prices are those of this moment.
        moves: Whether the scene can be animated, so that other moments can be looked at.
        compiled: Modules that were compiled, so far.
        compile_s: Seconds that took.
        load_s: Seconds that loading modules from the cache took.
        plans: Looks that built a plan.
    """

    def __init__(self, renderer: Renderer, cameras: Sequence[Camera], now_s: float) -> None:
        self.renderer, self.cameras, self.now_s = renderer, list(cameras), now_s
        self.device = renderer.device
        self.moves = renderer.scene.animate is not None
        self.compiled, self.compile_s, self.load_s, self.plans = 0, 0.0, 0.0, 0
        self._settings = renderer.settings
        self._sum = wp.zeros(1, dtype=wp.int64, device=self.device)
        self._warm = False
        #: Time of the last look's own frame, all of it [ms].
        self._look_ms = 0.0
        self._blocks: tuple[wp.array, wp.array] | None = None

    @property
    def plan(self) -> Plan:
        """The plan of the last look."""
        return self.renderer.plan

    def look(self, settings: Settings) -> Plan:
        """Render the scene's moment at these settings; of a shutter that stays open, the second frame of two."""
        self.renderer.settings = settings
        before = self.renderer.plan
        self._prepare()
        self.plans += self.renderer.plan is not before
        if self.moves and any(camera.shutter > 0.0 for camera in self.cameras):
            self.animate(self.now_s - FRAME_S)
            self.renderer.render(self.cameras)
            self.animate(self.now_s)
        self.renderer.plan.resources.program.ready()
        wp.synchronize_device(self.device)
        begun = time.perf_counter()
        self.renderer.render(self.cameras)
        wp.synchronize_device(self.device)
        self._look_ms = (time.perf_counter() - begun) * 1e3
        if not self._warm:
            warm_up(self.plan.resources.program)
            self._warm = True
        return self.plan

    def _prepare(self) -> None:
        """Build the plan, and take the time of what compiling and loading add to it."""
        begun: list[tuple[float, int]] = []

        def advance(kernel: str, done: int, total: int) -> None:
            now, kept = time.perf_counter(), _kept_modules()
            if begun:
                last, known = begun.pop()
                if kept > known:
                    self.compiled += kept - known
                    self.compile_s += now - last
                else:
                    self.load_s += now - last
            if done < total:
                begun.append((now, kept))

        self.renderer.prepare(advance, camera=self.cameras)

    def picture(self) -> wp.array:
        """Return a copy of the picture of the last look, a word a pixel."""
        return wp.clone(self._words())

    def _words(self) -> wp.array:
        display = self.plan.outputs["display"]
        words = wp.array(ptr=display.ptr, dtype=wp.uint32, shape=(display.size,), device=self.device, copy=False)
        words._ref = display
        return words

    def rmse(self, reference: wp.array, picture: wp.array | None = None) -> float:
        """Root of the mean squared difference of two pictures, codes as shares of 255.

        Args:
            reference: One of them.
            picture: The other; that of the last look if left out.
        """
        words = self._words() if picture is None else picture
        self._sum.zero_()
        wp.launch(
            picture_error.sum_squares_kernel, dim=min(picture_error.THREADS, words.size), inputs=[words, reference],
            outputs=[self._sum], device=self.device, block_dim=picture_error.BLOCK_DIM,
        )  # fmt: skip
        return math.sqrt(int(self._sum.numpy()[0]) / (3.0 * words.size)) / 255.0

    def price(self) -> float:
        """Time of the last look's frame, replayed [ms]: the median on CUDA.

        On the CPU the fastest: what else runs on the host only ever adds, and prices are differences. What takes long
        is not rendered once more for it.
        """
        if self._look_ms > (SLOW_MS[0] if self.device.is_cuda else CPU_ONCE_MS):
            return self._look_ms
        spread = self.replays()
        return spread.median if self.device.is_cuda else spread.p5

    def replays(self) -> Spread:
        """Times of the last look's frame, replayed."""
        return replays(self.plan.resources.program)

    def in_motion(self) -> float:
        """Time of frames as they come after the last look, the moment put back [ms]: as `price` has it."""
        spread = Spread.of(self.frames(1, FEW + 1)[1:])
        self.animate(self.now_s)
        return spread.median if self.device.is_cuda else spread.p5

    def frames(self, first: int, count: int) -> list[float]:
        """Times of `count` frames from the `first` one on after the scene's moment [ms]; the same again if it rests."""

        def prepare(k: int) -> None:
            self.animate(self.now_s + (first + k) * FRAME_S)

        if self._blocks is None and self.device.is_cuda:
            self._blocks = busy_blocks(self.device)
        return frames(self.device, count, prepare, lambda: self.renderer.render(self.cameras), self._blocks)

    def animate(self, moment_s: float) -> None:
        """Move the scene, where it can be."""
        if self.moves:
            self.renderer.scene.animate(self.renderer.scene, moment_s)

    @contextlib.contextmanager
    def restoring(self) -> Any:
        """Show the scene's moment, and put scene and settings back to it, whatever happens.

        Memory of plans that are let go of is kept for the next ones meanwhile: asking the driver anew takes longer.
        """
        self.animate(self.now_s)
        pooled = self.device.is_cuda and wp.is_mempool_enabled(self.device)
        kept = wp.get_mempool_release_threshold(self.device) if pooled else 0
        if pooled:
            wp.set_mempool_release_threshold(self.device, 0.9)
        try:
            yield
        finally:
            self._blocks = None
            if pooled:
                wp.set_mempool_release_threshold(self.device, kept)
            self.renderer.settings = self._settings
            self.animate(self.now_s)


def _kept_modules() -> int:
    """How many modules Warp's cache of kernels holds: a folder each, but for those still being built."""
    try:
        return _count(wp.config.kernel_cache_dir, os.stat(wp.config.kernel_cache_dir).st_mtime_ns)
    except OSError:
        return 0


@functools.lru_cache(1)
def _count(folder: str, modified: int) -> int:
    """Count a folder's modules anew when it was modified."""
    return sum(not UNFINISHED.search(name) for name in os.listdir(folder))
