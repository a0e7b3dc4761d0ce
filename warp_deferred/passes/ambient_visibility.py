"""Ambient visibility: how much of the constant ambient light each pixel sees."""

from __future__ import annotations

import warp as wp

from ..kernels import ambient_visibility as gtao
from ..kernels import bilateral, depth_pyramid
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass, Request
from .resolve import gbuffer_buffers, gbuffer_codec, make_gbuffer

__all__ = ["AmbientVisibilityPass", "ambient_visibility_reason", "why_not"]

#: Outputs that ambient light is part of.
AMBIENT_OUTPUTS = ("color", "display")


def ambient_visibility_reason(request: Request) -> str | None:
    """Reason why the effect runs, or None; host-side declarations only."""
    settings = request.settings.ambient_visibility
    if settings.rung == "off":
        return None
    if "ambient_visibility" in request.outputs:
        return "ambient_visibility asked for"
    if not any(name in request.outputs for name in AMBIENT_OUTPUTS):
        return None
    if request.features.ambient:
        return "ambient light is not zero"
    return "the settings ask for it always" if settings.when == "always" else None


def why_not(request: Request) -> str:
    """Reason why the effect does not run."""
    if request.settings.ambient_visibility.rung == "off":
        return "off in the settings"
    if not any(name in request.outputs for name in AMBIENT_OUTPUTS):
        return "no output asked for shows ambient light"
    return "no ambient light"


class AmbientVisibilityPass(Pass):
    """Share of ambient light that reaches each surface."""

    name = "ambient_visibility"
    doc = "find how much ambient light each surface sees"

    @property
    def half(self) -> bool:
        """Whether horizons are searched at half size."""
        return self.rung() == "gtao_half"

    def called_for(self) -> str | None:
        """Ambient light, or the output asked for."""
        return ambient_visibility_reason(self.request)

    def rung(self) -> str:
        """Rung."""
        return self.request.settings.ambient_visibility.rung

    def reads(self) -> tuple[str, ...]:
        """Depth and normals."""
        return ("depth", *gbuffer_buffers(self.request, self.layout))

    def writes(self) -> dict[str, Buffer]:
        """Visibility, and what its making needs: the depth pyramid, words before and after the first blur."""
        pixels = max(self.layout.pixels, 1)
        bins = max(len(self.layout.bin_tiles), 1)
        words = bins * 64 if self.half else pixels
        return {
            "visibility_pyramid": Buffer(wp.float32, bins * depth_pyramid.BIN_WORDS),
            "visibility_words": Buffer(wp.uint32, words),
            "visibility_rows": Buffer(wp.uint32, words),
            "ambient_visibility": Buffer(wp.float32, pixels),
        }

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, upload the pattern."""
        settings, codec = self.request.settings.ambient_visibility, gbuffer_codec(self.request)
        self.radius = resources.scene.extent() / 20.0 if settings.radius_m is None else settings.radius_m
        self.gbuffer = make_gbuffer(resources)
        self.gather = gtao.make_ambient_visibility_kernel(codec, settings.slices, settings.steps, self.half)
        if self.half:
            self.upsample = bilateral.make_upsample_kernel(codec)
        self.pattern = wp.array(gtao.slice_pattern(settings.slices), dtype=wp.vec4, device=resources.device)

    def run(self, resources: Resources) -> None:
        """Pyramid, horizons, blur along rows, blur along columns, and up to full size."""
        program, views, channels = resources.program, resources.frame.views, resources.channels
        pyramid, words, rows = (channels[f"visibility_{n}"] for n in ("pyramid", "words", "rows"))
        final, power = channels["ambient_visibility"], self.request.settings.ambient_visibility.power
        over_bins = len(self.layout.bin_tiles) * 64
        over_blocks = len(self.layout.blocks) * 64
        tiles, threads = (resources.bin_tiles, over_bins) if self.half else (resources.blocks, over_blocks)
        program.launch(
            depth_pyramid.fill_pyramid_kernel, over_bins, [views, resources.bin_tiles, channels["depth"], FIRST],
            [pyramid], block_dim=depth_pyramid.BLOCK_DIM, band=64,
        )  # fmt: skip
        program.launch(
            self.gather, threads, [views, tiles, self.gbuffer, pyramid, self.pattern, self.radius, FIRST], [words],
            block_dim=gtao.BLOCK_DIM, band=64,
        )  # fmt: skip
        blur, block = bilateral.blur_words_kernel, bilateral.BLOCK_DIM
        half = int(self.half)
        program.launch(
            blur, threads, [views, tiles, words, self.radius, 0, half, FIRST], [rows], block_dim=block, band=64
        )
        if not self.half:
            inputs = [views, resources.blocks, rows, self.radius, power, FIRST]
            program.launch(bilateral.blur_final_kernel, over_blocks, inputs, [final], block_dim=block, band=64)
            return
        program.launch(
            blur, threads, [views, tiles, rows, self.radius, 1, half, FIRST], [words], block_dim=block, band=64
        )
        inputs = [views, resources.blocks, self.gbuffer, words, self.radius, power, FIRST]
        program.launch(self.upsample, over_blocks, inputs, [final], block_dim=block, band=64)

    def bytes_moved(self) -> int:
        """Depth and normals in, pyramid, words twice each way, visibility out."""
        share = 0.25 if self.half else 1.0
        return int(self.layout.pixels * (4 + 1.33 + share * (8 + 4 + 8 + 4) + 4 + (12 if self.half else 0)))
