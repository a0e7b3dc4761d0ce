"""Writes tables and plots of docs/benchmarks.md, effects.md, accuracy.md, performance.md, README.md from bench/results.

No number is typed. A result's file name is its key: `frame.json` fills `<!-- bench:frame -->`, `frame_cpu.json` fills
`<!-- bench:frame_cpu -->`. The same results give the same files.
"""

from __future__ import annotations

import re
from pathlib import Path

from warp_deferred.errors import LoadError

from . import record, tables
from .accuracy_page import accuracy_page, chosen, plot_name
from .accuracy_tables import ladder_names, overview_table
from .effect_page import effects_page, overview
from .performance_page import BENCHES, performance_page

__all__ = ["MARKER", "fill", "run"]

MARKER = re.compile(r"(<!-- bench:([\w-]+) -->\n).*?(<!-- /bench -->)", re.DOTALL)
OPENING = re.compile(r"<!-- bench:([\w-]+) -->")
RESULTS, PAGE, IMAGES = Path("bench/results"), Path("docs/benchmarks.md"), Path("docs/images")
EFFECTS_PAGE, ACCURACY_PAGE = Path("docs/effects.md"), Path("docs/accuracy.md")
PERFORMANCE_PAGE = Path("docs/performance.md")
#: Bench -> heading and what its table shows; the order of the page.
SECTIONS = {
    "frame": (
        "Whole frames",
        "Frames with the output `display`, then their passes. A pass's floor is the time its memory traffic takes at "
        "the copy bandwidth measured in the same run; passes are timed as graphs of their own, so that their sum "
        "exceeds the frame's, which is one graph, by the cost of starting them.",
    ),
    "triangles": (
        "Triangles",
        "Terrain: the whole compact G-buffer of 16 bytes a pixel (clear, cull, raster, resolve). The others: clear and "
        "visibility, drawn whatever their winding.",
    ),
    "lights": (
        "Lights",
        "Point lights over one scene, their ranges set so that a stated number of them lights a pixel on average; the "
        "mean is counted again in the rendered picture.",
    ),
    "tiles": ("Light tiles", "The same scene by the side of a screen tile, the number of lights and the resolution."),
    "effects": (
        "Effects",
        "Each rung of each effect on the scene that shows it, beside the same frame without; pictures, tables and "
        "whole frames with effects are in [effects.md](effects.md).",
    ),
    "accuracy": (
        "What accuracy costs",
        "Each stage's rungs from cheap to reference on the scene that shows it best; all scenes, the stages' own "
        "errors, bounds and crops are in [accuracy.md](accuracy.md).",
    ),
    "peers": (
        "Beside others",
        "Newton, OpenGL and nvdiffrast on the same scenes in the same run, and in brackets how many times our time "
        "that is; what each computes and what not is in [performance.md](performance.md).",
    ),
    "scaling": (
        "Growth",
        "One thing varied, the rest fixed; every point and every pass is in [performance.md](performance.md).",
    ),
    "presets": (
        "Presets",
        "Whole frames at each preset, and how far their pictures are from those of `reference`, which traces 16 rays "
        "here in each of its 64 samples a pixel, and not 256, so that its time is less than it says: RMSE and largest "
        "difference of `display` in [0, 1], mean FLIP of its middle. Which rungs a preset takes, and what each costs "
        "and leaves by itself, is told in `warp_deferred/presets.py`.",
    ),
    "fit": (
        "Settings for a budget",
        "`warp_deferred.fit` at several budgets, beside the best of every combination of rungs that the scene calls "
        "for, each rendered and timed as the fit times frames. RMSE of `display` in [0, 1] against one picture whose "
        "ladders trace more rays than the fit's own reference, in which the fit's own figure is taken. A combination "
        "counts as possible where its median keeps the budget; a fit's choice must keep it in 19 of 20 frames of a "
        "time interval it did not see.",
    ),
    "guards": (
        "Guards",
        "Frames with the tests and clamps against bad input that are always on, and of a copy of the package without "
        "them, in processes that take turns: medians of the turns, and their spread.",
    ),
    "host": (
        "Host time",
        "What a call of `render` costs the thread that makes it: no figure waits for the device inside the clock, and "
        "where none is named not between calls either, so that a full queue would show. The last figure is that "
        "of host or device, whichever is slower. On the CPU a call renders the frame.",
    ),
}
#: Benches whose tables say it all.
PLOTLESS = ("presets", "fit", "guards")
INTRODUCTION = """# Benchmarks

Written by `python -m bench report` from `bench/results/*.json`; do not edit. The cases are frozen in `bench/cases.py`;
`python -m bench preview` writes a picture of each. To measure anew:

```
python -m bench NAME --device cuda:0 --json bench/results/NAME.json     # NAME: {names}
python -m bench report
python -m bench compare OLD.json NEW.json    # what got slower beyond the noise; exit code 1 if anything did
```

Figures are medians; on CUDA they are device times of graph replays, at least 50, warmed up before, with no pause
between them; on the CPU they are wall-clock times. "5 % to 95 %" is the spread between these percentiles."""


def run(root: Path, *, check: bool = False) -> list[Path]:
    """Write what is out of date.

    Args:
        root: Folder of README.md, docs and bench/results.
        check: Write nothing and leave pictures out of account: their bytes depend on matplotlib's version.

    Returns:
        Files that were, or with `check` would be, changed; pictures are always drawn and named when they change.

    Raises:
        LoadError: If there are no results, one cannot be read, or a marker of README.md names none.
    """
    folder = root / RESULTS
    records = {path.stem: record.read(path) for path in sorted(folder.glob("*.json"))}
    if not records:
        raise LoadError(f"{folder}: expected results (*.json), got none; run a bench with --json {RESULTS}/NAME.json")
    for name, result in records.items():
        if result["bench"] not in SECTIONS:
            raise LoadError(
                f"{folder / name}.json: expected a bench among {', '.join(SECTIONS)}, got {result['bench']!r}"
            )
    texts = {root / PAGE: _page(records)}
    if effects := {name: result for name, result in records.items() if result["bench"] == "effects"}:
        texts[root / EFFECTS_PAGE] = effects_page(effects, root / IMAGES)
    if accuracy := {name: result for name, result in records.items() if result["bench"] == "accuracy"}:
        texts[root / ACCURACY_PAGE] = accuracy_page(accuracy, root / IMAGES)
    if performance := {name: result for name, result in records.items() if result["bench"] in BENCHES}:
        texts[root / PERFORMANCE_PAGE] = performance_page(performance, root / IMAGES)
    readme = root / "README.md"
    if readme.exists():
        texts[readme] = fill(readme.read_text(encoding="utf-8"), records, str(readme))
    changed = [path for path, text in texts.items() if _read(path) != text.encode()]
    if check:
        return changed
    for path in changed:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(texts[path].encode())
    from . import plots

    parts = [(f"bench_{name}.png", result, "") for name, result in records.items() if result["bench"] not in PLOTLESS]
    if accuracy:
        result = accuracy[chosen(accuracy)]
        parts += [(plot_name(ladder), result, ladder) for ladder in ladder_names(result)]
    for name, result, part in parts:
        path = root / IMAGES / name
        before = _read(path)
        plots.draw(result, path, part)
        if _read(path) != before:
            changed.append(path)
    return changed


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def _page(records: dict[str, record.Record]) -> str:
    parts = [INTRODUCTION.format(names=", ".join(SECTIONS))]
    for bench, (heading, text) in SECTIONS.items():
        for name, result in records.items():
            if result["bench"] != bench:
                continue
            suffix = name.removeprefix(bench).strip("_-")
            parts.append(f"## {heading}{f' ({suffix})' if suffix else ''}")
            parts.append(text)
            parts.append(_shown(result))
            if bench not in PLOTLESS:
                parts.append(f"![{heading.lower()}](images/bench_{name}.png)")
            parts.append(f"Measured on {tables.provenance(result)}.")
    return "\n\n".join(parts) + "\n"


def _shown(result: record.Record) -> str:
    """Table of a result; where it has a page of its own, one line a row of that."""
    if result["bench"] == "effects":
        return overview(result, EFFECTS_PAGE.name)
    if result["bench"] == "accuracy":
        return overview_table(result, ACCURACY_PAGE.name)
    return tables.short_table(result) if result["bench"] in BENCHES else tables.full_table(result)


def fill(text: str, records: dict[str, record.Record], name: str) -> str:
    """Put the short table of each result between its markers.

    Raises:
        LoadError: If a marker names no result or is not closed.
    """
    closed = {match[2] for match in MARKER.finditer(text)}
    for key in OPENING.findall(text):
        if key not in records:
            known = ", ".join(records)
            raise LoadError(
                f"{name}: bench:{key}: expected one of the results {known}, got {key!r}; run it with --json"
            )
        if key not in closed:
            raise LoadError(f"{name}: bench:{key}: expected a closing <!-- /bench -->, got none; add it")

    def table(match: re.Match[str]) -> str:
        result = records[match[2]]
        return f"{match[1]}\n{tables.short_table(result)}\n\nMeasured on {tables.provenance(result)}.\n\n{match[3]}"

    return MARKER.sub(table, text)
