"""Depth of field: blur one image by distance from the plane in focus, or look through points of the lens."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels import depth_of_field as kernels
from ..kernels.depth_of_field_pack import make_depth_of_field_pack_kernel, near_columns_kernel, near_rows_kernel
from ..kernels.depth_of_field_plane import make_depth_of_field_plane_kernels
from ..kernels.lens_layers import LAYER_TEXELS, LAYERS, LEVEL_TEXELS
from ..program import FIRST
from ..resources import Resources
from ..views import ViewLayout
from .base import Buffer, Pass, Request
from .image import float_image, image_bytes, make_image

__all__ = ["DepthOfFieldPass", "LensSamplesPass"]


def blur_weights(radius: int) -> np.ndarray:
    """Weights of a Gaussian blur at 0, 1, ... radius pixels; the standard deviation is half the radius.

    A Gaussian of deviation r / 2 spreads light as far, in the mean square along an axis, as a disc of radius r.
    """
    weights = np.exp(-0.5 * (np.arange(radius + 1) / (0.5 * radius)) ** 2)
    return np.float32(weights / (2.0 * weights.sum() - weights[0]))


class DepthOfFieldPass(Pass):
    """The image blurred by distance from the plane in focus."""

    name = "depth_of_field"
    doc = "blur what is out of focus"
    image = "turn"
    scope = "frame_end"

    def bound(self, request: Request, layout: ViewLayout) -> Pass:
        """With `lens_samples` the image is blurred as it is."""
        stage = super().bound(request, layout)
        if stage.rung() == "lens_samples":
            object.__setattr__(stage, "image", "")
        return stage

    def rung(self) -> str:
        """Rung of its ladder."""
        return self.request.settings.depth_of_field.rung

    @property
    def gathers(self) -> bool:
        """Whether it is the rung of circles."""
        return self.rung() == "gather"

    def reads(self) -> tuple[str, ...]:
        """Depth of the pixel's centre."""
        return ("depth",) if self.image else ()

    def writes(self) -> dict[str, Buffer]:
        """Reduced images, layers and reach of circles, or the image blurred along one axis."""
        if not self.image:
            return {}
        full = float_image(self.request)
        if not self.gathers:
            return {"lens_rows": Buffer(wp.vec3 if full else wp.uint64, max(self.layout.pixels, 1))}
        tiles, texel = max(self.layout.shown_bins, 1), wp.vec4 if full else wp.uint64
        return {
            "lens_taps": Buffer(texel, tiles * LEVEL_TEXELS),
            "lens_layers": Buffer(texel, tiles * LAYERS * LAYER_TEXELS),
            "lens_far": Buffer(wp.float32, tiles * LAYER_TEXELS),
            "lens_near": Buffer(wp.float32, tiles * LAYER_TEXELS),
            "lens_nearest": Buffer(wp.float32, tiles * 2),
            "lens_near_rows": Buffer(wp.float32, tiles),
            "lens_reach": Buffer(wp.float32, tiles),
        }

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, build the structs."""
        settings, full = self.request.settings.depth_of_field, float_image(self.request)
        self.seen = make_image(resources, self.request, self.source)
        self.shown = make_image(resources, self.request, self.target)
        device = resources.device
        if not self.gathers:
            self.kernels = make_depth_of_field_plane_kernels(not full)
            self.rows = make_image(resources, self.request, "lens_rows")
            self.weights = wp.array(blur_weights(settings.blur_radius_px), dtype=wp.float32, device=device)
            return
        dilate = (near_rows_kernel, near_columns_kernel)
        self.kernels = (make_depth_of_field_pack_kernel(not full), *dilate)
        self.kernels += kernels.make_depth_of_field_kernels(not full)
        self.taps, self.layers = (self._texels(resources, name) for name in ("lens_taps", "lens_layers"))

    def _texels(self, resources: Resources, name: str) -> kernels.Taps:
        texels, full = kernels.Taps(), float_image(self.request)
        texels.half = resources.channel("" if full else name, wp.uint64)
        texels.full = resources.channel(name if full else "", wp.vec4)
        texels.tiles = self.layout.shown_bins
        return texels

    def run(self, resources: Resources) -> None:
        """Reduce, dilate, gather, lay over; or blur along both axes."""
        if self.gathers:
            self._run_gather(resources)
        else:
            self._run_plane(resources)

    def _launch(self, resources: Resources, index: int, rows: int, inputs: list, outputs: list) -> None:
        resources.program.launch(
            self.kernels[index], rows, [*inputs, FIRST], outputs, block_dim=kernels.BLOCK_DIM, band=64
        )

    def _run_gather(self, resources: Resources) -> None:
        channels, views = resources.channels, resources.frame.views
        depth, reach = channels["depth"], channels["lens_reach"]
        far, near, nearest = (channels[name] for name in ("lens_far", "lens_near", "lens_nearest"))
        rows, tiles = channels["lens_near_rows"], self.layout.shown_bins
        settings, grid = self.request.settings.depth_of_field, [views, resources.bin_tiles]
        limit = settings.max_radius_px
        self._launch(resources, 0, tiles * 64, [*grid, self.seen, depth, limit], [self.taps, far, near, nearest])
        self._launch(resources, 1, tiles, [*grid, nearest, limit], [rows])
        self._launch(resources, 2, tiles, [*grid, rows, limit], [reach])
        inputs = [*grid, self.taps, far, near, reach, settings.texels]
        self._launch(resources, 3, tiles * 64, inputs, [self.layers])
        inputs = [views, resources.blocks, self.seen, depth, self.layers, reach, limit]
        self._launch(resources, 4, len(self.layout.blocks) * 64, inputs, [self.shown])

    def _run_plane(self, resources: Resources) -> None:
        channels, frame = resources.channels, resources.frame
        threads, grid = len(self.layout.blocks) * 64, [frame.views, resources.blocks]
        power = self.request.settings.depth_of_field.power
        self._launch(resources, 0, threads, [*grid, self.seen, self.weights], [self.rows])
        inputs = [*grid, self.seen, self.rows, channels["depth"], self.weights, -1.0 if power is None else power]
        self._launch(resources, 1, threads, inputs, [self.shown])

    def bytes_moved(self) -> int:
        """Image and depth in, image out; the levels or the rows out and in."""
        own = sum(wp.types.type_size_in_bytes(b.dtype) * b.count for b in self.writes().values())
        return self.layout.pixels * (2 * image_bytes(self.request) + 4) + 2 * own


class LensSamplesPass(Pass):
    """Each sample looks through its point of the lens."""

    name = "lens_samples"
    doc = "move the views over the lens"

    def rung(self) -> str:
        """Points of the lens."""
        return f"{self.request.settings.depth_of_field.samples} samples"

    def reads(self) -> tuple[str, ...]:
        """The views as the sample's jitter left them."""
        return ("sample_counter", "sample_views")

    def writes(self) -> dict[str, Buffer]:
        """The views live with the frame block."""
        return {"sample_views": Buffer(None, 0)}

    def run(self, resources: Resources) -> None:
        """One launch."""
        channels = resources.channels
        resources.program.launch(
            kernels.lens_samples_kernel,
            self.request.cameras,
            [channels["sample_table"], channels["sample_counter"]],
            [resources.frame.views],
            block_dim=kernels.BLOCK_DIM,
        )
