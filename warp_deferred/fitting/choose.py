"""From predictions to a choice that was rendered and timed.

The frame that the model likes best is looked at for real; what its time and error turn out to be corrects the model's
figures for frames of the same size and number of samples, and roughly for all. So it goes on until no frame that was
not looked at promises to be better than the best that was and fits. A few that are predicted to miss the budget by less
than predictions err are looked at, too, where they promise much. Then come frames of a time interval that nobody has
seen: where fewer than 19 of 20 stay within the budget, the next best frame is tried on the interval after that.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from .clock import Spread
from .ladders import EXACT
from .model import Choice, Market, best
from .probe import Probe
from .survey import Surveyor

__all__ = ["HELD_SHARE", "Chooser", "Verified"]

#: Share of unseen frames that must stay within the budget.
HELD_SHARE = 0.95
#: Frames looked at for real, at most, and intervals tried.
MOST_VERIFIED, MOST_TRIES = 10, 4
#: What a frame must promise to be looked at: so much less error, or time, than the best so far.
WORTHWHILE = 0.02
#: So much less error will do where that one takes less than this share of the budget.
LITTLE, SPENT = 0.003, 0.9
#: What a prediction may be too high by, as a share of the budget; how much less error then makes it worth a look; and
#: how many such looks. On an H200, at 2 ms, a frame was predicted 1.2 % too high that had 14 % less error.
DOUBT, HOPED, MOST_DOUBTS = 0.03, 0.05, 3
#: Frames timed one by one for a verified time, and of an interval that was not seen: on CUDA, on the CPU.
SEEN, UNSEEN = {"cuda": 10, "cpu": 5}, {"cuda": 40, "cpu": 20}
#: Time after which fewer frames must do, but for those that a budget is held against [ms].
PATIENCE_MS = 3_000.0


@dataclasses.dataclass
class Verified:
    """A frame that was rendered and timed.

    Attributes:
        choice: Its rungs.
        predicted_ms: What the model said of its time [ms].
        predicted_error: What the model said of its error.
        ms: Time of frames as they come, uploads included [ms].
        error: RMSE of its picture against the reference.
        held: Share of unseen frames that stayed within the budget; None if none were looked at.
        unseen: Times of those frames.
    """

    choice: Choice
    predicted_ms: float
    predicted_error: float
    ms: Spread
    error: float
    held: float | None = None
    unseen: Spread | None = None


class Chooser:
    """Buys on a market and looks at what it bought.

    Args:
        market: All frames with their predictions.
        surveyor: Knows settings and looks.
        truth: The reference's picture.
        budget_ms: Most a frame may take [ms]; None: any.
        max_error: Most the picture may be off by; None: as little as the budget buys.
        whole_samples: Samples a pixel of the reference.
    """

    def __init__(
        self,
        market: Market,
        surveyor: Surveyor,
        truth: wp.array,
        budget_ms: float | None,
        max_error: float | None,
        whole_samples: int,
    ) -> None:
        self.market, self.surveyor, self.truth = market, surveyor, truth
        self.budget_ms, self.max_error, self.whole_samples = budget_ms, max_error, whole_samples
        self.probe: Probe = surveyor.probe
        self.kind = "cuda" if self.probe.device.is_cuda else "cpu"
        #: Verified frames by index on the market.
        self.verified: dict[int, Verified] = {}
        self._ruled_out: set[int] = set()
        self._doubts = 0
        #: First frame that nobody has seen; those that are verified by come before.
        self._interval = SEEN[self.kind] + 2

    def choose(self) -> Verified:
        """Buy, verify, and try on unseen frames; the nearest possible where nothing fits."""
        for _ in range(MOST_TRIES):
            index = self._settle()
            chosen = self.verified[index]
            if self.budget_ms is None or chosen.ms.p95 > self.budget_ms:
                # Without a budget, or none that can be kept: no share to speak of, but frames as they come.
                self._try(chosen)
                return chosen
            self._try(chosen)
            if chosen.held >= HELD_SHARE:
                return chosen
            self._ruled_out.add(index)
        tried = [v for v in self.verified.values() if v.held is not None]
        return max(tried, key=lambda v: (v.held, -v.error))

    def _settle(self) -> int:
        """Look at frames until nothing promises more; index of the best one."""
        while len(self.verified) < MOST_VERIFIED + len(self._ruled_out):
            index = self._promising()
            if index is None:
                break
            self._verify(index)
        found = self._best_verified()
        if found is not None:
            return found
        return self._nearest()

    def corrected(self) -> tuple[np.ndarray, np.ndarray]:
        """Predicted times and errors of all frames, by what the verified ones turned out to be."""
        ms, error = self.market.ms.copy(), self.market.error.copy()
        seen = list(self.verified.items())
        if not seen:
            return ms, error
        places = [index for index, _ in seen]
        cells, weights = self.market.cell[places], self.market.weight[places]
        time = np.array([_correction(v.predicted_ms, v.ms.p95) for _, v in seen])
        square = np.array([_correction(v.predicted_error**2, v.error**2) for _, v in seen])
        # Sizes and samples that nobody has looked at: as much more a sample and pixel, but no more than what was seen.
        factor, more = np.median(time[:, 0]), np.median(time[:, 1] / weights)
        ms = factor * ms + np.minimum(more * self.market.weight, np.median(time[:, 1]))
        factor, more = np.median(square, axis=0)
        error = factor * error**2 + more
        for cell in set(cells.tolist()):
            own, last = self.market.cell == cell, np.flatnonzero(cells == cell)[-1]
            ms[own] = time[last, 0] * self.market.ms[own] + time[last, 1]
            error[own] = square[last, 0] * self.market.error[own] ** 2 + square[last, 1]
        error = np.sqrt(error)
        for index, v in seen:
            ms[index], error[index] = v.ms.p95, v.error
        return ms, error

    def buyable(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and errors as `corrected` has them, without the frames that did not hold."""
        ms, error = self.corrected()
        ms[list(self._ruled_out)] = np.inf
        return ms, error

    def swapped(self, chosen: Verified, other: Choice) -> tuple[float, float]:
        """What another frame takes more than a verified one [ms], and what its picture is off by, corrected by it."""
        ms, error = self.market.predict(other)
        factor, more = _correction(chosen.predicted_error**2, chosen.error**2)
        return ms - chosen.predicted_ms, math.sqrt(factor * error**2 + more)

    def _promising(self) -> int | None:
        """The frame to look at next: the best that was not, if it promises enough."""
        ms, error = self.corrected()
        ms = ms.copy()
        ms[list({*self.verified, *self._ruled_out})] = np.inf
        index = best(ms, error, self.budget_ms if self.budget_ms is not None else np.finfo(float).max, self.max_error)
        known = self._best_verified()
        if known is None:
            return index
        found = self.verified[known]
        if index is not None and self.max_error is not None and found.error <= self.max_error:
            return index if ms[index] < (1.0 - WORTHWHILE) * found.ms.p95 else None
        least = WORTHWHILE if self._spends(found) else LITTLE
        if index is not None and error[index] < (1.0 - least) * found.error:
            return index
        return self._doubtful(ms, error, found.error)

    def _doubtful(self, ms: np.ndarray, error: np.ndarray, least: float) -> int | None:
        """A frame a little past the budget, as predicted, that would be worth much if that were too high."""
        if self.budget_ms is None or self.max_error is not None or self._doubts == MOST_DOUBTS:
            return None
        index = best(ms, error, (1.0 + DOUBT) * self.budget_ms, None)
        if index is None or error[index] >= (1.0 - HOPED) * least:
            return None
        self._doubts += 1
        return index

    def _spends(self, found: Verified) -> bool:
        return self.budget_ms is None or found.ms.median >= SPENT * self.budget_ms

    def _best_verified(self) -> int | None:
        places = [k for k in self.verified if k not in self._ruled_out]
        if not places:
            return None
        ms = np.array([self.verified[k].ms.p95 for k in places])
        error = np.array([self.verified[k].error for k in places])
        found = best(ms, error, self.budget_ms, self.max_error)
        return None if found is None else places[found]

    def _nearest(self) -> int:
        """Where nothing fits: within the budget what is nearest to the error, else the fastest frame there is."""
        if self.max_error is not None:
            # The error cannot be had, at this price or at all: the least that the budget buys.
            wanted, self.max_error = self.max_error, None
            index = self._settle()
            self.max_error = wanted
            return index
        ms, _ = self.corrected()
        ms[list(self._ruled_out)] = np.inf
        for _ in range(MOST_TRIES):
            index = int(np.argmin(ms))
            if index in self.verified:
                break
            self._verify(index)
            ms, _ = self.corrected()
            ms[list(self._ruled_out)] = np.inf
        usable = [k for k in self.verified if k not in self._ruled_out] or list(self.verified)
        return min(usable, key=lambda k: self.verified[k].ms.median)

    def _verify(self, index: int) -> None:
        """Render and time a frame, first as it is and then as it moves."""
        choice = self.market.choice(index)
        predicted = float(self.market.ms[index]), float(self.market.error[index])
        self.surveyor.look("verifying " + short(choice), choice)
        error = self.probe.rmse(self.truth)
        if self.market.samples(choice) >= self.whole_samples and self._is_poor(choice):
            # The reference has no more samples or rays than this: it would flatter itself.
            error = max(error, predicted[1])
        ms = self._frames(1, self._count(SEEN[self.kind], predicted[0]))
        self.probe.animate(self.probe.now_s)
        self.verified[index] = Verified(choice, *predicted, ms, error)

    def _is_poor(self, choice: Choice) -> bool:
        """Whether the reference has fewer samples than it might, or rays that the frame has, too."""
        traces = any(rung.startswith("ray_traced ") for rung in choice.values())
        return traces or self.whole_samples < self.surveyor.samples

    def _try(self, chosen: Verified) -> None:
        """Time frames of an interval that was not seen, and count those within the budget."""
        self.surveyor.look("unseen frames", chosen.choice)
        count = UNSEEN[self.kind]
        if self.budget_ms is None:
            count = self._count(count, chosen.ms.median)
        values = self.probe.frames(self._interval, count)
        self._interval += count
        chosen.unseen = Spread.of(values)
        if self.budget_ms is not None:
            chosen.held = sum(value <= self.budget_ms for value in values) / count

    @staticmethod
    def _count(count: int, ms: float) -> int:
        """Frames to time, of so many, where one takes so long."""
        return max(1, min(count, int(PATIENCE_MS / max(ms, 1e-3))))

    def _frames(self, first: int, count: int) -> Spread:
        # The first one still finds caches and shadow maps of the look before.
        return Spread.of(self.probe.frames(first, count + 1)[1:])


def short(choice: Choice) -> str:
    """A frame in few words: the rungs that are no ladder's usual one."""
    from .ladders import LADDERS

    usual = {ladder.name: ladder.base for ladder in LADDERS} | {"scale": "off", EXACT.name: EXACT.base}
    return ", ".join(f"{name} {rung}" for name, rung in choice.items() if usual.get(name) != rung)


def _correction(predicted: float, found: float) -> tuple[float, float]:
    """Factor and summand that make what was found of what was predicted: what was too much shrinks in proportion."""
    if found < predicted:
        return found / predicted, 0.0
    return 1.0, found - predicted
