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
and float32. What is left of rounding in the depth itself is UNITS last places.

pcf weighs 4 x 4 comparisons by the product of (1-f, 2-f, 1+f, f) / 4 along each side, the tent 1 2 1 run over
bilinear weights (Reeves et al. 1987, "Rendering Antialiased Shadows with Depth Maps", with fixed weights); f is in
256ths, so that the weights sum to 1 exactly. pcss (Fernando 2005, "Percentage-Closer Soft Shadows") looks for blockers
on a lattice of texels around the point, measured from the receiver's plane, and then weighs a disc as wide as the
penumbra of their mean depth; the lattice stands still in the map, so there is neither noise nor banding. Both depths
being linear in z, so is the penumbra's width.
Where cascades meet, the filters blend over the outer eighth of the finer one, and the last one fades out; hard
switches. A point takes the finest map that holds it with its filter. Functions only, no kernel.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import bits_float, float_bits, load_vec4, load_vec4i
from .structs import ORTHOGRAPHIC, SLOT_CASCADE, SLOT_FACE, ShadowMaps, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Farthest texel centre from the point that a filter of radius 0 reads, and the 4 x 4 one [texel].
REACH_HARD = wp.constant(0.70710678)
REACH_PCF = wp.constant(2.8284271)
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


@wp.func
def passes(maps: ShadowMaps, texel: wp.int32, z: wp.float32):
    """1 where a texel's depth lets light through to a depth, else 0."""
    if bits_float(maps.keys[texel]) > z:
        return wp.float32(0.0)
    return wp.float32(1.0)


@wp.func
def texel_index(tile: wp.vec4i, x: wp.int32, y: wp.int32):
    """Index of a texel, the nearest one inside its map."""
    last = tile[1] - 1
    return tile[0] + wp.clamp(y, 0, last) * tile[1] + wp.clamp(x, 0, last)


@wp.func
def hard_factor(maps: ShadowMaps, tile: wp.vec4i, u: wp.float32, v: wp.float32, z: wp.float32):
    """Share of light by the texel that a point falls on."""
    return passes(maps, texel_index(tile, wp.int32(wp.floor(u)), wp.int32(wp.floor(v))), z)


@wp.func
def tent_weight(k: wp.int32, f: wp.float32):
    """Weight of the k-th of four texels, times 4."""
    if k == 0:
        return 1.0 - f
    if k == 1:
        return 2.0 - f
    if k == 2:
        return 1.0 + f
    return f


@wp.func
def pcf_factor(maps: ShadowMaps, tile: wp.vec4i, u: wp.float32, v: wp.float32, z: wp.float32):
    """Share of light by 4 x 4 texels; all sums are of 65536ths, so exact."""
    x0, y0 = wp.floor(u - 0.5), wp.floor(v - 0.5)
    fx = wp.floor((u - 0.5 - x0) * 256.0) * 0.00390625
    fy = wp.floor((v - 0.5 - y0) * 256.0) * 0.00390625
    # At the rim the weights are off by a texel or two; what stands there is outside every cone, face and cascade.
    last = wp.float32(tile[1] - 4)
    x, y = wp.int32(wp.clamp(x0 - 1.0, 0.0, last)), wp.int32(wp.clamp(y0 - 1.0, 0.0, last))
    texel = tile[0] + y * tile[1] + x
    total = wp.float32(0.0)
    for j in range(4):
        row = wp.float32(0.0)
        for i in range(4):
            row += tent_weight(i, fx) * passes(maps, texel + i, z)
        total += tent_weight(j, fy) * row
        texel += tile[1]
    return total * 0.0625


@wp.func
def lattice_step(radius: wp.float32, taps: wp.float32):
    """Power of two of texels between taps, so that at most `taps` fit a radius."""
    step = wp.int32(1)
    while wp.float32(step) * taps < radius:
        step = step * 2
    return step


@wp.func
def lattice_first(low: wp.float32, step: wp.int32):
    """First texel at or past a coordinate whose index is a multiple of the step."""
    return wp.int32(wp.ceil((low - 0.5) / wp.float32(step))) * step


@wp.func
def mean_blocker(
    maps: ShadowMaps, tile: wp.vec4i, u: wp.float32, v: wp.float32, z: wp.float32, slope: wp.vec2, radius: wp.float32
):
    """Mean depth of the texels in reach that lie before the receiver's plane; -1 where none does."""
    step = lattice_step(radius, 4.0)
    total, count = wp.float32(0.0), wp.float32(0.0)
    y = lattice_first(v - radius, step)
    while wp.float32(y) + 0.5 <= v + radius:
        x = lattice_first(u - radius, step)
        dy = wp.float32(y) + 0.5 - v
        while wp.float32(x) + 0.5 <= u + radius:
            dx = wp.float32(x) + 0.5 - u
            depth = bits_float(maps.keys[texel_index(tile, x, y)])
            if dx * dx + dy * dy <= radius * radius and depth > z + slope[0] * dx + slope[1] * dy:
                total += depth
                count += 1.0
            x += step
        y += step
    if count == 0.0:
        return wp.float32(-1.0)
    return total / count


@wp.func
def disc_factor(maps: ShadowMaps, tile: wp.vec4i, u: wp.float32, v: wp.float32, z: wp.float32, radius: wp.float32):
    """Share of light by a disc of texels, soft over one step at its rim."""
    step = lattice_step(radius, 5.0)
    soft = wp.float32(step)
    outer = radius + 0.5 * soft
    total, lit = wp.float32(0.0), wp.float32(0.0)
    y = lattice_first(v - outer, step)
    while wp.float32(y) + 0.5 <= v + outer:
        x = lattice_first(u - outer, step)
        dy = wp.float32(y) + 0.5 - v
        while wp.float32(x) + 0.5 <= u + outer:
            dx = wp.float32(x) + 0.5 - u
            weight = wp.clamp((outer - wp.sqrt(dx * dx + dy * dy)) / soft, 0.0, 1.0)
            total += weight
            lit += weight * passes(maps, texel_index(tile, x, y), z)
            x += step
        y += step
    # The two sums are made alike, so all lit is 1 exactly.
    return lit / total


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
        cosine = wp.dot(normal, m.back)
        lifted = q + normal * lift(REACH_HARD, texel, cosine, slack)
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
            # A blocker nearer to the light than a quarter of the way counts as one there.
            widest = spread * 3.0 * z
        radius = wp.clamp(widest, 2.0, PCSS_RADIUS)
        blocker = mean_blocker(maps, tile, p[0], p[1], biased(z), plane_slope(m, lifted, normal, z), radius)
        if blocker < 0.0:
            return wp.float32(1.0)
        radius = wp.clamp(spread * (blocker - z), 1.5, PCSS_RADIUS)
        # Half a step beyond the radius, which is a fifth of it at most, or half a texel.
        p = project(m, q + normal * lift(radius * 1.2 + 0.5, texel, cosine, slack))
        if not inside(m, p):
            return wp.float32(1.0)
        return disc_factor(maps, tile, p[0], p[1], biased(p[2]), radius)

    return filter_soft if rung == "pcss" else filter_simple


@functools.cache
def make_shadow_factor(rung: str, kinds: int, border: float):
    """Function that tells which share of a light reaches a point: 1 where no map holds it (lit), 0 in full shadow.

    Args:
        rung: hard, pcf or pcss.
        kinds: Bit k: slots of kind k (spot, face, cascade) are there.
        border: Texels at the rim of a cascade that only filters read.
    """
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
                return cascade_factor(maps, first, tile, point, normal, slack)
        if wp.static((kinds & 3) != 0):
            slack = pixel * SNAP + ROUNDING * (wp.length(point) + wp.length(to_light))
            return local_factor(maps, first, tile, -to_light, normal, slack)
        return wp.float32(1.0)

    return shadow_factor
