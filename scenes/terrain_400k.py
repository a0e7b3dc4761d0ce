"""The terrain in 400 000 triangles under one directional and one point light: dusk, and a lamp between the hills.

The low sun rakes over the ridges and leaves the valleys to the lamp, which drifts along one of them as a glowing ball.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range, input_error
from warp_deferred.lights import DirectionalLight, PointLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from .shapes import sphere, translation
from .terrain import height, net

__all__ = ["PERIOD", "animate", "build"]

PERIOD = 16.0
"""Time after which sun and lamp are back where they were [s]."""
SUN = (-0.80, -0.34, 0.62)
"""Direction of the sun's light in the middle of its swing."""
LAMP = (0.55, 5.55)
"""x and z around which the lamp drifts [m]."""
ABOVE = 0.42
"""Height of the lamp above the ground [m]."""


def build(*, triangles: int = 400_000, sun: float = 1.0, lamp: float = 1.0) -> Scene:
    """Build terrain, sun and lamp.

    Args:
        triangles: Triangles wanted; the nearest 2 (n - 1)² is taken, and the lamp's ball has 960 more.
        sun: Factor on the directional light.
        lamp: Factor on the point light.
    """
    triangles = check_count("terrain_400k.triangles", triangles, 2, 200_000_000)
    factors = [check_range(f"terrain_400k.{n}", v, 0.0, 1e6) for n, v in (("sun", sun), ("lamp", lamp))]
    scene = Scene("terrain_400k")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.050, 0.066, 0.125), background=(0.21, 0.20, 0.31))
    scene.cameras.append(Camera.look_at((0.0, 2.3, 9.4), (0.0, -0.1, 1.6), vertical_fov_deg=50.0, near=0.05))
    sand = Material(base_color=(0.34, 0.29, 0.23, 1.0), roughness=0.62, name="sand")
    scene.add(net(round(math.sqrt(triangles / 2)) + 1), material=sand, label=1)
    warm = Material(base_color=(0.0, 0.0, 0.0, 1.0), emissive=(9.0, 5.4, 2.2), roughness=1.0, name="lamp")
    # No larger than the light in it: what lies within the source's radius must not stand in its way.
    scene.add(sphere(0.075, 32, 16).mesh("lamp"), material=warm, label=2)
    scene.lights.add(
        PointLight(color=(1.0, 0.60, 0.24), intensity=5.0 * factors[1], range=7.0, source_radius=0.08,
                   casts_shadow=True, name="lamp"),
        DirectionalLight(color=(1.0, 0.58, 0.34), intensity=4.4 * factors[0], casts_shadow=True, name="sun"),
    )  # fmt: skip
    animate(scene, 0.0)
    return scene


def animate(scene: Scene, time: float) -> None:
    """Swing the sun and let the lamp drift through its valley.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene was not made by `build`.
    """
    if scene.name != "terrain_400k" or len(scene.lights.point) != 1 or len(scene.lights.directional) != 1:
        raise input_error("terrain_400k.animate.scene", "a scene made by terrain_400k.build", repr(scene))
    beat = 2.0 * np.pi * check_range("terrain_400k.animate.time", time, -1e9, 1e9, unit="s") / PERIOD
    x, z = LAMP[0] + 0.5 * math.sin(beat), LAMP[1] + 0.5 * math.sin(2.0 * beat)
    y = float(height(np.float64(x), np.float64(z))[0]) + ABOVE
    scene.lights.point.position = [[x, y, z]]
    scene.lights.directional.direction = [[SUN[0], SUN[1] - 0.08 * math.sin(beat), SUN[2] + 0.2 * math.sin(beat)]]
    for instance in scene.instances:
        if instance.mesh.name == "lamp":
            instance.transform = translation(x, y, z)
