"""Measuring rendered size against samples of the pixel, all other ladders at their base.

Full size is looked at with one sample, a few and many, smaller ones with `fxaa` and a few. What lies between follows
(`curves.py`, `Grid.time`), so that every number of samples at every size is for sale.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from .curves import sample_errors, scaled_errors
from .ladders import PIXEL_SAMPLES, SCALES
from .model import Grid, share

if TYPE_CHECKING:
    from .survey import Surveyor

__all__ = ["measure_grid"]

#: Rungs of `anti_aliasing` that are looked at in full size, beside `off` and the most samples; and in smaller ones.
LOOKED, SMALLER = ("fxaa", "samples_4", "samples_16"), ("fxaa", "samples_4")
FULL = next(iter(SCALES))


def measure_grid(surveyor: Surveyor, taken: dict[int, float]) -> Grid:
    """Measure size against samples of the pixel; what is held stays as it is.

    Args:
        surveyor: Looks, and knows the base frame.
        taken: Samples -> time of a frame with so many, as other ladders took them [ms].
    """
    probe, samples, held = surveyor.probe, surveyor.samples, surveyor.fixed.get("anti_aliasing")
    sold = "scale" not in {**surveyor.fixed, **surveyor.absent}
    scales = list(SCALES) if sold else [surveyor.settings.scale.rung]
    first = scales[0]
    rungs = [held] if held else [name for name, count in PIXEL_SAMPLES.items() if count <= samples]
    top = f"samples_{samples}"
    surveyor.look(f"{samples} samples a pixel", {"scale": "off", "anti_aliasing": top})
    picture = probe.picture()
    times: dict[tuple[str, int], float] = {(first, surveyor.base_samples): surveyor.base_ms}
    errors = {(first, held or "off"): probe.rmse(picture, surveyor.base_picture)}
    if not held and surveyor.within_reach(Grid(times, {}).time(first, samples)):
        times[first, max(samples, surveyor.base_samples)] = probe.price()
        errors[first, top] = 0.0
    fxaa_ms = 0.0
    for scale, rung in itertools.product(scales, rungs):
        count = max(PIXEL_SAMPLES[rung], surveyor.base_samples)
        looked = held or rung in (LOOKED if scale == first else SMALLER)
        if (scale, rung) in errors or not looked or not surveyor.within_reach(Grid(times, {}).time(scale, count)):
            continue
        surveyor.look(_cell(scale, rung), {"scale": scale, "anti_aliasing": rung})
        errors[scale, rung], price = probe.rmse(picture), probe.price()
        if rung != "fxaa":
            times[scale, count] = price
        elif scale == first:
            # Of full size; every other size pays its share.
            fxaa_ms = max(price - times[scale, count], 0.0) / share(scale)
        else:
            times[scale, count] = max(price - fxaa_ms * share(scale), 0.5 * price)
    for count, ms in taken.items():
        times.setdefault((first, count), ms)
    grid = Grid(times, errors, fxaa_ms, surveyor.base_samples, surveyor.moving_ms)
    if not held:
        _fill(surveyor, grid, errors, scales, rungs)
    return grid


def _fill(
    surveyor: Surveyor, grid: Grid, errors: dict[tuple[str, str], float], scales: list[str], rungs: list[str]
) -> None:
    """Add the errors of sizes and samples that were not looked at, as far as the budget reaches."""
    first = scales[0]
    known = {PIXEL_SAMPLES[rung]: e for (scale, rung), e in errors.items() if scale == first and rung != "fxaa"}
    law = sample_errors(known, [PIXEL_SAMPLES[rung] for rung in rungs])
    full = {rung: errors.get((first, rung), law[PIXEL_SAMPLES[rung]]) for rung in rungs}
    for scale in scales:
        own = {rung: error for (size, rung), error in errors.items() if size == scale}
        if not own:
            surveyor.unmeasured.append(f"scale {scale}")
            continue
        found = full if scale == first else scaled_errors(full, own, rungs)
        for rung in rungs:
            # Pixels by the dozen are better spent at full size than on a picture that is scaled up.
            if scale != first and PIXEL_SAMPLES[rung] > surveyor.samples // 4:
                break
            guess = grid.time(scale, max(PIXEL_SAMPLES[rung], surveyor.base_samples))
            if not surveyor.within_reach(guess):
                surveyor.unmeasured.append(f"{_cell(scale, rung)} and more (from about {guess:.3g} ms)")
                break
            errors.setdefault((scale, rung), found[rung])


def _cell(scale: str, rung: str) -> str:
    return f"anti_aliasing {rung}" + ("" if scale == FULL else f" at scale {scale}")
