"""Bench `triangles`: the six rows of the raster table at 1920x1080.

Terrain: the whole compact G-buffer (clear, cull, raster, resolve). The others: clear and visibility only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from warp_deferred import Settings

from .cases import RESOLUTIONS, TRIANGLE_CASES, TriangleCase
from .probe import bytes_by_pass, open_scene, plan_of, raster_counts
from .record import Record
from .timing import REPEATS, copy_bandwidth, time_program

__all__ = ["run"]

QUICK_SIZE = (160, 90)
VISIBILITY = ("clusters", "raster")


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Any,
    only: str = "",
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Time every case.

    Args:
        device: Where to run.
        quick: Small cases and few repeats.
        settings: Settings of all cases.
        note: Function of a text that tells how far it is.
        only: Name of the one case wanted.
        keep: Called with what is there after each case, so that nothing measured is lost.

    Returns:
        Copy bandwidth and one row a case.
    """
    bandwidth = copy_bandwidth(device)
    result: Record = {"copy_bytes_per_s": round(bandwidth), "rows": []}
    for case in TRIANGLE_CASES:
        if not only or only == case.name:
            note(case.title)
            result["rows"].append(_row(case, device, quick, settings, bandwidth))
            if keep:
                keep(result)
    return result


def _row(case: TriangleCase, device: wp.Device, quick: bool, settings: Settings, bandwidth: float) -> dict[str, Any]:
    scene = case.quick() if quick else case.build()
    width, height = QUICK_SIZE if quick else RESOLUTIONS["1080p"]
    # A lit output is what makes the resolve write the G-buffer; the passes behind it are not timed.
    renderer = open_scene(scene, (width, height), device, ("display",) if case.whole else ("depth",))
    plan = plan_of(renderer, settings)
    program, repeats = plan.resources.program, 5 if quick else REPEATS
    passes = (*VISIBILITY, "resolve") if case.whole else VISIBILITY
    whole = time_program(program, passes, repeats=repeats)
    moved = sum(bytes_by_pass(plan)[name] for name in passes)
    row: dict[str, Any] = {
        "case": case.name, "title": case.title, "width": width, "height": height, "triangles": scene.triangle_count,
        "passes": " + ".join(passes), **whole.metrics("total"),
    }  # fmt: skip
    if case.whole:
        row |= time_program(program, VISIBILITY, repeats=repeats).metrics("visibility")
        row |= time_program(program, ("resolve",), repeats=repeats).metrics("resolve")
    # The clear of the keys runs beside the culling, so raster alone is the difference, not a graph of its own.
    culling = time_program(program, ("clusters",), repeats=repeats).median
    row["raster.ms"] = round(row.get("visibility.ms", whole.median) - culling, 6)
    row |= {"bytes": moved, "floor.ms": round(moved / bandwidth * 1e3, 6)}
    row["times_floor"] = round(whole.median / (moved / bandwidth * 1e3), 3)
    # The culling's own graph clears the counters beside it: one whole frame fills them again.
    plan.replay()
    memory = renderer.memory_report()
    return row | raster_counts(plan) | {"memory.bytes": memory.total, "scene.bytes": memory.scene}
