"""Five spotlights, each of which lights every pixel: rings of ripples that cross on a sheet of lacquer.

For 600 x 600 pixels. The cones are wider than the square picture and the ripples flatter than the lowest light, so that
the output `light_count` is 5 everywhere: no tile can leave a light out, and the frame costs what its lights cost.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_choice, check_range, input_error
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from .shapes import Shape, surface

__all__ = ["PERIOD", "animate", "build"]

PERIOD = 15.0
"""Time in which the lights go round once [s]."""
WIDTH, HEIGHT, CELL = 7.4, 4.4, 0.015
"""Size of the sheet and of its cells [m]."""
WAVE = 0.34
"""Length of the ripples [m]."""
STEEPEST = 0.55
"""Bound on the slope of the sheet; the lowest light stands 33 degrees, a slope of 0.65, over its farthest pixel."""
#: Middles of the rings [m].
MIDDLES = np.array([[0.62, 0.20], [-0.34, 0.78], [-0.92, -0.42], [0.26, -0.94], [1.55, 1.30]])
#: Colours of the spotlights, linear.
COLORS = np.array([[1.0, 0.52, 0.20], [0.95, 0.20, 0.34], [0.42, 0.30, 1.0], [0.12, 0.62, 1.0], [0.45, 0.95, 0.62]])
AWAY, ABOVE = 2.6, 3.4
"""Distance of the spotlights from the axis and from the sheet [m]."""


def _sheet() -> Shape:
    """The sheet z = sum of ripples around the middles, facing +z."""
    x, y = (0.5 * size * np.linspace(-1.0, 1.0, round(size / CELL) + 1) for size in (WIDTH, HEIGHT))
    xs, ys = np.meshgrid(x, y)
    height, slope_x, slope_y = np.zeros_like(xs), np.zeros_like(xs), np.zeros_like(xs)
    wave_number = 2.0 * math.pi / WAVE
    # The slopes of all rings add up to the bound at most.
    rise = STEEPEST / (wave_number * len(MIDDLES))
    for middle in MIDDLES:
        dx, dy = xs - middle[0], ys - middle[1]
        away = np.maximum(np.hypot(dx, dy), 1e-9)
        height += rise * np.cos(wave_number * away)
        slope = -rise * wave_number * np.sin(wave_number * away) / away
        slope_x += slope * dx
        slope_y += slope * dy
    return surface(np.stack([xs, ys, height], -1), np.stack([-slope_x, -slope_y, np.ones_like(xs)], -1))


def build(*, intensity: float = 1.0, casts_shadow: bool = False) -> Scene:
    """Build the sheet and its five spotlights.

    Args:
        intensity: Factor on the lights.
        casts_shadow: Whether they call for shadows, of which the flat ripples throw none: what a look-up costs.
    """
    factor = check_range("fullscreen_spots.intensity", intensity, 0.0, 1e6)
    shadow = check_choice("fullscreen_spots.casts_shadow", casts_shadow, (False, True))
    scene = Scene("fullscreen_spots")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.012, 0.012, 0.016), background=(0.0, 0.0, 0.0))
    scene.cameras.append(Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), vertical_fov_deg=40.0))
    lacquer = Material(base_color=(0.10, 0.095, 0.105, 1.0), roughness=0.24, name="lacquer")
    scene.add(_sheet().mesh("sheet"), material=lacquer)
    scene.lights.extend(
        "spot", 5, color=COLORS, intensity=np.full(5, 30.0 * factor), range=np.full(5, 14.0),
        inner_angle=np.full(5, 0.2), outer_angle=np.full(5, 1.0), source_radius=np.full(5, 0.05),
        casts_shadow=np.full(5, bool(shadow)),
    )  # fmt: skip
    animate(scene, 0.0)
    return scene


def animate(scene: Scene, time: float) -> None:
    """Let the spotlights go round.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene was not made by `build`.
    """
    if scene.name != "fullscreen_spots" or len(scene.lights.spot) != 5:
        raise input_error("fullscreen_spots.animate.scene", "a scene made by fullscreen_spots.build", repr(scene))
    time = check_range("fullscreen_spots.animate.time", time, -1e9, 1e9, unit="s")
    turn = 2.0 * np.pi * (np.arange(5) / 5.0 + time / PERIOD) + 0.5
    place = np.stack([AWAY * np.cos(turn), AWAY * np.sin(turn), np.full(5, ABOVE)], -1)
    scene.lights.spot.position = place
    scene.lights.spot.direction = -place
