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
    """What a surface makes of light from one direction, cosine not included."""

    diffuse: wp.vec3  # share of the diffuse reflectance, which is `diffuse_albedo` / pi, that the lobe leaves
    specular: wp.vec3  # [1/sr]


@wp.struct
class Lobe:
    """What of a specular lobe depends on surface and viewer alone: computed once a pixel, not once a light."""

    f0: wp.vec3  # reflectance at normal incidence (ggx), or the lobe's colour
    n_dot_v: wp.float32
    alpha2: wp.float32  # alpha squared, alpha = roughness squared
    smith_view: wp.float32  # sqrt(n_dot_v^2 (1 - alpha^2) + alpha^2)
    scale: wp.float32  # constant factor of the lobe


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
def smith_root(cosine: wp.float32, alpha2: wp.float32):
    """One of the two roots of the height-correlated Smith term."""
    return wp.sqrt(cosine * cosine * (1.0 - alpha2) + alpha2)


@wp.func
def ggx_lobe(lobe: Lobe, n: wp.vec3, sum: wp.vec3, sum2: wp.float32, n_dot_l: wp.float32):
    """Distribution times visibility of ggx, without Fresnel.

    The half vector is not normalised: with m = l + v, (n x m)^2 + alpha^2 (n.m)^2 is |m|^2 times the distribution's
    denominator, so that one division serves distribution and visibility. It is at least alpha^2 |m|^2; where its square
    leaves float32's normal range, L is -V and the lobe vanishes.

    Args:
        lobe: View-dependent terms.
        n: Normal.
        sum: l + v.
        sum2: Its squared length.
        n_dot_l: Cosine at the light, > 0.
    """
    cross = wp.cross(n, sum)
    along = wp.dot(n, sum)
    spread = wp.dot(cross, cross) + along * along * lobe.alpha2
    smith = n_dot_l * lobe.smith_view + lobe.n_dot_v * smith_root(n_dot_l, lobe.alpha2)
    below = spread * spread * smith
    if not (below > 1.0e-37):
        return wp.float32(0.0)
    return lobe.scale * sum2 * sum2 / below


@wp.func
def phong_lobe(n: wp.vec3, l: wp.vec3, v: wp.vec3, n_dot_l: wp.float32, shininess: wp.float32):
    """Phong lobe around the mirrored light, without its constant factor."""
    r = 2.0 * n_dot_l * n - l
    return wp.pow(wp.max(wp.dot(r, v), 0.0), shininess)


@wp.func
def blinn_phong_lobe(n: wp.vec3, sum: wp.vec3, sum2: wp.float32, shininess: wp.float32):
    """Blinn-Phong lobe around the half vector, without its constant factor; 0 where L is -V."""
    if sum2 == 0.0:
        return wp.float32(0.0)
    return wp.pow(wp.max(wp.dot(n, sum) / wp.sqrt(sum2), 0.0), shininess)


@functools.cache
def make_reflectance(models: int):
    """(view_lobe, reflect) of the specular models in use; bit m of `models` says that model m occurs."""

    @wp.func
    def view_lobe(s: Surface, n_dot_v: wp.float32):
        lobe = Lobe()
        if wp.static((models & 8) != 0):
            if s.model == MODEL_GGX:
                rough = wp.clamp(s.roughness, MIN_ROUGHNESS, 1.0)
                alpha = rough * rough
                lobe.f0 = wp.vec3(0.04, 0.04, 0.04) * (1.0 - s.metallic) + s.albedo * s.metallic
                lobe.n_dot_v = n_dot_v
                lobe.alpha2 = alpha * alpha
                lobe.smith_view = smith_root(n_dot_v, lobe.alpha2)
                lobe.scale = lobe.alpha2 * (0.5 * INVERSE_PI)
        if wp.static((models & 2) != 0):
            if s.model == MODEL_PHONG:
                lobe.f0 = s.specular
                lobe.scale = (s.shininess + 2.0) * (0.5 * INVERSE_PI)
        if wp.static((models & 4) != 0):
            if s.model == MODEL_BLINN_PHONG:
                lobe.f0 = s.specular
                rest = wp.pow(2.0, -0.5 * s.shininess) + s.shininess
                lobe.scale = (s.shininess + 2.0) * (s.shininess + 4.0) / rest * (0.125 * INVERSE_PI)
        return lobe

    @wp.func
    def reflect(s: Surface, lobe: Lobe, l: wp.vec3, v: wp.vec3, n_dot_l: wp.float32):
        result = Reflection()
        result.diffuse = wp.vec3(1.0, 1.0, 1.0)
        if wp.static((models & 12) != 0):
            sum = l + v
            sum2 = wp.dot(sum, sum)
            if wp.static((models & 8) != 0):
                if s.model == MODEL_GGX:
                    # v.h of unit vectors is half the length of their sum.
                    f = schlick(lobe.f0, wp.min(0.5 * wp.sqrt(sum2), 1.0))
                    result.specular = f * ggx_lobe(lobe, s.normal, sum, sum2, n_dot_l)
                    result.diffuse = wp.vec3(1.0, 1.0, 1.0) - f
            if wp.static((models & 4) != 0):
                if s.model == MODEL_BLINN_PHONG:
                    result.specular = lobe.f0 * (lobe.scale * blinn_phong_lobe(s.normal, sum, sum2, s.shininess))
        if wp.static((models & 2) != 0):
            if s.model == MODEL_PHONG:
                result.specular = lobe.f0 * (lobe.scale * phong_lobe(s.normal, l, v, n_dot_l, s.shininess))
        return result

    return view_lobe, reflect
