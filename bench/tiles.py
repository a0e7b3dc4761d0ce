"""Bench `tiles`: tile size by number of lights by resolution, and how many lights each tile considers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Settings

from .cases import RESOLUTIONS, TILE_LIGHTS, TILE_SIZES, many_lights
from .lights import time_lighting
from .probe import lights_per_tile, open_scene, plan_of
from .record import Record
from .timing import REPEATS

__all__ = ["read_heat_map", "run"]

#: Mean of lights at a pixel.
MEAN = 5
QUICK_RESOLUTIONS = {"quick": (160, 90)}
QUICK_LIGHTS, QUICK_TILES = (10, 50), (16, 64)
#: Case of the heat map: resolution, lights, tile size.
HEAT_MAP = ("1080p", 1000, 16)
QUICK_HEAT_MAP = ("quick", 50, 16)


def run(
    device: wp.Device, *, quick: bool, settings: Settings, note: Any, keep: Callable[[Record], Any] | None = None
) -> Record:
    """Time every combination.

    Args:
        device: Where to run.
        quick: Small cases and few repeats.
        settings: Settings of all cases but the tile size.
        note: Function of a text that tells how far it is.
        keep: Called with what is there after each combination, so that nothing measured is lost.

    Returns:
        One row a combination, and the lights of each tile of one of them as a heat map.
    """
    rows: list[dict[str, Any]] = []
    result: Record = {"mean": MEAN, "rows": rows}
    for lights in QUICK_LIGHTS if quick else TILE_LIGHTS:
        scene = many_lights(lights, MEAN, quick=quick)
        for name, size in (QUICK_RESOLUTIONS if quick else RESOLUTIONS).items():
            renderer = open_scene(scene, size, device, ("display",))
            for tile in QUICK_TILES if quick else TILE_SIZES:
                note(f"{lights:,} lights, {name}, tiles of {tile} px")
                culling = settings.light_culling.replace(tile_size=tile)
                plan = plan_of(renderer, settings.replace(light_culling=culling))
                row = {"resolution": name, "width": size[0], "height": size[1], "lights": lights, "tile_size": tile}
                row |= time_lighting(plan.resources.program, 5 if quick else REPEATS)
                counts = lights_per_tile(plan)
                row |= {"tile.lights_mean": round(float(counts.mean()), 3), "tile.lights_max": int(counts.max())}
                rows.append(row)
                if (name, lights, tile) == (QUICK_HEAT_MAP if quick else HEAT_MAP):
                    head = ("resolution", "width", "height", "lights", "tile_size")
                    result["heat_map"] = {key: row[key] for key in head}
                    result["heat_map_counts"] = [" ".join(map(str, line)) for line in counts.tolist()]
                if keep:
                    keep(result)
    return result


def read_heat_map(record: Record) -> np.ndarray:
    """Lights of each tile of the case `heat_map` names, shape (tiles down, tiles across)."""
    return np.array([[int(n) for n in line.split()] for line in record["heat_map_counts"]])
