"""Tables of the bench `peers`: every row with who is faster, what each peer computes, and who is missing."""

from __future__ import annotations

from typing import Any

from .layout import markdown, milliseconds, spread, times
from .peers.cases import KINDS
from .record import Record
from .targets import PEER_TARGETS

__all__ = ["peers_overview", "peers_table", "titles"]

Row = dict[str, Any]


def titles(record: Record) -> dict[str, str]:
    """Name of each peer -> what it is called, in the order of the record; ours is `ours` whatever it does."""
    found = {row["peer"]: row["peer_title"] for row in record["rows"]}
    order = [peer["name"] for peer in record["peers"] if peer["name"] in found]
    return {name: found[name] if name != "ours" else "ours" for name in dict.fromkeys(order)}


def _reached(record: Record, row: Row) -> str:
    """The least that is wanted of a ratio, and whether it holds where the result is of the card it is stated for."""
    target = PEER_TARGETS.get((row["case"], row["peer"]))
    if target is None or "ratio" not in row:
        return ""
    stated = "H200" in record["device"] and not record["quick"]
    return f"≥ {target:g} x" + (f" {'✓' if row['ratio'] >= target else '✗'}" if stated else "")


def _ratio(row: Row) -> str:
    if "ratio" not in row:
        return ""
    text = times(row["ratio"])
    # Ours in another way, such as with kept maps, is no peer that wins.
    return f"{text}, faster" if row["ratio"] < 1.0 and not row["peer"].startswith("ours") else text


def peers_table(record: Record) -> str:
    """Every row, kind by kind, then what each peer is, and who is missing."""
    parts = []
    columns = ["case", "renderer", ">ms", ">5 % to 95 %", ">times ours", ">must reach*", ">depth agrees"]
    for kind, text in KINDS.items():
        rows = [row for row in record["rows"] if row["kind"] == kind]
        if not rows:
            continue
        lines, last = [], ""
        for row in rows:
            share = row.get("depth.agrees")
            agrees = "" if share is None else "everywhere" if share == 1.0 else f"{min(share, 0.99999):.3%}"
            case = row["title"] if row["title"] != last else ""
            time = milliseconds(row["time.ms"])
            own = row["peer"] == "ours"
            name = row["peer_title"] + (f" ({row['note']})" if "note" in row else "")
            lines.append([
                case, name, f"**{time}**" if own else time, spread(row, "time"), "" if own else _ratio(row),
                _reached(record, row), agrees,
            ])  # fmt: skip
            last = row["title"]
        parts.append(f"{text[0].upper()}{text[1:]}.\n\n{markdown(columns, lines)}")
    parts.append(
        "Depth agrees: share of pixels whose depth differs by at most 0.001 of ours, or that show the background in "
        "both.\n\n\\* on one H200."
    )
    parts += _descriptions(record)
    return "\n\n".join(parts)


def _descriptions(record: Record) -> list[str]:
    """What each peer computes, leaves out and is timed by, where it wins; who is missing and why."""
    parts = []
    for peer in record["peers"]:
        version = f" ({peer['version']})" if peer["version"] else ""
        lines = [f"**{peer['title']}**{version}", ""]
        lines.append(f"- computes {peer['computes']}")
        if peer["leaves_out"]:
            lines.append(f"- leaves out {peer['leaves_out']}")
        lines.append(f"- timed by {peer['method']}")
        if peer["wins"]:
            won = [
                f"{row['title']} ({times(row['ratio'])})"
                for row in record["rows"]
                if row["peer"] == peer["name"] and row.get("ratio", 1.0) < 1.0
            ]
            lines.append(f"- faster than ours here: {'; '.join(won) if won else 'nowhere'}. {peer['wins']}")
        parts.append("\n".join(lines))
    if record["skipped"]:
        parts.append("Missing:\n\n" + "\n".join(f"- {text}" for text in record["skipped"]))
    return parts


def peers_overview(record: Record) -> str:
    """One line a case: milliseconds of each renderer, and in brackets how many times ours that is."""
    names = titles(record)
    place = {(row["case"], row["peer"]): row for row in record["rows"]}
    lines = []
    for case, title in dict.fromkeys((row["case"], row["title"]) for row in record["rows"]):
        line = [title]
        for name in names:
            row = place.get((case, name))
            if row is None:
                line.append("")
            elif name == "ours":
                line.append(f"**{milliseconds(row['time.ms'])}**")
            else:
                target = _reached(record, row)
                ratio = f" ({times(row['ratio'])})" if "ratio" in row else ""
                line.append(f"{milliseconds(row['time.ms'])}{ratio}{f', {target}' if target else ''}")
        lines.append(line)
    return markdown(["case (ms)", *(f">{title}" for title in names.values())], lines)
