"""Tables of the benches `fit` and `presets`, for docs/benchmarks.md."""

from __future__ import annotations

from .layout import markdown, milliseconds, spread, verdict
from .record import Record

__all__ = ["fit_table", "presets_table"]

#: Seconds a fit may take with kernels compiled [one H200], what its error may be of the best possible, and what may be
#: left of the budget, where it buys anything.
SECONDS, RATIO, LEFT = 3.0, 1.15, 0.1
#: Scenes these are stated for.
STATED = ("hundred_lights",)


def fit_table(record: Record) -> str:
    """Every fit: what it took, what it bought, and how near that is to the best of all combinations."""
    columns = [
        "scene", ">budget ms", ">frame ms", ">5 % to 95 %", ">unseen frames within", ">of budget", ">must reach*",
        ">RMSE, fit's own", ">RMSE", ">best RMSE", ">its share of budget", ">of best possible", ">must reach*",
    ]  # fmt: skip
    lines = []
    for row in record["rows"]:
        ratio = row.get("error.ratio")
        lines.append([
            f"`{row['scene']}`", f"{row['budget_ms']:g}", f"**{milliseconds(row['frame.ms'])}**", spread(row, "frame"),
            f"{row['held.share']:.0%} of {row['frame.repeats']}", f"{row['spent.share']:.0%}",
            _spent(record, row),
            f"{row['error.rmse']:.4f}", f"**{row['error.judged']:.4f}**",
            f"{row['best.error']:.4f}" if "best.error" in row else "none fits",
            f"{row['best.share']:.0%}" if "best.error" in row else "",
            "" if ratio is None else f"{ratio:.3f}",
            "" if ratio is None else verdict(record, ratio, RATIO),
        ])  # fmt: skip
    columns_s = [">budget ms", ">first in a process s", ">of it loading", ">compiling apart s", ">modules compiled",
                 ">kernels loaded s", ">frames looked at", ">prices known s", ">must reach*"]  # fmt: skip
    seconds = [
        [
            f"`{row['scene']}`", f"{row['budget_ms']:g}", f"{row['first.s']:.2f}", f"{row['first.load_s']:.2f}",
            f"{row['first.compile_s']:.1f}", str(row["first.compiled"]), f"{row['fit.s']:.2f}", str(row["fit.frames"]),
            f"{row['cached.s']:.2f}",
            verdict(record, row["first.s"], SECONDS if row["scene"] in STATED else None),
        ]
        for row in record["rows"]
    ]  # fmt: skip
    bought = ["scene", ">budget ms", "bought", "the best possible", "beyond the budget"]
    words = [
        [
            f"`{row['scene']}`", f"{row['budget_ms']:g}", _settings(row["bought"]),
            _settings(row.get("best.bought", "")), "; ".join(filter(None, (row["unspent"], row["next"]))),
        ]
        for row in record["rows"]
    ]  # fmt: skip
    tried = " ".join(_tried(row) for row in {row["scene"]: row for row in record["rows"]}.values())
    return "\n\n".join([
        markdown(columns, lines), tried, "Time a fit takes, measured anew and with prices it has measured before:",
        markdown(["scene", *columns_s], seconds), "Settings, as far as they are not the defaults:",
        markdown(bought, words), "\\* on one H200.",
    ])  # fmt: skip


def _spent(record: Record, row: Record) -> str:
    """Whether a tenth of the budget is left at most; or nothing that more of it would buy."""
    left = 1.0 - row["spent.share"]
    if left > LEFT and row["unspent"]:
        return "nothing for sale"
    return verdict(record, left, LEFT)


def _tried(row: Record) -> str:
    """What was tried on a scene."""
    count, whole = row["tried.count"], row["tried.of"]
    text = f"Tried on `{row['scene']}` in {row['tried.s']:.0f} s: {count} combinations of {whole}"
    if count == whole:
        return text + "."
    return f"{text}, the others predicted to be {row['tried.ratio']:.2f} times the least error in their time or more."


def _settings(text: str) -> str:
    return "<br>".join(f"`{word}`" for word in text.split()) or "the defaults"


def presets_table(record: Record) -> str:
    """Every preset on every scene: time, and error against the preset `reference`."""
    columns = ["scene", "preset", ">frame ms", ">5 % to 95 %", ">RMSE", ">max", ">FLIP"]
    lines, last = [], ""
    for row in record["rows"]:
        errors = ["reference", "", ""]
        if row["preset"] != "reference":
            errors = [f"{row[key]:.3g}" if key in row else "" for key in ("error.rmse", "error.max", "error.flip")]
        scene = f"`{row['scene']}`" if row["scene"] != last else ""
        lines.append([
            scene, f"`{row['preset']}`", f"**{milliseconds(row['frame.ms'])}**", spread(row, "frame"), *errors
        ])  # fmt: skip
        last = row["scene"]
    return markdown(columns, lines)
