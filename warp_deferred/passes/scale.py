"""Scale: the picture, rendered smaller, up-scaled to the size it is shown at. Last of the frame."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels import scale as kernels
from ..program import FIRST
from ..resources import Resources
from ..views import ViewLayout, ViewSize, table_array
from .base import Buffer, Pass
from .display import shown_channel

__all__ = ["ScalePass"]


class ScalePass(Pass):
    """The rendered picture at the size asked for."""

    name = "scale"
    doc = "scale the picture up"
    scope = "frame_end"

    @property
    def filter(self) -> str:
        """A debug view's pixels are shown as they are: nothing lies between two ids."""
        settings = self.request.settings
        return settings.scale.filter if settings.display.view == "picture" else "nearest"

    def rung(self) -> str:
        """Share and filter."""
        return f"{self.request.settings.scale.rung}, {self.filter}"

    def reads(self) -> tuple[str, ...]:
        """The picture as rendered."""
        return (shown_channel(self.request),)

    def writes(self) -> dict[str, Buffer]:
        """The picture."""
        return {"display": Buffer(wp.uint32, max(self.layout.shown_pixels, 1), public=wp.vec4ub)}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel; tables of the shown pixels' blocks and of where each view's picture lies."""
        self.kernel = kernels.make_scale_kernel(self.filter)
        # Views of depth alone are behind the others and have no picture.
        sizes = [size.shown for size in self.layout.sizes if not size.depth_only]
        self.table = ViewLayout(tuple(ViewSize(*size) for size in sizes), 16).blocks
        self.blocks = table_array(self.table, resources.device)
        ends = np.cumsum([0, *(width * height for width, height in sizes)])
        rows = [(start, *size, 0) for start, size in zip(ends, sizes, strict=False)]
        self.places = table_array(np.array(rows, np.int32), resources.device)

    def run(self, resources: Resources) -> None:
        """One launch."""
        image = resources.channels[shown_channel(self.request)]
        resources.program.launch(
            self.kernel,
            len(self.table) * 64,
            [resources.frame.views, self.blocks, self.places, image, FIRST],
            [resources.channels["display"]],
            block_dim=kernels.BLOCK_DIM,
            band=64,
        )

    def bytes_moved(self) -> int:
        """The small picture in, the large one out."""
        return 4 * (self.layout.pixels + self.layout.shown_pixels)
