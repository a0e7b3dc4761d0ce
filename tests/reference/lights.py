"""What arrives at a point from one light: direction and irradiance before the cosine."""

from __future__ import annotations

import numpy as np

from .brdf import dot, unit
from .data import Light

__all__ = ["attenuation", "incoming", "spot_factor"]

MIN_POLYNOMIAL = 1e-8


def attenuation(distance: np.ndarray, light: Light) -> np.ndarray:
    """Fall-off with distance [1/m² for the inverse square], exactly 0 from the range on.

    Source: KHR_lights_punctual, "Range property": clamp(1 - (d/range)^4, 0, 1) over d², the latter at least the squared
    source radius. Polynomial: X3D (PointLight) and OpenGL 1.5: 1 / (c + l d + q d²), no window.
    """
    d = np.asarray(distance, float)
    if light.coefficients is not None:
        c, l, q = light.coefficients
        value = 1.0 / np.maximum(c + l * d + q * d * d, MIN_POLYNOMIAL)
    else:
        window = 1.0 if np.isinf(light.range) else np.clip(1.0 - (d / light.range) ** 4, 0.0, 1.0)
        value = window / np.maximum(d * d, light.source_radius**2)
    return np.where(d < light.range, value, 0.0)


def spot_factor(cosine: np.ndarray, inner_angle: float, outer_angle: float) -> np.ndarray:
    """Fade between the inner and the outer angle, given the cosine from the axis. Source: KHR_lights_punctual."""
    scale = 1.0 / max(0.001, np.cos(inner_angle) - np.cos(outer_angle))
    return np.clip((np.asarray(cosine, float) - np.cos(outer_angle)) * scale, 0.0, 1.0) ** 2


def incoming(light: Light, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the unit direction to the light and the light arriving on a facing surface.

    Args:
        light: The light.
        points: World positions (n, 3).

    Returns:
        Directions (n, 3), zero for a point on the light itself, and irradiance (n, 3) [lx].
    """
    radiance = np.asarray(light.radiance, float)
    axis = unit(np.asarray(light.direction, float))
    if light.kind == "directional":
        return np.broadcast_to(-axis, points.shape), np.broadcast_to(radiance, points.shape)
    offset = np.asarray(light.position, float) - points
    to_light = unit(offset)
    strength = attenuation(np.sqrt(dot(offset, offset)), light)
    if light.kind == "spot":
        strength = strength * spot_factor(dot(axis, -to_light), light.inner_angle, light.outer_angle)
    return to_light, strength * radiance
