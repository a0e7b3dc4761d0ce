"""What the command line prints of comparisons and built-in scenes."""

from __future__ import annotations

import importlib
import inspect
import io
from typing import Any

from .compare import Comparison

__all__ = ["comparison_text", "scene_list", "scene_text"]


def _table(columns: list[tuple[str, str]], rows: list[list[str]]) -> str:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False)
    for title, side in columns:
        table.add_column(title, justify=side)  # type: ignore[arg-type]
    for row in rows:
        table.add_row(*row)
    stream = io.StringIO()
    Console(file=stream, width=110, color_system=None).print(table)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def comparison_text(result: Comparison, actual: str, reference: str) -> str:
    """Lay out a comparison: verdict, problems, then a row per channel."""
    several = max(row.part for row in result.channels) > 0
    rows = [
        [
            f"{row.part}: {row.name}" if several else row.name,
            f"{row.max_error:.3g}",
            f"{row.rmse:.3g}",
            "equal" if row.rmse == 0.0 else f"{row.psnr:.1f}",
            f"{row.share_over:.4%}",
            f"({row.worst[0]}, {row.worst[1]})" if row.max_error > 0.0 else "",
        ]
        for row in result.channels
    ]
    columns = [("channel", "left")]
    columns += [(name, "right") for name in ("max", "rmse", "psnr [dB]", "over threshold", "worst pixel")]
    verdict = "equal within the tolerance" if result.ok else "DIFFERENT"
    flip = f"{result.flip_note} {result.flip:.5f}" if result.flip is not None else result.flip_note
    lines = [
        f"{actual} against {reference}: {verdict}",
        f"{result.share_over:.4%} of pixels over threshold {result.threshold:g}, {result.tolerance:.4%} allowed",
        flip,
        *(f"problem: {problem}" for problem in result.problems),
        _table(columns, rows),
    ]
    return "\n".join(lines)


def scene_list() -> list[dict[str, Any]]:
    """Return name, one line and parameters (name to default) of every built-in scene."""
    from .loading import built_in_scenes

    listed = []
    for name, line in built_in_scenes().items():
        build = importlib.import_module(f"warp_deferred.scenes.{name}").build
        parameters = {
            key: None if value.default is value.empty else value.default
            for key, value in inspect.signature(build).parameters.items()
            if value.kind in (value.KEYWORD_ONLY, value.POSITIONAL_OR_KEYWORD)
        }
        listed.append({"name": name, "line": line, "parameters": parameters})
    return listed


def scene_text(listed: list[dict[str, Any]]) -> str:
    """Lay out the list of scenes, and how to set a parameter."""
    if not listed:
        return "there are no built-in scenes"
    lines = []
    for scene in listed:
        lines.append(f"{scene['name']}: {scene['line']}")
        if scene["parameters"]:
            lines.append("    " + "  ".join(f"{key}={value}" for key, value in scene["parameters"].items()))
    example = next((s for s in listed if s["parameters"]), None)
    if example:
        key, value = next(iter(example["parameters"].items()))
        lines.append(f"\nparameters go after a question mark: '{example['name']}?{key}={value}'")
    return "\n".join(lines)
