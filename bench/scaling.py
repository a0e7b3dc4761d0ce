"""Bench `scaling`: how time and memory grow with triangles, lights, pixels and views, one varied and the rest fixed.

Growth is told in two ways. The exponent is the slope of log(figure) over log(n), by least squares over the upper half
of the points, where what is fixed no longer hides what grows. The model figure = a + b n, by least squares of relative
errors over all points, tells the fixed cost a and the price b of one more, neither of them below zero.
"""

from __future__ import annotations

import dataclasses
import gc
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Renderer, Scene, Settings, load

from .cases import reachable_mean
from .effects import reason
from .frame import pass_names
from .layout import count_text
from .probe import open_scene, plan_of
from .record import Record
from .timing import MIN_REPEATS, REPEATS, time_passes, time_program

__all__ = ["AXES", "Axis", "fit", "run"]

#: Most triangles of a terrain that is one mesh; to cut more into clusters takes the host minutes.
WHOLE_TRIANGLES = 10_000_000
#: Most triangles of the one mesh that larger terrains are tiled with.
TILE_TRIANGLES = 1_000_000
#: Side of the terrain [m].
GROUND = 20.0
#: Fewest points an exponent is fitted to.
FEWEST = 3

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Fixed:
    """What is not varied, on one kind of device.

    Attributes:
        screen: Size of the picture where triangles or lights are varied [px].
        city: Triangles of the scene whose lights are varied.
        hills: Triangles of the terrain whose pixels are varied.
        lamps: Lights over that terrain.
        side: Side of a view where views are varied [px].
        small: Triangles of the terrain they show.
        few: Lights over it.
    """

    screen: tuple[int, int]
    city: int
    hills: int
    lamps: int
    side: int
    small: int
    few: int


FIXED = {
    "cuda": Fixed((1920, 1080), 100_000, 500_000, 1000, 128, 20_000, 100),
    "cpu": Fixed((640, 360), 100_000, 20_000, 200, 128, 20_000, 100),
    "quick": Fixed((96, 64), 10_000, 2000, 10, 32, 200, 5),
}


@dataclasses.dataclass(frozen=True)
class Axis:
    """One thing that is varied.

    Attributes:
        name: Key in results, and what is counted.
        text: What stays the same, in words; the fields of `Fixed` stand in braces.
        build: Makes the scene of a number.
        counts: Numbers by kind of device.
        size: Size of a view for a number [px].
        views: Views for a number.
    """

    name: str
    text: str
    build: Callable[[int, Fixed], Scene]
    counts: dict[str, tuple[int, ...]]
    size: Callable[[int, Fixed], tuple[int, int]]
    views: Callable[[int], int] = lambda _: 1


def tiled_terrain(triangles: int) -> Scene:
    """Terrain under a sun; past `WHOLE_TRIANGLES` it is tiled with scaled instances of one mesh.

    Tiles keep the ground's area and the camera, so that there are more triangles to each pixel and nothing else.
    """
    across = 1 if triangles <= WHOLE_TRIANGLES else math.ceil(math.sqrt(triangles / TILE_TRIANGLES))
    scene = load(f"terrain?triangles={max(2, round(triangles / across**2))}")
    if across == 1:
        return scene
    (first,) = scene.instances
    mesh, material = first.mesh, first.material
    scene.clear()
    for row in range(across):
        for column in range(across):
            transform = np.diag([1.0 / across, 1.0 / across, 1.0 / across, 1.0])
            transform[[0, 2], 3] = [((place + 0.5) / across - 0.5) * GROUND for place in (column, row)]
            scene.add(mesh, transform=transform, material=material)
    return scene


def _city(lights: int, fixed: Fixed) -> Scene:
    return load(f"many_lights?lights={lights}&mean={reachable_mean(lights, 5):g}&triangles={fixed.city}")


def _powers(base: int, first: int, last: int) -> tuple[int, ...]:
    return tuple(base**k for k in range(first, last + 1))


AXES = (
    Axis(
        "triangles",
        "one view of {screen[0]}x{screen[1]}, terrain under a sun; past 10^7 it is tiled with instances of one mesh",
        lambda count, fixed: tiled_terrain(count),
        {"cuda": _powers(10, 3, 8), "cpu": _powers(10, 3, 6), "quick": (200, 800, 3200)},
        lambda count, fixed: fixed.screen,
    ),
    Axis(
        "lights",
        "one view of {screen[0]}x{screen[1]}, a city of {city} triangles; 5 lights reach a pixel on average, or half "
        "of them if there are fewer than 10",
        _city,
        {"cuda": _powers(10, 0, 5), "cpu": _powers(10, 0, 4), "quick": (1, 10, 100)},
        lambda count, fixed: fixed.screen,
    ),
    Axis(
        "pixels",
        "one square view, terrain of {hills} triangles, {lamps} lights, 5 of which reach a pixel on average",
        lambda count, fixed: load(f"terrain?triangles={fixed.hills}&lights={fixed.lamps}"),
        {"cuda": _powers(4, 6, 14), "cpu": _powers(4, 6, 11), "quick": _powers(4, 4, 6)},
        lambda count, fixed: (math.isqrt(count), math.isqrt(count)),
    ),
    Axis(
        "views",
        "views of {side}x{side} from a ring around a terrain of {small} triangles, {few} lights",
        lambda count, fixed: load(f"terrain?triangles={fixed.small}&lights={fixed.few}"),
        {"cuda": _powers(4, 0, 5), "cpu": _powers(4, 0, 3), "quick": (1, 2, 4)},
        lambda count, fixed: (fixed.side, fixed.side),
        lambda count: count,
    ),
)


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Any,
    only: str = "",
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Time every point of every axis and fit its growth.

    A point that cannot be run is named, and the others go on.

    Args:
        device: Where to run; the CPU runs fewer and smaller points.
        quick: Three tiny points an axis.
        settings: Settings of all points.
        note: Function of a text that tells how far it is.
        only: Name of the one axis to run; all of them if left out.
        keep: Called with what is there after each point, so that nothing measured is lost.

    Returns:
        What each axis keeps fixed (`axes`), one row a point, the fits of what is there, and what was skipped.
    """
    result: Record = {"axes": [], "skipped": [], "fits": [], "rows": []}
    kind = "quick" if quick else "cuda" if device.is_cuda else "cpu"
    for axis in AXES:
        if only not in ("", axis.name):
            continue
        values = dataclasses.asdict(FIXED[kind])
        words = axis.text.format(**{k: count_text(v) if isinstance(v, int) else v for k, v in values.items()})
        result["axes"].append({"axis": axis.name, "fixed": words})
        for count in axis.counts[kind]:
            note(f"{count_text(count)} {axis.name}")
            try:
                result["rows"].append(_point(axis, count, device, settings, kind))
            except Exception as error:
                text = f"{count_text(count)} {axis.name}: {reason(error)}"
                note(f"skipped {text}")
                result["skipped"].append(text)
            # A renderer's own graphs and buffers are in cycles; the next point needs their memory.
            gc.collect()
            result["fits"] = fits(result["rows"])
            if keep:
                keep(result)
    return result


def _cameras(scene: Scene, count: int) -> list[Camera]:
    """The scene's camera, or a ring of them around what it looks at."""
    if count == 1:
        return [scene.camera]
    turns = 2.0 * math.pi * np.arange(count) / count
    return [
        Camera.look_at((9.0 * math.sin(t), 3.0, 9.0 * math.cos(t)), (0.0, 0.0, 0.0), vertical_fov_deg=60.0)
        for t in turns
    ]


def _point(axis: Axis, count: int, device: wp.Device, settings: Settings, kind: str) -> Row:
    """Time one point: whole frame, passes, memory."""
    begun = time.perf_counter()
    scene = axis.build(count, FIXED[kind])
    width, height = axis.size(count, FIXED[kind])
    repeats = MIN_REPEATS if kind == "quick" else REPEATS
    renderer = open_scene(scene, (width, height), device, ("display",))
    plan = _plan(renderer, scene, settings, axis.views(count))
    row: Row = {
        "axis": axis.name, "n": count, "width": width, "height": height, "views": axis.views(count),
        "triangles": scene.triangle_count, "lights": len(scene.lights),
        "stored_triangles": sum(len(mesh.triangles) for mesh in {id(i.mesh): i.mesh for i in scene.instances}.values()),
    }  # fmt: skip
    ready = time.perf_counter() - begun
    program = plan.resources.program
    row |= time_program(program, repeats=repeats).metrics("frame")
    for name, timing in time_passes(program, repeats=repeats).items():
        row |= timing.metrics(f"pass.{name}")
    memory = renderer.memory_report()
    return row | {"memory.bytes": memory.total, "scene.bytes": memory.scene, "build.s": round(ready, 2)}


def _plan(renderer: Renderer, scene: Scene, settings: Settings, views: int) -> Any:
    """Plan of a frame of so many views, rendered once."""
    if views == 1:
        return plan_of(renderer, settings)
    scene.settings = settings
    renderer.render(_cameras(scene, views))
    wp.synchronize_device(renderer.device)
    return renderer.plan


def fits(rows: Sequence[Row]) -> list[Row]:
    """Fit time of the frame, of each pass, and memory with the scene, for each axis with enough points."""
    found = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        points = [row for row in rows if row["axis"] == axis]
        if len(points) < FEWEST:
            continue
        names = [name for name in pass_names(points[-1]) if all(f"pass.{name}.ms" in row for row in points)]
        figures: dict[str, list[float]] = {"frame.ms": [row["frame.ms"] for row in points]}
        figures |= {f"pass.{name}.ms": [row[f"pass.{name}.ms"] for row in points] for name in names}
        found += [_fitted(axis, name, points, values) for name, values in figures.items() if min(values) > 0.0]
        # Triangles that instances share take no memory of their own.
        own = [row for row in points if axis != "triangles" or row["stored_triangles"] == row["triangles"]]
        if len(own) >= FEWEST:
            found.append(_fitted(axis, "bytes", own, [row["memory.bytes"] + row["scene.bytes"] for row in own]))
    return found


def _fitted(axis: str, figure: str, points: Sequence[Row], values: Sequence[float]) -> Row:
    return {"axis": axis, "figure": figure} | fit([row["n"] for row in points], values)


def fit(counts: Sequence[float], values: Sequence[float]) -> dict[str, float]:
    """Fit growth.

    Args:
        counts: Numbers n, ascending, > 0; at least three.
        values: Figure at each, > 0.

    Returns:
        `exponent` of the upper half, which begins at `from_n`; `fixed` and `each` of the model fixed + each n; `error`,
        the root mean square of the model's relative errors.
    """
    n, v = np.asarray(counts, np.float64), np.asarray(values, np.float64)
    start = min(len(n) // 2, len(n) - FEWEST)
    slope = np.polyfit(np.log(n[start:]), np.log(v[start:]), 1)[0]
    # Relative errors: rows of the least squares over the values themselves.
    table = np.stack([1.0 / v, n / v], axis=1)
    # Scaled by the largest n, or the two columns would differ by ten orders of magnitude.
    scaled = np.linalg.lstsq(table * [1.0, 1.0 / n[-1]], np.ones(len(n)), rcond=None)[0]
    fixed, each = float(scaled[0]), float(scaled[1] / n[-1])
    if min(fixed, each) < 0.0:  # neither is a cost then: the other one alone
        alone = table.sum(axis=0) / (table**2).sum(axis=0)
        fixed, each = (0.0, float(alone[1])) if fixed < 0.0 else (float(alone[0]), 0.0)
    error = float(np.sqrt(np.mean((table @ [fixed, each] - 1.0) ** 2)))
    figures = {"exponent": float(slope), "from_n": float(n[start]), "fixed": fixed, "each": each, "error": error}
    return {name: float(f"{value:.6g}") for name, value in figures.items()}
