"""Reflectance: Lambert with phong, blinn_phong or ggx.

ggx follows glTF 2.0, appendix B: GGX distribution, height-correlated Smith visibility, Schlick Fresnel, diffuse scaled
by 1 - F. The distribution uses the cross-product form of 1 - (n.h)² (Filament, "Physically Based Rendering", 4.4.1),
which keeps its digits at grazing half vectors and never divides by zero at roughness >= 0.045.
phong is the normalised lobe (n + 2) / 2π of Lafortune and Willems 1994; blinn_phong the exact normalisation
(n + 2)(n + 4) / (8π (2^(-n/2) + n)) of Giesen 2009, "Phong and Blinn-Phong Normalization Factors". What the lobe's
colour can reflect at most is taken from the diffuse part, so that together they make no energy.
"""

from __future__ import annotations

import functools

import warp as wp

from .encoding import Surface
from .structs import MODEL_BLINN_PHONG, MODEL_GGX, MODEL_PHONG

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

MIN_ROUGHNESS = wp.constant(wp.float32(0.045))
MIN_N_DOT_V = wp.constant(wp.float32(1.0e-4))
INVERSE_PI = wp.constant(wp.float32(0.3183098861837907))


@wp.struct
class Reflection:
    """Diffuse and specular reflectance in 1/sr, cosine not included."""

    diffuse: wp.vec3
    specular: wp.vec3


@wp.func
def largest(v: wp.vec3):
    """Largest component."""
    return wp.max(v[0], wp.max(v[1], v[2]))


@wp.func
def diffuse_albedo(s: Surface):
    """Colour of the diffuse part: what ambient light and Lambert multiply."""
    if s.model == MODEL_GGX:
        return s.albedo * (1.0 - s.metallic)
    if s.model == MODEL_PHONG or s.model == MODEL_BLINN_PHONG:
        return s.albedo * (1.0 - largest(s.specular))
    return s.albedo


@wp.func
def schlick(f0: wp.vec3, cosine: wp.float32):
    """Fresnel reflectance of Schlick 1994 at the half vector."""
    m = 1.0 - cosine
    m2 = m * m
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m2 * m2 * m)


@wp.func
def ggx_lobe(n: wp.vec3, h: wp.vec3, n_dot_l: wp.float32, n_dot_v: wp.float32, roughness: wp.float32):
    """Distribution times visibility of ggx, without Fresnel."""
    alpha = roughness * roughness
    cross = wp.cross(n, h)
    a = wp.dot(n, h) * alpha
    # At least alpha² for unit vectors; 0 only where L = -V leaves no half vector.
    spread = wp.dot(cross, cross) + a * a
    if spread == 0.0:
        return wp.float32(0.0)
    k = alpha / spread
    a2 = alpha * alpha
    smith = n_dot_l * wp.sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2) + n_dot_v * wp.sqrt(
        n_dot_l * n_dot_l * (1.0 - a2) + a2
    )
    return k * k * INVERSE_PI * (0.5 / smith)


@wp.func
def phong_lobe(n: wp.vec3, l: wp.vec3, v: wp.vec3, shininess: wp.float32):
    """Normalised Phong lobe around the mirrored light."""
    r = 2.0 * wp.dot(n, l) * n - l
    cosine = wp.max(wp.dot(r, v), 0.0)
    return (shininess + 2.0) * (0.5 * INVERSE_PI) * wp.pow(cosine, shininess)


@wp.func
def blinn_phong_lobe(n: wp.vec3, h: wp.vec3, shininess: wp.float32):
    """Normalised Blinn-Phong lobe around the half vector."""
    cosine = wp.max(wp.dot(n, h), 0.0)
    scale = (shininess + 2.0) * (shininess + 4.0) / (wp.pow(2.0, -0.5 * shininess) + shininess)
    return scale * (0.125 * INVERSE_PI) * wp.pow(cosine, shininess)


@functools.cache
def make_reflect(models: int):
    """Function that evaluates a surface's reflectance; bit m of `models` says that model m occurs."""

    @wp.func
    def reflect(s: Surface, l: wp.vec3, v: wp.vec3, n_dot_l: wp.float32, n_dot_v: wp.float32):
        result = Reflection()
        result.diffuse = s.albedo * INVERSE_PI
        if wp.static((models & 14) != 0):
            # L = -V leaves no half vector; normalize gives 0 there and the lobes vanish.
            h = wp.normalize(l + v)
            if wp.static((models & 8) != 0):
                if s.model == MODEL_GGX:
                    rough = wp.clamp(s.roughness, MIN_ROUGHNESS, 1.0)
                    f0 = wp.vec3(0.04, 0.04, 0.04) * (1.0 - s.metallic) + s.albedo * s.metallic
                    f = schlick(f0, wp.clamp(wp.dot(v, h), 0.0, 1.0))
                    result.specular = f * ggx_lobe(s.normal, h, n_dot_l, n_dot_v, rough)
                    result.diffuse = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - f, s.albedo) * ((1.0 - s.metallic) * INVERSE_PI)
            if wp.static((models & 2) != 0):
                if s.model == MODEL_PHONG:
                    result.specular = s.specular * phong_lobe(s.normal, l, v, s.shininess)
                    result.diffuse = s.albedo * ((1.0 - largest(s.specular)) * INVERSE_PI)
            if wp.static((models & 4) != 0):
                if s.model == MODEL_BLINN_PHONG:
                    result.specular = s.specular * blinn_phong_lobe(s.normal, h, s.shininess)
                    result.diffuse = s.albedo * ((1.0 - largest(s.specular)) * INVERSE_PI)
        return result

    return reflect
