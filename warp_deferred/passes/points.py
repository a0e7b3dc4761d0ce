"""Points: what hangs on the bound points of deforming meshes, once a frame before anything else looks at them."""

from __future__ import annotations

import warp as wp

from ..kernels import points as kernels
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass

__all__ = ["PointsPass"]

#: Groups of vertices a host thread takes at least.
BAND = 256


class PointsPass(Pass):
    """Normals, cluster bounds and boxes of meshes whose points were staged for this frame."""

    name = "points"
    doc = "normals and bounds of meshes with bound points"
    scope = "frame_start"

    def writes(self) -> dict[str, Buffer]:
        """Boxes of bound clusters, low and high; that they are written tells that the scene's geometry is fresh."""
        return {"points": Buffer(wp.vec3, 2 * max(self.request.features.bound_clusters, 1))}

    def run(self, resources: Resources) -> None:
        """Normals, then clusters, then the boxes of meshes."""
        program, scene = resources.program, resources.scene
        geometry, tables, boxes = scene.geometry, scene.points, resources.channels["points"]
        program.launch(
            kernels.average_normals_kernel,
            tables.group_count,
            [geometry, tables.groups, tables.corners, tables.members, FIRST],
            [geometry.normals],
            block_dim=kernels.BLOCK_DIM,
            band=BAND,
        )
        # Tile operations: one host thread on the CPU.
        program.launch(
            kernels.bound_clusters_kernel,
            tables.cluster_count,
            [geometry, tables.clusters],
            [geometry.cluster_triangles, geometry.clusters, boxes],
            block_dim=kernels.BLOCK_DIM,
            tiled=True,
        )
        program.launch(
            kernels.bound_meshes_kernel,
            tables.mesh_count,
            [tables.meshes, boxes, tables.places],
            [geometry.instances],
            block_dim=kernels.BLOCK_DIM,
            tiled=True,
        )

    def bytes_moved(self) -> int:
        """Positions in and normals out; rows, triangles and records of clusters in, boxes and records out."""
        features = self.request.features
        return features.bound_vertices * (16 + 16) + features.bound_clusters * (128 * 32 + 2 * 48 + 24)
