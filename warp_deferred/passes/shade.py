"""Shade: light the G-buffer by each tile's lights; where light masks come in bands, band by band."""

from __future__ import annotations

import functools

import warp as wp

from ..effects import called_for
from ..kernels import shade as kernels
from ..kernels.light_culling import make_light_culling_kernels
from ..program import FIRST
from ..resources import Resources
from ..shadow_maps import make_shadows, shadow_arguments, shadow_channels
from .base import LIT_OUTPUTS, Buffer, Pass
from .image import all_writes, float_image, make_image
from .light_culling import Band, culls_by_band, fill_masks, make_masks, mask_bands, mask_words
from .resolve import depth_buffers, depth_format, gbuffer_buffers, gbuffer_codec, make_gbuffer

__all__ = ["ShadePass"]

TYPES = {"diffuse": wp.vec3, "specular": wp.vec3, "light_count": wp.int32}


class ShadePass(Pass):
    """Outgoing radiance of every pixel."""

    name = "shade"
    doc = "accumulate diffuse and specular light"
    image = "write"

    @functools.cached_property
    def bands(self) -> tuple[Band, ...]:
        """Bands the blocks are shaded in."""
        return mask_bands(self.request, self.layout)

    @property
    def culls(self) -> bool:
        """Whether the masks are filled here, band by band."""
        return culls_by_band(self.request, self.bands)

    def called_for(self) -> str | None:
        """Something lit is asked for, or a user's own pass works on the image."""
        names = [n for n in LIT_OUTPUTS if n in self.request.outputs]
        if not names and self.request.lit:
            names = [stage.name for stage in self.request.passes if stage.image]
        return f"{', '.join(names)} asked for" if names else None

    def rung(self) -> str:
        """Radiance format, and what else is not at its most exact."""
        shade = self.request.settings.shade
        sums = ["half sums"] * (shade.accumulation == "half")
        rounding = [shade.arithmetic] * (shade.arithmetic != "precise")
        return ", ".join(["float32" if float_image(self.request) else "half", *sums, *rounding])

    def reads(self) -> tuple[str, ...]:
        """G-buffer, masks, lights."""
        names = [*depth_buffers(self.request, self.layout), *gbuffer_buffers(self.request, self.layout)]
        if self.request.features.emissive:
            names.append("emission")
        if self.request.features.kinds:
            names += ["mask_words", "mask_summary", "staged_lights"]
        if called_for(self.request, "ambient_visibility"):
            names.append("ambient_visibility")
        if self.culls:
            names += ["mask_coarse", "mask_bounds", "mask_coarse_bounds"]
        names += shadow_channels(self.request)
        return tuple(names)

    def writes(self) -> dict[str, Buffer]:
        """The parts asked for."""
        return {n: Buffer(t, max(self.layout.pixels, 1)) for n, t in TYPES.items() if n in self.request.outputs}

    def _bright_level(self) -> float | None:
        """Exposed radiance above which the pass tells bloom that it has work; None where nobody listens."""
        if not called_for(self.request, "bloom"):
            return None
        from .bloom import bright_level

        return bright_level(self.request)

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, build the structs."""
        features = self.request.features
        full = float_image(self.request)
        outputs = ("color",) * full + tuple(n for n in TYPES if n in self.request.outputs)
        level = self._bright_level()
        if level is not None:
            outputs += ("bright",)
        self.kernel = kernels.make_shade_kernel(
            gbuffer_codec(self.request),
            features.models,
            features.kinds,
            features.polynomial,
            features.emissive,
            outputs,
            "ambient_visibility" in self.reads(),
            shadow_arguments(self.request),
            depth_format(self.request),
            self.request.settings.shade.accumulation,
            self.request.settings.shade.arithmetic,
        )
        self.shadows = make_shadows(resources, self.request)
        self.gbuffer = make_gbuffer(resources)
        if self.culls:
            depth_bounds = self.request.settings.light_culling.rung == "tiles_depth"
            self.culling = make_light_culling_kernels(depth_bounds)
        self.masks = [make_masks(resources, self.request, band) for band in self.bands]
        self.out = kernels.ShadeTarget()
        for name, dtype in TYPES.items():
            setattr(self.out, name, resources.channel(name, dtype))
        image = make_image(resources, self.request, self.target)
        self.out.color, self.out.radiance = image.full, image.half
        self.out.bright, self.out.bright_level = resources.frame.bright, level or 0.0

    def run(self, resources: Resources) -> None:
        """One launch a band, after those that fill its masks where there are several."""
        frame = resources.frame
        emission = resources.channel("emission", wp.vec3)
        visibility = resources.channel("ambient_visibility", wp.float32)
        for band, masks in zip(self.bands, self.masks, strict=True):
            if self.culls:
                fill_masks(resources, self.request, self.culling, masks, band)
            blocks = resources.blocks[band.blocks]
            lights = resources.lights.staged
            resources.program.launch(
                self.kernel,
                (band.blocks.stop - band.blocks.start) * 64,
                [
                    frame.views,
                    frame.values,
                    blocks,
                    self.gbuffer,
                    emission,
                    visibility,
                    lights,
                    masks,
                    self.shadows,
                    FIRST,
                ],
                [self.out],
                block_dim=kernels.BLOCK_DIM,
                band=64,
            )

    def bytes_moved(self) -> int:
        """G-buffer in, radiance out; and the masks that are filled here."""
        buffers = depth_buffers(self.request, self.layout) | gbuffer_buffers(self.request, self.layout)
        read = sum(wp.types.type_size_in_bytes(b.dtype) for b in buffers.values())
        read += 4 * ("ambient_visibility" in self.reads())
        written = sum(wp.types.type_size_in_bytes(b.dtype) for b in all_writes(self).values())
        masks = len(self.layout.tiles) * mask_words(self.request)[0] * 4 if self.culls else 0
        return self.layout.pixels * (read + written) + masks
