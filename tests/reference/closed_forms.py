"""Scenes whose picture is known on paper, and small geometry that needs no files."""

from __future__ import annotations

import numpy as np

from .data import Instance, Light, Material, Mesh, Scene, View

__all__ = [
    "angle_weighted_normals",
    "furnace",
    "lambert_plane",
    "lambert_plane_radiance",
    "loose",
    "quad",
    "scene_of",
    "sphere",
    "translation",
    "view_of",
]


def view_of(width: int = 48, height: int = 32, focal: float = 40.0, **fields) -> View:
    """A view from the origin down -Z with the principal point in the middle; `focal` in pixels."""
    return View(width, height, (focal, focal, width / 2, height / 2), **fields)


def scene_of(*meshes: Mesh, material: Material | None = None, **fields) -> Scene:
    """A scene of meshes where they are, all of one material."""
    return Scene(tuple(Instance(m) for m in meshes), (material or Material(),), **fields)


def loose(triangles: np.ndarray, **fields) -> Mesh:
    """A mesh of triangles (m, 3, 3) that share no vertices."""
    points = np.asarray(triangles, float).reshape(-1, 3)
    return Mesh(points, np.arange(len(points)).reshape(-1, 3), **fields)


def translation(x: float, y: float, z: float) -> np.ndarray:
    """A (4, 4) matrix that moves points."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def angle_weighted_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Average face normals at each vertex, weighted by the face's angle there; zero where no face has an area.

    Source: Thürmer and Wüthrich 1998, Computing vertex normals from polygonal facets.
    """
    points = np.asarray(positions, float)
    faces = np.asarray(triangles, np.int64).reshape(-1, 3)
    total = np.zeros_like(points)
    corners = points[faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(face, axis=1, keepdims=True)
    face = np.where(size > 0.0, face / np.where(size > 0.0, size, 1.0), 0.0)
    for i in range(3):
        a, b = corners[:, i - 2] - corners[:, i], corners[:, i - 1] - corners[:, i]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        np.add.at(total, faces[:, i], face * angle[:, None])
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(size > 0.0, total / np.where(size > 0.0, size, 1.0), 0.0)


def quad(half_size: float, height: float = 0.0) -> Mesh:
    """A square in the plane y = height, facing up, uv 0 to 1."""
    s = half_size
    points = np.array([[-s, height, s], [s, height, s], [s, height, -s], [-s, height, -s]], float)
    uvs = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 1.0, 0.0], (4, 1)), uvs)


def sphere(radius: float, rings: int = 8, sectors: int = 12) -> Mesh:
    """A closed sphere of 2 sectors (rings - 1) triangles with smooth normals."""
    theta = np.linspace(0.0, np.pi, rings + 1)[1:-1]
    phi = np.arange(sectors) * (2.0 * np.pi / sectors)
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.sin(phi)),
            np.repeat(np.cos(theta)[:, None], sectors, axis=1),
            np.outer(np.sin(theta), np.cos(phi)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    points = np.concatenate([[[0.0, 1.0, 0.0]], ring, [[0.0, -1.0, 0.0]]])
    last, faces = len(points) - 1, []
    for s in range(sectors):
        t = (s + 1) % sectors
        faces.append([0, 1 + s, 1 + t])
        for r in range(rings - 2):
            upper, lower = 1 + r * sectors, 1 + (r + 1) * sectors
            faces += [[upper + s, lower + s, lower + t], [upper + s, lower + t, upper + t]]
        faces.append([last - sectors + t, last - sectors + s, last])
    return Mesh(points * radius, np.array(faces), points)


def lambert_plane(albedo: float, light: Light, half_size: float = 50.0) -> Scene:
    """A diffuse floor at y = 0 under one light."""
    material = Material(model="lambert", base_color=(albedo, albedo, albedo, 1.0))
    return Scene((Instance(quad(half_size)),), (material,), (light,))


def lambert_plane_radiance(points: np.ndarray, albedo: float, light: Light) -> np.ndarray:
    """Radiance of that floor under a point light of no range: albedo / pi · I · h / d³, (n, 3).

    The cosine law with cos = h / d and inverse-square fall-off; h is the light's height, d its distance.
    """
    offset = np.asarray(light.position, float) - points
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    return albedo / np.pi * np.asarray(light.radiance, float) * offset[..., 1:2] / distance**3


def furnace(mesh: Mesh, albedo: float) -> Scene:
    """A diffuse body in uniform light of radiance 1: it shows albedo everywhere, and with albedo 1 vanishes."""
    material = Material(model="lambert", base_color=(albedo, albedo, albedo, 1.0))
    return Scene((Instance(mesh),), (material,), (), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
