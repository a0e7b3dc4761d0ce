"""Motion: how far each pixel's surface moved in the image since the frame before."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels import motion as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass

__all__ = ["MotionPass"]


class MotionPass(Pass):
    """Position of each pixel's surface less that of the frame before."""

    name = "motion"
    doc = "compare poses with the frame before"
    scope = "frame_end"

    @property
    def deforms(self) -> bool:
        """Whether points are bound, which move by themselves."""
        return self.request.features.bound_vertices > 0 and self.request.candidates > 0

    def reads(self) -> tuple[str, ...]:
        """Keys of the pixels' centres, in which depth is; and what bound points are interpolated by."""
        return ("keys", "pairs") if self.deforms else ("keys",)

    def writes(self) -> dict[str, Buffer]:
        """Motion, and how each pair's image came about."""
        result = {
            "motion": Buffer(wp.vec2, max(self.layout.pixels, 1)),
            "motion_steps": Buffer(kernels.Step, max(self.request.pairs, 1) + self.request.cameras),
        }
        if self.deforms:
            result["motion_points"] = Buffer(wp.vec4, self.request.features.bound_vertices, persistent=True)
        return result

    def prepare(self, resources: Resources) -> None:
        """Make room for the poses of the frame before, which nobody else sees."""
        device, transforms = resources.device, resources.scene.geometry.transforms
        self.old_views = wp.zeros(self.request.cameras, dtype=structs.View, device=device)
        self.old_transforms = wp.zeros_like(transforms)
        self.known = resources.channels["motion_known"] = wp.zeros(1, dtype=wp.int32, device=device)
        if self.deforms:
            self._prepare_points(resources)

    def _prepare_points(self, resources: Resources) -> None:
        """Say where each bound vertex is kept: mesh after mesh, whatever lies between them in the scene."""
        scene, device = resources.scene, resources.device
        vertices, offsets = [], {}
        count = 0
        for mesh in scene.meshes:
            if id(mesh) in scene.bound:
                first = scene.first_vertex[id(mesh)]
                vertices.append(np.arange(first, first + len(mesh.positions), dtype=np.int32))
                offsets[id(mesh)] = count - first
                count += len(mesh.positions)
        rows = [offsets.get(id(scene.meshes[k]), int(kernels.NOT_BOUND)) for k in scene.mesh_of]
        self.vertices = wp.array(np.concatenate(vertices), dtype=wp.int32, device=device)
        self.past = kernels.Past()
        self.past.known, self.past.views, self.past.transforms = self.known, self.old_views, self.old_transforms
        self.past.points = resources.channels["motion_points"]
        self.past.offsets = wp.array(np.array(rows, np.int32), dtype=wp.int32, device=device)

    def run(self, resources: Resources) -> None:
        """Steps of the pairs, motion of the pixels; then the frame's poses are kept."""
        channels, program = resources.channels, resources.program
        # The views of shadow maps lie behind the cameras', and nobody asks for their motion.
        views = resources.frame.views[: self.request.cameras]
        geometry, steps = resources.scene.geometry, channels["motion_steps"]
        old = [self.known, self.old_views]
        block = {"block_dim": kernels.BLOCK_DIM}
        rows = (self.request.cameras, self.request.instances_per_view + 1)
        inputs = [views, geometry, *old, self.old_transforms]
        program.launch(kernels.prepare_steps_kernel, rows, inputs, [steps], **block)
        inputs = [views, resources.blocks, geometry, channels["keys"], *old, steps, FIRST]
        threads = len(self.layout.blocks) * 64
        program.launch(kernels.motion_kernel, threads, inputs, [channels["motion"]], band=64, **block)
        if self.deforms:
            inputs = [views, resources.blocks, geometry, channels["pairs"], channels["keys"], self.past, steps, FIRST]
            program.launch(kernels.point_motion_kernel, threads, inputs, [channels["motion"]], band=64, **block)
            inputs = [geometry, self.vertices]
            program.launch(kernels.keep_points_kernel, len(self.vertices), inputs, [self.past.points], **block)
        count = max(self.request.cameras, geometry.transforms.shape[0])
        kept = [self.old_views, self.old_transforms, self.known]
        program.launch(kernels.remember_kernel, count, [views, geometry.transforms], kept, **block)

    def bytes_moved(self) -> int:
        """Keys in, motion out; steps out and in."""
        points = self.request.features.bound_vertices * 2 * 16 if self.deforms else 0
        return self.layout.pixels * (8 + 8) + self.request.pairs * 2 * 48 + points
