"""Coverage and depth of a snapped triangle: exact integers, one set of functions for every raster path.

Vertices snap to 1/256 px, edges are tested exactly, the top-left rule decides shared edges (Direct3D 11.3 functional
specification, 3.4.2). Depth comes from the exact edge values through `fragment_depth` on every path, so all paths write
the same bits. Functions only, no kernel.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import float_bits
from .projection import pixel_index
from .structs import (
    ALL_BITS,
    CULL_BACK,
    CULL_FRONT,
    GUARD_BAND_PX,
    ORTHOGRAPHIC,
    SUBPIXEL,
    LargeTriangle,
    Pair,
    RasterTarget,
    View,
)

#: Boxes of more pixels than the first number and at most the second look at their middle before they are drawn.
PROBE_AREA_PX = (12, 32)
#: Bin tiles of a box above which a triangle is huge: binned by a whole block of lanes, and kept apart at the end of the
#: store, a share of which is theirs.
HUGE_TILES = 32
HUGE_SHARE = 16

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def snap(position_px: wp.float32):
    """Snap to 1/256 px; floor(v + 0.5) rounds the same way on every device and on both sides of zero."""
    return wp.int32(
        wp.floor(wp.clamp(position_px, -GUARD_BAND_PX, GUARD_BAND_PX) * wp.float32(SUBPIXEL) + wp.float32(0.5))
    )


@wp.func
def huge_first(capacity: wp.int32):
    """First place of huge triangles in a store of large ones."""
    return capacity - capacity // wp.static(HUGE_SHARE)


@wp.func
def first_pixel(low: wp.int32):
    """First pixel whose centre is at or past a snapped coordinate."""
    return (low + 127) >> 8


@wp.func
def last_pixel(high: wp.int32):
    """Last pixel whose centre is at or before a snapped coordinate."""
    return (high - 128) >> 8


@wp.func
def edge_threshold(a: wp.int32, b: wp.int32):
    """Least edge value that is inside: 0 on a top or left edge, else 1. The edge steps by a in x and b in y."""
    if a > 0 or (a == 0 and b > 0):
        return 0
    return 1


@wp.func
def fragment_depth(e0: wp.float32, e1: wp.float32, e2: wp.float32, inverse: wp.float32, z: wp.vec3):
    """Depth at a pixel from its exact edge values and 1 / area; all terms are >= 0: an error of a few ulp.

    One division a triangle instead of one a pixel costs one more rounding.
    """
    return (e0 * z[0] + e1 * z[1] + e2 * z[2]) * inverse


@wp.func
def accept_depth(view: View, z: wp.float32):
    """Depth clamped to [0, 1], or -1 for NaN and for an orthographic fragment outside near and far: not drawn."""
    if view.projection == ORTHOGRAPHIC and view.depth_clamp == 0 and (z < 0.0 or z > 1.0):
        return wp.float32(-1.0)
    if z > 0.0:
        return wp.min(z, 1.0)
    return wp.where(z <= 0.0, 0.0, -1.0)


@functools.cache
def make_write_fragment(depth_views: bool, behind: bool):
    """Function that combines one fragment into the keys."""

    @wp.func
    def write_fragment(
        view: View, target: RasterTarget, index: wp.int32, z: wp.float32, identity: wp.uint32, crowded: bool
    ):
        bits = float_bits(z)
        if wp.static(depth_views):
            if view.depth_only != 0:
                if not crowded or bits > target.depth_keys[index]:
                    wp.atomic_max(target.depth_keys, index, bits)
                return
        key = (wp.uint64(bits) << wp.uint64(32)) | wp.uint64(ALL_BITS - identity)
        if wp.static(behind):
            if key >= target.behind[index]:
                return
        # Where the triangle's middle is hidden already, look before each write: the plain read may be stale, never too
        # large: what loses here would lose in the atomic too. Elsewhere waiting for the read costs more than it saves.
        if not crowded or key > target.keys[index]:
            wp.atomic_max(target.keys, index, key)

    return write_fragment


@functools.cache
def make_hidden_middle(depth_views: bool):
    """Function that tells whether the pixel in the middle of a triangle's box is nearer already than all of it."""

    @wp.func
    def hidden_middle(view: View, target: RasterTarget, t: LargeTriangle, low: wp.vec2i, high: wp.vec2i):
        index = pixel_index(view, (low[0] + high[0]) // 2, (low[1] + high[1]) // 2)
        nearest = float_bits(accept_depth(view, wp.max(t.z[0], wp.max(t.z[1], t.z[2]))))
        if wp.static(depth_views):
            if view.depth_only != 0:
                return target.depth_keys[index] > nearest
        return wp.uint32(target.keys[index] >> wp.uint64(32)) > nearest

    return hidden_middle


@functools.cache
def make_draw(depth_views: bool, behind: bool):
    """Functions that draw a snapped, oriented triangle: small (32-bit), direct (64-bit)."""
    write_fragment = make_write_fragment(depth_views, behind)
    hidden_middle = make_hidden_middle(depth_views)

    @wp.func
    def draw_small(view: View, target: RasterTarget, t: LargeTriangle, low: wp.vec2i, high: wp.vec2i):
        a0, b0 = t.p1[1] - t.p2[1], t.p2[0] - t.p1[0]
        a1, b1 = t.p2[1] - t.p0[1], t.p0[0] - t.p2[0]
        a2, b2 = t.p0[1] - t.p1[1], t.p1[0] - t.p0[0]
        x, y = low[0] * 256 + 128, low[1] * 256 + 128
        row0 = a0 * (x - t.p1[0]) + b0 * (y - t.p1[1])
        row1 = a1 * (x - t.p2[0]) + b1 * (y - t.p2[1])
        row2 = a2 * (x - t.p0[0]) + b2 * (y - t.p0[1])
        t0, t1, t2 = edge_threshold(a0, b0), edge_threshold(a1, b1), edge_threshold(a2, b2)
        crowded = wp.bool(False)
        # Fewer pixels are not worth the wait; more would wait at every pixel where a hill hides a lone triangle.
        box = (high[0] - low[0] + 1) * (high[1] - low[1] + 1)
        if box > wp.static(PROBE_AREA_PX[0]) and box <= wp.static(PROBE_AREA_PX[1]):
            crowded = hidden_middle(view, target, t, low, high)
        inverse = 1.0 / wp.float32(b2 * (t.p2[1] - t.p0[1]) + a2 * (t.p2[0] - t.p0[0]))
        a0, a1, a2 = a0 * 256, a1 * 256, a2 * 256
        b0, b1, b2 = b0 * 256, b1 * 256, b2 * 256
        for py in range(low[1], high[1] + 1):
            # One by one: a tuple assignment would alias the rows in Warp, not copy them.
            e0 = row0
            e1 = row1
            e2 = row2
            index = pixel_index(view, low[0], py)
            for _px in range(low[0], high[0] + 1):
                if e0 >= t0 and e1 >= t1 and e2 >= t2:
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), inverse, t.z))
                    if z >= 0.0:
                        write_fragment(view, target, index, z, t.id, crowded)
                e0 += a0
                e1 += a1
                e2 += a2
                index += 1
            row0 += b0
            row1 += b1
            row2 += b2

    @wp.func
    def draw_direct(view: View, target: RasterTarget, t: LargeTriangle, low: wp.vec2i, high: wp.vec2i):
        a0, b0 = t.p1[1] - t.p2[1], t.p2[0] - t.p1[0]
        a1, b1 = t.p2[1] - t.p0[1], t.p0[0] - t.p2[0]
        a2, b2 = t.p0[1] - t.p1[1], t.p1[0] - t.p0[0]
        x, y = low[0] * 256 + 128, low[1] * 256 + 128
        row0 = wp.int64(a0) * wp.int64(x - t.p1[0]) + wp.int64(b0) * wp.int64(y - t.p1[1])
        row1 = wp.int64(a1) * wp.int64(x - t.p2[0]) + wp.int64(b1) * wp.int64(y - t.p2[1])
        row2 = wp.int64(a2) * wp.int64(x - t.p0[0]) + wp.int64(b2) * wp.int64(y - t.p0[1])
        t0, t1, t2 = edge_threshold(a0, b0), edge_threshold(a1, b1), edge_threshold(a2, b2)
        l0, l1, l2 = wp.int64(t0), wp.int64(t1), wp.int64(t2)
        crowded = hidden_middle(view, target, t, low, high)
        area = wp.int64(b2) * wp.int64(t.p2[1] - t.p0[1]) + wp.int64(a2) * wp.int64(t.p2[0] - t.p0[0])
        inverse = 1.0 / wp.float32(area)
        s0, s1, s2 = wp.int64(a0) * wp.int64(256), wp.int64(a1) * wp.int64(256), wp.int64(a2) * wp.int64(256)
        r0, r1, r2 = wp.int64(b0) * wp.int64(256), wp.int64(b1) * wp.int64(256), wp.int64(b2) * wp.int64(256)
        for py in range(low[1], high[1] + 1):
            # One by one: a tuple assignment would alias the rows in Warp, not copy them.
            e0 = row0
            e1 = row1
            e2 = row2
            index = pixel_index(view, low[0], py)
            for _px in range(low[0], high[0] + 1):
                if e0 >= l0 and e1 >= l1 and e2 >= l2:
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), inverse, t.z))
                    if z >= 0.0:
                        write_fragment(view, target, index, z, t.id, crowded)
                e0 += s0
                e1 += s1
                e2 += s2
                index += 1
            row0 += r0
            row1 += r1
            row2 += r2

    return draw_small, draw_direct


@wp.func
def orient(pair: Pair, view: View, two_sided: bool, t: LargeTriangle):
    """Turn a triangle so that its area is positive, y down; an id of 0xFFFFFFFF marks one that is not drawn.

    Facing comes from the snapped vertices that are drawn. Counter-clockwise in the world is negative with y down;
    a mirroring transform swaps front and back.
    """
    u, v = t.p1 - t.p0, t.p2 - t.p0
    area = wp.int64(u[0]) * wp.int64(v[1]) - wp.int64(v[0]) * wp.int64(u[1])
    front = (area < wp.int64(0)) != (pair.flip != 0)
    culled = area == wp.int64(0)
    if not two_sided:
        culled = culled or (view.cull_mode == CULL_BACK and not front) or (view.cull_mode == CULL_FRONT and front)
    result = t
    if area < wp.int64(0):
        result.p1 = t.p2
        result.p2 = t.p1
        result.z = wp.vec3(t.z[0], t.z[2], t.z[1])
    if culled:
        result.id = ALL_BITS
    return result


@wp.func
def pixel_box(view: View, t: LargeTriangle):
    """First and last column and row (x0, y0, x1, y1) whose centres a triangle may cover inside the view."""
    x0 = first_pixel(wp.min(t.p0[0], wp.min(t.p1[0], t.p2[0])))
    x1 = last_pixel(wp.max(t.p0[0], wp.max(t.p1[0], t.p2[0])))
    y0 = first_pixel(wp.min(t.p0[1], wp.min(t.p1[1], t.p2[1])))
    y1 = last_pixel(wp.max(t.p0[1], wp.max(t.p1[1], t.p2[1])))
    return wp.vec4i(wp.max(x0, 0), wp.max(y0, 0), wp.min(x1, view.width - 1), wp.min(y1, view.height - 1))


@wp.func
def fits_32_bits(t: LargeTriangle):
    """Whether a triangle's edge values fit 32 bits over its own box: extents below 2^14 sub-pixels, 64 px."""
    u, v, w = t.p1 - t.p0, t.p2 - t.p0, t.p2 - t.p1
    x = wp.max(wp.abs(u[0]), wp.max(wp.abs(v[0]), wp.abs(w[0])))
    y = wp.max(wp.abs(u[1]), wp.max(wp.abs(v[1]), wp.abs(w[1])))
    return wp.max(x, y) < 16384
