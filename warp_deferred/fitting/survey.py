"""Measuring the ladders on one scene: what every rung costs and what the picture is off by without the better one.

One frame is the base: one sample a pixel at full size, every ladder at its base rung, what the user set held. A rung's
price is what a frame takes more with it alone changed; its error, the RMSE of that picture against the ladder's
reference in the same frame, so that stairs of edges, which the base has, do not drown it. `scale` and `anti_aliasing`
are measured together, against the most samples at full size. References that trace rays take fewer of them than a
picture would, as the time allowed buys; how many is told. What differs in a number alone is measured at two or three of
them: time grows in proportion to samples and rays, errors fall by a power of them (`curves.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import warp as wp

from ..sampling import sample_count
from ..settings import Settings
from .climb import COUNTS, Climber
from .ladders import AMOUNTS, EXACT, FEW_LIGHTS, LADDERS, Ladder
from .model import Choice, Survey, share
from .probe import Probe
from .sizes import measure_grid

__all__ = ["Progress", "Surveyor"]

#: Called with (what is measured, done, about how many in all).
Progress = Callable[[str, int, int], Any]
#: On the CPU no reference takes longer than so many base frames: small pictures are done at once.
CPU_FRAMES = 150
#: Most that a reference may take, on CUDA and on the CPU: samples of the pixel, rays of a ladder, all together [ms].
ALLOWED_MS = {"samples": (400.0, 10_000.0), "rays": (150.0, 3_000.0), "whole": (600.0, 15_000.0)}
#: A frame of the grid is measured up to so many times the budget, and on CUDA whenever it takes less than this [ms].
REACH, CHEAP_MS = 3.0, 25.0
#: Samples of lens and shutter that references take.
MOST_SAMPLES = 64


class Surveyor:
    """Measures a scene's ladders.

    Args:
        probe: Looks at the scene.
        settings: The user's settings.
        held: (stage, field) of what must stay as it is.
        budget_ms: Time that frames will be bought for; None: any.
        progress: Told how far it is.
    """

    def __init__(
        self,
        probe: Probe,
        settings: Settings,
        held: frozenset[tuple[str, str]],
        budget_ms: float | None,
        progress: Progress | None,
    ) -> None:
        self.probe, self.settings, self.budget_ms = probe, settings, budget_ms
        self._progress, self._done = progress, 0
        self.cuda = probe.device.is_cuda
        self.free = EXACT.rung(EXACT.base)
        #: Samples a pixel of the reference of the grid.
        self.samples = 1
        self.absent: dict[str, str] = {}
        self.fixed: dict[str, str] = {}
        self.unmeasured: list[str] = []
        #: Ladders without the amounts that are held.
        self.ladders = tuple(_without(ladder, held) for ladder in LADDERS)
        for ladder in (*self.ladders, EXACT):
            if ladder.fields & held:
                self.fixed[ladder.name] = _held_text(ladder, settings, held)
        for name in ("scale", "anti_aliasing"):
            if (name, "rung") in held:
                self.fixed[name] = getattr(settings, name).rung
        if "scale" not in self.fixed and probe.renderer.outputs != {"display"}:
            self.absent["scale"] = "other outputs than display are asked for"

    # ---- settings

    def at(self, choice: Choice, counts: dict[str, int] | None = None) -> Settings:
        """Settings of a frame: rungs by ladder, the base rung where none is named, what is held as it is."""
        texts = list(self.free.settings) if self.sold(EXACT) else []
        for ladder in filter(self.sold, self.ladders):
            name = choice.get(ladder.name, ladder.base)
            texts += ladder.rung(name).settings + ladder.rung(name).amounts
            if counts and ladder.name in counts and name == ladder.reference.name:
                texts.append(f"{AMOUNTS[ladder.name]}={counts[ladder.name]}")
        for name in ("scale", "anti_aliasing"):
            if name not in self.fixed:
                texts.append(f"{name}.rung={choice.get(name, 'off')}")
        return self.settings.with_values(texts)

    def adopt(self, survey: Survey) -> None:
        """Take prices that were measured before."""
        self.free = EXACT.rung(survey.free or EXACT.base)
        self.absent, self.unmeasured, self.samples = dict(survey.absent), list(survey.unmeasured), survey.samples

    # ---- measuring

    def measure(self) -> Survey:
        """Measure everything that the scene calls for and the budget could reach."""
        self.look("the base frame", {})
        usual_ms = self.probe.price()
        self._find_absent()
        free_ms = self._cull(usual_ms)
        self.probe.look(self.at({}))
        base = self.probe.replays()
        self.base_ms, self.base_picture = base.median if self.cuda else base.p5, self.probe.picture()
        self.moving_ms = max(self.probe.in_motion() - self.base_ms, 0.0)
        self.noise_ms = 0.25 * (base.p95 - base.p5)
        request = self.probe.plan.request
        self.base_samples, self.base_share = sample_count(request), share(request.settings.scale.rung)
        samples = self.samples = self._affordable(MOST_SAMPLES, self.base_ms, "samples")
        climber = Climber(self)
        ladders = tuple(climber.climb(ladder) for ladder in self.ladders if self.sold(ladder))
        grid = measure_grid(self, climber.taken)
        whole_samples, whole_counts = self._whole(samples, climber.counts, climber.reference_ms)
        return Survey(
            grid, ladders, self.free.name if self.sold(EXACT) else "", free_ms,
            dict(self.fixed), dict(self.absent), list(self.unmeasured), samples, climber.counts, whole_samples,
            whole_counts, base, float("inf") if self.budget_ms is None else self.budget_ms,
        )  # fmt: skip

    def sold(self, ladder: Ladder) -> bool:
        """Whether a ladder is for sale."""
        return ladder.name not in self.fixed and ladder.name not in self.absent

    def look(self, title: str, choice: Choice, counts: dict[str, int] | None = None) -> None:
        """Look at a frame, and tell that it is looked at."""
        if self._progress:
            total = 16 + sum(sum(not r.rays for r in x.rungs) for x in self.ladders if self.sold(x))
            self._progress(title, self._done, max(total, self._done + 1))
        self._done += 1
        self.probe.look(self.at(choice, counts))

    def _find_absent(self) -> None:
        reports = {report.name: report for report in self.probe.plan.reports(False)}
        for ladder in (*self.ladders, EXACT):
            report = reports.get(ladder.needs)
            if ladder.name not in self.fixed and report is not None and not report.runs:
                self.absent[ladder.name] = report.reason
        if not self.cuda and "arithmetic" not in self.fixed:
            self.absent.setdefault("arithmetic", "fast and precise arithmetic are one on a CPU")

    def _cull(self, usual_ms: float) -> tuple[float, float]:
        """Find the fastest rung of light culling; every one gives the same bits."""
        if not self.sold(EXACT):
            return usual_ms, usual_ms
        times = {self.free.name: usual_ms}

        def ask(name: str) -> float:
            self.free = EXACT.rung(name)
            self.look(f"light_culling {name}", {})
            times[name] = self.probe.price()
            return times[name]

        # From the usual size of tiles towards the faster side.
        if ask("tiles_depth, 32 px") < usual_ms:
            ask("tiles_depth, 64 px")
        else:
            ask("tiles_depth, 8 px")
        if len(self.probe.renderer.scene.lights) <= FEW_LIGHTS:
            for rung in EXACT.rungs:
                if not rung.name.startswith("tiles_depth"):
                    ask(rung.name)
        # Another one must be worth more than the noise.
        fastest = min(times, key=times.__getitem__)
        if times[fastest] > 0.99 * usual_ms:
            fastest = EXACT.base
        self.free = EXACT.rung(fastest)
        return times[fastest], usual_ms

    def limit_ms(self, kind: str) -> float:
        """Most that a reference may take [ms]."""
        cuda, cpu = ALLOWED_MS[kind]
        return cuda if self.cuda else min(cpu, CPU_FRAMES * self.base_ms)

    def _affordable(self, most: int, ms: float, kind: str) -> int:
        """Most samples a pixel, by quarters, that the time allowed buys; those held where they are."""
        if "anti_aliasing" in self.fixed and not self._takes_samples():
            return self.base_samples
        limit = self.limit_ms(kind)
        while most > 4 and most * ms > limit:
            most //= 4
        return most

    def _takes_samples(self) -> bool:
        return any(self.sold(ladder) and ladder.rungs[-1].samples > 1 for ladder in self.ladders)

    def within_reach(self, ms: float) -> bool:
        """Whether a frame of that time is worth a look for the budget [ms]."""
        if self.budget_ms is None:
            return True
        return ms <= max(REACH * self.budget_ms, CHEAP_MS if self.cuda else 2.0 * self.base_ms)

    def _whole(
        self, samples: int, counts: dict[str, int], reference_ms: dict[str, float]
    ) -> tuple[int, dict[str, int]]:
        """How many samples and rays the picture may take in which all references stand together."""
        limit, chosen = self.limit_ms("whole"), dict(counts)

        def total() -> float:
            extra = sum((ms - self.base_ms) * chosen.get(name, 1) / counts.get(name, 1)
                        for name, ms in reference_ms.items() if name in counts)  # fmt: skip
            return samples * (self.base_ms + extra)

        while total() > limit and any(count > COUNTS[-1] for count in chosen.values()):
            dearest = max(chosen, key=lambda name: (chosen[name] > COUNTS[-1], reference_ms[name] * chosen[name]))
            chosen[dearest] = COUNTS[COUNTS.index(chosen[dearest]) + 1]
        while total() > limit and samples > 16 and "anti_aliasing" not in self.fixed:
            samples //= 4
        return samples, chosen

    def truth(self, survey: Survey) -> wp.array:
        """Render the picture in which all references stand together."""
        choice = {ladder.name: ladder.offers[-1].rung for ladder in survey.ladders}
        choice |= {"scale": "off", "anti_aliasing": f"samples_{survey.whole_samples}"}
        if survey.whole_samples == 1:
            choice["anti_aliasing"] = "off"
        self.look("the reference", choice, survey.whole_counts)
        return self.probe.picture()


def _without(ladder: Ladder, held: frozenset[tuple[str, str]]) -> Ladder:
    """A ladder without the amounts that the user has set."""
    rungs = [r for r in ladder.rungs if not any(tuple(t.partition("=")[0].split(".")) in held for t in r.amounts)]
    return dataclasses.replace(ladder, rungs=tuple(rungs))


def _held_text(ladder: Ladder, settings: Settings, held: frozenset[tuple[str, str]]) -> str:
    """What the user's settings say of a ladder."""
    return ", ".join(
        f"{stage}.{field}={getattr(getattr(settings, stage), field)}"
        for stage, field in sorted(ladder.fields)
        if (stage, field) in held or field == "rung"
    )
