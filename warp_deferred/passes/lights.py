"""Lights: stage every light for every view, positions relative to the eye."""

from __future__ import annotations

from ..kernels import lights as kernels
from ..program import FIRST
from ..resources import Resources
from ..sampling import lens_samples, shutter_samples
from ..views import ViewLayout
from .base import Buffer, Pass, Request

__all__ = ["LightsPass"]


class LightsPass(Pass):
    """Lights as shading reads them."""

    name = "lights"
    doc = "stage lights relative to each view"
    # Samples move within the pixel, not the eye, unless they are points of a lens.
    scope = "frame_start"

    def bound(self, request: Request, layout: ViewLayout) -> Pass:
        """Run in each sample where samples move the eye."""
        stage = super().bound(request, layout)
        if max(lens_samples(request), shutter_samples(request)) > 1:
            object.__setattr__(stage, "scope", "sample")
        return stage

    def called_for(self) -> str | None:
        """Lights, and something lit by them."""
        if self.request.features.kinds and self.request.lit:
            infinite = self.request.features.infinite_lights
            return "the scene has lights" + (f" ({infinite} without a range, in every tile)" if infinite else "")
        return None

    def why_not(self) -> str:
        """No light, or nothing lit."""
        return "no light in the scene" if not self.request.features.kinds else "no lit output asked for"

    def reads(self) -> tuple[str, ...]:
        """Nothing but the scene."""
        return ()

    def writes(self) -> dict[str, Buffer]:
        """The staged lights live in the light store."""
        return {"staged_lights": Buffer(None, 0)}

    def run(self, resources: Resources) -> None:
        """One launch."""
        lights, frame = resources.lights, resources.frame
        resources.program.launch(
            kernels.stage_lights_kernel,
            (self.request.cameras, lights.capacity),
            [frame.views, frame.values, lights.source, FIRST],
            [lights.staged],
            block_dim=kernels.BLOCK_DIM,
        )

    def bytes_moved(self) -> int:
        """Source in, staged out."""
        capacity = self.request.features.light_capacity
        return capacity * (100 + 64) + capacity * self.request.cameras * 16
