"""Scenes laid out in pixels, and small helpers to render them; shared by the tests of hard cases.

An orthographic camera of one metre per pixel makes places exact: x_px = x + width / 2, y_px = height / 2 - y, and a
coordinate that is a whole number of 1/256 px snaps to itself. Depth is a power of two apart from its ends, so that
depth values are exact too.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

import warp_deferred as wd

FAR = 16.0
#: One set for nearly all geometry tests: each new set of outputs compiles a kernel of its own.
GEOMETRY = ("depth", "normal", "albedo", "instance_id", "triangle_id")
TWO_SIDED = wd.Material(model="lambert", base_color=(0.5, 0.5, 0.5, 1.0), two_sided=True)


def pixel_camera(height: int, **fields: Any) -> wd.Camera:
    """An orthographic camera of one metre per pixel, at the origin, seeing depths 0 to FAR."""
    return wd.Camera(
        **{"projection": "orthographic", "vertical_extent": float(height), "near": 0.0, "far": FAR} | fields
    )


def at_pixels(points: Any, width: int, height: int, depth: Any = 8.0) -> np.ndarray:
    """World places of points (..., 2) given in pixels, at a depth [m] that broadcasts over them; (..., 3)."""
    points = np.asarray(points, float)
    depth = np.broadcast_to(depth, points.shape[:-1])
    return np.stack([points[..., 0] - width / 2.0, height / 2.0 - points[..., 1], -depth], axis=-1)


def in_front(points: Any, w: Any, camera: wd.Camera, width: int, height: int) -> np.ndarray:
    """World places that a perspective camera at the origin sees at pixels (..., 2) and view depths w (...)."""
    points = np.asarray(points, float)
    fx, fy, cx, cy = camera.pixel_projection(width, height)
    w = np.broadcast_to(w, points.shape[:-1])
    return np.stack([(points[..., 0] - cx) / fx * w, (cy - points[..., 1]) / fy * w, -w], axis=-1)


def loose_mesh(corners: np.ndarray, **fields: Any) -> wd.Mesh:
    """A mesh of triangles (m, 3, 3) that share no vertices."""
    points = np.asarray(corners).reshape(-1, 3)
    return wd.Mesh(points.astype(np.float32), np.arange(len(points)).reshape(-1, 3), **fields)


def scene_of(*meshes: wd.Mesh, material: wd.Material = TWO_SIDED, **placing: Any) -> wd.Scene:
    """A scene of meshes where they are, all of one material."""
    scene = wd.Scene()
    for mesh in meshes:
        scene.add(mesh, material=material, **placing)
    return scene


def settings_of(*assignments: str) -> wd.Settings:
    """Settings from the command line's form."""
    return wd.Settings().with_values(list(assignments))


def render(
    scene: wd.Scene,
    camera: wd.Camera | Sequence[wd.Camera],
    width: int,
    height: int,
    *,
    outputs: Sequence[str] = GEOMETRY,
    settings: Sequence[str] = (),
    device: str = "cpu",
    **fields: Any,
) -> dict[str, np.ndarray]:
    """Render and read back; one camera gives arrays without the view axis."""
    renderer = wd.Renderer(
        scene, width=width, height=height, outputs=outputs, settings=settings_of(*settings), device=device, **fields
    )
    frame = renderer.render(camera)
    if isinstance(camera, wd.Camera):
        return {name: frame.numpy(name)[0].copy() for name in outputs}
    return {name: frame.numpy(name).copy() for name in outputs}


def cover_count(
    points: np.ndarray, triangles: np.ndarray, camera: wd.Camera, width: int, height: int, device: str = "cpu"
) -> np.ndarray:
    """How often each pixel is covered: every triangle is drawn alone, into a view of its own world.

    All of them keep the whole mesh's vertices, so that each is placed to the bit as it is in the whole mesh.
    """
    scene = wd.Scene()
    for k, triangle in enumerate(triangles):
        scene.add(wd.Mesh(points.astype(np.float32), [triangle]), material=TWO_SIDED, world=k)
    cameras = [camera.replace(world=k) for k in range(len(triangles))]
    return (render(scene, cameras, width, height, device=device)["instance_id"] >= 0).sum(axis=0)


def snapped(points_px: np.ndarray) -> np.ndarray:
    """Whole numbers of 1/256 px."""
    return np.floor(np.asarray(points_px) * 256.0 + 0.5).astype(np.int64)


@functools.cache
def grid_triangles(columns: int, rows: int) -> np.ndarray:
    """Triangles (m, 3) of a grid of columns x rows vertices, the diagonals alternating."""
    faces = []
    for y in range(rows - 1):
        for x in range(columns - 1):
            a, b = y * columns + x, (y + 1) * columns + x
            if (x + y) % 2:
                faces += [[a, b, a + 1], [a + 1, b, b + 1]]
            else:
                faces += [[a, b, b + 1], [a, b + 1, a + 1]]
    return np.array(faces)


def assert_same(a: dict[str, np.ndarray], b: dict[str, np.ndarray], names: Sequence[str] | None = None) -> None:
    """Bit-identical images, by name."""
    for name in names or a:
        assert a[name].shape == b[name].shape, name
        different = (a[name] != b[name]).reshape(*a[name].shape[:2], -1).any(axis=-1)
        assert not different.any(), f"{name}: {different.sum()} pixels differ, first {np.argwhere(different)[0]}"
