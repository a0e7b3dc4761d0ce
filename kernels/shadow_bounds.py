"""Shadow bounds: what of a map shades anything that is looked at. Before clusters are culled.

A caster shades what a camera sees only if it meets the convex hull of the camera's frustum and the light. That hull is
bounded by the faces of the frustum that the light is behind, and by planes through the light and those edges of the
frustum that have all of it on one side: at most 18 candidates, a thread each. The frustum ends where the map's light
does. Every plane is moved outwards by what a filter reads beside a point, and by a share of the coordinates for
rounding, so culling may only ever keep too much.

A cascade has one bound more: a point in the middle of the next finer map, where that does not blend, is never looked up
in this one (shadow_lookup.py), so a caster whose shadow stays in there is not drawn. Both maps look the same way, so
that part is an upright box of this map; it counts only where the finer map reaches behind everything there is.

Bounds are rows of (normal, distance) in the axes right, up, depth of the map's view, relative to its eye; see
`clusters.bounded_away`. Block size 64.
"""

from __future__ import annotations

import warp as wp

from .clusters import BOUND_PLANES, BOUND_ROWS, to_single, widen
from .shadow import deepest, extent_of
from .structs import ORTHOGRAPHIC, SLOT_CASCADE, LightSource, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Share of the coordinates that rounding may take, and the part of it that may make a plane miss a corner.
SLACK = wp.constant(wp.float32(1.0e-5))
TOUCH = wp.constant(wp.float32(1.0e-6))
#: Pixels beyond the picture that samples may look at.
JITTER_PX = wp.constant(wp.float32(1.0))


@wp.struct
class BoundParams:
    """Settings of a plan, as the kernel reads them."""

    first_view: wp.int32  # view of the first slot
    border: wp.float32  # texels a filter reads beside a point
    inner: wp.float32  # share of a cascade, without its border, that is looked up in no coarser one
    distance: wp.float32  # depth up to which directional lights cast [m], inf: as far as the scene reaches
    one_eye: wp.int32  # 1: pictures are taken from where their cameras were uploaded, give or take a pixel
    keep: wp.int32  # 1: maps are kept while their bounds are the same, and those of points and spots hold all casters


@wp.struct
class Frustum:
    """A camera's frustum in the axes right, up, depth of a map: corner = eye + turn * (x d, y d, d)."""

    turn: wp.mat33
    eye: wp.vec3
    low: wp.vec4  # left, bottom, near; w: 1 where rays part from the eye, 0 where they are parallel
    high: wp.vec3  # right, top, far
    size: wp.float32  # largest coordinate of a corner


@wp.func
def corner_of(f: Frustum, k: wp.int32):
    """Corner k: bits 0, 1 and 2 tell right from left, top from bottom, far from near."""
    x, y = wp.where((k & 1) != 0, f.high[0], f.low[0]), wp.where((k & 2) != 0, f.high[1], f.low[1])
    d = wp.where((k & 4) != 0, f.high[2], f.low[2])
    spread = wp.where(f.low[3] != 0.0, d, wp.float32(1.0))
    return f.eye + f.turn * wp.vec3(x * spread, y * spread, d)


@wp.func
def frustum_of(camera: View, view: View, near: wp.float32, far: wp.float32):
    """Frustum of a camera between two depths as a map's view sees it."""
    f = Frustum()
    fx, fy = camera.scale[0], -camera.scale[1]
    left, right = -camera.center[0] - JITTER_PX, wp.float32(camera.width) - camera.center[0] + JITTER_PX
    bottom, top = camera.center[1] - wp.float32(camera.height) - JITTER_PX, camera.center[1] + JITTER_PX
    f.low = wp.vec4(left / fx, bottom / fy, near, wp.where(camera.projection == ORTHOGRAPHIC, 0.0, 1.0))
    f.high = wp.vec3(right / fx, top / fy, far)
    # Axes right, up, depth have a third one that is the negative of "backward", on both sides.
    flip = wp.diag(wp.vec3(1.0, 1.0, -1.0))
    f.turn = flip * (view.rotation * wp.transpose(camera.rotation)) * flip
    f.eye = flip * to_single(widen(view.rotation) * (camera.origin - view.origin))
    for k in range(8):
        c = corner_of(f, k)
        f.size = wp.max(f.size, wp.max(wp.abs(c[0]), wp.max(wp.abs(c[1]), wp.abs(c[2]))))
    return f


@wp.func
def unit_plane(normal: wp.vec3, point: wp.vec3):
    """Plane through a point; 0 where the normal vanishes."""
    length = wp.length(normal)
    if not (length > 0.0):
        return wp.vec4()
    n = normal * (1.0 / length)
    return wp.vec4(n[0], n[1], n[2], -wp.dot(n, point))


@wp.func
def height_over(plane: wp.vec4, point: wp.vec3):
    """Signed distance of a point."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]


@wp.func
def facing(f: Frustum, plane: wp.vec4):
    """The plane turned so that the whole frustum is on its positive side; 0 where the plane cuts it."""
    low, high = wp.float32(0.0), wp.float32(0.0)
    for k in range(8):
        h = height_over(plane, corner_of(f, k))
        low = wp.min(low, h)
        high = wp.max(high, h)
    if low >= -TOUCH * f.size:
        return plane
    if high <= TOUCH * f.size:
        return -plane
    return wp.vec4()


@wp.func
def face_plane(f: Frustum, k: wp.int32):
    """Face k: left, right, bottom, top, near, far; the frustum is on its positive side."""
    axis, side = k >> 1, k & 1
    corner = corner_of(f, side << axis)
    normal = f.turn * wp.vec3(0.0, 0.0, 1.0)
    if axis != 2:
        # By the edges of the far end: the near one may be next to a point.
        corner = corner_of(f, 4 + (side << axis))
        along = corner_of(f, 4 + (side << axis) + (2 >> axis)) - corner
        normal = wp.cross(along, corner_of(f, side << axis) - corner)
    return facing(f, unit_plane(normal, corner))


@wp.func
def edge_plane(f: Frustum, k: wp.int32, parallel: bool):
    """Plane through edge k of 12 and the light, which is above all depths (parallel) or in the origin."""
    axis = k >> 2
    a, b = 1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3)
    start = wp.where((k & 1) != 0, a, 0) + wp.where((k & 2) != 0, b, 0)
    p, q = corner_of(f, start), corner_of(f, start + (1 << axis))
    if parallel:
        return facing(f, unit_plane(wp.cross(q - p, wp.vec3(0.0, 0.0, -1.0)), p))
    return facing(f, unit_plane(wp.cross(p, q), p))


@wp.func
def light_plane(f: Frustum, k: wp.int32, parallel: bool, reach: wp.float32):
    """Candidate k of the hull's planes; 0 where it is none, normal 0 and distance -inf where no light is seen."""
    if k >= 6:
        return edge_plane(f, k - 6, parallel)
    plane = face_plane(f, k)
    if parallel:
        # The light is where depth falls.
        return wp.where(plane[2] <= 0.0, plane, wp.vec4())
    if plane[3] < -reach:
        return wp.vec4(0.0, 0.0, 0.0, -wp.inf)
    return wp.where(plane[3] >= 0.0, plane, wp.vec4())


@wp.func
def inner_box(view: View, finer: View, drawn: bool, behind: wp.float32, params: BoundParams):
    """Middle (x, y), half side and nearest depth of the part of a map that nothing looks up; half side -1: none."""
    to_finer = widen(view.rotation) * (finer.origin - view.origin)
    x, y, depth = wp.float32(to_finer[0]), wp.float32(to_finer[1]), wp.float32(-to_finer[2])
    limit = (0.5 * wp.float32(finer.width) - params.border) * params.inner - 1.0
    half = limit / finer.scale[0] - (params.border + 1.0) / view.scale[0]
    # Points behind the finer map are looked up here.
    if not drawn or not (depth + finer.far > behind):
        half = wp.float32(-1.0)
    return wp.vec4(x, y, half, depth + finer.near)


@wp.func
def same_row(a: wp.vec4, b: wp.vec4):
    """Whether two rows are the same number for number."""
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2] and a[3] == b[3]


@wp.kernel
def bound_casters_kernel(
    # Frame
    cameras: wp.array[View],
    views: wp.array[View],
    # In
    source: LightSource,
    slots: wp.array[wp.vec4i],
    bounds: wp.array[wp.float32],
    # Params
    params: BoundParams,
    # Out
    out_rows: wp.array[wp.vec4],
    out_states: wp.array[wp.int32],
):
    """One thread a map and row: planes first, then the box."""
    s, k = wp.tid()
    slot = slots[s]
    view = views[params.first_view + s]
    row = wp.where(k < BOUND_PLANES, wp.vec4(), wp.vec4(0.0, 0.0, -1.0, 0.0))
    if out_states[s] >= 0:
        if slot[1] == SLOT_CASCADE:
            if k < BOUND_PLANES and params.one_eye != 0:
                camera = cameras[slot[3]]
                extent = extent_of(camera, bounds, params.distance)
                f = frustum_of(camera, view, extent[0], extent[1])
                row = light_plane(f, k, True, 0.0)
                row[3] += (params.border + 1.0) / view.scale[0] + SLACK * f.size
            elif k == BOUND_PLANES and slot[2] > 0:
                finer = views[params.first_view + s - 1]
                row = inner_box(view, finer, out_states[s - 1] >= 0, deepest(view, bounds, 1.0), params)
        elif params.keep == 0 and params.one_eye != 0 and slot[3] >= 0 and k < BOUND_PLANES:
            camera = cameras[slot[3]]
            reach = source.range[slot[0]]
            rotation = widen(camera.rotation)
            to_light = rotation * (view.origin - camera.origin)
            far = wp.float32(-to_light[2]) + reach
            near = wp.where(camera.projection == ORTHOGRAPHIC, wp.min(camera.near, far), camera.near)
            if not wp.isfinite(far):
                row = wp.vec4()
            elif far <= near:
                row = wp.vec4(0.0, 0.0, 0.0, -wp.inf)
            else:
                f = frustum_of(camera, view, near, far)
                row = light_plane(f, k, False, reach + SLACK * f.size)
                row[3] += reach * (params.border + 1.0) / view.scale[0] + SLACK * f.size
    place = s * BOUND_ROWS + k
    if params.keep != 0 and out_states[s] == 0 and not same_row(out_rows[place], row):
        # All threads that write it write the same.
        out_states[s] = 1
    out_rows[place] = row
