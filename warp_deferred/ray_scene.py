"""Trees for shadow rays: one of each mesh's triangles, and one of the instances' boxes, refitted every frame."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from .device_scene import DeviceScene
    from .resources import Resources

__all__ = ["RayScene"]


class RayScene:
    """What rays are tested against, beside the device scene's own geometry.

    Attributes:
        meshes: Tree of each instance's triangles, 0 where it has none; uint64.
        worlds: World of each instance; int32.
        low: World box of each instance, written before every frame; vec3.
        high: Its other corner.
        inverses: World to object; mat33.
        tree: Tree of the boxes.
        bound: Trees of meshes whose points are bound.
    """

    def __init__(self, scene: DeviceScene) -> None:
        device, count = scene.device, max(scene.instance_count, 1)
        self._trees = [_mesh_tree(mesh.positions, mesh.triangles, device) for mesh in scene.meshes]
        handles = [self._trees[k].id if self._trees[k] else 0 for k in scene.mesh_of]
        self.meshes = wp.array(handles or [0], dtype=wp.uint64, device=device)
        self.worlds = wp.array(list(scene.worlds) or [-1], dtype=wp.int32, device=device)
        self.low = wp.zeros(count, dtype=wp.vec3, device=device)
        self.high = wp.zeros(count, dtype=wp.vec3, device=device)
        self.inverses = wp.zeros(count, dtype=wp.mat33, device=device)
        self.tree = wp.Bvh(self.low, self.high)
        self.bound = [
            BoundTree(scene.first_vertex[id(mesh)], scene.first_triangle[id(mesh)], tree)
            for mesh, tree in zip(scene.meshes, self._trees, strict=True)
            if id(mesh) in scene.bound and tree is not None
        ]


@dataclasses.dataclass(frozen=True)
class BoundTree:
    """Tree of a mesh with bound points, and where the mesh lies in the scene's arrays."""

    first_vertex: int
    first_triangle: int
    tree: wp.Mesh

    def update(self, resources: Resources) -> None:
        """Add the launches that bring it up to date."""
        from .kernels import shadow_rays

        program, geometry = resources.program, resources.scene.geometry
        points, indices = self.tree.points, self.tree.indices
        program.launch(
            shadow_rays.refresh_points_kernel,
            len(points),
            [geometry, self.first_vertex],
            [points],
            block_dim=shadow_rays.BLOCK_DIM,
        )
        program.launch(
            shadow_rays.refresh_faces_kernel,
            len(indices) // 3,
            [geometry, self.first_vertex, self.first_triangle],
            [indices],
            block_dim=shadow_rays.BLOCK_DIM,
        )
        program.call(self.tree.refit)


def _mesh_tree(positions: np.ndarray, triangles: np.ndarray, device: wp.Device) -> wp.Mesh | None:
    """Tree of a mesh; a face with a vertex that is not finite is shrunk to a point, which keeps all faces' numbers."""
    if not len(triangles):
        return None
    good = np.isfinite(positions).all(axis=1)
    faces = np.where(good[triangles].all(axis=1, keepdims=True), triangles, 0)
    points = wp.array(np.where(good[:, None], positions, 0.0).astype(np.float32), dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(faces.astype(np.int32).reshape(-1), dtype=wp.int32, device=device))
