"""Presets: chosen from a result of the bench `accuracy`, written as the module `warp_deferred/presets.py`; measured.

The rule. Of each ladder's rungs a preset takes the one with the least error + rate x price. Error: RMSE of the picture,
root of the mean square over the ladder's scenes. Price: what the frame takes more than with the ladder's fastest rung,
as a share of that frame, mean over the scenes; so that a ladder of slow scenes counts no more than others. The rate is
the error that one more frame's worth of time must buy. `reference` takes every ladder's reference rung. Ladders whose
rungs all give the same bits have no part in it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Settings
from warp_deferred.errors import LoadError

from .accuracy import QUICK, whole_frame
from .accuracy_tables import check_format, ladder_names, rows_of, scenes_of
from .ladders import LADDERS, SCENES, stand_size
from .measures import picture_errors
from .probe import open_scene, plan_of
from .record import Record, read
from .timing import REPEATS

__all__ = ["MEASURED", "MODULE", "RATES", "choose", "module_text", "run", "source", "write"]

#: RMSE that a frame's worth of time must buy, preset by preset; None: the reference, whatever it costs.
RATES: dict[str, float | None] = {"draft": 0.05, "balanced": 0.005, "high": 0.001, "reference": None}
MODULE = Path("warp_deferred/presets.py")
RESULTS = Path("bench/results")
#: Rays and samples of `reference` where presets are measured, in each of its 64 samples a pixel; with its own 256 a
#: frame takes minutes.
COUNTS = ("shadow.samples=16", "ambient_visibility.rays=16")
#: Those of a quick run.
QUICK_COUNTS = ("shadow.samples=1", "ambient_visibility.rays=1", *QUICK)
#: Scenes presets are measured on: those that carry every ladder they can.
MEASURED = ("many_lights", "hundred_lights", "spheres_50k", "shadows")

HEAD = '''"""Presets: a rung for every ladder, by what accuracy costs.

Written by `python -m bench presets` from {name} ({device}, {date}); do not edit.
bench/presets.py has the rule. Each line tells what the rung costs and leaves, over the scenes of its ladder: how much
longer a frame takes than with the ladder's fastest rung, as a share of that frame, and the RMSE of `display` in [0, 1]
against the ladder's reference rung.

{tables}
"""

from __future__ import annotations

__all__ = ["PRESETS"]

#: Preset -> stage -> field -> value.
PRESETS: dict[str, dict[str, dict[str, str]]] = {{
{entries}
}}
'''


@dataclasses.dataclass(frozen=True)
class Chosen:
    """A rung that a preset takes.

    Attributes:
        ladder: The ladder.
        rung: The rung.
        price: What the frame takes more than with the fastest rung, as a share of that frame.
        error: RMSE of the picture.
        settings: Assignments that select it.
    """

    ladder: str
    rung: str
    price: float
    error: float
    settings: tuple[str, ...]


def source(root: Path) -> Path:
    """The result that presets are made from: that of a GPU, or the one of a CPU where there is none yet.

    Raises:
        LoadError: If there is neither.
    """
    for name in ("accuracy.json", "accuracy_cpu.json"):
        if (root / RESULTS / name).is_file():
            return root / RESULTS / name
    raise LoadError(f"{root / RESULTS}: expected accuracy.json, got none; run python -m bench accuracy with --json")


def _points(record: Record, ladder: str) -> dict[str, tuple[float, float]]:
    """Price and error of each rung that was measured on every scene of its ladder."""
    scenes = scenes_of(record, ladder)
    found: dict[str, list[tuple[float, float]]] = {}
    for scene in scenes:
        rows = rows_of(record, ladder, scene)
        fastest = min(row["frame.ms"] for row in rows)
        for row in rows:
            point = row["frame.ms"] / fastest - 1.0, row.get("error.rmse", 0.0)
            found.setdefault(row["rung"], []).append(point)
    return {
        rung: (float(np.mean([p for p, _ in points])), math.sqrt(float(np.mean([e * e for _, e in points]))))
        for rung, points in found.items()
        if len(points) == len(scenes)
    }


def choose(record: Record) -> dict[str, list[Chosen]]:
    """Choose the rungs of every preset.

    Args:
        record: Result of the bench `accuracy`.

    Raises:
        LoadError: If it is of another version, or a ladder or rung of it is not known.
    """
    check_format(record, "accuracy")
    result: dict[str, list[Chosen]] = {name: [] for name in RATES}
    for name in ladder_names(record):
        if name not in LADDERS:
            raise LoadError(f"accuracy: expected ladders {', '.join(LADDERS)}, got {name!r}; run the bench again")
        ladder = LADDERS[name]
        if ladder.twin or ladder.exact:
            continue
        points = _points(record, name)
        if not any(error for _, error in points.values()):
            # Fast arithmetic on a CPU, which has none: noise alone would choose.
            continue
        for preset, rate in RATES.items():
            if rate is None:
                rung = ladder.reference
            else:
                rung = min(points, key=lambda r: (points[r][1] + rate * points[r][0], points[r][0]))
            price, error = points.get(rung, (math.nan, 0.0))
            result[preset].append(Chosen(name, rung, price, error, ladder.rung(rung).settings))
    return result


def module_text(record: Record, name: str) -> str:
    """Text of the module that holds the presets.

    Args:
        record: Result of the bench `accuracy`.
        name: Its file, as seen from the repository's root.
    """
    tables, entries = [], []
    for preset, chosen in choose(record).items():
        rate = RATES[preset]
        rule = "every ladder's reference" if rate is None else f"a frame's worth of time must buy {rate:g}"
        lines = [f"{preset}: {rule}", ""]
        for c in chosen:
            price = "price not measured" if math.isnan(c.price) else f"frame {100.0 * c.price:+.0f} %"
            lines.append(f"- {c.ladder} `{c.rung}`: {price}, off by {c.error:.2g}")
        tables.append("\n".join(lines))
        stages: dict[str, dict[str, str]] = {}
        for text in (text for c in chosen for text in c.settings):
            path, _, value = text.partition("=")
            stage, _, field = path.partition(".")
            stages.setdefault(stage, {})[field] = value
        inner = "\n".join(f"        {_literal(stage)}: {_entry(fields)}," for stage, fields in stages.items())
        entries.append(f"    {_literal(preset)}: {{\n{inner}\n    }},")
    return HEAD.format(
        name=name, device=record["device"], date=record["date"].split()[0], tables="\n\n".join(tables),
        entries="\n".join(entries),
    )  # fmt: skip


def _literal(text: str) -> str:
    return f'"{text}"'


def _entry(fields: dict[str, str]) -> str:
    return "{" + ", ".join(f"{_literal(field)}: {_literal(value)}" for field, value in fields.items()) + "}"


def write(root: Path, path: str | Path | None, out: Path | None, *, check: bool) -> Path | None:
    """Write the module if it is out of date; return it where it was, or with `check` would be, changed.

    Args:
        root: Folder of the repository.
        path: Result to make it from; that of a GPU, or else of a CPU, if left out.
        out: Where to write it; `MODULE` if left out.
        check: Write nothing.
    """
    given = source(root) if path is None else Path(path)
    inside = given.resolve().is_relative_to(root.resolve())
    name = given.resolve().relative_to(root.resolve()).as_posix() if inside else given.name
    text, target = module_text(read(given), name), out or root / MODULE
    if target.is_file() and target.read_text(encoding="utf-8") == text:
        return None
    if not check:
        target.write_text(text, encoding="utf-8")
    return target


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Callable[[str], Any],
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Measure what each preset costs and leaves on whole scenes.

    Args:
        device: Where to run.
        quick: Small cases, few repeats, and one scene.
        settings: Settings beside the preset's.
        note: Function of a text that tells how far it is.
        keep: Called with what is there after each scene, so that nothing measured is lost.

    Returns:
        A row for each scene and preset: time of the frame, RMSE and FLIP of its picture against that of `reference`.
    """
    rows: list[dict[str, Any]] = []
    size = stand_size(device.is_cuda, quick)
    for name in MEASURED[: 1 if quick else None]:
        chosen = SCENES[name].chosen(device.is_cuda, quick)
        renderer = open_scene(SCENES[name].build(chosen), size, device, ("display",))
        pictures, times = {}, {}
        # The reference first: without it nothing can be said of the others.
        for preset in reversed(RATES):
            note(f"{preset} on {name}")
            counts = QUICK_COUNTS if quick else COUNTS if preset == "reference" else ()
            plan = plan_of(renderer, settings.replace(preset=preset).with_values(list(counts)))
            times[preset] = whole_frame(plan, 3 if quick else REPEATS, None)
            pictures[preset] = plan.outputs["display"].numpy()[0].copy()
        for preset in RATES:
            row = {"preset": preset, "scene": name, "source": chosen, "width": size[0], "height": size[1]}
            errors = picture_errors(pictures[preset], pictures["reference"])
            rows.append(row | times[preset].metrics("frame") | {f"error.{k}": v for k, v in errors.items()})
        if keep:
            keep({"rows": rows})
    return {"rows": rows}
