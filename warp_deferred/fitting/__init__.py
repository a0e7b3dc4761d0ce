"""Settings for a budget: measures what each rung costs and is worth on one scene and device, and buys.

1. `survey.py` measures every ladder that the scene calls for (`ladders.py`), about 30 frames, each with its own plan;
   or `cache.py` has the prices from an earlier call.
2. `model.py` adds prices and squared errors up and searches all frames that can be bought, exactly.
3. `choose.py` renders and times the best of them, corrects the model by what it sees, and tries the choice on frames of
   a time interval that nobody has seen.
4. `report.py` tells what was bought, what was left out, and what more would buy.

The error is the root mean square difference of `display`, as shares of the full range, over the whole picture of the
moment at hand: it is what `bench accuracy` states, its squares add up, and a kernel finds it in microseconds, where
FLIP takes a host thread a second for a million pixels. What it is taken against has as many samples and rays as half
a second or so of a GPU buys, and is named in the report.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import warp as wp

from ..camera import Camera
from ..checks import check_range, input_error
from ..renderer import Renderer
from ..scene import Scene
from ..settings import Settings
from . import cache as kept
from .choose import HELD_SHARE, Chooser, Verified
from .ladders import held_fields
from .model import Market, Survey
from .probe import Probe
from .report import Fit, left_out, next_purchase, notes, purchases, unspent
from .survey import Progress, Surveyor

__all__ = ["Fit", "fit"]


def fit(
    scene: Scene,
    camera: Camera | Sequence[Camera] | None = None,
    *,
    budget_ms: float | None = None,
    max_error: float | None = None,
    width: int = 1280,
    height: int = 720,
    device: Any = None,
    outputs: Sequence[str] = ("display",),
    settings: Settings | None = None,
    threads: int | None = None,
    time_s: float = 0.0,
    cache: bool | str | Path = True,
    progress: Progress | None = None,
) -> Fit:
    """Buy the accuracy that a budget allows, where it is cheapest on this scene and device.

    With a budget alone: the settings whose picture is nearest to the reference within it. With `max_error` alone: the
    fastest settings that keep it. With both: the fastest that keep both, and where there are none, the nearest picture
    within the budget. What is set in `settings`, or in the scene's where they are left out, stays as it is; all other
    ladders are for sale. The scene is not changed: it is animated to look at other moments, and put back to `time_s`.

    Args:
        scene: What is rendered.
        camera: The camera or cameras it is seen by; the scene's if left out.
        budget_ms: Most that a frame may take [ms], > 0: device time on CUDA, wall-clock time on the CPU.
        max_error: Most that the picture may be off by, > 0: RMSE of `display` in [0, 1].
        width: Width of a view [px].
        height: Height of a view [px].
        device: Warp device name; the current default if left out.
        outputs: Outputs the frames will have, `display` among them; others keep `scale` from being bought.
        settings: Settings to start from.
        threads: Host threads on the CPU; the number of cores if left out.
        time_s: The moment that the scene shows [s], where it can be animated.
        cache: Whether prices are kept from call to call; or the folder to keep them in.
        progress: Called with (what is looked at, done, about how many in all).

    Returns:
        The settings, with the account of what they cost and what they are worth.

    Raises:
        InputError: If there is neither budget nor error, or one is not a number above zero, or an argument does not fit
            the renderer, or a preset stands in the settings.
        DeviceError: If the device is not there.
    """
    started = time.perf_counter()
    budget_ms, max_error = _check_wishes(budget_ms, max_error, outputs)
    renderer = Renderer(
        scene, width=width, height=height, device=device, outputs=outputs, settings=settings, threads=threads
    )
    probe = Probe(renderer, renderer.cameras_of(camera), check_range("fit.time_s", time_s, -1e9, 1e9, unit="s"))
    where = None if cache is False else kept.folder() if cache is True else Path(cache)
    surveyor = Surveyor(probe, renderer.settings, _held(renderer.settings), budget_ms, progress)
    with probe.restoring(), wp.ScopedDevice(renderer.device):
        survey, date = _survey(surveyor, where)
        market = Market(survey.grid, survey.ladders)
        chooser = Chooser(market, surveyor, surveyor.truth(survey), budget_ms, max_error, survey.whole_samples)
        chosen = chooser.choose()
    return _account(chooser, survey, chosen, date, time.perf_counter() - started)


def _held(settings: Settings) -> frozenset[tuple[str, str]]:
    """What stays as it is; a preset would hold everything."""
    if settings.preset != "none":
        raise input_error("fit.settings.preset", "none", settings.preset, "a budget chooses every rung that is not set")
    return held_fields(settings)


def _check_wishes(budget_ms: Any, max_error: Any, outputs: Sequence[str]) -> tuple[float | None, float | None]:
    """Check that something sensible is asked for."""
    if "display" not in outputs:
        raise input_error("fit.outputs", "display among them", list(outputs), "errors are those of the picture")
    if budget_ms is None and max_error is None:
        raise input_error("fit", "budget_ms, max_error or both", "<neither>", "such as budget_ms=1.0")
    wishes = []
    for name, value, mend in (
        ("budget_ms", budget_ms, "such as budget_ms=1.0 [ms]"),
        ("max_error", max_error, "such as max_error=0.02, the RMSE of display in 0 to 1"),
    ):
        if value is not None:
            value = check_range(f"fit.{name}", value, 0.0, mend=mend)
            if value == 0.0:
                raise input_error(f"fit.{name}", "a number > 0", value, mend)
        wishes.append(value)
    return wishes[0], wishes[1]


def _survey(surveyor: Surveyor, where: Path | None) -> tuple[Survey, str]:
    """Take prices from the cache, or measure and keep them; with the date of kept ones."""
    probe = surveyor.probe
    key = kept.signature(probe.renderer, probe.cameras, surveyor.settings) if where is not None else {}
    found = kept.load(where, key) if where is not None else None
    wanted = float("inf") if surveyor.budget_ms is None else surveyor.budget_ms
    if found is not None and found[0].reach_ms >= wanted:
        surveyor.adopt(found[0])
        return found
    survey = surveyor.measure()
    if where is not None:
        kept.save(where, key, survey)
    return survey, ""


def _account(chooser: Chooser, survey: Survey, chosen: Verified, date: str, seconds: float) -> Fit:
    surveyor, probe = chooser.surveyor, chooser.probe
    renderer = probe.renderer
    times = chosen.unseen or chosen.ms
    kept_budget = chosen.held is None or chosen.held >= HELD_SHARE
    kept_error = chooser.max_error is None or chosen.error <= chooser.max_error
    views = f"{len(probe.cameras)} views of " if len(probe.cameras) > 1 else ""
    device = renderer.device
    name = f"{device} ({device.name})" if device.is_cuda else f"{device}, {renderer.threads} threads"
    return Fit(
        settings=surveyor.at(chosen.choice),
        budget_ms=chooser.budget_ms,
        max_error=chooser.max_error,
        met=kept_budget and kept_error,
        ms=times,
        held=chosen.held,
        error=chosen.error,
        predicted_ms=chosen.predicted_ms,
        predicted_error=chosen.predicted_error,
        bought=purchases(chooser, chosen),
        left_out=left_out(chooser, chosen),
        next=next_purchase(chooser, chosen),
        notes=tuple(notes(survey)),
        reference=survey.reference(),
        scene=f"{renderer.scene.name or 'scene'} at {views}{renderer.width}x{renderer.height} on {name}",
        seconds=seconds - probe.compile_s,
        load_seconds=probe.load_s,
        cold_seconds=probe.compile_s,
        compiled=probe.compiled,
        plans=probe.plans,
        cached=date,
        unspent=unspent(chooser, chosen),
    )
