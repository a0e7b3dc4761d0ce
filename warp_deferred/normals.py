"""Vertex normals for meshes that have none and should look smooth."""

from __future__ import annotations

import numpy as np

__all__ = ["smooth_normals", "weld"]


def weld(positions: np.ndarray, normals: np.ndarray | None = None) -> np.ndarray:
    """Number the places vertices lie at: (n,) group of each, equal where positions are, and normals where given.

    Args:
        positions: (n, 3) floats.
        normals: (n, 3) floats that keep vertices apart: an edge stays hard where a file's normals make it so.
    """
    rows = np.asarray(positions, np.float64)
    if normals is not None:
        rows = np.concatenate([rows, normals], axis=1)
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


def smooth_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Average face normals, weighted by corner angle, over all vertices that share a position.

    Formats that cut vertices along texture seams would show these seams if each cut side were averaged alone.
    Angle weights do not depend on how the surface is cut into triangles (Thürmer and Wüthrich 1998).

    Args:
        positions: (n, 3) floats.
        triangles: (m, 3) indices, all in range.

    Returns:
        (n, 3) float32 unit normals; zero where no face with an area touches.
    """
    points = np.asarray(positions, np.float64)
    group = weld(points)
    corners = points[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(face, axis=1, keepdims=True)
    face = np.divide(face, length, out=np.zeros_like(face), where=length > 0.0)
    total = np.zeros((int(group.max()) + 1 if len(group) else 0, 3))
    for k in range(3):
        a = corners[:, (k + 1) % 3] - corners[:, k]
        b = corners[:, (k + 2) % 3] - corners[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        for axis in range(3):
            total[:, axis] += np.bincount(group[triangles[:, k]], angle * face[:, axis], len(total))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.divide(total, length, out=np.zeros_like(total), where=length > 1e-12)
    return total[group].astype(np.float32)
