"""All triangles of a scene in world space under one Warp BVH: what reference rungs trace rays against.

Built only for plans that trace. Each frame the corners are placed anew and the BVH is refitted on the device, so that
device transforms need no host; after large movements a refitted BVH answers the same and slower. Every face blocks,
from both sides and whole: neither culling nor alpha masks are looked at.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .device_scene import DeviceScene
from .kernels import world_mesh as kernels
from .program import FIRST, Program

__all__ = ["WorldMesh"]


class WorldMesh:
    """Corners, triangles and BVH of a device scene.

    Attributes:
        id: The Warp mesh's handle for kernels; 0 where the scene has no triangle.
        anchor: World position that corners are relative to [m].
        grouped: Whether instances stand in worlds of their own; group 0 is shared, group w + 1 is world w's.
    """

    def __init__(self, scene: DeviceScene) -> None:
        self._scene = scene
        low, high = scene.box()
        middle = (low + high) / 2.0
        self.anchor = wp.vec3d(*middle) if np.isfinite(middle).all() else wp.vec3d()
        placed = scene.placed
        counts = placed[:, 2]
        first = np.cumsum(counts) - counts
        rows = np.arange(counts.sum()) - np.repeat(first - placed[:, 1], counts)
        table = np.stack([np.repeat(placed[:, 0], counts), rows], axis=1).astype(np.int32)
        worlds = np.repeat(placed[:, 3], counts)
        self.grouped = bool((worlds >= 0).any())
        self.id, self._mesh = 0, None
        if not len(table):
            return
        device = scene.device
        self._triangles = wp.array(table, dtype=wp.vec2i, device=device)
        self._points = wp.zeros(3 * len(table), dtype=wp.vec3, device=device)
        wp.launch(
            kernels.place_corners_kernel, dim=3 * len(table),
            inputs=[scene.geometry, self._triangles, self.anchor, 0], outputs=[self._points],
            device=device, block_dim=kernels.BLOCK_DIM,
        )  # fmt: skip
        groups = wp.array(worlds + 1, dtype=wp.int32, device=device) if self.grouped else None
        corners = wp.array(np.arange(3 * len(table)), dtype=wp.int32, device=device)
        self._mesh = wp.Mesh(self._points, corners, groups=groups)
        self.id = self._mesh.id

    def add_update(self, program: Program) -> None:
        """Add the launches that bring corners and BVH up to the frame's transforms."""
        if self._mesh is None:
            return
        inputs = [self._scene.geometry, self._triangles, self.anchor, FIRST]
        program.launch(
            kernels.place_corners_kernel, len(self._points), inputs, [self._points], block_dim=kernels.BLOCK_DIM,
            band=64,
        )  # fmt: skip
        program.call(self._mesh.refit)
