"""Bench `fit`: how long a fit takes, whether its choice keeps the budget, and how near it comes to the best there is.

The best is found by trying: on each scene combinations of the rungs that the scene calls for, all numbers of samples
and sizes among them, are rendered and timed as a fit times frames, but for rungs that trace rays and frames far past
the largest budget. Of those at most `MOST_TRIED` are taken, the ones that are predicted to come nearest to the least
error of any in their time; rows say of how many, and how much worse than that the last one was predicted: what a better
one must have been mistaken for. Formats, of the G-buffer and of radiance, are tried at their ends, both cheap or both
at their reference, and arithmetic is fast: their errors are the smallest of all ladders (docs/accuracy.md). All errors
of this bench, those of the fit's choices among them, are taken against one picture, whose ladders trace more rays than
the fit's own reference does. A combination counts as possible in a budget where its median keeps it, while a fit's
choice must keep it in 19 of 20 frames: the comparison is in favour of the trying.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from warp_deferred import Renderer, Scene, Settings
from warp_deferred.errors import Error
from warp_deferred.fitting import Fit, fit
from warp_deferred.fitting.ladders import held_fields
from warp_deferred.fitting.model import Choice, Market, Survey
from warp_deferred.fitting.probe import Probe
from warp_deferred.fitting.report import assignments
from warp_deferred.fitting.survey import Surveyor

from .ladders import SCENES, stand_size
from .record import ROOT, Record

__all__ = ["CASES", "Case", "combinations", "run"]


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene and its budgets.

    Attributes:
        scene: Name among the scenes of the accuracy bench.
        budgets_ms: Budgets on CUDA [ms].
        factors: Budgets on the CPU, as multiples of the frame that has one sample and every ladder at its base.
    """

    scene: str
    budgets_ms: tuple[float, ...]
    factors: tuple[float, ...] = (1.5,)


CASES = (Case("hundred_lights", (0.5, 1.0, 2.0), (1.0, 3.0)), Case("shadows", (1.0, 2.0)))
#: Rays and samples of the picture that errors are taken against.
JUDGE_COUNTS = {"ambient_visibility": 16, "shadow": 16}
#: A quick run judges by these.
QUICK_COUNTS = {"ambient_visibility": 4, "shadow": 4}
#: Frames of each combination that are timed.
FRAMES = 5
#: Ladders that are tried at their ends, together.
FORMATS = ("gbuffer", "shade")
#: Ladders that are tried at their cheap end.
CHEAP = ("arithmetic",)
#: Combinations past so many times the largest budget, as predicted, are not tried.
PAST = 1.5
#: Combinations tried on a scene, at most; in a quick run.
MOST_TRIED, QUICK_TRIED = 1200, 12
#: Settings of a quick run: little is for sale.
QUICK = ("gbuffer.normal=oct24", "shade.radiance=half", "scale.rung=off", "light_culling.tile_size=16")


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Callable[[str], Any],
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Fit at every budget of every case, then try every combination.

    Args:
        device: Where to run.
        quick: One small case, with little for sale.
        settings: Settings that are held.
        note: Function of a text that tells how far it is.
        keep: Called with what is there after each scene, so that nothing measured is lost.

    Returns:
        A row for each scene and budget. `first.*`: the first fit here, which may compile kernels; `fresh.*`: that of
        a process of its own later, which finds them compiled and loads them; `fit.*`: one that measures with all
        kernels loaded; `cached.*`: one that finds prices measured before.
    """
    rows: list[dict[str, Any]] = []
    size = stand_size(device.is_cuda, quick)
    if quick:
        settings = settings.with_values(list(QUICK))
    for case in CASES[: 1 if quick else None]:
        source = SCENES[case.scene].chosen(device.is_cuda, quick)
        bench = _Bench(SCENES[case.scene].build(source), device, size, settings)
        budgets = case.budgets_ms if device.is_cuda else [round(f * bench.base_ms(), 3) for f in case.factors]
        fits = []
        for budget in budgets:
            note(f"fit of {case.scene} to {budget:g} ms")
            fits.append(bench.fits(budget))
        note(f"fit of {case.scene} in a process of its own")
        fresh = _in_own_process(case.scene, source, size, str(device), budgets[len(budgets) // 2], settings)
        note(f"every combination on {case.scene}")
        counts, most = (QUICK_COUNTS, QUICK_TRIED) if quick else (JUDGE_COUNTS, MOST_TRIED)
        judged = bench.judge([found[-1] for found in fits], budgets, counts, most)
        for budget, found, outcome in zip(budgets, fits, judged, strict=True):
            head = {"scene": case.scene, "source": source, "width": size[0], "height": size[1], "budget_ms": budget}
            own = fresh if budget == fresh["budget_ms"] else {}
            rows.append(head | _seconds(*found) | own | _choice(found[-1]) | outcome)
        if keep:
            keep({"rows": rows})
    return {"rows": rows}


def _in_own_process(
    scene: str, source: str, size: tuple[int, int], device: str, budget: float, settings: Settings
) -> dict[str, Any]:
    """Fit in a new process: seconds of the call, of loading, and of the process with interpreter and imports."""
    words = json.dumps([scene, source, size, device, budget, settings.model_dump(exclude_unset=True)])
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "bench.fit"], input=words, text=True, capture_output=True, cwd=ROOT
    )  # fmt: skip
    if done.returncode != 0:
        raise Error(f"fit: its own process failed: {(done.stderr.strip() or 'no message').splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1]) | {"fresh.process_s": round(time.perf_counter() - begun, 3)}


def _own_process() -> None:
    """What the process does: read what to fit from standard input, and write how long it took."""
    scene, source, size, device, budget, changed = json.loads(sys.stdin.read())
    wp.config.log_level = wp.LOG_WARNING
    found = fit(
        SCENES[scene].build(source), budget_ms=budget, width=size[0], height=size[1], device=device,
        settings=Settings(**changed), cache=False,
    )  # fmt: skip
    print(json.dumps({
        "budget_ms": budget, "fresh.s": round(found.seconds, 3), "fresh.load_s": round(found.load_seconds, 3),
        "fresh.compiled": found.compiled,
    }))  # fmt: skip


class _Bench:
    """A scene at one size, with what is held."""

    def __init__(self, scene: Scene, device: wp.Device, size: tuple[int, int], settings: Settings) -> None:
        self.scene, self.device, self.size, self.settings = scene, device, size, settings

    def base_ms(self) -> float:
        """Time of the frame that has one sample and every ladder at its base."""
        probe = self._probe()
        probe.look(self.settings)
        return probe.replays().median

    def _probe(self) -> Probe:
        renderer = Renderer(self.scene, width=self.size[0], height=self.size[1], device=self.device)
        return Probe(renderer, [self.scene.camera], 0.0)

    def fits(self, budget: float) -> tuple[Fit, Fit, Fit]:
        """Fit to a budget: as the first call does, with prices kept, and anew with all kernels loaded."""

        def call(cache: bool | str) -> Fit:
            return fit(
                self.scene, budget_ms=budget, width=self.size[0], height=self.size[1], device=self.device,
                settings=self.settings, cache=cache,
            )  # fmt: skip

        with tempfile.TemporaryDirectory() as folder:
            return call(folder), call(folder), call(False)

    def judge(
        self, fits: Sequence[Fit], budgets: Sequence[float], counts: dict[str, int], most: int
    ) -> list[dict[str, Any]]:
        """Try combinations; what each fit's choice is off by, and the best that its budget allows."""
        begun, probe = time.perf_counter(), self._probe()
        surveyor = Surveyor(probe, self.settings, held_fields(self.settings), max(budgets), None)
        with probe.restoring():
            survey = surveyor.measure()
            own = {name: count for name, count in counts.items() if name in survey.counts}
            truth = surveyor.truth(dataclasses.replace(survey, whole_counts=own, whole_samples=survey.samples))
            tried = []
            choices, ratios = combinations(survey, PAST * max(budgets))
            for choice in choices[:most]:
                surveyor.look("", choice)
                error = probe.rmse(truth)
                tried.append((statistics.median(probe.frames(1, FRAMES + 1)[1:]), error, surveyor.at(choice)))
                probe.animate(probe.now_s)
            judged = []
            for found in fits:
                probe.look(found.settings)
                judged.append(probe.rmse(truth))
        row = {
            "tried.count": len(tried), "tried.of": len(choices), "tried.ratio": round(ratios[len(tried) - 1], 3),
            "tried.s": round(time.perf_counter() - begun, 1),
        }  # fmt: skip
        return [row | _outcome(error, budget, tried) for error, budget in zip(judged, budgets, strict=True)]


def combinations(survey: Survey, most_ms: float) -> tuple[list[Choice], list[float]]:
    """Every combination of rungs, but for rungs whose price is an estimate and frames past a time as predicted.

    Returns:
        The combinations, and how many times the least error of any that takes no longer each one's is, as predicted: in
        that order, least first.
    """
    market = Market(survey.grid, survey.ladders)
    single = [x for x in survey.ladders if x.name not in FORMATS + CHEAP]
    cheap = {x.name: x.offers[0].rung for x in survey.ladders if x.name in CHEAP}
    formats = [x for x in survey.ladders if x.name in FORMATS]
    ends = [{x.name: x.offers[end].rung for x in formats} for end in ((0, -1) if formats else (0,))]
    offers = [[offer.rung for offer in x.offers if not offer.estimated] for x in single]
    found = []
    for (scale, rung), end, *rungs in itertools.product(survey.grid.errors, ends, *offers):
        choice = {"scale": scale, "anti_aliasing": rung, **end, **cheap}
        choice |= {x.name: name for x, name in zip(single, rungs, strict=True)}
        ms, error = market.predict(choice)
        if ms <= most_ms:
            found.append((ms, error, choice))
    found.sort(key=lambda one: one[:2])
    least = itertools.accumulate((error for _, error, _ in found), min)
    rated = [(error / max(low, 1e-9), choice) for (_, error, choice), low in zip(found, least, strict=True)]
    rated.sort(key=lambda one: one[0])
    return [choice for _, choice in rated], [ratio for ratio, _ in rated]


def _outcome(error: float, budget: float, tried: Sequence[tuple[float, float, Settings]]) -> dict[str, Any]:
    """What a choice is off by beside the best of those tried that keep the budget."""
    possible = [found for found in tried if found[0] <= budget]
    row: dict[str, Any] = {"error.judged": float(f"{error:.4g}")}
    if possible:
        ms, best, settings = min(possible, key=lambda found: found[:2][::-1])
        row |= {"best.error": float(f"{best:.4g}"), "best.frame_ms": round(ms, 5), "best.share": round(ms / budget, 4)}
        row["best.bought"] = " ".join(assignments(settings))
        row["error.ratio"] = round(error / best, 4) if best > 0.0 else 1.0
    return row


def _seconds(first: Fit, cached: Fit, found: Fit) -> dict[str, Any]:
    """Seconds that the three calls took."""
    return {
        "first.s": round(first.seconds, 3), "first.load_s": round(first.load_seconds, 3),
        "first.compile_s": round(first.cold_seconds, 3), "first.compiled": first.compiled,
        "fit.s": round(found.seconds, 3), "fit.frames": found.plans, "cached.s": round(cached.seconds, 3),
    }  # fmt: skip


def _choice(found: Fit) -> dict[str, Any]:
    """What was bought, and whether it keeps the budget."""
    return {
        "bought": " ".join(assignments(found.settings)), "frame.ms": round(found.ms.median, 5),
        "frame.ms_p5": round(found.ms.p5, 5), "frame.ms_p95": round(found.ms.p95, 5),
        "frame.repeats": found.ms.count, "held.share": round(found.held, 4), "met": found.met,
        "predicted.frame_ms": round(found.predicted_ms, 5), "error.predicted": float(f"{found.predicted_error:.4g}"),
        "error.rmse": float(f"{found.error:.4g}"), "next": found.next, "unspent": found.unspent,
        "spent.share": round(found.ms.median / found.budget_ms, 4),
    }  # fmt: skip


if __name__ == "__main__":
    _own_process()
