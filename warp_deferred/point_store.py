"""Meshes with bound points on the device: the tables their kernels walk, and the staging of the points of a frame.

Made with the device scene, and only for a scene that has bindings; what the tables say does not change from frame to
frame. Arrays that come from the device are staged before every frame, those of the host once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from .device_arrays import as_float_array
from .device_scene import DeviceScene
from .errors import CapacityError
from .kernels import points as kernels
from .normals import weld
from .scene import Mesh, PointBinding, Scene

__all__ = ["PointStore"]

MAX_ELEMENTS = 2**31 - 1


class PointStore:
    """Tables of all bound meshes of a device scene, in the order of the bindings.

    Attributes:
        groups: Array of vec4i: first corner, corners, first member, members of each place that shares a normal.
        corners: Array of vec4i: a corner's vertex and the two that follow in its triangle.
        members: Array of int32: the vertices that take a group's normal.
        clusters: Array of vec2i: cluster, first triangle of its mesh.
        meshes: Array of `kernels.points.BoundMesh`.
        places: Array of int32: instances of the meshes, mesh after mesh.
        bytes: Device memory held.
    """

    def __init__(self, scene: Scene, device_scene: DeviceScene) -> None:
        self.device = device_scene.device
        self._scene = device_scene
        meshes = [mesh for binding in scene.point_bindings for mesh in binding.meshes]
        _check_capacity(meshes)
        self.bytes = 0
        self._build_meshes(scene, meshes)
        self._build_groups([mesh for mesh in meshes if mesh.normals is not None or mesh.smooth])
        self._targets: list[wp.array] = []
        first = 0
        for binding in scene.point_bindings:
            rows = [
                np.stack(
                    [device_scene.first_vertex[id(m)] + np.arange(len(m.positions)), np.full(len(m.positions), k)], 1
                )
                for k, m in enumerate(binding.meshes, first)
            ]
            self._targets.append(self._put(np.concatenate(rows), wp.vec2i))
            first += len(binding.meshes)
        self._staged: list[np.ndarray | None] = [None] * len(self._targets)

    def _put(self, rows: np.ndarray, dtype: type) -> wp.array:
        if not len(rows):
            rows = np.zeros((1, *rows.shape[1:]), rows.dtype)
        kind = np.int32 if rows.dtype.names is None else rows.dtype
        array = wp.array(rows.astype(kind), dtype=dtype, device=self.device)
        self.bytes += array.capacity
        return array

    def _build_meshes(self, scene: Scene, meshes: list[Mesh]) -> None:
        table = np.zeros(len(meshes), np.dtype(kernels.BoundMesh.numpy_dtype()))
        of_mesh: dict[int, list[int]] = {}
        for place, k in enumerate(self._scene.order):
            of_mesh.setdefault(id(scene.instances[k].mesh), []).append(place)
        clusters: list[np.ndarray] = [np.zeros((0, 2), np.int32)]
        places: list[int] = []
        count = 0
        for row, mesh in zip(table, meshes, strict=True):
            first, own = self._scene.cluster_range[id(mesh)]
            row["origin"] = mesh.origin
            row["cluster_first"], row["cluster_count"] = count, own
            row["instance_first"], row["instance_count"] = len(places), len(of_mesh[id(mesh)])
            pairs = np.empty((own, 2), np.int32)
            pairs[:, 0], pairs[:, 1] = first + np.arange(own), self._scene.first_triangle[id(mesh)]
            clusters.append(pairs)
            places += of_mesh[id(mesh)]
            count += own
        self.mesh_count, self.cluster_count = len(meshes), count
        self.meshes = self._put(table, kernels.BoundMesh)
        self.clusters = self._put(np.concatenate(clusters), wp.vec2i)
        self.places = self._put(np.array(places, np.int32), wp.int32)

    def _build_groups(self, meshes: list[Mesh]) -> None:
        """Gather lists of the meshes whose normals are averaged; seams stay welded as they were at load."""
        groups, corners, members = ([np.zeros((0, 4), np.int64)], [np.zeros((0, 4), np.int64)], [np.zeros(0, np.int64)])
        corner_count = member_count = 0
        for mesh in meshes:
            count, vertex = len(mesh.positions), self._scene.first_vertex[id(mesh)]
            group = np.arange(count)
            if count and np.ptp(mesh.positions, axis=0).any():
                # Positions that are all the same are not places, but stand for ones yet to come.
                group = weld(mesh.positions, mesh.normals)
            turned = np.stack([mesh.triangles, mesh.triangles[:, [1, 2, 0]], mesh.triangles[:, [2, 0, 1]]], axis=2)
            rows = np.zeros((3 * len(mesh.triangles), 4), np.int64)
            rows[:, :3] = turned.reshape(-1, 3)
            owner = group[rows[:, 0]]
            rows[:, :3] += vertex
            places = int(group.max()) + 1 if count else 0
            table = np.empty((places, 4), np.int64)
            table[:, 1], table[:, 3] = np.bincount(owner, minlength=places), np.bincount(group, minlength=places)
            table[:, 0] = corner_count + np.cumsum(table[:, 1]) - table[:, 1]
            table[:, 2] = member_count + np.cumsum(table[:, 3]) - table[:, 3]
            groups.append(table)
            corners.append(rows[np.argsort(owner, kind="stable")])
            members.append(np.argsort(group, kind="stable") + vertex)
            corner_count += len(rows)
            member_count += count
        self.group_count = sum(map(len, groups))
        self.groups = self._put(np.concatenate(groups), wp.vec4i)
        self.corners = self._put(np.concatenate(corners), wp.vec4i)
        self.members = self._put(np.concatenate(members), wp.int32)

    def stage(self, bindings: Sequence[PointBinding]) -> None:
        """Copy the points of a frame to their vertices, on the device.

        Raises:
            InputError: If a device array holds other numbers or has another shape.
        """
        for k, (binding, targets) in enumerate(zip(bindings, self._targets, strict=True)):
            given, count = binding.array, binding.vertex_count
            if count == 0:
                continue
            if isinstance(given, np.ndarray):
                if self._staged[k] is given:
                    continue
                array = wp.array(given, dtype=wp.float32, device="cpu", copy=False).to(self.device)
            else:
                array = as_float_array("Scene.bind_points", given, self.device, (count, 3))
            wp.launch(
                kernels.stage_points_kernel,
                dim=count,
                inputs=[array, targets, self.meshes],
                outputs=[self._scene.geometry.positions],
                device=self.device,
                block_dim=kernels.BLOCK_DIM,
            )
            self._staged[k] = given if isinstance(given, np.ndarray) else None


def _check_capacity(meshes: list[Mesh]) -> None:
    corners = 3 * sum(len(m.triangles) for m in meshes)
    if corners > MAX_ELEMENTS:
        raise CapacityError(
            f"Scene.bind_points: expected at most {MAX_ELEMENTS // 3} triangles over all bound meshes, "
            f"got {corners // 3}; bind fewer"
        )
