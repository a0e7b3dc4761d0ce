"""Tables of the bench `effects`: the ladder of each effect, and what effects cost that are not called for."""

from __future__ import annotations

from typing import Any

from .layout import count_text, markdown, megabytes, milliseconds, spread, verdict
from .record import Record
from .targets import EFFECT_TARGETS_MS, SKIPPED_TARGET_MS

__all__ = ["effect_names", "effects_table", "free_table", "ladder_table", "rungs_of", "skipped_list"]

Row = dict[str, Any]


def effect_names(record: Record) -> list[str]:
    """Effects that have rungs in a result, in its order."""
    return list(dict.fromkeys(row["effect"] for row in record["rows"] if row["kind"] == "rung"))


def rungs_of(record: Record, effect: str) -> list[Row]:
    """Rows of an effect's rungs, `off` first."""
    return [row for row in record["rows"] if row["kind"] == "rung" and row["effect"] == effect]


def ladder_table(record: Record, effect: str) -> str:
    """What each rung of an effect costs, and how far its picture is from the reference rung's."""
    columns = [
        "rung", ">frame ms", ">5 % to 95 %", ">cost ms", ">must reach*", ">own passes ms", ">other passes ms",
        ">moved", ">of floor", ">memory", ">compile s", ">RMSE", ">max", ">FLIP",
    ]  # fmt: skip
    lines = []
    for row in rungs_of(record, effect):
        cost = row.get("cost.difference_ms")
        target = EFFECT_TARGETS_MS.get((effect, row["rung"]))
        lines.append([
            f"`{row['rung']}`", milliseconds(row["frame.ms"]), spread(row, "frame"),
            "" if cost is None else f"**{milliseconds(cost)}**",
            "" if cost is None else verdict(record, cost, target),
            milliseconds(row["own.ms"]) if "own.ms" in row else "",
            f"{milliseconds(row['shared.difference_ms'])} (`{row['shared.most']}`)" if "shared.most" in row else "",
            megabytes(row["own.bytes"]) if "own.bytes" in row else "",
            f"{row['own.times_floor']:.1f} x" if "own.times_floor" in row else "",
            megabytes(row["memory.added_bytes"]) if "memory.added_bytes" in row else "",
            f"{row['compile.s']:.1f} ({row['compile.replaced_s']:.1f})" if "compile.s" in row else "",
            *_errors(row),
        ])  # fmt: skip
    return markdown(columns, lines)


def _errors(row: Row) -> list[str]:
    if row.get("reference") == row["rung"]:
        return ["reference", "", ""]
    return [f"{row[key]:.4f}" if key in row else "" for key in ("error.rmse", "error.max", "error.flip")]


def free_table(record: Record) -> str:
    """What effects cost that are not called for, or have nothing to do."""
    columns = ["effect", "here", ">frame ms", ">with rung `off`", ">passes", ">launches", ">kernels", ">memory",
               ">on top ms", ">must reach"]  # fmt: skip
    lines = []
    for row in (r for r in record["rows"] if r["kind"] == "free"):
        figures = [milliseconds(row["frame.ms"]), milliseconds(row["off.ms"])]
        name = f"`{row['effect']}`"
        if "idle.difference_ms" in row:
            cost = row["idle.difference_ms"]
            limit = verdict(record, cost, SKIPPED_TARGET_MS)
            lines.append(
                [name, "called for, skipped on the device", *figures, "", "", "", "", milliseconds(cost), limit]
            )
        else:
            counts = [count_text(row[f"free.{key}"]) for key in ("passes", "launches", "kernels")]
            same = "by the plan, none" if not any(row[f"free.{k}"] for k in ("passes", "launches", "kernels")) else ""
            lines.append([name, "not called for", *figures, *counts, megabytes(row["free.bytes"]), same, ""])
    return markdown(columns, lines)


def skipped_list(record: Record) -> str:
    """What could not be measured, and why; empty if nothing."""
    return "\n".join(["Not measured:", "", *(f"- {text}" for text in record["skipped"])]) if record["skipped"] else ""


def effects_table(record: Record) -> str:
    """Every ladder, then what is not called for, then what was left out."""
    parts = []
    for effect in effect_names(record):
        rows = rungs_of(record, effect)
        size = f"{rows[0]['width']}x{rows[0]['height']}"
        parts.append(f"**{effect}** (`{rows[0]['source']}`, {size})\n\n{ladder_table(record, effect)}")
    legend = (
        "Cost: the frame's time less that of the frame with rung `off`; own passes: those only this frame has, each as "
        "a graph of its own; other passes: what it adds to those that run anyway, and to which one most. Moved, of "
        "floor: bytes that own passes must move, and their time over that of copying so much. Memory: beside rung "
        "`off`. Compile: kernels only this frame has and, in brackets, those in whose place some of them stand. "
        "Errors: of `display` in [0, 1] against the reference rung."
    )
    stated = "\\* stated for one H200 at 1920x1080."
    counts = "Passes, launches, kernels, memory: how many more than the plan of the same scene with rung `off`."
    parts += [legend, stated, "**Effects without work**", free_table(record), counts, skipped_list(record)]
    return "\n\n".join(part for part in parts if part)
