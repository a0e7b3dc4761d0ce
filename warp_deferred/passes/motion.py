"""Motion: how far each pixel's surface moved in the image since the frame before."""

from __future__ import annotations

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

    def reads(self) -> tuple[str, ...]:
        """Keys of the pixels' centres; depth is in them."""
        return ("keys",)

    def writes(self) -> dict[str, Buffer]:
        """Motion, and how each pair's image came about."""
        return {
            "motion": Buffer(wp.vec2, max(self.layout.pixels, 1)),
            "motion_steps": Buffer(kernels.Step, max(self.request.pairs, 1) + self.request.cameras),
        }

    def prepare(self, resources: Resources) -> None:
        """Make room for the poses of the frame before, which nobody else sees."""
        device, transforms = resources.device, resources.scene.geometry.transforms
        self.old_views = wp.zeros(self.request.cameras, dtype=structs.View, device=device)
        self.old_transforms = wp.zeros_like(transforms)
        self.known = resources.channels["motion_known"] = wp.zeros(1, dtype=wp.int32, device=device)

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
        count = max(self.request.cameras, geometry.transforms.shape[0])
        kept = [self.old_views, self.old_transforms, self.known]
        program.launch(kernels.remember_kernel, count, [views, geometry.transforms], kept, **block)

    def bytes_moved(self) -> int:
        """Keys in, motion out; steps out and in."""
        return self.layout.pixels * (8 + 8) + self.request.pairs * 2 * 48
