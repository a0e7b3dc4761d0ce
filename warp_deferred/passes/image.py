"""The HDR image between passes: one format a plan, one channel a pass that turns it, and the public `color` last.

float32 where `color` is asked for, where a setting says so, or where a user's own pass works on the image, whose
kernel is then a plain one over `wp.vec3`; half4 packed in 64 bits elsewhere, at two thirds of the traffic.
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from ..kernels.image import Image
from ..resources import Resources
from .base import Buffer, Pass, Request

__all__ = ["all_reads", "all_writes", "float_image", "image_bytes", "link_images", "make_image"]

#: Channels of the last image of the chain: the public one, and the half one.
FLOAT, HALF = "color", "radiance"


def float_image(request: Request) -> bool:
    """Whether HDR images are kept in float32."""
    return (
        "color" in request.outputs
        or request.settings.shade.radiance == "float32"
        or request.settings.gbuffer.rung == "full"
        or any(stage.image for stage in request.passes)
    )


def image_bytes(request: Request) -> int:
    """Bytes of a pixel of an HDR image."""
    return 12 if float_image(request) else 8


def link_images(stages: Sequence[Pass]) -> None:
    """Name the image each pass reads and writes; the last one that is written is `color`, or `radiance` if half.

    Args:
        stages: Passes that are called for, in the order they run.
    """
    if not stages:
        return
    request = stages[0].request
    last = next((s for s in reversed(stages) if s.image in ("write", "turn")), None)
    used = "color" in request.outputs or any(s.image and s.scope == "frame_end" for s in stages)
    current = ""
    for stage in stages:
        # Summing samples of an image that nobody looks at would cost more than shading some of them.
        wanted = used or stage.scope not in ("accumulate", "average")
        if stage.image in ("turn", "rewrite", "read") and wanted:
            object.__setattr__(stage, "source", current)
        if stage.image in ("write", "turn"):
            final = FLOAT if float_image(request) else HALF
            current = final if stage is last else f"{HALF}_{stage.name}"
        if stage.image in ("write", "turn", "rewrite") and wanted:
            object.__setattr__(stage, "target", current)


def all_reads(stage: Pass) -> tuple[str, ...]:
    """Names of the channels a pass reads, the HDR image among them."""
    return tuple(dict.fromkeys((*stage.reads(), *([stage.source] if stage.source else []))))


def all_writes(stage: Pass) -> dict[str, Buffer]:
    """Channels a pass writes, the HDR image among them."""
    if not stage.target:
        return stage.writes()
    dtype = wp.vec3 if float_image(stage.request) else wp.uint64
    return stage.writes() | {stage.target: Buffer(dtype, max(stage.layout.pixels, 1))}


def make_image(resources: Resources, request: Request, name: str) -> Image:
    """Struct over an HDR image's channel, for kernels that are compiled for either format."""
    image = Image()
    full = float_image(request)
    image.full = resources.channel(name if full else "", wp.vec3)
    image.half = resources.channel("" if full else name, wp.uint64)
    return image
