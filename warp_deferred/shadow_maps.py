"""What core passes know of shadow maps: whether they keep and clear them, and what shading reads to look shadows up.

Kernels are imported only where a plan has shadows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from .effects import called_for
from .kernels import structs
from .passes.base import Request
from .program import FIRST
from .resources import Resources
from .sampling import sample_count

__all__ = [
    "BORDERS", "clear_maps", "keeps_maps", "light_tangent", "make_shadows", "shadow_arguments", "shadow_channels",
]  # fmt: skip

#: Texels a map keeps beyond what it must hold, by rung: the filter's radius, and how far a point is lifted.
BORDERS = {"hard": 3.0, "pcf": 6.0, "pcss": 40.0}


def shadow_channels(request: Request) -> list[str]:
    """Channels that shading reads to look shadows up."""
    if not called_for(request, "shadow"):
        return []
    names = ["shadow_first", "shadow_rows", "shadow_tiles"] + ["rays"] * (request.settings.shadow.rung == "ray_traced")
    return names + ["depth_keys"] * (request.shadow_slots > 0 and request.candidates > 0)


def shadow_arguments(request: Request) -> tuple[Any, ...] | None:
    """What `make_shade_kernel` takes for `shadow`: the rung and its look-up's arguments, or None without shadows."""
    settings, features = request.settings.shadow, request.features
    if not called_for(request, "shadow"):
        return None
    if settings.rung == "ray_traced":
        return settings.rung, settings.samples, settings.cull, features.masked
    point, spot, directional = (count > 0 for count in features.casters)
    # A wide spot has the maps of a point light; angles may change without another plan.
    kinds = spot + 2 * (point or spot) + 4 * directional
    return settings.rung, kinds, BORDERS[settings.rung]


def make_shadows(resources: Resources, request: Request) -> Any:
    """Struct over what the look-up of a plan reads; empty arrays where it has none."""
    if shadow_channels(request) and request.settings.shadow.rung == "ray_traced":
        from .kernels.shadow_rays import ShadowRays

        rays = ShadowRays()
        rays.first, rays.source = resources.channels["shadow_first"], resources.lights.source
        rays.scene = resources.scene.rays().struct()
        rays.tangent = light_tangent(request)
        return rays
    maps = structs.ShadowMaps()
    maps.first = resources.channel("shadow_first", wp.int32)
    maps.rows = resources.channel("shadow_rows", wp.vec4)
    maps.tiles = resources.channel("shadow_tiles", wp.vec4i)
    maps.keys = resources.channel("depth_keys", wp.uint32)
    return maps


def light_tangent(request: Request) -> float:
    """Tangent of the angular radius of directional lights."""
    return math.tan(math.radians(request.settings.shadow.directional_angle_deg))


def keeps_maps(request: Request) -> bool:
    """Whether maps stay from frame to frame, or from sample to sample; the passes before shading leave them alone."""
    keeps = request.settings.shadow.keep_maps or sample_count(request) > 1
    return request.shadow_slots > 0 and request.candidates > 0 and keeps


def clear_maps(resources: Resources, request: Request) -> None:
    """Clear the maps that are drawn anew, beside the step before."""
    from .kernels import shadow_keep

    layout, chunk = resources.layout, int(shadow_keep.CHUNK)
    views = range(request.cameras, len(layout.sizes))
    owners = np.repeat(
        np.array(views, np.int32), [layout.sizes[v].width * layout.sizes[v].height // chunk for v in views]
    )
    chunks = wp.array(owners, dtype=wp.int32, device=resources.device)
    resources.program.launch(
        shadow_keep.clear_maps_kernel,
        layout.depth_pixels // int(shadow_keep.CLEARED),
        [resources.frame.views, chunks, FIRST],
        [resources.channels["depth_keys"]],
        block_dim=shadow_keep.BLOCK_DIM,
        band=chunk,
        beside=True,
    )
