"""A spinning wheel, a ball that flies past it, and a swinging hammer before things that stand still.

Every frame of an open shutter shows rotations and a fast straight flight, before a checkered wall and behind a post.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_range
from warp_deferred.errors import InputError
from warp_deferred.lights import DirectionalLight, PointLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from .shapes import bevelled_box, join, plane, sphere, torus, translation

__all__ = ["PERIOD", "animate", "build"]

#: Time after which everything is back in its place [s].
PERIOD = 4.0
HUB = (-0.85, 1.25, -0.3)
PIVOT = (1.55, 2.35, -0.9)


def _about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def _upright() -> np.ndarray:
    return np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def build(*, shutter: float = 0.5) -> Scene:
    """Build the stage.

    Args:
        shutter: Share of the frame interval that the camera's shutter is open, 0 to 1.
    """
    shutter = check_range("motion.shutter", shutter, 0.0, 1.0)
    scene = Scene("motion")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.06, 0.07, 0.09), background=(0.012, 0.016, 0.03))
    floor = Material(base_color=(0.24, 0.20, 0.17, 1.0), roughness=0.35, name="floor")
    scene.add(plane(40.0, 40.0).mesh("floor"), material=floor, label=1)
    light, dark = bevelled_box(0.58, 0.58, 0.12, 0.03), Material(base_color=(0.13, 0.20, 0.27, 1.0), name="dark tile")
    pale, mesh = Material(base_color=(0.42, 0.40, 0.36, 1.0), name="pale tile"), light.mesh("tile")
    for row in range(6):
        for column in range(-7, 8):
            place = translation(0.6 * column, 0.6 * row, -2.6)
            scene.add(mesh, transform=place, material=dark if (row + column) % 2 else pale, label=2)
    post = Material(base_color=(0.55, 0.50, 0.44, 1.0), roughness=0.5, name="post")
    scene.add(bevelled_box(0.16, 2.2, 0.16, 0.02).mesh("post"), transform=translation(0.45, 0, 1.0), material=post)
    _add_moving(scene)
    scene.lights.add(
        DirectionalLight(direction=(-0.45, -0.9, -0.7), color=(1.0, 0.95, 0.86), intensity=2.4),
        PointLight(position=(-2.4, 2.4, 2.2), color=(1.0, 0.70, 0.44), intensity=14.0, range=10.0),
        PointLight(position=(2.6, 1.6, 1.4), color=(0.45, 0.62, 1.0), intensity=10.0, range=10.0),
    )
    eye, target = (0.25, 1.55, 4.8), (0.1, 1.2, -0.6)
    scene.cameras.append(Camera.look_at(eye, target, vertical_fov_deg=42.0, shutter=shutter))
    animate(scene, 0.0)
    return scene


def _add_moving(scene: Scene) -> None:
    """A wheel of eight spokes, a ball, and a hammer: named, so that `animate` finds them."""
    brass = Material(base_color=(0.95, 0.64, 0.22, 1.0), metallic=0.7, roughness=0.48, name="brass")
    red = Material(base_color=(0.78, 0.07, 0.05, 1.0), roughness=0.25, name="red")
    steel = Material(base_color=(0.62, 0.66, 0.72, 1.0), metallic=0.9, roughness=0.36, name="steel")
    rim = torus(0.92, 0.075, 96, 20).moved(_upright())
    spokes = [bevelled_box(0.075, 0.9, 0.075, 0.015).moved(_about_z(k * math.pi / 4.0)) for k in range(8)]
    scene.add(join(rim, sphere(0.16, 32, 16), *spokes).mesh("wheel"), material=brass, label=3, name="wheel")
    # One spoke of another colour tells how far the wheel has turned.
    mark = bevelled_box(0.10, 0.86, 0.11, 0.015)
    scene.add(mark.mesh("mark"), material=red, label=3, name="wheel")
    scene.add(sphere(0.21, 48, 24).mesh("ball"), material=red, label=4, name="ball")
    handle = bevelled_box(0.06, 1.25, 0.06, 0.01).at(0.0, -1.25, 0.0)
    head = bevelled_box(0.46, 0.24, 0.24, 0.03).at(0.0, -1.45, 0.0)
    scene.add(join(handle, head).mesh("hammer"), material=steel, label=5, name="hammer")


def animate(scene: Scene, time: float) -> None:
    """Spin the wheel, let the ball fly to and fro, swing the hammer.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene is not one of `build`.
    """
    phase = 2.0 * math.pi * time / PERIOD
    ball = 2.3 * math.sin(2.0 * phase), 0.95 + 0.5 * math.cos(4.0 * phase), 0.35
    places = {
        "wheel": translation(*HUB) @ _about_z(-3.0 * phase),
        "ball": translation(*ball),
        "hammer": translation(*PIVOT) @ _about_z(0.9 * math.sin(3.0 * phase + 0.4)),
    }
    moving = [i for i in scene.instances if i.name in places]
    if not moving:
        raise InputError("motion.animate: expected a scene made by its build, got another one; load('motion')")
    for instance in moving:
        instance.transform = places[instance.name]
