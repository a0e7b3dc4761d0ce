"""Motion: how far each pixel's surface moved in the image since the frame before, from rigid or affine transforms.

A point q of a view (before the eye, world scale) was at q + D q + t before, where D and t come from both poses of its
instance and of the view, in float64, once a pair: R1 L1 inverse(L0) transpose(R0) - 1, so what does not move has D and
t of exactly 0 and what moves little loses nothing. A background pixel is a point infinitely far away: rotations alone.
Where a mesh's points are bound, what its corners moved in its own space is interpolated as everything is and goes
through the poses of the frame before; the points of that frame are kept on the device. Block size 64.
Bytes a pixel: 8 in, 8 out, and an instance's pair; for bound meshes 3 x 2 x 16 more, of which neighbours share most.
"""

from __future__ import annotations

import warp as wp

from .clusters import instance_of_rank, pair_of_instance, to_single, widen
from .interpolation import barycentric, mix3, relative_vertex
from .intrinsics import bits_float, load_vec4, load_vec4i
from .projection import linear_depth, pixel_index, pixel_of, pixel_ray, position_of
from .structs import (
    ALL_BITS,
    CLUSTER_SIZE,
    ORTHOGRAPHIC,
    Geometry,
    Pair,
    Transform,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Longest motion [px]: beyond it lies nothing that a picture of at most 16384 pixels could show.
MAX_MOTION_PX = wp.constant(wp.float32(16384.0))
#: Offset that marks an instance whose mesh has no bound points.
NOT_BOUND = wp.constant(wp.int32(-(2**31)))


@wp.struct
class Step:
    """How a view's image of an instance, or of what is infinitely far, was before: q + matrix q + offset."""

    matrix: wp.mat33
    offset: wp.vec3


@wp.struct
class Past:
    """What was seen a frame ago."""

    known: wp.array[wp.int32]  # 0: nothing
    views: wp.array[View]
    transforms: wp.array[Transform]
    points: wp.array[wp.vec4]  # of bound meshes, one after the other
    offsets: wp.array[wp.int32]  # of each instance: from a vertex to its row in `points`


@wp.func
def same_pose(a: wp.vec3d, b: wp.vec3d, m: wp.mat33, n: wp.mat33):
    """Whether two poses agree to the bit."""
    return a == b and m == n


@wp.func
def minus_one(m: wp.mat33d):
    """M - 1 in float32."""
    d = m - wp.identity(3, dtype=wp.float64)
    return wp.mat33(
        wp.float32(d[0, 0]), wp.float32(d[0, 1]), wp.float32(d[0, 2]),
        wp.float32(d[1, 0]), wp.float32(d[1, 1]), wp.float32(d[1, 2]),
        wp.float32(d[2, 0]), wp.float32(d[2, 1]), wp.float32(d[2, 2]),
    )  # fmt: skip


@wp.kernel
def prepare_steps_kernel(
    # Frame
    views: wp.array[View],
    # Scene
    geometry: Geometry,
    # In
    known: wp.array[wp.int32],
    old_views: wp.array[View],
    old_transforms: wp.array[Transform],
    # Out
    out_steps: wp.array[Step],
):
    """One thread a pair, and one a view for what is infinitely far, whose step lies behind those of the pairs."""
    v, rank = wp.tid()
    view = views[v]
    instances = view.shared_instances + view.own_count
    if rank > instances:
        return
    result = Step()
    index = out_steps.shape[0] - views.shape[0] + v
    if rank < instances:
        index = view.pair_offset + rank
    if known[0] != 0:
        before = old_views[v]
        turned = widen(before.rotation)
        back = wp.transpose(widen(view.rotation))
        still = same_pose(view.origin, before.origin, view.rotation, before.rotation)
        if rank == instances:
            if not (view.rotation == before.rotation):
                result.matrix = minus_one(turned * back)
        else:
            i = instance_of_rank(view, rank)
            now, old = geometry.transforms[i], old_transforms[i]
            linear = widen(now.linear)
            moved = not same_pose(now.origin, old.origin, now.linear, old.linear)
            if moved and wp.determinant(linear) != wp.float64(0.0):
                change = widen(old.linear) * wp.inverse(linear)
                result.matrix = minus_one(turned * change * back)
                result.offset = to_single(turned * (change * (view.origin - now.origin) + (old.origin - before.origin)))
            elif not moved and not still:
                result.matrix = minus_one(turned * back)
                result.offset = to_single(turned * (view.origin - before.origin))
    out_steps[index] = result


@wp.func
def motion_of(view: View, before: View, step: Step, px: wp.float32, py: wp.float32, depth: wp.float32, more: wp.vec3):
    """Motion of a pixel [px], y down, whose point was off by `more` besides; 0 where it cannot be told."""
    ray = pixel_ray(view, px, py)
    q = ray * depth
    if view.projection == ORTHOGRAPHIC:
        q = wp.vec3(ray[0], ray[1], -depth)
    d = step.matrix * q + step.offset + more
    p = q + d
    shift = wp.vec2(-d[0], -d[1])
    place = wp.vec2(p[0], p[1])
    if view.projection != ORTHOGRAPHIC:
        if not (p[2] < -0.001 * depth):
            # Behind the eye, or so near it that it was nowhere in the picture.
            return wp.vec2(0.0, 0.0)
        # x / -z now less x / -z before, without the difference of two large numbers.
        inverse = 1.0 / p[2]
        shift = wp.vec2(d[0] + ray[0] * d[2], d[1] + ray[1] * d[2]) * inverse
        place = place * -inverse
    motion = wp.cw_mul(view.scale, shift) + wp.cw_mul(view.scale - before.scale, place)
    motion = motion + (view.center - before.center)
    length = wp.length(motion)
    if not wp.isfinite(length):
        return wp.vec2(0.0, 0.0)
    return motion * wp.min(1.0, MAX_MOTION_PX / wp.max(length, 1.0))


@wp.kernel(grid_stride=False)
def motion_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # Scene
    geometry: Geometry,
    # In
    keys: wp.array[wp.uint64],
    known: wp.array[wp.int32],
    old_views: wp.array[View],
    steps: wp.array[Step],
    # Params
    first: wp.int32,
    # Out
    out_motion: wp.array[wp.vec2],
):
    """One thread a pixel."""
    pixel = pixel_of(blocks, wp.tid() + first)
    view = views[pixel[0]]
    x, y = pixel[1], pixel[2]
    if x >= view.width or y >= view.height:
        return
    i = pixel_index(view, x, y)
    motion = wp.vec2(0.0, 0.0)
    if known[0] != 0:
        key = keys[i]
        index = steps.shape[0] - views.shape[0] + pixel[0]
        distance = wp.float32(1.0)
        if key != wp.uint64(0):
            identity = ALL_BITS - wp.uint32(key)
            index = pair_of_instance(view, geometry.id_blocks[wp.int32(identity / wp.uint32(CLUSTER_SIZE))])
            distance = linear_depth(view, bits_float(wp.uint32(key >> wp.uint64(32))))
        if key != wp.uint64(0) or view.projection != ORTHOGRAPHIC:
            px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
            motion = motion_of(view, old_views[pixel[0]], steps[index], px, py, distance, wp.vec3())
    out_motion[i] = motion


@wp.func
def old_point(past: Past, vertex: wp.int32):
    """A bound vertex where it was."""
    p = load_vec4(past.points, vertex)
    return wp.vec3(p[0], p[1], p[2])


@wp.kernel(grid_stride=False)
def point_motion_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # Scene
    geometry: Geometry,
    # In
    pairs: wp.array[Pair],
    keys: wp.array[wp.uint64],
    past: Past,
    steps: wp.array[Step],
    # Params
    first: wp.int32,
    # Out
    out_motion: wp.array[wp.vec2],
):
    """One thread a pixel: motion anew where the points of its mesh moved."""
    pixel = pixel_of(blocks, wp.tid() + first)
    view = views[pixel[0]]
    x, y = pixel[1], pixel[2]
    if x >= view.width or y >= view.height or past.known[0] == 0:
        return
    i = pixel_index(view, x, y)
    key = keys[i]
    if key == wp.uint64(0):
        return
    identity = ALL_BITS - wp.uint32(key)
    slot = geometry.id_blocks[wp.int32(identity / wp.uint32(CLUSTER_SIZE))]
    offset = past.offsets[slot]
    if offset == NOT_BOUND:
        return
    instance = geometry.instances[slot]
    v = load_vec4i(geometry.triangles, instance.triangle_first + wp.int32(identity - instance.id_base))
    index = pair_of_instance(view, slot)
    pair = pairs[index]
    px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
    a, b, c = position_of(geometry, v[0]), position_of(geometry, v[1]), position_of(geometry, v[2])
    w = barycentric(
        relative_vertex(view, pair, a, px, py),
        relative_vertex(view, pair, b, px, py),
        relative_vertex(view, pair, c, px, py),
    ).weight
    moved = mix3(
        w,
        old_point(past, v[0] + offset) - a,
        old_point(past, v[1] + offset) - b,
        old_point(past, v[2] + offset) - c,
    )
    if wp.isfinite(moved) and wp.length_sq(moved) > 0.0:
        before = past.views[pixel[0]]
        more = before.rotation * (past.transforms[slot].linear * moved)
        distance = linear_depth(view, bits_float(wp.uint32(key >> wp.uint64(32))))
        out_motion[i] = motion_of(view, before, steps[index], px, py, distance, more)


@wp.kernel
def keep_points_kernel(
    # Scene
    geometry: Geometry,
    # In
    vertices: wp.array[wp.int32],
    # Out
    out_points: wp.array[wp.vec4],
):
    """One thread a bound vertex: keep where it is for the next frame."""
    i = wp.tid()
    out_points[i] = load_vec4(geometry.positions, vertices[i])


@wp.kernel
def remember_kernel(
    # In
    views: wp.array[View],
    transforms: wp.array[Transform],
    # Out
    out_views: wp.array[View],
    out_transforms: wp.array[Transform],
    out_known: wp.array[wp.int32],
):
    """One thread a view or instance: keep the frame's poses for the next."""
    i = wp.tid()
    if i < views.shape[0]:
        out_views[i] = views[i]
    if i < transforms.shape[0]:
        out_transforms[i] = transforms[i]
    if i == 0:
        out_known[0] = 1
