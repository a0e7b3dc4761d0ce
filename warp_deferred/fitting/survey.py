"""Measuring the ladders on one scene: what every rung costs and what the picture is off by without the better one.

One frame is the base: one sample a pixel at full size, every ladder at its base rung, what the user set held. A rung's
price is what a frame takes more with it alone changed; its error, the RMSE of that picture against the ladder's
reference in the same frame, so that stairs of edges, which the base has, do not drown it. `scale` and `anti_aliasing`
are measured together, against the most samples at full size. References that trace rays take fewer of them than a
picture would, as the time allowed buys; how many is told.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import warp as wp

from ..sampling import sample_count
from ..settings import Settings
from .ladders import AMOUNTS, EXACT, FEW_LIGHTS, LADDERS, PIXEL_SAMPLES, SCALES, Ladder, Rung
from .model import Choice, Grid, LadderPrices, Offer, Survey, share
from .probe import Probe

__all__ = ["Progress", "Surveyor"]

#: Called with (what is measured, done, about how many in all).
Progress = Callable[[str, int, int], Any]
#: On the CPU no reference takes longer than so many base frames: small pictures are done at once.
CPU_FRAMES = 150
#: Most that a reference may take, on CUDA and on the CPU: samples of the pixel, rays of a ladder, all together [ms].
ALLOWED_MS = {"samples": (400.0, 10_000.0), "rays": (150.0, 3_000.0), "whole": (600.0, 15_000.0)}
#: A frame of the grid is measured up to so many times the budget, and on CUDA whenever it takes less than this [ms].
REACH, CHEAP_MS = 3.0, 25.0
#: Rays or samples of a reference that traces, dear to cheap. Few counts: a shadow's is compiled in.
COUNTS = (64, 16, 8, 4)
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
        for ladder in (*LADDERS, EXACT):
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
        texts = list(self.free.settings) if self._sold(EXACT) else []
        for ladder in filter(self._sold, LADDERS):
            name = choice.get(ladder.name, ladder.base)
            texts += ladder.rung(name).settings
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
        counts: dict[str, int] = {}
        reference_ms: dict[str, float] = {}
        taken: dict[int, float] = {}
        ladders = tuple(
            self._climb(ladder, counts, reference_ms, taken, samples) for ladder in LADDERS if self._sold(ladder)
        )
        grid = self._grid(samples, taken)
        whole_samples, whole_counts = self._whole(samples, counts, reference_ms)
        return Survey(
            grid, ladders, self.free.name if self._sold(EXACT) else "", free_ms,
            dict(self.fixed), dict(self.absent), list(self.unmeasured), samples, counts, whole_samples, whole_counts,
            base, float("inf") if self.budget_ms is None else self.budget_ms,
        )  # fmt: skip

    def _sold(self, ladder: Ladder) -> bool:
        return ladder.name not in self.fixed and ladder.name not in self.absent

    def look(self, title: str, choice: Choice, counts: dict[str, int] | None = None) -> None:
        """Look at a frame, and tell that it is looked at."""
        if self._progress:
            total = 14 + sum(len(ladder.rungs) for ladder in LADDERS if self._sold(ladder))
            self._progress(title, self._done, max(total, self._done + 1))
        self._done += 1
        self.probe.look(self.at(choice, counts))

    def _find_absent(self) -> None:
        reports = {report.name: report for report in self.probe.plan.reports(False)}
        for ladder in (*LADDERS, EXACT):
            report = reports.get(ladder.needs)
            if ladder.name not in self.fixed and report is not None and not report.runs:
                self.absent[ladder.name] = report.reason

    def _cull(self, usual_ms: float) -> tuple[float, float]:
        """Find the fastest rung of light culling; every one gives the same bits."""
        if not self._sold(EXACT):
            return usual_ms, usual_ms
        times = {self.free.name: usual_ms}
        few = len(self.probe.renderer.scene.lights) <= FEW_LIGHTS
        for rung in EXACT.rungs:
            if rung.name not in times and (few or rung.name.startswith("tiles_depth")):
                self.free = rung
                self.look(f"light_culling {rung.name}", {})
                times[rung.name] = self.probe.price()
        # Another one must be worth more than the noise.
        fastest = min(times, key=times.__getitem__)
        if times[fastest] > 0.99 * usual_ms:
            fastest = EXACT.base
        self.free = EXACT.rung(fastest)
        return times[fastest], usual_ms

    def _climb(
        self,
        ladder: Ladder,
        counts: dict[str, int],
        reference_ms: dict[str, float],
        taken: dict[int, float],
        samples: int,
    ) -> LadderPrices:
        """Measure a ladder: the reference's picture first, then each rung's price and distance from it."""
        rungs = [rung for rung in ladder.rungs if rung.samples <= samples]
        best = rungs[-1]
        if ladder.name in AMOUNTS:
            counts[ladder.name] = COUNTS[1]
        self.look(f"{ladder.name} {best.name}", {ladder.name: best.name}, counts)
        reference_ms[ladder.name] = ms = self.probe.price()
        if ladder.name in AMOUNTS:
            self._refine(ladder, best, counts, reference_ms)
            ms = reference_ms[ladder.name]
        picture = self.probe.picture()
        offers: dict[str, Offer] = {}
        for rung in rungs[:-1]:
            error, price = self.probe.rmse(picture, self.base_picture), self.base_ms
            if rung.name != ladder.base:
                self.look(f"{ladder.name} {rung.name}", {ladder.name: rung.name})
                error, price = self.probe.rmse(picture), self._settled(self.probe.price())
            once = self._once(ladder, rung, price)
            offers[rung.name] = dataclasses.replace(
                self._offer(ladder, rung, price, error, offers, taken), once_ms=once
            )
        offers[best.name] = self._top(ladder, best, ms, counts, offers, taken)
        return LadderPrices(ladder.name, ladder.part, tuple(offers[rung.name] for rung in rungs))

    def _once(self, ladder: Ladder, rung: Rung, price: float) -> float:
        """What a frame in motion takes more than with the base rung, beside what a frame at rest does.

        Shadow maps of what rests are kept, so that a replayed frame draws none; and samples share them.
        """
        if ladder.name != "shadow" or rung.name == ladder.base or not self.probe.moves:
            return 0.0
        extra = self.probe.in_motion() - price - self.moving_ms
        return extra if abs(extra) > self.noise_ms else 0.0

    def _weight(self, ladder: Ladder) -> float:
        """How often the base frame pays a ladder's price of one sample at full size."""
        return self.base_share * (self.base_samples if ladder.part == "sample" else 1)

    def _offer(
        self,
        ladder: Ladder,
        rung: Rung,
        ms: float,
        error: float,
        offers: dict[str, Offer],
        taken: dict[int, float],
    ) -> Offer:
        """Price of a rung; one that takes samples costs those, and beside them what the stage's `off` does."""
        weight = self._weight(ladder)
        if rung.samples == 1:
            return Offer(rung.name, (ms - self.base_ms) / weight, error)
        without = offers["off"].ms
        taken.setdefault(rung.samples, ms - without * weight)
        return Offer(rung.name, without, error, rung.samples)

    def _top(
        self,
        ladder: Ladder,
        rung: Rung,
        ms: float,
        counts: dict[str, int],
        offers: dict[str, Offer],
        taken: dict[int, float],
    ) -> Offer:
        """Offer of the reference rung; a traced one at as many rays as its settings say, not at the survey's count."""
        if ladder.name not in AMOUNTS:
            return self._offer(ladder, rung, ms, 0.0, offers, taken)
        stage, _, field = AMOUNTS[ladder.name].partition(".")
        wanted = getattr(getattr(self.settings, stage), field)
        without = min(offer.ms for offer in offers.values())
        rays_ms = (ms - self.base_ms) / self._weight(ladder) - without
        # Rays need no maps, as `off` needs none.
        once = offers["off"].once_ms
        return Offer(rung.name, without + rays_ms * wanted / counts[ladder.name], 0.0, 1, True, once)

    def _limit_ms(self, kind: str) -> float:
        """Most that a reference may take [ms]."""
        cuda, cpu = ALLOWED_MS[kind]
        return cuda if self.cuda else min(cpu, CPU_FRAMES * self.base_ms)

    def _settled(self, ms: float) -> float:
        """A frame's time, or the base frame's where the difference drowns in the spread."""
        return ms if abs(ms - self.base_ms) > self.noise_ms else self.base_ms

    def _refine(self, ladder: Ladder, rung: Rung, counts: dict[str, int], reference_ms: dict[str, float]) -> None:
        """Take more rays where the time allowed buys them, fewer where it does not buy these."""
        count, ms = counts[ladder.name], reference_ms[ladder.name]
        limit = self._limit_ms("rays")
        wanted = next((n for n in COUNTS if ms * n / count <= limit), COUNTS[-1])
        if wanted != count:
            counts[ladder.name] = wanted
            self.look(f"{ladder.name} {rung.name}", {ladder.name: rung.name}, counts)
            reference_ms[ladder.name] = self.probe.price()

    def _affordable(self, most: int, ms: float, kind: str) -> int:
        """Most samples a pixel, by quarters, that the time allowed buys; those held where they are."""
        if "anti_aliasing" in self.fixed and not self._takes_samples():
            return self.base_samples
        limit = self._limit_ms(kind)
        while most > 4 and most * ms > limit:
            most //= 4
        return most

    def _takes_samples(self) -> bool:
        return any(self._sold(ladder) and ladder.rungs[-1].samples > 1 for ladder in LADDERS)

    def _grid(self, samples: int, taken: dict[int, float]) -> Grid:
        """Measure size against samples of the pixel; what is held stays as it is."""
        held = self.fixed.get("anti_aliasing")
        sold = "scale" not in {**self.fixed, **self.absent}
        scales = list(SCALES) if sold else [self.settings.scale.rung]
        rungs = [held] if held else [name for name, count in PIXEL_SAMPLES.items() if count <= samples]
        top = f"samples_{samples}"
        self.look(f"{samples} samples a pixel", {"scale": "off", "anti_aliasing": top})
        picture = self.probe.picture()
        times: dict[tuple[str, int], float] = {(scales[0], self.base_samples): self.base_ms}
        errors = {(scales[0], held or "off"): self.probe.rmse(picture, self.base_picture)}
        if not held and self._within_reach(Grid(times, {}).time(scales[0], samples)):
            times[scales[0], max(samples, self.base_samples)] = self.probe.price()
            errors[scales[0], top] = 0.0
        fxaa_ms = 0.0
        for scale, rung in itertools.product(scales, rungs):
            count = max(PIXEL_SAMPLES[rung], self.base_samples)
            # Pixels by the hundred are better spent at full size than on a picture that is scaled up.
            if (scale, rung) in errors or (scale != scales[0] and PIXEL_SAMPLES[rung] == MOST_SAMPLES):
                continue
            guess = Grid(times, {}).time(scale, count)
            if not self._within_reach(guess):
                self.unmeasured.append(f"{_cell(scale, rung)} (about {guess:.3g} ms)")
                continue
            self.look(_cell(scale, rung), {"scale": scale, "anti_aliasing": rung})
            errors[scale, rung] = self.probe.rmse(picture)
            if rung != "fxaa":
                times[scale, count] = self.probe.price()
            elif scale == scales[0] and not held:
                # Of full size; every other size pays its share.
                fxaa_ms = max(self.probe.price() - times[scale, count], 0.0) / share(scale)
        for count, ms in taken.items():
            times.setdefault((scales[0], count), ms)
        return Grid(times, errors, fxaa_ms, self.base_samples, self.moving_ms)

    def _within_reach(self, ms: float) -> bool:
        if self.budget_ms is None:
            return True
        return ms <= max(REACH * self.budget_ms, CHEAP_MS if self.cuda else 2.0 * self.base_ms)

    def _whole(
        self, samples: int, counts: dict[str, int], reference_ms: dict[str, float]
    ) -> tuple[int, dict[str, int]]:
        """How many samples and rays the picture may take in which all references stand together."""
        limit, chosen = self._limit_ms("whole"), dict(counts)

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


def _cell(scale: str, rung: str) -> str:
    return f"anti_aliasing {rung}" + ("" if scale == "off" else f" at scale {scale}")


def _held_text(ladder: Ladder, settings: Settings, held: frozenset[tuple[str, str]]) -> str:
    """What the user's settings say of a ladder."""
    return ", ".join(
        f"{stage}.{field}={getattr(getattr(settings, stage), field)}"
        for stage, field in sorted(ladder.fields)
        if (stage, field) in held or field == "rung"
    )
