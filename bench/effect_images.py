"""Bench `effects-images`: the rungs of each effect side by side, for docs/effects.md, and all effects, for README.md.

A strip has a cell for each rung: a cut of its picture, enlarged without smoothing, and below it where it differs from
the reference rung's, with the differences multiplied. The sheet has a cell for each effect, its left half without.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Settings
from warp_deferred.errors import Error, LoadError
from warp_deferred.images import write_png

from .effect_cases import EFFECT_CASES, EffectCase, without_case
from .effects import open_case, picture, reason
from .probe import plan_of

__all__ = ["cut", "difference", "labelled", "lay_side_by_side", "run", "strip_path", "strip_rungs", "write_cells"]

#: Most bytes of a strip; cuts shrink until it fits.
MOST_BYTES = 170_000
#: Size of a cut at first [px], the factor by which it shrinks, cuts in a row, and the gap between them [px].
CUT, SHRINK, ACROSS, GAP = (288, 192), 0.9, 3, 4
#: Height of the bar a label stands in, and size of its letters [px].
BAR, LETTERS = 18, 13
#: Cases of the sheet, and the size of a cell in it [px]: the middle of a picture four times as wide, at half its size.
SHEET, CELL = ("shadow", "ambient_visibility", "bloom", "depth_of_field", "motion_blur", "custom_pass"), (288, 162)


def strip_path(folder: Path, name: str) -> Path:
    """Where the strip of a case lies; without a name the sheet of all effects."""
    return folder / ("_".join(["effects", name]) + ".png" if name else "effects.png")


def strip_rungs(path: Path) -> list[str]:
    """Rungs a strip shows, in order: kept in a file beside it."""
    try:
        return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LoadError(f"{path}: expected its rungs in {path.stem}.json, got {error}; draw it again") from None


def run(device: wp.Device, out: Path, *, quick: bool, settings: Settings, note: Any, only: str = "") -> list[Path]:
    """Write one strip an effect, and the sheet; what fails is named, and the others go on.

    Args:
        device: Where to run.
        out: Folder for the strips; made if it is not there.
        quick: Pictures of a quarter of the size.
        settings: Settings but for the rung at hand.
        note: Function of a text that tells how far it is.
        only: Name of the one case to draw; all of them and the sheet if left out.
    """
    labelled(np.zeros((1, 1, 4), np.uint8), "")  # before minutes of drawing, not after
    out.mkdir(parents=True, exist_ok=True)
    paths, cells = [], []
    for effect in without_case():
        note(f"skipped {effect}: no case for it in bench/effect_cases.py")
    for name, case in EFFECT_CASES.items():
        if only not in ("", name) or not case.draws:
            continue
        size = (case.size[0] // 4, case.size[1] // 4) if quick else case.size
        case = case.quick() if quick else case
        pictures = _pictures(case, size, case.rungs(), device, settings, note)
        if len(pictures) > 1:
            paths.append(write_cells(strip_path(out, name), case, pictures))
        if name in SHEET and not only:
            cells += _sheet_cell(case, device, 1 if quick else 2, settings, note)
    if cells:
        paths.append(strip_path(out, ""))
        write_png(paths[-1], lay_side_by_side(cells))
    return paths


def _pictures(
    case: EffectCase, size: tuple[int, int], rungs: tuple[str, ...], device: wp.Device, settings: Settings, note: Any
) -> dict[str, np.ndarray]:
    """Pictures of a case at some rungs."""
    pictures, renderer = {}, None
    for rung in rungs:
        note(f"{case.name}, {rung}, {size[0]}x{size[1]}")
        try:
            if renderer is None or case.passes is not None:
                renderer = open_case(case, size, device, rung=rung)
            plan_of(renderer, case.at(settings.with_values(list(case.settings)), rung))
            pictures[rung] = picture(case, renderer)
        except Exception as error:
            note(f"skipped {case.name}, {rung}: {reason(error)}")
    return pictures


def _sheet_cell(case: EffectCase, device: wp.Device, factor: int, settings: Settings, note: Any) -> list[np.ndarray]:
    """Cell of the sheet, cut out of a picture twice as wide and high and reduced by a factor; none where one failed."""
    rungs = (case.rungs()[0], case.default(settings))
    size = (CELL[0] * factor * factor, CELL[1] * factor * factor)
    pair = _pictures(case, size, rungs, device, settings, note)
    near = dataclasses.replace(case, centre=case.sheet_centre or case.centre, zoom=1)
    window = (CELL[0] * factor, CELL[1] * factor)
    cuts = [_smaller(cut(image, near, window), factor) for image in pair.values()]
    return [_halves(case.name, *cuts)] if len(cuts) == len(rungs) else []


def write_cells(path: Path, case: EffectCase, pictures: dict[str, np.ndarray]) -> Path:
    """Write a strip of no more than `MOST_BYTES`, and the names of its rungs beside it."""
    width, height = CUT
    while True:
        size = (round(width), round(height))
        cuts = {rung: cut(image, case, size) for rung, image in pictures.items()}
        write_png(path, lay_side_by_side(_cells(case, cuts)))
        if path.stat().st_size <= MOST_BYTES:
            break
        width, height = width * SHRINK, height * SHRINK
    path.with_suffix(".json").write_text(json.dumps(list(pictures)) + "\n", encoding="utf-8")
    return path


def _cells(case: EffectCase, cuts: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Cells of a strip: each cut, and below it its difference from the reference's."""
    if case.reference not in cuts:
        return [labelled(image, rung) for rung, image in cuts.items()]
    cells = []
    for rung, image in cuts.items():
        if rung == case.reference:
            below = labelled(np.full_like(image, 255), "")
            cells.append(np.vstack([labelled(image, f"{rung} (reference)"), below]))
        else:
            below = difference(image, cuts[case.reference], case.gain)
            cells.append(np.vstack([labelled(image, rung), labelled(below, f"{case.gain} x difference")]))
    return cells


def difference(image: np.ndarray, reference: np.ndarray, gain: int) -> np.ndarray:
    """Absolute difference of two pictures, multiplied and clamped, opaque; uint8 as they are."""
    apart = np.abs(image.astype(np.int32) - reference.astype(np.int32)) * gain
    result = np.minimum(apart, 255).astype(np.uint8)
    result[..., 3] = 255
    return result


def _halves(name: str, off: np.ndarray, on: np.ndarray) -> np.ndarray:
    """One picture whose left half is without the effect."""
    middle = off.shape[1] // 2
    both = np.hstack([off[:, :middle], on[:, middle:]])
    both[:, middle - 1 : middle + 1] = 255
    return labelled(both, f"without | {name.replace('_', ' ')}")


def _smaller(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean of squares of pixels."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, 4)
    return np.rint(blocks.astype(np.float32).mean(axis=(1, 3))).astype(np.uint8)


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    """Put a white bar with a text above a picture; (height + `BAR`, width, 4) uint8."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise Error(
            "pillow: expected it for labels, got no such module; install it with: pip install -e '.[test]'"
        ) from error
    bar = Image.new("RGBA", (image.shape[1], BAR), (255, 255, 255, 255))
    # Pillow's own letters: machines without a screen often have no fonts.
    ImageDraw.Draw(bar).text((2, 1), text, fill=(32, 32, 32, 255), font=ImageFont.load_default(LETTERS))
    return np.vstack([np.asarray(bar, np.uint8), image])


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
