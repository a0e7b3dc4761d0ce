"""Fifty thousand triangles of spheres: balls on a spiral around a pearl, under four point lights or four spotlights.

The balls lie where seeds lie in a sunflower, a golden angle from one to the next, and grow with their distance from
the middle by the same factor each time, so that every part of the picture is the whole at another size. They rest on
the floor, and a wave runs outwards through them.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_choice, check_range, input_error
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from .shapes import plane, sphere, translation

__all__ = ["PERIOD", "animate", "build"]

PERIOD = 12.0
"""Time after which everything is back where it was [s]."""
PEARL = 1.15
"""Radius of the sphere in the middle [m]."""
BALLS = 77
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
"""Angle from one ball to the next [rad]."""
NEAREST, GROWTH, SIZE = 1.60, 1.0150, 0.141
"""Distance of the first ball's middle [m], factor from one ball to the next, radius as a share of the distance."""
LIFT = 0.9
"""How far the wave lifts a ball, as a share of its radius."""
#: (base colour, metalness, roughness) of the balls; each stands in one of the spiral's arms.
FINISHES = [
    ((0.93, 0.89, 0.83), 0.0, 0.30),
    ((0.045, 0.10, 0.19), 0.0, 0.18),
    ((0.98, 0.72, 0.36), 1.0, 0.34),
    ((0.50, 0.055, 0.050), 0.0, 0.24),
    ((0.10, 0.26, 0.23), 0.0, 0.36),
]
#: Colour of each light, the angle it starts at [rad], its distance from the axis and its height [m].
LAMPS = [
    ((1.0, 0.66, 0.34), 0.55, 3.3, 3.0),
    ((0.42, 0.66, 1.0), 2.25, 3.9, 3.3),
    ((1.0, 0.40, 0.46), 3.70, 3.5, 2.9),
    ((0.66, 0.92, 0.86), 5.25, 4.0, 3.4),
]


def _distances() -> np.ndarray:
    """(77,) distances of the balls from the axis [m]."""
    return NEAREST * GROWTH ** np.arange(BALLS)


def _balls(time: float) -> list[np.ndarray]:
    """Where the balls are at a time; (4, 4) matrices of a ball of radius 1."""
    distance = _distances()
    angle = GOLDEN * np.arange(BALLS)
    radius = SIZE * distance
    beat = 2.0 * np.pi * time / PERIOD
    # A ball leaves the floor in the crest only, so that most of them rest at any time.
    lift = LIFT * radius * np.maximum(np.sin(2.0 * beat - 1.1 * distance), 0.0) ** 2
    x, z = distance * np.cos(angle), distance * np.sin(angle)
    return [translation(x[k], radius[k] + lift[k], z[k], scale=radius[k]) for k in range(BALLS)]


def build(*, lights: str = "point", intensity: float = 1.0, casts_shadow: bool = True) -> Scene:
    """Build pearl, balls, floor and four lights: 50 000 triangles.

    Args:
        lights: Kind of the four lights: point or spot.
        intensity: Factor on them.
        casts_shadow: Whether they call for shadows.
    """
    kind = check_choice("spheres_50k.lights", lights, ("point", "spot"))
    factor = check_range("spheres_50k.intensity", intensity, 0.0, 1e6)
    shadow = check_choice("spheres_50k.casts_shadow", casts_shadow, (False, True))
    scene = Scene("spheres_50k")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.040, 0.044, 0.060), background=(0.006, 0.007, 0.011))
    scene.cameras.append(Camera.look_at((1.6, 6.6, 10.2), (0.0, 0.25, -0.15), vertical_fov_deg=38.0, exposure=0.2))
    slate = Material(base_color=(0.26, 0.26, 0.28, 1.0), roughness=0.45, name="slate")
    scene.add(plane(80.0, 80.0, columns=16, rows=10).mesh("floor"), material=slate)
    pearl = Material(base_color=(0.92, 0.90, 0.87, 1.0), roughness=0.26, name="pearl")
    scene.add(sphere(PEARL, 96, 48).mesh("pearl"), transform=translation(0.0, PEARL, 0.0), material=pearl, label=1)
    finishes = [Material(base_color=(*c, 1.0), metallic=m, roughness=r) for c, m, r in FINISHES]
    ball = sphere(1.0, 24, 12).mesh("ball")
    for k, matrix in enumerate(_balls(0.0)):
        scene.add(ball, transform=matrix, material=finishes[k % len(finishes)], label=2)
    fields = {
        "color": np.array([lamp[0] for lamp in LAMPS]),
        "casts_shadow": np.full(4, bool(shadow)),
        "source_radius": np.full(4, 0.06),
    }
    if kind == "point":
        scene.lights.extend("point", 4, **fields, intensity=np.full(4, 30.0 * factor), range=np.full(4, 14.0))
    else:
        scene.lights.extend(
            "spot", 4, **fields, intensity=np.full(4, 230.0 * factor), range=np.full(4, 26.0),
            inner_angle=np.full(4, 0.24), outer_angle=np.full(4, 0.46),
        )  # fmt: skip
    animate(scene, 0.0)
    return scene


def animate(scene: Scene, time: float) -> None:
    """Send the wave through the balls and turn the lights around the pearl.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene was not made by `build`.
    """
    groups = [group for _, group in scene.lights.groups() if len(group)]
    if scene.name != "spheres_50k" or len(groups) != 1 or len(groups[0]) != 4:
        raise input_error("spheres_50k.animate.scene", "a scene made by spheres_50k.build", repr(scene))
    time = check_range("spheres_50k.animate.time", time, -1e9, 1e9, unit="s")
    turn = np.array([lamp[1] for lamp in LAMPS]) + 2.0 * np.pi * time / PERIOD
    away, height = np.array([lamp[2] for lamp in LAMPS]), np.array([lamp[3] for lamp in LAMPS])
    if groups[0] is scene.lights.spot:
        away, height = away * 1.5, height * 2.3
    place = np.stack([away * np.cos(turn), height, away * np.sin(turn)], -1)
    groups[0].position = place
    if groups[0] is scene.lights.spot:
        # Each aims past the pearl, so that the four pools of light lie apart and share their rims.
        aim = np.stack([-2.4 * np.sin(turn), np.full(4, 0.3), 2.4 * np.cos(turn)], -1)
        groups[0].direction = aim - place
    balls = iter(_balls(time))
    for instance in scene.instances:
        if instance.mesh.name == "ball":
            instance.transform = next(balls)
