"""Prices kept from one call to the next, in a file a scene, camera, size, device and version.

The folder is `$XDG_CACHE_HOME/warp-deferred`, or what the system has in its place; a file holds one survey as JSON. The
key names all that prices depend on, but not the moment: what moves from frame to frame is looked at anew when a choice
is verified. A file that cannot be read, is of another format or does not fit the ladders of this version is measured
anew and written over.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..features import Features
from ..renderer import Renderer
from ..settings import Settings
from .clock import Spread
from .ladders import EXACT, LADDERS, PIXEL_SAMPLES, SCALES
from .model import Grid, LadderPrices, Offer, Survey

__all__ = ["FORMAT", "folder", "load", "save", "signature"]

#: Number of the file's layout; files of another one are not read.
FORMAT = 3


def folder() -> Path:
    """Folder of the kept surveys; it need not exist."""
    home = Path.home()
    if named := os.environ.get("XDG_CACHE_HOME"):
        return Path(named) / "warp-deferred"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "warp-deferred" / "Cache"
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "warp-deferred"


def signature(renderer: Renderer, cameras: Any, settings: Settings) -> dict[str, Any]:
    """Everything that prices depend on, as plain data."""
    from .. import __version__

    scene, device = renderer.scene, renderer.device
    meshes = {id(instance.mesh): instance.mesh for instance in scene.instances}.values()
    shapes = hashlib.blake2b(digest_size=16)
    for mesh in meshes:
        for array in (mesh.positions, mesh.triangles):
            shapes.update(f"{array.shape}".encode())
            # Every so many-th number: enough to tell two shapes apart, and quick for millions.
            flat = array.reshape(-1)
            shapes.update(np.ascontiguousarray(flat[:: max(1, len(flat) // 4096)]).tobytes())
    return {
        "format": FORMAT,
        "versions": [__version__, wp.config.version],
        "device": [device.name, device.arch if device.is_cuda else 0, _driver(device), renderer.threads],
        "size": [renderer.width, renderer.height],
        "outputs": sorted(renderer.outputs),
        "scene": [scene.name, scene.triangle_count, len(scene.instances), shapes.hexdigest()],
        "lights": [len(group) for _, group in scene.lights.groups()],
        "features": dataclasses.asdict(Features.of(scene)),
        "environment": scene.environment.model_dump(),
        "moves": scene.animate is not None,
        "cameras": [camera.model_dump() for camera in cameras],
        "settings": settings.model_dump(),
        "held": settings.model_dump(exclude_unset=True),
    }


def _driver(device: wp.Device) -> list[int]:
    return list(wp.get_cuda_driver_version() or ()) if device.is_cuda else []


def _path(where: Path, key: dict[str, Any]) -> Path:
    text = json.dumps(key, sort_keys=True, default=str)
    return where / f"fit-{hashlib.blake2b(text.encode(), digest_size=12).hexdigest()}.json"


def save(where: Path, key: dict[str, Any], survey: Survey) -> Path | None:
    """Write a survey, whole or not at all; None where the folder cannot be written to, which is no error."""
    path = _path(where, key)
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = json.dumps({"format": FORMAT, "date": now, "key": key, "survey": _to_data(survey)}, default=str, indent=1)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        where.mkdir(parents=True, exist_ok=True)
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError:
        return None
    return path


def load(where: Path, key: dict[str, Any]) -> tuple[Survey, str] | None:
    """Read the survey of a key and the day it was made, or None where there is none that fits."""
    path = _path(where, key)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT or data["key"] != json.loads(json.dumps(key, default=str)):
            return None
        survey = _from_data(data["survey"])
        _check(survey)
        return survey, str(data["date"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        # Missing, torn, foreign or of ladders that have changed: measured anew.
        return None


def _to_data(survey: Survey) -> dict[str, Any]:
    data = {field.name: getattr(survey, field.name) for field in dataclasses.fields(survey)}
    grid = survey.grid
    data["grid"] = {
        "times": [[*key, ms] for key, ms in grid.times.items()],
        "errors": [[*key, error] for key, error in grid.errors.items()],
        "fxaa_ms": grid.fxaa_ms,
        "least": grid.least,
        "moving_ms": grid.moving_ms,
    }
    data["ladders"] = [dataclasses.asdict(ladder) for ladder in survey.ladders]
    data["base"] = dataclasses.asdict(survey.base)
    # JSON knows no infinity.
    data["reach_ms"] = None if survey.reach_ms == float("inf") else survey.reach_ms
    return data


def _from_data(data: dict[str, Any]) -> Survey:
    grid = data["grid"]
    fields = data | {
        "grid": Grid(
            {(scale, int(count)): float(ms) for scale, count, ms in grid["times"]},
            {(scale, rung): float(error) for scale, rung, error in grid["errors"]},
            float(grid["fxaa_ms"]),
            int(grid["least"]),
            float(grid["moving_ms"]),
        ),
        "ladders": tuple(
            LadderPrices(row["name"], row["part"], tuple(Offer(**offer) for offer in row["offers"]))
            for row in data["ladders"]
        ),
        "free_ms": tuple(data["free_ms"]),
        "base": Spread(**data["base"]),
        "reach_ms": float("inf") if data["reach_ms"] is None else float(data["reach_ms"]),
    }
    return Survey(**fields)


def _check(survey: Survey) -> None:
    """Raise ValueError if a survey does not fit the ladders there are, or holds a number that is none."""
    known = {ladder.name: ladder for ladder in LADDERS}
    for ladder in survey.ladders:
        for offer in ladder.offers:
            known[ladder.name].rung(offer.rung)
            if not np.isfinite([offer.ms, offer.once_ms, offer.error]).all() or offer.error < 0.0:
                raise ValueError(offer)
    for (scale, _), ms in survey.grid.times.items():
        if scale not in SCALES or not ms > 0.0 or not np.isfinite(ms):
            raise ValueError(scale)
    for (scale, rung), error in survey.grid.errors.items():
        if scale not in SCALES or rung not in PIXEL_SAMPLES or not error >= 0.0:
            raise ValueError(rung)
    if survey.free:
        EXACT.rung(survey.free)
