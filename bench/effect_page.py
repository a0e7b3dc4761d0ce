"""Writes docs/effects.md: each effect's rungs side by side, with error and time. No number is typed."""

from __future__ import annotations

import inspect
from pathlib import Path

from warp_deferred import Settings
from warp_deferred.effects import EFFECTS, Effect

from . import tables
from .effect_images import strip_path, strip_rungs
from .effect_tables import effect_names, free_table, ladder_table, rungs_of, skipped_list
from .record import Record

__all__ = ["effects_page"]

INTRODUCTION = """# Effects

Written by `python -m bench report` from `bench/results/effects*.json`; do not edit. Every effect is a ladder of rungs
from cheap to reference, chosen by `--set EFFECT.rung=RUNG` or in `Settings`; the reference rung is what the others are
measured against. To measure and draw anew:

```
python -m bench effects --device cuda:0 --json bench/results/effects.json
python -m bench effects-images --device cuda:0
python -m bench report
```

An effect runs where the scene calls for it, and `explain` says why. Cost is the time of the frame less that of the
same frame with rung `off`; errors are those of `display` in [0, 1] against the reference rung: root of the mean square,
the largest, and the mean of FLIP, which tells how different two pictures look. A reference rung of a finite number of
samples has noise of its own, which is part of these errors."""


def effects_page(records: dict[str, Record], images: Path) -> str:
    """Lay out the page.

    Args:
        records: Results of the bench `effects` by file name, the first of which fills the ladders.
        images: Folder of the strips; a strip that is not there is left out.
    """
    parts = [INTRODUCTION]
    for name, record in records.items():
        suffix = name.removeprefix("effects").strip("_-")
        parts += _record(record, f" ({suffix})" if suffix else "", images)
    listed = [f"- `{effect.name}`, {_place(effect)}" for effect in EFFECTS if not effect.quiet]
    parts += ["## Passes of effects", "In frame order:", "\n".join(listed)]
    return "\n\n".join(parts) + "\n"


def _place(effect: Effect) -> str:
    if effect.before:
        return f"before `{effect.before}`"
    return f"after `{effect.after}`" if effect.after else "first"


def _record(record: Record, suffix: str, images: Path) -> list[str]:
    parts = []
    for effect in effect_names(record):
        rows = rungs_of(record, effect)
        parts.append(f"## {effect}{suffix}")
        if effect in Settings.model_fields:
            parts.append(inspect.getdoc(Settings.model_fields[effect].annotation).split("\n\n")[0].replace("\n", " "))
        strip = strip_path(images, effect)
        if strip.is_file():
            shown = ", ".join(f"`{rung}`" for rung in strip_rungs(strip))
            parts.append(f"![{effect}]({images.name}/{strip.name})\n\nFrom left to right, then down: {shown}.")
        parts.append(ladder_table(record, effect))
        parts.append(f"Scene `{rows[0]['source']}`, {rows[0]['width']}x{rows[0]['height']}.")
    parts += [f"## Not called for{suffix}", free_table(record)]
    frames = [row for row in record["rows"] if row["kind"] == "frame"]
    if frames:
        parts += [f"## Whole frames{suffix}", tables.frames_table(record | {"rows": frames})]
    return [*(part for part in (*parts, skipped_list(record)) if part), f"Measured on {tables.provenance(record)}."]
