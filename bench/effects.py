"""Bench `effects`: what each rung of each effect costs and how far it is from its reference; what not calling costs.

Rows are of three kinds. `rung`: an effect's scene at one rung, beside the same frame at rung `off`. `free`: the same
scene without what calls for the effect, or, with `.idle`, with nothing for it to do on the device; both beside `off`.
`frame`: whole frames with several effects, pass by pass, as in the bench `frame`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Renderer, Scene, Settings, load
from warp_deferred.compare import compare
from warp_deferred.errors import Error, LoadError
from warp_deferred.plan import Plan
from warp_deferred.program import SAMPLE

from .effect_cases import EFFECT_CASES, EffectCase, case_size, composite_cases, ladders
from .effect_compile import compile_times
from .frame import floor, frame_row
from .probe import open_scene, plan_of
from .record import Record
from .timing import REPEATS, Timing, copy_bandwidth, time_moving, time_passes, time_program

__all__ = ["STEP", "at_rung", "open_case", "own_passes", "picture", "run"]

#: Seconds from one frame of a moving scene to the next.
STEP = 1.0 / 30.0

Row = dict[str, Any]


def run(device: wp.Device, *, quick: bool, settings: Settings, note: Any) -> Record:
    """Time every rung of every effect that is there, then whole frames.

    Args:
        device: Where to run.
        quick: Small cases and few repeats; kernels are not compiled anew.
        settings: Settings of all cases, but for the rung at hand.
        note: Function of a text that tells how far it is.

    Returns:
        Copy bandwidth, the rows, and in `skipped` every effect, rung and frame that could not be measured, and why.
    """
    bandwidth, repeats = copy_bandwidth(device), 3 if quick else REPEATS
    known, rows, skipped = ladders(), [], []

    def skip(text: str) -> None:
        note(f"skipped {text}")
        skipped.append(text)

    for effect in known:
        if effect not in EFFECT_CASES:
            skip(f"{effect}: no case for it in bench/effect_cases.py")
    for effect, case in EFFECT_CASES.items():
        if effect not in known:
            skip(f"{effect}: no such effect in this version")
            continue
        if quick:
            more = case.settings + case.small_settings
            case = dataclasses.replace(case, source=case.small or case.source, settings=more)
        try:
            rows += _ladder(case, known[effect], device, quick, settings, bandwidth, repeats, note, skip)
        except LoadError as error:
            skip(f"{effect}: {error}")
    if quick:
        skip("compile times: kernels are not compiled anew in a quick run")
    for frame in composite_cases(device.is_cuda, quick=quick):
        missing = [name for name in frame.needs if name not in known]
        if missing:
            skip(f"{frame.name}: no {', '.join(missing)} in this version")
            continue
        note(frame.title)
        row = frame_row(frame, device, settings.with_values(frame.assignments()), bandwidth, repeats)
        rows.append({"kind": "frame"} | row)
    return {"copy_bytes_per_s": round(bandwidth), "skipped": skipped, "rows": rows}


def _ladder(
    case: EffectCase, rungs: tuple[str, ...], device: wp.Device, quick: bool, settings: Settings, bandwidth: float,
    repeats: int, note: Any, skip: Any,
) -> list[Row]:  # fmt: skip
    """Rows of one effect: its rungs, then what it costs where it has no work."""
    size = case_size(device.is_cuda, quick)
    settings = settings.with_values(list(case.settings))
    renderer = open_case(case, size, device)
    shared = {"effect": case.effect, "source": case.source, "width": size[0], "height": size[1]}
    rows, pictures, off = [], {}, None
    for rung in rungs:
        note(f"{case.effect}, {rung}")
        try:
            row, plan = _rung(case, renderer, at_rung(settings, case.effect, rung), off, bandwidth, repeats)
            pictures[rung] = picture(case, renderer)
        except Error as error:
            skip(f"{case.effect}.rung={rung}: {error}")
            continue
        off = off or (row, plan)
        rows.append({"kind": "rung", **shared, "rung": rung, **row})
    reference = rungs[-1]
    for row in rows:
        if reference in pictures:
            row |= {"reference": reference} | _error(pictures[row["rung"]], pictures[reference])
    if not quick:
        note(f"{case.effect}, compiling its kernels anew")
        times = compile_times(case.effect, str(device), [row["rung"] for row in rows[1:]], settings)
        for row in rows:
            row |= times.get(row["rung"], {})
    default = getattr(settings, case.effect).rung
    tried = settings if default != "off" else at_rung(settings, case.effect, rungs[1])
    if case.free is not None:
        note(f"{case.effect}, not called for")
        rows.append({"kind": "free", **shared} | _free(case, size, device, tried, repeats))
    if case.idle is not None:
        note(f"{case.effect}, nothing to do on the device")
        rows.append({"kind": "free", **shared} | _idle(case, size, device, tried, repeats))
    return rows


def at_rung(settings: Settings, effect: str, rung: str) -> Settings:
    """Change the rung of one effect."""
    return settings.replace(**{effect: getattr(settings, effect).replace(rung=rung)})


def open_case(case: EffectCase, size: tuple[int, int], device: wp.Device, change: Any = None) -> Renderer:
    """Open the case's scene for its picture, changed by a function of the scene where one is handed in."""
    scene: Scene = load(case.source)
    if change is not None:
        change(scene)
    return open_scene(scene, size, device, ("display",))


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
    whole = _time(case, renderer, plan, repeats)
    row: Row = whole.metrics("frame") | {"memory.bytes": _held(renderer)}
    # Passes are timed by replays, in which nothing moves.
    times = {} if case.moving else _passes(plan, repeats)
    row |= {f"pass.{name}.ms": round(value, 5) for name, value in times.items()}
    if off is None:
        return row, plan
    other, off_plan = off
    # Of figures with spreads of their own; below zero where the cost drowns in them.
    row["cost.difference_ms"] = round(whole.median - other["frame.ms"], 5)
    row["memory.added_bytes"] = row["memory.bytes"] - other["memory.bytes"]
    row["samples"] = plan.replays
    if not times:
        return row, plan
    names = own_passes(plan, off_plan)
    # What an effect adds to passes that run anyway: look-ups in shade, views in raster, more samples of all.
    shared = {name: times[name] - other[f"pass.{name}.ms"] for name in times if f"pass.{name}.ms" in other}
    row["shared.difference_ms"] = round(sum(shared.values()), 5)
    row["shared.most"] = max(shared, key=lambda name: shared[name])
    if names:
        moved = {report.name: report.bytes or 0 for report in plan.reports(measure=False) if report.runs}
        own = sum(times[name] for name in names)
        row |= {"own.passes": " + ".join(names), "own.ms": round(own, 5)}
        row |= floor("own", own, sum(moved[name] for name in names), bandwidth)
    return row, plan


def _passes(plan: Plan, repeats: int) -> dict[str, float]:
    """Milliseconds of each pass in a frame, over all its samples."""
    program = plan.resources.program
    counts = {s.name: plan.replays if s.part == SAMPLE else 1 for s in program.sections}
    return {name: timing.median * counts[name] for name, timing in time_passes(program, repeats=repeats).items()}


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


def _launches(plan: Plan) -> list[Any]:
    """Kernels of a plan in the order they are launched; equal kernels are the same object."""
    return [kernel for kernel, _ in plan.resources.program.kernels]


def _free(case: EffectCase, size: tuple[int, int], device: wp.Device, settings: Settings, repeats: int) -> Row:
    """Compare the plan of a scene that does not call for the effect with the plan of rung `off`."""
    figures = []
    for chosen in (settings, at_rung(settings, case.effect, "off")):
        renderer = open_case(case, size, device, case.free)
        plan = plan_of(renderer, chosen)
        figures.append((plan, _time(case, renderer, plan, repeats), _held(renderer)))
    (plan, whole, memory), (off_plan, off, off_memory) = figures
    row: Row = {"case": f"{case.effect}.free"} | whole.metrics("frame") | off.metrics("off")
    return row | {
        "free.passes": len(own_passes(plan, off_plan)),
        "free.launches": len(_launches(plan)) - len(_launches(off_plan)),
        "free.kernels": len(set(_launches(plan)) - set(_launches(off_plan))),
        "free.bytes": memory - off_memory,
    }


def _idle(case: EffectCase, size: tuple[int, int], device: wp.Device, settings: Settings, repeats: int) -> Row:
    """Time a frame whose device finds nothing to do for the effect, beside the frame without it."""
    renderer = open_case(case, size, device, case.idle)
    off = time_program(plan_of(renderer, at_rung(settings, case.effect, "off")).resources.program, repeats=repeats)
    program = plan_of(renderer, settings).resources.program
    whole = time_program(program, repeats=repeats)
    active = [section.name for section in program.sections if section.active]
    row: Row = {"case": f"{case.effect}.idle"} | whole.metrics("frame") | off.metrics("off")
    return row | {"idle.difference_ms": round(whole.median - off.median, 5), "idle.active": " ".join(active)}
