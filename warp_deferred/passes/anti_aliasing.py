"""Anti-aliasing of the finished picture; what averages samples is in sampling.py."""

from __future__ import annotations

import warp as wp

from ..kernels import anti_aliasing as kernels
from ..kernels import color as color_kernels
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass
from .display import ALIASED, shown_channel

__all__ = ["AntiAliasingPass"]


class AntiAliasingPass(Pass):
    """Softens the stairs of display's picture."""

    name = "anti_aliasing"
    doc = "mix pixels across the edges of the picture"
    scope = "frame_end"

    def rung(self) -> str:
        """The method."""
        return self.request.settings.anti_aliasing.rung

    def reads(self) -> tuple[str, ...]:
        """The picture as display leaves it."""
        return (ALIASED,)

    def writes(self) -> dict[str, Buffer]:
        """The picture."""
        return {shown_channel(self.request): Buffer(wp.uint32, max(self.layout.pixels, 1), public=wp.vec4ub)}

    def prepare(self, resources: Resources) -> None:
        """Upload the tables of the encoding."""
        self.tables = [
            wp.array(table, dtype=wp.float32, device=resources.device)
            for table in (color_kernels.srgb_linear(), color_kernels.srgb_thresholds())
        ]

    def run(self, resources: Resources) -> None:
        """One launch."""
        channels = resources.channels
        resources.program.launch(
            kernels.anti_aliasing_kernel,
            len(self.layout.blocks) * 64,
            [resources.frame.views, resources.blocks, channels[ALIASED], *self.tables, FIRST],
            [channels[shown_channel(self.request)]],
            block_dim=kernels.BLOCK_DIM,
            band=64,
        )

    def bytes_moved(self) -> int:
        """The picture in, the picture out."""
        return self.layout.pixels * 8
