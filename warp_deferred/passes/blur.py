"""Blur: a Gaussian over the HDR image, and over any channel of another pass.

`GaussianBlur` is the part that other passes use: made in `prepare`, added to the program in `run`, with a scratch
buffer that the pass declares among its `writes`.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..kernels import blur as kernels
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass
from .image import float_image, image_bytes

__all__ = ["BlurPass", "GaussianBlur", "gaussian_weights"]

#: Standard deviations at which the weights end; what lies beyond is 0.27 % of a Gaussian's sum.
REACH = 3.0


def gaussian_weights(sigma_px: float) -> np.ndarray:
    """Weights of the middle and of each neighbour to one side, (radius + 1,) float32; both sides sum to 1."""
    if sigma_px <= 0.0:
        return np.ones(1, np.float32)
    distance = np.arange(math.ceil(REACH * sigma_px) + 1)
    weights = np.exp(-0.5 * (distance / sigma_px) ** 2)
    return (weights / (weights[0] + 2.0 * weights[1:].sum())).astype(np.float32)


class GaussianBlur:
    """A separable Gaussian for the pixels of a plan, view by view.

    Args:
        resources: Of the plan, as handed to `prepare`.
        kind: What is blurred: "half" or "color" for HDR images in half4 or float32, "vec3" or "float32" for channels.
        sigma_px: Standard deviation [px], >= 0.
    """

    def __init__(self, resources: Resources, kind: str, sigma_px: float) -> None:
        self._kind = kind
        self._kernels = [kernels.make_blur_kernel(kind, columns) for columns in (False, True)]
        self._weights = wp.array(gaussian_weights(sigma_px), dtype=wp.float32, device=resources.device)
        self._empty = {t: wp.zeros(1, dtype=t, device=resources.device) for t in (wp.vec3, wp.uint64, wp.float32)}

    def _plane(self, array: wp.array) -> kernels.Plane:
        plane, kind, empty = kernels.Plane(), self._kind, self._empty
        plane.image.half = array if kind == "half" else empty[wp.uint64]
        plane.image.full = array if kind == "color" else empty[wp.vec3]
        plane.vectors = array if kind == "vec3" else empty[wp.vec3]
        plane.scalars = array if kind == "float32" else empty[wp.float32]
        return plane

    def add(self, resources: Resources, source: wp.array, scratch: wp.array, target: wp.array) -> None:
        """Add the two launches; arrays are flat, of the kind's type, and source may be target."""
        threads = len(resources.layout.blocks) * 64
        for kernel, start, end in zip(self._kernels, (source, scratch), (scratch, target), strict=True):
            inputs = [resources.frame.views, resources.blocks, self._plane(start), self._weights, FIRST]
            resources.program.launch(kernel, threads, inputs, [self._plane(end)], block_dim=kernels.BLOCK_DIM, band=64)


class BlurPass(Pass):
    """The whole image out of focus."""

    name = "blur"
    doc = "blur the image by a Gaussian"
    image = "turn"
    # Linear, so once after all samples is as good as in each.
    scope = "frame_end"

    @property
    def sigma_px(self) -> float:
        """Standard deviation."""
        return self.request.settings.blur.sigma_px

    def rung(self) -> str:
        """Rung and width."""
        return f"gaussian, {self.sigma_px:g} px"

    def writes(self) -> dict[str, Buffer]:
        """The image after its rows."""
        dtype = wp.vec3 if float_image(self.request) else wp.uint64
        return {"blur_rows": Buffer(dtype, max(self.layout.pixels, 1))} if self.sigma_px > 0.0 else {}

    def prepare(self, resources: Resources) -> None:
        """Fetch kernels, upload weights."""
        kind = "color" if float_image(self.request) else "half"
        self.blur = GaussianBlur(resources, kind, self.sigma_px) if self.sigma_px > 0.0 else None

    def run(self, resources: Resources) -> None:
        """Rows, then columns; a copy where the width is 0."""
        source, target = resources.channels[self.source], resources.channels[self.target]
        if self.blur is None:
            resources.program.call(lambda: wp.copy(target, source))
            return
        self.blur.add(resources, source, resources.channels["blur_rows"], target)

    def bytes_moved(self) -> int:
        """The image in and out, twice."""
        return self.layout.pixels * image_bytes(self.request) * (4 if self.sigma_px > 0.0 else 2)
