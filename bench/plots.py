"""Plots of results. matplotlib comes with the `dev` extra; it is imported here and nowhere else."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from warp_deferred.errors import Error, LoadError

from .cases import reachable_mean
from .effect_tables import case_names, rungs_of
from .frame import pass_names
from .record import Record
from .tables import milliseconds
from .targets import FRAME_TARGETS, HOST_TARGET_US, LIGHT_TARGETS_MS, TRIANGLE_QUOTES
from .tiles import read_heat_map

try:
    import matplotlib
    from matplotlib.figure import Figure
except ImportError as error:  # told here, where a plot was asked for
    raise Error(
        "matplotlib: expected it for plots, got no such module; install it with: pip install -e '.[dev]'"
    ) from error

from . import accuracy_plots, performance_plots  # they import matplotlib, too

__all__ = ["check_target", "draw"]

#: Colour-blind safe (Okabe and Ito 2008), in the order in which series take them.
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#8C6D31", "#555555")
INK, PALE, GRID, LIMIT = "#222222", "#8A8A8A", "#E4E4E4", "#C1121F"
#: Colours on which white is hard to read.
LIGHT_COLORS = (COLORS[1], COLORS[5])
STYLE = {
    "font.size": 9.0, "axes.titlesize": 10.0, "axes.titleweight": "bold", "axes.titlelocation": "left",
    "axes.edgecolor": PALE, "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True, "axes.grid": True,
    "grid.color": GRID, "legend.frameon": False, "figure.constrained_layout.use": True,
    "font.family": "DejaVu Sans", "xtick.minor.visible": False, "ytick.minor.visible": False,
}  # fmt: skip
DPI = 130


def check_target(path: str | os.PathLike[str]) -> Path:
    """Return the path if it names a PNG file."""
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise LoadError(f"{target}: expected a name that ends in .png, got {target.suffix!r}; rename it")
    return target


def draw(record: Record, path: str | os.PathLike[str], part: str = "") -> Path:
    """Draw a result's plot as PNG; the same result gives the same bytes under the same matplotlib.

    Args:
        record: The result.
        path: Where to.
        part: A ladder of a result of the bench `accuracy`; the whole result if left out.

    Raises:
        LoadError: If the name does not end in .png or the file cannot be written.
    """
    target = check_target(path)
    with matplotlib.rc_context(STYLE):
        figure = accuracy_plots.ladder_figure(record, part, COLORS, PALE, _device(record)) if part else None
        figure = figure or _DRAW[record["bench"]](record)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            # Without the version in the file a picture changes only when its pixels do.
            figure.savefig(target, dpi=DPI, metadata={"Software": None})
        except OSError as error:
            raise LoadError(f"{target}: expected a file that can be written, got {error.strerror}") from None
    return target


def _log_ticks(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 on a logarithmic axis."""
    axis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(matplotlib.ticker.NullLocator())
    axis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:,.0f}" if v >= 1 else f"{v:g}"))


def _device(record: Record) -> str:
    return record["device"] + (" (quick run)" if record["quick"] else "")


def _triangles(record: Record) -> Figure:
    rows = record["rows"]
    figure = Figure(figsize=(8.0, 1.0 + 0.72 * len(rows)))
    axes = figure.subplots()
    series = [
        ("ours", COLORS[0], lambda r: r["total.ms"]),
        ("nvdiffrast (quoted)", "#B9B9B9", lambda r: TRIANGLE_QUOTES[r["case"]].nvdiffrast),
        ("OpenGL (quoted)", "#D9D9D9", lambda r: TRIANGLE_QUOTES[r["case"]].opengl),
    ]
    high = max(value(r) for r in rows for _, _, value in series)
    low = min(value(r) for r in rows for _, _, value in series)
    for k, (label, color, value) in enumerate(series):
        places = [i + 0.27 * (k - 1) for i in range(len(rows))]
        values = [value(r) for r in rows]
        axes.barh(places, values, 0.25, color=color, label=label)
        for y, v in zip(places, values, strict=True):
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
            axes.text(v * 1.05, y, milliseconds(v), va="center", fontsize=8, color=INK if k == 0 else PALE, bbox=box)
    targets = [TRIANGLE_QUOTES[r["case"]].must_reach for r in rows]
    for i, t in enumerate(targets):
        axes.plot([t, t], [i - 0.42, i + 0.42], color=LIMIT, linewidth=1.4, label="must reach" if i == 0 else None)
    axes.set(xscale="log", xlim=(min(low, *targets) / 1.6, high * 1.8), yticks=range(len(rows)))
    axes.set_yticklabels([r["title"] for r in rows])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    _log_ticks(axes.xaxis)
    axes.set_xlabel(f"ms at {rows[0]['width']}x{rows[0]['height']}, less is better")
    axes.set_title(f"Triangles: {_device(record)}")
    axes.legend(loc="upper center", bbox_to_anchor=(0.36, -0.13), ncols=4, handlelength=1.2)
    return figure


def _tiles(record: Record) -> Figure:
    rows = record["rows"]
    names = list(dict.fromkeys(r["resolution"] for r in rows))
    figure = Figure(figsize=(8.4, 7.0))
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.0, 1.15))
    panels = np.atleast_1d(top.subplots(1, len(names), sharey=True))
    sizes = sorted({r["tile_size"] for r in rows})
    counts = sorted({r["lights"] for r in rows})
    for axes, name in zip(panels, names, strict=True):
        for k, lights in enumerate(counts):
            points = [(r["tile_size"], r["total.ms"]) for r in rows if (r["resolution"], r["lights"]) == (name, lights)]
            axes.plot(*zip(*sorted(points), strict=True), "o-", color=COLORS[k], markersize=4, label=f"{lights:,}")
        axes.set(xscale="log", yscale="log", title=name, xlabel="side of a tile [px]")
        axes.set_xticks(sizes, [str(s) for s in sizes])
        axes.minorticks_off()
        axes.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
        _log_ticks(axes.yaxis)
    panels[0].set_ylabel("stage + cull + shade [ms]")
    panels[-1].legend(title="lights", loc="center left", bbox_to_anchor=(1.0, 0.5))
    if "heat_map" in record:  # a run that was interrupted may lack it
        _heat_map(record, bottom.subplots())
    title = f"Light tiles, {record['mean']:g} lights at a pixel on average: {_device(record)}"
    figure.suptitle(title, fontsize=10, fontweight="bold")
    return figure


def _heat_map(record: Record, axes: Any) -> None:
    case, counts = record["heat_map"], read_heat_map(record)
    side = case["tile_size"]
    extent = (0, counts.shape[1] * side, counts.shape[0] * side, 0)
    image = axes.imshow(counts, extent=extent, cmap="inferno", interpolation="nearest", vmin=0)
    axes.set(xlim=(0, case["width"]), ylim=(case["height"], 0), xlabel="x [px]", ylabel="y [px]")
    axes.grid(visible=False)
    axes.set_title(f"Lights considered by each tile of {side} px, {case['lights']:,} lights, {case['resolution']}")
    axes.figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02, label="lights")


def _lights(record: Record) -> Figure:
    figure = Figure(figsize=(7.2, 4.2))
    axes = figure.subplots()
    rows = record["rows"]
    counts = sorted({r["lights"] for r in rows})
    place = {(r["lights"], r["mean"]): r for r in rows}
    # The means that the largest number of lights gives; fewer lights stand in each curve with the most they can give.
    for k, mean in enumerate(sorted(r["mean"] for r in rows if r["lights"] == counts[-1])):
        keys = [(count, reachable_mean(count, mean)) for count in counts]
        curve = [place[key] for key in keys if key in place]
        axes.plot(
            [r["lights"] for r in curve],
            [r["total.ms"] for r in curve],
            "o-",
            color=COLORS[k],
            markersize=4,
            label=f"{mean:g} lit",
        )
        brute = [(r["lights"], r["brute_force.ms"]) for r in curve if "brute_force.ms" in r]
        if brute and k == 0:
            axes.plot(*zip(*brute, strict=True), "--", color=PALE, linewidth=1.2, label=f"{mean:g} lit, brute force")
    if not record["quick"]:
        spots = [(lights, limit) for (lights, _), limit in LIGHT_TARGETS_MS.items()]
        axes.plot(
            *zip(*spots, strict=True), "_", color=LIMIT, markersize=16, markeredgewidth=2, label="5 lit must reach"
        )
    axes.set(xscale="log", yscale="log", xlabel="lights in the scene", ylabel="stage + cull + shade [ms]")
    _log_ticks(axes.yaxis)
    axes.set_xticks(counts, [f"{count:,}" for count in counts])
    axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    axes.set_title(f"Lights at {rows[0]['width']}x{rows[0]['height']}: {_device(record)}")
    axes.legend(loc="upper left")
    return figure


def _frame(record: Record) -> Figure:
    rows = record["rows"]
    figure = Figure(figsize=(8.0, 0.6 + 1.35 * len(rows)))
    names = list(dict.fromkeys(name for r in rows for name in pass_names(r)))
    colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(names)}
    for axes, row in zip(np.atleast_1d(figure.subplots(len(rows), 1)), rows, strict=True):
        left = 0.0
        for name in pass_names(row):
            value = row[f"pass.{name}.ms"]
            axes.barh(1, value, 0.75, left=left, color=colors[name], label=name)
            if value > 0.07 * row["passes.sum_ms"]:
                ink = INK if colors[name] in LIGHT_COLORS else "white"
                axes.text(left + value / 2, 1, milliseconds(value), ha="center", va="center", fontsize=8, color=ink)
            left += value
        axes.barh(0, row["frame.ms"], 0.75, color="#B9B9B9")
        axes.text(row["frame.ms"] * 0.99, 0, milliseconds(row["frame.ms"]), ha="right", va="center", fontsize=8)
        floor = row["frame.floor_ms"]
        axes.plot([floor, floor], [-0.5, 1.5], color=INK, linestyle=":", linewidth=1.2)
        target = FRAME_TARGETS.get(row["case"])
        if target:
            axes.plot([target.ms, target.ms], [-0.5, 1.5], color=LIMIT, linewidth=1.6)
        axes.set(yticks=(1, 0), yticklabels=("passes", "whole frame"), ylim=(-0.55, 1.55))
        axes.set_xlim(0.0, 1.03 * max(left, row["frame.ms"], target.ms if target else 0.0))
        axes.grid(axis="y", visible=False)
        axes.set_title(row["title"], fontsize=9)
    axes.set_xlabel(f"ms on {_device(record)}; dotted: memory floor; red: must reach")
    handles = [matplotlib.patches.Patch(color=colors[name], label=name) for name in names]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(names), handlelength=1.0, columnspacing=1.2)
    return figure


def _host(record: Record) -> Figure:
    rows = [r for r in record["rows"] if r["figure"] != "back_to_back"]
    figure = Figure(figsize=(7.2, 1.2 + 0.45 * len(rows)))
    axes = figure.subplots()
    for i, row in enumerate(rows):
        axes.barh(i, row["host.us"], 0.6, color=COLORS[0])
        axes.plot([row["host.us_p5"], row["host.us_p95"]], [i, i], color=INK, linewidth=1.2)
        axes.text(row["host.us_p95"], i, f"  {row['host.us']:,.0f}", va="center", fontsize=8)
    if not record["device"].startswith("CPU"):
        axes.axvline(HOST_TARGET_US, color=LIMIT, linewidth=1.6)
    axes.set_yticks(range(len(rows)), [r["text"].replace("`", "") for r in rows])
    axes.set_xlim(0.0, 1.15 * max([r["host.us_p95"] for r in rows]))
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("µs a call, 5 % to 95 %; red: must reach")
    axes.set_title(f"Host time: {_device(record)}")
    return figure


def _effects(record: Record) -> Figure:
    """Error over cost, one panel an effect: what a rung's accuracy costs."""
    names = [name for name in case_names(record) if any("error.rmse" in row for row in rungs_of(record, name))]
    across = min(3, max(1, len(names)))
    down = -(-max(1, len(names)) // across)
    figure = Figure(figsize=(0.6 + 3.1 * across, 0.6 + 2.6 * down))
    panels = np.atleast_1d(figure.subplots(down, across)).ravel()
    for axes, name in zip(panels, names, strict=False):
        rows = [row for row in rungs_of(record, name) if "error.rmse" in row]
        # The reference of a ladder that saves time is the frame without it: no cost then, but the frame's time.
        saves = rows[0]["rung"] == rows[0]["reference"]
        key = "frame.ms" if saves else "cost.difference_ms"
        points = [(row[key], row["error.rmse"], row["rung"]) for row in rows[not saves :]]
        # What costs no more than the noise still has its place, at the left edge.
        least = min([cost for cost, _, _ in points if cost > 0.0], default=1e-3) / 2.0
        points = [(max(cost, least), error, rung) for cost, error, rung in points]
        if not saves:
            axes.axhline(rows[0]["error.rmse"], color=PALE, linestyle=":", linewidth=1.2)
        axes.plot([p[0] for p in points], [p[1] for p in points], "o", color=COLORS[0], markersize=5)
        high = max(row["error.rmse"] for row in rows) or 1.0
        for (cost, error, rung), shift in zip(points, _label_shifts([p[1] / high for p in points]), strict=True):
            axes.annotate(rung, (cost, error), xytext=(6, -3 + shift), textcoords="offset points", fontsize=8)
        axes.set(
            xscale="log",
            title=name,
            xlabel="frame [ms]" if saves else "cost [ms]",
            xlim=(least / 1.8, max(p[0] for p in points) * 12.0),
        )
        axes.set_ylim(-0.12 * high, 1.15 * high)
        axes.minorticks_off()
        axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    panels[0].set_ylabel("RMSE of display")
    figure.suptitle(f"Effects, dotted: rung off: {_device(record)}", fontsize=10, fontweight="bold")
    return figure


def _accuracy(record: Record) -> Figure:
    return accuracy_plots.overview_figure(record, COLORS, PALE, _device(record))


def _peers(record: Record) -> Figure:
    return performance_plots.peers_figure(record, COLORS, PALE, _device(record))


def _scaling(record: Record) -> Figure:
    return performance_plots.scaling_figure(record, COLORS, PALE, _device(record))


def _label_shifts(heights: list[float]) -> list[float]:
    """How far up each label goes [pt] so that those at one height, a share of the axis, do not lie on one another."""
    shifts = [0.0] * len(heights)
    order = sorted(range(len(heights)), key=lambda k: heights[k])
    for low, high in itertools.pairwise(order):
        # A label is as high as a tenth of the panel.
        gap = (heights[high] - heights[low]) * 110.0
        shifts[high] = max(0.0, shifts[low] + 10.0 - gap)
    return shifts


_DRAW = {
    "triangles": _triangles, "tiles": _tiles, "lights": _lights, "frame": _frame, "host": _host, "effects": _effects,
    "accuracy": _accuracy, "peers": _peers, "scaling": _scaling,
}  # fmt: skip
