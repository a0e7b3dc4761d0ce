"""Raster: clusters to visibility keys.

One block of CLUSTER_SIZE lanes per work-list entry over a fixed grid with a stride loop; vertices are transformed in
the lane itself. Two paths by the size of a triangle's pixel box, both writing the same bits: small ones are drawn by
their lane, large ones are stored for the bins (bins.py), and what does not fit there is drawn here all the same.
Edge values are 32-bit wherever the extent is below 2^14 sub-pixels. A third path, medium triangles drawn by the 32
lanes of a warp together, was tried and was slower on an H200 (docs/performance-notes.md).

Block size 128. Keys are combined by maximum, so the result does not depend on any order.
"""

from __future__ import annotations

import functools

import warp as wp

from .clipping import ClipPolygon, clip_polygon, clip_vertex, snap_vertex
from .coverage import (
    HUGE_TILES,
    accept_depth,
    edge_threshold,
    fits_32_bits,
    fragment_depth,
    huge_first,
    make_draw,
    make_write_fragment,
    orient,
    pixel_box,
)
from .intrinsics import block_width, load_vec4i
from .masking import make_discard
from .projection import pixel_index, position_of, to_view, vertex_depth
from .structs import (
    ALL_BITS,
    BIN_TILE,
    CLUSTER_SIZE,
    FLAG_MASKED,
    FLAG_TWO_SIDED,
    MODULE_OPTIONS,
    PERSPECTIVE,
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
#: Bounding boxes of up to this many pixels are drawn by their lane: in views that keep ids, and in shadow maps, whose
#: fragments cost less.
SMALL_AREA_PX = 128
SMALL_DEPTH_PX = 192
#: The plain kernel is worth eight blocks a multiprocessor; the careful one needs its registers.
PLAIN_BOUNDS = (128, 8)
#: (careful, masked, depth_views, behind): what CI compiles.
VARIANTS = [
    (careful, masked, depth_views, behind)
    for careful, masked in ((False, False), (True, False), (True, True))
    for depth_views in (False, True)
    for behind in (False, True)
]


@functools.cache
def make_emit(depth_views: bool, behind: bool):
    """Functions that tell a triangle's path, store a large one, and draw by a single lane whatever comes.

    `classify` returns 0: nothing to draw, 1: small, 2: large.
    """
    draw_small, draw_direct = make_draw(depth_views, behind)

    @wp.func
    def classify(view: View, target: RasterTarget, t: LargeTriangle, box: wp.vec4i):
        wide, tall = box[2] - box[0] + 1, box[3] - box[1] + 1
        if t.id == ALL_BITS or wide <= 0 or tall <= 0:
            return 0
        if fits_32_bits(t):
            small = wp.int32(wp.static(SMALL_AREA_PX))
            if wp.static(depth_views):
                if view.depth_only != 0:
                    small = wp.int32(wp.static(SMALL_DEPTH_PX))
            if wide * tall <= small or (block_width() == 1 and target.large.shape[0] == 0):
                return 1
        return 2

    @wp.func
    def store_large(target: RasterTarget, t: LargeTriangle, box: wp.vec4i):
        capacity = target.large.shape[0]
        if capacity == 0:
            return False
        split = huge_first(capacity)
        tiles = (box[2] // BIN_TILE - box[0] // BIN_TILE + 1) * (box[3] // BIN_TILE - box[1] // BIN_TILE + 1)
        if tiles > wp.static(HUGE_TILES):
            place = split + wp.atomic_add(target.large_count, 1, 1)
            if place < capacity:
                target.large[place] = t
                return True
        place = wp.atomic_add(target.large_count, 0, 1)
        if place < split:
            target.large[place] = t
        return place < split

    @wp.func
    def draw_alone(view: View, target: RasterTarget, t: LargeTriangle, box: wp.vec4i):
        low, high = wp.vec2i(box[0], box[1]), wp.vec2i(box[2], box[3])
        if fits_32_bits(t):
            draw_small(view, target, t, low, high)
        else:
            draw_direct(view, target, t, low, high)

    return classify, store_large, draw_alone


@functools.cache
def make_raster_kernel(careful: bool, masked: bool, depth_views: bool, behind: bool):
    """Kernel that draws the plain or the careful end of the work list.

    Args:
        careful: Clip against the near plane and the guard band.
        masked: Ask the material's discard hook for every fragment; needs `careful`.
        depth_views: Some views keep 32-bit depth keys only.
        behind: Draw only what lies behind given keys.
    """
    classify, store_large, draw_alone = make_emit(depth_views, behind)
    write_fragment = make_write_fragment(depth_views, behind)
    keep_fragment = make_discard()

    @wp.func
    def draw_single(view: View, target: RasterTarget, t: LargeTriangle):
        box = pixel_box(view, t)
        kind = classify(view, target, t, box)
        if kind != 0 and (kind == 1 or not store_large(target, t, box)):
            draw_alone(view, target, t, box)

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
        box = pixel_box(view, t)
        a0, b0 = t.p1[1] - t.p2[1], t.p2[0] - t.p1[0]
        a1, b1 = t.p2[1] - t.p0[1], t.p0[0] - t.p2[0]
        a2, b2 = t.p0[1] - t.p1[1], t.p1[0] - t.p0[0]
        l0, l1, l2 = (
            wp.int64(edge_threshold(a0, b0)),
            wp.int64(edge_threshold(a1, b1)),
            wp.int64(edge_threshold(a2, b2)),
        )
        area = wp.int64(b2) * wp.int64(t.p2[1] - t.p0[1]) + wp.int64(a2) * wp.int64(t.p2[0] - t.p0[0])
        inverse = 1.0 / wp.float32(area)
        for py in range(box[1], box[3] + 1):
            y = py * 256 + 128
            for px in range(box[0], box[2] + 1):
                x = px * 256 + 128
                e0 = wp.int64(a0) * wp.int64(x - t.p1[0]) + wp.int64(b0) * wp.int64(y - t.p1[1])
                e1 = wp.int64(a1) * wp.int64(x - t.p2[0]) + wp.int64(b1) * wp.int64(y - t.p2[1])
                e2 = wp.int64(a2) * wp.int64(x - t.p0[0]) + wp.int64(b2) * wp.int64(y - t.p0[1])
                if e0 >= l0 and e1 >= l1 and e2 >= l2:
                    z = accept_depth(view, fragment_depth(wp.float32(e0), wp.float32(e1), wp.float32(e2), inverse, t.z))
                    if z >= 0.0 and keep_fragment(view, pair, geometry, material, v, px, py):
                        write_fragment(view, target, pixel_index(view, px, py), z, t.id, True)

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
        c0 = clip_vertex(view, to_view(pair, position_of(geometry, v[0])))
        c1 = clip_vertex(view, to_view(pair, position_of(geometry, v[1])))
        c2 = clip_vertex(view, to_view(pair, position_of(geometry, v[2])))
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
                        draw_single(view, target, t)
                else:
                    draw_single(view, target, t)

    @wp.func
    def set_up(view: View, pair: Pair, geometry: Geometry, v: wp.vec3i, identity: wp.uint32):
        s0 = to_view(pair, position_of(geometry, v[0]))
        s1 = to_view(pair, position_of(geometry, v[1]))
        s2 = to_view(pair, position_of(geometry, v[2]))
        t = LargeTriangle()
        t.id = ALL_BITS
        if wp.isfinite(s0) and wp.isfinite(s1) and wp.isfinite(s2):
            t.p0 = snap_vertex(clip_vertex(view, s0))
            t.p1 = snap_vertex(clip_vertex(view, s1))
            t.p2 = snap_vertex(clip_vertex(view, s2))
            t.z = wp.vec3(vertex_depth(view, s0[2]), vertex_depth(view, s1[2]), vertex_depth(view, s2[2]))
            t.id = identity
            t.view = pair.view
            flags = geometry.instances[pair.instance].flags
            t = orient(pair, view, (flags & FLAG_TWO_SIDED) != 0, t)
        return t

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, launch_bounds=None if careful else PLAIN_BOUNDS)
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
            view = views[pair.view]
            base = geometry.instances[pair.instance].id_base
            if wp.static(careful):
                if lane < cluster.count:
                    corner = load_vec4i(geometry.cluster_triangles, cluster.first + lane)
                    v = wp.vec3i(corner[0], corner[1], corner[2])
                    draw_clipped(view, out_target, pair, geometry, materials, v, base + wp.uint32(corner[3]))
            else:
                if lane < cluster.count:
                    corner = load_vec4i(geometry.cluster_triangles, cluster.first + lane)
                    v = wp.vec3i(corner[0], corner[1], corner[2])
                    t = set_up(view, pair, geometry, v, base + wp.uint32(corner[3]))
                    draw_single(view, out_target, t)
            e += stride

    return raster_kernel
