"""Compares two results of one bench: what got slower or faster by more than the noise, what counts and sizes changed.

Times are judged by `noise.limit`. Where a result tells no repeats, as old ones do not, those of its bench are taken, on
the CPU, which may stop early, the fewest possible. A time without a spread (a difference, or a pass in old results)
takes the widest of its row. Counts, sizes and errors repeat bit for bit on one device: `TOLERANCE` allows for how they
are rounded. Figures made of others (floors, sums, differences), words, and times taken only once are not judged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from warp_deferred.checks import check_range
from warp_deferred.errors import InputError, LoadError

from .layout import count_text, markdown, megabytes, milliseconds
from .noise import DRIFT, FLOOR_MS, Sample, limit
from .record import Record
from .timing import MIN_REPEATS, REPEATS

__all__ = ["Change", "Comparison", "compare", "row_name", "table"]

#: Fields that name a row; of a bench that is not here, all that are words or whole numbers and no metric.
NAMES = {
    "frame": ("case",), "triangles": ("case",), "lights": ("lights", "mean"), "host": ("case", "figure"),
    "tiles": ("resolution", "lights", "tile_size"), "effects": ("kind", "case", "rung"),
    "accuracy": ("ladder", "scene", "rung"), "peers": ("case", "peer"), "scaling": ("axis", "n"),
    "fit": ("scene", "budget_ms"), "presets": ("preset", "scene"),
}  # fmt: skip
#: Fields that make a row another case if they differ.
INPUTS = ("width", "height", "triangles", "lights", "source", "settings")
#: Repeats of a quick run, where the result does not tell: the fewest of all benches.
QUICK_REPEATS = 3
#: Ends of metrics that are made of others, or are measured once.
DERIVED = ("floor_ms", "floor.ms", "times_floor", "sum_ms", "difference_ms", "of_frame", "added_bytes")
ONCE = (
    "compile.s", "compile.replaced_s", "build.s", "first.s", "fresh.s", "fresh.process_s", "fit.s", "cached.s",
    "load_s", "compile_s", "held.share", "best.frame_ms", "predicted.frame_ms", "error.predicted",
)  # fmt: skip
#: Times that are, or may be, differences of longer ones: what runs differ by is a share of the whole.
WHOLE = {"stage.ms": "frame.ms", "raster.ms": "total.ms"}
#: Share and difference by which errors and means may differ: they are rounded to four digits, or to 1e-6.
TOLERANCE, ROUNDING = 1e-3, 2e-6
TIMES = (".ms", ".us")
FLAGGED = ("slower", "faster", "more", "less")

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Change:
    """One figure in two results.

    Attributes:
        row: Name of the row.
        metric: Name of the figure; empty where the whole row is meant.
        old: Figure then; None if there was none.
        new: Figure now; None if there is none.
        noise: Largest difference that is called noise, in the figure's unit.
        verdict: slower, faster (times), more, less (other figures), same; missing, new; another case.
        text: What differs, for another case.
    """

    row: str
    metric: str
    old: float | None
    new: float | None
    noise: float
    verdict: str
    text: str = ""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All figures of two results.

    Attributes:
        changes: Figures that were compared, and rows and figures that only one result has.
        notes: What else differs between the runs.
    """

    changes: tuple[Change, ...]
    notes: tuple[str, ...]

    def count(self, verdict: str) -> int:
        """Number of figures with a verdict."""
        return sum(change.verdict == verdict for change in self.changes)


def compare(old: Record, new: Record, *, factor: float = 1.0) -> Comparison:
    """Compare two results.

    Args:
        old: What `record.read` returned.
        new: Another result, of the same bench, device and version of Warp.
        factor: By which all noise of times is multiplied, >= 0.

    Raises:
        InputError: If the two cannot be compared, or no row is in both.
        LoadError: If a result has two rows of the same name, or a figure that is no number.
    """
    factor = check_range("--factor", factor, 0.0)
    _check_alike(old, new)
    rows = [_rows(record) for record in (old, new)]
    shared = [name for name in rows[0] if name in rows[1]]
    if not shared:
        raise InputError(f"rows: expected some that both results have, got none, such as {_first(rows)}; run it again")
    changes: list[Change] = []
    alike = []
    for name in shared:
        if differ := [f"{k} {rows[0][name].get(k)} → {rows[1][name].get(k)}" for k in _changed_inputs(rows, name)]:
            changes.append(Change(name, "", None, None, 0.0, "another case", ", ".join(differ)))
        else:
            alike.append(name)
    count = sum(metric in rows[1][name] for name in alike for metric in _metrics(rows[0][name]) if _is_time(metric))
    for name in alike:
        changes += _row_changes(name, (rows[0][name], rows[1][name]), (old, new), max(count, 1), factor)
    for here, there, verdict in ((*rows, "missing"), (*rows[::-1], "new")):
        changes += [Change(name, "", None, None, 0.0, verdict) for name in here if name not in there]
    return Comparison(tuple(changes), tuple(_notes(old, new)))


def _check_alike(old: Record, new: Record) -> None:
    keys = ["bench", "warp", "device", "quick"]
    # Host time is of the machine, whatever the device.
    if _kind(old) == "cpu" or old["bench"] == "host":
        keys.append("machine")
    for key in keys:
        if old[key] != new[key]:
            raise InputError(
                f"{key}: expected the same in both results, got {old[key]!r} and {new[key]!r}; measure one of them "
                "again where the other was measured"
            )


def _notes(old: Record, new: Record) -> Iterator[str]:
    for key in ("driver", "machine", "settings"):
        if old[key] != new[key]:
            yield f"{key} differs: {old[key]!r} and {new[key]!r}"
    for state, record in (("old", old), ("new", new)):
        if str(record["commit"]).endswith("-dirty"):
            yield f"the {state} result is of files that no commit has ({record['commit']})"
    if (before := old.get("copy_bytes_per_s")) and (after := new.get("copy_bytes_per_s")):
        if abs(after / before - 1.0) > DRIFT[_kind(old)]:
            yield f"the device copies {after / 1e9:,.0f} GB/s and copied {before / 1e9:,.0f}: is it alone?"


def _rows(record: Record) -> dict[str, Row]:
    """Rows by name."""
    found: dict[str, Row] = {}
    for row in record["rows"]:
        name = row_name(record["bench"], row)
        if name in found:
            raise LoadError(f"rows of {record['bench']}: expected one named {name!r}, got two; run the bench again")
        found[name] = row
    return found


def row_name(bench: str, row: Row) -> str:
    """Name of a row: the words and numbers that no other row of its result has together."""
    keys = NAMES.get(bench) or [k for k, v in row.items() if "." not in k and isinstance(v, (str, int))]
    # A number says nothing without its field; a word does.
    parts = [str(row[k]) if isinstance(row[k], str) else f"{k} {row[k]:g}" for k in keys if k in row]
    # The bench of effects has two rows of what costs nothing, told apart by their figures.
    return ", ".join([*parts, "idle"] if any(k.startswith("idle.") for k in row) else parts)


def _first(rows: list[dict[str, Row]]) -> str:
    return " and ".join(repr(next(iter(part), "no row")) for part in rows)


def _changed_inputs(rows: list[dict[str, Row]], name: str) -> list[str]:
    return [key for key in INPUTS if rows[0][name].get(key) != rows[1][name].get(key)]


def _is_time(metric: str) -> bool:
    return metric.endswith(TIMES)


def _metrics(row: Row) -> list[str]:
    """Names of the figures of a row that are judged."""
    ends = (*DERIVED, *ONCE, "_p5", "_p95", ".repeats")
    numbers = [k for k, v in row.items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    return [k for k in numbers if ("." in k or k in ("bytes", "samples")) and not k.endswith(ends)]


def _row_changes(
    name: str, rows: tuple[Row, Row], records: tuple[Record, Record], count: int, factor: float
) -> list[Change]:
    old, new = rows
    changes = []
    for metric in [*_metrics(old), *(m for m in _metrics(new) if m not in old)]:
        if metric not in new or metric not in old:
            verdict = "missing" if metric in old else "new"
            changes.append(Change(name, metric, old.get(metric), new.get(metric), 0.0, verdict))
            continue
        before, after = old[metric], new[metric]
        if not isinstance(after, (int, float)):
            raise LoadError(f"{name}: {metric}: expected a number, got {after!r}; run the bench again")
        if _is_time(metric):
            whole = abs(old.get(WHOLE.get(metric, metric), before))
            # Host times, in microseconds, are those of one thread.
            between = DRIFT["cpu"] * whole if metric.endswith(".us") else _between(records[0], whole)
            samples = [_sample(row, metric, record) for row, record in zip(rows, records, strict=True)]
            noise, words = factor * limit(*samples, count, between), ("slower", "faster")
        else:
            exact = isinstance(before, int) and isinstance(after, int)
            noise, words = 0.0 if exact else max(TOLERANCE * abs(before), ROUNDING), ("more", "less")
        # Values are decimals of few digits; the last bit of their difference means nothing.
        apart = round(after - before, 9)
        changes.append(Change(name, metric, before, after, noise, "same" if abs(apart) <= noise else words[apart < 0]))
    return changes


def _sample(row: Row, metric: str, record: Record) -> Sample:
    spread = _spread(row, metric)
    if spread is None:
        spread = max((s for m in _metrics(row) if _is_time(m) and (s := _spread(row, m)) is not None), default=None)
    if spread is None:
        raise LoadError(f"{metric}: expected a time with a spread in its row, got none; run the bench again")
    told = row.get(f"{metric.rpartition('.')[0]}.repeats", row.get("frame.repeats", row.get("calls")))
    fewest = QUICK_REPEATS if record["quick"] else MIN_REPEATS if _kind(record) == "cpu" else REPEATS
    return Sample(row[metric], spread, max(int(told if told is not None else fewest), 2))


def _spread(row: Row, metric: str) -> float | None:
    """From the 5th to the 95th percentile, if the row tells."""
    ends = [row.get(f"{metric}_{end}") for end in ("p5", "p95")]
    return None if None in ends else max(ends[1] - ends[0], 0.0)


def _kind(record: Record) -> str:
    """Kind of the device: cpu or cuda."""
    return "cpu" if record["device"].startswith("CPU") else "cuda"


def _between(record: Record, time: float) -> float:
    """Milliseconds by which runs differ whatever their spreads, for a time in milliseconds."""
    kind = _kind(record)
    return DRIFT[kind] * time + FLOOR_MS[kind]


def table(comparison: Comparison, *, everything: bool = False) -> str:
    """What changed, as Markdown, and a line that sums it up.

    Args:
        comparison: Two results, compared.
        everything: Figures that stayed the same, too.
    """
    shown = [c for c in comparison.changes if everything or c.verdict != "same"]
    lines = [_line(change) for change in sorted(shown, key=lambda c: c.verdict != "slower")]
    columns = ["case", "figure", ">old", ">new", ">change", ">noise", "verdict"]
    times = sorted(c.new / c.old for c in comparison.changes if _is_time(c.metric) and c.old and c.new is not None)
    words = [*FLAGGED, "same", "missing", "new", "another case"]
    told = ", ".join(f"{n} {word}" for word in words if (n := comparison.count(word)))
    if times:
        told += f"; times are {100.0 * (times[len(times) // 2] - 1.0):+.1f} % at the median"
    parts = [f"note: {note}" for note in comparison.notes]
    return "\n\n".join([*parts, *([markdown(columns, lines)] if lines else []), told])


def _line(change: Change) -> list[str]:
    values = [_shown(change.metric, value) for value in (change.old, change.new)]
    if change.verdict in ("missing", "new", "another case"):
        return [change.row, change.metric or "(the row)", *values, change.text, "", change.verdict]
    apart = change.new - change.old
    share = f"{100.0 * apart / abs(change.old):+.1f} %" if change.old else f"{apart:+g}"
    noise = f"± {100.0 * change.noise / abs(change.old):.1f} %" if change.old else f"± {change.noise:g}"
    verdict = f"**{change.verdict}**" if change.verdict == "slower" else change.verdict
    return [change.row, change.metric, *values, share, noise, verdict]


def _shown(metric: str, value: float | None) -> str:
    if value is None:
        return ""
    if _is_time(metric):
        return f"{milliseconds(value)} {metric[-2:].replace('us', 'µs')}"
    return megabytes(value) if metric.endswith("bytes") else count_text(value)
