"""Tables of the bench `accuracy`, the rungs that nothing beats, and the check that a result is of this layout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warp_deferred import Settings
from warp_deferred.errors import LoadError

from .ladders import LADDERS, SCENES, TWIN, Ladder
from .layout import markdown, milliseconds
from .measures import MEASURES
from .record import Record

__all__ = [
    "FORMAT", "LEGEND", "accuracy_table", "check_format", "default_rung", "front_of", "ladder_names", "ladder_table",
    "overview_table", "pareto_front", "points_of", "rows_of", "scene_list", "scenes_of", "skipped_list",
]  # fmt: skip

#: Number of the rows' layout; results of another one are refused.
FORMAT = 1
Row = dict[str, Any]

LEGEND = (
    "**Bold**: no other rung of the same scene is both cheaper and nearer (Pareto front of time and error of the "
    "stage). Stage: time of its own passes as graphs of their own, or, for a stage that has a rung `off`, what the "
    "frame takes more than without; below zero where that drowns in the noise. Of frame: as a share of all passes, or "
    "of the frame. Error: the stage's own, root of the mean square, against the reference rung; over: the share of "
    "pixels (or components) that are off by more than the threshold stated. RMSE, max: of `display` in [0, 1] over the "
    "picture; FLIP: of its middle, {window} pixels at most. ± stands for the reference's own standard error, where it "
    "samples. Medians; a frame that takes more than 20 ms is timed three times, one of more "
    "than 200 ms once."
)


def check_format(record: Record, name: str) -> None:
    """Refuse a result whose rows are laid out otherwise.

    Raises:
        LoadError: If it is of another version.
    """
    found = record.get("format")
    if found != FORMAT:
        raise LoadError(
            f"{name}: format: expected {FORMAT}, got {found!r}; it was written by another version: run the bench again"
        )


def ladder_names(record: Record) -> list[str]:
    """Ladders in a result, in its order."""
    return list(dict.fromkeys(row["ladder"] for row in record["rows"]))


def scenes_of(record: Record, ladder: str) -> list[str]:
    """Scenes a ladder was climbed on, the one that shows it best first."""
    found = {row["scene"] for row in record["rows"] if row["ladder"] == ladder}
    known = LADDERS[ladder].scenes if ladder in LADDERS else ()
    return [*(name for name in known if name in found), *sorted(found - set(known))]


def rows_of(record: Record, ladder: str, scene: str) -> list[Row]:
    """Rows of a ladder on a scene, cheap to reference."""
    return [row for row in record["rows"] if (row["ladder"], row["scene"]) == (ladder, scene)]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other one beats, by rising cost.

    A point (cost, error) is beaten by one that is no larger in both and smaller in one; equal points do not beat one
    another.
    """
    front: list[int] = []
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        if not front or points[k][1] < points[front[-1]][1] or points[k] == points[front[-1]]:
            front.append(k)
    return front


def points_of(rows: Sequence[Row], error: str = "stage.rmse") -> list[tuple[float, float]]:
    """Cost [ms] and error of rows; a cost that drowns in the noise is none."""
    return [(max(row["stage.ms"], 0.0), row[error]) for row in rows]


def front_of(rows: Sequence[Row], error: str = "stage.rmse") -> set[str]:
    """Rungs of a ladder on a scene that no other one beats."""
    known = [row for row in rows if error in row]
    return {known[k]["rung"] for k in pareto_front(points_of(known, error))}


def default_rung(ladder: Ladder) -> str:
    """The rung that is in force where nothing is said, or an empty text."""
    plain = Settings()
    return next((r.name for r in ladder.rungs if r.settings and plain.with_values(list(r.settings)) == plain), "")


def ladder_table(record: Record, ladder: str) -> str:
    """Every scene and rung of a ladder."""
    known = LADDERS[ladder]
    measure, default = MEASURES[known.measure], default_rung(known)
    columns = [
        "scene", "rung", ">stage ms", ">5 % to 95 %", ">of frame", ">frame ms", f">error, {measure.unit}", ">largest",
        f">over {measure.threshold:g}", ">RMSE", ">max", ">FLIP",
    ]  # fmt: skip
    lines = []
    for scene in scenes_of(record, ladder):
        rows = rows_of(record, ladder, scene)
        front = front_of(rows)
        for k, row in enumerate(rows):
            mark = "**" if row["rung"] in front else ""
            name = f"{mark}`{row['rung']}`{mark}" + (" (default)" if row["rung"] == default else "")
            low, high = milliseconds(row["stage.ms_p5"]), milliseconds(row["stage.ms_p95"])
            lines.append([
                f"`{scene}`" if k == 0 else "", name, milliseconds(row["stage.ms"]), f"{low} to {high}",
                f"{100.0 * row['stage.of_frame']:.0f} %", milliseconds(row["frame.ms"]), *_errors(row),
            ])  # fmt: skip
    filled = [k for k in range(len(columns)) if any(line[k] for line in lines)]
    return markdown([columns[k] for k in filled], [[line[k] for k in filled] for line in lines])


def _errors(row: Row) -> list[str]:
    if row["rung"] == row["reference"]:
        noise = [f"reference ± {row[key]:.2g}" if key in row else "reference"
                 for key in ("noise.stage_rmse", "noise.error_rmse")]  # fmt: skip
        return [noise[0], "", "", noise[1], "", ""]
    return [
        f"{row['stage.rmse']:.3g}", f"{row['stage.max']:.3g}", f"{100.0 * row['stage.off_share']:.3g} %",
        *(f"{row[key]:.3g}" if key in row else "" for key in ("error.rmse", "error.max", "error.flip")),
    ]  # fmt: skip


def overview_table(record: Record, page: str = "") -> str:
    """One line a ladder, on the scene that shows it best: each rung's price and what the picture is off by."""
    lines = []
    for ladder in ladder_names(record):
        scene = scenes_of(record, ladder)[0]
        cells = []
        for row in rows_of(record, ladder, scene):
            if row["rung"] == row["reference"]:
                error = "reference"
            elif "error.rmse" in row:
                error = f"{row['error.rmse']:.2g}"
            else:
                error = f"{row['stage.rmse']:.2g} {row['unit']}, against {TWIN}"
            cells.append(f"`{row['rung']}` {milliseconds(row['stage.ms'])} ms, {error}")
        title = LADDERS[ladder].title if ladder in LADDERS else ladder
        lines.append([f"[{title}]({page}#{_anchor(title)})" if page else title, f"`{scene}`", "<br>".join(cells)])
    return markdown(["stage", "scene", "rung: its time, and the RMSE of the picture"], lines)


def _anchor(title: str) -> str:
    return "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c in "-_")


def skipped_list(record: Record) -> str:
    """What could not be measured, and why; empty if nothing."""
    return "\n".join(["Not measured:", "", *(f"- {text}" for text in record["skipped"])]) if record["skipped"] else ""


def accuracy_table(record: Record) -> str:
    """Every ladder, for the screen."""
    parts = [f"**{LADDERS[name].title}**\n\n{ladder_table(record, name)}" for name in ladder_names(record)]
    return "\n\n".join(part for part in (*parts, skipped_list(record)) if part)


def scene_list(record: Record) -> str:
    """The scenes of a result: what each is there for, and how large its picture is."""
    seen: dict[str, list[Row]] = {}
    for row in record["rows"]:
        seen.setdefault(row["scene"], []).append(row)
    lines = []
    for name in (n for n in SCENES if n in seen):
        row = max(seen[name], key=lambda r: r["width"])
        lines.append([f"`{name}`", SCENES[name].title, f"`{row['source']}`", f"{row['width']}x{row['height']}"])
    return markdown(["scene", "for", "source", ">size"], lines)
