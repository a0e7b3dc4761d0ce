"""A Lambert plane under one point light: the radiance of every pixel is known in closed form.

At a point p of the plane the light at l, of intensity I and range r, gives the radiance
albedo / pi * I * window(d / r) / d² * cos(angle between normal and l - p), d = |l - p|, with the window
clamp(1 - (d / r)⁴, 0, 1) of KHR_lights_punctual.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_range
from warp_deferred.lights import PointLight
from warp_deferred.materials import Material
from warp_deferred.scene import Scene

from ._reach import camera_rays
from .shapes import plane

__all__ = ["build", "expected_radiance"]

_ALBEDO = (0.8, 0.5, 0.3)


def build(*, intensity: float = 12.0, height: float = 1.5, light_range: float = 0.0, tilt_deg: float = 0.0) -> Scene:
    """Build the plane y = 0, its light and a camera that sees nothing else.

    Args:
        intensity: Of the light [cd].
        height: Of the light above the plane [m].
        light_range: Distance at which the light ends [m]; 0 for a light without end.
        tilt_deg: Angle between the view direction and straight down [degrees]; 0 faces the plane.
    """
    check_range("lambert_plane.height", height, 1e-3, 1e3, unit="m")
    check_range("lambert_plane.light_range", light_range, 0.0, unit="m")
    tilt = math.radians(check_range("lambert_plane.tilt_deg", tilt_deg, 0.0, 60.0, mend="steeper views see the sky"))
    scene = Scene("lambert_plane")
    # Large enough for the corners of wide pictures: 40 degrees of view around a tilt of at most 60.
    ground = plane(400.0, 400.0)
    scene.add(ground.mesh("plane"), material=Material(model="lambert", base_color=(*_ALBEDO, 1.0), name="clay"))
    reach = light_range if light_range > 0.0 else math.inf
    scene.lights.add(
        PointLight(position=(0.3, height, -0.2), color=(1.0, 0.9, 0.7), intensity=intensity, range=reach, name="lamp")
    )
    eye = (0.0, 5.0 * math.cos(tilt), 5.0 * math.sin(tilt))
    scene.cameras.append(Camera.look_at(eye, (0.0, 0.0, 0.0), vertical_fov_deg=40.0))
    return scene


def expected_radiance(scene: Scene, width: int, height: int) -> np.ndarray:
    """Radiance that `color` must show for a scene of `build`, in float64.

    Args:
        scene: A scene made by `build`; light and camera may have been moved since, the plane not.
        width: Width of the picture [px].
        height: Height of the picture [px].

    Returns:
        (height, width, 3) linear radiance; 0 where the view misses the plane.
    """
    eye, rays = camera_rays(scene.camera, width, height)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -eye[1] / rays[..., 1]
    points = eye + rays * along[..., None]
    light = scene.lights.point
    to_light = light.position[0] - points
    square = np.einsum("...i,...i->...", to_light, to_light)
    window = np.clip(1.0 - (square / np.square(float(light.range[0]))) ** 2, 0.0, 1.0)
    cosine = np.maximum(to_light[..., 1], 0.0) / np.sqrt(square)
    irradiance = float(light.intensity[0]) * window * cosine / np.maximum(square, float(light.source_radius[0]) ** 2)
    color = np.array(scene.instances[0].material.base_color[:3]) * light.color[0] / np.pi
    return np.where((along > 0.0)[..., None], irradiance[..., None] * color, 0.0)
