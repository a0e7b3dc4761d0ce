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
#: What the table of seconds says.
SECONDS_TEXT = (
    "Time a fit takes: with all kernels loaded, and with prices it has measured before; in a process of its own, which "
    "finds its kernels compiled and loads them, from the call on and with the interpreter's start and imports; and the "
    "first here, compiling apart:"
)


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
    columns_s = [">budget ms", ">kernels loaded s", ">frames looked at", ">prices known s", ">own process s",
                 ">of it loading", ">with imports", ">must reach*", ">first here s", ">compiling apart s",
                 ">modules compiled"]  # fmt: skip
    seconds = [
        [
            f"`{row['scene']}`", f"{row['budget_ms']:g}", f"{row['fit.s']:.2f}", str(row["fit.frames"]),
            f"{row['cached.s']:.2f}", _seconds(row, "fresh.s"), _seconds(row, "fresh.load_s"),
            _seconds(row, "fresh.process_s"), _in_time(record, row), f"{row['first.s']:.2f}",
            f"{row['first.compile_s']:.1f}", str(row["first.compiled"]),
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
        markdown(columns, lines), tried, SECONDS_TEXT, markdown(["scene", *columns_s], seconds),
        "Settings, as far as they are not the defaults:",
        markdown(bought, words), "\\* on one H200.",
    ])  # fmt: skip


def _seconds(row: Record, key: str) -> str:
    return f"{row[key]:.2f}" if key in row else ""


def _in_time(record: Record, row: Record) -> str:
    """Whether a fit in a process of its own keeps its limit, where it was measured."""
    if "fresh.s" not in row or row["scene"] not in STATED:
        return ""
    return verdict(record, row["fresh.s"], SECONDS)


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
