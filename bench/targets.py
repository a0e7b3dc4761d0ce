"""Figures that are quoted, not measured here: what has to be reached, and what others need.

The raster table is the design's: device times from graph replays on one NVIDIA H200 at 1920x1080, taken with throw-away
prototypes (`one path`, `two paths`) and with nvdiffrast and OpenGL on the same card. Reports mark them as quoted.
"""

from __future__ import annotations

import dataclasses

__all__ = [
    "EFFECT_TARGETS_MS", "FRAME_TARGETS", "GUARD_TARGET_PERCENT", "HOST_TARGET_US", "LIGHT_TARGETS_MS", "PEER_TARGETS",
    "SKIPPED_TARGET_MS", "TRIANGLE_QUOTES", "FrameTarget", "TriangleQuote",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class TriangleQuote:
    """A row of the raster table [ms]; None where it has no figure.

    Attributes:
        one_path: Prototype that draws every triangle from its own thread.
        two_paths: Prototype that bins large triangles, untuned.
        nvdiffrast: nvdiffrast on the same card.
        opengl: OpenGL on the same card.
        must_reach: What has to be reached first.
        then: What is to be reached after that.
    """

    one_path: float
    two_paths: float | None
    nvdiffrast: float
    opengl: float
    must_reach: float
    then: float | None = None


TRIANGLE_QUOTES = {
    "terrain_500k": TriangleQuote(0.137, None, 0.67, 1.10, 0.16, 0.13),
    "terrain_10m": TriangleQuote(0.31, None, 5.1, 8.2, 0.38, 0.31),
    "quads": TriangleQuote(2.9, 0.58, 0.78, 3.2, 0.5),
    "slivers": TriangleQuote(14.8, 0.98, 0.63, 6.1, 0.55),
    "mixed": TriangleQuote(3.2, 1.74, 1.12, 5.2, 1.0),
    "pile": TriangleQuote(0.93, 0.80, 66.8, 2.9, 0.8),
}
#: (lights, mean of lights at a pixel) -> most milliseconds of culling and shading, 1080p.
LIGHT_TARGETS_MS = {(1000, 5): 0.22, (10_000, 5): 0.5}
#: Host time of one `render` with a new camera [µs].
HOST_TARGET_US = 80.0
#: What guards against bad input may add to a frame [%].
GUARD_TARGET_PERCENT = 3.0


@dataclasses.dataclass(frozen=True)
class FrameTarget:
    """What a frame must reach: milliseconds, and bytes of device memory beside the scene (None: not stated)."""

    ms: float
    memory_bytes: int | None = None


FRAME_TARGETS = {
    "terrain_1080p": FrameTarget(0.42, 250_000_000),
    "terrain_360p": FrameTarget(60.0),
    "composite_1080p": FrameTarget(0.90),
    "composite_4k": FrameTarget(2.5),
    "shadowed_points_1080p": FrameTarget(1.2),
}
#: (case, rung) -> most milliseconds it may add to its frame at 1920x1080; cascades: 0.25 to draw and 0.08 to filter.
#: No scene is stated for ambient visibility: it is held against both, the terrain of whole frames, of whose pixels 62 %
#: show a surface, and `corner`, where all do.
EFFECT_TARGETS_MS = {
    ("shadow_cascades", "pcf"): 0.33,
    ("ambient_visibility", "gtao"): 0.12,
    ("ambient_visibility", "gtao_half"): 0.05,
    ("ambient_visibility_terrain", "gtao"): 0.12,
    ("ambient_visibility_terrain", "gtao_half"): 0.05,
    ("bloom", "mip_chain"): 0.05,
    ("depth_of_field", "gather"): 0.2,
    ("anti_aliasing", "fxaa"): 0.03,
}
#: Most milliseconds an effect may cost that is in the plan and skipped on the device.
SKIPPED_TARGET_MS = 0.010
#: (case, peer) -> how many times our time the peer's must be at least, on one H200.
PEER_TARGETS = {
    ("gbuffer_1080p", "nvdiffrast"): 4.0,
    ("gbuffer_1080p", "opengl"): 4.0,
    ("lit_1000", "newton"): 20.0,
    ("lit_1000", "newton_sensor_camera"): 20.0,
    ("shadowed_16", "newton"): 15.0,
    ("shadowed_16", "newton_sensor_camera"): 15.0,
}
