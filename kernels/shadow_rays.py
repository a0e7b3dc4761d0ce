"""Shadows by rays, the reference of the shadow maps: which share of a light's disc a point sees.

The disc that the light shows a receiver is cut into square cells. Rays go to their corners first; a cell whose corners
are all seen, or all hidden, counts as its corners do, which is exact for a straight edge; any other is asked 16 points,
a (0, 4, 2)-net in base 2 (Larcher and Pillichshammer 2001; Hammersley's points with another end). So an edge is told as
16 times as many rays would tell it: over straight edges of any place and direction the root mean square error is
0.0006 for 256 samples, where 256 points of a spiral of equal areas have 0.0043 and 4096 have 0.0005 [computed in
float64]; it falls as samples^-0.75. A blocker narrower than a cell, 1.8 / sqrt(samples) of the disc's radius, may be
missed, as it may be by so many points. Points are the same for every pixel: no noise. The lattice is turned by an angle
whose tangent no fraction comes near, so that it is aligned with no edge of a common slope.

What stops light is what shadow maps draw: the same worlds, alpha masks and culled sides; ray_scene.py has the trees.
Rays leave from a point lifted off the surface by its rounding alone, that of its depth's format included. Rays a pixel:
1.4 samples, and up to 1.5 samples more in a penumbra. Functions only, no kernel.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from .depth_encoding import make_depth_slack
from .ray_scene import RayScene, make_blocked
from .shadow_lookup import ROUNDING, SNAP, pixel_size
from .structs import LIGHT_DIRECTIONAL, LightSource, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: How far rays to a directional light go [m].
FAR_AWAY = wp.constant(1.0e18)
#: Angle of the lattice: its tangent is the golden ratio less 1, which fractions approach worst of all numbers.
LATTICE_ANGLE = math.atan(0.5 * (math.sqrt(5.0) - 1.0))
#: Sixteenths: second coordinates of a cell's points, as nibbles of 64 bits; the first ones count up.
NET = wp.constant(wp.uint64(0xF7B3D591E6A2C480))
#: Most samples: a row of corners is kept as bits of one word.
MAX_SAMPLES = 2048


@wp.struct
class ShadowRays:
    """Which lights cast, and what stops their light."""

    first: wp.array[wp.int32]  # [view * light capacity + light]: -1 casts no shadow
    source: LightSource
    scene: RayScene
    tangent: wp.float32  # of a directional light's angular radius


@wp.func
def net_point(k: wp.int32):
    """k-th of 16 points of the unit square."""
    nibble = wp.int32((NET >> wp.uint64(4 * k)) & wp.uint64(15))
    return wp.vec2((wp.float32(k) + 0.5) * 0.0625, (wp.float32(nibble) + 0.5) * 0.0625)


@functools.cache
def make_ray_factor(samples: int, cull: str, masked: bool, depth_format: str = "float32"):
    """Function that tells which share of a light reaches a point, 1 where it casts no shadow.

    Args:
        samples: Corners of cells that lie on the light's disc, at most 2048.
        cull: Sides of one-sided materials that stop no light: none, back or front.
        masked: Some material is alpha-masked.
        depth_format: Depth format of the G-buffer that points come from.
    """
    coded = depth_format != "float32"
    depth_slack = make_depth_slack(depth_format) if coded else None
    blocked = make_blocked(cull, masked)
    side = math.sqrt(math.pi / samples)
    # Corners of all cells that touch the disc.
    edge = math.ceil(1.0 / side + math.sqrt(2.0))
    along, across = side * math.cos(LATTICE_ANGLE), side * math.sin(LATTICE_ANGLE)
    corner_limit, cell_limit = (1.0 + math.sqrt(2.0) * side) ** 2, (1.0 + math.sqrt(0.5) * side) ** 2
    whole_limit = max(1.0 - math.sqrt(0.5) * side, 0.0) ** 2

    @wp.func
    def lattice_point(x: wp.float32, y: wp.float32):
        return wp.vec2(along * x - across * y, across * x + along * y)

    @wp.func
    def cell_share(
        rays: ShadowRays, eye: wp.vec3d, start: wp.vec3, to_light: wp.vec3, right: wp.vec3, up: wp.vec3,
        reach: wp.float32, world: wp.int32, x: wp.float32, y: wp.float32, corners: wp.int32,
    ):  # fmt: skip
        # (seen, counted) of a cell's points that lie on the disc; `corners` has a bit for each that is seen.
        middle = lattice_point(x + 0.5, y + 0.5)
        away = wp.dot(middle, middle)
        if away >= cell_limit:
            return wp.vec2(0.0, 0.0)
        same = corners == 0 or corners == 15
        if same and away < whole_limit:
            return wp.vec2(wp.where(corners == 0, 0.0, 16.0), 16.0)
        seen = wp.float32(0.0)
        counted = wp.float32(0.0)
        k = wp.int32(0)
        # Not a range: unrolled, this would be sixteen copies of a traversal.
        while k < 16:
            place = net_point(k)
            at = lattice_point(x + place[0], y + place[1])
            if wp.dot(at, at) < 1.0:
                counted += 1.0
                lit = corners == 15
                if not same:
                    lit = not blocked(rays.scene, eye, start, to_light + right * at[0] + up * at[1], reach, world)
                if lit:
                    seen += 1.0
            k += 1
        return wp.vec2(seen, counted)

    @wp.func
    def disc_share(
        rays: ShadowRays, eye: wp.vec3d, start: wp.vec3, to_light: wp.vec3, right: wp.vec3, up: wp.vec3,
        reach: wp.float32, world: wp.int32,
    ):  # fmt: skip
        total = wp.vec2(0.0, 0.0)
        below = wp.uint64(0)
        row = wp.int32(-edge)
        while row <= edge:
            seen = wp.uint64(0)
            column = wp.int32(-edge)
            while column <= edge:
                at = lattice_point(wp.float32(column), wp.float32(row))
                if wp.dot(at, at) < corner_limit:
                    if not blocked(rays.scene, eye, start, to_light + right * at[0] + up * at[1], reach, world):
                        seen = seen | (wp.uint64(1) << wp.uint64(column + edge))
                if row > -edge and column > -edge:
                    shift = wp.uint64(column + edge - 1)
                    corners = wp.int32((below >> shift) & wp.uint64(3)) + 4 * wp.int32((seen >> shift) & wp.uint64(3))
                    x, y = wp.float32(column - 1), wp.float32(row - 1)
                    total += cell_share(rays, eye, start, to_light, right, up, reach, world, x, y, corners)
                column += 1
            below = seen
            row += 1
        return total[0] / total[1]

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
        if wp.static(coded):
            slack += depth_slack(view, point, normal, depth)
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
        return disc_share(rays, view.origin, start, to_light, right, up, reach, world)

    return shadow_factor
