"""Shadows by rays, the reference of the shadow maps: which share of a light's disc a point sees.

A fixed set of points on the disc that the light shows a receiver (a spiral of equal areas, Vogel 1979, "A better way to
construct the sunflower head") is tested for every pixel alike: no noise, and an error that falls faster than that of
random points, 0.5 / sqrt(count) at most. What stops light is what shadow maps draw: the same worlds, alpha masks and
culled sides; ray_scene.py has the trees. Rays leave from a point lifted off the surface by its rounding alone.
Functions only, no kernel.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from .ray_scene import RayScene, make_blocked
from .shadow_lookup import ROUNDING, SNAP, pixel_size
from .structs import LIGHT_DIRECTIONAL, LightSource, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: How far rays to a directional light go [m].
FAR_AWAY = wp.constant(1.0e18)
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@wp.struct
class ShadowRays:
    """Which lights cast, and what stops their light."""

    first: wp.array[wp.int32]  # [view * light capacity + light]: -1 casts no shadow
    source: LightSource
    scene: RayScene
    tangent: wp.float32  # of a directional light's angular radius


@wp.func
def disc_point(k: wp.int32, count: wp.int32):
    """k-th of `count` points of a unit disc, each for the same area."""
    radius = wp.sqrt((wp.float32(k) + 0.5) / wp.float32(count))
    angle = wp.float32(k) * wp.static(GOLDEN_ANGLE)
    return wp.vec2(radius * wp.cos(angle), radius * wp.sin(angle))


@functools.cache
def make_ray_factor(samples: int, cull: str, masked: bool):
    """Function that tells which share of a light reaches a point, 1 where it casts no shadow.

    Args:
        samples: Rays to each light.
        cull: Sides of one-sided materials that stop no light: none, back or front.
        masked: Some material is alpha-masked.
    """
    blocked = make_blocked(cull, masked)

    @wp.func
    def shadow_factor(
        rays: ShadowRays, view: View, place: wp.int32, light: wp.int32, point: wp.vec3, to_light: wp.vec3,
        normal: wp.vec3, depth: wp.float32,
    ):  # fmt: skip
        if rays.first[place] < 0:
            return wp.float32(1.0)
        parallel = (rays.source.kind[light] & 3) == LIGHT_DIRECTIONAL
        size = wp.where(parallel, rays.tangent, rays.source.source_radius[light])
        away = wp.where(parallel, 0.0, wp.length(to_light))
        # In lengths of the ray: to a point or spot light it ends where the source begins.
        reach = wp.where(parallel, FAR_AWAY, wp.max(1.0 - size / wp.max(away, 1.0e-30), 0.0))
        slack = pixel_size(view, depth) * SNAP + ROUNDING * (4.0 * wp.length(point) + away)
        start = point + normal * slack
        towards = wp.normalize(to_light)
        aside = wp.vec3(0.0, 1.0, 0.0)
        if wp.abs(towards[1]) > 0.9:
            aside = wp.vec3(1.0, 0.0, 0.0)
        right = wp.normalize(wp.cross(aside, towards)) * size
        up = wp.cross(towards, right)
        world = rays.source.world[light]
        if world < 0:
            world = view.world
        seen = wp.float32(0.0)
        for k in range(samples):
            at = disc_point(k, samples)
            direction = to_light + right * at[0] + up * at[1]
            if not blocked(rays.scene, view.origin, start, direction, reach, world):
                seen += 1.0
        return seen / wp.float32(samples)

    return shadow_factor
