"""Clusters: prepare (view, instance) pairs and cull clusters into the work list. First pass of the frame."""

from __future__ import annotations

import warp as wp

from ..kernels import clusters as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass

__all__ = ["ClustersPass"]


class ClustersPass(Pass):
    """Which clusters each view may see."""

    name = "clusters"
    doc = "cull clusters of triangles per view"

    def called_for(self) -> str | None:
        """Whatever is seen goes through it."""
        return "the scene has triangles" if self.request.candidates else None

    def why_not(self) -> str:
        """Nothing to draw."""
        return "the scene has no triangles"

    def reads(self) -> tuple[str, ...]:
        """Nothing but the scene, whose bound points must be up to date, and what bounds its shadow maps."""
        names = ("points",) if self.request.features.bound_meshes else ()
        return names + (("shadow_bounds",) if self.request.shadow_slots else ())

    def writes(self) -> dict[str, Buffer]:
        """Pairs and work list."""
        return {
            "pairs": Buffer(structs.Pair, max(self.request.pairs, 1)),
            "work_entries": Buffer(wp.vec2i, max(self.request.candidates, 1)),
            "work_counts": Buffer(wp.int32, 2),
        }

    def prepare(self, resources: Resources) -> None:
        """Build the work list struct."""
        self.work = structs.WorkList()
        self.work.entries = resources.channels["work_entries"]
        self.work.counts = resources.channels["work_counts"]
        self.bounds = resources.channel("shadow_bounds", wp.vec4)

    def run(self, resources: Resources) -> None:
        """Pairs, then clusters."""
        program, views = resources.program, resources.frame.views
        pairs = resources.channels["pairs"]
        rows = len(self.layout.sizes)
        program.launch(
            kernels.prepare_pairs_kernel,
            (rows, max(2, self.request.instances_per_view)),
            [views, resources.scene.geometry, FIRST],
            [pairs, self.work],
            block_dim=kernels.BLOCK_DIM,
        )
        program.launch(
            kernels.cull_clusters_kernel,
            (rows, self.request.clusters_per_view),
            [views, resources.scene.geometry, pairs, self.bounds, self.request.cameras],
            [self.work],
            block_dim=kernels.BLOCK_DIM,
        )

    def bytes_moved(self) -> int:
        """Cluster records and slots in, entries out."""
        return self.request.candidates * (48 + 8 + 8)
