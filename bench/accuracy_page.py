"""Writes docs/accuracy.md: each ladder with what is exact, bounded and measured, its table, plot and crops.

No measured figure is typed: they are results; bounds are the settings' own docstrings, or derived in accuracy_texts.py.
"""

from __future__ import annotations

import inspect
from pathlib import Path

from warp_deferred import Settings

from . import tables
from .accuracy_images import strip_name
from .accuracy_tables import (
    LEGEND,
    check_format,
    ladder_names,
    ladder_table,
    overview_table,
    scene_list,
    scenes_of,
    skipped_list,
)
from .accuracy_texts import EVERYWHERE, WORDS
from .effect_images import strip_rungs
from .ladders import LADDERS
from .measures import MEASURES, WINDOW
from .record import Record

__all__ = ["accuracy_page", "chosen", "plot_name"]

INTRODUCTION = """# What accuracy costs

Written by `python -m bench report` from `bench/results/accuracy*.json`; do not edit. Every stage is a ladder of rungs
from cheap to reference. A rung's error is taken against the reference rung, which is also the oracle of the tests:
once of the stage's own output in its natural unit, once of the picture. A ladder changes one stage; every optional
effect that is not on it is off, and the rest is at its default. To measure anew:

```
python -m bench accuracy --device cuda:0 --json bench/results/accuracy.json --images docs/images
python -m bench report
```"""
OVERVIEW = """Each line is a stage on the scene that shows it best, from its cheapest rung to its reference: down is
nearer to the truth, right is dearer, and rungs off the line are beaten by others. Stages whose rungs all give the same
bits (light tiles, light culling) are not drawn: they are free of error at any price."""


def chosen(records: dict[str, Record]) -> str:
    """Name of the result the page is made of: the one without a suffix, or the first."""
    return "accuracy" if "accuracy" in records else next(iter(records))


def plot_name(ladder: str) -> str:
    """File name of a ladder's plot."""
    return f"accuracy_{ladder}.png"


def accuracy_page(records: dict[str, Record], images: Path) -> str:
    """Lay out the page.

    Args:
        records: Results of the bench `accuracy` by file name.
        images: Folder of plots and strips; a strip that is not there is left out.

    Raises:
        LoadError: If a result is of another version.
    """
    for name, record in records.items():
        check_format(record, f"bench/results/{name}.json")
    name = chosen(records)
    record = records[name]
    parts = [INTRODUCTION, f"Measured on {tables.provenance(record)}."]
    if record["device"].startswith("CPU"):
        parts.append("**These are figures of a CPU**, of small pictures; there is no result of a GPU yet. Errors are "
                     "those of any device, times are not.")  # fmt: skip
    parts += ["## Overview", OVERVIEW, f"![time against error of every stage]({images.name}/bench_{name}.png)"]
    parts += [overview_table(record), "## What is exact", EVERYWHERE]
    for ladder in ladder_names(record):
        parts += _ladder(record, ladder, images)
    parts += ["## Scenes", scene_list(record)]
    parts += ["## The tables", LEGEND.format(window=f"{WINDOW[0]}x{WINDOW[1]}"), skipped_list(record)]
    for other, result in records.items():
        if other != name:
            parts += [f"## {other.removeprefix('accuracy').strip('_-') or other}", overview_table(result)]
            parts.append(f"Measured on {tables.provenance(result)}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _ladder(record: Record, name: str, images: Path) -> list[str]:
    """Part of a ladder: words, plot, table, crops, and the settings' own words with their bounds."""
    ladder, words = LADDERS[name], WORDS[name]
    measure = MEASURES[ladder.measure]
    held = f", {', '.join(f'`{s}`' for s in ladder.fixed)} held" if ladder.fixed else ""
    parts = [f"## {ladder.title}"]
    parts.append(f"Stage: {_stage(name)}. Error in {measure.unit}: {_lowered(measure.text)}{held}.")
    parts.append(f"- Exact: {words.exact}\n- Bounded: {words.bounded}\n- Only measured: {words.measured}")
    parts.append(f"![{ladder.title.lower()}: time against error]({images.name}/{plot_name(name)})")
    parts.append(ladder_table(record, name))
    strip = images / strip_name(name)
    if strip.is_file():
        shown = ", ".join(f"`{rung}`" for rung in strip_rungs(strip))
        scene = scenes_of(record, name)[0]
        parts.append(f"Where the cheapest rung is farthest off in `{scene}`, and below it the difference:")
        parts.append(f"![{name}: {shown}]({images.name}/{strip.name})")
    return parts + _quoted(name)


def _stage(name: str) -> str:
    passes = LADDERS[name].passes
    if passes:
        return "passes " + ", ".join(f"`{p}`" for p in passes)
    return "what the frame takes more than at rung `off`" if LADDERS[name].has_off else "the whole frame"


def _lowered(text: str) -> str:
    return (text[0].lower() + text[1:]).rstrip(".")


def _quoted(name: str) -> list[str]:
    """What the settings say of an effect, its bounds among it."""
    field = Settings.model_fields.get(name)
    if field is None or "As stated in the settings" not in WORDS[name].bounded:
        return []
    words = inspect.getdoc(field.annotation).split("\n\n")
    quoted = "\n\n".join([*words, f"`rung`: {field.annotation.model_fields['rung'].description}"])
    if name == "shadow":
        quoted += f"\n\n`samples`: {field.annotation.model_fields['samples'].description}"
    return ["\n".join(f"> {line}".rstrip() for line in quoted.splitlines())]
