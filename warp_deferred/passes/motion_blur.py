"""Motion blur: gather along motions, or move views and instances to the times of samples."""

from __future__ import annotations

import warp as wp

from ..kernels import motion_blur as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from ..views import ViewLayout
from .base import Buffer, Pass, Request
from .image import float_image, image_bytes, make_image

__all__ = ["MotionBlurPass", "ShutterSamplesPass"]


class MotionBlurPass(Pass):
    """The image blurred along what moves."""

    name = "motion_blur"
    doc = "blur what moves while the shutter is open"
    image = "turn"
    scope = "frame_end"

    def bound(self, request: Request, layout: ViewLayout) -> Pass:
        """With `shutter_samples` the image is blurred as it is."""
        stage = super().bound(request, layout)
        if stage.rung() == "shutter_samples":
            object.__setattr__(stage, "image", "")
        return stage

    def rung(self) -> str:
        """Rung of its ladder."""
        return self.request.settings.motion_blur.rung

    def reads(self) -> tuple[str, ...]:
        """Motion, and depth of the pixel's centre."""
        return ("motion", "depth") if self.image else ()

    def writes(self) -> dict[str, Buffer]:
        """Longest trails of rows, tiles and neighbourhoods."""
        tiles = max(self.layout.shown_bins, 1)
        names = {"trail_rows": 16 * tiles, "trail_tiles": tiles, "trail_near": tiles} if self.image else {}
        return {name: Buffer(wp.vec2, count) for name, count in names.items()}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel, build the structs."""
        self.kernel = kernels.make_motion_blur_kernel(not float_image(self.request))
        self.seen = make_image(resources, self.request, self.source)
        self.shown = make_image(resources, self.request, self.target)

    def run(self, resources: Resources) -> None:
        """Longest trails, then the gather."""
        channels, program, views = resources.channels, resources.program, resources.frame.views
        settings, tiles = self.request.settings.motion_blur, self.layout.shown_bins
        limit, grid = settings.max_length_px, [views, resources.bin_tiles]
        block = {"block_dim": kernels.BLOCK_DIM, "band": 64}
        rows, longest, near = (channels[f"trail_{name}"] for name in ("rows", "tiles", "near"))
        inputs = [*grid, channels["motion"], limit, FIRST]
        program.launch(kernels.row_motion_kernel, 16 * tiles, inputs, [rows], **block)
        program.launch(kernels.tile_motion_kernel, tiles, [rows, FIRST], [longest], **block)
        program.launch(kernels.near_motion_kernel, tiles, [*grid, longest, limit, FIRST], [near], **block)
        inputs = [views, resources.blocks, self.seen, channels["depth"], channels["motion"], near, limit]
        inputs += [settings.taps, FIRST]
        program.launch(self.kernel, len(self.layout.blocks) * 64, inputs, [self.shown], **block)

    def bytes_moved(self) -> int:
        """Image, depth and motion in, image out."""
        return self.layout.pixels * (2 * image_bytes(self.request) + 4 + 2 * 8)


class ShutterSamplesPass(Pass):
    """Each sample shows views and instances at its time."""

    name = "shutter_samples"
    doc = "move views and instances to the time"

    def rung(self) -> str:
        """Times within the shutter's."""
        return f"{self.request.settings.motion_blur.samples} samples"

    def reads(self) -> tuple[str, ...]:
        """The views as the sample's jitter left them."""
        return ("sample_counter", "sample_views")

    def writes(self) -> dict[str, Buffer]:
        """The views live with the frame block, the transforms with the scene."""
        return {"sample_views": Buffer(None, 0)}

    def prepare(self, resources: Resources) -> None:
        """Make room for the poses of the frame before and of this one, which nobody else sees."""
        device, transforms = resources.device, resources.scene.geometry.transforms
        self.old_views = wp.zeros(self.request.cameras, dtype=structs.View, device=device)
        resources.frame.move_middle()
        self.old_transforms, self.transforms = wp.zeros_like(transforms), wp.zeros_like(transforms)
        self.known = resources.channels["shutter_known"] = wp.zeros(1, dtype=wp.int32, device=device)

    def run(self, resources: Resources) -> None:
        """Three launches."""
        channels, program, frame = resources.channels, resources.program, resources.frame
        table = [channels["sample_table"], channels["sample_counter"]]
        moved, block = resources.scene.geometry.transforms, {"block_dim": kernels.BLOCK_DIM}
        inputs = [*table, self.known, frame.uploaded]
        kept = [self.old_transforms, self.transforms, moved]
        program.launch(kernels.shutter_transforms_kernel, moved.shape[0], inputs, kept, **block)
        views = [self.old_views, frame.views, frame.middle]
        program.launch(kernels.shutter_views_kernel, self.request.cameras, inputs, views, **block)
        program.launch(kernels.shutter_known_kernel, 1, table, [self.known], **block)
