"""Tables of the bench `effects`: the ladder of each effect, and what effects cost that are not called for."""

from __future__ import annotations

from typing import Any

from .layout import count_text, markdown, megabytes, milliseconds, spread, verdict
from .record import Record
from .targets import EFFECT_TARGETS_MS, SKIPPED_TARGET_MS

__all__ = [
    "COUNTS", "LEGEND", "STATED", "case_names", "effects_table", "explain_lines", "free_table", "ladder_table",
    "measured_on", "rungs_of", "skipped_list",
]  # fmt: skip

Row = dict[str, Any]

LEGEND = (
    "Cost: the frame's time less that of the first row; own passes: those only this frame has, each as a graph of its "
    "own; other passes: what it adds to those that run anyway, and to which two most. Moved, of floor: bytes that own "
    "passes must move, and their time over that of copying so much. Memory: beside the first row. Compile: seconds to "
    "compile and load, with an empty cache, the kernels only this frame has, which is what a frame without the effect "
    "is spared, and in brackets those in whose place some of them stand. Errors: of `display` in [0, 1] against the "
    "reference rung. A frame that takes more than 20 ms is timed five times, others at least 50 times."
)
STATED = "\\* stated for one H200 at 1920x1080."
COUNTS = (
    "Passes, launches, kernels, memory: how many more than the plan of the same scene with rung `off`. Compile spared: "
    "seconds the kernels of the default rung would take."
)


def case_names(record: Record) -> list[str]:
    """Cases that have rungs in a result, in its order."""
    return list(dict.fromkeys(row["case"] for row in record["rows"] if row["kind"] == "rung"))


def rungs_of(record: Record, name: str) -> list[Row]:
    """Rows of a case's rungs, that without the effect first."""
    return [row for row in record["rows"] if row["kind"] == "rung" and row["case"] == name]


def ladder_table(record: Record, name: str) -> str:
    """What each rung of a case costs, and how far its picture is from the reference rung's; no empty columns."""
    columns = [
        "rung", ">frame ms", ">5 % to 95 %", ">cost ms", ">must reach*", ">own passes ms", ">other passes ms",
        ">moved", ">of floor", ">memory", ">compile s", ">RMSE", ">max", ">FLIP",
    ]  # fmt: skip
    lines = []
    for row in rungs_of(record, name):
        cost = row.get("cost.difference_ms")
        target = EFFECT_TARGETS_MS.get((name, row["rung"]))
        lines.append([
            f"`{row['rung']}`", milliseconds(row["frame.ms"]), spread(row, "frame"),
            "" if cost is None else f"**{milliseconds(cost)}**",
            "" if cost is None else _limit(record, cost, target),
            milliseconds(row["own.ms"]) if "own.ms" in row else "",
            _shared(row) if "shared.difference_ms" in row else "",
            megabytes(row["own.bytes"]) if "own.bytes" in row else "",
            f"{row['own.times_floor']:.1f} x" if "own.times_floor" in row else "",
            megabytes(row["memory.added_bytes"]) if "memory.added_bytes" in row else "",
            f"{row['compile.s']:.1f} ({row['compile.replaced_s']:.1f})" if "compile.s" in row else "",
            *_errors(row),
        ])  # fmt: skip
    filled = [k for k in range(len(columns)) if any(line[k] for line in lines)]
    return markdown([columns[k] for k in filled], [[line[k] for k in filled] for line in lines])


def measured_on(record: Record, name: str) -> str:
    """Scene, size and settings of a case."""
    row = rungs_of(record, name)[0]
    text = f"scene `{row['source']}`, {row['width']}x{row['height']}"
    return text + (f", `{row['settings']}`" if "settings" in row else "")


def _limit(record: Record, cost: float, limit: float | None) -> str:
    """The limit, judged on the card it is stated for only."""
    return verdict(record if "H200" in record["device"] else record | {"quick": True}, cost, limit)


def _shared(row: Row) -> str:
    """What passes that run anyway take more, and the two that change most."""
    parts = sorted(row["shared.passes"].items(), key=lambda part: -abs(part[1]))[:2]
    return f"{milliseconds(row['shared.difference_ms'])} ({', '.join(f'`{n}` {milliseconds(v)}' for n, v in parts)})"


def explain_lines(record: Record, name: str) -> str:
    """Lines of `explain` that the case's rungs change, and that of the frame that does not call for the effect."""
    lines = [(line[0], "runs", line[1], line[2]) for row in rungs_of(record, name) for line in row.get("explain", ())]
    lines += [
        (row["effect"], "-", "off", row["free.reason"])
        for row in record["rows"]
        if row["kind"] == "free" and row["case"] == name and "free.reason" in row
    ]
    lines = list(dict.fromkeys(lines))
    widths = [max(len(line[k]) for line in lines) for k in range(3)] if lines else []
    return "\n".join(
        "  ".join([*(word.ljust(n) for word, n in zip(line, widths, strict=False)), line[3]]).rstrip() for line in lines
    )


def _errors(row: Row) -> list[str]:
    if row.get("reference") == row["rung"]:
        return ["reference"] * 3
    return [f"{row[key]:.4f}" if key in row else "" for key in ("error.rmse", "error.max", "error.flip")]


def free_table(record: Record) -> str:
    """What effects cost that are not called for, or have nothing to do."""
    columns = ["effect", "here", ">frame ms", ">with rung `off`", ">passes", ">launches", ">kernels", ">memory",
               ">compile spared s", ">on top ms", ">must reach"]  # fmt: skip
    named = {row["case"] for row in record["rows"] if row["kind"] == "free"}
    lines = []
    for row in (r for r in record["rows"] if r["kind"] == "free"):
        figures = [milliseconds(row["frame.ms"]), milliseconds(row["off.ms"])]
        name = f"`{row['case']}`"
        if "idle.difference_ms" in row:
            cost = row["idle.difference_ms"]
            limit = _limit(record, cost, SKIPPED_TARGET_MS)
            lines.append([name, "called for, skipped on the device", *figures, *[""] * 5, milliseconds(cost), limit])
        else:
            counts = [count_text(row[f"free.{key}"]) for key in ("passes", "launches", "kernels")]
            same = "by the plan, none" if not any(row[f"free.{k}"] for k in ("passes", "launches", "kernels")) else ""
            told = f"not called for: {row['free.reason']}"
            spared = f"{row['compile.s']:.1f}" if "compile.s" in row else ""
            lines.append([name, told, *figures, *counts, megabytes(row["free.bytes"]), spared, same, ""])
    others = [f"`{name}`" for name in case_names(record) if name not in named]
    text = (
        f"Called for by nothing but settings or `passes=`, and measured beside the frame without: {', '.join(others)}."
    )
    return markdown(columns, lines) + (f"\n\n{text}" if others else "")


def skipped_list(record: Record) -> str:
    """What could not be measured, and why; empty if nothing."""
    return "\n".join(["Not measured:", "", *(f"- {text}" for text in record["skipped"])]) if record["skipped"] else ""


def effects_table(record: Record) -> str:
    """Every ladder, then what is not called for, then what was left out."""
    parts = []
    for name in case_names(record):
        parts.append(f"**{name}** ({measured_on(record, name)})\n\n{ladder_table(record, name)}")
    parts += [LEGEND, STATED, "**Effects without work**", free_table(record), COUNTS, skipped_list(record)]
    return "\n\n".join(part for part in parts if part)
