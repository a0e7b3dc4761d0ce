"""Shade: light the G-buffer by each tile's lights."""

from __future__ import annotations

import warp as wp

from ..kernels import shade as kernels
from ..program import FIRST
from ..resources import Resources
from .ambient_visibility import ambient_visibility_reason
from .base import Buffer, Pass
from .light_culling import make_masks
from .resolve import gbuffer_buffers, gbuffer_codec, make_gbuffer, needs_gbuffer

__all__ = ["ShadePass"]

TYPES = {"color": wp.vec3, "diffuse": wp.vec3, "specular": wp.vec3, "light_count": wp.int32, "radiance": wp.uint64}


class ShadePass(Pass):
    """Outgoing radiance of every pixel."""

    name = "shade"
    doc = "accumulate diffuse and specular light"

    def called_for(self) -> str | None:
        """Something lit is asked for."""
        names = [n for n in ("color", "display", "diffuse", "specular", "light_count") if n in self.request.outputs]
        return f"{', '.join(names)} asked for" if names else None

    @property
    def float_color(self) -> bool:
        """Whether radiance is kept in float32: it was asked for, or the setting says so."""
        request = self.request
        return (
            "color" in request.outputs
            or request.settings.shade.radiance == "float32"
            or request.settings.gbuffer.rung == "full"
        )

    def rung(self) -> str:
        """Radiance format."""
        return "float32" if self.float_color else "half"

    def reads(self) -> tuple[str, ...]:
        """G-buffer, masks, lights."""
        names = ["depth", *gbuffer_buffers(self.request, self.layout)]
        if self.request.features.emissive:
            names.append("emission")
        if self.request.features.kinds:
            names += ["mask_words", "mask_summary", "staged_lights"]
        if ambient_visibility_reason(self.request):
            names.append("ambient_visibility")
        return tuple(names)

    def writes(self) -> dict[str, Buffer]:
        """Radiance, and the parts asked for."""
        names = [n for n in ("diffuse", "specular", "light_count") if n in self.request.outputs]
        names.append("color" if self.float_color else "radiance")
        return {n: Buffer(TYPES[n], max(self.layout.pixels, 1)) for n in names}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel, build the structs."""
        features = self.request.features
        outputs = tuple(n for n in kernels.OUTPUTS if n in self.writes())
        self.kernel = kernels.make_shade_kernel(
            gbuffer_codec(self.request),
            features.models,
            features.kinds,
            features.polynomial,
            features.emissive,
            outputs,
            "ambient_visibility" in self.reads(),
        )
        self.gbuffer = make_gbuffer(resources)
        self.masks = make_masks(resources, features.light_capacity)
        self.out = kernels.ShadeTarget()
        for name, dtype in TYPES.items():
            setattr(self.out, name, resources.channel(name, dtype))

    def run(self, resources: Resources) -> None:
        """One launch."""
        frame = resources.frame
        emission = resources.channel("emission", wp.vec3)
        inputs = [
            frame.views,
            frame.values,
            resources.blocks,
            self.gbuffer,
            emission,
            resources.channel("ambient_visibility", wp.float32),
            resources.lights.staged,
            self.masks,
            FIRST,
        ]
        resources.program.launch(
            self.kernel, len(self.layout.blocks) * 64, inputs, [self.out], block_dim=kernels.BLOCK_DIM, band=64
        )

    def bytes_moved(self) -> int:
        """G-buffer in, radiance out."""
        read = 4 + sum(
            wp.types.type_size_in_bytes(b.dtype) for b in gbuffer_buffers(self.request, self.layout).values()
        )
        read += 4 * ("ambient_visibility" in self.reads())
        written = sum(wp.types.type_size_in_bytes(b.dtype) for b in self.writes().values())
        return self.layout.pixels * (read + written) if needs_gbuffer(self.request) else 0
