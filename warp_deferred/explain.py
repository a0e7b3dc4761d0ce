"""Reports for people: what a plan runs and why, and where its memory is."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

from .device_scene import DeviceScene
from .plan import Plan
from .scene import Scene
from .selection import PassReport

__all__ = ["Explanation", "MemoryReport", "table"]


def _size(count: int | None) -> str:
    if count is None:
        return ""
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"


def table(title: str, columns: list[tuple[str, str]], rows: list[list[str]]) -> str:
    """Lay out a table for the screen; a column is its name and the side it is aligned to."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, header_style="bold", pad_edge=False)
    for name, side in columns:
        table.add_column(name, justify=side, no_wrap=name != "why")
    for row in rows:
        table.add_row(*row)
    stream = io.StringIO()
    Console(file=stream, width=110, color_system=None).print(table)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def _mask_bands(plan: Plan) -> int:
    """Bands the light masks come in; 0 without masks."""
    return next((len(stage.bands) for stage in plan.passes if stage.name == "light_culling"), 0)


@dataclasses.dataclass(frozen=True)
class Explanation:
    """What runs, why, and what it costs; `str()` is a table.

    Attributes:
        title: The scene and the device.
        rows: One report a pass, in frame order.
        notes: Counts and remarks.
    """

    title: str
    rows: list[PassReport]
    notes: list[str]

    @classmethod
    def of(cls, scene: Scene, plan: Plan, rows: list[PassReport]) -> Explanation:
        """Gather a plan's reports."""
        sizes = plan.layout.sizes[: plan.request.cameras]
        views = f"{len(sizes)} views of " if len(sizes) > 1 else ""
        size = "{}x{}".format(*sizes[0].shown)
        title = f"{scene.name or 'scene'} at {views}{size} on {plan.resources.device}"
        notes = [
            f"{plan.resources.scene.triangle_count:,} triangles in {plan.resources.scene.cluster_slots:,} clusters, "
            f"{plan.resources.scene.instance_count:,} instances, {len(scene.lights):,} lights",
            f"buffers {_size(plan.bytes)} beside the scene's {_size(plan.resources.scene.bytes)}",
        ]
        if rays := plan.resources.scene.ray_bytes:
            notes.append(f"trees for rays {_size(rays)}")
        if sizes[0].shown_width:
            notes.append(f"rendered at {sizes[0].width}x{sizes[0].height} and scaled up")
        if (bands := _mask_bands(plan)) > 1:
            notes.append(
                f"light masks come in {bands} bands of tiles, culled and timed with shade; "
                "light_culling.mask_budget_bytes holds them all in one if raised"
            )
        if plan.replays > 1:
            notes.append(f"the passes between start and average run {plan.replays} times; figures are of all of them")
        notes += plan.counters()
        return cls(title, rows, notes + list(scene.notes))

    def __str__(self) -> str:
        total = [r.milliseconds for r in self.rows if r.milliseconds is not None]
        rows = [
            [
                r.name,
                "-" if not r.runs else "skipped" if r.active is False else "runs",
                r.rung,
                "" if r.milliseconds is None else f"{r.milliseconds:.3f}",
                _size(r.bytes) if r.runs else "",
                r.reason,
            ]
            for r in self.rows
        ]
        if total:
            rows.append(["sum", "", "", f"{sum(total):.3f}", "", ""])
        columns = [
            ("pass", "left"),
            ("", "left"),
            ("rung", "left"),
            ("ms", "right"),
            ("bytes", "right"),
            ("why", "left"),
        ]
        return table(self.title, columns, rows) + "\n" + "\n".join(f"  {note}" for note in self.notes)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return {"title": self.title, "passes": [dataclasses.asdict(r) for r in self.rows], "notes": self.notes}


@dataclasses.dataclass(frozen=True)
class MemoryReport:
    """Device memory of a plan by buffer; `str()` is a table.

    Attributes:
        buffers: Name -> bytes the buffer needs by itself.
        shared: Bytes of the arena that transient buffers share.
        outputs: Bytes of the outputs.
        tables: Bytes of tables, views and lights.
        scene: Bytes of geometry, materials and textures.
        rays: Bytes of the trees that rays are traced against, Warp's own nodes included.
        mask_bands: Bands of tiles that the light masks come in; the mask buffers hold one. 0 without masks.
    """

    buffers: dict[str, int]
    shared: int
    outputs: int
    tables: int
    scene: int
    rays: int
    mask_bands: int

    @classmethod
    def of(cls, plan: Plan, scene: DeviceScene) -> MemoryReport:
        """Gather a plan's memory."""
        r = plan.resources
        tables = (
            sum(t.capacity for t in (r.blocks, r.tiles, r.coarse_tiles, r.bin_tiles)) + r.frame.bytes + r.lights.bytes
        )
        outputs = sum(a.capacity if a.capacity else a.size * 4 for a in (r.channels[n] for n in plan.outputs))
        own = dict(plan.memory), plan.arena.capacity, outputs, tables
        return cls(*own, scene.bytes, scene.ray_bytes, _mask_bands(plan))

    @property
    def total(self) -> int:
        """Bytes beside the scene."""
        return self.shared + self.outputs + self.tables

    def __str__(self) -> str:
        held = {}
        if self.mask_bands > 1:
            held = dict.fromkeys(("mask_words", "mask_summary", "mask_coarse"), f", 1 of {self.mask_bands} bands")
        ordered = sorted(self.buffers.items(), key=lambda kv: -kv[1])
        rows = [[name + held.get(name, ""), _size(size)] for name, size in ordered]
        rows += [["transient buffers share", _size(self.shared)], ["outputs", _size(self.outputs)]]
        rows += [["tables, views, lights", _size(self.tables)], ["beside the scene", _size(self.total)]]
        rows += [["scene", _size(self.scene)]] + [["trees for rays", _size(self.rays)]] * (self.rays > 0)
        return table("device memory", [("buffer", "left"), ("bytes", "right")], rows)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return dataclasses.asdict(self) | {"total": self.total}
