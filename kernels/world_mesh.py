"""World triangles of all instances, for passes that trace rays. One thread a corner, block size 64; deterministic.

Corners are stored relative to an anchor amid the scene, so that float32 keeps a scene's own detail wherever it stands.
"""

from __future__ import annotations

import warp as wp

from .projection import position_of
from .structs import Geometry

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Half the largest float: beyond it, a box's size would overflow.
FARTHEST = wp.constant(1.0e18)


@wp.kernel(grid_stride=False)
def place_corners_kernel(
    # Scene
    geometry: Geometry,
    # In
    triangles: wp.array[wp.vec2i],
    # Params
    anchor: wp.vec3d,
    first: wp.int32,
    # Out
    out_points: wp.array[wp.vec3],
):
    """Corner 3 t + c of the t-th triangle, given as (instance slot, row of Geometry.triangles)."""
    i = wp.tid() + first
    row = triangles[i // 3]
    vertex = geometry.triangles[row[1]][i % 3]
    transform = geometry.transforms[row[0]]
    origin = transform.origin - anchor
    offset = wp.vec3(wp.float32(origin[0]), wp.float32(origin[1]), wp.float32(origin[2]))
    point = transform.linear * position_of(geometry, vertex) + offset
    # A transform that is not finite hides its instance: all its corners fall together, which no ray hits.
    if not (wp.abs(point[0]) < FARTHEST and wp.abs(point[1]) < FARTHEST and wp.abs(point[2]) < FARTHEST):
        point = wp.vec3()
    out_points[i] = point
