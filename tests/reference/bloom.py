"""Bloom's twin: the pyramid as products of small matrices, the exact sum of Gaussians, the window; float64, no halves.

Every step of the pyramid is linear and, but for the 13 taps, a product of one matrix an axis; the 13 taps are half of
a a' plus half of s s' with two matrices an axis.
"""

from __future__ import annotations

import numpy as np

__all__ = ["bloom_axes", "bloom_bilinear", "bloom_bright", "bloom_chain", "bloom_gaussians", "bloom_window"]


def bloom_bright(v: np.ndarray, threshold: float, knee: float) -> np.ndarray:
    """Part above a threshold with a soft start of half width `knee`, hue kept; v (..., 3)."""
    v = np.asarray(v, float)
    peak = v.max(axis=-1, keepdims=True)
    above = peak - threshold
    inside = np.abs(above) < knee
    curve = np.where(inside, (above + knee) ** 2 / (4.0 * knee if knee else 1.0), np.maximum(above, 0.0))
    return v * np.divide(curve, peak, out=np.zeros_like(peak), where=peak > 0.0)


def _mirror(i: int, count: int, edge: int) -> int:
    i = -1 - i if i < 0 else i
    i = edge - 1 - i if i >= count else i
    return min(max(i, 0), count - 1)


def _matrix(rows: int, columns: int, edge: int, taps) -> np.ndarray:
    """Row r gathers `taps(r)`, pairs of column and weight, with columns beyond the ends mirrored."""
    m = np.zeros((rows, columns))
    for r in range(rows):
        for c, w in taps(r):
            m[r, _mirror(c, columns, edge)] += w
    return m


def _spaced(start, values):
    return lambda r: [(start(r) + k, w) for k, w in enumerate(np.asarray(values, float) / sum(values))]


def _towards(r: int, values) -> list[tuple[int, float]]:
    step = 1 if r % 2 else -1
    first = -1 if len(values) == 4 else 0
    return [(r // 2 + (first + k) * step, w / sum(values)) for k, w in enumerate(values)]


def bloom_axes(length: int, levels: int) -> dict[str, list[np.ndarray]]:
    """Matrices along one axis of `length` pixels: from each level to the next, and back."""
    counts = [-(-length // 2**k) for k in range(levels + 1)]
    edges = [int(np.floor(2.0 * length / 2**k + 0.5)) for k in range(levels + 1)]
    result: dict[str, list[np.ndarray]] = {"first": [], "a": [], "s": [], "tent": [], "bilinear": []}
    result["first"].append(_matrix(counts[1], counts[0], edges[0], _spaced(lambda r: 2 * r - 1, (1, 3, 3, 1))))
    result["bilinear"].append(_matrix(counts[0], counts[1], edges[1], lambda r: _towards(r, (3, 1))))
    for k in range(1, levels):
        rows, columns, edge = counts[k + 1], counts[k], edges[k]
        result["a"].append(_matrix(rows, columns, edge, _spaced(lambda r: 2 * r - 1, (1, 1, 1, 1))))
        result["s"].append(_matrix(rows, columns, edge, _spaced(lambda r: 2 * r - 2, (1, 1, 2, 2, 1, 1))))
        result["tent"].append(_matrix(columns, rows, edges[k + 1], lambda r: _towards(r, (3, 7, 5, 1))))
    return result


def _both(rows: np.ndarray, image: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return np.einsum("iy,yxc,jx->ijc", rows, image, columns)


def bloom_bilinear(level: np.ndarray, height: int, width: int) -> np.ndarray:
    """Level 1 as display sees it."""
    return _both(bloom_axes(height, 1)["bilinear"][0], level, bloom_axes(width, 1)["bilinear"][0])


def bloom_chain(bright: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Level 1 of the pyramid after the way down and up: the sum of all levels, weighted, widest last."""
    levels = len(weights)
    y, x = (bloom_axes(n, levels) for n in bright.shape[:2])
    down = [_both(y["first"][0], bright, x["first"][0])]
    for k in range(levels - 1):
        down.append(0.5 * (_both(y["a"][k], down[k], x["a"][k]) + _both(y["s"][k], down[k], x["s"][k])))
    total = weights[-1] * down[-1]
    for k in reversed(range(levels - 1)):
        total = weights[k] * down[k] + _both(y["tent"][k], total, x["tent"][k])
    return total


def _gaussian(length: int, deviation: float) -> np.ndarray:
    """Blur along one axis, the row of pixels mirrored at its ends without end."""
    reach = int(np.ceil(8.0 * deviation))
    offsets = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (offsets / deviation) ** 2)
    weights /= weights.sum()
    m = np.zeros((length, length))
    for r in range(length):
        c = (r + offsets) % (2 * length)
        np.add.at(m[r], np.where(c < length, c, 2 * length - 1 - c), weights)
    return m


def bloom_gaussians(bright: np.ndarray, weights: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Sum of Gaussian blurs of the whole picture."""
    height, width = bright.shape[:2]
    return sum(
        w * _both(_gaussian(height, d), bright, _gaussian(width, d)) for w, d in zip(weights, deviations, strict=True)
    )


def bloom_window(bright: np.ndarray, window: int) -> np.ndarray:
    """Mean of a square window at level 1."""
    height, width = bright.shape[:2]
    level = _both(bloom_axes(height, 1)["first"][0], bright, bloom_axes(width, 1)["first"][0])
    rows, columns = (
        _matrix(n, n, length, lambda r: [(r + k, 1.0 / (2 * window + 1)) for k in range(-window, window + 1)])
        for n, length in zip(level.shape[:2], (height, width), strict=True)
    )
    return _both(rows, level, columns)
