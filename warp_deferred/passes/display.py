"""Display: exposure, tone mapping and sRGB encoding."""

from __future__ import annotations

import warp as wp

from ..effects import called_for
from ..kernels import color as color_kernels
from ..kernels import display as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass, Request
from .image import float_image, image_bytes, make_image

__all__ = ["ALIASED", "DisplayPass", "shown_channel"]

#: Channel of the picture where a later pass makes the public one of it.
ALIASED = "display_aliased"


def shown_channel(request: Request) -> str:
    """Channel that the picture, or the view in its place, is written to: `display`, or what is scaled up to it."""
    return "display" if request.settings.scale.rung == "off" else "display_rendered"


class DisplayPass(Pass):
    """The picture people look at."""

    name = "display"
    doc = "expose, tone map and encode"
    image = "read"
    scope = "frame_end"

    def called_for(self) -> str | None:
        """Only for its own output, and where no debug view takes its place."""
        wanted = "display" in self.request.outputs and self.request.settings.display.view == "picture"
        return "display asked for" if wanted else None

    def why_not(self) -> str:
        """A debug view, or nobody asked."""
        view = self.request.settings.display.view
        return super().why_not() if view == "picture" else f"display.view is {view}"

    def rung(self) -> str:
        """Tone curve."""
        return self.request.settings.display.tone_mapping

    @property
    def blooms(self) -> bool:
        """Whether bloom is in the plan."""
        return called_for(self.request, "bloom")

    @property
    def written(self) -> str:
        """Name of the channel it writes."""
        return ALIASED if called_for(self.request, "anti_aliasing") else shown_channel(self.request)

    def reads(self) -> tuple[str, ...]:
        """Bloom where there is some."""
        return ("bloom",) * self.blooms

    def writes(self) -> dict[str, Buffer]:
        """Encoded bytes."""
        return {self.written: Buffer(wp.uint32, max(self.layout.pixels, 1), public=wp.vec4ub)}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel, upload the thresholds."""
        self.bloom, kind = structs.Bloom(), ""
        if self.blooms:
            from .bloom import make_bloom

            self.bloom = make_bloom(resources, self.request, self.layout)
            kind = "full" if self.request.settings.bloom.rung == "exact" else "levels"
        self.kernel = kernels.make_display_kernel(self.rung(), not float_image(self.request), kind)
        self.thresholds = wp.array(color_kernels.srgb_thresholds(), dtype=wp.float32, device=resources.device)

    def run(self, resources: Resources) -> None:
        """One launch."""
        image = make_image(resources, self.request, self.source)
        inputs = [
            resources.frame.views,
            resources.bin_tiles,
            image.half,
            image.full,
            self.thresholds,
            self.bloom,
            FIRST,
        ]
        resources.program.launch(
            self.kernel,
            self.layout.shown_bins * 64,
            inputs,
            [resources.channels[self.written]],
            block_dim=kernels.BLOCK_DIM,
            band=64,
        )

    def bytes_moved(self) -> int:
        """Radiance and bloom in, bytes out."""
        bloom = (12 if self.request.settings.bloom.rung == "exact" else 2) if self.blooms else 0
        return self.layout.pixels * (image_bytes(self.request) + bloom + 4)
