"""Projection, depth and addressing: the functions every stage shares, so that they agree to the bit.

Pixel coordinates have their origin at the top left, y down, centres at +0.5. Perspective depth is reversed with an
infinite far plane, z = near / w (Reed 2015, "Depth Precision Visualized"); orthographic depth is linear, 1 at the near
plane and 0 at the far one.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import load_vec4, load_vec4i
from .structs import (
    ORTHOGRAPHIC,
    PIXEL_BLOCK,
    PIXEL_BLOCK_AREA,
    Geometry,
    Pair,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def pixel_in_block(thread: wp.int32):
    """Place of a thread inside its block of pixels: (x, y), 8 x 8."""
    # Masks: division of what may be negative takes several instructions.
    return wp.vec2i(thread & (PIXEL_BLOCK - 1), (thread & (PIXEL_BLOCK_AREA - 1)) // PIXEL_BLOCK)


@wp.func
def pixel_block(thread: wp.int32):
    """Row of a thread, >= 0, in the table of its blocks of pixels."""
    return wp.int32(wp.uint32(thread) // wp.uint32(PIXEL_BLOCK_AREA))


@wp.func
def pixel_of(blocks: wp.array[wp.vec4i], thread: wp.int32):
    """(view, x, y) of a thread, by the table of its blocks of pixels; outside the view where a block hangs over."""
    block = load_vec4i(blocks, pixel_block(thread))
    place = pixel_in_block(thread)
    return wp.vec3i(block[0], block[1] + place[0], block[2] + place[1])


@wp.func
def pixel_index(view: View, x: wp.int32, y: wp.int32):
    """Index of a pixel in the arena; arenas are below 2^31 pixels, which the plan checks."""
    return wp.int32(view.pixel_offset) + y * view.row_pitch + x


@wp.func
def position_of(geometry: Geometry, vertex: wp.int32):
    """Object-space position of a vertex."""
    p = load_vec4(geometry.positions, vertex)
    return wp.vec3(p[0], p[1], p[2])


@wp.func
def normal_of(geometry: Geometry, vertex: wp.int32):
    """Object-space normal of a vertex; 0 where the face's own is wanted."""
    n = load_vec4(geometry.normals, vertex)
    return wp.vec3(n[0], n[1], n[2])


@wp.func
def to_view(pair: Pair, position: wp.vec3):
    """Object space to (x_px w, y_px w, w), without the principal point.

    The anchor lies near both camera and mesh, so that the subtraction is exact where it matters: coordinates far from
    the origin lose nothing.
    """
    return pair.matrix * (position - pair.anchor) + pair.offset


@wp.func
def to_homogeneous(view: View, scaled: wp.vec3):
    """(x_px w, y_px w, w) with the principal point added; w is 1 for orthographic views."""
    if view.projection == ORTHOGRAPHIC:
        return wp.vec3(scaled[0] + view.center[0], scaled[1] + view.center[1], 1.0)
    return wp.vec3(scaled[0] + view.center[0] * scaled[2], scaled[1] + view.center[1] * scaled[2], scaled[2])


@wp.func
def vertex_depth(view: View, distance: wp.float32):
    """Depth z in the key's sense of a view distance [m]: near / w, or linear for orthographic views (not clamped)."""
    if view.projection == ORTHOGRAPHIC:
        return (view.far - distance) / (view.far - view.near)
    return view.near / distance


@wp.func
def linear_depth(view: View, z: wp.float32):
    """View distance [m] from depth z; perspective z = 0 gives +inf."""
    if view.projection == ORTHOGRAPHIC:
        return view.far - z * (view.far - view.near)
    return view.near / z


@wp.func
def pixel_ray(view: View, px: wp.float32, py: wp.float32):
    """View-space direction of a perspective pixel with z = -1, or the offset of an orthographic one with z = 0."""
    x = (px - view.center[0]) / view.scale[0]
    y = (py - view.center[1]) / view.scale[1]
    if view.projection == ORTHOGRAPHIC:
        return wp.vec3(x, y, 0.0)
    return wp.vec3(x, y, -1.0)


@wp.func
def relative_position(view: View, px: wp.float32, py: wp.float32, depth: wp.float32):
    """World-oriented position relative to the eye [m] of a pixel at a linear depth; depth must be finite."""
    ray = pixel_ray(view, px, py)
    if view.projection == ORTHOGRAPHIC:
        return wp.transpose(view.rotation) * wp.vec3(ray[0], ray[1], -depth)
    return wp.transpose(view.rotation) * (ray * depth)


@wp.func
def view_direction(view: View, relative: wp.vec3):
    """Unit vector from a surface point towards the viewer, world-oriented."""
    if view.projection == ORTHOGRAPHIC:
        return wp.vec3(view.rotation[2, 0], view.rotation[2, 1], view.rotation[2, 2])
    # One reciprocal in place of three divisions; the eye itself, where no surface is, has no direction.
    length = wp.length(relative)
    if length == 0.0:
        return wp.vec3()
    return relative * (-1.0 / length)
