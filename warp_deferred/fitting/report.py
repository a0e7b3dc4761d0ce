"""What `fit` returns: the settings, what they cost, what they were bought instead of, and what more would buy."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..explain import table
from ..settings import Settings
from .choose import LITTLE, SPENT, Chooser, Verified
from .clock import Spread
from .ladders import EXACT, PIXEL_SAMPLES
from .model import Choice, Survey, best

__all__ = [
    "NEXT_MS",
    "Fit",
    "Purchase",
    "assignments",
    "left_out",
    "next_purchase",
    "notes",
    "purchases",
    "unspent",
]

#: Time whose worth is told beyond what was bought [ms].
NEXT_MS = 0.1
#: An error must fall by this share to be worth a mention.
NOTABLE = 0.01


@dataclasses.dataclass(frozen=True)
class Purchase:
    """One stage's rung, bought or not.

    Attributes:
        stage: The ladder; `size and samples` for `scale` and `anti_aliasing`, which are bought together.
        rung: The rung.
        instead: The rung in whose place it stands: the cheapest one for what was bought, the bought one else.
        ms: What the frame takes more than with that one, as predicted [ms].
        error: RMSE of the picture as predicted: of what was bought, had the cheaper rung been taken in its place; of
            what was left out, had it been bought.
    """

    stage: str
    rung: str
    instead: str
    ms: float
    error: float


@dataclasses.dataclass(frozen=True)
class Fit:
    """Settings that were bought, and the account of it; `str()` prints it.

    Errors are RMSE of `display` in [0, 1] against `reference`, over the picture of the moment it was fitted at.

    Attributes:
        settings: The settings to render with.
        budget_ms: The budget [ms]; None if there was none.
        max_error: The error asked for; None if none was.
        met: Whether budget and error are kept: the budget in 19 of 20 frames not seen before, the error as measured.
        ms: Time of frames of an interval that was not seen before, uploads included: device time on CUDA, wall-clock
            time on the CPU.
        held: Share of those frames that stayed within the budget; None without one.
        error: RMSE of the picture, measured.
        predicted_ms: What the additive model said of the time [ms].
        predicted_error: What it said of the error.
        bought: What was bought, dear to cheap.
        left_out: What was not, stage by stage.
        next: What the next tenth of a millisecond would buy, in words.
        notes: What was held, not called for, free or not measured.
        reference: What the error is taken against.
        scene: What was looked at, and where.
        seconds: Time the call took [s], `cold_seconds` not included.
        load_seconds: The part of it that loading compiled kernels took, once a process [s].
        cold_seconds: Time that compiling kernels took, which the machine's cache spares the next call [s].
        compiled: Modules of kernels compiled.
        plans: Frames looked at that needed a plan of their own.
        cached: When the prices were measured, if they came from the cache; else empty.
        unspent: Why more than a tenth of the budget is left, in words; empty where it is not.
    """

    settings: Settings
    budget_ms: float | None
    max_error: float | None
    met: bool
    ms: Spread
    held: float | None
    error: float
    predicted_ms: float
    predicted_error: float
    bought: tuple[Purchase, ...]
    left_out: tuple[Purchase, ...]
    next: str
    notes: tuple[str, ...]
    reference: str
    scene: str
    seconds: float
    load_seconds: float
    cold_seconds: float
    compiled: int
    plans: int
    cached: str
    unspent: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON; settings as far as they differ from the defaults."""
        return dataclasses.asdict(dataclasses.replace(self, settings=None)) | {"settings": assignments(self.settings)}

    @property
    def verdict(self) -> str:
        """Whether what was asked for is kept, and by how much not."""
        parts = []
        if self.budget_ms is not None:
            over = self.ms.median - self.budget_ms
            share = f"{self.held:.0%} of {self.ms.count} frames not seen before are within {self.budget_ms:g} ms"
            if over > 0.0:
                parts.append(f"the budget cannot be kept: this is the fastest frame, {over:.3g} ms over; {share}")
            elif self.held < 0.95:
                parts.append(f"the budget is not always kept: {share}, 95 % of frames take up to {self.ms.p95:.3g} ms")
            else:
                parts.append(f"the budget is kept: {share}")
        if self.max_error is not None:
            kept = self.error <= self.max_error
            parts.append(
                f"the error is kept: {self.error:.4f} of {self.max_error:g}" if kept
                else f"the error cannot be had{' within the budget' if self.budget_ms is not None else ''}: "
                f"{self.error:.4f} is the nearest to {self.max_error:g}"
            )  # fmt: skip
        return "; ".join(parts)

    def __str__(self) -> str:
        asked = [f"budget {self.budget_ms:g} ms"] if self.budget_ms is not None else []
        asked += [f"error {self.max_error:g}"] if self.max_error is not None else []
        lines = [
            f"fit of {self.scene}: {' and '.join(asked)}",
            f"  {self.verdict}",
            f"  frame {self.ms}, predicted {self.predicted_ms:.3g} ms; picture off by {self.error:.4f} (RMSE of "
            f"display in 0 to 1), predicted {self.predicted_error:.4f}",
            f"  against {self.reference}",
        ]
        if self.bought:
            rows = [[p.stage, p.rung, f"{round(p.ms, 3) + 0.0:+.3f}", f"{p.error:.4f}", p.instead] for p in self.bought]
            lines += ["", table("bought", [("stage", "left"), ("rung", "left"), ("ms", "right"),
                                           ("error without", "right"), ("in place of", "left")], rows)]  # fmt: skip
        if self.left_out:
            rows = [
                [p.stage, p.rung, f"{round(p.ms, 3) + 0.0:+.3f}", f"{p.error:.4f}", p.instead] for p in self.left_out
            ]
            lines += ["", table("left out", [("stage", "left"), ("rung", "left"), ("ms", "right"),
                                             ("error with", "right"), ("in place of", "left")], rows)]  # fmt: skip
        told = [self.unspent] if self.unspent else []
        lines += ["", *(f"  {text}" for text in (*told, self.next, *self.notes))]
        cold = f", and {self.cold_seconds:.1f} s to compile {self.compiled} modules" if self.compiled else ""
        if self.load_seconds >= 0.1:
            cold = f", {self.load_seconds:.1f} s of them to load kernels" + cold
        source = f"prices measured {self.cached}" if self.cached else "prices measured now"
        lines.append(f"  {source}, {self.plans} frames looked at in {self.seconds:.1f} s{cold}")
        lines.append("  settings: " + (" ".join(assignments(self.settings)) or "the defaults"))
        return "\n".join(lines)


def assignments(settings: Settings) -> list[str]:
    """Settings that differ from the defaults, as the command line takes them."""
    plain = Settings()
    return [
        f"{stage}.{field}={value}"
        for stage in plain.stages
        for field, value in getattr(settings, stage)
        if value != getattr(getattr(plain, stage), field)
    ]


def purchases(chooser: Chooser, chosen: Verified) -> tuple[Purchase, ...]:
    """What was bought: each stage's rung in place of its cheapest one, dear to cheap."""
    result = []
    for stage, options in _options(chooser).items():
        cheap = min(options, key=lambda option: chooser.market.predict(chosen.choice | option)[0])
        other = chosen.choice | cheap
        if other == chosen.choice:
            continue
        ms, error = chooser.swapped(chosen, other)
        result.append(Purchase(stage, _named(chosen.choice, cheap), _named(cheap, cheap), -ms, error))
    return tuple(sorted(result, key=lambda p: -p.ms))


def left_out(chooser: Chooser, chosen: Verified) -> tuple[Purchase, ...]:
    """What was not bought: for each stage the cheapest rung that would bring the picture nearer."""
    result = []
    for stage, options in _options(chooser).items():
        found = []
        for option in options:
            ms, error = chooser.swapped(chosen, chosen.choice | option)
            # What is told to cost less was looked at, and did not.
            if ms > 0.0 and error < (1.0 - NOTABLE) * chosen.error:
                found.append(Purchase(stage, _named(option, option), _named(chosen.choice, option), ms, error))
        if found:
            result.append(min(found, key=lambda p: p.ms))
    return tuple(sorted(result, key=lambda p: p.ms))


def next_purchase(chooser: Chooser, chosen: Verified) -> str:
    """What `NEXT_MS` more would buy, and if that is nothing, what the next purchase is and what it costs."""
    ms, error = chooser.buyable()
    # Beyond the budget; where an error was asked for, beyond what it took.
    spent = chosen.ms.p95
    if chooser.budget_ms is not None and chooser.max_error is None:
        spent = max(chooser.budget_ms, spent)
    index = best(ms, error, spent + NEXT_MS, None)
    asked = f"{NEXT_MS:g} ms more"
    if index is not None and error[index] < (1.0 - NOTABLE) * chosen.error:
        return f"{asked} would buy {_change(chooser, chosen, index)}: error {error[index]:.4f}, {ms[index]:.3g} ms"
    better = np.where(error < (1.0 - NOTABLE) * chosen.error, ms, np.inf)
    if not np.isfinite(better).any():
        return f"{asked} would buy nothing, and neither would any other sum: nothing on sale is nearer"
    index = int(np.argmin(better))
    return (
        f"{asked} would buy nothing; the next purchase, {better[index] - spent:.3g} ms more, is "
        f"{_change(chooser, chosen, index)}: error {error[index]:.4f}, {ms[index]:.3g} ms"
    )


def unspent(chooser: Chooser, chosen: Verified) -> str:
    """Why the choice leaves more than a tenth of the budget, and from what on a nearer picture can be had."""
    spent = (chosen.unseen or chosen.ms).median
    if chooser.budget_ms is None or chooser.max_error is not None or spent >= SPENT * chooser.budget_ms:
        return ""
    left = f"{1.0 - spent / chooser.budget_ms:.0%} of the budget is left"
    ms, error = chooser.buyable()
    index = int(np.argmin(np.where(error < (1.0 - LITTLE) * chosen.error, ms, np.inf)))
    if not error[index] < (1.0 - LITTLE) * chosen.error:
        return f"{left}: nothing that is for sale is nearer to the reference"
    times = chosen.unseen or chosen.ms
    if times.p95 >= SPENT * chooser.budget_ms:
        return f"{left} by the median, for frames vary: 95 % of them take up to {times.p95:.3g} ms"
    if ms[index] <= chooser.budget_ms:
        return f"{left}: {_change(chooser, chosen, index)} may fit, too, and was not looked at"
    between = f"between {spent:.3g} and {ms[index]:.3g} ms"
    return f"{left}: nothing for sale {between} takes {LITTLE:.1%} or more off the error"


def notes(survey: Survey) -> list[str]:
    """What was not for sale, and why, and what is free."""
    result = []
    if survey.free and survey.free != EXACT.base:
        fast, usual = survey.free_ms
        result.append(f"free: light_culling {survey.free}, {usual - fast:.3g} ms less, every rung gives the same bits")
    if survey.grid.moving_ms > 0.0:
        result.append(f"uploads and what moves take {survey.grid.moving_ms:.3g} ms of a frame")
    result += [f"held as set: {name} ({value})" for name, value in survey.held.items()]
    if survey.absent:
        listed = "; ".join(f"{name} ({reason})" for name, reason in survey.absent.items())
        result.append(f"not for sale, costs nothing: {listed}")
    estimated = [x.name for x in survey.ladders if any(offer.estimated for offer in x.offers)]
    if estimated:
        result.append(f"prices of any number of rays follow from one: {', '.join(estimated)}")
    if survey.unmeasured:
        result.append(f"not measured, far past the budget: {', '.join(survey.unmeasured)}")
    return result


def _options(chooser: Chooser) -> dict[str, list[Choice]]:
    """Every stage with all that can be put in its place."""
    grid, ladders = chooser.market.grid, chooser.market.ladders
    result = {"size and samples": [{"scale": scale, "anti_aliasing": rung} for scale, rung in grid.errors]}
    return result | {x.name: [{x.name: offer.rung} for offer in x.offers] for x in ladders}


def _named(choice: Choice, keys: Choice) -> str:
    """Rungs of some stages; of size and samples both."""
    if "scale" not in keys:
        return choice[next(iter(keys))]
    rung = choice["anti_aliasing"]
    count = PIXEL_SAMPLES[rung]
    words = f"{count} sample{'s' if count > 1 else ''}" + (", fxaa" if rung == "fxaa" else "")
    return words + ("" if choice["scale"] == "off" else f" at {choice['scale']} size")


def _change(chooser: Chooser, chosen: Verified, index: int) -> str:
    """What is other in another frame."""
    return ", ".join(f"{k} {v}" for k, v in chooser.market.choice(index).items() if v != chosen.choice[k])
