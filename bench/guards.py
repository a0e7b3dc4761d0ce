"""Bench `guards`: what the guards that are always on cost a frame.

A guard is a line of a kernel that only matters where input is bad: a test for NaN or Inf, a clamp before a cast, the
bounds of an interpolation. The package is copied twice, once as it is and once with each of GUARDS taken out, and both
copies render the same frames in processes of their own, in turns. Their pictures are compared, too: on good input
guards must change nothing that is seen.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Settings
from warp_deferred.errors import Error

from .cases import FrameCase, frame_cases
from .effect_cases import CompositeCase, composite_cases
from .probe import open_scene, plan_of
from .record import ROOT, Record
from .timing import REPEATS, Timing, time_program

__all__ = ["GUARDS", "Guard", "run", "without_guards"]

#: Where the parts of the package lie in a copy, as they do once installed.
PLACES = {"warp_deferred": "warp_deferred", "kernels": "warp_deferred/kernels", "scenes": "warp_deferred/scenes"}
#: How often each copy takes its turn.
TURNS = 3


@dataclasses.dataclass(frozen=True)
class Guard:
    """A line of a kernel that bad input needs.

    Attributes:
        file: File in kernels/.
        line: The line, or a part of it that is there once.
        bare: The same without the guard.
        keeps: What it keeps out, in words.
    """

    file: str
    line: str
    bare: str
    keeps: str

    def removed(self, text: str) -> str:
        """Text of the file without the guard.

        Raises:
            Error: If the line is not there exactly once.
        """
        if (count := text.count(self.line)) != 1:
            raise Error(f"guard of kernels/{self.file}: expected {self.line!r} once, got it {count} times; adapt it")
        return text.replace(self.line, self.bare)


_NEVER, _ALWAYS = "if wp.static(False):", "if wp.static(True):"
GUARDS = (
    Guard("clusters.py", "result.drawn = wp.where(finite, 1, 0)", "result.drawn = 1", "transforms that are not finite"),
    Guard("clusters.py", "if not (wp.isfinite(center[0] + center[1] + center[2]) and wp.isfinite(radius)):", _NEVER,
          "spheres that are not finite"),
    Guard("raster.py", "if not (wp.isfinite(c0) and wp.isfinite(c1) and wp.isfinite(c2)):", _NEVER,
          "vertices that are not finite, near the clipping planes"),
    Guard("raster.py", "if wp.isfinite(s0) and wp.isfinite(s1) and wp.isfinite(s2):", _ALWAYS,
          "vertices that are not finite"),
    Guard("coverage.py", "wp.clamp(position_px, -GUARD_BAND_PX, GUARD_BAND_PX)", "position_px",
          "positions that no integer holds"),
    Guard("interpolation.py", "if not wp.isfinite(scale):", _NEVER, "triangles that cancel to nothing"),
    Guard("interpolation.py", "if not wp.isfinite(inverse):", _NEVER, "derivatives of such triangles"),
    Guard("interpolation.py", "def mix3(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):",
          "def mix3(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):\n"
          "    return a + (b - a) * w[1] + (c - a) * w[2]\n\n\n"
          "@wp.func\ndef bounded_mix3(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):",
          "interpolated values past those of the vertices"),
    Guard("resolve.py", "if square > 1.0e-30 and square < 1.0e30:", _ALWAYS, "normals without a length"),
    Guard("image.py",
          "return wp.vec3(finite_radiance(v[0], limit), finite_radiance(v[1], limit), finite_radiance(v[2], limit))",
          "return v", "radiance that is not finite, or more than half holds"),
    Guard("shadow.py", "if wp.isfinite(low) and wp.isfinite(high):", _ALWAYS, "bounds that are not finite"),
    Guard("ambient_visibility.py", "if not (open_total > 0.0 and wp.isfinite(total)):", _NEVER,
          "slices that see nothing, sums that are not finite"),
    Guard("bloom_bright.py",
          "if not (wp.where(lowest < 0.0, wp.inf, value[0] + value[1] + value[2]) <= MAX_FLOAT):", _NEVER,
          "radiance that would spread NaN"),
    Guard("color.py", '    """NaN to 0, then [0, 65504] per channel."""\n',
          '    """Nothing."""\n    return v\n\n\n@wp.func\ndef bounded_radiance(v: wp.vec3):\n    """Bounds."""\n',
          "values that no curve takes"),
)  # fmt: skip


def without_guards(folder: Path) -> None:
    """Take all guards out of a copy of kernels/.

    Raises:
        Error: If one is not there as GUARDS has it.
    """
    for guard in GUARDS:
        path = folder / guard.file
        path.write_text(guard.removed(path.read_text(encoding="utf-8")), encoding="utf-8")


def _cases(device_is_cuda: bool, quick: bool) -> list[FrameCase | CompositeCase]:
    composite = composite_cases(device_is_cuda, quick=quick)
    return [frame_cases(device_is_cuda, quick=quick)[0], composite[0]]


def run(device: wp.Device, *, quick: bool, settings: Settings, note: Callable[[str], Any]) -> Record:
    """Time frames with and without guards, in turns.

    Args:
        device: Where to run.
        quick: Small frames, one turn.
        settings: Settings of all frames.
        note: Function of a text that tells how far it is.

    Returns:
        A row a frame: medians over the turns of the medians of each, their spread, what guards cost, and how many
        bytes of the picture differ without them.

    Raises:
        Error: If a copy cannot render, or a guard is no longer in the kernels.
    """
    turns: dict[str, list[list[dict[str, Any]]]] = {"guarded": [], "bare": []}
    with tempfile.TemporaryDirectory(prefix="guards-") as name:
        for kind in turns:
            _copy(Path(name) / kind)
        without_guards(Path(name) / "bare" / PLACES["kernels"])
        for turn in range(1 if quick else TURNS):
            for kind, found in turns.items():
                note(f"{kind}, turn {turn + 1}")
                found.append(_render(Path(name) / kind, str(device), quick, settings))
        rows = _rows(turns["guarded"], turns["bare"])
    return {"guards": [f"{g.file}: {g.keeps}" for g in GUARDS], "rows": rows}


def _copy(folder: Path) -> None:
    """Copy the package, laid out so that `warp_deferred` is found in the folder before the installed one."""
    for source, place in PLACES.items():
        shutil.copytree(ROOT / source, folder / place, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)


def _render(folder: Path, device: str, quick: bool, settings: Settings) -> list[dict[str, Any]]:
    """Let a process of a copy's own time the frames and write their pictures there."""
    places = [str(folder), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-m", "bench.guards", str(folder), device, "quick" if quick else "whole"],
        input=settings.model_dump_json(), env=os.environ | {"PYTHONPATH": os.pathsep.join(places)},
        cwd=folder, text=True, capture_output=True,
    )  # fmt: skip
    if done.returncode != 0:
        raise Error(f"guards: a copy could not render: {(done.stderr.strip() or 'no message').splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def _rows(guarded: list[list[dict[str, Any]]], bare: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Rows of what the copies' turns gave."""
    rows = []
    for k, first in enumerate(guarded[0]):
        row = {name: first[name] for name in ("case", "title", "width", "height")}
        medians = {}
        for kind, turns in (("guarded", guarded), ("bare", bare)):
            timing = Timing.of([turn[k]["ms"] for turn in turns])
            medians[kind] = timing.median
            row |= timing.metrics(kind)
        row["guards.percent"] = round(100.0 * (medians["guarded"] / medians["bare"] - 1.0), 2)
        pictures = [np.frombuffer(Path(turns[0][k]["picture"]).read_bytes(), np.uint8) for turns in (guarded, bare)]
        row["differing_bytes"] = int(np.count_nonzero(pictures[0] != pictures[1]))
        rows.append(row)
    return rows


def _child(folder: Path, device: str, quick: bool, settings: Settings) -> list[dict[str, Any]]:
    """Time the frames in the package that this process imports."""
    import warp_deferred

    if not Path(warp_deferred.__file__).is_relative_to(folder):
        raise Error(f"expected warp_deferred from {folder}, got {warp_deferred.__file__}")
    wp.config.log_level = wp.LOG_WARNING
    found = []
    for case in _cases(wp.get_device(device).is_cuda, quick):
        renderer = open_scene(case.build(), (case.width, case.height), device, ("display",))
        more = case.assignments() if isinstance(case, CompositeCase) else []
        plan = plan_of(renderer, settings.with_values(more))
        timing = time_program(plan.resources.program, repeats=5 if quick else REPEATS)
        picture = folder / f"{case.name}.bytes"
        picture.write_bytes(plan.outputs["display"].numpy().tobytes())
        about = {"case": case.name, "title": case.title, "width": case.width, "height": case.height}
        found.append(about | {"ms": round(timing.median, 5), "picture": str(picture)})
    return found


if __name__ == "__main__":
    place, chosen, size = sys.argv[1:]
    print(json.dumps(_child(Path(place), chosen, size == "quick", Settings.model_validate_json(sys.stdin.read()))))
