"""What rays are traced against: a tree of each mesh's triangles, in its own space, under a tree of instances' boxes.

Both trees are Warp's. Instances share their mesh's tree, so memory grows with meshes and not with what is placed, and
what moves only has its box refitted; after large movements the same answers take longer. The boxes are in float32 world
coordinates, widened by their rounding; triangles are tested in their mesh's own space, where a ray is relative to the
camera first, so far-away worlds are stable. The order in which a tree is walked does not show, since any hit ends a
ray. A transform that flattens its instance has no inverse; its instance is given a thickness of FLAT. Block size 64.
"""

from __future__ import annotations

import functools

import warp as wp

from .clusters import to_double, to_single, widen
from .intrinsics import load_vec4i
from .masking import make_keep_surface
from .projection import position_of
from .structs import FLAG_MASKED, FLAG_TWO_SIDED, Geometry, Material

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Thickness of what a transform makes flat, as a share of its other sides: below the rounding that rays start beyond.
FLAT = wp.constant(wp.float64(1.0e-7))


@wp.struct
class RayScene:
    """The trees, and what tells which instance a leaf is."""

    geometry: Geometry
    materials: wp.array[Material]
    meshes: wp.array[wp.uint64]  # tree of each instance's triangles, 0: it has none
    worlds: wp.array[wp.int32]  # of each instance
    inverses: wp.array[wp.mat33]  # world to object; all 0 where an instance is not drawn
    tree: wp.uint64  # of the instances' boxes


@wp.func
def thickened(m: wp.mat33d):
    """A matrix of rank 2 with its flat direction made thin instead; others as they are.

    The cofactors of such a matrix map just the direction that it loses to the normal of what it maps to.
    """
    if wp.determinant(m) != wp.float64(0.0):
        return m
    a, b, c = m[0], m[1], m[2]
    cofactors = wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))
    size = wp.sqrt(wp.ddot(cofactors, cofactors))
    if not (size > wp.float64(0.0)):
        return m
    return m + cofactors * (FLAT * wp.sqrt(wp.ddot(m, m)) / size)


@wp.kernel
def place_instances_kernel(
    # Scene
    geometry: Geometry,
    # Out
    out_low: wp.array[wp.vec3],
    out_high: wp.array[wp.vec3],
    out_inverses: wp.array[wp.mat33],
):
    """World box and inverse of every instance; one that is not finite, or a line, gets an empty box at the origin."""
    i = wp.tid()
    instance = geometry.instances[i]
    transform = geometry.transforms[i]
    linear = thickened(widen(transform.linear))
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


@functools.cache
def make_blocked(cull: str, masked: bool):
    """Function that tells whether a ray is stopped before its end.

    Args:
        cull: Sides of one-sided materials that stop nothing, as seen from the ray's end: none, back or front.
        masked: Alpha masks have holes; else they are taken for solid.
    """
    keep_surface = make_keep_surface()
    picky = masked or cull != "none"

    @wp.func
    def stops(rays: RayScene, instance: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, front: bool):
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
    def blocked_by(rays: RayScene, i: wp.int32, eye: wp.vec3d, start: wp.vec3, direction: wp.vec3, reach: wp.float32):
        inverse = rays.inverses[i]
        transform = rays.geometry.transforms[i]
        p = to_single(widen(inverse) * (eye - transform.origin)) + inverse * start
        d = inverse * direction
        if wp.length_sq(d) == 0.0:
            return False
        if wp.static(not picky):
            return wp.mesh_query_ray_anyhit(rays.meshes[i], p, d, reach)
        # The ray leaves through the side that its end sees; in object space a mirroring transform does not turn faces
        # round.
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
    def blocked(rays: RayScene, eye: wp.vec3d, start: wp.vec3, direction: wp.vec3, reach: wp.float32, world: wp.int32):
        # From `start`, relative to the eye, as far as `reach` times the direction; -1 is a ray of all worlds.
        result = wp.bool(False)
        query = wp.bvh_query_ray(rays.tree, to_single(eye + to_double(start)), direction)
        i = wp.int32(0)
        while wp.bvh_query_next(query, i, reach):
            if rays.meshes[i] != wp.uint64(0):
                mine = rays.worlds[i]
                if mine < 0 or world < 0 or mine == world:
                    if blocked_by(rays, i, eye, start, direction, reach):
                        result = wp.bool(True)
                        break
        return result

    return blocked
