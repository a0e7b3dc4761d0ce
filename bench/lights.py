"""Bench `lights`: 1 to 10 000 lights of which 5, 20 and 80 reach a pixel, at 1920x1080; brute force beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from warp_deferred import Settings

from .cases import BRUTE_FORCE_LIMIT, LIGHT_COUNTS, MEANS, RESOLUTIONS, many_lights, reachable_mean
from .probe import lit_lights, open_scene, plan_of
from .record import Record
from .timing import REPEATS, time_program

__all__ = ["LIGHTING", "run", "time_lighting"]

#: Staging, culling and shading, side by side in the frame.
LIGHTING = ("lights", "light_culling", "shade")
QUICK_SIZE = (160, 90)
QUICK_COUNTS, QUICK_MEANS = (1, 20), (5,)


def run(
    device: wp.Device, *, quick: bool, settings: Settings, note: Any, keep: Callable[[Record], Any] | None = None
) -> Record:
    """Time every number of lights at every mean it can give.

    Args:
        device: Where to run.
        quick: Small cases and few repeats.
        settings: Settings of all cases.
        note: Function of a text that tells how far it is.
        keep: Called with what is there after each row, so that nothing measured is lost.
    """
    size = QUICK_SIZE if quick else RESOLUTIONS["1080p"]
    rows = []
    for lights in QUICK_COUNTS if quick else LIGHT_COUNTS:
        reached = [reachable_mean(lights, mean) for mean in (QUICK_MEANS if quick else MEANS)]
        for mean in dict.fromkeys(reached):
            note(f"{lights:,} lights, mean {mean:g}")
            rows.append(_row(lights, mean, size, device, settings, quick))
            if keep:
                keep({"rows": rows})
    return {"rows": rows}


def time_lighting(program: Any, repeats: int) -> dict[str, float]:
    """Metrics of culling alone, shading alone, and staging, culling and shading as one graph."""
    row = time_program(program, LIGHTING, repeats=repeats).metrics("total")
    row |= time_program(program, ("light_culling",), repeats=repeats).metrics("light_culling")
    return row | time_program(program, ("shade",), repeats=repeats).metrics("shade")


def _row(
    lights: int, mean: float, size: tuple[int, int], device: wp.Device, settings: Settings, quick: bool
) -> dict[str, Any]:
    scene, repeats = many_lights(lights, mean, quick=quick), 5 if quick else REPEATS
    row: dict[str, Any] = {"lights": lights, "mean": mean, "width": size[0], "height": size[1]}
    row |= lit_lights(scene, size, device, settings)
    renderer = open_scene(scene, size, device, ("display",))
    row |= time_lighting(plan_of(renderer, settings).resources.program, repeats)
    if lights <= BRUTE_FORCE_LIMIT:
        all_lights = settings.replace(light_culling=settings.light_culling.replace(rung="brute_force"))
        program = plan_of(renderer, all_lights).resources.program
        row |= time_program(program, LIGHTING, repeats=repeats).metrics("brute_force")
    return row
