"""Strips of the bench `accuracy`: each rung where the cheapest one is farthest off, and differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .effect_cases import EffectCase
from .effect_images import write_cells

__all__ = ["strip_name", "worst_place", "write_strip"]

#: Side of the square in which differences are summed to find the worst place [px].
SQUARE = 32
#: Largest factor on differences: a code of 255 becomes a quarter of white.
MOST_GAIN = 64


def strip_name(ladder: str) -> str:
    """File name of a ladder's strip."""
    return f"accuracy_{ladder}_crops.png"


def worst_place(apart: np.ndarray) -> tuple[float, float]:
    """Middle of the square with the largest sum of differences, as shares of width and height."""
    height, width = apart.shape
    sums = np.pad(apart.astype(np.float64), ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    h, w = min(SQUARE, height), min(SQUARE, width)
    total = sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]
    y, x = np.unravel_index(int(np.argmax(total)), total.shape)
    return (float(x + 0.5 * w) / width, float(y + 0.5 * h) / height)


def write_strip(folder: Path, ladder: str, pictures: dict[str, np.ndarray], reference: str) -> Path:
    """Write the strip of a ladder, and its rungs' names beside it; pictures are (height, width, 4) uint8.

    The factor on differences is the power of two that brings the largest of the cheapest rung's to at most white.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rungs = [name for name in pictures if name not in (reference, "off")] or [n for n in pictures if n != reference]
    worst = pictures[rungs[0]][..., :3].astype(np.int32) - pictures[reference][..., :3]
    apart = np.abs(worst).max(axis=-1)
    gain = 1
    while gain < MOST_GAIN and gain * 2 * np.percentile(apart, 99.9) <= 255:
        gain *= 2
    height, width = apart.shape
    zoom = 3
    case = EffectCase(ladder, "", reference, centre=worst_place(apart), zoom=zoom, gain=gain, size=(width, height))
    return write_cells(folder / strip_name(ladder), case, pictures)
