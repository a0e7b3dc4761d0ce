"""Shadows by rays, the reference of the shadow maps: which share of a light's disc a point sees.

A fixed set of points on the disc that the light shows a receiver (a spiral of equal areas, Vogel 1979, "A better way to
construct the sunflower head") is tested for every pixel alike: no noise, and an error that falls faster than that of
random points, 0.5 / sqrt(count) at most. A tree of the instances' world boxes, refitted every frame, finds the meshes
a ray may meet; each mesh has a tree of its own triangles in object space. What stops light is what shadow maps draw:
the same worlds, alpha masks and culled sides. Rays leave from a point lifted off the surface by its rounding alone.

The boxes are in float32 world coordinates, widened by their rounding; rays are tested in object space, where they are
relative to the camera first. The order in which a tree is walked does not show, since any hit ends a ray.
Block size 64.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from .clusters import to_double, to_single, widen
from .intrinsics import load_vec4i
from .masking import make_keep_surface
from .projection import position_of
from .shadow_lookup import ROUNDING, SNAP, pixel_size
from .structs import (
    FLAG_MASKED,
    FLAG_TWO_SIDED,
    LIGHT_DIRECTIONAL,
    Geometry,
    LightSource,
    Material,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: How far rays to a directional light go [m].
FAR_AWAY = wp.constant(1.0e18)
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@wp.struct
class ShadowRays:
    """What rays are tested against."""

    first: wp.array[wp.int32]  # [view * light capacity + light]: -1 casts no shadow
    source: LightSource
    geometry: Geometry
    materials: wp.array[Material]
    meshes: wp.array[wp.uint64]  # tree of each instance's triangles, 0: it has none
    worlds: wp.array[wp.int32]  # of each instance
    inverses: wp.array[wp.mat33]  # world to object; all 0 where an instance is not drawn
    tree: wp.uint64  # of the instances' boxes
    tangent: wp.float32  # of a directional light's angular radius


@wp.kernel
def place_instances_kernel(
    # Scene
    geometry: Geometry,
    # Out
    out_low: wp.array[wp.vec3],
    out_high: wp.array[wp.vec3],
    out_inverses: wp.array[wp.mat33],
):
    """World box and inverse of every instance; one that is not finite or flat gets an empty box at the origin."""
    i = wp.tid()
    instance = geometry.instances[i]
    transform = geometry.transforms[i]
    linear = widen(transform.linear)
    half = to_double(instance.bounds_high - instance.bounds_low) * wp.float64(0.5)
    middle = transform.origin + linear * (to_double(instance.bounds_low) + half)
    low, high, inverse = wp.vec3(), wp.vec3(), wp.mat33()
    determinant = wp.determinant(linear)
    for k in range(3):
        reach = wp.abs(linear[k, 0]) * half[0] + wp.abs(linear[k, 1]) * half[1] + wp.abs(linear[k, 2]) * half[2]
        # Rounding of the box and of the rays that are tested against it.
        margin = 1.0e-6 * (wp.float32(wp.abs(middle[k])) + wp.float32(reach))
        low[k] = wp.float32(middle[k] - reach) - margin
        high[k] = wp.float32(middle[k] + reach) + margin
    if wp.isfinite(low) and wp.isfinite(high) and determinant != wp.float64(0.0):
        wide = wp.inverse(linear)
        for a in range(3):
            for b in range(3):
                inverse[a, b] = wp.float32(wide[a, b])
    if not wp.isfinite(wp.length(inverse[0]) + wp.length(inverse[1]) + wp.length(inverse[2])):
        inverse = wp.mat33()
    if wp.length(inverse[0]) == 0.0:
        low = wp.vec3()
        high = wp.vec3()
    out_low[i] = low
    out_high[i] = high
    out_inverses[i] = inverse


@wp.kernel
def refresh_points_kernel(
    # Scene
    geometry: Geometry,
    # Params
    first: wp.int32,
    # Out
    out_points: wp.array[wp.vec3],
):
    """Copy a mesh's bound points to its tree; what is not finite goes to the origin, where no face keeps it."""
    i = wp.tid()
    p = position_of(geometry, first + i)
    if not wp.isfinite(p):
        p = wp.vec3()
    out_points[i] = p


@wp.kernel
def refresh_faces_kernel(
    # Scene
    geometry: Geometry,
    # Params
    first_vertex: wp.int32,
    first_triangle: wp.int32,
    # Out
    out_indices: wp.array[wp.int32],
):
    """Write a mesh's faces for its tree; one with a vertex that is not finite becomes a point."""
    i = wp.tid()
    corner = load_vec4i(geometry.triangles, first_triangle + i)
    good = wp.isfinite(position_of(geometry, corner[0]))
    good = good and wp.isfinite(position_of(geometry, corner[1])) and wp.isfinite(position_of(geometry, corner[2]))
    for k in range(3):
        out_indices[3 * i + k] = wp.where(good, corner[k], corner[0]) - first_vertex


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
    keep_surface = make_keep_surface()
    picky = masked or cull != "none"

    @wp.func
    def stops(rays: ShadowRays, instance: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, front: bool):
        row = rays.geometry.instances[instance]
        if wp.static(cull != "none"):
            if (row.flags & FLAG_TWO_SIDED) == 0 and front == wp.static(cull == "front"):
                return False
        if (row.flags & FLAG_MASKED) != 0:
            corner = load_vec4i(rays.geometry.triangles, row.triangle_first + face)
            corners = wp.vec3i(corner[0], corner[1], corner[2])
            weights = wp.vec3(u, v, 1.0 - u - v)
            return keep_surface(rays.geometry, instance, rays.materials[row.material], corners, weights)
        return True

    @wp.func
    def blocked_by(rays: ShadowRays, i: wp.int32, eye: wp.vec3d, start: wp.vec3, direction: wp.vec3, reach: wp.float32):
        inverse = rays.inverses[i]
        transform = rays.geometry.transforms[i]
        p = to_single(widen(inverse) * (eye - transform.origin)) + inverse * start
        d = inverse * direction
        if wp.length_sq(d) == 0.0:
            return False
        if wp.static(not picky):
            return wp.mesh_query_ray_anyhit(rays.meshes[i], p, d, reach)
        # The ray goes towards the light and leaves through the side that the light sees; in object space a mirroring
        # transform does not turn faces round.
        left = wp.float32(reach)
        result = wp.bool(False)
        searching = wp.bool(True)
        while searching:
            hit = wp.mesh_query_ray(rays.meshes[i], p, d, left)
            searching = hit.result
            if searching:
                front = wp.dot(hit.normal, d) > 0.0
                if stops(rays, i, hit.face, hit.u, hit.v, front):
                    result = wp.bool(True)
                    searching = wp.bool(False)
                else:
                    # Past the hit by more than the rounding of a hit.
                    step = hit.t * 1.00001 + 1.0e-5 * wp.length(p) / wp.length(d)
                    p = p + d * step
                    left -= step
                    searching = left > 0.0
        return result

    @wp.func
    def blocked(
        rays: ShadowRays, eye: wp.vec3d, start: wp.vec3, direction: wp.vec3, reach: wp.float32, world: wp.int32
    ):
        result = wp.bool(False)
        query = wp.bvh_query_ray(rays.tree, to_single(eye + to_double(start)), direction)
        i = wp.int32(0)
        while wp.bvh_query_next(query, i, reach):
            if not result and rays.meshes[i] != wp.uint64(0):
                mine = rays.worlds[i]
                if mine < 0 or world < 0 or mine == world:
                    result = blocked_by(rays, i, eye, start, direction, reach)
        return result

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
            if not blocked(rays, view.origin, start, direction, reach, world):
                seen += 1.0
        return seen / wp.float32(samples)

    return shadow_factor
