"""Writes docs/effects.md: each effect's rungs side by side, with error, time, bounds and what `explain` says.

No figure is typed: times and errors are results, bounds are the settings' own docstrings.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from warp_deferred import Settings
from warp_deferred.effects import EFFECTS, Effect

from . import tables
from .effect_cases import EFFECT_CASES
from .effect_images import strip_path, strip_rungs
from .effect_tables import (
    COUNTS,
    LEGEND,
    STATED,
    case_names,
    explain_lines,
    free_table,
    ladder_table,
    measured_on,
    rungs_of,
    skipped_list,
)
from .effect_texts import TEXTS, TITLES
from .layout import milliseconds
from .record import Record

__all__ = ["effects_page", "overview"]

INTRODUCTION = """# Effects

Written by `python -m bench report` from `bench/results/effects*.json`; do not edit. Every effect is a ladder of rungs
from cheap to reference, chosen by `--set EFFECT.rung=RUNG` or in `Settings`; the errors of the others are taken against
the reference rung, which this program computes itself. To measure and draw anew:

```
python -m bench effects --device cuda:0 --json bench/results/effects.json
python -m bench effects-images --device cuda:0
python -m bench report
```

An effect runs where the scene calls for it, and `explain` says why. Errors are those of `display` in [0, 1] against the
reference rung: root of the mean square, the largest, and the mean of FLIP, which tells how different two pictures look
(0 alike, 1 as black and white). A reference of a finite number of samples has noise of its own, which is part of them.

In the pictures a pixel is enlarged without smoothing; below each rung is where it differs from the reference, times the
factor stated, black where it does not."""


def effects_page(records: dict[str, Record], images: Path) -> str:
    """Lay out the page.

    Args:
        records: Results of the bench `effects` by file name, the first of which fills the ladders.
        images: Folder of the strips; a strip that is not there is left out.
    """
    parts = [INTRODUCTION]
    shown: set[str] = set()
    for name, record in records.items():
        suffix = name.removeprefix("effects").strip("_-")
        parts += _record(record, f" ({suffix})" if suffix else "", images, shown)
    listed = [f"- `{effect.name}`, {_place(effect)}" for effect in EFFECTS if not effect.quiet]
    parts += ["## Passes of effects", "In frame order:", "\n".join(listed)]
    return "\n\n".join(parts) + "\n"


def _place(effect: Effect) -> str:
    if effect.before:
        return f"before `{effect.before}`"
    return f"after `{effect.after}`" if effect.after else "first"


def _record(record: Record, suffix: str, images: Path, shown: set[str]) -> list[str]:
    """Sections of one result; of several, texts and strips stand with the first only."""
    parts = [overview(record)]
    for name in case_names(record):
        parts.append(f"## {TITLES.get(name, name)}{suffix}")
        if name not in shown:
            parts += _about(name, images)
        shown.add(name)
        parts.append(ladder_table(record, name))
        parts.append(f"On {measured_on(record, name)}.")
        if told := explain_lines(record, name):
            parts.append(f"What `explain` says at these rungs, and where nothing calls for it:\n\n```\n{told}\n```")
    parts += [f"## The tables{suffix}", LEGEND, STATED, f"## Not called for{suffix}", free_table(record), COUNTS]
    frames = [row for row in record["rows"] if row["kind"] == "frame"]
    if frames:
        parts += [f"## Whole frames{suffix}", tables.full_table(record | {"bench": "frame", "rows": frames})]
    return [*(part for part in (*parts, skipped_list(record)) if part), f"Measured on {tables.provenance(record)}."]


def overview(record: Record, page: str = "") -> str:
    """One line a case: what its rungs cost and how far they are from the reference; links lead to a page."""
    lines = "\n".join(_line(record, name, page) for name in case_names(record))
    return f"| what | rung: the frame without, then what each adds, and its RMSE |\n| --- | --- |\n{lines}"


def _line(record: Record, name: str, page: str) -> str:
    title = TITLES.get(name, name)
    anchor = "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c in "-_")
    first, *rows = rungs_of(record, name)
    cells = [f"`{first['rung']}` {milliseconds(first['frame.ms'])} ms{_error(first)}"]
    for row in rows:
        sign = "+" if row["cost.difference_ms"] >= 0.0 else ""
        cells.append(f"`{row['rung']}` {sign}{milliseconds(row['cost.difference_ms'])} ms{_error(row)}")
    return f"| [{title}]({page}#{anchor}) | {'<br>'.join(cells)} |"


def _error(row: dict[str, Any]) -> str:
    if row.get("reference") == row["rung"]:
        return ", reference"
    return f", {row['error.rmse']:.4f}" if "error.rmse" in row else ""


def _about(name: str, images: Path) -> list[str]:
    """What a case shows: our words, its strip, and the settings' own words with their bounds."""
    parts = [TEXTS[name]] if name in TEXTS else []
    strip = strip_path(images, name)
    if strip.is_file():
        shown = ", ".join(f"`{rung}`" for rung in strip_rungs(strip))
        parts.append(f"![{name}: {shown}]({images.name}/{strip.name})")
    case = EFFECT_CASES.get(name)
    field = Settings.model_fields.get(case.stage) if case and case.name == case.stage else None
    if field is not None:
        words = inspect.getdoc(field.annotation).split("\n\n")
        rung = field.annotation.model_fields[case.field].description
        quoted = "\n\n".join([*words, f"`rung`: {rung}"])
        parts.append("\n".join(f"> {line}".rstrip() for line in quoted.splitlines()))
    return parts
