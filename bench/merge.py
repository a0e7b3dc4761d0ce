"""Joins results of one bench, such as runs with `--only`, into one: later rows take the place of earlier ones.

Rows belong together if a reader could take them for those of one run: the same bench, layout, device, version of Warp
and driver, settings, and full or quick. The commit may differ, since that is what a part is measured anew for; the
joined result names all of them. A row's name is that of `bench compare`. Rows of `accuracy` whose ladder no longer has
their rung are left out: no run would make them. A list of what was skipped is joined too, less what another result has
measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warp_deferred.errors import InputError

from .compare import row_name
from .ladders import LADDERS, SCENES
from .record import Record

__all__ = ["merge"]

#: What must be the same, with what to do where it is not.
ALIKE = {
    "bench": "join results of one bench",
    "format": "run the older one again",
    "device": "measure both on one device",
    "warp": "measure both with one version",
    "driver": "measure both with one version",
    "quick": "leave --quick out of both, or of neither",
    "settings": "give both the same --set",
}
#: Of the CPU, and of what host threads do, the machine is the device.
HOST = "host"


def merge(records: Sequence[Record], names: Sequence[str]) -> Record:
    """Join results; a row of a later one takes the place of that of the same name.

    Args:
        records: What `record.read` returned, at least one, earlier before later.
        names: Their files, for errors.

    Returns:
        A result: the head of the last one, commits of all, rows in the order of their ladders or of the files.

    Raises:
        InputError: If two are of different runs: bench, layout, device, versions, settings, size.
    """
    if not records:
        raise InputError("merge: expected at least one result, got none; name the files to be joined")
    first, last = records[0], records[-1]
    alike = dict(ALIKE)
    if first["device"].startswith("CPU") or first["bench"] == HOST:
        alike["machine"] = "measure both on one machine"
    for record, name in zip(records[1:], names[1:], strict=True):
        for key, mend in alike.items():
            if record.get(key) != first.get(key):
                raise InputError(
                    f"{name}: {key}: expected {first.get(key)!r}, as in {names[0]}, got {record.get(key)!r}; {mend}"
                )
    rows: dict[str, dict[str, Any]] = {}
    for record, name in zip(records, names, strict=True):
        own = [row_name(record["bench"], row) for row in record["rows"]]
        if len(set(own)) != len(own):
            twice = next(text for text in own if own.count(text) > 1)
            raise InputError(f"{name}: expected one row named {twice!r}, got {own.count(twice)}; run the bench again")
        rows |= dict(zip(own, record["rows"], strict=True))
    result = last | {"commit": ", ".join(dict.fromkeys(part for r in records for part in r["commit"].split(", ")))}
    result["rows"] = _ordered(list(rows.values())) if first["bench"] == "accuracy" else list(rows.values())
    if any("skipped" in record for record in records):
        result["skipped"] = _skipped(records, result["rows"])
    return result


def _ordered(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of `accuracy` as a whole run has them: by ladder and scene, from cheap to reference."""
    rungs = {name: [rung.name for rung in ladder.rungs] for name, ladder in LADDERS.items()}
    known, scenes = list(LADDERS), list(SCENES)
    kept = [row for row in rows if row["rung"] in rungs.get(row["ladder"], [])]
    return sorted(
        (row for row in kept if row["scene"] in SCENES),
        key=lambda row: (
            known.index(row["ladder"]), scenes.index(row["scene"]), rungs[row["ladder"]].index(row["rung"])
        ),
    )  # fmt: skip


def _skipped(records: Sequence[Record], rows: list[dict[str, Any]]) -> list[str]:
    """Texts of what was skipped, `ladder on scene: why` or `ladder.rung on scene: why`, and is in no result."""
    measured = {f"{row['ladder']}{rung} on {row['scene']}" for row in rows if {"ladder", "scene", "rung"} <= set(row)
                for rung in ("", f".{row['rung']}")}  # fmt: skip
    texts = dict.fromkeys(text for record in records for text in record.get("skipped", []))
    return [text for text in texts if text.partition(": ")[0] not in measured]
