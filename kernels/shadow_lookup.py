"""Shadow look-up: which share of a light reaches a point, by its maps. Part of shading.

Bias. A texel holds the depth at its centre, but answers for points up to k = sqrt(2) / 2 + r texels away, r being the
filter's radius: on a plane at angle a to the map these differ in depth by up to k t tan(a), t being the texel's size
where the point is. Instead of adding that to the depth, the point is lifted along its normal by k t sin(a). Any point
q' beside the lifted one, at the same depth and at most k t away across the map's axis, then lies on the lit side of
the plane or on it, since its height is the lift minus at most k t sin(a). So a plane alone never shadows itself at any
angle, and the lift stays below k t, where the depth bias would grow without bound. a is measured from the map's axis,
not from the ray, which makes this hold for perspective maps too. The lift moves the edge of a shadow by at most
k t sin(a), and lets light through an occluder only where it is thinner than that.
SNAP, TILT and the rounding terms cover snapped vertices (1/256 texel, and 1/256 pixel of the camera), quantised normals
and float32; where the camera's depth is a code, what its format may be off comes to it. What is left of rounding in the
depth itself is UNITS last places.

The filters themselves are in shadow_filters.py. A point takes the finest cascade that holds it with its filter. Where
cascades meet, the filters blend over the outer eighth of the finer one, and the last one fades out; `hard` switches.
Functions only, no kernel.
"""

from __future__ import annotations

import functools

import warp as wp

from .depth_encoding import make_depth_slack
from .intrinsics import bits_float, float_bits, load_vec4, load_vec4i
from .shadow_filters import disc_factor, hard_factor, mean_blocker, pcf_factor
from .structs import ORTHOGRAPHIC, SLOT_CASCADE, SLOT_FACE, ShadowMaps, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Farthest texel centre from the point that a filter of radius 0 reads, and the 4 x 4 one [texel].
REACH_HARD = wp.constant(0.70710678)
REACH_PCF = wp.constant(2.8284271)
#: pcss follows the receiver's plane from texel to texel, so its lift need not grow with the radius.
REACH_PCSS = wp.constant(1.5)
#: Two vertices snapped by half a 256th each along both axes [texel].
SNAP = wp.constant(0.0078125)
#: Sine that the quantised normal may be off: 1.2 degrees.
TILT = wp.constant(0.02)
#: Units in the last place of a depth that rounding may take.
UNITS = wp.constant(16.0)
#: Share of coordinates that rounding may take.
ROUNDING = wp.constant(1.0e-6)
#: Largest radius of the pcss filter and of its search [texel].
PCSS_RADIUS = wp.constant(32.0)
#: Share of a cascade's half side over which filters blend into the next one.
BLEND = wp.constant(0.125)


@wp.func
def biased_depth(z: wp.float32, largest: wp.float32, units: wp.float32, slope: wp.float32, limit: wp.float32):
    """Depth plus `units` last places of `largest` plus `slope`, limited to `limit` where that is not 0.

    Source: Direct3D 11.3 functional specification, 15.10, for floating-point depth; slope is factor times gradient.
    """
    last_place = bits_float(float_bits(largest) & wp.uint32(0x7F800000)) * 1.1920929e-7
    bias = units * last_place + slope
    if limit > 0.0:
        bias = wp.min(bias, limit)
    elif limit < 0.0:
        bias = wp.max(bias, limit)
    return z + bias


@wp.func
def pixel_size(view: View, depth: wp.float32):
    """Side of a pixel at a depth [m]."""
    return wp.where(view.projection == ORTHOGRAPHIC, 1.0, depth) / view.scale[0]


@wp.func
def lift(reach: wp.float32, texel: wp.float32, cosine: wp.float32, slack: wp.float32):
    """Distance along the normal [m] by which a point is lifted; `cosine` is between normal and map axis."""
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    return (reach + SNAP) * texel * (sine + TILT) + slack


@wp.struct
class MapView:
    """A slot's view, as the look-up needs it."""

    right: wp.vec3
    up: wp.vec3
    back: wp.vec3
    offset: wp.vec3  # of the eye in the map's axes [m]; 0 for perspective maps, which points are relative to
    scale: wp.float32  # texels per unit of x/w, orthographic: per metre
    near: wp.float32
    far: wp.float32
    source: wp.float32  # radius of the light [m], directional: tangent of its angular radius
    half: wp.float32  # half the side [texel]


@wp.func
def load_map(maps: ShadowMaps, slot: wp.int32, side: wp.int32):
    """Rows of a slot."""
    r0, r1 = load_vec4(maps.rows, 4 * slot), load_vec4(maps.rows, 4 * slot + 1)
    r2, lens = load_vec4(maps.rows, 4 * slot + 2), load_vec4(maps.rows, 4 * slot + 3)
    m = MapView()
    m.right = wp.vec3(r0[0], r0[1], r0[2])
    m.up = wp.vec3(r1[0], r1[1], r1[2])
    m.back = wp.vec3(r2[0], r2[1], r2[2])
    m.offset = wp.vec3(r0[3], r1[3], r2[3])
    m.scale = lens[0]
    m.near = lens[1]
    m.far = lens[2]
    m.source = lens[3]
    m.half = 0.5 * wp.float32(side)
    return m


@wp.func
def parallel_point(m: MapView, q: wp.vec3):
    """(u, v) [texel] and z of a point relative to the eye, orthographic."""
    x, y = wp.dot(m.right, q) + m.offset[0], wp.dot(m.up, q) + m.offset[1]
    depth = -(wp.dot(m.back, q) + m.offset[2])
    return wp.vec3(m.half + m.scale * x, m.half - m.scale * y, (m.far - depth) / (m.far - m.near))


@wp.func
def central_point(m: MapView, q: wp.vec3):
    """(u, v) [texel] and z of a point relative to the light, perspective; z is -1 at or behind the light's plane."""
    depth = -wp.dot(m.back, q)
    if not (depth > 0.0):
        return wp.vec3(-1.0, -1.0, -1.0)
    inverse = 1.0 / depth
    u, v = m.scale * wp.dot(m.right, q) * inverse, m.scale * wp.dot(m.up, q) * inverse
    return wp.vec3(m.half + u, m.half - v, m.near * inverse)


@wp.func
def face_of(direction: wp.vec3):
    """Face of a point light that a direction goes through: +x, -x, +y, -y, +z, -z."""
    a = wp.vec3(wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2]))
    axis = wp.int32(2)
    if a[0] >= a[1] and a[0] >= a[2]:
        axis = wp.int32(0)
    elif a[1] >= a[2]:
        axis = wp.int32(1)
    return 2 * axis + wp.where(direction[axis] < 0.0, 1, 0)


@functools.cache
def make_filter(rung: str, parallel: bool):
    """Function that filters one map at a point whose texel size, angle and slack are known.

    `parallel` tells orthographic maps from perspective ones.
    """
    project = parallel_point if parallel else central_point

    @wp.func
    def inside(m: MapView, p: wp.vec3):
        side = 2.0 * m.half
        return p[2] >= 0.0 and p[0] >= 0.0 and p[0] <= side and p[1] >= 0.0 and p[1] <= side

    @wp.func
    def biased(z: wp.float32):
        if wp.static(parallel):
            return biased_depth(z, wp.float32(1.0), UNITS, 0.0, 0.0)
        return biased_depth(z, z, UNITS, 0.0, 0.0)

    @wp.func
    def plane_slope(m: MapView, q: wp.vec3, normal: wp.vec3, z: wp.float32):
        """Change of z a texel along the receiver's plane: exact, since z is linear over the map on a plane."""
        along = wp.vec2(wp.dot(normal, m.right), -wp.dot(normal, m.up))
        if wp.static(parallel):
            steep = wp.max(wp.dot(normal, m.back), 1.0e-3)
            return along * (-1.0 / (steep * m.scale * (m.far - m.near)))
        limited = along * (m.near / (m.scale * wp.min(wp.dot(normal, q), -1.0e-9)))
        return wp.vec2(wp.clamp(limited[0], -z, z), wp.clamp(limited[1], -z, z))

    @wp.func
    def filter_simple(
        maps: ShadowMaps, tile: wp.vec4i, m: MapView, q: wp.vec3, normal: wp.vec3, texel: wp.float32, slack: wp.float32
    ):
        reach = wp.static(float(REACH_HARD if rung == "hard" else REACH_PCF))
        p = project(m, q + normal * lift(reach, texel, wp.dot(normal, m.back), slack))
        if not inside(m, p):
            return wp.float32(1.0)
        if wp.static(rung == "hard"):
            return hard_factor(maps, tile, p[0], p[1], biased(p[2]))
        return pcf_factor(maps, tile, p[0], p[1], biased(p[2]))

    @wp.func
    def filter_soft(
        maps: ShadowMaps, tile: wp.vec4i, m: MapView, q: wp.vec3, normal: wp.vec3, texel: wp.float32, slack: wp.float32
    ):
        lifted = q + normal * lift(REACH_PCSS, texel, wp.dot(normal, m.back), slack)
        p = project(m, lifted)
        if not inside(m, p):
            return wp.float32(1.0)
        z = p[2]
        # Texels of penumbra per unit of z between blocker and receiver.
        if wp.static(parallel):
            spread = m.source * m.scale * (m.far - m.near)
            widest = spread * (1.0 - z)
        else:
            spread = m.source * m.scale / m.near
            # A blocker nearer to the light than an eighth of the way counts as one there.
            widest = spread * 7.0 * z
        search = wp.clamp(widest, 3.0, PCSS_RADIUS)
        slope = plane_slope(m, lifted, normal, z)
        blocker = mean_blocker(maps, tile, p[0], p[1], biased(z), slope, search)
        if blocker < 0.0:
            return wp.float32(1.0)
        # The disc and its soft rim, a fifth of it or half a texel, stay inside the search: where that loses sight of
        # the last blocker, the disc has lost it already, and light does not jump.
        radius = wp.clamp(spread * (blocker - z), 1.5, wp.min(search - 0.5, 0.83 * search))
        return disc_factor(maps, tile, p[0], p[1], biased(z), slope, radius)

    return filter_soft if rung == "pcss" else filter_simple


@functools.cache
def make_shadow_factor(rung: str, kinds: int, border: float, depth_format: str = "float32"):
    """Function that tells which share of a light reaches a point: 1 where no map holds it (lit), 0 in full shadow.

    Args:
        rung: hard, pcf or pcss.
        kinds: Bit k: slots of kind k (spot, face, cascade) are there.
        border: Texels at the rim of a cascade that only filters read.
        depth_format: Depth format of the G-buffer that points come from.
    """
    coded = depth_format != "float32"
    depth_slack = make_depth_slack(depth_format) if coded else None
    filter_local, filter_cascade = make_filter(rung, False), make_filter(rung, True)

    @wp.func
    def cascade_factor(
        maps: ShadowMaps, first: wp.int32, tile: wp.vec4i, point: wp.vec3, normal: wp.vec3, slack: wp.float32
    ):
        # Finest first. Once inside the blending rim of one map, the next that holds the point gives the other part.
        result = wp.float32(1.0)
        weight = wp.float32(1.0)
        slot = first
        while slot < first + tile[3] and weight > 0.0:
            m = load_map(maps, slot, tile[1])
            p = parallel_point(m, point)
            limit = m.half - border
            room = limit - wp.max(wp.abs(p[0] - m.half), wp.abs(p[1] - m.half))
            if m.far > 0.0 and room >= 0.0 and p[2] >= 0.0 and p[2] <= 1.0:
                part = wp.min(room / (BLEND * limit), 1.0)
                if wp.static(rung == "hard"):
                    part = wp.float32(1.0)
                mine = wp.vec4i(tile[0] + (slot - first) * tile[1] * tile[1], tile[1], 0, 0)
                factor = filter_cascade(maps, mine, m, point, normal, 1.0 / m.scale, slack)
                result += weight * part * (factor - 1.0)
                weight *= 1.0 - part
            slot += 1
        return result

    @wp.func
    def local_factor(maps: ShadowMaps, first: wp.int32, tile: wp.vec4i, q: wp.vec3, normal: wp.vec3, slack: wp.float32):
        slot = first
        if wp.static((kinds & 2) != 0):
            if tile[2] == SLOT_FACE:
                slot = first + face_of(q)
        m = load_map(maps, slot, tile[1])
        mine = wp.vec4i(tile[0] + (slot - first) * tile[1] * tile[1], tile[1], 0, 0)
        depth = -wp.dot(m.back, q)
        if not (depth > m.near):
            return wp.float32(1.0)
        # Lifting adds to the depth no more than the lift, which is a few of the hundreds of texels that depth has.
        return filter_local(maps, mine, m, q, normal, 1.05 * depth / m.scale, slack)

    @wp.func
    def shadow_factor(
        maps: ShadowMaps, view: View, place: wp.int32, light: wp.int32, point: wp.vec3, to_light: wp.vec3,
        normal: wp.vec3, depth: wp.float32,
    ):  # fmt: skip
        first = maps.first[place]
        if first < 0:
            return wp.float32(1.0)
        # What the point may be off its surface: its depth by a 256th of a pixel's slope, its numbers by rounding.
        pixel = pixel_size(view, depth)
        tile = load_vec4i(maps.tiles, first)
        if wp.static((kinds & 4) != 0):
            if tile[2] == SLOT_CASCADE:
                slack = pixel * SNAP + ROUNDING * wp.length(point)
                if wp.static(coded):
                    slack += depth_slack(view, point, normal, depth)
                return cascade_factor(maps, first, tile, point, normal, slack)
        if wp.static((kinds & 3) != 0):
            slack = pixel * SNAP + ROUNDING * (wp.length(point) + wp.length(to_light))
            if wp.static(coded):
                slack += depth_slack(view, point, normal, depth)
            return local_factor(maps, first, tile, -to_light, normal, slack)
        return wp.float32(1.0)

    return shadow_factor
