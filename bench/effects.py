"""Bench `effects`: what each rung of each effect costs and how far it is from its reference; what not calling costs.

Rows are of three kinds. `rung`: an effect's scene at one rung, beside the same frame at rung `off`. `free`: the same
scene without what calls for the effect, or, with `.idle`, with nothing for it to do on the device; both beside `off`.
`frame`: whole frames with several effects, pass by pass, as in the bench `frame`.
"""

from __future__ import annotations

import concurrent.futures
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Renderer, Settings
from warp_deferred.compare import compare
from warp_deferred.plan import Plan
from warp_deferred.program import SAMPLE

from .effect_cases import EFFECT_CASES, CompositeCase, EffectCase, case_size, composite_cases, ladders, without_case
from .effect_compile import compile_all
from .frame import floor, frame_row
from .probe import open_scene, plan_of
from .record import Record
from .timing import REPEATS, Timing, copy_bandwidth, time_moving, time_passes, time_program

__all__ = ["STEP", "open_case", "own_passes", "picture", "reason", "run"]

#: Seconds from one frame of a moving scene to the next.
STEP = 1.0 / 30.0
#: A frame that takes longer than this [ms] is timed `SLOW_REPEATS` times only.
SLOW_MS, SLOW_REPEATS = 20.0, 5
#: The same for the slowest: a reference rung may take seconds.
SLOWEST_MS, SLOWEST_REPEATS = 200.0, 2

Row = dict[str, Any]


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Any,
    only: str = "",
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Time every rung of every effect that is there, then whole frames.

    What fails, whatever the reason, is reported by name, and the others go on.

    Args:
        device: Where to run.
        quick: Small cases and few repeats; kernels are not compiled anew.
        settings: Settings of all cases, but for the rung at hand.
        note: Function of a text that tells how far it is.
        only: Name of the one case to run, or `frames` for the frames with several effects; all if left out.
        keep: Called with what is there after each case, so that nothing measured is lost.

    Returns:
        Copy bandwidth, the rows, and in `skipped` every effect, rung and frame that could not be measured, and why.
    """
    bandwidth, repeats = copy_bandwidth(device), 3 if quick else REPEATS
    result: Record = {"copy_bytes_per_s": round(bandwidth), "skipped": [], "rows": []}

    def skip(text: str) -> None:
        note(f"skipped {text}")
        result["skipped"].append(text)

    def add(name: str, measure: Callable[[], list[Row]]) -> None:
        try:
            result["rows"] += measure()
        except Exception as error:
            skip(f"{name}: {reason(error)}")
        if keep:
            keep(result)

    cases = [case for name, case in EFFECT_CASES.items() if only in ("", name)]
    for effect in without_case():
        skip(f"{effect}: no case for it in bench/effect_cases.py")
    for case in cases:
        if not case.rungs():
            skip(f"{case.name}: no such effect in this version")
    cases = [case.quick() if quick else case for case in cases if case.rungs()]
    if quick:
        skip("compile times: kernels are not compiled anew in a quick run")
    compiled = {} if quick else compile_all(cases, str(device), settings, note, skip)
    for case in cases:
        size = case_size(device.is_cuda, quick)

        def measure(case: EffectCase = case, size: tuple[int, int] = size) -> list[Row]:
            rows = _case(case, size, device, settings, bandwidth, repeats, note, skip)
            return [row | compiled.get((case.name, row.get("rung", "")), {}) for row in rows]

        add(case.name, measure)
    for frame in composite_cases(device.is_cuda, quick=quick) if only in ("", "frames") else ():
        add(frame.name, lambda frame=frame: _frame(frame, device, settings, bandwidth, repeats, note, skip))
    return result


def reason(error: Exception) -> str:
    """What an error says, in one line: its first, with its kind where it is none of ours."""
    line = (str(error).strip() or "no message").splitlines()[0]
    return line if type(error).__module__.startswith("warp_deferred") else f"{type(error).__name__}: {line}"


def _frame(
    frame: CompositeCase, device: wp.Device, settings: Settings, bandwidth: float, repeats: int, note: Any, skip: Any
) -> list[Row]:
    """Row of a whole frame."""
    if missing := [name for name in frame.needs if name not in ladders()]:
        skip(f"{frame.name}: no {', '.join(missing)} in this version")
        return []
    note(frame.title)
    return [{"kind": "frame"} | frame_row(frame, device, settings.with_values(frame.assignments()), bandwidth, repeats)]


def _case(
    case: EffectCase, size: tuple[int, int], device: wp.Device, settings: Settings, bandwidth: float, repeats: int,
    note: Any, skip: Any,
) -> list[Row]:  # fmt: skip
    """Rows of one effect: its rungs, then what it costs where it has no work."""
    settings = settings.with_values(list(case.settings))
    shared = {"case": case.name, "effect": case.stage, "source": case.source, "width": size[0], "height": size[1]}
    if case.settings:
        shared["settings"] = " ".join(case.settings)
    rungs, rows, pictures = case.rungs(), [], {}
    renderer = open_case(case, size, device)
    note(f"{case.name}, {rungs[0]}")
    # Without the frame of this rung there is nothing to compare with: what fails here ends the case.
    row, off_plan = _rung(case, renderer, case.at(settings, rungs[0]), None, bandwidth, repeats)
    off = (row, off_plan)
    pictures[rungs[0]] = picture(case, renderer)
    rows.append({"kind": "rung", **shared, "rung": rungs[0], **row})
    for rung in rungs[1:]:
        note(f"{case.name}, {rung}")
        try:
            if case.passes is not None:
                renderer = open_case(case, size, device, rung=rung)
            row, _ = _rung(case, renderer, case.at(settings, rung), off, bandwidth, repeats)
            pictures[rung] = picture(case, renderer)
        except Exception as error:
            skip(f"{case.name}.{case.field}={rung}: {reason(error)}")
            continue
        rows.append({"kind": "rung", **shared, "rung": rung, **row})
    if case.reference in pictures:
        # FLIP takes seconds and leaves the interpreter to others meanwhile; nothing is timed now.
        with concurrent.futures.ThreadPoolExecutor() as pool:
            errors = pool.map(lambda row: _error(pictures[row["rung"]], pictures[case.reference]), rows)
            for row, found in zip(rows, list(errors), strict=True):
                row |= {"reference": case.reference} | found
    tried = case.at(settings, case.default(settings)) if case.has_cause or case.idle else settings
    for text, measure, wanted in (
        ("not called for", _free, case.has_cause),
        ("nothing to do on the device", _idle, case.idle is not None),
    ):
        if not wanted:
            continue
        note(f"{case.name}, {text}")
        try:
            row = measure(case, size, device, tried, repeats)
            rows.append({"kind": "free", **shared, "rung": case.default(settings), **row})
        except Exception as error:
            skip(f"{case.name}, {text}: {reason(error)}")
    return rows


def open_case(
    case: EffectCase, size: tuple[int, int], device: wp.Device, change: Any = None, rung: str = ""
) -> Renderer:
    """Open the case's scene for its picture, changed by a function of the scene where one is handed in.

    Passes of a user's own belong to a renderer, not to settings: `rung` names the one that is wanted.
    """
    scene = case.build()
    if change is not None:
        change(scene)
    passes = [stage for stage in case.passes() if stage.name == rung] if case.passes else []
    return open_scene(scene, size, device, ("display",), passes)


def _step(renderer: Renderer, k: int) -> None:
    """Render frame number k of a scene that moves."""
    renderer.scene.animate(renderer.scene, STEP * k)
    renderer.render()


def picture(case: EffectCase, renderer: Renderer) -> np.ndarray:
    """Render the frame whose picture counts: uint8 (height, width, 4). Of a scene that moves it is the second one."""
    for k in (0, 1) if case.moving else ():
        _step(renderer, k)
    frame = renderer.render() if not case.moving else None
    return (frame.numpy("display") if frame is not None else renderer.plan.outputs["display"].numpy())[0].copy()


def _time(case: EffectCase, renderer: Renderer, plan: Plan, repeats: int) -> Timing:
    if case.moving:
        # A replay of the same frame would find nothing in motion.
        return time_moving(renderer.device, lambda k: _step(renderer, k), repeats)
    return time_program(plan.resources.program, repeats=repeats)


def _fewer(renderer: Renderer, plan: Plan, repeats: int) -> int:
    """Repeats of what is timed: few where a frame is slow, as those of reference rungs are."""
    started = time.perf_counter()
    plan.resources.program.replay()
    wp.synchronize_device(renderer.device)
    taken = (time.perf_counter() - started) * 1e3
    if taken > SLOWEST_MS:
        return min(repeats, SLOWEST_REPEATS)
    return min(repeats, SLOW_REPEATS) if taken > SLOW_MS else repeats


def own_passes(plan: Plan, off: Plan) -> list[str]:
    """Names of the passes a plan has and the one with the effect off has not, in frame order."""
    others = {stage.name for stage in off.passes}
    return [stage.name for stage in plan.passes if stage.name not in others]


def _rung(
    case: EffectCase, renderer: Renderer, settings: Settings, off: tuple[Row, Plan] | None, bandwidth: float,
    repeats: int,
) -> tuple[Row, Plan]:  # fmt: skip
    """Time one rung; `off` has row and plan of rung `off`, None for that rung itself."""
    plan = plan_of(renderer, settings)
    if case.moving:
        _step(renderer, 1)
        plan = renderer.plan
    repeats = _fewer(renderer, plan, repeats)
    whole = _time(case, renderer, plan, repeats)
    row: Row = whole.metrics("frame") | {"memory.bytes": _held(renderer)}
    # Passes are timed by replays, in which nothing moves.
    times = {} if case.moving else _passes(plan, repeats)
    for name, timing in times.items():
        row |= timing.metrics(f"pass.{name}")
    if off is None:
        return row, plan
    other, off_plan = off
    # Of figures with spreads of their own; below zero where the cost drowns in them.
    row["cost.difference_ms"] = round(whole.median - other["frame.ms"], 5)
    row["memory.added_bytes"] = row["memory.bytes"] - other["memory.bytes"]
    row["samples"] = plan.replays
    row["explain"] = _explained(plan, off_plan)
    if not times:
        return row, plan
    names = own_passes(plan, off_plan)
    # What an effect adds to passes that run anyway: look-ups in shade, views in raster, more samples of all.
    shared = {n: t.median - other[f"pass.{n}.ms"] for n, t in times.items() if f"pass.{n}.ms" in other}
    row["shared.difference_ms"] = round(sum(shared.values()), 5)
    row["shared.passes"] = {name: round(value, 5) for name, value in shared.items()}
    if names:
        moved = {report.name: report.bytes or 0 for report in plan.reports(measure=False) if report.runs}
        own = sum(times[name].median for name in names)
        row |= {"own.passes": " + ".join(names), "own.ms": round(own, 5)}
        row |= floor("own", own, sum(moved[name] for name in names), bandwidth)
    return row, plan


def _passes(plan: Plan, repeats: int) -> dict[str, Timing]:
    """Time of each pass in a frame, over all its samples."""
    program = plan.resources.program
    counts = {s.name: plan.replays if s.part == SAMPLE else 1 for s in program.sections}
    return {name: timing.times(counts[name]) for name, timing in time_passes(program, repeats=repeats).items()}


def _held(renderer: Renderer) -> int:
    """Bytes on the device, what a rung keeps beside the scene's triangles included."""
    memory = renderer.memory_report()
    return memory.total + memory.scene


def _error(shown: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Errors of a picture against the reference rung's, of codes in [0, 1]; FLIP where OpenImageIO has it."""
    parts = [{name: image[..., k] for k, name in enumerate("RGB")} for image in (shown, reference)]
    result = compare(*parts)
    errors = {"error.rmse": round(result.rmse, 6), "error.max": round(result.max_error, 6)}
    return errors | ({"error.flip": round(result.flip, 6)} if result.flip is not None else {})


def _explained(plan: Plan, off: Plan) -> list[list[str]]:
    """Lines of `explain` that the rung changes: pass, what it runs as, why."""
    others = {line.name: line for line in off.reports(measure=False)}
    lines = []
    for line in plan.reports(measure=False):
        other = others.get(line.name)
        if line.runs and (other is None or not other.runs or other.rung != line.rung):
            lines.append([line.name, line.rung, line.reason])
    return lines


def _launches(plan: Plan) -> list[Any]:
    """Kernels of a plan in the order they are launched; equal kernels are the same object."""
    return [kernel for kernel, _ in plan.resources.program.kernels]


def _free(case: EffectCase, size: tuple[int, int], device: wp.Device, settings: Settings, repeats: int) -> Row:
    """Compare the plan of a scene that does not call for the effect with the plan of rung `off`."""
    figures = []
    settings = settings.with_values(list(case.free_settings))
    for chosen in (settings, case.at(settings, "off")):
        renderer = open_case(case, size, device, case.free)
        plan = plan_of(renderer, chosen)
        figures.append((plan, _time(case, renderer, plan, repeats), _held(renderer)))
    (plan, whole, memory), (off_plan, off, off_memory) = figures
    told = next(line for line in plan.reports(measure=False) if line.name == case.stage)
    row: Row = whole.metrics("frame") | off.metrics("off")
    return row | {
        "free.reason": told.reason,
        "free.passes": len(own_passes(plan, off_plan)),
        "free.launches": len(_launches(plan)) - len(_launches(off_plan)),
        "free.kernels": len(set(_launches(plan)) - set(_launches(off_plan))),
        "free.bytes": memory - off_memory,
    }


def _idle(case: EffectCase, size: tuple[int, int], device: wp.Device, settings: Settings, repeats: int) -> Row:
    """Time a frame whose device finds nothing to do for the effect, beside the frame without it."""
    renderer = open_case(case, size, device, case.idle)
    off = time_program(plan_of(renderer, case.at(settings, "off")).resources.program, repeats=repeats)
    program = plan_of(renderer, settings).resources.program
    whole = time_program(program, repeats=repeats)
    active = [section.name for section in program.sections if section.active]
    row: Row = whole.metrics("frame") | off.metrics("off")
    return row | {"idle.difference_ms": round(whole.median - off.median, 5), "idle.active": " ".join(active)}
