"""Bloom: light that the lens scatters around what is bright; display mixes it in."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
import warp as wp

from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from ..settings import Settings
from ..views import ViewLayout, ViewSize, block_grid, table_array
from .base import Buffer, Pass, Request
from .image import float_image, image_bytes, make_image

__all__ = ["BloomPass", "Pyramid", "bright_level", "level_count", "make_bloom", "spread", "weights"]

#: A level more than any picture has pixels for would be one texel of everything, like the one before.
MAX_LEVELS = 14
#: Kinds of launches, or of steps of the chain, in the order of its constants.
KINDS = ("downsample", "narrow", "widen", "upsample")
#: Items of a block of the chain, as in its kernel file.
CHAINED = 4
#: Most texels, of all views, of the level that a single launch mixes all wider ones into: level 3 at 1080p. It makes
#: as many again of each of those.
WIDEN_TEXELS = 65536
#: Most texels, of all views, of the finer of two levels that a launch makes; it makes four times as many.
NARROW_TEXELS = 16384
#: A half keeps 11 bits: shade must not miss a pixel that only its rounding lifts above the threshold.
ROUNDING = 1.0 - 2.0**-10


def bright_level(request: Request) -> float | None:
    """Exposed radiance above which shade says that bloom has work; None where it need not, or cannot, say.

    Samples and blurs average what shade wrote, so their pixels are above it only where shade's are; a user's own pass
    may write anything.
    """
    settings = request.settings.bloom
    changed = any(stage.image in ("turn", "rewrite") for stage in request.passes)
    if changed or "display" not in request.outputs or settings.threshold == 0.0:
        return None
    return settings.threshold * (1.0 - settings.knee) * ROUNDING


def spread(level: int) -> float:
    """Standard deviation of the blur that level 1, 2, ... of the pyramid comes to, as display sees it [px].

    Variances add up, along each axis, over the positions a pixel may have in its texels: 3/4 for the taps 1 3 3 1 of
    level 1, 7/4 source texels squared for every further level (half of 5/4 and 9/4, see `thirteen_taps`), 11/16 texels
    squared for the tent out of a level (1/2 for 1 2 1, 3/16 for interpolating a quarter off) and 3/16 for display's
    interpolation of level 1. With texels of 4^k px^2 the sum is (3 4^k - 9) / 2.
    """
    return math.sqrt((3.0 * 4.0**level - 9.0) / 2.0)


def level_count(height: int, radius: float) -> int:
    """Levels whose widest blur comes nearest to `radius` times the height, as a ratio."""
    wanted = radius * height
    ratios = [abs(math.log(spread(k) / wanted)) for k in range(1, MAX_LEVELS + 1)]
    return 1 + ratios.index(min(ratios))


def weights(count: int, falloff: float) -> np.ndarray:
    """Share of each blur, narrowest first: a geometric row that adds up to 1; (count,) float64."""
    row = falloff ** np.arange(count)
    return row / row.sum()


@dataclasses.dataclass(frozen=True)
class Pyramid:
    """Where the levels of all views lie in one buffer, and which blocks of them a launch makes.

    Blocks are (b, 4) int32: view, x, y, row.

    Attributes:
        rows: `structs.BloomLevel` rows, `count` a view; rows of levels a view does not have are 0.
        count: Most levels a view has.
        counts: Levels of each view.
        texels: Texels of all levels.
    """

    rows: np.ndarray
    count: int
    counts: tuple[int, ...]
    texels: int

    @classmethod
    def of(cls, sizes: tuple[ViewSize, ...], settings: Settings) -> Pyramid:
        """Lay out the levels of the views that keep colour."""
        s = settings.bloom
        chain = s.rung == "mip_chain"
        counts = tuple(0 if v.depth_only else level_count(v.height, s.radius) if chain else 1 for v in sizes)
        most = max(counts, default=0)
        rows = np.zeros((len(sizes), most), structs.BloomLevel.numpy_dtype())
        first = 0
        for v, (size, count) in enumerate(zip(sizes, counts, strict=True)):
            share = weights(count, s.falloff) if count else np.zeros(0)
            for k in range(count):
                texel = 2 << k
                width, height = -(-size.width // texel), -(-size.height // texel)
                edges = [math.floor(2 * length / texel + 0.5) for length in (size.width, size.height)]
                wider = share[k + 1 :].sum() / share[k:].sum()
                rows[v, k] = (first, width, height, *edges, wider, v * most + count - 1)
                first += width * height
        return cls(rows.reshape(-1), most, counts, first)

    def blocks(
        self,
        level: int,
        views: list[int],
        side: tuple[int, int],
        cells: Callable[[int, int], tuple[int, int]] = lambda width, height: (width, height),
    ) -> np.ndarray:
        """Blocks of a level of some views.

        Args:
            level: 0 is level 1.
            views: The views.
            side: Cells that a block is wide and high.
            cells: Cells that a level of a width and height has: what the blocks' x and y count.
        """
        tables = [np.zeros((0, 4), np.int32)]
        for v in views:
            row = v * self.count + level
            width, height = cells(int(self.rows[row]["width"]), int(self.rows[row]["height"]))
            table = block_grid(v, ViewSize(-(-width // side[0]), -(-height // side[1])), 1)
            tables.append(table * np.int32((1, *side, 0)) + np.int32((0, 0, 0, row)))
        return np.concatenate(tables)

    def having(self, level: int) -> list[int]:
        """Views that have a level."""
        return [v for v, count in enumerate(self.counts) if count > level]

    def first_below(self, limit: int) -> int:
        """Finest level of which all views together have no more texels than a limit; `count` if none."""
        areas = self.rows["width"].astype(np.int64) * self.rows["height"]
        totals = areas.reshape(-1, max(self.count, 1)).sum(axis=0)
        return next((k for k in range(self.count) if totals[k] <= limit), self.count)

    def steps(self, together: bool) -> list[tuple[str, np.ndarray]]:
        """Steps that turn level 1 into bloom: one of KINDS, and blocks.

        Args:
            together: Make several small levels in a step: the same texels, less waiting, more work.
        """
        mixed = self.first_below(WIDEN_TEXELS) if together else self.count
        pairs = max(1, self.first_below(NARROW_TEXELS)) if together else self.count
        widened = {v for v in self.having(mixed + 2)}
        # `widen_kernel` makes the widest level itself.
        made = [count - (v in widened) for v, count in enumerate(self.counts)]
        steps = []
        for k in range(1, self.count):
            second = k > pairs and (k - pairs) % 2 == 1
            paired = [v for v in self.having(k + 1) if k >= pairs and not second and k + 1 < made[v]]
            alone = [v for v in self.having(k) if k < made[v] and not second and v not in paired]
            steps += [("downsample", self.blocks(k, alone, (8, 8), lambda w, h: (w, -(-h // 2))))]
            steps += [("narrow", self.blocks(k + 1, paired, (2, 2)))]
        steps.append(("widen", self.blocks(mixed, sorted(widened), (8, 8))))
        for k in reversed(range(self.count - 1)):
            views = [v for v in self.having(k + 1) if k < mixed or v not in widened]
            # Corners of the wider level's texels.
            steps.append(("upsample", self.blocks(k, views, (8, 8), lambda w, h: (w // 2 + 1, h // 2 + 1))))
        return [(name, blocks) for name, blocks in steps if len(blocks)]

    def chain(self) -> tuple[np.ndarray, np.ndarray, int]:
        """All steps in a list: items, what `chain_kernel` knows of each four, both (b, 4) int32, and how many steps."""
        items, rows, steps, before = [np.zeros((0, 4), np.int32)], [np.zeros((0, 4), np.int32)], self.steps(True), 0
        for k, (name, blocks) in enumerate(steps):
            count = -(-len(blocks) // CHAINED)
            items += [blocks, np.full((count * CHAINED - len(blocks), 4), -1, np.int32)]
            row = (k, KINDS.index(name), before, count if k + 1 < len(steps) else -count)
            rows.append(np.tile(np.array(row, np.int32), (count, 1)))
            before = count
        return np.concatenate(items), np.concatenate(rows), len(steps)


@functools.lru_cache(maxsize=16)
def _pyramid(sizes: tuple[ViewSize, ...], settings: Settings) -> Pyramid:
    return Pyramid.of(sizes, settings)


def make_bloom(resources: Resources, request: Request, layout: ViewLayout) -> structs.Bloom:
    """Struct over bloom's buffers and settings, for its kernels and for display."""
    settings, pyramid = request.settings.bloom, _pyramid(layout.sizes, request.settings)
    exact, knee = settings.rung == "exact", settings.threshold * settings.knee
    bloom = structs.Bloom()
    bloom.texels = resources.channel("" if exact else "bloom", wp.uint64)
    bloom.full = resources.channel("bloom" if exact else "", wp.vec3)
    bloom.levels = wp.array(pyramid.rows, dtype=structs.BloomLevel, device=resources.device)
    bloom.bright = resources.frame.bright
    if bright_level(request) is None:
        bloom.bright = wp.ones(1, dtype=wp.int32, device=resources.device)
    bloom.level_count = pyramid.count
    # Bounded so that luminance times part times this, 2^32 times more, is finite.
    bloom.firefly = min(1.0 / settings.fireflies, 2.0**64) if settings.fireflies > 0.0 else 0.0
    bloom.threshold, bloom.knee, bloom.soft = settings.threshold, knee, 0.25 / knee if knee > 0.0 else 0.0
    return bloom


class BloomPass(Pass):
    """Light scattered by the lens, exposed."""

    name = "bloom"
    doc = "scatter light around what is bright"
    image = "read"
    scope = "frame_end"
    active_if = "some pixel exceeds the threshold"
    #: Whether all levels but the first are made in one launch; None: on a GPU.
    together: bool | None = None

    def active(self, resources: Resources) -> wp.array | None:
        """Shade's flag; display tests it too, so that nothing stale shows where the pass was skipped."""
        return None if bright_level(self.request) is None else resources.frame.bright

    @property
    def leaves_early(self) -> bool:
        """Two launches that look at the flag are cheaper than a conditional node; the reference has dozens."""
        return self.rung() != "exact"

    def rung(self) -> str:
        """Rung of the ladder."""
        return self.request.settings.bloom.rung

    @property
    def pyramid(self) -> Pyramid:
        """Levels of all views."""
        return _pyramid(self.layout.sizes, self.request.settings)

    def writes(self) -> dict[str, Buffer]:
        """Bloom, and what only this pass sees."""
        if self.rung() == "exact":
            names = ("bloom", "bloom_bright", "bloom_rows")
            return {n: Buffer(wp.vec3, max(self.layout.pixels, 1)) for n in names}
        names = ("bloom", "bloom_bright") if self.rung() == "neighbourhood" else ("bloom",)
        return {n: Buffer(wp.uint64, max(self.pyramid.texels, 1)) for n in names}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, upload the tables."""
        settings, device = self.request.settings.bloom, resources.device
        self.bloom = make_bloom(resources, self.request, self.layout)
        image = make_image(resources, self.request, self.source)
        self.radiance, self.color = image.half, image.full
        if settings.rung == "exact":
            self._prepare_exact(device)
            return
        from ..kernels import bloom, bloom_bright

        self.kernels = bloom
        self.bright = bloom_bright.make_bright_kernel(not float_image(self.request), settings.fireflies > 0.0)
        pyramid, steps = self.pyramid, []
        shown = pyramid.having(0)
        strips = pyramid.blocks(0, shown, (bloom_bright.STRIP_WIDTH, 2 * bloom_bright.STRIP_HEIGHT))
        self.strips = (table_array(strips, device), len(strips))
        self.chained = settings.rung == "mip_chain" and (device.is_cuda if self.together is None else self.together)
        if settings.rung == "neighbourhood":
            steps = [("gather", pyramid.blocks(0, shown, (8, 8)))]
        elif self.chained:
            self._prepare_chain(device)
        else:
            steps = pyramid.steps(False)
        self.steps = [
            (getattr(bloom, f"{name}_kernel"), table_array(blocks, device), len(blocks)) for name, blocks in steps
        ]

    def _prepare_chain(self, device: wp.Device) -> None:
        """Upload the items; on the CPU, where blocks have no memory of their own, the lane at work has some here."""
        from ..kernels import bloom_chain

        items, steps, count = self.pyramid.chain()
        self.chain, self.items = bloom_chain, (table_array(items, device), table_array(steps, device), len(items))
        self.counters = wp.zeros(32 * (count + 1), dtype=wp.int32, device=device)
        self.scratch = wp.zeros(1 if device.is_cuda else bloom_chain.SHARED, dtype=wp.uint64, device=device)

    def _prepare_exact(self, device: wp.Device) -> None:
        """Weights of all Gaussians, out to five standard deviations, views of one height sharing theirs."""
        from ..kernels import bloom_exact as kernels

        settings = self.request.settings.bloom
        counts = [0 if s.depth_only else level_count(s.height, settings.radius) for s in self.layout.sizes]
        self.gaussian_count = max(counts, default=0)
        rows = np.zeros((len(counts), self.gaussian_count), kernels.Gaussian.numpy_dtype())
        tables, first = [], 0
        starts = []
        for k in range(self.gaussian_count):
            deviation = spread(k + 1)
            radius = math.ceil(5.0 * deviation)
            row = np.exp(-0.5 * (np.arange(radius + 1) / deviation) ** 2)
            tables.append(row / (2.0 * row.sum() - row[0]))
            starts.append((first, radius))
            first += radius + 1
        for v, count in enumerate(counts):
            for k, share in enumerate(weights(count, settings.falloff) if count else ()):
                rows[v, k] = (*starts[k], share)
        self.gaussians = wp.array(rows.reshape(-1), dtype=kernels.Gaussian, device=device)
        self.weights = wp.array(np.concatenate([*tables, [0.0]]), dtype=wp.float32, device=device)
        self.kernels = kernels
        self.bright = kernels.make_bright_pixels_kernel(not float_image(self.request))

    def run(self, resources: Resources) -> None:
        """Bright parts, then down and up the pyramid, or the window, or one Gaussian after the other."""
        if self.rung() == "exact":
            self._run_exact(resources)
            return
        frame, texels, window = resources.frame, resources.channels["bloom"], self.rung() == "neighbourhood"
        bright = resources.channels["bloom_bright"] if window else texels

        def launch(kernel: wp.Kernel, blocks: wp.array, count: int, inputs: list, out: wp.array) -> None:
            values = [frame.views, blocks, *inputs, FIRST]
            resources.program.launch(kernel, count * 64, values, [out], block_dim=self.kernels.BLOCK_DIM, band=64)

        launch(self.bright, *self.strips, [self.radiance, self.color, self.bloom], bright)
        for kernel, blocks, count in self.steps:
            inputs = [bright, self.bloom, self.request.settings.bloom.window] if window else [self.bloom.levels]
            launch(kernel, blocks, count, inputs, texels)
        if self.chained:
            # No band: the items are done in order.
            items, steps, count = self.items
            inputs, outputs = [frame.views, items, steps, self.bloom, self.scratch], [self.counters, texels]
            resources.program.launch(
                self.chain.chain_kernel, count * 64, inputs, outputs, block_dim=self.chain.BLOCK_DIM
            )

    def _run_exact(self, resources: Resources) -> None:
        kernels, frame, blocks = self.kernels, resources.frame, resources.blocks
        bright, rows, out = (resources.channels[n] for n in ("bloom_bright", "bloom_rows", "bloom"))
        count, size, block_dim = self.gaussian_count, len(self.layout.blocks) * 64, kernels.BLOCK_DIM

        def launch(kernel: wp.Kernel, inputs: list, target: wp.array) -> None:
            values = [frame.views, blocks, *inputs, FIRST]
            resources.program.launch(kernel, size, values, [target], block_dim=block_dim, band=64)

        launch(self.bright, [self.radiance, self.color, self.bloom], bright)
        for k in range(count):
            launch(kernels.blur_rows_kernel, [bright, self.gaussians, self.weights, count, k], rows)
            launch(kernels.blur_columns_kernel, [rows, self.gaussians, self.weights, count, k], out)

    def bytes_moved(self) -> int:
        """Radiance in; each level down and up once, or each Gaussian's rows and columns."""
        pixels, image = self.layout.pixels, image_bytes(self.request)
        if self.rung() == "exact":
            radius, shown = self.request.settings.bloom.radius, [s for s in self.layout.sizes if not s.depth_only]
            most = max((level_count(s.height, radius) for s in shown), default=0)
            return pixels * (image + 12 + most * 60)
        return pixels * image + 8 * self.pyramid.texels * (3 if self.rung() == "neighbourhood" else 4)
