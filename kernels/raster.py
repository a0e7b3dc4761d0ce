"""Raster: clusters to visibility keys.

One block of CLUSTER_SIZE lanes per work-list entry over a fixed grid with a stride loop; vertices are transformed in
the lane itself. Coverage is integer: vertices snap to 1/256 px, edges are tested exactly, the top-left rule decides
shared edges (Direct3D 11.3 functional specification, 3.4.2). Small triangles are drawn here with 32-bit edge values,
exact because their extent is below 2^14 sub-pixels; large ones are stored for the bins (bins.py), and what does not
fit there is drawn here with 64-bit values. All three evaluate depth with `fragment_depth` from the same integers.

Clip vertices are computed from an edge's two ends in the order of their coordinates, not of their ids: neighbours
agree even where a file repeats shared vertices.

Block size 128. Keys are combined by maximum, so the result does not depend on any order.
"""

from __future__ import annotations

import functools

import warp as wp

from .masking import make_discard
from .projection import float_bits, pixel_index, to_homogeneous, to_view, vertex_depth
from .structs import (
    ALL_BITS,
    CLUSTER_SIZE,
    CULL_BACK,
    CULL_FRONT,
    FLAG_MASKED,
    FLAG_TWO_SIDED,
    GUARD_BAND_PX,
    MODULE_OPTIONS,
    ORTHOGRAPHIC,
    PERSPECTIVE,
    SUBPIXEL,
    Geometry,
    LargeTriangle,
    Material,
    Pair,
    RasterTarget,
    View,
    WorkList,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 128
#: Bounding boxes of up to this many pixels are drawn by their lane.
SMALL_AREA_PX = 192
#: (careful, masked, depth_views, behind): what CI compiles.
VARIANTS = [
    (careful, masked, depth_views, behind)
    for careful, masked in ((False, False), (True, False), (True, True))
    for depth_views in (False, True)
    for behind in (False, True)
]

ClipPolygon = wp.types.matrix(shape=(9, 4), dtype=wp.float32)


@wp.func
def snap(position_px: wp.float32):
    """Snap to 1/256 px; floor(v + 0.5) rounds the same way on every device and on both sides of zero."""
    return wp.int32(
        wp.floor(wp.clamp(position_px, -GUARD_BAND_PX, GUARD_BAND_PX) * wp.float32(SUBPIXEL) + wp.float32(0.5))
    )


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
def fragment_depth(e0: wp.float32, e1: wp.float32, e2: wp.float32, area: wp.float32, z: wp.vec3):
    """Depth at a pixel from its exact edge values; all terms are >= 0, so the error stays within a few ulp."""
    return (e0 * z[0] + e1 * z[1] + e2 * z[2]) / area


@wp.func
def accept_depth(view: View, z: wp.float32):
    """Depth clamped to [0, 1], or -1 for an orthographic fragment outside near and far."""
    if view.projection == ORTHOGRAPHIC and view.depth_clamp == 0 and (z < 0.0 or z > 1.0):
        return wp.float32(-1.0)
    if not (z > 0.0):
        return wp.float32(0.0)
    return wp.min(z, 1.0)


@functools.cache
def make_write_fragment(depth_views: bool, behind: bool):
    """Function that combines one fragment into the keys."""

    @wp.func
    def write_fragment(view: View, target: RasterTarget, index: wp.int32, z: wp.float32, identity: wp.uint32):
        bits = float_bits(z)
        if wp.static(depth_views):
            if view.depth_only != 0:
                if bits > target.depth_keys[index]:
                    wp.atomic_max(target.depth_keys, index, bits)
                return
        key = (wp.uint64(bits) << wp.uint64(32)) | wp.uint64(ALL_BITS - identity)
        if wp.static(behind):
            if key >= target.behind[index]:
                return
        # The plain read may be stale, never too large: a fragment that loses here would lose in the atomic too.
        if key > target.keys[index]:
            wp.atomic_max(target.keys, index, key)

    return write_fragment


@functools.cache
def make_draw(depth_views: bool, behind: bool):
    """Functions that draw a snapped, oriented triangle: small (32-bit), direct (64-bit)."""
    write_fragment = make_write_fragment(depth_views, behind)

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
        area = wp.float32(b2 * (t.p2[1] - t.p0[1]) + a2 * (t.p2[0] - t.p0[0]))
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
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), area, t.z))
                    if z >= 0.0:
                        write_fragment(view, target, index, z, t.id)
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
        area = wp.float32(wp.int64(b2) * wp.int64(t.p2[1] - t.p0[1]) + wp.int64(a2) * wp.int64(t.p2[0] - t.p0[0]))
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
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), area, t.z))
                    if z >= 0.0:
                        write_fragment(view, target, index, z, t.id)
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


@functools.cache
def make_emit(depth_views: bool, behind: bool):
    """Function that draws an oriented triangle by the path its size calls for."""
    draw_small, draw_direct = make_draw(depth_views, behind)

    @wp.func
    def emit(view: View, target: RasterTarget, t: LargeTriangle):
        x_min = wp.min(t.p0[0], wp.min(t.p1[0], t.p2[0]))
        x_max = wp.max(t.p0[0], wp.max(t.p1[0], t.p2[0]))
        y_min = wp.min(t.p0[1], wp.min(t.p1[1], t.p2[1]))
        y_max = wp.max(t.p0[1], wp.max(t.p1[1], t.p2[1]))
        low = wp.vec2i(wp.max(first_pixel(x_min), 0), wp.max(first_pixel(y_min), 0))
        high = wp.vec2i(wp.min(last_pixel(x_max), view.width - 1), wp.min(last_pixel(y_max), view.height - 1))
        wide, tall = high[0] - low[0] + 1, high[1] - low[1] + 1
        if wide <= 0 or tall <= 0:
            return
        extent = wp.max(x_max - x_min, y_max - y_min)
        if extent < 16384 and wide * tall <= wp.static(SMALL_AREA_PX):
            draw_small(view, target, t, low, high)
            return
        capacity = target.large.shape[0]
        place = capacity
        if capacity > 0:
            place = wp.atomic_add(target.large_count, 0, 1)
        if place < capacity:
            target.large[place] = t
        elif extent < 16384:
            draw_small(view, target, t, low, high)
        else:
            draw_direct(view, target, t, low, high)

    return emit


@wp.func
def clip_distance(vertex: wp.vec4, plane: wp.int32, near: wp.float32):
    """Signed distance of (x_px w, y_px w, w, view distance) from the near plane (0) or a side of the guard band."""
    if plane == 0:
        return vertex[3] - near
    if plane == 1:
        return GUARD_BAND_PX * vertex[2] + vertex[0]
    if plane == 2:
        return GUARD_BAND_PX * vertex[2] - vertex[0]
    if plane == 3:
        return GUARD_BAND_PX * vertex[2] + vertex[1]
    return GUARD_BAND_PX * vertex[2] - vertex[1]


@wp.func
def in_order(a: wp.vec4, b: wp.vec4):
    """Whether a comes before b in the order of coordinates."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[3] < b[3]


@wp.func
def crossing(a: wp.vec4, b: wp.vec4, da: wp.float32, db: wp.float32):
    """Point of an edge on the clip plane, the same to the bit from both sides of the edge."""
    if in_order(a, b):
        return a + (b - a) * (da / (da - db))
    return b + (a - b) * (db / (db - da))


@wp.func
def clip_polygon(polygon: ClipPolygon, count: wp.int32, plane: wp.int32, near: wp.float32):
    """Cut a convex polygon by one plane (Sutherland and Hodgman 1974); the new count stands in row 8."""
    result = ClipPolygon()
    kept = wp.int32(0)
    for i in range(count):
        j = i + 1
        if j == count:
            j = 0
        a, b = polygon[i], polygon[j]
        da, db = clip_distance(a, plane, near), clip_distance(b, plane, near)
        if da >= 0.0:
            result[kept] = a
            kept += 1
        if (da >= 0.0) != (db >= 0.0):
            vertex = crossing(a, b, da, db)
            if plane == 0:
                vertex[2] = near
                vertex[3] = near
            result[kept] = vertex
            kept += 1
    result[8] = wp.vec4(wp.float32(kept), 0.0, 0.0, 0.0)
    return result


@wp.func
def clip_vertex(view: View, scaled: wp.vec3):
    """(x_px w, y_px w, w, view distance), w being 1 for orthographic views."""
    h = to_homogeneous(view, scaled)
    return wp.vec4(h[0], h[1], h[2], scaled[2])


@wp.func
def snap_vertex(vertex: wp.vec4):
    """Snapped screen position of a clipped vertex."""
    inverse = 1.0 / vertex[2]
    return wp.vec2i(snap(vertex[0] * inverse), snap(vertex[1] * inverse))


@functools.cache
def make_raster_kernel(careful: bool, masked: bool, depth_views: bool, behind: bool):
    """Kernel that draws the plain or the careful end of the work list.

    Args:
        careful: Clip against the near plane and the guard band.
        masked: Ask the material's discard hook for every fragment; needs `careful`.
        depth_views: Some views keep 32-bit depth keys only.
        behind: Draw only what lies behind given keys.
    """
    emit = make_emit(depth_views, behind)
    write_fragment = make_write_fragment(depth_views, behind)
    keep_fragment = make_discard()

    @wp.func
    def draw_masked(
        view: View,
        target: RasterTarget,
        pair: Pair,
        geometry: Geometry,
        material: Material,
        v: wp.vec3i,
        t: LargeTriangle,
    ):
        x_min = wp.min(t.p0[0], wp.min(t.p1[0], t.p2[0]))
        x_max = wp.max(t.p0[0], wp.max(t.p1[0], t.p2[0]))
        y_min = wp.min(t.p0[1], wp.min(t.p1[1], t.p2[1]))
        y_max = wp.max(t.p0[1], wp.max(t.p1[1], t.p2[1]))
        a0, b0 = t.p1[1] - t.p2[1], t.p2[0] - t.p1[0]
        a1, b1 = t.p2[1] - t.p0[1], t.p0[0] - t.p2[0]
        a2, b2 = t.p0[1] - t.p1[1], t.p1[0] - t.p0[0]
        l0, l1, l2 = (
            wp.int64(edge_threshold(a0, b0)),
            wp.int64(edge_threshold(a1, b1)),
            wp.int64(edge_threshold(a2, b2)),
        )
        area = wp.float32(wp.int64(b2) * wp.int64(t.p2[1] - t.p0[1]) + wp.int64(a2) * wp.int64(t.p2[0] - t.p0[0]))
        for py in range(wp.max(first_pixel(y_min), 0), wp.min(last_pixel(y_max), view.height - 1) + 1):
            y = py * 256 + 128
            for px in range(wp.max(first_pixel(x_min), 0), wp.min(last_pixel(x_max), view.width - 1) + 1):
                x = px * 256 + 128
                e0 = wp.int64(a0) * wp.int64(x - t.p1[0]) + wp.int64(b0) * wp.int64(y - t.p1[1])
                e1 = wp.int64(a1) * wp.int64(x - t.p2[0]) + wp.int64(b1) * wp.int64(y - t.p2[1])
                e2 = wp.int64(a2) * wp.int64(x - t.p0[0]) + wp.int64(b2) * wp.int64(y - t.p0[1])
                if e0 >= l0 and e1 >= l1 and e2 >= l2:
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), area, t.z))
                    if z >= 0.0 and keep_fragment(view, pair, geometry, material, v, px, py):
                        write_fragment(view, target, pixel_index(view, px, py), z, t.id)

    @wp.func
    def draw_clipped(
        view: View,
        target: RasterTarget,
        pair: Pair,
        geometry: Geometry,
        materials: wp.array[Material],
        v: wp.vec3i,
        identity: wp.uint32,
    ):
        c0 = clip_vertex(view, to_view(pair, geometry.positions[v[0]]))
        c1 = clip_vertex(view, to_view(pair, geometry.positions[v[1]]))
        c2 = clip_vertex(view, to_view(pair, geometry.positions[v[2]]))
        if not (wp.isfinite(c0) and wp.isfinite(c1) and wp.isfinite(c2)):
            return
        instance = geometry.instances[pair.instance]
        polygon = ClipPolygon()
        polygon[0] = c0
        polygon[1] = c1
        polygon[2] = c2
        count = wp.int32(3)
        plane = wp.int32(0)
        if view.projection != PERSPECTIVE:
            plane = 1
        while plane < 5 and count >= 3:
            polygon = clip_polygon(polygon, count, plane, view.near)
            count = wp.int32(polygon[8, 0])
            plane += 1
        for i in range(2, count):
            t = LargeTriangle()
            t.p0 = snap_vertex(polygon[0])
            t.p1 = snap_vertex(polygon[i - 1])
            t.p2 = snap_vertex(polygon[i])
            t.z = wp.vec3(
                vertex_depth(view, polygon[0, 3]),
                vertex_depth(view, polygon[i - 1, 3]),
                vertex_depth(view, polygon[i, 3]),
            )
            t.id = identity
            t.view = pair.view
            t = orient(pair, view, (instance.flags & FLAG_TWO_SIDED) != 0, t)
            if t.id != ALL_BITS:
                if wp.static(masked):
                    if (instance.flags & FLAG_MASKED) != 0:
                        draw_masked(view, target, pair, geometry, materials[instance.material], v, t)
                    else:
                        emit(view, target, t)
                else:
                    emit(view, target, t)

    @wp.func
    def draw_plain(view: View, target: RasterTarget, pair: Pair, geometry: Geometry, v: wp.vec3i, identity: wp.uint32):
        s0 = to_view(pair, geometry.positions[v[0]])
        s1 = to_view(pair, geometry.positions[v[1]])
        s2 = to_view(pair, geometry.positions[v[2]])
        if not (wp.isfinite(s0) and wp.isfinite(s1) and wp.isfinite(s2)):
            return
        t = LargeTriangle()
        t.p0 = snap_vertex(clip_vertex(view, s0))
        t.p1 = snap_vertex(clip_vertex(view, s1))
        t.p2 = snap_vertex(clip_vertex(view, s2))
        t.z = wp.vec3(vertex_depth(view, s0[2]), vertex_depth(view, s1[2]), vertex_depth(view, s2[2]))
        t.id = identity
        t.view = pair.view
        flags = geometry.instances[pair.instance].flags
        t = orient(pair, view, (flags & FLAG_TWO_SIDED) != 0, t)
        if t.id != ALL_BITS:
            emit(view, target, t)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def raster_kernel(
        # Frame
        views: wp.array[View],
        # Scene
        geometry: Geometry,
        materials: wp.array[Material],
        # In
        pairs: wp.array[Pair],
        work: WorkList,
        # Params
        first: wp.int32,
        step: wp.int32,
        stride: wp.int32,
        # Out
        out_target: RasterTarget,
    ):
        thread = wp.tid()
        lane = thread % CLUSTER_SIZE
        e = first + (thread // CLUSTER_SIZE) * step
        count = work.counts[wp.static(1 if careful else 0)]
        while e < count:
            place = e
            if wp.static(careful):
                place = work.entries.shape[0] - 1 - e
            entry = work.entries[place]
            pair = pairs[entry[0]]
            cluster = geometry.clusters[entry[1]]
            if lane < cluster.count:
                corner = geometry.cluster_triangles[cluster.first + lane]
                view = views[pair.view]
                identity = geometry.instances[pair.instance].id_base + wp.uint32(corner[3])
                v = wp.vec3i(corner[0], corner[1], corner[2])
                if wp.static(careful):
                    draw_clipped(view, out_target, pair, geometry, materials, v, identity)
                else:
                    draw_plain(view, out_target, pair, geometry, v, identity)
            e += stride

    return raster_kernel
