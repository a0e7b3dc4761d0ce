"""Light culling: which lights each screen tile considers, as bit masks in light order.

Depth bounds per tile, then two levels: coarse tiles (several tiles a side) test every light, tiles test only what their
coarse tile kept. A light may be tested in vain, never missed: spheres are inflated by the rounding bound. A tile's
volume is the slice of its frustum between its depth bounds; a sphere must reach the slice's box and all four side
planes, a cone must reach the slice's bounding sphere (Wronski 2017, "Cull that cone!").
Masks are combined with atomic OR, so their order cannot show. Masks, and the tables and bounds that the mask kernels
see, are those of one band of tiles, be it of all; only a tile's coarse tile is numbered over all bands. Block size 64.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import load_vec4, lowest_bit
from .projection import pixel_index
from .structs import (
    ALL_BITS,
    LIGHT_DIRECTIONAL,
    LIGHT_SPOT,
    MODULE_OPTIONS,
    ORTHOGRAPHIC,
    FrameValues,
    LightMasks,
    Lights,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: depth bounds used or not: what CI compiles.
VARIANTS = [(False,), (True,)]


@wp.struct
class TileVolume:
    """Slice of a tile's frustum: side planes in scaled view space, box in view space (x, y, distance)."""

    left: wp.vec2  # plane (n_x, n_w) of n_x x_scaled + n_w w >= 0, unit length in metres
    right: wp.vec2
    top: wp.vec2
    bottom: wp.vec2
    low: wp.vec3
    high: wp.vec3
    center: wp.vec3
    radius: wp.float32


@wp.func
def slice_extent(edge0: wp.float32, edge1: wp.float32, near: wp.float32, far: wp.float32):
    """Least and largest coordinate of a slice whose sides are the rays edge0 < edge1, between two depths."""
    return wp.vec2(wp.min(edge0 * near, edge0 * far), wp.max(edge1 * near, edge1 * far))


@wp.func
def tile_volume(view: View, x0: wp.int32, y0: wp.int32, x1: wp.int32, y1: wp.int32, bounds: wp.vec2):
    """Volume of the pixels [x0, x1) x [y0, y1) between two view depths."""
    fx, fy = view.scale[0], -view.scale[1]
    left, right = (wp.float32(x0) - view.center[0]) / fx, (wp.float32(x1) - view.center[0]) / fx
    bottom, top = (view.center[1] - wp.float32(y1)) / fy, (view.center[1] - wp.float32(y0)) / fy
    volume = TileVolume()
    near, far = bounds[0], bounds[1]
    if view.projection == ORTHOGRAPHIC:
        volume.low = wp.vec3(left, bottom, near)
        volume.high = wp.vec3(right, top, far)
    else:
        x, y = slice_extent(left, right, near, far), slice_extent(bottom, top, near, far)
        volume.low = wp.vec3(x[0], y[0], near)
        volume.high = wp.vec3(x[1], y[1], far)
        volume.left = wp.vec2(1.0, -left) / wp.sqrt(1.0 + left * left)
        volume.right = wp.vec2(-1.0, right) / wp.sqrt(1.0 + right * right)
        volume.bottom = wp.vec2(1.0, -bottom) / wp.sqrt(1.0 + bottom * bottom)
        volume.top = wp.vec2(-1.0, top) / wp.sqrt(1.0 + top * top)
    volume.center = (volume.low + volume.high) * 0.5
    volume.radius = wp.length(volume.high - volume.low) * 0.5
    return volume


@wp.func
def sphere_reaches(view: View, volume: TileVolume, center: wp.vec3, radius: wp.float32):
    """Whether a sphere may touch the volume; center is (x, y, distance) in view space."""
    nearest = wp.max(volume.low, wp.min(center, volume.high))
    away = center - nearest
    if wp.dot(away, away) > radius * radius:
        return False
    if view.projection == ORTHOGRAPHIC:
        return True
    x, y, w = center[0], center[1], center[2]
    side = wp.min(volume.left[0] * x + volume.left[1] * w, volume.right[0] * x + volume.right[1] * w)
    rise = wp.min(volume.bottom[0] * y + volume.bottom[1] * w, volume.top[0] * y + volume.top[1] * w)
    return wp.min(side, rise) >= -radius


@wp.func
def cone_reaches(volume: TileVolume, apex: wp.vec3, axis: wp.vec3, cosine: wp.float32, margin: wp.float32):
    """Whether a cone may touch the volume's bounding sphere; wide cones always may."""
    if cosine < 0.1:
        return True
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    v = volume.center - apex
    along = wp.dot(v, axis)
    across = wp.sqrt(wp.max(wp.dot(v, v) - along * along, 0.0))
    radius = volume.radius * 1.0001 + margin
    return across * cosine - along * sine <= radius and along >= -radius


@wp.func
def light_reaches(view: View, volume: TileVolume, lights: Lights, v: wp.int32, i: wp.int32):
    """Whether a light may reach a tile."""
    place = load_vec4(lights.position, v * lights.capacity + i)
    reach = place[3]
    if reach < 0.0:
        return False
    kind = wp.int32(lights.shape[i][3]) & 3
    if kind == LIGHT_DIRECTIONAL:
        return True
    p = view.rotation * wp.vec3(place[0], place[1], place[2])
    center = wp.vec3(p[0], p[1], -p[2])
    # 1e-4 of the range and 1e-5 of all distances cover the rounding here and in the shading. A point in reach is no
    # farther than light and range together, so an unbounded slice needs no wider margin.
    away = wp.abs(center[0]) + wp.abs(center[1]) + wp.abs(center[2])
    if wp.isfinite(reach) and not sphere_reaches(view, volume, center, reach * 1.0001 + 1.0e-5 * away):
        return False
    margin = 1.0e-5 * (away + wp.length(volume.center) + volume.radius)
    # An unbounded slice has no bounding sphere.
    if kind == LIGHT_SPOT and wp.isfinite(margin):
        a = lights.axis[i]
        d = view.rotation * wp.vec3(a[0], a[1], a[2])
        return cone_reaches(volume, center, wp.vec3(d[0], d[1], -d[2]), lights.color[i][3], margin)
    return True


@wp.kernel
def tile_bounds_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    depth: wp.array[wp.float32],
    # Params
    tile_shift: wp.int32,
    first: wp.int32,
    # Out
    out_bounds: wp.array[wp.vec2],
):
    """Nearest and farthest depth of a tile's surfaces; (inf, 0) where there is none. One block a tile."""
    row, lane = wp.tid()
    t = row + first
    tile = tiles[t]
    view = views[tile[0]]
    side = wp.int32(1) << tile_shift
    near, far = wp.float32(wp.inf), wp.float32(0.0)
    k = lane
    while k < side * side:
        x, y = tile[1] + (k & (side - 1)), tile[2] + (k >> tile_shift)
        if x < view.width and y < view.height:
            d = depth[pixel_index(view, x, y)]
            if wp.isfinite(d):
                near = wp.min(near, d)
                far = wp.max(far, d)
        k += wp.block_dim()
    nearest = wp.tile_min(wp.tile(near))
    farthest = wp.tile_max(wp.tile(far))
    result = wp.vec2(nearest[0], farthest[0])
    if lane == 0:
        out_bounds[t] = result


@wp.kernel
def coarse_bounds_kernel(
    # Frame
    views: wp.array[View],
    coarse_tiles: wp.array[wp.vec4i],
    # In
    bounds: wp.array[wp.vec2],
    # Params
    tile_shift: wp.int32,
    coarse_shift: wp.int32,
    first: wp.int32,
    # Out
    out_bounds: wp.array[wp.vec2],
):
    """Join the bounds of a coarse tile's tiles. One block a coarse tile."""
    row, lane = wp.tid()
    t = row + first
    tile = coarse_tiles[t]
    view = views[tile[0]]
    side = wp.int32(1) << coarse_shift
    x0, y0 = tile[1] >> tile_shift, tile[2] >> tile_shift
    tiles_y = (view.height + (wp.int32(1) << tile_shift) - 1) >> tile_shift
    near, far = wp.float32(wp.inf), wp.float32(0.0)
    k = lane
    while k < side * side:
        x, y = x0 + (k & (side - 1)), y0 + (k >> coarse_shift)
        if x < view.tiles_x and y < tiles_y:
            b = bounds[view.tile_offset + y * view.tiles_x + x]
            near = wp.min(near, b[0])
            far = wp.max(far, b[1])
        k += wp.block_dim()
    nearest = wp.tile_min(wp.tile(near))
    farthest = wp.tile_max(wp.tile(far))
    result = wp.vec2(nearest[0], farthest[0])
    if lane == 0:
        out_bounds[t] = result


@functools.cache
def make_light_culling_kernels(depth_bounds: bool):
    """(coarse, fine) kernels that fill the masks, with depth bounds or without any."""

    @wp.func
    def effective_bounds(view: View, bounds: wp.vec2):
        if wp.static(depth_bounds):
            return bounds
        if bounds[0] > bounds[1]:
            return bounds
        # An orthographic view may start behind its eye.
        return wp.vec2(wp.where(view.projection == ORTHOGRAPHIC, -1.0e30, 0.0), 1.0e30)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def coarse_masks_kernel(
        # Frame
        views: wp.array[View],
        values: wp.array[FrameValues],
        coarse_tiles: wp.array[wp.vec4i],
        # In
        lights: Lights,
        # Params
        first: wp.int32,
        # Out
        out_masks: LightMasks,
    ):
        row, i = wp.tid()
        t = row + first
        if i >= values[0].light_count:
            return
        bounds = out_masks.coarse_bounds[t]
        if bounds[0] > bounds[1]:
            return
        tile = coarse_tiles[t]
        view = views[tile[0]]
        side = wp.int32(1) << (out_masks.tile_shift + out_masks.coarse_shift)
        x1, y1 = wp.min(tile[1] + side, view.width), wp.min(tile[2] + side, view.height)
        volume = tile_volume(view, tile[1], tile[2], x1, y1, effective_bounds(view, bounds))
        if light_reaches(view, volume, lights, tile[0], i):
            bit = wp.uint32(1) << wp.uint32(i & 31)
            wp.atomic_or(out_masks.coarse, t * out_masks.words_per_tile + (i >> 5), bit)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def tile_masks_kernel(
        # Frame
        views: wp.array[View],
        tiles: wp.array[wp.vec4i],
        # In
        lights: Lights,
        # Params
        first: wp.int32,
        # Out
        out_masks: LightMasks,
    ):
        row, word = wp.tid()
        t = row + first
        tile = tiles[t]
        place = t * out_masks.words_per_tile + word
        bounds = out_masks.bounds[t]
        candidates = out_masks.coarse[(tile[3] - out_masks.first_coarse) * out_masks.words_per_tile + word]
        if candidates == wp.uint32(0) or bounds[0] > bounds[1]:
            out_masks.words[place] = wp.uint32(0)
            return
        view = views[tile[0]]
        side = wp.int32(1) << out_masks.tile_shift
        x1, y1 = wp.min(tile[1] + side, view.width), wp.min(tile[2] + side, view.height)
        volume = tile_volume(view, tile[1], tile[2], x1, y1, effective_bounds(view, bounds))
        kept = wp.uint32(0)
        while candidates != wp.uint32(0):
            b = lowest_bit(candidates)
            candidates = candidates & (candidates - wp.uint32(1))
            if light_reaches(view, volume, lights, tile[0], word * 32 + b):
                kept = kept | (wp.uint32(1) << wp.uint32(b))
        out_masks.words[place] = kept
        if kept != wp.uint32(0):
            bit = wp.uint32(1) << wp.uint32(word & 31)
            wp.atomic_or(out_masks.summary, t * out_masks.summary_per_tile + (word >> 5), bit)

    return coarse_masks_kernel, tile_masks_kernel


@wp.kernel
def all_lights_kernel(
    # Frame
    values: wp.array[FrameValues],
    # Params
    first: wp.int32,
    # Out
    out_masks: LightMasks,
):
    """Set the bit of every light in every tile: the reference that culling must not differ from."""
    row, word = wp.tid()
    t = row + first
    left = values[0].light_count - word * 32
    bits = wp.uint32(0)
    if left >= 32:
        bits = ALL_BITS
    elif left > 0:
        bits = (wp.uint32(1) << wp.uint32(left)) - wp.uint32(1)
    out_masks.words[t * out_masks.words_per_tile + word] = bits
    if bits != wp.uint32(0):
        bit = wp.uint32(1) << wp.uint32(word & 31)
        wp.atomic_or(out_masks.summary, t * out_masks.summary_per_tile + (word >> 5), bit)
