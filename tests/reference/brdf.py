"""Reflection models. Each yields (diffuse, specular) reflectance [1/sr], (n, 3) each, without the cosine.

`normal`, `to_light` and `to_viewer` are (n, 3) unit vectors pointing away from the surface. Where the light is below
the horizon (n.l <= 0) both parts are exactly 0; n.v is at least 1e-4.
"""

from __future__ import annotations

import numpy as np

__all__ = ["MIN_ROUGHNESS", "brdf_blinn_phong", "brdf_ggx", "brdf_lambert", "brdf_phong", "dot", "unit"]

MIN_ROUGHNESS = 0.045
MIN_N_DOT_V = 1e-4


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar product over the last axis, kept as an axis of length 1."""
    return np.sum(np.asarray(a, float) * np.asarray(b, float), axis=-1, keepdims=True)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale to length 1 over the last axis; the zero vector stays zero."""
    length = np.sqrt(dot(vectors, vectors))
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), 0.0)


def _lit(n_dot_l: np.ndarray, diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.where(n_dot_l > 0.0, diffuse, 0.0), np.where(n_dot_l > 0.0, specular, 0.0)


def brdf_lambert(normal, to_light, to_viewer, *, albedo):
    """Ideal diffuse reflection, albedo / pi. Source: Lambert 1760."""
    diffuse = np.broadcast_to(np.asarray(albedo, float) / np.pi, np.shape(to_light))
    return _lit(dot(normal, to_light), diffuse, np.zeros_like(diffuse))


def brdf_phong(normal, to_light, to_viewer, *, albedo, specular, shininess):
    """Cosine lobe round the mirror direction, normalised so that it never reflects more than `specular`.

    Source: Lafortune and Willems 1994, Using the modified Phong reflectance model for physically based rendering.
    """
    n_dot_l = dot(normal, to_light)
    mirror = 2.0 * n_dot_l * normal - to_light
    lobe = np.maximum(dot(mirror, to_viewer), 0.0) ** shininess * (shininess + 2.0) / (2.0 * np.pi)
    return _lit(n_dot_l, _rest(specular) * albedo / np.pi, np.asarray(specular) * lobe)


def brdf_blinn_phong(normal, to_light, to_viewer, *, albedo, specular, shininess):
    """Cosine lobe round the half vector, normalised for normal incidence.

    Source: Giesen 2009, Phong normalization factor derivation.
    """
    n = shininess
    factor = (n + 2.0) * (n + 4.0) / (8.0 * np.pi * (2.0 ** (-n / 2.0) + n))
    lobe = np.maximum(dot(normal, unit(to_light + to_viewer)), 0.0) ** n * factor
    return _lit(dot(normal, to_light), _rest(specular) * albedo / np.pi, np.asarray(specular) * lobe)


def _rest(specular: np.ndarray) -> np.ndarray:
    return 1.0 - np.max(specular, axis=-1, keepdims=True)


def brdf_ggx(normal, to_light, to_viewer, *, base_color, metallic, roughness):
    """Microfacet reflection of glTF 2.0.

    Source: glTF 2.0 specification, appendix B.3: Trowbridge-Reitz distribution, height-correlated Smith visibility,
    Schlick Fresnel. Perceptual roughness is at least 0.045, as design section 4 states.

    Args:
        normal: Surface normals.
        to_light: Directions to the light.
        to_viewer: Directions to the viewer.
        base_color: (n, 3) linear.
        metallic: (n, 1).
        roughness: (n, 1) perceptual.
    """
    n_dot_l = dot(normal, to_light)
    n_dot_v = np.maximum(dot(normal, to_viewer), MIN_N_DOT_V)
    half = unit(to_light + to_viewer)
    n_dot_h = np.clip(dot(normal, half), 0.0, 1.0)
    v_dot_h = np.clip(dot(to_viewer, half), 0.0, 1.0)
    a2 = np.maximum(roughness, MIN_ROUGHNESS) ** 4
    distribution = a2 / (np.pi * (n_dot_h**2 * (a2 - 1.0) + 1.0) ** 2)
    above = np.maximum(n_dot_l, 0.0)
    smith = above * np.sqrt(n_dot_v**2 * (1.0 - a2) + a2) + n_dot_v * np.sqrt(above**2 * (1.0 - a2) + a2)
    c_diff = base_color * (1.0 - metallic)
    f0 = 0.04 + (base_color - 0.04) * metallic
    fresnel = f0 + (1.0 - f0) * (1.0 - v_dot_h) ** 5
    return _lit(n_dot_l, (1.0 - fresnel) * c_diff / np.pi, fresnel * distribution * 0.5 / smith)
