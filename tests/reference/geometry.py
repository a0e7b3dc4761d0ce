"""From world triangles to snapped screen triangles: view transform, projection, clipping, 1/256 pixel snap.

A clip vertex is (X, Y, Z, W): homogeneous pixel coordinates, so that pixel = (X / W, Y / W) and z = Z / W. With a
perspective view Z is the near distance for every vertex, hence z = near / W; with an orthographic one W is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .data import Instance, View

__all__ = ["GUARD_PX", "Pieces", "clip_polygon", "make_pieces", "project", "seen", "snap", "to_world", "unproject"]

GUARD_PX = 32768.0
SUBPIXELS = 256

# Rows are planes over (X, Y, Z, W); inside is where the product is >= 0.
NEAR_PLANE = np.array([[0.0, 0.0, -1.0, 1.0]])
GUARD_PLANES = np.array(
    [[1.0, 0.0, 0.0, GUARD_PX], [-1.0, 0.0, 0.0, GUARD_PX], [0.0, 1.0, 0.0, GUARD_PX], [0.0, -1.0, 0.0, GUARD_PX]]
)


@dataclass
class Pieces:
    """Snapped triangles, in the order of their sources.

    Attributes:
        xy: (k, 3, 2) int64 in 1/256 px.
        z: (k, 3) float64 depth values at the vertices.
        area: (k,) int64 doubled signed area; negative is counter-clockwise as seen.
        source: (k,) index of the triangle each piece was cut from.
    """

    xy: np.ndarray
    z: np.ndarray
    area: np.ndarray
    source: np.ndarray


def seen(world: int, view: View) -> bool:
    """Tell whether something of that world takes part in the view."""
    return view.world < 0 or world < 0 or world == view.world


def to_world(instance: Instance) -> np.ndarray:
    """Return the instance's vertex positions in the world, (n, 3)."""
    with np.errstate(invalid="ignore"):  # vertices without a place are dropped later
        return instance.mesh.positions @ instance.transform[:3, :3].T + instance.transform[:3, 3]


def project(points: np.ndarray, view: View) -> np.ndarray:
    """Project world points (..., 3) to clip vertices (..., 4)."""
    local = (points - np.asarray(view.eye, float)) @ np.asarray(view.rotation, float).T
    fx, fy, cx, cy = view.projection
    if view.orthographic:
        w = np.ones(local.shape[:-1])
        z = (view.far + local[..., 2]) / (view.far - view.near)
    else:
        w = -local[..., 2]
        z = np.full(local.shape[:-1], float(view.near))
    return np.stack([fx * local[..., 0] + cx * w, cy * w - fy * local[..., 1], z, w], axis=-1)


def unproject(x: np.ndarray, y: np.ndarray, depth: np.ndarray, view: View) -> np.ndarray:
    """Find the world points (n, 3) seen at pixel centres of columns x and rows y at a view depth [m]."""
    fx, fy, cx, cy = view.projection
    w = np.ones_like(depth) if view.orthographic else depth
    local = np.stack([(x + 0.5 - cx) / fx * w, (cy - y - 0.5) / fy * w, -depth], axis=-1)
    return local @ np.asarray(view.rotation, float) + np.asarray(view.eye, float)


def _cut(a: np.ndarray, b: np.ndarray, plane: np.ndarray) -> np.ndarray:
    # Two triangles walk a shared edge in opposite directions; sorted ends give both the same rounded point.
    if tuple(b) < tuple(a):
        a, b = b, a
    at_a, at_b = float(plane @ a), float(plane @ b)
    return a + (at_a / (at_a - at_b)) * (b - a)


def clip_polygon(polygon: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Clip a convex polygon of clip vertices (n, 4) to the inside of all planes; may return no vertices.

    Source: Sutherland and Hodgman 1974, Reentrant polygon clipping.
    """
    vertices = list(polygon)
    for plane in planes:
        kept: list[np.ndarray] = []
        for i, b in enumerate(vertices):
            a = vertices[i - 1]
            a_in, b_in = plane @ a >= 0.0, plane @ b >= 0.0
            if a_in != b_in:
                kept.append(_cut(a, b, plane))
            if b_in:
                kept.append(b)
        vertices = kept
    return np.array(vertices).reshape(-1, 4)


def snap(pixels: np.ndarray) -> np.ndarray:
    """Round pixel coordinates to the nearest 1/256 px, halves up, as int64 of that unit."""
    limit = GUARD_PX * SUBPIXELS
    return np.clip(np.floor(pixels * SUBPIXELS + 0.5), -limit, limit).astype(np.int64)


def make_pieces(corners: np.ndarray, view: View) -> Pieces:
    """Clip, divide and snap triangles.

    Args:
        corners: (m, 3, 4) clip vertices; triangles with a number that is not finite vanish.
        view: Decides whether the near plane clips; an orthographic view tests depth per fragment instead.

    Returns:
        Pieces of non-zero area, sorted by source.
    """
    planes = GUARD_PLANES if view.orthographic else np.concatenate([NEAR_PLANE, GUARD_PLANES])
    inside = corners @ planes.T >= 0.0
    finite = np.isfinite(corners).all(axis=(1, 2))
    whole = finite & inside.all(axis=(1, 2))
    crossing = finite & ~whole & inside.any(axis=1).all(axis=1)
    polygons, sources = [corners[whole]], [np.flatnonzero(whole)]
    for index in np.flatnonzero(crossing):
        polygon = clip_polygon(corners[index], planes)
        fan = [polygon[[0, i, i + 1]] for i in range(1, len(polygon) - 1)]
        if fan:
            polygons.append(np.array(fan))
            sources.append(np.full(len(fan), index))
    clip, source = np.concatenate(polygons), np.concatenate(sources)
    order = np.argsort(source, kind="stable")
    clip, source = clip[order], source[order]
    w = clip[..., 3:]
    xy, z = snap(clip[..., :2] / w), clip[..., 2] / w[..., 0]
    if not view.orthographic:
        z = np.minimum(z, 1.0)  # a cut at the near plane may come out one rounding error in front of it
    (x0, y0), (x1, y1), (x2, y2) = (xy[:, i].T for i in range(3))
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    keep = area != 0
    return Pieces(xy[keep], z[keep], area[keep], source[keep])
