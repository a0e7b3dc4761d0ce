"""The thin lens: circles of confusion, and points of the lens opening. Functions only.

A lens of diameter A focused at view depth f, with a projection of s pixels per unit of x/z, spreads a point at depth z
over a circle of A s |1/z - 1/f| pixels across (Potmesil and Chakravarty 1982, "Synthetic Image Generation with a Lens
and Aperture Camera Model", written for a pinhole projection): the same that a view through a point of the opening sees
if it is sheared so that the plane in focus stays where it is.
"""

from __future__ import annotations

import warp as wp

from .intrinsics import fast_reciprocal
from .structs import ORTHOGRAPHIC, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

QUARTER_PI = wp.constant(wp.float32(0.7853981633974483))


@wp.func
def lens_scale(view: View):
    """Radius of a circle of confusion per difference of 1/z [px m]; 0 for a pinhole and for parallel rays."""
    if view.projection == ORTHOGRAPHIC:
        return wp.float32(0.0)
    return 0.5 * view.aperture * wp.max(wp.abs(view.scale[0]), wp.abs(view.scale[1]))


@wp.func
def lens_terms(view: View):
    """(a, b) such that the circle of confusion of a depth z is a / z + b [px m, px]; 0 and 0 where all is in focus."""
    scale = lens_scale(view)
    return wp.vec2(-scale, scale / view.focus_distance)


@wp.func
def circle_of_confusion(lens: wp.vec2, depth: wp.float32, limit: wp.float32):
    """Radius of a depth's circle of confusion [px], negative before the plane in focus; depth may be +inf.

    Where pixels are not square it is that along the axis with more of them to a metre.
    """
    return wp.clamp(lens[0] * fast_reciprocal(depth) + lens[1], -limit, limit)


@wp.func
def circle_shape(view: View):
    """What a circle's radius is multiplied by along x and y: 1 and 1 where pixels are square."""
    x, y = wp.abs(view.scale[0]), wp.abs(view.scale[1])
    inverse = 1.0 / wp.max(x, y)
    return wp.vec2(x * inverse, y * inverse)


@wp.func
def disc_point(u: wp.float32, v: wp.float32):
    """Point of the unit disc for one of the unit square, equal areas to equal areas, (0.5, 0.5) to the middle.

    Squares around the middle become circles (Shirley and Chiu 1997, "A Low Distortion Map Between Disk and Square").
    """
    a, b = 2.0 * u - 1.0, 2.0 * v - 1.0
    if a == 0.0 and b == 0.0:
        return wp.vec2(0.0, 0.0)
    radius, angle = a, QUARTER_PI * (b / a)
    if wp.abs(b) > wp.abs(a):
        radius = b
        angle = QUARTER_PI * (2.0 - a / b)
    return wp.vec2(radius * wp.cos(angle), radius * wp.sin(angle))


@wp.func
def through_lens(view: View, point: wp.vec2):
    """The view from a point of the opening [radii], sheared off its axis so that the plane in focus does not move."""
    result = view
    offset = point * (0.5 * view.aperture)
    right = wp.vec3d(wp.float64(view.rotation[0, 0]), wp.float64(view.rotation[0, 1]), wp.float64(view.rotation[0, 2]))
    up = wp.vec3d(wp.float64(view.rotation[1, 0]), wp.float64(view.rotation[1, 1]), wp.float64(view.rotation[1, 2]))
    result.origin = view.origin + right * wp.float64(offset[0]) + up * wp.float64(offset[1])
    result.center = view.center + wp.cw_mul(view.scale, offset) / view.focus_distance
    return result
