"""A row of things that recedes through the plane in focus; two red-capped posts stand in that plane.

Bulbs far behind show the shape of the lens opening, a rail close to the lens what blur before the plane does.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_range
from warp_deferred.lights import DirectionalLight, PointLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from ._furnishings import pedestal, urn
from .shapes import bevelled_box, plane, sphere, torus, translation

__all__ = ["PERIOD", "animate", "build"]

#: Time after which the focus has come back [s].
PERIOD = 8.0
EYE, TARGET = (0.0, 1.05, 5.0), (0.0, 0.80, -2.0)
#: The posts, x and z [m]; the plane in focus goes through the middle between them.
POSTS = ((-1.55, 0.0), (1.55, 0.0))
#: Nearest and farthest depth that `animate` focuses on [m].
SWEEP = (2.4, 11.0)
COLORS = ((0.62, 0.17, 0.11), (0.75, 0.48, 0.13), (0.16, 0.38, 0.24), (0.12, 0.28, 0.50), (0.48, 0.20, 0.40))
BULBS = ((1.0, 0.62, 0.28), (1.0, 0.80, 0.55), (0.95, 0.36, 0.20), (0.45, 0.70, 1.0), (0.65, 1.0, 0.60))


def depth_of(x: float, y: float, z: float) -> float:
    """View depth of a point before the scene's camera [m]."""
    forward = np.subtract(TARGET, EYE)
    return float((np.array([x, y, z]) - EYE) @ forward / np.linalg.norm(forward))


def build(*, aperture: float = 0.12) -> Scene:
    """Build the row.

    Args:
        aperture: Diameter of the camera's lens opening [m]; 0 shows everything sharp.
    """
    aperture = check_range("focus.aperture", aperture, 0.0, 1.0, unit="m")
    scene = Scene("focus")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.055, 0.062, 0.085), background=(0.008, 0.011, 0.022))
    table = Material(base_color=(0.20, 0.15, 0.12, 1.0), roughness=0.34, name="table")
    scene.add(plane(60.0, 60.0).mesh("table"), material=table, label=1)
    _add_row(scene)
    _add_posts(scene)
    _add_bulbs(scene)
    scene.lights.add(
        DirectionalLight(direction=(-0.55, -0.9, -0.62), color=(1.0, 0.93, 0.82), intensity=2.1),
        PointLight(position=(-2.6, 2.6, 2.8), color=(1.0, 0.72, 0.46), intensity=16.0, range=12.0),
        PointLight(position=(3.0, 2.2, -4.5), color=(0.45, 0.62, 1.0), intensity=30.0, range=14.0),
    )
    lens = {"aperture": aperture, "focus_distance": depth_of(0.0, 0.9, 0.0)}
    scene.cameras.append(Camera.look_at(EYE, TARGET, vertical_fov_deg=40.0, **lens))
    return scene


def _add_row(scene: Scene) -> None:
    """Urns, balls and rings in turn along a diagonal, farther apart the farther away."""
    base, vase = pedestal(0.42, 0.44).mesh("pedestal"), urn().mesh("urn")
    ball, ring = sphere(0.34, 64, 32).mesh("ball"), torus(0.30, 0.085, 64, 20).mesh("ring")
    marble = Material(base_color=(0.62, 0.58, 0.53, 1.0), roughness=0.42, name="marble")
    for k in range(9):
        share = k / 8.0
        z = 2.15 - 13.0 * share**1.25
        x = (2.6 * share - 0.82) * (1.0 - 0.02 * z)
        color = (*COLORS[k % len(COLORS)], 1.0)
        glaze = Material(base_color=color, roughness=0.16 + 0.09 * (k % 4), metallic=float(k % 3 == 2), name="glaze")
        if k % 3 == 0:
            scene.add(vase, transform=translation(x, 0.0, z, turn=0.5 + k, scale=0.82), material=glaze, label=2)
            continue
        scene.add(base, transform=translation(x, 0.0, z, turn=0.3 * k), material=marble, label=3)
        place = translation(x, 0.76, z, turn=0.4 * k)
        if k % 3 == 2:
            # Rings stand upright.
            place = place @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0.02], [0, 0, 0, 1.0]])
        scene.add(ball if k % 3 == 1 else ring, transform=place, material=glaze, label=4)
    rail = Material(base_color=(0.10, 0.30, 0.34, 1.0), roughness=0.3, name="rail")
    scene.add(
        bevelled_box(0.10, 0.62, 0.10, 0.02).mesh("rail"),
        transform=translation(0.62, 0.42, 3.1),
        material=rail,
        label=5,
    )


def _add_posts(scene: Scene) -> None:
    """Boxes that mark the plane in focus, with fine stripes to see how sharp they are."""
    post, band = bevelled_box(0.20, 1.30, 0.20, 0.015), bevelled_box(0.212, 0.045, 0.212, 0.01)
    white = Material(base_color=(0.82, 0.80, 0.76, 1.0), roughness=0.5, name="post")
    red = Material(base_color=(0.72, 0.05, 0.04, 1.0), roughness=0.4, name="band")
    post_mesh, band_mesh = post.mesh("post"), band.mesh("band")
    for x, z in POSTS:
        scene.add(post_mesh, transform=translation(x, 0.0, z), material=white, label=6)
        for k in range(14):
            scene.add(band_mesh, transform=translation(x, 0.03 + 0.092 * k, z), material=red, label=6)


def _add_bulbs(scene: Scene) -> None:
    """Small bright balls far away: each becomes a disc as wide as its circle of confusion."""
    rng = np.random.default_rng(5)
    mesh = sphere(0.05, 16, 8).mesh("bulb")
    glows = [
        Material(base_color=(0.0, 0.0, 0.0, 1.0), emissive=tuple(22.0 * c for c in color), roughness=1.0, name="bulb")
        for color in BULBS
    ]
    for k in range(46):
        x, y, z = rng.uniform(-6.5, 6.5), rng.uniform(0.5, 3.6), rng.uniform(-14.0, -10.0)
        scene.add(mesh, transform=translation(x, y, z), material=glows[k % len(glows)], label=7)


def animate(scene: Scene, time: float) -> None:
    """Pull the focus from where `build` left it to the nearest thing, to the farthest, and back.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.
    """
    start = depth_of(0.0, 0.9, 0.0)
    wave = math.sin(2.0 * math.pi * time / PERIOD)
    # Equal steps of 1/z blur equally fast.
    end = SWEEP[0] if wave > 0.0 else SWEEP[1]
    focus = 1.0 / (1.0 / start + abs(wave) * (1.0 / end - 1.0 / start))
    scene.camera = (scene.camera or scene.cameras[0]).replace(focus_distance=focus)
