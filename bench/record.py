"""Results as JSON: what was run where, when and at which commit, and one row a figure, laid out for `git diff`."""

from __future__ import annotations

import datetime
import json
import math
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import warp as wp

from warp_deferred.errors import LoadError

__all__ = ["REQUIRED", "header", "read", "write"]

ROOT = Path(__file__).resolve().parents[1]
#: Keys every result has.
REQUIRED = ("bench", "machine", "device", "warp", "driver", "commit", "date", "quick", "settings", "rows")

Record = dict[str, Any]


def header(bench: str, device: wp.Device, *, quick: bool, settings: list[str]) -> Record:
    """Describe a run, all but its rows.

    Args:
        bench: Name of the bench.
        device: Where it ran.
        quick: Whether small cases stood in for the frozen ones.
        settings: Settings that differ from the defaults, as given on the command line.
    """
    return {
        "bench": bench,
        "machine": _machine(),
        "device": device.name if device.is_cuda else f"CPU, {_cores()} cores",
        "warp": wp.config.version,
        "driver": _driver(device),
        "commit": _commit(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "quick": quick,
        "settings": list(settings),
    }


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _machine() -> str:
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass  # no such file outside Linux
    return f"{platform.system()} {platform.machine()}, {model}, {_cores()} cores"


def _driver(device: wp.Device) -> str:
    if not device.is_cuda:
        return ""
    versions = [("CUDA driver", wp.get_cuda_driver_version()), ("toolkit", wp.get_cuda_toolkit_version())]
    return ", ".join(f"{name} {'.'.join(map(str, v))}" for name, v in versions if v)


def _commit() -> str:
    """Commit of the tree, with `-dirty` where files differ; `$WD_COMMIT` names it for a copy that is no checkout."""
    if named := os.environ.get("WD_COMMIT"):
        return named
    try:
        name = _git("rev-parse", "--short=12", "HEAD")
        # Results change while benches run one after another; they alone make no tree dirty.
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!bench/results")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{name}-dirty" if changed else name


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def write(path: str | os.PathLike[str], record: Record) -> Path:
    """Write a result, whole or not at all: one line a key, one line a row."""
    target = Path(path)
    lines = []
    for key, value in record.items():
        if isinstance(value, list) and value and isinstance(value[0], (dict, str)):
            inner = ",\n".join("  " + _dumps(item) for item in value)
            lines.append(f" {json.dumps(key)}: [\n{inner}\n ]")
        else:
            lines.append(f" {json.dumps(key)}: {_dumps(value)}")
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        temporary.replace(target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise LoadError(
            f"{target}: expected a file that can be written, got {error.strerror}; check the path"
        ) from None
    return target


def _dumps(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def read(path: str | os.PathLike[str]) -> Record:
    """Read a result back.

    Raises:
        LoadError: If it is no JSON, or a key is missing, or a row is none or holds a number that is not finite.
    """
    source = Path(path)
    try:
        record = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LoadError(f"{source}: expected a result of a bench, got {error}; run the bench again") from None
    missing = [key for key in REQUIRED if key not in record] if isinstance(record, dict) else list(REQUIRED)
    if missing or not isinstance(record["rows"], list):
        raise LoadError(
            f"{source}: expected the keys {', '.join(REQUIRED)}, got none of {missing}; run the bench again"
        )
    for k, row in enumerate(record["rows"]):
        if not isinstance(row, dict):
            raise LoadError(f"{source}: rows[{k}]: expected figures by name, got {row!r}; run the bench again")
        for name, value in row.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise LoadError(
                    f"{source}: rows[{k}].{name}: expected a finite number, got {value}; run the bench again"
                )
    return record
