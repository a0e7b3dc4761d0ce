"""Measuring a ladder: what each rung's frame costs, and what its picture is off by from the ladder's reference.

Rungs that differ from another one in a number alone are not looked at: time grows in proportion to samples and rays,
and errors fall by a power of them.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import warp as wp

from .curves import sample_errors
from .ladders import AMOUNTS, INDEPENDENT, RAY_POWERS, Ladder, Rung
from .model import LadderPrices, Offer

if TYPE_CHECKING:
    from .survey import Surveyor

__all__ = ["COUNTS", "Climber"]

#: Rays or samples of a reference that traces, dear to cheap. Few counts: a shadow's is compiled in.
COUNTS = (64, 16, 8, 4)


class Climber:
    """Climbs the ladders of a survey from its base frame.

    Args:
        surveyor: Looks, and knows the base frame.

    Attributes:
        counts: Rays or samples of the references that trace.
        reference_ms: What frames with each ladder's reference take [ms].
        taken: Samples -> time of a frame with so many, where a rung took them [ms].
    """

    def __init__(self, surveyor: Surveyor) -> None:
        self._surveyor, self._probe = surveyor, surveyor.probe
        self.counts: dict[str, int] = {}
        self.reference_ms: dict[str, float] = {}
        self.taken: dict[int, float] = {}

    def climb(self, ladder: Ladder) -> LadderPrices:
        """Measure a ladder: the reference's picture first, then each rung's price and distance from it."""
        rungs = [rung for rung in ladder.rungs if rung.samples <= self._surveyor.samples]
        best = rungs[-1]
        picture = self._look_at_reference(ladder, best)
        offers: dict[str, Offer] = {}
        base_ms = self._surveyor.base_ms
        for rung in _looked(rungs):
            if rung.name == ladder.base:
                error, price = self._probe.rmse(picture, self._surveyor.base_picture), base_ms
            else:
                self._surveyor.look(f"{ladder.name} {rung.name}", {ladder.name: rung.name})
                error, price = self._probe.rmse(picture), self._settled(self._probe.price())
            offer = self._offer(ladder, rung, price, error, offers)
            offers[rung.name] = dataclasses.replace(offer, once_ms=self._once(ladder, rung, price))
        if ladder.name in AMOUNTS:
            self._trace(ladder, rungs, picture, offers)
        else:
            offers[best.name] = self._offer(ladder, best, self.reference_ms[ladder.name], 0.0, offers)
            _interpolate(rungs, offers)
        return LadderPrices(ladder.name, ladder.part, tuple(offers[r.name] for r in rungs if r.name in offers))

    def _look_at_reference(self, ladder: Ladder, rung: Rung) -> wp.array:
        """Look at the reference; with more rays where the time allowed buys them, fewer where it does not buy these."""
        name, choice = ladder.name, {ladder.name: rung.name}
        if rung.name == ladder.base:
            self.reference_ms[name] = self._surveyor.base_ms
            return self._surveyor.base_picture
        count = COUNTS[1]
        if name in AMOUNTS:
            self.counts[name] = count
        self._surveyor.look(f"{name} {rung.name}", choice, self.counts)
        self.reference_ms[name] = ms = self._probe.price()
        limit = self._surveyor.limit_ms("rays")
        wanted = next((n for n in COUNTS if ms * n / count <= limit), COUNTS[-1])
        if name in AMOUNTS and wanted != count:
            self.counts[name] = wanted
            self._surveyor.look(f"{name} {rung.name}", choice, self.counts)
            self.reference_ms[name] = self._probe.price()
        return self._probe.picture()

    def _once(self, ladder: Ladder, rung: Rung, price: float) -> float:
        """What a frame in motion takes more than with the base rung, beside what a frame at rest does.

        Shadow maps of what rests are kept, so that a replayed frame draws none; and samples share them.
        """
        if ladder.name != "shadow" or rung.name == ladder.base or not self._probe.moves:
            return 0.0
        extra = self._probe.in_motion() - price - self._surveyor.moving_ms
        return extra if abs(extra) > self._surveyor.noise_ms else 0.0

    def _weight(self, ladder: Ladder) -> float:
        """How often the base frame pays a ladder's price of one sample at full size."""
        return self._surveyor.base_share * (self._surveyor.base_samples if ladder.part == "sample" else 1)

    def _offer(self, ladder: Ladder, rung: Rung, ms: float, error: float, offers: dict[str, Offer]) -> Offer:
        """Price of a rung; one that takes samples costs those, and beside them what the stage's `off` does."""
        weight = self._weight(ladder)
        if rung.samples == 1:
            return Offer(rung.name, (ms - self._surveyor.base_ms) / weight, error)
        without = offers["off"].ms
        self.taken.setdefault(rung.samples, ms - without * weight)
        return Offer(rung.name, without, error, rung.samples)

    def _settled(self, ms: float) -> float:
        """A frame's time, or the base frame's where the difference drowns in the spread."""
        return ms if abs(ms - self._surveyor.base_ms) > self._surveyor.noise_ms else self._surveyor.base_ms

    def _trace(self, ladder: Ladder, rungs: list[Rung], picture: wp.array, offers: dict[str, Offer]) -> None:
        """Offer the reference at as many rays as the settings say, and fewer where the budget reaches any.

        All prices follow from the reference's frame, whose rays are many: a few would drown in the spread.
        """
        stage, _, field = AMOUNTS[ladder.name].partition(".")
        wanted, count = getattr(getattr(self._surveyor.settings, stage), field), self.counts[ladder.name]
        without, weight = min(offer.ms for offer in offers.values()), self._weight(ladder)
        ray_ms = ((self.reference_ms[ladder.name] - self._surveyor.base_ms) / weight - without) / count
        # Rays need no maps, as `off` needs none.
        once = offers["off"].once_ms
        best = rungs[-1].name
        offers[best] = Offer(best, without + ray_ms * wanted, 0.0, 1, True, once)
        few = [rung for rung in rungs if 0 < rung.rays < wanted]
        looked = next((rung for rung in few if COUNTS[-1] <= rung.rays < count), None)
        least = self._surveyor.base_ms + weight * (without + ray_ms * (few[0].rays if few else wanted))
        if looked is None or not self._surveyor.within_reach(least):
            return
        self._surveyor.look(f"{ladder.name} {looked.name}", {ladder.name: looked.name})
        power = RAY_POWERS[ladder.name]
        # The reference's picture is off by what its own rays leave, too.
        own = self._probe.rmse(picture) / (1.0 + (looked.rays / count) ** (2.0 * power)) ** 0.5
        for rung in few:
            error = own * (looked.rays / rung.rays) ** power
            price = without + ray_ms * rung.rays
            offers[rung.name] = Offer(rung.name, price, error, 1, True, once, ladder.name in INDEPENDENT)


def _looked(rungs: list[Rung]) -> list[Rung]:
    """Rungs below the reference that are looked at; of those that take samples the one in the middle."""
    several = [rung for rung in rungs[:-1] if rung.samples > 1]
    middle = several[len(several) // 2 : len(several) // 2 + 1]
    return [rung for rung in rungs[:-1] if not rung.rays and (rung.samples == 1 or rung in middle)]


def _interpolate(rungs: list[Rung], offers: dict[str, Offer]) -> None:
    """Offer the numbers of samples that were not looked at, at the price of those that were."""
    known = {rung.samples: offers[rung.name].error for rung in rungs[:-1] if rung.samples > 1 and rung.name in offers}
    for rung in rungs[:-1]:
        if rung.name not in offers and known:
            error = sample_errors(known, [rung.samples])[rung.samples]
            offers[rung.name] = dataclasses.replace(offers["off"], rung=rung.name, error=error, samples=rung.samples)
