"""Light culling: depth bounds, coarse masks, tile masks; of all tiles at once, or of one band of them at a time.

Masks take tiles times lights bits, which for large images and many lights is more than the frame's other buffers. Past
`light_culling.mask_budget_bytes` the tiles are cut into bands. The pass then finds the depth bounds of all tiles, and
the shading alternates between filling the masks of a band and lighting its pixels (`ShadePass`).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import numpy as np
import warp as wp

from ..errors import CapacityError
from ..kernels import light_culling as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from ..views import ViewLayout
from .base import Buffer, Pass, Request
from .resolve import depth_buffers, depth_format

__all__ = ["Band", "LightCullingPass", "culls_by_band", "fill_masks", "make_masks", "mask_bands", "mask_words"]

#: Mask words that a 32-bit index reaches.
MAX_WORDS = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class Band:
    """What is culled and shaded together: rows of coarse tiles, over all views in order, as slices of the tables."""

    tiles: slice
    coarse: slice
    blocks: slice

    @property
    def tile_count(self) -> int:
        """Tiles of the band."""
        return self.tiles.stop - self.tiles.start

    @property
    def coarse_count(self) -> int:
        """Coarse tiles of the band."""
        return self.coarse.stop - self.coarse.start


def mask_words(request: Request) -> tuple[int, int]:
    """Mask words and summary words of a tile."""
    words = -(-request.features.light_capacity // 32)
    return words, -(-words // 32)


def _row_ends(layout: ViewLayout) -> np.ndarray:
    """(rows + 1, 3) int64: tiles, coarse tiles and pixel blocks before each row of coarse tiles, and before the end.

    The tables are row-major view by view, and a coarse tile's side is a multiple of a tile's and of a block's.
    """
    sides = (layout.tile_size, layout.tile_size << layout.coarse_shift, structs.PIXEL_BLOCK)
    ends = [np.zeros((1, 3), np.int64)]
    for size in layout.sizes:
        if not size.depth_only:
            below = np.arange(sides[1], size.height + sides[1], sides[1], dtype=np.int64).clip(max=size.height)
            columns = [-(-below // side) * -(-size.width // side) for side in sides]
            ends.append(ends[-1][-1] + np.stack(columns, axis=1))
    return np.concatenate(ends)


def mask_bands(request: Request, layout: ViewLayout) -> tuple[Band, ...]:
    """Cut the tiles into bands whose masks fit the budget; one band where all do.

    Bands are cut between rows of coarse tiles, so that no tile is parted from its coarse tile nor a pixel from its
    tile, and each is filled as far as it goes. A row that exceeds the budget by itself is a band all the same.
    """
    words, summary = mask_words(request)
    ends = _row_ends(layout)
    sizes = 4 * (ends[:, 0] * (words + summary) + ends[:, 1] * words)
    budget, last = request.settings.light_culling.mask_budget_bytes, len(ends) - 1
    cuts = [0]
    while cuts[-1] < last:
        fits = int(np.searchsorted(sizes, sizes[cuts[-1]] + budget, side="right")) - 1
        cuts.append(max(fits, cuts[-1] + 1))
    if last == 0 or not request.features.kinds:
        cuts = [0, last]
    limits = ends[cuts].tolist()
    return tuple(
        Band(*(slice(a, b) for a, b in zip(low, high, strict=True))) for low, high in itertools.pairwise(limits)
    )


def culls_by_band(request: Request, bands: tuple[Band, ...]) -> bool:
    """Whether masks are filled anew for each band; by brute force all tiles' masks are the same."""
    return len(bands) > 1 and request.settings.light_culling.rung != "brute_force"


def make_masks(resources: Resources, request: Request, band: Band) -> structs.LightMasks:
    """Struct over the mask channels of a plan while they hold a band."""
    masks = structs.LightMasks()
    for field in ("words", "summary", "coarse"):
        setattr(masks, field, resources.channel(f"mask_{field}", wp.uint32))
    # Bounds are kept for all tiles.
    for field, rows in (("bounds", band.tiles), ("coarse_bounds", band.coarse)):
        name = f"mask_{field}"
        whole = resources.channel(name, wp.vec2)
        setattr(masks, field, whole[rows] if name in resources.channels else whole)
    masks.words_per_tile, masks.summary_per_tile = mask_words(request)
    masks.first_tile, masks.first_coarse = band.tiles.start, band.coarse.start
    masks.tile_shift, masks.coarse_shift = resources.layout.tile_shift, resources.layout.coarse_shift
    return masks


def fill_masks(
    resources: Resources, request: Request, culling: tuple[Any, Any], masks: structs.LightMasks, band: Band
) -> None:
    """Add the launches that fill the masks of a band from the bounds: clear, coarse tiles, tiles.

    Args:
        resources: Of a plan whose bounds are filled by then; the launches go to its program.
        request: What the plan was built for.
        culling: The two kernels of `make_light_culling_kernels`.
        masks: Struct of the band.
        band: The band.
    """
    program, frame, lights = resources.program, resources.frame, resources.lights.staged
    program.call(masks.summary.zero_)
    program.call(masks.coarse.zero_)
    program.launch(
        culling[0],
        (band.coarse_count, request.features.light_capacity),
        [frame.views, frame.values, resources.coarse_tiles[band.coarse], lights, FIRST],
        [masks],
        block_dim=kernels.BLOCK_DIM,
        band=1,
    )
    program.launch(
        culling[1],
        (band.tile_count, masks.words_per_tile),
        [frame.views, resources.tiles[band.tiles], lights, FIRST],
        [masks],
        block_dim=kernels.BLOCK_DIM,
        band=1,
    )


class LightCullingPass(Pass):
    """Which lights each tile considers."""

    name = "light_culling"
    doc = "find the lights each screen tile needs"

    @functools.cached_property
    def bands(self) -> tuple[Band, ...]:
        """Bands the tiles are processed in."""
        return mask_bands(self.request, self.layout)

    def called_for(self) -> str | None:
        """Lights, and something lit by them."""
        if self.request.features.kinds and self.request.lit:
            return "the scene has lights"
        return None

    def why_not(self) -> str:
        """No light, or nothing lit."""
        return "no light in the scene" if not self.request.features.kinds else "no lit output asked for"

    def rung(self) -> str:
        """Rung, tile size, and the bands where there are several."""
        s = self.request.settings.light_culling
        parts = [s.rung] if s.rung == "brute_force" else [s.rung, f"{s.tile_size} px"]
        return ", ".join(parts + [f"{len(self.bands)} bands"] * (len(self.bands) > 1))

    def reads(self) -> tuple[str, ...]:
        """Depth and lights."""
        return (*depth_buffers(self.request, self.layout), "staged_lights")

    def writes(self) -> dict[str, Buffer]:
        """Masks of the largest band, and bounds of all tiles."""
        words, summary = mask_words(self.request)
        tiles, coarse = max(b.tile_count for b in self.bands), max(b.coarse_count for b in self.bands)
        if tiles * words > MAX_WORDS:
            raise CapacityError(
                f"light masks: expected tiles x mask words of at most {MAX_WORDS} in a row of coarse tiles, "
                f"got {tiles} x {words}; use larger light tiles"
            )
        result = {"mask_words": Buffer(wp.uint32, tiles * words), "mask_summary": Buffer(wp.uint32, tiles * summary)}
        if self.request.settings.light_culling.rung != "brute_force":
            result |= {
                "mask_coarse": Buffer(wp.uint32, coarse * words),
                "mask_bounds": Buffer(wp.vec2, len(self.layout.tiles)),
                "mask_coarse_bounds": Buffer(wp.vec2, len(self.layout.coarse_tiles)),
            }
        return result

    def prepare(self, resources: Resources) -> None:
        """Fetch kernels, build the struct."""
        rung = self.request.settings.light_culling.rung
        if rung != "brute_force":
            self.culling = kernels.make_light_culling_kernels(rung == "tiles_depth")
            self.bounds = kernels.tile_bounds_kernel
            if depth_format(self.request) != "float32":
                from ..kernels.coded_bounds import make_coded_bounds_kernel

                self.bounds = make_coded_bounds_kernel(depth_format(self.request))
        self.masks = make_masks(resources, self.request, self.bands[0])

    def run(self, resources: Resources) -> None:
        """Bounds, then the masks unless they come band by band."""
        if self.request.settings.light_culling.rung == "brute_force":
            resources.program.call(self.masks.summary.zero_)
            resources.program.launch(
                kernels.all_lights_kernel,
                (max(b.tile_count for b in self.bands), self.masks.words_per_tile),
                [resources.frame.values, FIRST],
                [self.masks],
                block_dim=kernels.BLOCK_DIM,
                band=1,
            )
            return
        self._find_bounds(resources)
        if not culls_by_band(self.request, self.bands):
            fill_masks(resources, self.request, self.culling, self.masks, self.bands[0])

    def _find_bounds(self, resources: Resources) -> None:
        program, views, channels = resources.program, resources.frame.views, resources.channels
        (depth,) = depth_buffers(self.request, self.layout)
        shift, coarse_shift = self.layout.tile_shift, self.layout.coarse_shift
        # Tile operations use one arena a process on the CPU backend: these two stay on one host thread.
        program.launch(
            self.bounds,
            len(self.layout.tiles),
            [views, resources.tiles, channels[depth], shift, FIRST],
            [channels["mask_bounds"]],
            block_dim=kernels.BLOCK_DIM,
            tiled=True,
        )
        program.launch(
            kernels.coarse_bounds_kernel,
            len(self.layout.coarse_tiles),
            [views, resources.coarse_tiles, channels["mask_bounds"], shift, coarse_shift, FIRST],
            [channels["mask_coarse_bounds"]],
            block_dim=kernels.BLOCK_DIM,
            tiled=True,
        )

    def bytes_moved(self) -> int:
        """Depth in, masks out; masks that come band by band are written, and counted, by the shading."""
        (buffer,) = depth_buffers(self.request, self.layout).values()
        depth = self.layout.pixels * wp.types.type_size_in_bytes(buffer.dtype)
        return depth if culls_by_band(self.request, self.bands) else depth + self.writes()["mask_words"].count * 4
