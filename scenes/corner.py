"""A wooden figure, crates, a vase and marbles in the corner of a room: even light that nooks and contacts lose.

Nearly all light is ambient, so without ambient visibility the picture falls flat; with it feet stand on the floor,
boards part and folds darken. It has what the effect finds easy (creases), hard (thin rings and rails, a sphere that
touches) and impossible from depth alone (the gap behind the crates). Metres; about 40,000 triangles.
"""

from __future__ import annotations

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range
from warp_deferred.lights import DirectionalLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from ._furnishings import urn
from .shapes import Shape, bevelled_box, box, join, lathe, plane, sphere, torus

__all__ = ["build"]

#: Joints of the figure [m]: it sits on the low crate, leans on its left hand and looks up.
PELVIS, CHEST, NECK, HEAD = (0.0, 0.62, 0.0), (0.0, 0.98, -0.05), (0.0, 1.18, -0.04), (0.0, 1.33, 0.0)
LIMBS = (
    # From, to, radius at either end.
    ((0.17, 1.08, -0.04), (0.30, 0.84, -0.10), 0.050, 0.040),
    ((0.30, 0.84, -0.10), (0.30, 0.60, -0.02), 0.040, 0.030),
    ((-0.17, 1.08, -0.04), (-0.27, 0.86, 0.10), 0.050, 0.040),
    ((-0.27, 0.86, 0.10), (-0.12, 0.72, 0.30), 0.040, 0.030),
    ((0.10, 0.60, 0.02), (0.13, 0.62, 0.42), 0.075, 0.055),
    ((0.13, 0.62, 0.42), (0.13, 0.12, 0.40), 0.055, 0.040),
    ((-0.10, 0.60, 0.02), (-0.14, 0.58, 0.42), 0.075, 0.055),
    ((-0.14, 0.58, 0.42), (-0.20, 0.12, 0.55), 0.055, 0.040),
)


def _between(a: tuple[float, ...], b: tuple[float, ...], first: float, last: float) -> Shape:
    """Tapering limb with round ends from a to b."""
    start, along = np.array(a), np.subtract(b, a)
    length = float(np.linalg.norm(along))
    t = np.linspace(0.0, np.pi / 2, 8)
    low = [(first * np.sin(u), -first * np.cos(u)) for u in t]
    high = [(last * np.cos(u), length + last * np.sin(u)) for u in t]
    up = along / length
    side = np.cross(up, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([np.cross(up, side), up, side])
    matrix[:3, 3] = start
    return lathe(low + high, 24).moved(matrix)


def _ball(centre: tuple[float, ...], x: float, y: float, z: float) -> Shape:
    """Ellipsoid of these half axes."""
    matrix = np.diag([x, y, z, 1.0])
    matrix[:3, 3] = centre
    return sphere(1.0, 32, 20).moved(matrix)


def _figure() -> Shape:
    """Sitting figure of wooden parts; its origin lies on the floor under the pelvis, it faces +z."""
    parts = [
        _ball(PELVIS, 0.17, 0.11, 0.13),
        _ball(CHEST, 0.18, 0.19, 0.12),
        _ball((0.0, 0.79, -0.02), 0.12, 0.10, 0.09),
    ]
    parts += [_between(CHEST, NECK, 0.05, 0.045), _ball(HEAD, 0.095, 0.125, 0.11)]
    for a, b, first, last in LIMBS:
        parts += [_between(a, b, first, last), _ball(b, last * 1.25, last * 1.25, last * 1.25)]
    parts += [_ball((0.13, 0.04, 0.46), 0.05, 0.04, 0.12), _ball((-0.20, 0.04, 0.61), 0.05, 0.04, 0.12)]
    return join(*parts)


def _crate(size: float, height: float) -> Shape:
    """Crate of boards with gaps between them."""
    boards = []
    for k in range(3):
        y, thick = height * (k + 0.06) / 3.0, height * 0.88 / 3.0
        for side in (-1.0, 1.0):
            boards.append(bevelled_box(size, thick, 0.03, 0.006).at(0.0, y, side * (size - 0.03) / 2))
            boards.append(bevelled_box(0.03, thick, size - 0.06, 0.006).at(side * (size - 0.03) / 2, y, 0.0))
    inner = (size - 0.11) / 2
    posts = [
        bevelled_box(0.05, height, 0.05, 0.006).at(x * inner, 0.0, z * inner) for x in (-1.0, 1.0) for z in (-1.0, 1.0)
    ]
    lid = [bevelled_box(size, 0.025, size / 5 - 0.012, 0.006).at(0.0, height, size * (k - 2) / 5) for k in range(5)]
    return join(*boards, *posts, *lid)


def _room() -> list[tuple[str, Shape]]:
    """Floor, two walls that meet at the origin, their skirting and a shelf."""
    wall = plane(6.0, 4.0, columns=12, rows=8)
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 2.0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    back = wall.moved(turn).at(3.0, 0.0, 0.0)
    left = wall.moved(turn).at(0.0, 0.0, 3.0, turn=np.pi / 2)
    skirting = join(
        bevelled_box(6.0, 0.14, 0.03, 0.012).at(3.0, 0.0, 0.015),
        bevelled_box(0.03, 0.14, 6.0, 0.012).at(0.015, 0.0, 3.0),
    )
    shelf = join(
        bevelled_box(1.3, 0.04, 0.30, 0.008).at(1.55, 1.62, 0.15),
        *(bevelled_box(0.04, 0.20, 0.22, 0.008).at(x, 1.42, 0.11) for x in (1.1, 2.0)),
    )
    books = [
        box(0.05 + 0.02 * (k % 3), 0.26 - 0.03 * (k * 7 % 4), 0.18).at(1.12 + 0.075 * k, 1.66, 0.12) for k in range(8)
    ]
    return [
        ("floor", plane(6.0, 6.0).at(3.0, 0.0, 3.0)),
        ("walls", join(back, left)),
        ("trim", join(skirting, shelf, *books)),
    ]


def build(*, ambient: float = 0.62, marbles: int = 24, seed: int = 3) -> Scene:
    """Build the corner.

    Args:
        ambient: Ambient radiance.
        marbles: Marbles on the floor.
        seed: Where they lie.
    """
    level = check_range("corner.ambient", ambient, 0.0, 100.0)
    count = check_count("corner.marbles", marbles, 0, 1000)
    rng = np.random.default_rng(check_count("corner.seed", seed, 0, 2**32 - 1))
    scene = Scene("corner")
    clay = {"floor": (0.50, 0.36, 0.26), "walls": (0.80, 0.74, 0.64), "trim": (0.82, 0.80, 0.77)}
    for name, shape in _room():
        scene.add(shape.mesh(name), material=Material(model="lambert", base_color=(*clay[name], 1.0), name=name))
    wood = Material(model="lambert", base_color=(0.80, 0.60, 0.40, 1.0), name="wood")
    pine = Material(model="lambert", base_color=(0.72, 0.62, 0.48, 1.0), name="pine")
    glaze = Material(model="lambert", base_color=(0.45, 0.60, 0.66, 1.0), name="glaze")
    red = Material(model="lambert", base_color=(0.74, 0.30, 0.24, 1.0), name="red")
    scene.add(_figure().at(1.02, 0.0, 0.95, turn=0.75).mesh("figure"), material=wood)
    scene.add(_crate(0.55, 0.47).at(1.0, 0.0, 0.92, turn=0.75).mesh("seat"), material=pine)
    scene.add(_crate(0.50, 0.42).at(0.42, 0.0, 0.42, turn=0.08).mesh("crate"), material=pine)
    scene.add(_crate(0.36, 0.32).at(0.40, 0.445, 0.40, turn=-0.35).mesh("crate"), material=pine)
    scene.add(urn().at(1.85, 0.0, 0.42, scale=0.8).mesh("urn"), material=glaze)
    hoop = torus(0.34, 0.018, 64, 12)
    lean = np.array([[1.0, 0, 0, 2.5], [0, 0.28, -0.96, 0.36], [0, 0.96, 0.28, 0.12], [0, 0, 0, 1.0]])
    scene.add(hoop.moved(lean).mesh("hoop"), material=red)
    scene.add(sphere(0.17, 48, 24).at(0.55, 0.17, 1.75).mesh("ball"), material=red)
    marble = sphere(0.035, 24, 12).mesh("marble")
    for _ in range(count):
        x, z = rng.uniform(0.6, 2.6), rng.uniform(1.3, 2.4)
        tint = Material(model="lambert", base_color=(*rng.uniform(0.35, 0.85, 3), 1.0), name="marble")
        place = np.eye(4)
        place[:3, 3] = x, 0.035, z
        scene.add(marble, transform=place, material=tint)
    scene.lights.add(DirectionalLight(direction=(-0.5, -1.0, -0.75), color=(1.0, 0.94, 0.84), intensity=0.25))
    scene.environment = Environment(ambient=(level, level, 1.03 * level), background=(0.5, 0.55, 0.6))
    scene.camera = Camera.look_at((3.35, 1.75, 3.75), (0.95, 0.68, 0.75), vertical_fov_deg=36.0)
    return scene
