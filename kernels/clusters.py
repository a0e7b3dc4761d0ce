"""Instances and clusters per view: stage transforms, prepare (view, instance) pairs, cull clusters into a work list.

First stage of the frame. Culling may only ever add work: spheres are inflated by the rounding bound, and a cluster
whose sphere comes near the near plane or the guard band goes to the careful list. The cone test (Zeux, meshoptimizer
"computeClusterBounds") drops clusters that face away as a whole; it is decided on exact normals, so a sub-pixel
triangle whose snapped copy would have flipped to the front is not drawn either.
The order of the work list depends on the run; the image does not.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import load_vec4
from .structs import (
    CULL_BACK,
    CULL_NONE,
    FLAG_MASKED,
    FLAG_TWO_SIDED,
    GUARD_BAND_PX,
    ORTHOGRAPHIC,
    Cluster,
    Geometry,
    Instance,
    Pair,
    Transform,
    View,
    WorkList,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 128
#: Rows of a depth-only view's bounds: planes (normal, distance), then an upright box (x, y, half side, nearest depth).
BOUND_PLANES = wp.constant(18)
BOUND_ROWS = wp.constant(19)


@wp.func
def to_double(v: wp.vec3):
    """Widen a vector."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def to_single(v: wp.vec3d):
    """Round a vector to float32."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def widen(m: wp.mat33):
    """Widen a matrix."""
    return wp.mat33d(
        wp.float64(m[0, 0]), wp.float64(m[0, 1]), wp.float64(m[0, 2]),
        wp.float64(m[1, 0]), wp.float64(m[1, 1]), wp.float64(m[1, 2]),
        wp.float64(m[2, 0]), wp.float64(m[2, 1]), wp.float64(m[2, 2]),
    )  # fmt: skip


@wp.kernel
def stage_matrices_kernel(
    # Scene
    instances: wp.array[Instance],
    # In
    matrices: wp.array3d[wp.float32],
    # Out
    out_transforms: wp.array[Transform],
):
    """Turn bound (instances, 4, 4) matrices into staged transforms."""
    i = wp.tid()
    instance = instances[i]
    k = instance.public_id
    linear = wp.mat33(
        matrices[k, 0, 0], matrices[k, 0, 1], matrices[k, 0, 2],
        matrices[k, 1, 0], matrices[k, 1, 1], matrices[k, 1, 2],
        matrices[k, 2, 0], matrices[k, 2, 1], matrices[k, 2, 2],
    )  # fmt: skip
    result = Transform()
    result.linear = linear
    translation = to_double(wp.vec3(matrices[k, 0, 3], matrices[k, 1, 3], matrices[k, 2, 3]))
    result.origin = widen(linear) * instance.mesh_origin + translation
    out_transforms[i] = result


@wp.kernel
def stage_poses_kernel(
    # Scene
    instances: wp.array[Instance],
    # In
    poses: wp.array2d[wp.float32],
    # Out
    out_transforms: wp.array[Transform],
):
    """Turn bound (instances, 7) poses, position then quaternion x y z w, into staged transforms."""
    i = wp.tid()
    instance = instances[i]
    k = instance.public_id
    rotation = wp.quat_to_matrix(wp.normalize(wp.quat(poses[k, 3], poses[k, 4], poses[k, 5], poses[k, 6])))
    result = Transform()
    result.linear = rotation
    result.origin = widen(rotation) * instance.mesh_origin + to_double(wp.vec3(poses[k, 0], poses[k, 1], poses[k, 2]))
    out_transforms[i] = result


@wp.kernel
def stage_cameras_kernel(
    # In
    matrices: wp.array3d[wp.float32],
    # Out
    out_views: wp.array[View],
):
    """Overwrite the poses of the first views by bound (views, 4, 4) camera-to-world matrices (rigid, -Z forward)."""
    i = wp.tid()
    view = out_views[i]
    view.origin = to_double(wp.vec3(matrices[i, 0, 3], matrices[i, 1, 3], matrices[i, 2, 3]))
    view.rotation = wp.mat33(
        matrices[i, 0, 0], matrices[i, 1, 0], matrices[i, 2, 0],
        matrices[i, 0, 1], matrices[i, 1, 1], matrices[i, 2, 1],
        matrices[i, 0, 2], matrices[i, 1, 2], matrices[i, 2, 2],
    )  # fmt: skip
    out_views[i] = view


@wp.func
def choose_anchor(instance: Instance, eye: wp.vec3d):
    """Point of the mesh's box nearest to the eye, on a grid of powers of two.

    Near it, p - anchor is exact (Sterbenz); being on the grid, it moves with a translated mesh bit for bit.
    """
    grid = wp.float64(instance.anchor_grid)
    anchor = wp.vec3d()
    for k in range(3):
        low, high = wp.float64(instance.bounds_low[k]), wp.float64(instance.bounds_high[k])
        value = eye[k]
        if not (value > low):
            value = low
        if value > high:
            value = high
        anchor[k] = wp.floor(value / grid + wp.float64(0.5)) * grid
    return anchor


@wp.func
def instance_of_rank(view: View, rank: wp.int32):
    """Instance a view's rank-th pair stands for: shared ones, then those of its own world."""
    if rank < view.shared_instances:
        return rank
    return view.own_first + rank - view.shared_instances


@wp.func
def pair_of_instance(view: View, instance: wp.int32):
    """Inverse of `instance_of_rank`, as an index into the pairs."""
    if instance < view.shared_instances:
        return view.pair_offset + instance
    return view.pair_offset + view.shared_instances + instance - view.own_first


@wp.kernel
def prepare_pairs_kernel(
    # Frame
    views: wp.array[View],
    # Scene
    geometry: Geometry,
    # Params
    first: wp.int32,
    # Out
    out_pairs: wp.array[Pair],
    out_work: WorkList,
):
    """Combine each view with each instance it may see, cameras subtracted in float64; empty the work list."""
    row, rank = wp.tid()
    if row == 0 and rank < 2:
        out_work.counts[rank] = 0
    v = row + first
    view = views[v]
    if view.skipped != 0 or rank >= view.shared_instances + view.own_count:
        return
    i = instance_of_rank(view, rank)
    instance = geometry.instances[i]
    transform = geometry.transforms[i]
    linear = transform.linear
    result = Pair()
    result.view = v
    result.instance = i

    # The determinant in float64: a tiny scale must not underflow to "singular".
    wide = widen(linear)
    determinant = wp.determinant(wide)
    to_eye = view.origin - transform.origin
    rotation = widen(view.rotation)
    if view.projection == ORTHOGRAPHIC:
        to_eye_direction = wp.vec3d(rotation[2, 0], rotation[2, 1], rotation[2, 2])
    else:
        to_eye_direction = to_eye
    eye = wp.vec3d()
    direction = wp.vec3d()
    if determinant != wp.float64(0.0):
        inverse = wp.inverse(wide)
        eye = inverse * to_eye
        direction = inverse * to_eye_direction
    anchor = choose_anchor(instance, eye)
    scale = wp.vec3d(wp.float64(view.scale[0]), wp.float64(view.scale[1]), wp.float64(-1.0))
    scaled = wp.diag(scale) * (rotation * wide)
    offset = wp.diag(scale) * (rotation * (wide * anchor - to_eye))
    matrix = wp.mat33()
    stretch = wp.float32(0.0)
    gram = wp.transpose(linear) * linear
    for a in range(3):
        # The largest singular value is at most the root of the largest row sum of the Gram matrix (Gershgorin).
        stretch = wp.max(stretch, wp.abs(gram[a, 0]) + wp.abs(gram[a, 1]) + wp.abs(gram[a, 2]))
        for b in range(3):
            matrix[a, b] = wp.float32(scaled[a, b])
    result.matrix = matrix
    result.offset = to_single(offset)
    result.anchor = to_single(anchor)
    result.camera = to_single(direction)
    result.radius_scale = wp.sqrt(stretch)
    result.flip = wp.where(determinant < wp.float64(0.0), 1, 0)
    finite = (
        wp.isfinite(gram[0, 0] + gram[1, 1] + gram[2, 2])
        and wp.isfinite(wp.length_sq(result.offset))
        and wp.isfinite(determinant)
    )
    result.drawn = wp.where(finite, 1, 0)
    out_pairs[view.pair_offset + rank] = result


@wp.func
def faces_away(pair: Pair, view: View, cluster: Cluster, two_sided: bool):
    """Whether every triangle of a cluster is culled by its facing, whatever the point of view inside its sphere."""
    if two_sided or view.cull_mode == CULL_NONE or cluster.cutoff > 1.0:
        return False
    axis = cluster.axis
    if view.cull_mode != CULL_BACK:
        axis = -axis
    if view.projection == ORTHOGRAPHIC:
        length = wp.length(pair.camera)
        return wp.dot(-pair.camera, axis) >= cluster.cutoff * length + 1.0e-4 * length
    away = cluster.center - pair.camera
    distance = wp.length(away)
    return wp.dot(away, axis) >= cluster.cutoff * distance + cluster.radius + 1.0e-4 * distance


@wp.func
def outside_plane(value: wp.float32, radius: wp.float32, nx: wp.float32, nw: wp.float32):
    """Whether a sphere lies wholly on the negative side of nx x + nw w >= 0, value being that form at its centre."""
    return value < -radius * wp.sqrt(nx * nx + nw * nw)


@wp.func
def classify_sphere(view: View, center: wp.vec3, radius: wp.float32):
    """0: not in view; 1: in view, wholly in front of the near plane and inside the guard band; 2: in view, careful."""
    if not (wp.isfinite(center[0] + center[1] + center[2]) and wp.isfinite(radius)):
        return 2
    fx, fy = wp.abs(view.scale[0]), wp.abs(view.scale[1])
    cx, cy = view.center[0], view.center[1]
    width, height = wp.float32(view.width), wp.float32(view.height)
    if view.projection == ORTHOGRAPHIC:
        x, y = center[0] + cx, center[1] + cy
        rx, ry = radius * fx, radius * fy
        if x < -rx or x > width + rx or y < -ry or y > height + ry:
            return 0
        if view.depth_clamp == 0 and (center[2] < view.near - radius or center[2] > view.far + radius):
            return 0
        guard = GUARD_BAND_PX - 2.0
        if wp.abs(x) + rx > guard or wp.abs(y) + ry > guard:
            return 2
        return 1
    x, y, w = center[0], center[1], center[2]
    if w < view.near - radius or (view.depth_clamp != 0 and w > view.far + radius):
        return 0
    if outside_plane(x + cx * w, radius, fx, cx) or outside_plane((width - cx) * w - x, radius, fx, width - cx):
        return 0
    if outside_plane(y + cy * w, radius, fy, cy) or outside_plane((height - cy) * w - y, radius, fy, height - cy):
        return 0
    if w - radius < view.near * 1.0001:
        return 2
    guard = GUARD_BAND_PX - 2.0
    reach_x = wp.abs(x + cx * w) + radius * (fx + wp.abs(cx) + guard)
    reach_y = wp.abs(y + cy * w) + radius * (fy + wp.abs(cy) + guard)
    if wp.max(reach_x, reach_y) > guard * w:
        return 2
    return 1


@wp.func
def bounded_away(bounds: wp.array[wp.vec4], first: wp.int32, center: wp.vec3, radius: wp.float32):
    """Whether a sphere, in the axes right, up, depth of a view, lies behind one of its planes or inside its box."""
    for k in range(BOUND_PLANES):
        p = load_vec4(bounds, first + k)
        if p[0] * center[0] + p[1] * center[1] + p[2] * center[2] + p[3] < -radius:
            return True
    box = load_vec4(bounds, first + BOUND_PLANES)
    aside = wp.max(wp.abs(center[0] - box[0]), wp.abs(center[1] - box[1]))
    return aside + radius < box[2] and center[2] - radius > box[3]


@wp.kernel
def cull_clusters_kernel(
    # Frame
    views: wp.array[View],
    # Scene
    geometry: Geometry,
    # In
    pairs: wp.array[Pair],
    bounds: wp.array[wp.vec4],
    # Params
    first_bounded: wp.int32,
    # Out
    out_work: WorkList,
):
    """Keep the clusters each view may see; append them to the plain or the careful end of the work list.

    Views from `first_bounded` on have BOUND_ROWS rows of `bounds` each, where that has any.
    """
    v, j = wp.tid()
    view = views[v]
    if view.skipped != 0 or j >= view.shared_clusters + view.own_cluster_count:
        return
    s = j
    if j >= view.shared_clusters:
        s = view.own_cluster_first + j - view.shared_clusters
    slot = geometry.slots[s]
    p = pair_of_instance(view, slot[0])
    pair = pairs[p]
    if pair.drawn == 0:
        return
    cluster = geometry.clusters[slot[1]]
    flags = geometry.instances[slot[0]].flags
    center = pair.matrix * (cluster.center - pair.anchor) + pair.offset
    # 1e-4 of the radius and 4e-6 of the distance cover the rounding of centre, matrix and vertices.
    spread = wp.length(cluster.center - pair.anchor) * pair.radius_scale
    x, y = center[0] / view.scale[0], center[1] / view.scale[1]
    distance = wp.abs(center[2]) + wp.abs(x) + wp.abs(y)
    radius = cluster.radius * pair.radius_scale * 1.0001 + 4.0e-6 * (spread + distance)
    kind = classify_sphere(view, center, radius)
    if kind == 0 or faces_away(pair, view, cluster, (flags & FLAG_TWO_SIDED) != 0):
        return
    if v >= first_bounded and bounds.shape[0] > 1:
        if bounded_away(bounds, (v - first_bounded) * BOUND_ROWS, wp.vec3(x, y, center[2]), radius):
            return
    entry = wp.vec2i(p, slot[1])
    if kind == 2 or (flags & FLAG_MASKED) != 0:
        place = wp.atomic_add(out_work.counts, 1, 1)
        out_work.entries[out_work.entries.shape[0] - 1 - place] = entry
    else:
        place = wp.atomic_add(out_work.counts, 0, 1)
        out_work.entries[place] = entry
