"""Filters over a shadow map: which share of its texels round a point lets light through to a depth.

pcf weighs 4 x 4 comparisons by the product of (1-f, 2-f, 1+f, f) / 4 along each side, the tent 1 2 1 run over
bilinear weights (Reeves et al. 1987, "Rendering Antialiased Shadows with Depth Maps", with fixed weights); f is in
256ths, so that the weights sum to 1 exactly. pcss (Fernando 2005, "Percentage-Closer Soft Shadows") looks for blockers
on a lattice of texels around the point and then weighs a disc as wide as the penumbra of their mean depth, both
measured from the receiver's plane, along which z is linear over the map. The lattice stands still in the map, so there
is neither noise nor banding. z being linear in what widens a penumbra, the mean of z is the mean to take.
Larger z is nearer to the light. Functions only, no kernel.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import bits_float
from .structs import ShadowMaps

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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
def plane_depth(z: wp.float32, slope: wp.vec2, dx: wp.float32, dy: wp.float32):
    """Depth of the receiver's plane beside the point; never below that of an empty texel, though the plane may be."""
    return wp.max(z + slope[0] * dx + slope[1] * dy, 0.0)


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
            if dx * dx + dy * dy <= radius * radius and depth > plane_depth(z, slope, dx, dy):
                total += depth
                count += 1.0
            x += step
        y += step
    if count == 0.0:
        return wp.float32(-1.0)
    return total / count


@wp.func
def disc_factor(
    maps: ShadowMaps, tile: wp.vec4i, u: wp.float32, v: wp.float32, z: wp.float32, slope: wp.vec2, radius: wp.float32
):
    """Share of light by a disc of texels, soft over one step at its rim; z changes by `slope` a texel."""
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
            lit += weight * passes(maps, texel_index(tile, x, y), plane_depth(z, slope, dx, dy))
            x += step
        y += step
    # The two sums are made alike, so all lit is 1 exactly.
    return lit / total
