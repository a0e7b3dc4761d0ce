"""Cutting a mesh into clusters of at most 128 triangles with bounding spheres and normal cones, once, at load.

Triangles are put in Morton order of their centroids, so that consecutive ones are neighbours whatever order a file
has; ids stay those of the mesh. Faces that cannot be drawn (a repeated vertex, no area, a non-finite vertex) are left
out of the clusters, so that they cost nothing and can never show.
"""

from __future__ import annotations

import dataclasses

import numpy as np

__all__ = ["CLUSTER_SIZE", "Clusters", "cut_clusters"]

CLUSTER_SIZE = 128


@dataclasses.dataclass(frozen=True)
class Clusters:
    """A mesh cut into clusters.

    Attributes:
        triangles: (m, 4) int32: three vertices and the mesh-local id, cluster after cluster.
        first: (c,) int32, first row of each cluster in `triangles`.
        count: (c,) int32, rows of each cluster, 1 to 128.
        low: (c, 3) float32, lowest corner of the box, object space.
        high: (c, 3) float32, highest corner.
        center: (c, 3) float32, middle of the bounding sphere, object space.
        radius: (c,) float32.
        axis: (c, 3) float32, axis of the cone of face normals.
        cutoff: (c,) float32, sine of the cone's half angle; 2 where the normals spread too far for a cone.
    """

    triangles: np.ndarray
    first: np.ndarray
    count: np.ndarray
    low: np.ndarray
    high: np.ndarray
    center: np.ndarray
    radius: np.ndarray
    axis: np.ndarray
    cutoff: np.ndarray


def morton_order(points: np.ndarray) -> np.ndarray:
    """Order of (n, 3) points along a Z curve with 21 bits an axis."""
    low, high = points.min(axis=0), points.max(axis=0)
    # One scale for all axes keeps the cells cubes.
    scale = (2**21 - 1) / max(float((high - low).max()), 1e-300)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        v = ((points[:, axis] - low[axis]) * scale).astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            v = (v | (v << np.uint64(shift))) & np.uint64(mask)
        code |= v << np.uint64(axis)
    return np.argsort(code, kind="stable")


def cut_clusters(positions: np.ndarray, triangles: np.ndarray, *, moving: bool = False) -> Clusters:
    """Cut a mesh.

    Args:
        positions: (n, 3) float32 vertex positions, object space.
        triangles: (m, 3) int32 vertex indices, all in range.
        moving: Keep faces without an area: other positions may give them one. Only repeated vertices never can.
    """
    corners = positions[triangles].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.abs(normals).max(axis=1, initial=0.0)
    drawable = np.isfinite(corners).all(axis=(1, 2)) & (size > 0.0)
    if moving:
        drawable = (triangles != triangles[:, [1, 2, 0]]).all(axis=1)
    ids = np.flatnonzero(drawable).astype(np.int32)
    if not len(ids):
        empty = np.zeros((0, 3), np.float32)
        none = np.zeros(0, np.float32)
        return Clusters(
            np.zeros((0, 4), np.int32), np.zeros(0, np.int32), np.zeros(0, np.int32),
            empty, empty, empty, none, empty, none,
        )  # fmt: skip
    if len(ids) > CLUSTER_SIZE:
        ids = ids[morton_order(corners[ids].mean(axis=1))]
    corners, normals, size = corners[ids], normals[ids], size[ids, None]
    normals = np.divide(normals, size, out=np.zeros_like(normals), where=size > 0.0)
    normals /= np.where(size > 0.0, np.linalg.norm(normals, axis=1, keepdims=True), 1.0)
    first = np.arange(0, len(ids), CLUSTER_SIZE)
    count = np.minimum(CLUSTER_SIZE, len(ids) - first)
    low = np.minimum.reduceat(corners.min(axis=1), first)
    high = np.maximum.reduceat(corners.max(axis=1), first)
    center = ((low + high) / 2.0).astype(np.float32)
    owner = np.repeat(np.arange(len(first)), count)
    offset = corners - center[owner].astype(np.float64)[:, None, :]
    radius = np.sqrt(np.maximum.reduceat((offset**2).sum(axis=2).max(axis=1), first))
    axis = np.add.reduceat(normals, first)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    axis = np.where(length > 0.0, axis / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    spread = np.minimum.reduceat((normals * axis[owner]).sum(axis=1), first)
    # Cones wider than about 84 degrees cull next to nothing.
    cutoff = np.where(spread > 0.1, np.sqrt(np.maximum(1.0 - spread * spread, 0.0)) + 1e-4, 2.0)
    rows = np.concatenate([triangles[ids], ids[:, None]], axis=1).astype(np.int32)
    with np.errstate(over="ignore"):
        # A sphere past float32 is infinite: its cluster is never culled and always clipped with care.
        sphere = (radius * (1.0 + 1e-6)).astype(np.float32)
    return Clusters(
        np.ascontiguousarray(rows),
        first.astype(np.int32),
        count.astype(np.int32),
        low.astype(np.float32),
        high.astype(np.float32),
        center,
        sphere,
        axis.astype(np.float32),
        cutoff.astype(np.float32),
    )
