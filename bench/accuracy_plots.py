"""Plots of the bench `accuracy`: time against error, one figure a ladder, and one of all ladders.

Both axes are logarithmic; an error of nothing stands on the line at the bottom, and a reference that samples at its own
standard error. A frame without the stage has no place on an axis of times: it is the dotted line.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from .accuracy_tables import default_rung, front_of, ladder_names, rows_of, scenes_of
from .effect_cases import ladders as effect_ladders
from .ladders import LADDERS
from .measures import MEASURES
from .record import Record

__all__ = ["ladder_figure", "overview_figure"]

Row = dict[str, Any]
#: Factor below the least error at which the line of errors of nothing stands.
BELOW = 5.0
ERRORS = {"stage": "the stage alone: {unit}", "error": "the picture: RMSE of display"}


def _noise(row: Row, part: str) -> float:
    return row.get(f"noise.{part}_rmse", 0.0) if row["rung"] == row["reference"] else row[f"{part}.rmse"]


def _cost(row: Row, least: float) -> float:
    return max(row["stage.ms"], least)


def _least(rows: list[Row]) -> float:
    """Where a cost stands that drowns in the noise: below all others."""
    return min((row["stage.ms"] for row in rows if row["stage.ms"] > 0.0), default=1e-3) / 2.0


def _shown(rows: list[Row]) -> list[Row]:
    return [row for row in rows if not (row["rung"] == "off" and row["reference"] != "off")]


def _floor(values: list[float]) -> float:
    return min((v for v in values if v > 0.0), default=1.0) / BELOW


def ladder_figure(record: Record, ladder: str, colors: tuple[str, ...], pale: str, title: str) -> Figure:
    """Time against error of a ladder on all its scenes; the Pareto front of each scene is a line."""
    known = LADDERS[ladder]
    rows = [row for row in record["rows"] if row["ladder"] == ladder]
    if known.exact and not any(row["stage.rmse"] for row in rows):
        return _exact_figure(record, ladder, colors, title)
    parts = [part for part in ERRORS if all(f"{part}.rmse" in row for row in rows)]
    figure = Figure(figsize=(4.6 * len(parts) + 0.4, 3.7))
    least = _least(_shown(rows))
    for axes, part in zip(np.atleast_1d(figure.subplots(1, len(parts))), parts, strict=True):
        floor = _floor([_noise(row, part) for row in rows])
        labels: list[tuple[float, float, str, str]] = []
        for k, scene in enumerate(scenes_of(record, ladder)):
            names = _scene(axes, rows_of(record, ladder, scene), part, least, floor, colors[k % len(colors)])
            labels = names if k == 0 else labels
        axes.axhline(floor, color=pale, linewidth=0.8)
        axes.text(0.01, floor, "nothing", transform=axes.get_yaxis_transform(), fontsize=7, color=pale, va="bottom")
        axes.set(xscale="log", yscale="log", xlabel="stage [ms]")
        axes.set_title(ERRORS[part].format(unit=MEASURES[known.measure].unit), fontsize=9)
        axes.margins(x=0.12)
        axes.set_ylim(bottom=floor / 1.6)
        _plain(axes.xaxis)
        _put_names(axes, labels, (5, 4), {"fontsize": 7.5})
    handles = [
        matplotlib.lines.Line2D([], [], color=colors[k % len(colors)], marker="o", markersize=4, label=scene)
        for k, scene in enumerate(scenes_of(record, ladder))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle(f"{known.title}: {title}", fontsize=10, fontweight="bold")
    return figure


def _scene(
    axes: Any, rows: list[Row], part: str, least: float, floor: float, color: str
) -> list[tuple[float, float, str, str]]:
    """Rungs of one scene, those of the front filled and joined; places, names and colours of labels."""
    shown, front = _shown(rows), front_of(_shown(rows), f"{part}.rmse")
    for row in rows:
        if row not in shown and row[f"{part}.rmse"] > 0.0:
            axes.axhline(row[f"{part}.rmse"], color=color, linestyle=":", linewidth=0.9, alpha=0.6)
    points = {row["rung"]: (_cost(row, least), max(_noise(row, part), floor)) for row in shown}
    line = sorted(points[rung] for rung in front)
    axes.step(*zip(*line, strict=True), where="post", color=color, linewidth=1.1, alpha=0.8)
    for row in shown:
        filled = row["rung"] in front
        axes.plot(*points[row["rung"]], "o", color=color, markerfacecolor=color if filled else "white", markersize=5)
    return [(*points[row["rung"]], row["rung"], "black") for row in shown]


def _exact_figure(record: Record, ladder: str, colors: tuple[str, ...], title: str) -> Figure:
    """Times alone, a line of points a scene, where every rung gives the same bits."""
    scenes = scenes_of(record, ladder)
    figure = Figure(figsize=(7.2, 1.5 + 0.42 * len(scenes)))
    axes = figure.subplots()
    names = list(dict.fromkeys(row["rung"] for row in record["rows"] if row["ladder"] == ladder))
    for y, scene in enumerate(scenes):
        for row in rows_of(record, ladder, scene):
            color = colors[names.index(row["rung"]) % len(colors)]
            axes.plot([row["stage.ms_p5"], row["stage.ms_p95"]], [y, y], color=color, linewidth=1.4)
            axes.plot(row["stage.ms"], y, "o", color=color, markersize=6, label=row["rung"] if y == 0 else None)
    axes.set(xscale="log", xlabel="stage [ms], 5 % to 95 %", ylim=(len(scenes) - 0.5, -0.5))
    axes.set_yticks(range(len(scenes)), scenes)
    axes.margins(x=0.1)
    _plain(axes.xaxis)
    axes.set_title(f"{LADDERS[ladder].title}, the error is 0 at every rung: {title}", fontsize=10)
    figure.legend(loc="outside lower center", ncols=len(names))
    return figure


def overview_figure(record: Record, colors: tuple[str, ...], pale: str, title: str) -> Figure:
    """Every ladder on the scene that shows it best: time against the error of the picture, the front as a line.

    Effects stand on the left, on the right in how many bits what is computed is kept. A result of ladders without
    errors of pictures alone, as `--only` may leave, is drawn as its first ladder.
    """
    names = [name for name in ladder_names(record) if not LADDERS[name].exact and not LADDERS[name].twin]
    if not names:
        return ladder_figure(record, ladder_names(record)[0], colors, pale, title)
    lines = {name: _shown(rows_of(record, name, scenes_of(record, name)[0])) for name in names}
    everything = [row for rows in lines.values() for row in rows]
    floor, most = _floor([row["error.rmse"] for row in everything]), max(row["error.rmse"] for row in everything)
    parts = {
        "what is computed": {name: rows for name, rows in lines.items() if name in effect_ladders()},
        "in how many bits": {name: rows for name, rows in lines.items() if name not in effect_ladders()},
    }
    parts = {words: part for words, part in parts.items() if part}
    figure = Figure(figsize=(10.6, 5.2), layout="constrained")
    several = len(parts) > 1
    panels = figure.subplots(1, len(parts), sharey=True, squeeze=False, width_ratios=(3, 2) if several else None)[0]
    for axes, (words, part) in zip(panels, parts.items(), strict=True):
        axes.set(xscale="log", yscale="log", xlabel="the stage's time [ms]: right is dearer")
        axes.set_ylim(floor / 1.5, 16.0 * max(floor, most))
        _overview_panel(axes, part, colors, pale, floor)
        axes.set_title(words, fontsize=9, loc="left")
    panels[0].set_ylabel("RMSE of the picture: down is nearer to the reference")
    for place, words, side in (((0.01, 0.98), "cheap and far off", "left"), ((0.99, 0.06), "dear and true", "right")):
        height = "top" if side == "left" else "bottom"
        panels[0].text(*place, words, transform=panels[0].transAxes, color=pale, ha=side, va=height, fontstyle="italic")
    figure.suptitle(f"What accuracy costs, filled: the default rung. {title}", fontsize=10, fontweight="bold")
    return figure


def _overview_panel(axes: Any, lines: dict[str, list[Row]], colors: tuple[str, ...], pale: str, floor: float) -> None:
    """Draw ladders into one panel, whose vertical limits are set."""
    labels: list[tuple[float, float, str, str]] = []
    least = _least([row for rows in lines.values() for row in rows])
    for k, (name, rows) in enumerate(lines.items()):
        color, style = colors[k % len(colors)], ("-", "--")[k // len(colors) % 2]
        points = [(_cost(row, least), max(_noise(row, "error"), floor)) for row in rows]
        front = front_of(rows, "error.rmse")
        line = sorted(point for row, point in zip(rows, points, strict=True) if row["rung"] in front)
        axes.plot(*zip(*line, strict=True), style, color=color, linewidth=1.3, alpha=0.85)
        for row, point in zip(rows, points, strict=True):
            chosen = row["rung"] == default_rung(LADDERS[name])
            axes.plot(*point, "o", color=color, markerfacecolor=color if chosen else "white", markersize=7 if chosen
                      else 5)  # fmt: skip
        labels.append((*max(points, key=lambda point: point[1]), name.replace("_", " "), color))
    axes.axhline(floor, color=pale, linewidth=0.8)
    axes.text(0.01, floor * 1.05, "no error", transform=axes.get_yaxis_transform(), fontsize=8, color=pale,
              va="bottom")  # fmt: skip
    axes.margins(x=0.12)
    _plain(axes.xaxis)
    _put_names(axes, labels, (0, 7), {"fontsize": 8.5, "ha": "center", "fontweight": "bold"})


def _put_names(
    axes: Any, labels: list[tuple[float, float, str, str]], offset: tuple[int, int], style: dict[str, Any]
) -> None:
    """Write names beside points (x, y, name, colour); one that would lie on another stands higher. Limits are set."""
    places = axes.transAxes.inverted().transform(axes.transData.transform([label[:2] for label in labels]))
    put: list[np.ndarray] = []
    for k in sorted(range(len(labels)), key=lambda k: places[k, 1]):
        place, height = places[k].copy(), 0
        while any(abs(place[0] - other[0]) < 0.2 and abs(place[1] - other[1]) < 0.035 for other in put):
            place[1], height = place[1] + 0.02, height + 6
        put.append(place)
        x, y, text, color = labels[k]
        axes.annotate(text, (x, y), xytext=(offset[0], offset[1] + height), textcoords="offset points", color=color,
                      **style)  # fmt: skip


def _plain(axis: Any) -> None:
    """Plain numbers on a logarithmic axis."""
    low, high = axis.get_view_interval()
    # Powers of ten say nothing of a stretch shorter than one.
    narrow = matplotlib.ticker.MaxNLocator(6, steps=[1, 2, 5, 10])
    axis.set_major_locator(narrow if high < 8.0 * low else matplotlib.ticker.LogLocator(subs=(1.0, 3.0)))
    axis.set_minor_locator(matplotlib.ticker.NullLocator())
    axis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
