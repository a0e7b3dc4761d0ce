"""Light culling: depth bounds, coarse masks, tile masks."""

from __future__ import annotations

import warp as wp

from ..errors import CapacityError
from ..kernels import light_culling as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass
from .resolve import is_lit

__all__ = ["LightCullingPass", "make_masks"]


def make_masks(resources: Resources, capacity: int) -> structs.LightMasks:
    """Struct over the mask channels of a plan."""
    masks = structs.LightMasks()
    fields = {
        "words": wp.uint32,
        "summary": wp.uint32,
        "coarse": wp.uint32,
        "bounds": wp.vec2,
        "coarse_bounds": wp.vec2,
    }
    for field, dtype in fields.items():
        setattr(masks, field, resources.channel(f"mask_{field}", dtype))
    masks.words_per_tile = -(-capacity // 32)
    masks.summary_per_tile = -(-masks.words_per_tile // 32)
    masks.tile_shift, masks.coarse_shift = resources.layout.tile_shift, resources.layout.coarse_shift
    return masks


class LightCullingPass(Pass):
    """Which lights each tile considers."""

    name = "light_culling"
    doc = "find the lights each screen tile needs"

    def called_for(self) -> str | None:
        """Lights, and something lit by them."""
        if self.request.features.kinds and is_lit(self.request):
            return "the scene has lights"
        return None

    def rung(self) -> str:
        """Rung and tile size."""
        s = self.request.settings.light_culling
        return s.rung if s.rung == "brute_force" else f"{s.rung}, {s.tile_size} px"

    def reads(self) -> tuple[str, ...]:
        """Depth and lights."""
        return ("depth", "staged_lights")

    def writes(self) -> dict[str, Buffer]:
        """Masks and bounds."""
        words = -(-self.request.features.light_capacity // 32)
        summary = -(-words // 32)
        tiles, coarse = len(self.layout.tiles), len(self.layout.coarse_tiles)
        if tiles * words > 2**31 - 1:
            raise CapacityError(
                f"light masks: expected tiles x mask words of at most {2**31 - 1}, got {tiles} x {words}; "
                "use larger light tiles"
            )
        result = {"mask_words": Buffer(wp.uint32, tiles * words), "mask_summary": Buffer(wp.uint32, tiles * summary)}
        if self.request.settings.light_culling.rung != "brute_force":
            result |= {
                "mask_coarse": Buffer(wp.uint32, coarse * words),
                "mask_bounds": Buffer(wp.vec2, tiles),
                "mask_coarse_bounds": Buffer(wp.vec2, coarse),
            }
        return result

    def prepare(self, resources: Resources) -> None:
        """Fetch kernels, build the struct."""
        self.masks = make_masks(resources, self.request.features.light_capacity)
        rung = self.request.settings.light_culling.rung
        if rung != "brute_force":
            self.coarse, self.fine = kernels.make_light_culling_kernels(rung == "tiles_depth")

    def run(self, resources: Resources) -> None:
        """Bounds, coarse, fine."""
        program, frame, masks = resources.program, resources.frame, self.masks
        tiles, coarse = len(self.layout.tiles), len(self.layout.coarse_tiles)
        program.call(masks.summary.zero_)
        block = kernels.BLOCK_DIM
        if self.request.settings.light_culling.rung == "brute_force":
            program.launch(
                kernels.all_lights_kernel,
                (tiles, masks.words_per_tile),
                [frame.values, FIRST],
                [masks],
                block_dim=block,
                band=1,
            )
            return
        shift, coarse_shift = masks.tile_shift, masks.coarse_shift
        depth = resources.channels["depth"]
        program.call(masks.coarse.zero_)
        # Tile operations use one arena a process on the CPU backend: these two stay on one host thread.
        program.launch(
            kernels.tile_bounds_kernel,
            tiles,
            [frame.views, resources.tiles, depth, shift, FIRST],
            [masks.bounds],
            block_dim=block,
            tiled=True,
        )
        program.launch(
            kernels.coarse_bounds_kernel,
            coarse,
            [frame.views, resources.coarse_tiles, masks.bounds, shift, coarse_shift, FIRST],
            [masks.coarse_bounds],
            block_dim=block,
            tiled=True,
        )
        lights = resources.lights.staged
        program.launch(
            self.coarse,
            (coarse, self.request.features.light_capacity),
            [frame.views, frame.values, resources.coarse_tiles, lights, FIRST],
            [masks],
            block_dim=block,
            band=1,
        )
        program.launch(
            self.fine,
            (tiles, masks.words_per_tile),
            [frame.views, resources.tiles, lights, FIRST],
            [masks],
            block_dim=block,
            band=1,
        )

    def bytes_moved(self) -> int:
        """Depth in, masks out."""
        words = -(-self.request.features.light_capacity // 32)
        return self.layout.pixels * 4 + len(self.layout.tiles) * words * 4
