"""How numbers and tables are written in Markdown, for all benches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .record import Record

__all__ = ["count_text", "markdown", "megabytes", "milliseconds", "spread", "times", "verdict"]

Row = dict[str, Any]


def milliseconds(value: float) -> str:
    """Three significant digits, no exponent, nothing below a nanosecond."""
    if value == 0.0:
        return "0"
    # Rounded before counting, so that 0.09996 is 0.100 and not 0.1000.
    exponent = math.floor(math.log10(abs(float(f"{value:.2e}"))))
    return f"{value:,.{min(max(2 - exponent, 0), 6)}f}"


def spread(row: Row, name: str) -> str:
    """The 5th to the 95th percentile of a figure."""
    low, high = milliseconds(row[f"{name}.ms_p5"]), milliseconds(row[f"{name}.ms_p95"])
    return f"{low} to {high}" if low != high else low


def megabytes(count: float) -> str:
    """Bytes, as MB or kB."""
    return f"{count / 1e6:,.1f} MB" if abs(count) >= 1e5 else f"{count / 1e3:,.1f} kB"


def count_text(value: float) -> str:
    """A number of things, thousands apart."""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else f"{value:g}"


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a table; a column whose title starts with '>' is aligned right."""
    titles = [c.lstrip(">") for c in columns]
    rules = ["---:" if c.startswith(">") else "---" for c in columns]
    return "\n".join("| " + " | ".join(line) + " |" for line in (titles, rules, *rows))


def verdict(record: Record, value: float, limit: float | None) -> str:
    """The limit, and whether it holds where the result is of a machine the limit is stated for."""
    if limit is None:
        return ""
    stated = "H200" in record["device"] or record["device"].startswith("CPU, 2 cores")
    return f"≤ {limit:g}" + (f" {'✓' if value <= limit else '✗'}" if stated and not record["quick"] else "")


def times(value: float) -> str:
    """How many times another figure it is."""
    return f"{milliseconds(value)} x"
