"""Bench `frame`: whole frames, pass by pass, beside the least time their memory traffic allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from warp_deferred import Settings

from .cases import FrameCase, frame_cases
from .probe import bytes_by_pass, lit_lights, open_scene, plan_of, raster_counts
from .record import Record
from .timing import REPEATS, copy_bandwidth, sample_sections, time_passes, time_program

__all__ = ["floor", "frame_row", "pass_names", "run"]


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Any,
    huge: bool = False,
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Time every frame and its passes.

    Args:
        device: Where to run.
        quick: A small case and few repeats.
        settings: Settings of all cases.
        note: Function of a text that tells how far it is.
        huge: Whether to render 16384x16384 pixels, too.
        keep: Called with what is there after each frame, so that nothing measured is lost.

    Returns:
        Copy bandwidth and one row a frame. Metrics: `frame.*` is the graph of the whole frame with all its samples,
        `sample.*` that of one sample where a frame takes several, `pass.NAME.*` each pass as a graph of
        its own, run once, `pass.NAME.times_floor` its time over its bytes at the copy bandwidth.
    """
    bandwidth = copy_bandwidth(device)
    result: Record = {"copy_bytes_per_s": round(bandwidth), "rows": []}
    for case in frame_cases(device.is_cuda, quick=quick, huge=huge):
        note(case.title)
        result["rows"].append(frame_row(case, device, settings, bandwidth, 5 if quick else REPEATS))
        if keep:
            keep(result)
    return result


def frame_row(case: FrameCase, device: wp.Device, settings: Settings, bandwidth: float, repeats: int) -> dict[str, Any]:
    """Time one frame and its passes.

    Args:
        case: The frame.
        device: Where to run.
        settings: Settings.
        bandwidth: Bytes a second of a copy, for the floors.
        repeats: Measurements of each figure.
    """
    scene, size = case.build(), (case.width, case.height)
    row: dict[str, Any] = {
        "case": case.name, "title": case.title, "source": case.source, "width": case.width, "height": case.height,
        "triangles": scene.triangle_count, "lights": len(scene.lights),
    }  # fmt: skip
    row |= lit_lights(scene, size, device, settings)
    renderer = open_scene(scene, size, device, ("display",))
    plan = plan_of(renderer, settings)
    program = plan.resources.program
    whole = time_program(program, repeats=repeats)
    moved = bytes_by_pass(plan)
    frame_bytes = sum(report.bytes or 0 for report in plan.reports(measure=False) if report.runs)
    row |= whole.metrics("frame") | floor("frame", whole.median, frame_bytes, bandwidth)
    if sample := sample_sections(program):
        row |= {"samples": program.samples} | time_program(program, sample, repeats=repeats).metrics("sample")
    passes = time_passes(program, repeats=repeats)
    for name, timing in passes.items():
        row |= timing.metrics(f"pass.{name}") | floor(f"pass.{name}", timing.median, moved[name], bandwidth)
    row["passes.sum_ms"] = round(sum(t.median for t in passes.values()), 5)
    memory = renderer.memory_report()
    row |= {"memory.bytes": memory.total, "scene.bytes": memory.scene}
    return row | raster_counts(plan)


def floor(name: str, milliseconds: float, moved: int, bandwidth: float) -> dict[str, float]:
    """Metrics of a memory floor: `name.bytes`, `name.floor_ms` and, unless that is 0, `name.times_floor`."""
    least = moved / bandwidth * 1e3
    row: dict[str, float] = {f"{name}.bytes": moved, f"{name}.floor_ms": round(least, 6)}
    return row | ({f"{name}.times_floor": round(milliseconds / least, 2)} if least > 0.0 else {})


def pass_names(row: dict[str, Any]) -> list[str]:
    """Names of the passes of a row, in frame order."""
    return [key.split(".")[1] for key in row if key.startswith("pass.") and key.endswith(".ms")]
