"""Perspective-correct interpolation from the original clip-space vertices.

Homogeneous barycentrics (Olano and Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates"), taken
relative to the pixel so that nothing large cancels: neither clipping nor snapping leaves a trace in attributes.
"""

from __future__ import annotations

import warp as wp

from .projection import to_view
from .structs import ORTHOGRAPHIC, Pair, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Barycentric:
    """Weights of a triangle's vertices at a pixel, their change per pixel, and the sign of the triangle's facing."""

    weight: wp.vec3
    ddx: wp.vec3
    ddy: wp.vec3
    orientation: wp.float32


@wp.func
def relative_vertex(view: View, pair: Pair, position: wp.vec3, px: wp.float32, py: wp.float32):
    """Homogeneous pixel coordinates of a vertex with the pixel at the origin."""
    s = to_view(pair, position)
    w = wp.where(view.projection == ORTHOGRAPHIC, 1.0, s[2])
    return wp.vec3(s[0] + (view.center[0] - px) * w, s[1] + (view.center[1] - py) * w, w)


@wp.func
def barycentric(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Weights at the origin of pixel-relative homogeneous vertices; >= 0, sum 1, finite whatever comes in."""
    e = wp.vec3(b[0] * c[1] - c[0] * b[1], c[0] * a[1] - a[0] * c[1], a[0] * b[1] - b[0] * a[1])
    ex = wp.vec3(b[1] * -c[2] + c[1] * b[2], c[1] * -a[2] + a[1] * c[2], a[1] * -b[2] + b[1] * a[2])
    ey = wp.vec3(b[0] * -c[2] + c[0] * b[2], c[0] * -a[2] + a[0] * c[2], a[0] * -b[2] + b[0] * a[2])
    ex = -ex
    total = e[0] + e[1] + e[2]
    # The determinant decides the facing: the sum changes sign past a grazing triangle's horizon, this does not.
    facing = a[2] * e[0] + b[2] * e[1] + c[2] * e[2]
    result = Barycentric()
    result.orientation = facing
    turned = e * wp.where(facing < 0.0, -1.0, 1.0)
    clamped = wp.vec3(wp.max(turned[0], 0.0), wp.max(turned[1], 0.0), wp.max(turned[2], 0.0))
    scale = 1.0 / (clamped[0] + clamped[1] + clamped[2])
    if not wp.isfinite(scale):
        # A grazing triangle can cancel to nothing; its pixel takes the middle.
        third = 1.0 / 3.0
        result.weight = wp.vec3(third, third, third)
        return result
    result.weight = clamped * scale
    inverse = 1.0 / total
    if not wp.isfinite(inverse):
        return result
    raw = e * inverse
    result.ddx = (ex - raw * (ex[0] + ex[1] + ex[2])) * inverse
    result.ddy = (ey - raw * (ey[0] + ey[1] + ey[2])) * inverse
    return result


@wp.func
def mix2(w: wp.vec3, a: wp.vec2, b: wp.vec2, c: wp.vec2):
    """Interpolate so that a constant stays exactly constant, and never leave the range of the three."""
    value = a + (b - a) * w[1] + (c - a) * w[2]
    return wp.max(wp.min(value, wp.max(a, wp.max(b, c))), wp.min(a, wp.min(b, c)))


@wp.func
def mix3(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Interpolate so that a constant stays exactly constant, and never leave the range of the three."""
    value = a + (b - a) * w[1] + (c - a) * w[2]
    return wp.max(wp.min(value, wp.max(a, wp.max(b, c))), wp.min(a, wp.min(b, c)))


@wp.func
def mix4(w: wp.vec3, a: wp.vec4, b: wp.vec4, c: wp.vec4):
    """Interpolate so that a constant stays exactly constant, and never leave the range of the three."""
    value = a + (b - a) * w[1] + (c - a) * w[2]
    return wp.max(wp.min(value, wp.max(a, wp.max(b, c))), wp.min(a, wp.min(b, c)))
