"""The discard hook: alpha masks decide coverage, so they sample exact texels and never the hardware filter.

glTF 2.0, 3.9.4: alpha below the cutoff is not there, at or above it is; NaN is not there.
"""

from __future__ import annotations

import functools

import warp as wp

from .interpolation import barycentric, mix2, mix4, relative_vertex
from .projection import position_of
from .structs import FLAG_COLORS, Geometry, Material, Pair, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def wrap_texel(coordinate: wp.float32, size: wp.float32, mode: wp.int32):
    """Texel index of a normalised coordinate under a wrap mode: repeat 0, clamp 1, mirror 2."""
    t = coordinate
    if mode == 0:
        t = t - wp.floor(t)
    elif mode == 2:
        t = t - 2.0 * wp.floor(t * 0.5)
        if t > 1.0:
            t = 2.0 - t
    return wp.clamp(wp.floor(t * size), 0.0, size - 1.0)


@functools.cache
def make_keep_surface():
    """Function that tells whether a masked material is there at a point of a triangle."""

    @wp.func
    def keep_surface(geometry: Geometry, instance: wp.int32, material: Material, v: wp.vec3i, weights: wp.vec3):
        alpha = material.base_color[3]
        if (geometry.instances[instance].flags & FLAG_COLORS) != 0:
            c0, c1, c2 = geometry.colors[v[0]], geometry.colors[v[1]], geometry.colors[v[2]]
            # Looked at before it is mixed, which drops NaN.
            if not wp.isfinite(c0[3] + c1[3] + c2[3]):
                return False
            color = mix4(weights, c0, c1, c2)
            alpha *= color[3]
        if (material.textured & 1) != 0:
            uv = mix2(weights, geometry.uvs[v[0]], geometry.uvs[v[1]], geometry.uvs[v[2]])
            size = material.base_color_size
            tx = (wrap_texel(uv[0], size[0], material.mask_wrap[0]) + 0.5) / size[0]
            ty = (wrap_texel(uv[1], size[1], material.mask_wrap[1]) + 0.5) / size[1]
            alpha *= wp.texture_sample(material.mask_texture, wp.vec2(tx, ty), dtype=float)
        return alpha >= material.alpha_cutoff

    return keep_surface


@functools.cache
def make_discard():
    """Function that tells whether a fragment of a masked material is there."""
    keep_surface = make_keep_surface()

    @wp.func
    def keep_fragment(
        view: View, pair: Pair, geometry: Geometry, material: Material, v: wp.vec3i, x: wp.int32, y: wp.int32
    ):
        px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
        weights = barycentric(
            relative_vertex(view, pair, position_of(geometry, v[0]), px, py),
            relative_vertex(view, pair, position_of(geometry, v[1]), px, py),
            relative_vertex(view, pair, position_of(geometry, v[2]), px, py),
        ).weight
        return keep_surface(geometry, pair.instance, material, v, weights)

    return keep_fragment
