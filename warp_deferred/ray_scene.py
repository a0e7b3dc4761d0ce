"""Trees for rays, one set a scene, for every pass that traces: one of each mesh's triangles, one of instances' boxes.

Made when a plan first traces, and kept with the scene; `passes/ray_scene.py` brings them up to date.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .kernels import ray_scene as kernels
from .memory import enough_memory
from .program import Program

if TYPE_CHECKING:
    from .device_scene import DeviceScene

__all__ = ["RayScene"]

#: Bytes of a tree's node in Warp 1.19: two corners with a child's index each, its parent, and on CUDA a counter.
NODE_BYTES = {"cpu": 36, "cuda": 40}


class RayScene:
    """What rays are tested against, beside the device scene's own geometry.

    Attributes:
        meshes: Tree of each instance's triangles, 0 where it has none; uint64.
        worlds: World of each instance; int32.
        low: World box of each instance; vec3.
        high: Its other corner.
        inverses: World to object; mat33.
        tree: Tree of the boxes.
        bound: Trees of meshes whose points are bound.
        bytes: Device memory held, Warp's own for the trees included.
    """

    def __init__(self, scene: DeviceScene) -> None:
        device, count = scene.device, max(scene.instance_count, 1)
        self._scene = scene
        faces = [len(mesh.triangles) for mesh in scene.meshes]
        nodes = [tree_bytes(device, number) + 24 * number for number in faces] + [tree_bytes(device, count)]
        mine = sum(12 * len(m.positions) + 12 * len(m.triangles) for m in scene.meshes) + count * (8 + 4 + 24 + 36)
        self.bytes = sum(nodes) + mine
        with enough_memory("trees for rays", self.bytes, device, "take rungs that trace no rays, or split the scene"):
            self._trees = [_mesh_tree(mesh.positions, mesh.triangles, device) for mesh in scene.meshes]
            handles = [self._trees[k].id if self._trees[k] else 0 for k in scene.mesh_of]
            self.meshes = wp.array(handles or [0], dtype=wp.uint64, device=device)
            self.worlds = wp.array(list(scene.worlds) or [-1], dtype=wp.int32, device=device)
            self.low = wp.zeros(count, dtype=wp.vec3, device=device)
            self.high = wp.zeros(count, dtype=wp.vec3, device=device)
            self.inverses = wp.zeros(count, dtype=wp.mat33, device=device)
            # A tree is cut by what its boxes are now, and only refitted later.
            wp.launch(
                kernels.place_instances_kernel, dim=scene.instance_count, inputs=[scene.geometry],
                outputs=[self.low, self.high, self.inverses], device=device, block_dim=kernels.BLOCK_DIM,
            )  # fmt: skip
            self.tree = wp.Bvh(self.low, self.high)
        self.bound = [
            BoundTree(scene.first_vertex[id(mesh)], scene.first_triangle[id(mesh)], tree)
            for mesh, tree in zip(scene.meshes, self._trees, strict=True)
            if id(mesh) in scene.bound and tree is not None
        ]

    def struct(self) -> kernels.RayScene:
        """What kernels trace against."""
        rays = kernels.RayScene()
        rays.geometry, rays.materials = self._scene.geometry, self._scene.materials
        rays.meshes, rays.worlds, rays.inverses = self.meshes, self.worlds, self.inverses
        rays.tree = self.tree.id
        return rays

    def add_points(self, program: Program) -> None:
        """Add the launches that bring trees of bound points up to date."""
        geometry, block = self._scene.geometry, {"block_dim": kernels.BLOCK_DIM}
        for bound in self.bound:
            points, indices = bound.tree.points, bound.tree.indices
            inputs = [geometry, bound.first_vertex]
            program.launch(kernels.refresh_points_kernel, len(points), inputs, [points], **block)
            inputs = [geometry, bound.first_vertex, bound.first_triangle]
            program.launch(kernels.refresh_faces_kernel, len(indices) // 3, inputs, [indices], **block)
            program.call(bound.tree.refit)

    def add_instances(self, program: Program) -> None:
        """Add the launches that bring boxes and inverses of instances up to date."""
        outputs = [self.low, self.high, self.inverses]
        program.launch(
            kernels.place_instances_kernel, self._scene.instance_count, [self._scene.geometry], outputs,
            block_dim=kernels.BLOCK_DIM,
        )  # fmt: skip
        program.call(self.tree.refit)


@dataclasses.dataclass(frozen=True)
class BoundTree:
    """Tree of a mesh with bound points, and where the mesh lies in the scene's arrays."""

    first_vertex: int
    first_triangle: int
    tree: wp.Mesh


def tree_bytes(device: wp.Device, count: int) -> int:
    """Bytes that Warp 1.19 holds for a tree over `count` boxes: 2 count - 1 nodes and a list of the boxes.

    Source: wp_bvh_create_device and TopDownBVHBuilder of warp/native/bvh.cu and bvh.cpp; a mesh adds its triangles'
    boxes, 24 bytes each. Without the descriptor, some 300 bytes a tree.
    """
    node = NODE_BYTES["cuda" if device.is_cuda else "cpu"]
    return node * (2 * count - 1) + 4 * count if count else 0


def _mesh_tree(positions: np.ndarray, triangles: np.ndarray, device: wp.Device) -> wp.Mesh | None:
    """Tree of a mesh; a face with a vertex that is not finite is shrunk to a point, which keeps all faces' numbers."""
    if not len(triangles):
        return None
    good = np.isfinite(positions).all(axis=1)
    faces = np.where(good[triangles].all(axis=1, keepdims=True), triangles, 0)
    points = wp.array(np.where(good[:, None], positions, 0.0).astype(np.float32), dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(faces.astype(np.int32).reshape(-1), dtype=wp.int32, device=device))
