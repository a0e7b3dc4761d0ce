"""Coverage in exact integers, nearest fragment per pixel, and an independent oracle for coverage alone.

Coordinates are integers of 1/256 px, y down; the centre of pixel (i, j) is (256 i + 128, 256 j + 128). With spans up
to 2^24 every edge value stays below 2^50, so int64 is exact and so is its float64 copy.

The fill rule is the top-left rule (Direct3D 11 functional specification, 3.4.2.1). `draw` decides it with edge
functions; `coverage_count` decides it with half-open scan-line crossings, so that each checks the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .geometry import Pieces

__all__ = ["Visibility", "coverage_count", "draw", "edge_values", "polygon_coverage"]

Discard = Callable[[int, np.ndarray, np.ndarray], np.ndarray]


@dataclass
class Visibility:
    """What each pixel of (height, width) sees.

    Attributes:
        z: Depth value of the nearest fragment, -inf where there is none.
        piece: Its piece, -1 where there is none.
        fragments: How many fragments were drawn there, seen or hidden.
        z_gap: Nearest z minus the z of the next fragment, +inf with fewer than two: where it is tiny a float32
            renderer may choose the other one.
        edge_distance: Distance from the pixel centre to the nearest edge of any drawn piece within about a pixel
            [1/256 px]; larger ones are +inf or too large.
    """

    z: np.ndarray
    piece: np.ndarray
    fragments: np.ndarray
    z_gap: np.ndarray
    edge_distance: np.ndarray


def edge_values(xy: np.ndarray, px: np.ndarray, py: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Evaluate the three edge functions of a triangle of positive area, and whether each point is inside.

    Args:
        xy: (3, 2) int64 vertices.
        px: Point x coordinates, int64, broadcastable with `py`.
        py: Point y coordinates.

    Returns:
        Edge values opposite vertex 0, 1 and 2 (their sum is the doubled area), and the mask of the top-left rule.
    """
    values, inside = [], None
    for i in range(3):
        (ax, ay), (bx, by) = xy[(i + 1) % 3].tolist(), xy[(i + 2) % 3].tolist()
        dx, dy = bx - ax, by - ay
        value = dx * (py - ay) - dy * (px - ax)
        owns_edge = dy < 0 or (dy == 0 and dx > 0)
        mask = value >= 0 if owns_edge else value > 0
        inside = mask if inside is None else inside & mask
        values.append(value)
    return values, inside


def _edge_distance(xy: np.ndarray, px: np.ndarray, py: np.ndarray) -> np.ndarray:
    result = np.inf
    for i in range(3):
        (ax, ay), (bx, by) = xy[i].tolist(), xy[i - 1].tolist()
        dx, dy = bx - ax, by - ay
        length = dx * dx + dy * dy
        t = np.clip(((px - ax) * dx + (py - ay) * dy) / length, 0.0, 1.0) if length else 0.0
        result = np.minimum(result, np.hypot(px - ax - t * dx, py - ay - t * dy))
    return result


def _pixel_span(low: int, high: int, count: int, pad: int = 0) -> tuple[int, int]:
    # First and one-past-last pixel whose centre lies in [low, high]; // floors, so -(-a // b) is the ceiling.
    return max(0, -((128 - low) // 256) - pad), min(count, (high - 128) // 256 + 1 + pad)


def draw(
    pieces: Pieces, width: int, height: int, depth: str, discard: Discard | None = None, edges: bool = True
) -> Visibility:
    """Draw pieces in order; the largest z wins, the earlier piece on a tie.

    Args:
        pieces: What to draw, already culled.
        width: Image width [px].
        height: Image height [px].
        depth: "clip" drops fragments with z outside [0, 1], "clamp" clamps them.
        discard: Called with (piece, x, y) for covered pixels; True drops the fragment.
        edges: Whether to compute `edge_distance`.
    """
    shape = (height, width)
    best = np.full(shape, -np.inf)
    second = np.full(shape, -np.inf)
    winner = np.full(shape, -1, np.int64)
    fragments = np.zeros(shape, np.int64)
    distance = np.full(shape, np.inf)
    xs, ys = np.arange(width)[None, :] * 256 + 128, np.arange(height)[:, None] * 256 + 128
    lows, highs = pieces.xy.min(axis=1).tolist(), pieces.xy.max(axis=1).tolist()
    for k, ((x_low, y_low), (x_high, y_high)) in enumerate(zip(lows, highs, strict=True)):
        if edges:
            (i0, i1), (j0, j1) = _pixel_span(x_low, x_high, width, 1), _pixel_span(y_low, y_high, height, 1)
            if i0 < i1 and j0 < j1:
                window = distance[j0:j1, i0:i1]
                np.minimum(window, _edge_distance(pieces.xy[k], xs[:, i0:i1], ys[j0:j1]), out=window)
        (i0, i1), (j0, j1) = _pixel_span(x_low, x_high, width), _pixel_span(y_low, y_high, height)
        if i0 >= i1 or j0 >= j1:
            continue
        order = [0, 1, 2] if pieces.area[k] > 0 else [0, 2, 1]
        values, drawn = edge_values(pieces.xy[k][order], xs[:, i0:i1], ys[j0:j1])
        z0, z1, z2 = pieces.z[k][order].tolist()
        z = (values[0] * z0 + values[1] * z1 + values[2] * z2) / abs(int(pieces.area[k]))
        if depth == "clamp":
            z = np.clip(z, 0.0, 1.0)
        else:
            drawn &= (z >= 0.0) & (z <= 1.0)
        if discard is not None and drawn.any():
            y, x = np.nonzero(drawn)
            drawn[y, x] = ~discard(k, x + i0, y + j0)
        here, next_best = best[j0:j1, i0:i1], second[j0:j1, i0:i1]
        won = drawn & (z > here)
        next_best[...] = np.where(won, here, np.where(drawn, np.maximum(next_best, z), next_best))
        here[won] = z[won]
        winner[j0:j1, i0:i1][won] = k
        fragments[j0:j1, i0:i1] += drawn
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(second), best - second, np.inf)
    return Visibility(best, winner, fragments, gap, distance)


def polygon_coverage(vertices: np.ndarray, width: int, height: int) -> np.ndarray:
    """Find the pixel centres inside a polygon (even-odd), exactly, by half-open scan-line crossings.

    An edge spans the rows from its upper end up to but without its lower end, and a centre is past an edge when it is
    on it or right of it; this owns top and left borders and disowns bottom and right ones, as the top-left rule does.

    Args:
        vertices: (n, 2) integers [1/256 px], |v| <= 2^29 so that products fit 64 bits.
        width: Image width [px].
        height: Image height [px].

    Returns:
        (height, width) bool.
    """
    vertices = np.asarray(vertices)
    if vertices.dtype.kind != "i" or np.abs(vertices).max(initial=0) > 1 << 29:
        raise ValueError("polygon_coverage: expected integers up to 2^29 in size; snap the vertices first")
    x, y = np.arange(width, dtype=np.int64)[None, :] * 256 + 128, np.arange(height, dtype=np.int64)[:, None] * 256 + 128
    inside = np.zeros((height, width), bool)
    for a, b in zip(vertices.tolist(), np.roll(vertices, -1, axis=0).tolist(), strict=True):
        (ax, ay), (bx, by) = (a, b) if a[1] < b[1] else (b, a)
        spans = (y >= ay) & (y < by)
        inside ^= spans & ((x - ax) * (by - ay) >= (y - ay) * (bx - ax))
    return inside


def coverage_count(triangles: np.ndarray, width: int, height: int) -> np.ndarray:
    """Count for each pixel centre the triangles that cover it; winding does not matter.

    Args:
        triangles: (m, 3, 2) integers [1/256 px].
        width: Image width [px].
        height: Image height [px].

    Returns:
        (height, width) int64.
    """
    count = np.zeros((height, width), np.int64)
    for triangle in np.asarray(triangles):
        (x_low, y_low), (x_high, y_high) = triangle.min(axis=0).tolist(), triangle.max(axis=0).tolist()
        (i0, i1), (j0, j1) = _pixel_span(x_low, x_high, width), _pixel_span(y_low, y_high, height)
        if i0 < i1 and j0 < j1:
            moved = triangle - np.array([i0, j0]) * 256
            count[j0:j1, i0:i1] += polygon_coverage(moved, i1 - i0, j1 - j0)
    return count
