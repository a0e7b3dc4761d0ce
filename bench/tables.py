"""Markdown tables made from results; every number comes from a result or, marked as quoted, from `targets`."""

from __future__ import annotations

from typing import Any

from .accuracy_tables import accuracy_table, overview_table
from .effect_tables import effects_table
from .fit_tables import fit_table, presets_table
from .frame import pass_names
from .layout import count_text, markdown, megabytes, milliseconds, spread, verdict
from .peer_tables import peers_overview, peers_table
from .record import Record
from .scaling_tables import scaling_overview, scaling_table
from .targets import FRAME_TARGETS, GUARD_TARGET_PERCENT, HOST_TARGET_US, LIGHT_TARGETS_MS, TRIANGLE_QUOTES

__all__ = ["frames_table", "full_table", "milliseconds", "provenance", "short_table"]

Row = dict[str, Any]


def provenance(record: Record) -> str:
    """Tell where, with what and when a result was measured."""
    parts = [record["device"], f"Warp {record['warp']}", record["driver"], f"commit {record['commit']}", record["date"]]
    text = ", ".join(p for p in parts if p) + f"; {record['machine']}"
    if "copy_bytes_per_s" in record:
        text += f"; copy bandwidth {record['copy_bytes_per_s'] / 1e9:,.0f} GB/s"
    if record["settings"]:
        text += f"; settings {', '.join(record['settings'])}"
    return text + ("; **a quick run on small cases**" if record["quick"] else "")


def full_table(record: Record) -> str:
    """Every row of a result, as Markdown."""
    return _FULL[record["bench"]](record)


def short_table(record: Record) -> str:
    """What a reader wants first of a result, as Markdown."""
    return _SHORT.get(record["bench"], _FULL[record["bench"]])(record)


def _triangles(record: Record, full: bool = True) -> str:
    columns = ["case (ms)", ">ours"] + [">5 % to 95 %", ">raster alone", ">of memory floor"] * full
    columns += [">must reach*", ">one path*", ">two paths*", ">nvdiffrast*", ">OpenGL*"]
    columns += [">large triangles", ">bin entries"] * full
    rows = []
    for row in record["rows"]:
        quote = TRIANGLE_QUOTES[row["case"]]
        line = [row["title"], f"**{milliseconds(row['total.ms'])}**"]
        if full:
            line += [spread(row, "total"), milliseconds(row["raster.ms"]), f"{row['times_floor']:.1f} x"]
        line.append(verdict(record, row["total.ms"], quote.must_reach))
        quoted = (quote.one_path, quote.two_paths, quote.nvdiffrast, quote.opengl)
        line += ["" if q is None else f"{q:g}" for q in quoted]
        if full:
            for name in ("large_triangles", "bin_entries"):
                line.append(count_text(row[f"raster.{name}"]) if f"raster.{name}" in row else "")
        rows.append(line)
    note = "\\* quoted: measured earlier on one H200, with prototypes and with the other programs, not in this run."
    return f"{markdown(columns, rows)}\n\n{note}"


def _tiles(record: Record, full: bool = True) -> str:
    rows = record["rows"]
    sizes = list(dict.fromkeys(r["tile_size"] for r in rows))
    names = list(dict.fromkeys(r["resolution"] for r in rows))
    if not full:
        names = ["1080p"] if "1080p" in names else names[:1]
    parts = []
    for name in names:
        columns = [">lights"] + [f">{s} px" for s in sizes]
        lines = []
        of_name = [r for r in rows if r["resolution"] == name]
        for lights in dict.fromkeys(r["lights"] for r in of_name):
            cells = {r["tile_size"]: r for r in of_name if r["lights"] == lights}
            best = min(cells, key=lambda s: cells[s]["total.ms"])
            lines.append([count_text(lights)] + [_tile_cell(cells[s], s == best) if s in cells else "" for s in sizes])
        size = f"{of_name[0]['width']}x{of_name[0]['height']}"
        parts.append(f"{size}, by side of a tile:\n\n{markdown(columns, lines)}")
    legend = "Total ms (culling + shading), then lights a tile considers: mean, most. The best of a row is bold."
    return "\n\n".join([*parts, legend])


def _tile_cell(row: Row, best: bool) -> str:
    total = milliseconds(row["total.ms"])
    parts = f"{milliseconds(row['light_culling.ms'])} + {milliseconds(row['shade.ms'])}"
    lights = f"{row['tile.lights_mean']:.1f}, {row['tile.lights_max']}"
    return f"{f'**{total}**' if best else total} ({parts}); {lights}"


def _lights(record: Record) -> str:
    columns = [
        ">lights", ">mean wanted", ">mean measured", ">most", ">cull ms", ">shade ms", ">total ms", ">5 % to 95 %",
        ">must reach*", ">brute force ms",
    ]  # fmt: skip
    rows = []
    for row in record["rows"]:
        rows.append([
            count_text(row["lights"]), f"{row['mean']:g}", f"{row['lit.mean']:.1f}", str(row["lit.max"]),
            milliseconds(row["light_culling.ms"]), milliseconds(row["shade.ms"]),
            f"**{milliseconds(row['total.ms'])}**", spread(row, "total"),
            verdict(record, row["total.ms"], LIGHT_TARGETS_MS.get((row["lights"], int(row["mean"])))),
            milliseconds(row["brute_force.ms"]) if "brute_force.ms" in row else "",
        ])  # fmt: skip
    note = "Total: staging, culling and shading as one graph; brute force: the same with every light everywhere."
    return f"{markdown(columns, rows)}\n\n{note}\n\n\\* on one H200 at 1920x1080."


def frames_table(record: Record) -> str:
    """Whole frames, one a line."""
    columns = ["frame", ">ms", ">5 % to 95 %", ">must reach*", ">of memory floor", ">lit lights", ">memory", ">scene"]
    rows = []
    for row in record["rows"]:
        target = FRAME_TARGETS.get(row["case"])
        rows.append([
            row["title"], f"**{milliseconds(row['frame.ms'])}**", spread(row, "frame"),
            verdict(record, row["frame.ms"], target.ms if target else None), f"{row['frame.times_floor']:.1f} x",
            f"{row['lit.mean']:.1f}", _memory(record, row), megabytes(row["scene.bytes"]),
        ])  # fmt: skip
    note = "Lit lights: mean at a pixel with a surface. Memory: on the device, beside the scene."
    stated = "\\* on the machine the figure is stated for: one H200, or two CPU cores."
    return f"{markdown(columns, rows)}\n\n{note}\n\n{stated}"


def _memory(record: Record, row: Row) -> str:
    target = FRAME_TARGETS.get(row["case"])
    text = megabytes(row["memory.bytes"])
    if target is None or target.memory_bytes is None:
        return text
    return f"{text} ({verdict(record, row['memory.bytes'] / 1e6, target.memory_bytes / 1e6)})"


def _frame(record: Record) -> str:
    parts = [frames_table(record)]
    columns = ["pass", ">ms", ">5 % to 95 %", ">moved", ">floor ms", ">of floor"]
    for row in record["rows"]:
        lines = [_pass_line(row, f"pass.{name}", f"`{name}`") for name in pass_names(row)]
        lines.append(["sum of passes", milliseconds(row["passes.sum_ms"]), "", "", "", ""])
        lines.append(_pass_line(row, "frame", "**whole frame**"))
        triangles, lights = count_text(row["triangles"]), count_text(row["lights"])
        heading = (
            f"**{row['title']}** ({triangles} triangles, {lights} lights, {row['coverage']:.0%} of the picture covered)"
        )
        parts.append(f"{heading}\n\n{markdown(columns, lines)}")
    return "\n\n".join(parts)


def _pass_line(row: Row, key: str, label: str) -> list[str]:
    factor = f"{row[f'{key}.times_floor']:.1f} x" if f"{key}.times_floor" in row else ""
    return [
        label, milliseconds(row[f"{key}.ms"]), spread(row, key), megabytes(row[f"{key}.bytes"]),
        milliseconds(row[f"{key}.floor_ms"]), factor,
    ]  # fmt: skip


def _host(record: Record) -> str:
    rows = []
    for row in record["rows"]:
        low, high = f"{row['host.us_p5']:,.1f}", f"{row['host.us_p95']:,.1f}"
        target = HOST_TARGET_US if row["figure"] == "render" and not record["device"].startswith("CPU") else None
        rows.append(
            [row["text"], f"**{row['host.us']:,.1f}**", f"{low} to {high}", verdict(record, row["host.us"], target)]
        )
    return markdown(["figure", ">median µs", ">5 % to 95 %", ">must reach"], rows)


def _guards(record: Record) -> str:
    columns = [
        "frame",
        ">with guards, ms",
        ">range",
        ">without",
        ">range",
        ">guards cost",
        ">must reach",
        ">bytes differ",
    ]
    lines = []
    for row in record["rows"]:
        line = [row["title"]]
        for kind in ("guarded", "bare"):
            line += [milliseconds(row[f"{kind}.ms"]), spread(row, kind)]
        cost = row["guards.percent"]
        line += [f"**{cost:+.1f} %**", verdict(record, cost, GUARD_TARGET_PERCENT), count_text(row["differing_bytes"])]
        lines.append(line)
    return f"{markdown(columns, lines)}\n\nTaken out: {'; '.join(record['guards'])}."


def _effects(record: Record) -> str:
    frames = [row for row in record["rows"] if row["kind"] == "frame"]
    return "\n\n".join([effects_table(record)] + [_frame(record | {"rows": frames})] * bool(frames))


_FULL = {
    "triangles": _triangles, "tiles": _tiles, "lights": _lights, "frame": _frame, "host": _host, "effects": _effects,
    "accuracy": accuracy_table, "peers": peers_table, "scaling": scaling_table,
    "fit": fit_table, "presets": presets_table, "guards": _guards,
}  # fmt: skip
_SHORT = {
    "triangles": lambda record: _triangles(record, full=False),
    "tiles": lambda record: _tiles(record, full=False),
    "frame": frames_table,
    "accuracy": overview_table,
    "peers": peers_overview,
    "scaling": scaling_overview,
}
