"""Plots of the benches `peers` and `scaling`; imported by `plots` alone, which has the style."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from .peer_tables import titles
from .record import Record
from .scaling_tables import fit_of, power

__all__ = ["peers_figure", "scaling_figure"]

Row = dict[str, Any]
MARKS = ("o", "d", "*", "s", "^", "v", "P", "X")


def peers_figure(record: Record, colors: tuple[str, ...], pale: str, device: str) -> Figure:
    """Milliseconds of every renderer, one line a case, on a logarithmic axis."""
    cases = dict.fromkeys((row["case"], row["title"]) for row in record["rows"])
    figure = Figure(figsize=(8.4, 1.4 + 0.34 * len(cases)))
    axes = figure.subplots()
    heights = {case: k for k, (case, _) in enumerate(cases)}
    for case, height in heights.items():
        values = [row["time.ms"] for row in record["rows"] if row["case"] == case]
        axes.plot([min(values), max(values)], [height, height], color=pale, linewidth=0.8, zorder=1)
    for k, (name, title) in enumerate(titles(record).items()):
        rows = [row for row in record["rows"] if row["peer"] == name]
        axes.plot(
            [row["time.ms"] for row in rows], [heights[row["case"]] for row in rows], MARKS[k % len(MARKS)],
            color=colors[k % len(colors)], markersize=7 if name == "ours" else 5, label=title,
        )  # fmt: skip
    axes.set(xscale="log", xlabel=f"ms a frame, on {device}")
    axes.set_yticks(range(len(cases)), [title for _, title in cases])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    figure.legend(loc="outside upper center", ncols=4, handletextpad=0.2, columnspacing=1.0)
    return figure


def scaling_figure(record: Record, colors: tuple[str, ...], pale: str, device: str) -> Figure:
    """One panel an axis: time of the frame and, on the right, memory, with the fitted models."""
    names = [axis["axis"] for axis in record["axes"] if any(row["axis"] == axis["axis"] for row in record["rows"])]
    figure = Figure(figsize=(8.8, 6.4))
    panels = np.atleast_1d(figure.subplots(2, 2)).ravel()
    for axes, name in zip(panels, names, strict=False):
        rows = [row for row in record["rows"] if row["axis"] == name]
        counts = np.array([row["n"] for row in rows], float)
        held = axes.twinx()
        held.grid(visible=False)
        _curve(axes, counts, [row["frame.ms"] for row in rows], fit_of(record, name, "frame.ms"), colors[0], "o")
        memory = [(row["memory.bytes"] + row["scene.bytes"]) / 1e6 for row in rows]
        _curve(held, counts, memory, None, colors[1], "s")
        time, room = (fit_of(record, name, figure) for figure in ("frame.ms", "bytes"))
        title = name
        title += f": time n^{time['exponent']:.2f}" if time else ""
        title += f", memory n^{room['exponent']:.2f}" if room else ""
        axes.set(xscale="log", yscale="log", title=title, xlabel=name)
        axes.set_ylabel("frame [ms]", color=colors[0])
        held.set_yscale("log")
        held.set_ylabel("memory [MB]", color=colors[1])
        held.spines["right"].set_visible(True)
        axes.set_xticks(counts[:: 1 if len(counts) < 8 else 2])
        axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: power(v)))
        for side in (axes, held):
            low, high = side.get_ylim()
            # Three ticks at least, where next to nothing grows.
            side.set_ylim(low / 1.5, max(high * 1.2, low * 6.0))
            side.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
            side.yaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
            side.minorticks_off()
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    figure.suptitle(f"Growth; dashed: fixed cost + price of each: {device}", fontsize=10, fontweight="bold")
    return figure


def _curve(axes: Any, counts: np.ndarray, values: list[float], fit: Row | None, color: str, mark: str) -> None:
    """Points joined by a line, and the model of a fit where there is one and it stays above zero."""
    axes.plot(counts, values, f"{mark}-", color=color, markersize=4, linewidth=1.2)
    if fit is not None:
        fine = np.geomspace(counts[0], counts[-1], 60)
        model = fit["fixed"] + fit["each"] * fine
        axes.plot(fine[model > 0.0], model[model > 0.0], "--", color=color, linewidth=1.0, alpha=0.6)
