"""Bench `accuracy`: what each rung of each ladder is off by, and what it costs; the stage alone, and in the picture.

One row a ladder, scene and rung. `stage.*`: the stage's own output against the reference rung's, in its natural unit,
and its time. `error.*`: `display` against the reference's. `frame.*`: the whole frame. A reference that samples is
compared with itself at a quarter of its samples: the difference over √3 is the standard error that independent samples,
the quarter among them, would have; well-spread ones have less.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Renderer, Scene, Settings
from warp_deferred.plan import Plan

from .accuracy_images import write_strip
from .accuracy_tables import FORMAT
from .effects import reason
from .ladders import LADDERS, SCENES, TWIN, Ladder, narrowed, stand_size, twin_size
from .measures import MEASURES, picture_errors, stage_errors
from .probe import open_scene, plan_of
from .record import Record
from .timing import REPEATS, Timing, time_moving, time_passes, time_program
from .twin import twin_outputs

__all__ = ["run", "whole_frame"]

#: A frame that takes longer than this [ms] is timed `SLOW_REPEATS` times, by the host's clock.
SLOW_MS, SLOW_REPEATS = 20.0, 3
#: One that takes longer than this [ms] is timed once: a reference may take seconds.
SLOWEST_MS = 200.0
#: Repeats of what is timed on the CPU.
CPU_REPEATS = 7
#: Repeats of frames that move, each of which waits for its own end.
MOVING_REPEATS = 15
#: Settings of shadow maps in a quick run.
QUICK = ("shadow.directional_size=256", "shadow.spot_size=256", "shadow.point_size=128")
#: Outputs that name what a pixel shows.
IDS = ("instance_id", "triangle_id")

Row = dict[str, Any]
Note = Callable[[str], Any]


@dataclasses.dataclass
class _Run:
    """What all ladders of a run share.

    Attributes:
        device: Where it runs.
        quick: Whether small cases stand in.
        settings: Settings but for those of ladders.
        note: Tells how far it is.
        images: Folder for strips; None: none are written.
    """

    device: wp.Device
    quick: bool
    settings: Settings
    note: Note
    images: Path | None

    @property
    def repeats(self) -> int:
        """Measurements of a figure."""
        return 3 if self.quick else REPEATS if self.device.is_cuda else CPU_REPEATS

    def at(self, ladder: Ladder, rung: str, more: tuple[str, ...] = ()) -> Settings:
        """Settings of a rung; a quick run has small shadow maps."""
        return ladder.at(rung, (*(QUICK if self.quick else ()), *more), self.settings)


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Note,
    only: str = "",
    images: str = "",
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Measure every ladder on every scene that shows it; what fails is named, and the others go on.

    Args:
        device: Where to run.
        quick: Small cases, few repeats, and one scene a ladder.
        settings: Settings of all cases, but for the ladder's.
        note: Function of a text that tells how far it is.
        only: LADDER or LADDER.RUNG; all ladders if left out.
        images: Folder for strips that show what the errors look like; none if left out.
        keep: Called with what is there after each ladder on each scene, so that nothing measured is lost.

    Returns:
        The rows, ladder by ladder, and in `skipped` every ladder and rung that could not be measured, and why.
    """
    ladders, shared = narrowed(only), _Run(device, quick, settings, note, Path(images) if images else None)
    result: Record = {"format": FORMAT, "skipped": [], "rows": []}
    order = {name: k for k, name in enumerate(LADDERS)}

    def skip(text: str) -> None:
        note(f"skipped {text}")
        result["skipped"].append(text)

    # Scenes in the outer loop: building and uploading one takes longer than many of its ladders.
    for name, stand in SCENES.items():
        wanted = [ladder for ladder in ladders.values() if name in ladder.scenes[: 1 if quick else None]]
        bench = _Bench(shared, name, stand.chosen(device.is_cuda, quick)) if wanted else None
        for ladder in wanted:
            note(f"{ladder.name} on {name}")
            try:
                result["rows"] += bench.climb(ladder, skip)
            except Exception as error:
                skip(f"{ladder.name} on {name}: {reason(error)}")
            result["rows"].sort(key=lambda row: order[row["ladder"]])
            if keep:
                keep(result)
    return result


class _Bench:
    """A scene with the renderers that look at it."""

    def __init__(self, shared: _Run, name: str, source: str) -> None:
        self.shared, self.name, self.source = shared, name, source
        self.scene: Scene | None = None
        self.renderers: dict[Any, Renderer] = {}
        self.truths: dict[tuple[int, int], dict[str, np.ndarray]] = {}

    def climb(self, ladder: Ladder, skip: Note) -> list[Row]:
        """Rows of a ladder; the scene is as before afterwards, but for what has moved."""
        if self.scene is None:
            self.scene = SCENES[self.name].build(self.source)
        camera = self.scene.camera
        casts = [(group, np.copy(group.casts_shadow)) for _, group in self.scene.lights.groups() if len(group)]
        if ladder.change is not None:
            ladder.change(self.scene)
        try:
            return self._twin_rows(ladder) if ladder.twin else self._rows(ladder, skip)
        finally:
            self.scene.camera = camera
            for group, cast in casts:
                if not np.array_equal(group.casts_shadow, cast):
                    group.casts_shadow = cast

    def _renderer(self, outputs: tuple[str, ...], size: tuple[int, int], moving: bool = False) -> Renderer:
        key = (outputs, size, moving)
        if key not in self.renderers:
            self.renderers[key] = open_scene(self.scene, size, self.shared.device, outputs)
        return self.renderers[key]

    def _rows(self, ladder: Ladder, skip: Note) -> list[Row]:
        """Rows of a ladder whose reference is one of its rungs."""
        size = stand_size(self.shared.device.is_cuda, self.shared.quick)
        climb = _Climb(self.shared, ladder, self._renderer(("display",), size, ladder.moving), SCENES[self.name].step)
        output = MEASURES[ladder.measure].output
        if output and MEASURES[ladder.measure].channel is None:
            climb.other = self._renderer((output,), size, ladder.moving)
        # The reference and the frame without first: without them nothing can be said of the others.
        names = [rung.name for rung in ladder.rungs]
        first = [*(["off"] if ladder.has_off else []), ladder.reference]
        for name in (*first, *(name for name in names if name not in first)):
            try:
                climb.measure(name)
            except Exception as error:
                if name in first:
                    raise
                skip(f"{ladder.name}.{name} on {self.name}: {reason(error)}")
        rows = climb.rows()
        if self.shared.images is not None and self.name == ladder.scenes[0] and not ladder.exact:
            kept = {name: climb.pictures[name] for name in names if name in climb.pictures}
            write_strip(self.shared.images, ladder.name, kept, ladder.reference)
        return [self._head(ladder, size, name) | rows[name] for name in names if name in rows]

    def _head(self, ladder: Ladder, size: tuple[int, int], rung: str) -> Row:
        settings = " ".join((*ladder.fixed, *(ladder.rung(rung).settings if rung != TWIN else ())))
        return {
            "ladder": ladder.name, "scene": self.name, "source": self.source, "width": size[0], "height": size[1],
            "rung": rung, "reference": ladder.reference, "unit": MEASURES[ladder.measure].unit, "settings": settings,
        }  # fmt: skip

    def _twin_rows(self, ladder: Ladder) -> list[Row]:
        """Rows of a ladder against the float64 twin, which has no picture and no time worth telling.

        Frames are timed as they are looked at, ids included: kernels of frames without ids would have to be compiled.
        """
        shared, size = self.shared, twin_size(self.shared.quick)
        measure = MEASURES[ladder.measure]
        renderer = self._renderer((measure.output if measure.channel is None else "display", *IDS), size)
        self.scene.settings = shared.at(ladder, ladder.rungs[0].name)
        # The twin knows neither codecs nor formats: what it sees is the same for every ladder.
        if size not in self.truths:
            self.truths[size] = twin_outputs(self.scene, size)
        truth = self.truths[size]
        rows = []
        for rung in ladder.rungs:
            settings = shared.at(ladder, rung.name)
            plan = plan_of(renderer, settings)
            frame = renderer.render()
            # Meshes number their own triangles: both ids make one.
            same = np.logical_and.reduce([frame.numpy(name)[0] == truth[name] for name in IDS])
            read = frame.numpy(measure.output)[0] if measure.channel is None else measure.channel(plan)
            own, true = read[same], truth[measure.output][same]
            row = _prefixed("stage", stage_errors(measure, own, true, None))
            row["pixels.other"] = round(float(1.0 - same.mean()), 6)
            rows.append(self._head(ladder, size, rung.name) | row | _times(plan, ladder, shared.repeats))
        return rows


class _Climb:
    """One ladder on one scene: the pictures and outputs of the rungs seen so far."""

    def __init__(self, shared: _Run, ladder: Ladder, renderer: Renderer, step: float) -> None:
        self.shared, self.ladder, self.renderer, self.step = shared, ladder, renderer, step
        self.other: Renderer | None = None
        self.pictures: dict[str, np.ndarray] = {}
        self.own: dict[str, np.ndarray] = {}
        self.times: dict[str, Row] = {}

    def measure(self, rung: str) -> None:
        """Look at a rung and time it; `off` must have been measured before the others."""
        ladder = self.ladder
        plan, self.pictures[rung], self.own[rung] = self._look(self.shared.at(ladder, rung))
        row = _times(plan, ladder, self.shared.repeats, self._move if ladder.moving else None)
        if ladder.has_off:
            # Of two figures with spreads of their own; below zero where the cost drowns in them.
            without = row["frame.ms"] if rung == "off" else self.times["off"]["frame.ms"]
            for end in ("ms", "ms_p5", "ms_p95"):
                row[f"stage.{end}"] = round(row[f"frame.{end}"] - without, 5)
            row["stage.of_frame"] = round(row["stage.ms"] / row["frame.ms"], 4)
        self.times[rung] = row

    def rows(self) -> dict[str, Row]:
        """Errors and times of all rungs looked at."""
        reference, ladder = self.ladder.reference, self.ladder
        looks = [(self.pictures[name], self.own[name]) for name in self.times]
        if ladder.quarter:
            looks.append(self._look(self.shared.at(ladder, reference, ladder.quarter))[1:])
        # FLIP takes seconds and leaves the interpreter to others meanwhile; nothing is timed now.
        with concurrent.futures.ThreadPoolExecutor() as pool:
            errors = list(pool.map(lambda look: self._errors(*look), looks))
        rows = {name: found | row for (name, row), found in zip(self.times.items(), errors, strict=False)}
        if ladder.quarter:
            row = errors[-1]
            for part in ("stage", "error"):
                rows[reference][f"noise.{part}_rmse"] = float(f"{row[f'{part}.rmse'] * 3.0**-0.5:.3g}")
        return rows

    def _errors(self, picture: np.ndarray, own: np.ndarray) -> Row:
        reference = self.ladder.reference
        errors = stage_errors(MEASURES[self.ladder.measure], own, self.own[reference], self.own.get("off"))
        shown = picture_errors(picture, self.pictures[reference])
        return _prefixed("stage", errors) | _prefixed("error", shown)

    def _look(self, settings: Settings) -> tuple[Plan, np.ndarray, np.ndarray]:
        """Plan, picture and the stage's own output at some settings."""
        measure = MEASURES[self.ladder.measure]
        picture = self._shown(self.renderer, settings, "display")
        if measure.channel is not None:
            return self.renderer.plan, picture, measure.channel(self.renderer.plan)
        if measure.absent is not None and getattr(settings, self.ladder.name).rung == "off":
            return self.renderer.plan, picture, np.full(picture.shape[:2], measure.absent, np.float32)
        if self.other is None:
            return self.renderer.plan, picture, picture
        return self.renderer.plan, picture, self._shown(self.other, settings, measure.output)

    def _shown(self, renderer: Renderer, settings: Settings, output: str) -> np.ndarray:
        """One output of the first view; of a scene that moves of its second frame."""
        renderer.scene.settings = settings
        for k in (0, 1) if self.ladder.moving else (0,):
            if self.ladder.moving:
                renderer.scene.animate(renderer.scene, self.step * k)
            frame = renderer.render()
        return frame.numpy(output)[0].copy()

    def _move(self, k: int) -> None:
        self.renderer.scene.animate(self.renderer.scene, self.step * (k + 2))
        self.renderer.render()


def _prefixed(prefix: str, row: Row) -> Row:
    return {f"{prefix}.{name}": value for name, value in row.items()}


def _times(plan: Plan, ladder: Ladder, repeats: int, move: Callable[[int], Any] | None = None) -> Row:
    """Times of a frame, and of the ladder's passes where it names some; else the stage is the frame."""
    program = plan.resources.program
    whole = whole_frame(plan, repeats, move)
    row = whole.metrics("frame") | {"frame.repeats": whole.repeats}
    if not ladder.passes:
        return row | whole.metrics("stage") | {"stage.of_frame": 1.0}
    passes = time_passes(program, repeats=repeats)
    own = [passes[name] for name in ladder.passes if name in passes]
    stage = Timing(*(sum(getattr(t, name) for t in own) for name in ("median", "p5", "p95")), whole.repeats)
    total = sum(timing.median for timing in passes.values())
    return row | stage.metrics("stage") | {"stage.of_frame": round(stage.median / total, 4) if total > 0.0 else 0.0}


def whole_frame(plan: Plan, repeats: int, move: Callable[[int], Any] | None) -> Timing:
    """Time a frame that was rendered before: few times where it is slow, as those of references are.

    Args:
        plan: Its plan.
        repeats: Measurements of a fast one.
        move: Function of the frame's number that moves the scene and renders it; None: the same frame is replayed.
    """
    program, device = plan.resources.program, plan.resources.device
    values: list[float] = []
    while len(values) < SLOW_REPEATS:
        wp.synchronize_device(device)
        begun = time.perf_counter()
        program.replay()
        wp.synchronize_device(device)
        values.append((time.perf_counter() - begun) * 1e3)
        if values[0] <= SLOW_MS or values[0] > SLOWEST_MS:
            break
    if move is not None:
        # A replay of the same frame would find nothing in motion.
        return time_moving(device, move, len(values) if values[0] > SLOW_MS else min(repeats, MOVING_REPEATS))
    return Timing.of(values) if values[0] > SLOW_MS else time_program(program, repeats=repeats)
