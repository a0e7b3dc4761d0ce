"""Bench `effects-images`: the rungs of each effect side by side, as one small PNG, for docs/effects.md."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Settings
from warp_deferred.errors import Error, LoadError
from warp_deferred.images import write_png

from .effect_cases import EFFECT_CASES, EffectCase, ladders
from .effects import at_rung, open_case, picture
from .probe import plan_of

__all__ = ["cut", "lay_side_by_side", "run", "strip_path", "strip_rungs"]

#: Most bytes of a strip; cuts shrink until it fits.
MOST_BYTES = 150_000
#: Size of a cut at first [px], the factor by which it shrinks, cuts in a row, and the gap between them [px].
CUT, SHRINK, ACROSS, GAP = (288, 192), 0.9, 3, 4


def strip_path(folder: Path, effect: str) -> Path:
    """Where the strip of an effect lies."""
    return folder / f"effects_{effect}.png"


def strip_rungs(path: Path) -> list[str]:
    """Rungs a strip shows, in order: kept in a file beside it."""
    try:
        return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LoadError(f"{path}: expected its rungs in {path.stem}.json, got {error}; draw it again") from None


def run(device: wp.Device, out: Path, *, quick: bool, settings: Settings, note: Any) -> list[Path]:
    """Write one strip an effect.

    Args:
        device: Where to run.
        out: Folder for the strips; made if it is not there.
        quick: Pictures of a quarter of the size.
        settings: Settings but for the rung at hand.
        note: Function of a text that tells how far it is.
    """
    out.mkdir(parents=True, exist_ok=True)
    known, paths = ladders(), []
    for effect in known:
        if effect not in EFFECT_CASES:
            note(f"skipped {effect}: no case for it in bench/effect_cases.py")
    for effect, case in EFFECT_CASES.items():
        if effect not in known:
            note(f"skipped {effect}: no such effect in this version")
            continue
        size = (case.size[0] // 4, case.size[1] // 4) if quick else case.size
        try:
            renderer = open_case(case, size, device)
        except LoadError as error:
            note(f"skipped {effect}: {error}")
            continue
        pictures = {}
        for rung in known[effect]:
            note(f"{effect}, {rung}")
            try:
                plan_of(renderer, at_rung(settings, effect, rung))
                pictures[rung] = picture(case, renderer)
            except Error as error:
                note(f"skipped {effect}.rung={rung}: {error}")
        paths.append(_write(strip_path(out, effect), case, pictures))
    return paths


def _write(path: Path, case: EffectCase, pictures: dict[str, np.ndarray]) -> Path:
    """Write a strip of no more than `MOST_BYTES`, and the names of its rungs beside it."""
    width, height = CUT
    while True:
        cuts = [cut(image, case, (round(width), round(height))) for image in pictures.values()]
        write_png(path, lay_side_by_side(cuts))
        if path.stat().st_size <= MOST_BYTES:
            break
        width, height = width * SHRINK, height * SHRINK
    path.with_suffix(".json").write_text(json.dumps(list(pictures)) + "\n", encoding="utf-8")
    return path


def cut(image: np.ndarray, case: EffectCase, size: tuple[int, int]) -> np.ndarray:
    """Cut a piece of about `size` pixels out of a picture, enlarged by the case's zoom; (height, width, 4) uint8."""
    height, width = image.shape[:2]
    w, h = (max(1, min(wanted // case.zoom, have)) for wanted, have in zip(size, (width, height), strict=True))
    x = min(max(round(case.centre[0] * width - 0.5 * w), 0), width - w)
    y = min(max(round(case.centre[1] * height - 0.5 * h), 0), height - h)
    return image[y : y + h, x : x + w].repeat(case.zoom, axis=0).repeat(case.zoom, axis=1)


def lay_side_by_side(cuts: list[np.ndarray]) -> np.ndarray:
    """Lay pictures of one size in rows from left to right, on white."""
    height, width = cuts[0].shape[:2]
    across = min(len(cuts), ACROSS if len(cuts) != 4 else 2)
    down = -(-len(cuts) // across)
    sheet = np.full((down * (height + GAP) - GAP, across * (width + GAP) - GAP, 4), 255, np.uint8)
    for k, piece in enumerate(cuts):
        y, x = k // across * (height + GAP), k % across * (width + GAP)
        sheet[y : y + height, x : x + width] = piece
    return sheet
