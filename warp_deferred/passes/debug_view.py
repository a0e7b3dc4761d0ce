"""Debug view: a buffer of the frame in place of the picture."""

from __future__ import annotations

import functools
import math

import warp as wp

from ..channels import OUTPUTS
from ..debug_views import DEBUG_VIEWS, DebugView
from ..kernels import color as color_kernels
from ..kernels import debug_view as kernels
from ..kernels import structs
from ..kernels.light_culling import make_light_culling_kernels
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass
from .display import shown_channel
from .image import float_image, make_image
from .light_culling import Band, culls_by_band, fill_masks, make_masks, mask_bands

__all__ = ["DebugViewPass"]

#: Field of `kernels.Shown` that takes an output, by the output's type.
FIELDS = {"vec3": "vectors", "float32": "scalars", "int32": "indices"}
TYPES = {
    "vectors": wp.vec3, "scalars": wp.float32, "indices": wp.int32, "normals": wp.vec3, "keys": wp.uint64,
    "depth_keys": wp.uint32, "clusters": wp.int32, "ranges": wp.uint32,
}  # fmt: skip


class DebugViewPass(Pass):
    """What `display.view` names."""

    name = "debug_view"
    doc = "show a buffer in place of the picture"
    scope = "frame_end"

    @property
    def image(self) -> str:
        """Only `invalid` looks at the HDR image."""
        return "read" if self.view.kind == "invalid" else ""

    @property
    def view(self) -> DebugView:
        """What is shown."""
        return DEBUG_VIEWS[self.request.settings.display.view]

    def rung(self) -> str:
        """The view's name."""
        return self.view.name

    @functools.cached_property
    def bands(self) -> tuple[Band, ...]:
        """Bands that the light masks come in; empty where no masks are shown."""
        return mask_bands(self.request, self.layout) if self.view.kind == "tiles" else ()

    def reads(self) -> tuple[str, ...]:
        """The buffer, less what an empty scene has none of; and what masks are filled from where they come in bands."""
        names = tuple(name for name in self.view.reads if name != "pairs" or self.request.candidates)
        if not culls_by_band(self.request, self.bands):
            return names
        return (*names, "staged_lights", *(f"mask_{n}" for n in ("summary", "coarse", "bounds", "coarse_bounds")))

    def mend(self, name: str) -> str:
        """What the frame lacks."""
        return f"display.view={self.view.name}: {self.view.mend}" if self.view.mend else ""

    def writes(self) -> dict[str, Buffer]:
        """Bytes."""
        result = {shown_channel(self.request): Buffer(wp.uint32, max(self.layout.pixels, 1), public=wp.vec4ub)}
        if self.view.kind == "depth":
            result["debug_ranges"] = Buffer(wp.uint32, 2 * len(self.layout.sizes))
        return result

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel, fill the struct; name each triangle's cluster where they are shown."""
        kind, device = self.view.kind, resources.device
        curve = self.request.settings.display.tone_mapping if kind in ("radiance", "invalid") else "off"
        half = kind == "invalid" and not float_image(self.request)
        self.kernel = kernels.make_debug_view_kernel(kind, curve, half)
        arrays = {field: wp.zeros(1, dtype=dtype, device=device) for field, dtype in TYPES.items()}
        for name in self.reads():
            if name == "normal" and kind != "direction":
                arrays["normals"] = resources.channels[name]
            elif name in ("keys", "depth_keys"):
                arrays[name] = resources.channels[name]
            elif name in OUTPUTS:
                arrays[FIELDS[OUTPUTS[name].dtype]] = resources.channels[name]
        arrays["ranges"] = resources.channel("debug_ranges", wp.uint32)
        if kind == "clusters":
            arrays["clusters"] = self._clusters(resources)
        arrays["thresholds"] = wp.array(color_kernels.srgb_thresholds(), dtype=wp.float32, device=device)
        arrays["pairs"] = resources.channel("pairs" if "pairs" in self.reads() else "", kernels.Pair)
        self.culling = None
        if culls_by_band(self.request, self.bands):
            self.culling = make_light_culling_kernels(self.request.settings.light_culling.rung == "tiles_depth")
        self.masks = [make_masks(resources, self.request, band) for band in self.bands]
        self.shown = [self._shown(resources, arrays, masks) for masks in self.masks or [None]]

    def _shown(
        self, resources: Resources, arrays: dict[str, wp.array], masks: structs.LightMasks | None
    ) -> kernels.Shown:
        """Struct over what is shown, with the masks of one band."""
        shown = kernels.Shown()
        for field, array in arrays.items():
            setattr(shown, field, array)
        shown.geometry = resources.scene.geometry
        shown.image = make_image(resources, self.request, self.source if self.image else "none")
        if masks is not None:
            shown.masks = masks
        maps = [v for v, size in enumerate(self.layout.sizes) if size.depth_only]
        columns = max(1, math.ceil(math.sqrt(len(maps))))
        shown.maps = wp.vec4i(maps[0] if maps else 0, len(maps), columns, max(1, -(-len(maps) // columns)))
        return shown

    def _clusters(self, resources: Resources) -> wp.array:
        geometry, device = resources.scene.geometry, resources.device
        result = wp.zeros(max(geometry.triangles.shape[0], 1), dtype=wp.int32, device=device)
        wp.launch(
            kernels.cluster_of_triangle_kernel,
            dim=resources.scene.cluster_slots,
            inputs=[geometry],
            outputs=[result],
            device=device,
            block_dim=kernels.BLOCK_DIM,
        )
        return result

    def run(self, resources: Resources) -> None:
        """The range where depth is shown, then the picture; band by band where masks are, each filled before."""
        frame, program, channels = resources.frame, resources.program, resources.channels
        threads = len(self.layout.blocks) * 64
        if self.view.kind == "depth":
            ranges = channels["debug_ranges"]
            program.call(ranges.zero_)
            program.launch(
                kernels.depth_range_kernel,
                threads,
                [frame.views, resources.blocks, channels["depth"]],
                [ranges],
                block_dim=kernels.BLOCK_DIM,
            )
        bands = self.bands or (None,)
        for band, shown in zip(bands, self.shown, strict=True):
            blocks = resources.blocks if band is None else resources.blocks[band.blocks]
            count = len(self.layout.blocks) if band is None else band.blocks.stop - band.blocks.start
            if self.culling is not None:
                fill_masks(resources, self.request, self.culling, shown.masks, band)
            program.launch(
                self.kernel,
                count * 64,
                [frame.views, blocks, shown, FIRST],
                [channels[shown_channel(self.request)]],
                block_dim=kernels.BLOCK_DIM,
                band=64,
            )

    def bytes_moved(self) -> int:
        """The buffer in, bytes out."""
        per_pixel = {"vec3": 12}
        read = sum(per_pixel.get(OUTPUTS[name].dtype, 4) for name in self.view.reads if name in OUTPUTS)
        return self.layout.pixels * (read + 8 * ("keys" in self.view.reads) + 4)
