"""Polygons of a file to triangles that cover exactly the same points, concave ones included."""

from __future__ import annotations

import numpy as np

__all__ = ["MAX_CONCAVE_CORNERS", "triangulate_polygon"]

#: Ear clipping takes quadratic time: concave polygons with more corners are cut into a plain fan.
MAX_CONCAVE_CORNERS = 2000
#: Corners tried for ears, for each corner of the polygon: simple polygons take a few, those that cross themselves may
#: take all of them each time. What is left then becomes a fan.
TESTS_PER_CORNER = 4


def triangulate_polygon(points: np.ndarray) -> np.ndarray:
    """Cut a polygon into triangles between its own corners, turning the same way.

    Convex polygons become a fan from the first corner. Others are cut by ear clipping in the plane of their area
    vector (Meisters 1975): an ear is a convex corner whose triangle holds no other corner. Corners on a straight
    edge are kept as corners of some triangle, so that neighbours still meet at them.

    Args:
        points: (k, 3) corners in order, k >= 3; nearly flat.

    Returns:
        Corner numbers (k - 2, 3) int64. A polygon that crosses itself or has no area gives some fan.
    """
    count = len(points)
    if count == 4:
        return np.array(_split_quad(points.tolist()))
    fan = np.arange(count - 2)[:, None] + (0, 1, 2)
    fan[:, 0] = 0
    if count == 3 or not np.isfinite(points).all():
        return fan
    offset = points - points[0]
    area = np.cross(offset, np.roll(offset, -1, axis=0)).sum(axis=0)
    drop = int(np.argmax(np.abs(area)))
    if not area[drop] != 0.0:
        return fan
    axes = [(1, 2), (2, 0), (0, 1)][drop]
    flat = offset[:, axes] if area[drop] > 0.0 else offset[:, axes] * (1.0, -1.0)
    incoming, outgoing = flat - np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0) - flat
    turns = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
    # All turns left and one full turn in all: convex. A star turns left everywhere too, but more than once.
    spokes = flat[1:] - flat[0]
    wedges = spokes[:-1, 0] * spokes[1:, 1] - spokes[:-1, 1] * spokes[1:, 0]
    # A flat triangle of the fan would leave its middle corner on another's edge.
    if count > MAX_CONCAVE_CORNERS or (turns.min() >= 0.0 and wedges.min() > 0.0):
        return fan
    return np.array(_clip_ears(flat))


def _split_quad(points: list[list[float]]) -> list[tuple[int, int, int]]:
    """Cut a quad along the diagonal on whose sides both triangles turn the same way and have an area.

    In plain floats: most files with polygons are full of quads, and arrays of four rows cost more than they save.
    """
    (ax, ay, az), (bx, by, bz), (cx, cy, cz), (dx, dy, dz) = points
    px, py, pz = cx - ax, cy - ay, cz - az
    qx, qy, qz = dx - bx, dy - by, dz - bz
    # The cross product of the diagonals is twice the area vector; each triangle's area is measured along it.
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx

    def area(ux: float, uy: float, uz: float, vx: float, vy: float, vz: float) -> float:
        return (uy * vz - uz * vy) * nx + (uz * vx - ux * vz) * ny + (ux * vy - uy * vx) * nz

    first = area(bx - ax, by - ay, bz - az, px, py, pz), area(px, py, pz, dx - ax, dy - ay, dz - az)
    second = area(cx - bx, cy - by, cz - bz, qx, qy, qz), area(qx, qy, qz, ax - bx, ay - by, az - bz)
    return [(1, 2, 3), (1, 3, 0)] if min(second) > 0.0 >= min(first) else [(0, 1, 2), (0, 2, 3)]


def _clip_ears(flat: np.ndarray) -> list[tuple[int, int, int]]:
    left = list(range(len(flat)))
    triangles, tests = [], 0
    while len(left) > 3 and tests <= TESTS_PER_CORNER * len(flat):
        at, tried = _find_ear(flat, left)
        tests += tried
        a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
        triangles.append((a, b, c))
        del left[at]
    return triangles + [(left[0], left[i], left[i + 1]) for i in range(1, len(left) - 1)]


def _find_ear(flat: np.ndarray, left: list[int]) -> tuple[int, int]:
    """Return the place in `left` of an ear and how many corners were tried.

    Where there is no ear it is that of a corner without area, else of any convex corner.
    """
    points = flat[left]
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    edge, reach = points - before, after - before
    turns = edge[:, 0] * reach[:, 1] - edge[:, 1] * reach[:, 0]
    x, y = np.ascontiguousarray(points.T)
    convex = np.nonzero(turns > 0.0)[0]
    for tried, at in enumerate(convex, 1):
        triangle = before[at].tolist(), points[at].tolist(), after[at].tolist()
        inside = np.ones(len(points), bool)
        for k in range(3):
            (ax, ay), (bx, by) = triangle[k], triangle[(k + 1) % 3]
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0.0
            inside &= (x != ax) | (y != ay)
        if not inside.any():
            return int(at), tried
    flat_corners = np.nonzero(turns == 0.0)[0]
    return int(flat_corners[0]) if len(flat_corners) else int(np.argmax(turns)), len(convex)
