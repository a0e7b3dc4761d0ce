"""Vertex normals for meshes that have none and should look smooth."""

from __future__ import annotations

import numpy as np

__all__ = ["smooth_normals"]


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
    _, group = np.unique(points, axis=0, return_inverse=True)
    group = group.reshape(-1)
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
