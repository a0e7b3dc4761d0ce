"""Tables of the bench `scaling`: every point, and the growth fitted to each axis."""

from __future__ import annotations

from typing import Any

from .layout import count_text, markdown, megabytes, milliseconds, spread
from .record import Record

__all__ = ["fit_of", "power", "scaling_overview", "scaling_table"]

Row = dict[str, Any]

#: What shapes the curves, by axis.
REMARKS = {
    "triangles": "Passes after `raster` work by the pixel and know nothing of triangles; with fewer triangles than "
    "pixels they hide what `raster` costs.",
    "lights": "As many lights reach a pixel however many there are, so that `shade` grows only as tiles hold more of "
    "them in vain; `light_culling` looks at all of them, coarse tiles first.",
    "pixels": "Small pictures do not fill a GPU, and a tile, which has a fixed number of pixels, sees the more of the "
    "scene and of its lights the fewer pixels there are: they need not be cheaper.",
    "views": "All views are drawn by the same launches, so that a few small ones cost little more than one.",
}


def fit_of(record: Record, axis: str, figure: str) -> Row | None:
    """Fit of a figure along an axis; None where there were too few points."""
    return next((f for f in record["fits"] if (f["axis"], f["figure"]) == (axis, figure)), None)


def power(count: float) -> str:
    """A number of things, from 10 000 on in short."""
    value = int(count)
    for name, size in (("G", 10**9), ("M", 10**6), ("k", 10**3)):
        if value >= 10 * size or value >= size > 10**3:
            return f"{value / size:.3g} {name}"
    return count_text(value)


def _price(milliseconds_each: float) -> str:
    """Milliseconds each, in the unit in which they have digits before the point."""
    for unit, size in (("ms", 1.0), ("µs", 1e-3), ("ns", 1e-6), ("ps", 1e-9)):
        if abs(milliseconds_each) >= size or unit == "ps":
            return f"{milliseconds_each / size:.3g} {unit}"
    raise AssertionError


def _model(fit: Row | None) -> str:
    """Fixed cost and price of one more, and how far the points are from that."""
    if fit is None:
        return ""
    return f"{milliseconds(fit['fixed'])} ms + {_price(fit['each'])} each, off by {fit['error']:.0%}"


def _bytes_each(fit: Row | None) -> str:
    if fit is None:
        return ""
    each = f"{fit['each']:.3g} B" if abs(fit["each"]) < 1e3 else megabytes(fit["each"])
    return f"{megabytes(fit['fixed'])} + {each} each"


def _exponent(fit: Row | None) -> str:
    return "" if fit is None else f"n^{fit['exponent']:.2f} from {power(fit['from_n'])} on"


def scaling_overview(record: Record) -> str:
    """One line an axis: its range, what the ends take, and how time and memory grow."""
    columns = ["varied", ">from", ">to", ">ms", ">time grows as", ">time", ">memory grows as", ">memory"]
    lines = []
    for axis in record["axes"]:
        rows = [row for row in record["rows"] if row["axis"] == axis["axis"]]
        if not rows:
            continue
        time, held = (fit_of(record, axis["axis"], figure) for figure in ("frame.ms", "bytes"))
        ends = f"{milliseconds(rows[0]['frame.ms'])} to {milliseconds(rows[-1]['frame.ms'])}"
        lines.append([
            axis["axis"], power(rows[0]["n"]), power(rows[-1]["n"]), ends, _exponent(time), _model(time),
            _exponent(held), _bytes_each(held),
        ])  # fmt: skip
    note = (
        "Exponents by least squares of logarithms over the upper half of the points; fixed cost and price by least "
        "squares of relative errors over all. Memory with the scene's; of triangles, those stored once."
    )
    return f"{markdown(columns, lines)}\n\n{note}"


def scaling_table(record: Record) -> str:
    """The overview, then every point of each axis, with the growth of each pass."""
    parts = [scaling_overview(record)]
    columns = [">n", ">size", ">ms", ">5 % to 95 %", ">each", ">memory", ">scene", ">build s"]
    for axis in record["axes"]:
        rows = [row for row in record["rows"] if row["axis"] == axis["axis"]]
        lines = [
            [
                power(row["n"]),
                f"{row['width']}x{row['height']}" + (f" x {row['views']}" if row["views"] > 1 else ""),
                f"**{milliseconds(row['frame.ms'])}**", spread(row, "frame"), _price(row["frame.ms"] / row["n"]),
                megabytes(row["memory.bytes"]), megabytes(row["scene.bytes"]), f"{row['build.s']:g}",
            ]
            for row in rows
        ]  # fmt: skip
        grown = [
            f"`{f['figure'].split('.')[1]}` n^{f['exponent']:.2f}"
            for f in record["fits"]
            if f["axis"] == axis["axis"] and f["figure"].startswith("pass.")
        ]
        text = f"**{axis['axis']}**: {axis['fixed']}. {REMARKS[axis['axis']]}\n\n{markdown(columns, lines)}"
        parts.append(text + (f"\n\nBy pass: {', '.join(grown)}." if grown else ""))
    parts.append("Memory: on the device, beside the scene. Build: host time of scene, plan and first frame.")
    if record["skipped"]:
        parts.append("Skipped:\n\n" + "\n".join(f"- {text}" for text in record["skipped"]))
    return "\n\n".join(parts)
