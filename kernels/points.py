"""Points of deforming meshes: positions staged from bound arrays, and what hangs on them made anew on the device.

First stage of a frame, for meshes with bound points alone. Positions are copied, vertex normals averaged, clusters get
their spheres and cones, instances their boxes. Which triangles form a cluster stays as it was cut at load: a mesh that
folds far out of its load shape is culled more loosely, never wrongly. Nothing is read back.

Every number is gathered by one thread or one block in a fixed order, or is a minimum or maximum, so runs agree to the
bit. Sums and face normals are float64, as on the host at load: which faces have no area is decided on the same bits.
A face with a vertex that is not finite, or without area, is collapsed to a point in the cluster's table, so that no
later stage can draw it, and is left out of normals, spheres, cones and boxes.
Normals are weighted by corner angle (Thürmer and Wüthrich 1998). Block size 128, a lane a triangle of a cluster.
"""

from __future__ import annotations

import warp as wp

from .clusters import to_double, to_single
from .intrinsics import bits_float, load_vec4i
from .projection import position_of
from .structs import Cluster, Geometry, Instance

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 128
#: Cosine of the widest spread of normals that still gets a cone, and what the cone's sine is widened by; as at load.
CONE_SPREAD = wp.constant(wp.float64(0.1))
CONE_MARGIN = wp.constant(wp.float64(1.0e-4))
#: Spheres grow by this share, so that rounding to float32 loses no vertex.
SPHERE_MARGIN = wp.constant(wp.float64(1.0e-6))
#: A sum of angle-weighted unit normals shorter than this has no direction.
NO_DIRECTION = wp.constant(wp.float64(1.0e-12))
#: Anchors lie on a grid of 2^-6 of the box's power of two; see `choose_anchor`.
ANCHOR_BITS = wp.constant(6)


@wp.struct
class BoundMesh:
    """A mesh with bound points: where its things lie in the tables."""

    origin: wp.vec3d  # taken out of the positions at load
    cluster_first: wp.int32  # in the list of bound clusters
    cluster_count: wp.int32
    instance_first: wp.int32  # in the list of places
    instance_count: wp.int32


@wp.func
def cross_of(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
    """Cross product of a face's edges in float64; 0 for a face with a corner that is not finite.

    No difference or product of float32 numbers, nor its square, under- or overflows there.
    """
    if not (wp.isfinite(p0) and wp.isfinite(p1) and wp.isfinite(p2)):
        return wp.vec3d()
    corner = to_double(p0)
    return wp.cross(to_double(p1) - corner, to_double(p2) - corner)


@wp.func
def face_normal(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
    """Unit normal of a face; 0 for one that cannot be drawn: without area, or with a corner that is not finite."""
    normal = cross_of(p0, p1, p2)
    length = wp.length(normal)
    if length > wp.float64(0.0):
        normal *= wp.float64(1.0) / length
    return normal


@wp.func
def is_drawn(normal: wp.vec3d):
    """Whether `face_normal` found one."""
    return wp.length_sq(normal) > wp.float64(0.0)


@wp.func
def anchor_grid(extent: wp.float64):
    """Spacing of anchors of a box whose longest side is `extent` >= 0: a power of two, normal in float32.

    Taken from the exponent's bits, since a rounded logarithm may fall on the wrong side of a power of two.
    """
    exponent = wp.int32(wp.cast(extent, wp.int64) >> wp.int64(52)) - 1023 - ANCHOR_BITS
    if extent == wp.float64(0.0):
        exponent = 0
    return bits_float(wp.uint32(wp.max(exponent, -126) + 127) << wp.uint32(23))


@wp.kernel
def stage_points_kernel(
    # In
    points: wp.array2d[wp.float32],
    targets: wp.array[wp.vec2i],
    meshes: wp.array[BoundMesh],
    # Out
    out_positions: wp.array[wp.vec4],
):
    """Copy bound (n, 3) points to their vertices, relative to their mesh's origin. 12 + 8 bytes in, 16 out a point.

    `targets` holds (vertex, mesh) a point. What is not finite is copied as it is.
    """
    i = wp.tid()
    target = targets[i]
    point = to_double(wp.vec3(points[i, 0], points[i, 1], points[i, 2]))
    p = to_single(point - meshes[target[1]].origin)
    out_positions[target[0]] = wp.vec4(p[0], p[1], p[2], 0.0)


@wp.kernel
def average_normals_kernel(
    # Scene
    geometry: Geometry,
    # In
    groups: wp.array[wp.vec4i],
    corners: wp.array[wp.vec4i],
    members: wp.array[wp.int32],
    # Params
    first: wp.int32,
    # Out
    out_normals: wp.array[wp.vec4],
):
    """Average the face normals around each group of vertices that share a place, weighted by corner angle.

    A gather: no two threads write one normal, and the order of the sum is the order of the mesh's triangles. A group
    is (first corner, corners, first member, members), a corner its vertex and the two that follow in the face.
    A corner moves 16 bytes and three positions, mostly from the cache, and costs one
    root, one division and one arc tangent in float64.
    """
    group = load_vec4i(groups, wp.tid() + first)
    total = wp.vec3d()
    for i in range(group[0], group[0] + group[1]):
        corner = load_vec4i(corners, i)
        p0, p1, p2 = (
            position_of(geometry, corner[0]),
            position_of(geometry, corner[1]),
            position_of(geometry, corner[2]),
        )
        normal = cross_of(p0, p1, p2)
        length = wp.length(normal)
        if length > wp.float64(0.0):
            # In float64: where a surface folds, normals cancel, and the error of an angle is what is left.
            along = wp.dot(to_double(p1) - to_double(p0), to_double(p2) - to_double(p0))
            total += normal * (wp.atan2(length, along) / length)
    sum_length = wp.length(total)
    unit = wp.vec3()
    if sum_length > NO_DIRECTION:
        unit = to_single(total / sum_length)
    for i in range(group[2], group[2] + group[3]):
        out_normals[members[i]] = wp.vec4(unit[0], unit[1], unit[2], 0.0)


@wp.func
def drawn_row(vertices: wp.vec4i, row: wp.vec4i, drawn: bool):
    """Row of the cluster's table: the triangle's vertices and id, or three times one vertex, which covers nothing."""
    if drawn:
        return wp.vec4i(vertices[0], vertices[1], vertices[2], row[3])
    return wp.vec4i(vertices[0], vertices[0], vertices[0], row[3])


@wp.func
def farthest(center: wp.vec3d, p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
    """Square of the largest distance of a triangle's corners from a point."""
    d0 = wp.length_sq(to_double(p0) - center)
    d1 = wp.length_sq(to_double(p1) - center)
    return wp.max(wp.max(d0, d1), wp.length_sq(to_double(p2) - center))


@wp.kernel
def bound_clusters_kernel(
    # Scene
    geometry: Geometry,
    # In
    bound: wp.array[wp.vec2i],
    # Out
    out_triangles: wp.array[wp.vec4i],
    out_clusters: wp.array[Cluster],
    out_boxes: wp.array[wp.vec3],
):
    """Give each bound cluster its sphere, cone and box, and collapse the faces that cannot be drawn.

    One block a cluster. `bound` holds (cluster, first triangle of its mesh); a box is two rows, low and high, infinite
    the wrong way round where nothing can be drawn. A triangle moves 32 bytes and three positions, cached the second
    time; its row is written only where it changes.
    """
    b, lane = wp.tid()
    entry = bound[b]
    cluster = out_clusters[entry[0]]
    start, end = cluster.first + lane, cluster.first + cluster.count
    low, high = wp.vec3(wp.inf, wp.inf, wp.inf), wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    axis = wp.vec3d()
    for r in range(start, end, wp.block_dim()):
        row = load_vec4i(out_triangles, r)
        v = load_vec4i(geometry.triangles, entry[1] + row[3])
        p0, p1, p2 = position_of(geometry, v[0]), position_of(geometry, v[1]), position_of(geometry, v[2])
        normal = face_normal(p0, p1, p2)
        drawn = is_drawn(normal)
        if drawn:
            low = wp.min(low, wp.min(p0, wp.min(p1, p2)))
            high = wp.max(high, wp.max(p0, wp.max(p1, p2)))
            axis += normal
        wanted = drawn_row(v, row, drawn)
        if wanted[1] != row[1] or wanted[2] != row[2]:
            out_triangles[r] = wanted
    low = wp.tile_extract(wp.tile_reduce(wp.min, wp.tile(low, preserve_type=True)), 0)
    high = wp.tile_extract(wp.tile_reduce(wp.max, wp.tile(high, preserve_type=True)), 0)
    axis = wp.tile_extract(wp.tile_reduce(wp.add, wp.tile(axis, preserve_type=True)), 0)
    if wp.length_sq(axis) > wp.float64(0.0):
        axis = wp.normalize(axis)
    else:
        axis = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    center = wp.vec3()
    if low[0] <= high[0]:
        center = to_single((to_double(low) + to_double(high)) * wp.float64(0.5))
    reach, spread = wp.float64(0.0), wp.float64(1.0)
    for r in range(start, end, wp.block_dim()):
        v = load_vec4i(geometry.triangles, entry[1] + out_triangles[r][3])
        p0, p1, p2 = position_of(geometry, v[0]), position_of(geometry, v[1]), position_of(geometry, v[2])
        normal = face_normal(p0, p1, p2)
        if is_drawn(normal):
            reach = wp.max(reach, farthest(to_double(center), p0, p1, p2))
            spread = wp.min(spread, wp.dot(normal, axis))
    reach = wp.tile_extract(wp.tile_max(wp.tile(reach)), 0)
    spread = wp.tile_extract(wp.tile_min(wp.tile(spread)), 0)
    if lane == 0:
        cluster.center = center
        # A sphere past float32 is infinite: its cluster is never culled and always clipped with care.
        cluster.radius = wp.float32(wp.sqrt(reach) * (wp.float64(1.0) + SPHERE_MARGIN))
        cluster.axis = to_single(axis)
        cluster.cutoff = wp.float32(2.0)
        if spread > CONE_SPREAD:
            sine = wp.sqrt(wp.max(wp.float64(1.0) - spread * spread, wp.float64(0.0)))
            cluster.cutoff = wp.float32(sine + CONE_MARGIN)
        out_clusters[entry[0]] = cluster
        out_boxes[2 * b] = low
        out_boxes[2 * b + 1] = high


@wp.kernel
def bound_meshes_kernel(
    # In
    meshes: wp.array[BoundMesh],
    boxes: wp.array[wp.vec3],
    places: wp.array[wp.int32],
    # Out
    out_instances: wp.array[Instance],
):
    """Join the boxes of each bound mesh's clusters and hand them to its instances. One block a mesh.

    24 bytes a cluster in, 44 bytes an instance out.
    """
    b, lane = wp.tid()
    mesh = meshes[b]
    low, high = wp.vec3(wp.inf, wp.inf, wp.inf), wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for i in range(mesh.cluster_first + lane, mesh.cluster_first + mesh.cluster_count, wp.block_dim()):
        low = wp.min(low, boxes[2 * i])
        high = wp.max(high, boxes[2 * i + 1])
    low = wp.tile_extract(wp.tile_reduce(wp.min, wp.tile(low, preserve_type=True)), 0)
    high = wp.tile_extract(wp.tile_reduce(wp.max, wp.tile(high, preserve_type=True)), 0)
    if not (low[0] <= high[0]):
        low = wp.vec3()
        high = wp.vec3()
    size = to_double(high) - to_double(low)
    grid = anchor_grid(wp.max(size[0], wp.max(size[1], size[2])))
    for i in range(mesh.instance_first + lane, mesh.instance_first + mesh.instance_count, wp.block_dim()):
        instance = out_instances[places[i]]
        instance.bounds_low = low
        instance.bounds_high = high
        instance.anchor_grid = grid
        out_instances[places[i]] = instance
