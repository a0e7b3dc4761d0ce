"""The additive model of a frame's time and error, and the exact search over it. Pure: nothing here renders.

Time: the base frame's at the chosen size and number of samples, plus each ladder's price at one sample and full size,
scaled by the share of pixels that are rendered and, for stages that run in every sample, by the samples. Error: stages
err independently, so their squares add up; `scale` and `anti_aliasing`, which do not, are one table. Both are
predictions: the choice is rendered and timed, and what that says corrects them for frames of the same size and samples.

The search is exhaustive. Within a ladder rungs that another one beats in everything are dropped first; what is left of
all of them, some thousand frames, is summed up whole.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from .clock import Spread
from .ladders import PIXEL_SAMPLES, SCALES

__all__ = ["Choice", "Grid", "LadderPrices", "Market", "Offer", "Survey", "best", "share", "undominated"]

#: No choice of rungs makes a frame take less than this share of the same frame at base rungs: where measured prices say
#: so, it is noise that many samples have multiplied.
FLOOR = 0.2
#: Ladder -> rung.
Choice = dict[str, str]


@dataclasses.dataclass(frozen=True)
class Offer:
    """A rung with its price.

    Attributes:
        rung: Its name.
        ms: What one sample at full size takes more than with the ladder's base rung [ms]; may be below zero.
        error: RMSE of the picture against the ladder's reference rung, all else at its base.
        samples: Samples a pixel that a frame with it takes at least.
        estimated: Whether the price was not measured but follows from a cheaper rung's.
        once_ms: What a frame of a scene that moves takes more beside, once, however many pixels and samples [ms].
        independent: Whether samples of the pixel average its error out: its square is that of one, divided by them.
    """

    rung: str
    ms: float
    error: float
    samples: int = 1
    estimated: bool = False
    once_ms: float = 0.0
    independent: bool = False

    def square(self, samples: int) -> float:
        """Squared error in a frame of so many samples."""
        return self.error**2 / (samples if self.independent else 1)


@dataclasses.dataclass(frozen=True)
class LadderPrices:
    """What a ladder offers.

    Attributes:
        name: The stage.
        part: `sample`: its price is paid in every sample; `frame`: once.
        offers: Rungs, cheap to reference.
    """

    name: str
    part: Literal["sample", "frame"]
    offers: tuple[Offer, ...]

    def offer(self, rung: str) -> Offer:
        """Look a rung up by its name, which must be there."""
        return next(offer for offer in self.offers if offer.rung == rung)


@dataclasses.dataclass(frozen=True)
class Grid:
    """Frames by rendered size and samples, all other ladders at their base.

    Attributes:
        times: (rung of `scale`, samples) -> time of the frame [ms].
        errors: (rung of `scale`, rung of `anti_aliasing`) -> RMSE of the picture against the best size and samples.
        fxaa_ms: What `fxaa` adds once a frame at full size [ms].
        least: Samples that what is held takes in any case.
        moving_ms: What a frame as it comes, with its uploads, takes more than one that is replayed [ms].
    """

    times: Mapping[tuple[str, int], float]
    errors: Mapping[tuple[str, str], float]
    fxaa_ms: float = 0.0
    least: int = 1
    moving_ms: float = 0.0

    def samples(self, rung: str, offers: Iterable[Offer]) -> int:
        """Samples that a frame takes: the most that a rung asks for."""
        return max([self.least, PIXEL_SAMPLES[rung], *(offer.samples for offer in offers)])

    def time(self, scale: str, samples: int) -> float:
        """Time of a frame [ms], measured or from what was: several samples cost so much each, and a little beside."""
        if (scale, samples) in self.times:
            return self.times[scale, samples]
        full, known = next(iter(SCALES)), self._several(scale)
        if known and samples > 1:
            if len(known) > 1:
                # Between two that were measured, or beyond them.
                after = next((k for k, (n, _) in enumerate(known) if n > samples), len(known) - 1)
                (first, start), (last, end) = known[max(after - 1, 0)], known[max(after, 1)]
                return start + (samples - first) * (end - start) / (last - first)
            (count, ms), beside = known[0], self._beside() * share(scale)
            return beside + (ms - beside) * samples / count
        if (scale, 1) in self.times:
            one, full_one = self.times[scale, 1], self.times.get((full, 1), 0.0)
            return one * self.time(full, samples) / full_one if scale != full and full_one else one * samples
        if known:
            return known[0][1] * samples / known[0][0]
        return self.time(full, samples) * share(scale) / share(full)

    def _several(self, scale: str) -> list[tuple[int, float]]:
        """(samples, time) of frames of several samples that were measured, few to many."""
        return sorted((n, ms) for (size, n), ms in self.times.items() if size == scale and n > 1)

    def _beside(self) -> float:
        """What a frame of several samples takes at full size beside them [ms]; nothing where no two numbers tell."""
        known = self._several(next(iter(SCALES)))
        if len(known) < 2:
            return 0.0
        (first, start), (last, end) = known[0], known[1]
        return max(start - first * (end - start) / (last - first), 0.0)


@dataclasses.dataclass
class Survey:
    """What was measured; plain data, so that it can be kept.

    Attributes:
        grid: Frames by size and samples.
        ladders: Prices and errors of the other ladders that the scene calls for.
        free: The rung of light culling that is fastest, and its time with that of the base rung [ms]; "" if held.
        held: Ladders that the user's settings hold, and the rung each is held at.
        absent: Ladders that nothing calls for, and why.
        unmeasured: Frames of the grid that were not measured, being far past the budget, and about what they take.
        samples: Samples a pixel of the reference.
        counts: Rays or samples of ladders' references.
        whole_samples: Samples a pixel of the picture in which all references stand together.
        whole_counts: Rays or samples in it.
        base: Time of the base frame.
        reach_ms: Budget up to which the grid was measured; infinity for all of it.
    """

    grid: Grid
    ladders: tuple[LadderPrices, ...]
    free: str
    free_ms: tuple[float, float]
    held: dict[str, str]
    absent: dict[str, str]
    unmeasured: list[str]
    samples: int
    counts: dict[str, int]
    whole_samples: int
    whole_counts: dict[str, int]
    base: Spread
    reach_ms: float

    def reference(self) -> str:
        """What errors are taken against, in words."""
        parts = [f"{self.whole_samples} samples a pixel"] if self.whole_samples > 1 else []
        for ladder in self.ladders:
            count = self.whole_counts.get(ladder.name)
            name = ladder.offers[-1].rung
            parts.append(f"{ladder.name} {name}" + (f" with {count} a pixel and sample" if count else ""))
        return ", ".join(parts) or "the picture itself: nothing is for sale"


def share(scale: str) -> float:
    """Share of the shown pixels that is rendered."""
    return SCALES[scale] ** 2


def undominated(offers: Sequence[Offer]) -> tuple[Offer, ...]:
    """Offers that no other one beats in price, error and samples at once; of equal ones the first stays."""
    # At one sample, and at as many as one likes.
    keys = [(o.ms, o.once_ms, o.error, 0.0 if o.independent else o.error, o.samples) for o in offers]
    return tuple(
        offer
        for k, offer in enumerate(offers)
        if not any(
            all(a <= b for a, b in zip(other, keys[k], strict=True)) and (other != keys[k] or j < k)
            for j, other in enumerate(keys)
            if j != k
        )
    )


class Market:
    """Every frame that can be bought, with its predicted time and error.

    Attributes:
        ms: Predicted time of each frame [ms].
        error: Predicted RMSE of its picture.
        cell: Which size and number of samples it has; frames of one cell share their corrections.
        weight: Samples times the share of pixels that are rendered: how often what runs in each is paid.
    """

    def __init__(self, grid: Grid, ladders: Sequence[LadderPrices]) -> None:
        self.grid, self.ladders = grid, tuple(ladders)
        #: Every offer of every ladder, for prices of single frames; the search looks at those that nothing beats.
        self._kept = [(ladder, undominated(ladder.offers)) for ladder in self.ladders]
        # Ladders that take samples come first: they decide how often the others are paid.
        self._kept.sort(key=lambda kept: all(offer.samples == 1 for offer in kept[1]))
        taking = sum(any(offer.samples > 1 for offer in offers) for _, offers in self._kept)
        blocks, cells, weights, names = [], [], [], []
        for scale in dict.fromkeys(scale for scale, _ in grid.errors):
            for taken in itertools.product(*(offers for _, offers in self._kept[:taking])):
                for rung, samples in self._rungs(scale, taken):
                    ms, square = self._block(scale, rung, taken, samples)
                    blocks.append((ms, square))
                    cells.append(np.full(len(ms), list(SCALES).index(scale) * 1024 + samples))
                    weights.append(np.full(len(ms), samples * share(scale)))
                    names.append((scale, rung, taken))
        self._names, self._length = names, len(blocks[0][0]) if blocks else 0
        self.ms = np.concatenate([ms for ms, _ in blocks]) if blocks else np.zeros(0)
        self.error = np.sqrt(np.concatenate([square for _, square in blocks])) if blocks else np.zeros(0)
        self.cell = np.concatenate(cells) if cells else np.zeros(0, int)
        self.weight = np.concatenate(weights) if weights else np.zeros(0)
        self._others = [offers for _, offers in self._kept[taking:]]
        self._taking = taking

    def _rungs(self, scale: str, taken: Sequence[Offer]) -> list[tuple[str, int]]:
        """Rungs of `anti_aliasing` at a size with the samples of a frame, but those that another one beats at as many.

        Where a lens or a shutter takes samples, the pixel's are the same ones: most rungs then cost the same.
        """
        rows = [(self.grid.samples(rung, taken), self._fxaa(scale, rung), error, rung)
                for (size, rung), error in self.grid.errors.items() if size == scale]  # fmt: skip
        return [
            (rung, samples)
            for k, (samples, ms, error, rung) in enumerate(rows)
            if not any(
                n == samples and other <= ms and square <= error and ((other, square) != (ms, error) or j < k)
                for j, (n, other, square, _) in enumerate(rows)
            )
        ]

    def _block(self, scale: str, rung: str, taken: Sequence[Offer], samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Times and squared errors of all frames of one size and one number of samples."""
        ms = np.array([self.grid.time(scale, samples) + self._fxaa(scale, rung) + self.grid.moving_ms])
        square = np.array([self.grid.errors[scale, rung] ** 2])
        for k, (ladder, offers) in enumerate(self._kept):
            chosen = [taken[k]] if k < len(taken) else offers
            weight = share(scale) * (samples if ladder.part == "sample" else 1)
            ms = np.add.outer(ms, [offer.ms * weight + offer.once_ms for offer in chosen]).ravel()
            square = np.add.outer(square, [offer.square(samples) for offer in chosen]).ravel()
        return np.maximum(ms, FLOOR * self.grid.time(scale, samples)), square

    def _fxaa(self, scale: str, rung: str) -> float:
        return self.grid.fxaa_ms * share(scale) if rung == "fxaa" else 0.0

    def __len__(self) -> int:
        return len(self.ms)

    def choice(self, index: int) -> Choice:
        """Rungs of a frame."""
        block, rest = divmod(int(index), self._length)
        scale, rung, taken = self._names[block]
        result = {"scale": scale, "anti_aliasing": rung}
        result |= {ladder.name: offer.rung for (ladder, _), offer in zip(self._kept, taken, strict=False)}
        places = np.unravel_index(rest, [len(offers) for offers in self._others]) if self._others else ()
        for (ladder, offers), place in zip(self._kept[self._taking :], places, strict=True):
            result[ladder.name] = offers[place].rung
        return result

    def samples(self, choice: Choice) -> int:
        """Samples a pixel that a frame takes."""
        return self.grid.samples(choice["anti_aliasing"], [x.offer(choice[x.name]) for x in self.ladders])

    def predict(self, choice: Choice) -> tuple[float, float]:
        """Time [ms] and error of any frame, among those that others beat, too."""
        offers = [(ladder, ladder.offer(choice[ladder.name])) for ladder in self.ladders]
        scale, rung = choice["scale"], choice["anti_aliasing"]
        samples = self.samples(choice)
        ms = self.grid.time(scale, samples) + self._fxaa(scale, rung) + self.grid.moving_ms
        for ladder, offer in offers:
            ms += offer.ms * share(scale) * (samples if ladder.part == "sample" else 1) + offer.once_ms
        square = self.grid.errors[scale, rung] ** 2 + sum(offer.square(samples) for _, offer in offers)
        return max(ms, FLOOR * self.grid.time(scale, samples)), math.sqrt(square)


def best(ms: np.ndarray, error: np.ndarray, budget_ms: float | None, max_error: float | None) -> int | None:
    """Index of the frame to buy, or None where nothing fits.

    With a budget alone the smallest error within it, of equal ones the cheapest; with an error alone the cheapest frame
    that keeps it; with both the cheapest that keeps both.
    """
    fits = np.ones(len(ms), bool)
    if budget_ms is not None:
        fits &= ms <= budget_ms
    if max_error is not None:
        fits &= error <= max_error
    places = np.flatnonzero(fits)
    if not len(places):
        return None
    keys = (ms[places], error[places]) if max_error is None else (error[places], ms[places])
    return int(places[np.lexsort(keys)[0]])
