"""A colonnade at night that is lit by its own neon: rings, tubes and an ember, seen through a lens that scatters.

Everything bright is an emissive mesh well above white on a dark, glossy court, so that `bloom` has something to
spread: thin tubes, wide rings, a ball, and sparks of a few pixels. Point lights of the same colours stand beside all
but the sparks, since emission alone lights nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range
from warp_deferred.lights import PointLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from ._furnishings import armillary_rings, pedestal, urn
from .shapes import Shape, bevelled_box, column, join, lathe, sphere, torus, translation

__all__ = ["build"]

Color = tuple[float, float, float]
ROSE, VIOLET, AZURE, TEAL, AMBER = (
    (1.0, 0.10, 0.38), (0.50, 0.14, 1.0), (0.07, 0.36, 1.0), (0.05, 0.85, 0.80), (1.0, 0.42, 0.08),
)  # fmt: skip
WALL = -9.0
"""Where the wall behind the rings stands, along z [m]."""
HEART = (0.0, 2.45, WALL + 2.2)
"""Middle of the rings and of the ember before them [m]."""
ROWS = np.linspace(0.6, WALL + 1.6, 5)
"""Where the columns stand along z [m]."""
AISLE = 3.1
"""Distance of the columns from the middle [m]."""
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""Turns a ring about y into one that faces along z."""


def _tube(length: float, radius: float = 0.028) -> Shape:
    """Upright glass tube with round ends, on y = 0."""
    bow = [(radius * math.sin(a), -radius * math.cos(a)) for a in np.linspace(0.0, math.pi / 2, 6)]
    profile = [(r, y + radius) for r, y in bow] + [(r, length - radius - y) for r, y in reversed(bow)]
    profile[0] = (0.0, 0.0)
    profile[-1] = (0.0, length)
    return lathe(profile, 16)


def _neon(color: Color, power: float) -> Material:
    return Material(
        base_color=(0.02, 0.02, 0.02, 1.0), emissive=tuple(power * c for c in color), roughness=0.3, name="neon"
    )


def _court(rng: np.random.Generator) -> Shape:
    """Slabs of dark stone, each of its own shade and a hair's breadth off level."""
    slabs = []
    for i in range(-6, 6):
        for j in range(-9, 5):
            shade = rng.uniform(0.7, 1.0) * np.array([1.0, 0.97, 1.04])
            slab = bevelled_box(1.19, 0.2, 1.19, 0.015).tinted(np.minimum(shade, 1.0))
            slabs.append(slab.at(1.2 * (i + 0.5), -0.2 - rng.uniform(0.0, 0.006), 1.2 * (j + 0.5)))
    return join(*slabs)


def _wall(rng: np.random.Generator) -> Shape:
    """Courses of large blocks behind the rings."""
    blocks = []
    for row in range(8):
        for k in range(-5, 6):
            block = bevelled_box(1.58, 0.78, 0.4, 0.03).tinted(rng.uniform(0.75, 1.0) * np.ones(3))
            blocks.append(block.at(1.6 * k + 0.8 * (row % 2), 0.8 * row, WALL - 0.2 - rng.uniform(0.0, 0.03)))
    return join(*blocks)


def _add_light(scene: Scene, place: Sequence[float], color: Color, intensity: float, reach: float) -> None:
    scene.lights.add(
        PointLight(position=tuple(place), color=color, intensity=intensity, range=reach, source_radius=0.06)
    )


def _add_rings(scene: Scene, brightness: float) -> None:
    """Three rings before the wall, with lights all around between them and the wall."""
    middle = np.array([HEART[0], HEART[1], WALL + 0.45])
    place = translation(*middle) @ UPRIGHT
    for radius, tube, color, power in ((2.25, 0.035, ROSE, 9.0), (1.92, 0.022, VIOLET, 8.0), (1.55, 0.03, AZURE, 9.0)):
        scene.add(torus(radius, tube, 128, 12).mesh("ring"), transform=place, material=_neon(color, power * brightness))
    for k in range(16):
        turn = 2.0 * math.pi * k / 16
        for radius, color, power in ((2.25, ROSE, 1.3), (1.55, AZURE, 0.9)):
            at = middle + np.array([radius * math.cos(turn), radius * math.sin(turn), -0.1])
            if at[1] > 0.1:
                _add_light(scene, at, color, power * brightness, 3.2)


def _add_columns(scene: Scene, brightness: float) -> None:
    """Columns with a tube each on the side of the court, warm in front and cold behind."""
    stone = Material(base_color=(0.34, 0.33, 0.36, 1.0), roughness=0.42, name="basalt")
    shaft, tube = column(4.4, 0.34).mesh("column"), _tube(2.6).mesh("tube")
    for k, z in enumerate(ROWS):
        for side in (-1.0, 1.0):
            color = (AMBER, ROSE, VIOLET, AZURE, TEAL)[k] if side < 0.0 else (ROSE, VIOLET, AZURE, TEAL, TEAL)[k]
            scene.add(shaft, transform=translation(side * AISLE, 0.0, z), material=stone, label=2)
            x = side * (AISLE - 0.47)
            scene.add(tube, transform=translation(x, 0.7, z + 0.1), material=_neon(color, 7.0 * brightness), label=8)
            for height in (0.95, 2.0, 3.05):
                _add_light(scene, (x - side * 0.16, height, z + 0.16), color, 1.5 * brightness, 4.2)


def _add_ember(scene: Scene, brightness: float) -> None:
    """A ball as bright as a flame inside turning rings of brass, on a pedestal before the neon rings."""
    brass = Material(base_color=(0.95, 0.66, 0.32, 1.0), metallic=1.0, roughness=0.32, name="brass")
    stone = Material(base_color=(0.24, 0.23, 0.25, 1.0), roughness=0.35, name="pedestal")
    *rings, stand = armillary_rings(1.05)
    for k, shape in enumerate(rings):
        scene.add(shape.mesh("rings"), transform=translation(*HEART, turn=0.5 + 0.7 * k), material=brass, label=5)
    scene.add(stand.mesh("stand"), transform=translation(*HEART), material=brass, label=5)
    top = float(stand.positions[:, 1].min()) + HEART[1]
    scene.add(pedestal(top, 0.85).mesh("pedestal"), transform=translation(0.0, 0.0, HEART[2]), material=stone, label=3)
    ball = sphere(0.2, 48, 24).mesh("ember")
    scene.add(ball, transform=translation(*HEART), material=_neon(AMBER, 24.0 * brightness), label=8)
    _add_light(scene, HEART, AMBER, 9.0 * brightness, 7.0)


def _add_details(scene: Scene, rng: np.random.Generator, brightness: float) -> None:
    """Urns between the columns, strips of light along the court, and sparks drifting over it."""
    glaze = Material(base_color=(0.10, 0.11, 0.14, 1.0), roughness=0.16, name="glaze")
    vase, base = urn().mesh("urn"), pedestal(0.5, 0.6).mesh("base")
    for k, z in enumerate(0.5 * (ROWS[1:] + ROWS[:-1])):
        for side in (-1.0, 1.0):
            at = side * (AISLE + 0.1)
            scene.add(base, transform=translation(at, 0.0, z), material=glaze, label=3)
            scene.add(vase, transform=translation(at, 0.5, z, turn=0.8 * k, scale=0.9), material=glaze, label=4)
    strip = bevelled_box(0.05, 0.05, 9.6, 0.012).mesh("strip")
    for side, color in ((-1.0, TEAL), (1.0, VIOLET)):
        place = translation(side * 1.45, 0.0, 0.5 * (ROWS[0] + ROWS[-1]))
        scene.add(strip, transform=place, material=_neon(color, 4.0 * brightness), label=8)
        for z in np.linspace(ROWS[0] + 0.6, ROWS[-1] - 0.6, 9):
            _add_light(scene, (side * 1.45, 0.22, z), color, 0.35 * brightness, 2.2)
    spark = sphere(0.018, 12, 6).mesh("spark")
    for _ in range(60):
        at = rng.uniform((-2.6, 0.4, WALL + 1.0), (2.6, 4.2, 0.5))
        color = (AMBER, ROSE, TEAL, AMBER)[rng.integers(4)]
        scene.add(spark, transform=translation(*at), material=_neon(color, 30.0 * brightness), label=8)


def build(*, brightness: float = 1.0, bloom: float = 0.3, seed: int = 4) -> Scene:
    """Build the court.

    Args:
        brightness: Factor on all emission and on the lights that go with it.
        bloom: Share of light the camera's lens scatters.
        seed: Of slabs, blocks and sparks.
    """
    brightness = check_range("glow.brightness", brightness, 0.0, 1e3)
    bloom = check_range("glow.bloom", bloom, 0.0, 1.0)
    rng = np.random.default_rng(check_count("glow.seed", seed, 0, 2**63 - 1))
    scene = Scene("glow")
    scene.environment = Environment(ambient=(0.010, 0.011, 0.020), background=(0.0015, 0.002, 0.005))
    scene.cameras.append(Camera.look_at((0.55, 1.55, 5.2), (0.0, 2.05, WALL), vertical_fov_deg=42.0, bloom=bloom))
    scene.add(_court(rng).mesh("court"), material=Material(base_color=(0.10, 0.10, 0.11, 1.0), roughness=0.2), label=1)
    scene.add(_wall(rng).mesh("wall"), material=Material(base_color=(0.30, 0.29, 0.31, 1.0), roughness=0.6), label=1)
    _add_rings(scene, brightness)
    _add_columns(scene, brightness)
    _add_ember(scene, brightness)
    _add_details(scene, rng, brightness)
    return scene
