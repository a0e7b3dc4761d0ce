"""Ambient visibility: how much of the constant ambient light each pixel sees."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels import ambient_visibility as gtao
from ..kernels import ambient_visibility_ssao as ssao
from ..kernels import bilateral, depth_pyramid, visibility_upsampling
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass
from .resolve import gbuffer_buffers, gbuffer_codec, make_gbuffer

__all__ = ["AmbientVisibilityPass"]

#: Beyond it the squared radius would leave float32 [m].
LARGEST_RADIUS = 1e18


class AmbientVisibilityPass(Pass):
    """Share of ambient light that reaches each surface."""

    name = "ambient_visibility"
    # Culling lights waits more than it computes; gathering fills the card.
    beside = ("lights", "light_culling")
    doc = "find how much ambient light each surface sees"

    def rung(self) -> str:
        """Rung."""
        return self.request.settings.ambient_visibility.rung

    def reads(self) -> tuple[str, ...]:
        """Depth and normals."""
        return ("depth", *gbuffer_buffers(self.request, self.layout), *(["rays"] * (self.rung() == "ray_traced")))

    def writes(self) -> dict[str, Buffer]:
        """Visibility, and what its making needs: the depth pyramid, words before and after the narrow blur."""
        pixels = max(self.layout.pixels, 1)
        result = {"ambient_visibility": Buffer(wp.float32, pixels)}
        if self.rung() != "ray_traced":
            bins = max(self.layout.shown_bins, 1)
            words = bins * 64 if self.half else pixels
            result |= {
                "visibility_pyramid": Buffer(wp.float32, bins * depth_pyramid.BIN_WORDS),
                "visibility_words": Buffer(wp.uint32, words),
                "visibility_narrow": Buffer(wp.uint32, words),
            }
        return result

    @property
    def half(self) -> bool:
        """Whether horizons are searched at half size."""
        return self.rung() == "gtao_half"

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, upload patterns; for the reference rung have the trees for rays made."""
        settings, codec = self.request.settings.ambient_visibility, gbuffer_codec(self.request)
        low, high = resources.scene.box()
        radius = float(np.linalg.norm(high - low)) / 20.0 if settings.radius_m is None else settings.radius_m
        self.radius = min(radius, LARGEST_RADIUS)
        self.gbuffer = make_gbuffer(resources)
        if self.rung() == "ray_traced":
            from ..kernels import ambient_visibility_traced as traced
            from ..kernels.hemisphere import cosine_directions

            self.rays = resources.scene.rays().struct()
            self.gather = traced.make_ambient_visibility_traced_kernel(codec)
            table = cosine_directions(settings.rays)
        elif self.rung() == "ssao":
            self.gather = ssao.make_ambient_visibility_ssao_kernel(codec)
            table = ssao.hemisphere_points(settings.samples)
        else:
            self.gather = gtao.make_ambient_visibility_kernel(codec, settings.slices, settings.steps, self.half)
            table = gtao.slice_pattern(settings.slices)
        if self.rung() != "ray_traced":
            self.blurs = [bilateral.make_blur_kernel(self.half, wide) for wide in (False, True)]
        self.table = wp.array(table, dtype=wp.vec4, device=resources.device)

    def run(self, resources: Resources) -> None:
        """Rays; or pyramid, gathering, narrow and wide blur, and up to full size."""
        if self.rung() == "ray_traced":
            self._trace(resources)
            return
        program, views, channels = resources.program, resources.frame.views, resources.channels
        pyramid, words, narrow = (channels[f"visibility_{n}"] for n in ("pyramid", "words", "narrow"))
        final, power = channels["ambient_visibility"], self.request.settings.ambient_visibility.power
        over_bins = self.layout.shown_bins * 64
        over_blocks = len(self.layout.blocks) * 64
        tiles, threads = (resources.bin_tiles, over_bins) if self.half else (resources.blocks, over_blocks)
        program.launch(
            depth_pyramid.fill_pyramid_kernel, over_bins, [views, resources.bin_tiles, channels["depth"], FIRST],
            [pyramid], block_dim=depth_pyramid.BLOCK_DIM, band=64,
        )  # fmt: skip
        inputs = [views, tiles, self.gbuffer, pyramid, self.table, *self._gather_parameters(), FIRST]
        program.launch(self.gather, threads, inputs, [words], block_dim=gtao.BLOCK_DIM, band=64)
        # The wide blur finishes, or hands over to the upsampling.
        stages = zip(self.blurs, (words, narrow), (narrow, words if self.half else final), strict=True)
        for blur, source, target in stages:
            inputs = [views, resources.bin_tiles, source, self.radius, power, FIRST]
            program.launch(blur, over_bins, inputs, [target], block_dim=bilateral.BLOCK_DIM, band=64)
        if self.half:
            inputs = [views, resources.bin_tiles, channels["depth"], words, self.radius, power, FIRST]
            program.launch(
                visibility_upsampling.upsample_kernel, over_bins, inputs, [final],
                block_dim=visibility_upsampling.BLOCK_DIM, band=64,
            )  # fmt: skip

    def _gather_parameters(self) -> list[float]:
        settings = self.request.settings.ambient_visibility
        if self.rung() == "ssao":
            return [settings.samples, self.radius, settings.bias]
        return [self.radius, gtao.falloff_of(self.radius)]

    def _trace(self, resources: Resources) -> None:
        from ..kernels.ambient_visibility_traced import BLOCK_DIM

        settings = self.request.settings.ambient_visibility
        inputs = [
            resources.frame.views, resources.blocks, self.rays, self.gbuffer, self.table, self.radius, settings.bias,
            settings.power, FIRST,
        ]  # fmt: skip
        resources.program.launch(
            self.gather, len(self.layout.blocks) * 64, inputs, [resources.channels["ambient_visibility"]],
            block_dim=BLOCK_DIM, band=64,
        )  # fmt: skip

    def bytes_moved(self) -> int:
        """Depth and normals in, visibility out; the pyramid; words twice each way, half size thrice, depth again."""
        if self.rung() == "ray_traced":
            return self.layout.pixels * 12
        words = 24 * 0.25 + 4 if self.half else 8 + 8
        return int(self.layout.pixels * (8 + 1.33 + words + 4))
