"""What a plan holds after a frame: lights of each tile, lights at each pixel, triangles that are large."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Pass, Renderer, Scene, Settings
from warp_deferred.passes.light_culling import (
    Band,
    LightCullingPass,
    culls_by_band,
    fill_masks,
    make_masks,
    mask_words,
)
from warp_deferred.passes.raster import large_stored
from warp_deferred.plan import Plan
from warp_deferred.program import Program

from .timing import run_until

__all__ = ["bytes_by_pass", "count_lights", "lights_per_tile", "lit_lights", "open_scene", "plan_of", "raster_counts"]


def open_scene(
    scene: Scene, size: tuple[int, int], device: wp.Device, outputs: Sequence[str], passes: Sequence[Pass] = ()
) -> Renderer:
    """Make a renderer that follows the scene's settings, so that `plan_of` can change them without a new upload."""
    return Renderer(scene, width=size[0], height=size[1], device=device, outputs=outputs, passes=passes)


def plan_of(renderer: Renderer, settings: Settings) -> Plan:
    """Render one frame with these settings and return its plan: kernels are loaded, cameras and lights uploaded."""
    renderer.scene.settings = settings
    renderer.render()
    wp.synchronize_device(renderer.device)
    return renderer.plan


def bytes_by_pass(plan: Plan) -> dict[str, int]:
    """Fewest bytes each pass must move."""
    return {stage.name: stage.bytes_moved() for stage in plan.passes}


def lights_per_tile(plan: Plan) -> np.ndarray:
    """Lights in each tile's mask, shape (tiles down, tiles across) int32; the first view's, read back.

    Masks that come in bands are filled and read one band after the other, outside the frame.
    """
    run_until(plan.resources.program, "light_culling")
    layout = plan.layout
    tile = layout.tile_size
    across, down = -(-layout.sizes[0].width // tile), -(-layout.sizes[0].height // tile)
    culling = next(stage for stage in plan.passes if isinstance(stage, LightCullingPass))
    per_tile = mask_words(plan.request)[0]
    counts = []
    for band in culling.bands:
        if culls_by_band(plan.request, culling.bands):
            _fill(plan, culling, band)
        words = plan.resources.channels["mask_words"].numpy()[: band.tile_count * per_tile]
        counts.append(np.bitwise_count(words.reshape(-1, per_tile)).sum(axis=1, dtype=np.int32))
    return np.concatenate(counts)[: across * down].reshape(down, across)


def _fill(plan: Plan, culling: LightCullingPass, band: Band) -> None:
    """Fill the masks of one band now."""
    program = Program(plan.resources.device, plan.request.threads)
    program.begin("masks")
    resources = dataclasses.replace(plan.resources, program=program)
    fill_masks(resources, plan.request, culling.culling, make_masks(resources, plan.request, band), band)
    program.load()
    program.replay()


def lit_lights(scene: Scene, size: tuple[int, int], device: wp.Device, settings: Settings) -> dict[str, float]:
    """Mean and most lights that light a pixel which shows a surface, and the share of such pixels."""
    scene.settings = settings
    frame = open_scene(scene, size, device, ("light_count", "instance_id")).render()
    return count_lights(frame.numpy("light_count"), frame.numpy("instance_id") >= 0)


def count_lights(lights: np.ndarray, surface: np.ndarray) -> dict[str, float]:
    """Summarise lights at each pixel over those that show a surface."""
    seen = lights[surface]
    return {
        "lit.mean": round(float(seen.mean()), 4) if seen.size else 0.0,
        "lit.max": int(seen.max(initial=0)),
        "coverage": round(float(surface.mean()), 4),
    }


def raster_counts(plan: Plan) -> dict[str, Any]:
    """Large triangles and bin entries of the last frame, beside what fits; nothing where nothing is binned."""
    channels, raster = plan.resources.channels, plan.request.settings.raster
    if "large_count" not in channels:
        return {}
    entries = int(channels["bin_offsets"].numpy()[-1]) + int(channels["bin_counts"].numpy()[-1])
    return {
        "raster.large_triangles": sum(large_stored(channels["large_count"].numpy(), raster.large_capacity)),
        "raster.large_capacity": raster.large_capacity,
        "raster.bin_entries": entries,
        "raster.bin_capacity": raster.bin_capacity,
    }
