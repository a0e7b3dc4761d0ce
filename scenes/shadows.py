"""A courtyard at dusk under one shadowed light of each kind: a low sun, a caged lantern and a spotlight.

The sun comes over the left arcade and draws its columns and arches on the paving. A lantern hangs in the dark corner
and throws the bars of its cage on both walls. A cold spotlight stands for the moon: it shines from above through the
rings of an armillary sphere, whose shadow lies sharp near its foot and soft on the wall behind.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_range, input_error
from warp_deferred.lights import DirectionalLight, PointLight, SpotLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from ._furnishings import armillary_rings, lantern, pedestal, urn
from .shapes import Shape, arch, bevelled_box, column, join, lathe, sphere, translation

__all__ = ["PERIOD", "animate", "build"]

PERIOD = 16.0
"""Time after which everything is back where it was [s]."""
WALL, SIDE, ARCADE = -3.6, 4.2, -3.4
"""Back wall's z, right wall's x and the arcade's x [m]."""
BAY, COLUMN, SHAFT, RISE = 2.0, 2.3, 0.17, 3.4
HEART = np.array([0.35, 1.78, -1.75])
"""Middle of the armillary sphere."""
HOOK = np.array([2.75, 3.75, -2.2])
"""Where the lantern's chain is fixed; it hangs CHAIN below."""
CHAIN = 1.9
SUN = np.array([1.0, -0.62, -0.42])
MOON = np.array([-1.9, 5.2, 2.6])


def _paving(rng: np.random.Generator) -> Shape:
    """Slabs of bevelled stone in running bond, each with its own shade and height."""
    slabs = []
    for row, z in enumerate(np.arange(-3.2, 6.0, 0.8)):
        for x in np.arange(-4.4 + 0.6 * (row % 2), 5.0, 1.2):
            shade = rng.uniform(0.78, 1.0) * np.array([1.0, 0.985, 0.96])
            slab = bevelled_box(1.19, 0.12, 0.79, 0.012).at(x, -0.12 + rng.uniform(-0.004, 0.004), z)
            slabs.append(slab.tinted(shade))
    return join(*slabs)


def _arcade() -> Shape:
    """Columns along the left side with an arch between each two, and the wall that they carry."""
    pieces = []
    for k in range(5):
        z = WALL + 0.35 + BAY * k
        pieces.append(column(COLUMN, SHAFT, flutes=16, segments=64).at(ARCADE, 0.0, z))
        if k < 4:
            span = BAY - 2.0 * SHAFT - 0.1
            pieces.append(arch(span, BAY, RISE, 0.4).at(ARCADE, COLUMN, z + 0.5 * BAY, turn=0.5 * np.pi))
    pieces.append(bevelled_box(0.62, 0.16, 4.0 * BAY + 0.6, 0.03).at(ARCADE, COLUMN + RISE, WALL + 0.35 + 2.0 * BAY))
    return join(*pieces)


def _walls(rng: np.random.Generator) -> Shape:
    """Courses of hewn blocks behind and to the right, each a little proud of its neighbours, under a coping."""
    blocks = []
    for row in range(8):
        y, offset = 0.46 * row, 0.5 * (row % 2)
        for x in np.arange(ARCADE - 0.6 + offset, SIDE + 0.6, 1.0):
            shade = rng.uniform(0.8, 1.0)
            blocks.append(
                bevelled_box(0.995, 0.455, 0.5, 0.018).at(x, y, WALL - 0.25 + rng.uniform(0, 0.012)).tinted([shade] * 3)
            )
        for z in np.arange(WALL + offset, 3.0, 1.0):
            shade = rng.uniform(0.8, 1.0)
            blocks.append(
                bevelled_box(0.5, 0.455, 0.995, 0.018).at(SIDE + 0.25 - rng.uniform(0, 0.012), y, z).tinted([shade] * 3)
            )
    blocks.append(bevelled_box(9.4, 0.14, 0.7, 0.03).at(0.4, 3.68, WALL - 0.2))
    blocks.append(bevelled_box(0.7, 0.14, 7.4, 0.03).at(SIDE + 0.2, 3.68, -0.4))
    return join(*blocks)


def _cage() -> Shape:
    """The lantern of the hall, its cage widened so that the lamp in it is seen past bars on every side."""
    hoop = lathe([(0.128, -0.012), (0.150, -0.012), (0.150, 0.012), (0.128, 0.012), (0.128, -0.012)], 48)
    bars = [bevelled_box(0.012, 0.31, 0.012, 0.003).at(0.14 * math.cos(a), -0.145, 0.14 * math.sin(a), turn=-a)
            for a in np.arange(8) * 0.25 * np.pi]  # fmt: skip
    return join(lantern(CHAIN), hoop.at(0.0, 0.02, 0.0), *bars)


def build(*, sun: float = 1.0, lamp: float = 1.0, moon: float = 1.0) -> Scene:
    """Build the courtyard.

    Args:
        sun: Factor on the directional light.
        lamp: Factor on the point light in the lantern.
        moon: Factor on the spotlight.
    """
    factors = [check_range(f"shadows.{n}", v, 0.0, 1e6) for n, v in (("sun", sun), ("lamp", lamp), ("moon", moon))]
    rng = np.random.default_rng(11)
    scene = Scene("shadows")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.030, 0.034, 0.052), background=(0.055, 0.060, 0.105))
    scene.cameras.append(
        Camera.look_at((-0.55, 2.25, 6.1), (0.25, 1.42, -1.6), vertical_fov_deg=41.0, exposure=0.35, name="gate")
    )
    stone = Material(base_color=(0.60, 0.53, 0.45, 1.0), roughness=0.75, name="sandstone")
    pale = Material(base_color=(0.66, 0.62, 0.56, 1.0), roughness=0.55, name="paving")
    gold = Material(base_color=(1.0, 0.76, 0.36, 1.0), metallic=0.55, roughness=0.34, name="gold")
    iron = Material(base_color=(0.10, 0.09, 0.08, 1.0), metallic=0.7, roughness=0.5, name="iron")
    glaze = Material(base_color=(0.07, 0.19, 0.24, 1.0), roughness=0.22, name="glaze")
    flame = Material(base_color=(0.0, 0.0, 0.0, 1.0), emissive=(6.0, 3.2, 1.1), roughness=1.0, name="flame")
    scene.add(_paving(rng).mesh("paving"), material=pale, label=1)
    for shape, name in ((_arcade(), "arcade"), (_walls(rng), "walls")):
        scene.add(shape.mesh(name), material=stone, label=2)
    *rings, stand = armillary_rings(0.62)
    for shape in rings:
        scene.add(shape.mesh("rings"), transform=translation(*HEART), material=gold, label=3)
    scene.add(stand.mesh("stand"), transform=translation(*HEART), material=gold, label=3)
    top = float(stand.positions[:, 1].min() + HEART[1])
    scene.add(pedestal(top, 0.72).mesh("pedestal"), transform=translation(HEART[0], 0.0, HEART[2]), material=stone)
    for x, z, turn in ((-1.7, -2.6, 0.4), (2.3, 0.9, 1.2)):
        scene.add(urn().mesh("urn"), transform=translation(x, 0.0, z, turn=turn), material=glaze, label=4)
    scene.add(_cage().mesh("lantern"), material=iron, label=5)
    scene.add(sphere(0.018, 16, 8).mesh("flame"), material=flame, label=5)
    scene.lights.add(
        PointLight(color=(1.0, 0.60, 0.25), intensity=7.0 * factors[1], range=9.0, source_radius=0.02,
                   casts_shadow=True, name="lantern"),
        SpotLight(position=tuple(MOON), direction=tuple(HEART - MOON), color=(0.55, 0.72, 1.0),
                  intensity=210.0 * factors[2], inner_angle=0.10, outer_angle=0.34, source_radius=0.09,
                  casts_shadow=True, name="moon"),
        DirectionalLight(color=(1.0, 0.62, 0.36), intensity=3.8 * factors[0], casts_shadow=True, name="sun"),
    )  # fmt: skip
    animate(scene, 0.0)
    return scene


def animate(scene: Scene, time: float) -> None:
    """Put sun, lantern, moon and rings where they are at a time.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene was not made by `build`.
    """
    if scene.name != "shadows" or len(scene.lights) != 3:
        raise input_error("shadows.animate.scene", "a scene made by shadows.build", repr(scene))
    time = check_range("shadows.animate.time", time, -1e9, 1e9, unit="s")
    beat = 2.0 * np.pi * time / PERIOD
    scene.lights.directional.direction = SUN[None] + [[0.0, 0.10 * math.sin(beat), 0.14 * math.sin(beat)]]
    moon = MOON + np.array([0.5 * math.sin(beat), 0.0, 0.0])
    scene.lights.spot.position = moon[None]
    scene.lights.spot.direction = (HEART - moon)[None]
    # A pendulum of CHAIN metres: it swings about its hook, body and flame as one.
    swing, turn = 0.14 * math.sin(4.0 * beat), 0.10 * math.sin(3.0 * beat)
    c, s = math.cos(swing), math.sin(swing)
    hang = np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    hang = translation(*HOOK) @ hang @ translation(0.0, -CHAIN, 0.0, turn=turn + 0.3)
    scene.lights.point.position = hang[None, :3, 3]
    turns = iter((1.0, -2.0, 3.0))
    for instance in scene.instances:
        if instance.mesh.name in ("lantern", "flame"):
            instance.transform = hang
        elif instance.mesh.name == "rings":
            instance.transform = translation(*HEART, turn=0.5 + beat * next(turns))
