"""Clipping against the near plane and the guard band, before snapping.

A new vertex is computed from its edge's two ends in the order of their coordinates, not of their ids: neighbours agree
to the bit even where a file repeats shared vertices. Functions only, no kernel.
"""

from __future__ import annotations

import warp as wp

from .coverage import snap
from .projection import to_homogeneous
from .structs import GUARD_BAND_PX, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Up to eight vertices (x_px w, y_px w, w, view distance); row 8 holds the count.
ClipPolygon = wp.types.matrix(shape=(9, 4), dtype=wp.float32)


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
