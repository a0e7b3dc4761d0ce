"""A columned hall at night under 100 point and 98 spot lights, every one of them moving.

Amber lanterns sway in the arches, glowing motes drift along the nave, a golden armillary sphere turns in the apse at
the far end; the vault lies in cold light, which sets it back behind the warm floor. Nothing casts a shadow and nothing
mirrors: depth comes from pools of light, grazing light on the columns, and the change from warm to cold.
"""

from __future__ import annotations

import dataclasses
import math
import weakref

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range, input_error
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from . import _furnishings as furnishings
from . import _hall as hall
from .shapes import sphere, translation

__all__ = ["PERIOD", "animate", "build"]

PERIOD = 24.0
"""Time after which everything is back where it was [s]."""
AMBER, GOLD, EMBER = (1.0, 0.52, 0.17), (1.0, 0.72, 0.36), (1.0, 0.33, 0.08)
TEAL, BLUE, ROSE = (0.08, 0.62, 0.68), (0.16, 0.34, 1.0), (0.95, 0.18, 0.36)
_FIRST = 9.0
"""Moment of the cycle that time 0 shows [s]: rings turned half open, light well spread over the floor."""
HEART = np.array([0.0, 3.3, hall.END + 0.6])
"""Middle of the armillary sphere."""


@dataclasses.dataclass(frozen=True)
class _Motion:
    """Closed paths of all lights: place + sum over two harmonics of amplitude * sin(rate * time + phase)."""

    centre: np.ndarray
    amplitude: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    aim: np.ndarray
    sweep: np.ndarray
    sweep_rate: np.ndarray
    sweep_phase: np.ndarray


_motions: weakref.WeakKeyDictionary[Scene, _Motion] = weakref.WeakKeyDictionary()


def _point_rows(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Centre, amplitude [m], colour, intensity [cd], range [m] and size of the glowing ball [m] of each point light."""
    rows: list[tuple] = []
    z = hall.bay_centres()
    for depth in z:
        for side in (-1.0, 1.0):
            rows.append(((side * hall.NAVE, 4.05, depth), (0.10, 0.0, 0.14), AMBER, 7.0, 5.8, 0.085))
    for k, depth in enumerate(z):
        for side in (-1.0, 1.0):
            color = ROSE if (k, side) in ((1, -1.0), (3, 1.0), (5, -1.0)) else (TEAL, BLUE)[(k + int(side > 0)) % 2]
            rows.append(((side * 5.5, 2.4, depth), (0.35, 0.7, 0.9), color, 4.5, 5.4, 0.04))
    for k in range(12):
        depth = np.interp(k, [0, 11], [hall.FRONT - 2.0, hall.BACK])
        rows.append(((rng.uniform(-1.2, 1.2), 8.6, depth), (1.1, 0.5, 1.6), BLUE if k % 3 else TEAL, 5.0, 5.5, 0.04))
    for k in range(12):
        turn = 2.0 * np.pi * k / 12
        around = HEART + np.array([2.1 * math.cos(turn), rng.uniform(-1.2, 1.3), 0.9 * math.sin(turn)])
        rows.append((around, (0.5, 0.4, 0.3), (GOLD, AMBER, GOLD, ROSE)[k % 4], 1.2, 2.4, 0.04))
    rows[-1] = (HEART, (0.02, 0.04, 0.02), (1.0, 0.60, 0.22), 6.0, 3.4, 0.36)
    colors = [AMBER] * 9 + [GOLD] * 5 + [EMBER] * 3 + [TEAL] * 2 + [ROSE]
    for k in range(44):
        depth = np.interp(k + rng.uniform(-0.4, 0.4), [0, 43], [hall.FRONT - 5.5, hall.BACK + 1.0])
        place = (rng.uniform(-2.3, 2.3), rng.uniform(0.5, 3.0), depth)
        rows.append((place, (0.9, 0.4, 1.2), colors[rng.integers(len(colors))], rng.uniform(0.8, 1.6), 4.4, 0.026))
    names = ("centre", "amplitude", "color", "intensity", "range", "size")
    return {name: np.array([row[k] for row in rows], float) for k, name in enumerate(names)}


def _spot_rows() -> dict[str, np.ndarray]:
    """Place, aim, sweep [rad], colour, intensity [cd], range [m], inner and outer angle [degrees] of each spot."""
    rows: list[tuple] = []
    for x, _, z in hall.column_places():
        side = math.copysign(1.0, x)
        # One from the floor up along the shaft, one from the capital down to the foot, both on the side of the nave.
        rows.append(((x - side * 0.85, 0.1, z), (side * 0.10, 1.0, 0.0), 0.10, AMBER, 5.0, 3.4, 8.0, 34.0))
        rows.append(((x - side * 0.70, 4.2, z), (side * 0.02, -1.0, 0.0), 0.12, GOLD, 4.0, 4.4, 6.0, 26.0))
        rows.append(
            (
                (x - side * 0.75, 7.3, z),
                (-side * 0.30, 1.0, 0.0),
                0.12,
                TEAL if side > 0 else BLUE,
                4.5,
                5.0,
                12.0,
                44.0,
            )
        )
    for k, z in enumerate(hall.bay_centres()):
        for side in (-1.0, 1.0):
            color = TEAL if (k + int(side > 0)) % 3 == 0 else GOLD
            rows.append(((side * 1.5, 6.6, z), (-side * 0.10, -1.0, 0.0), 0.22, color, 170.0, 8.0, 9.0, 15.0))
            color = (BLUE, ROSE)[(k + int(side > 0)) % 2]
            rows.append(((side * 6.2, 0.75, z), (side * 0.32, 1.0, 0.0), 0.10, color, 7.0, 6.0, 10.0, 42.0))
    for k in range(12):
        turn = np.pi * (k + 0.5) / 12
        out = np.array([math.cos(turn), 0.0, -math.sin(turn)])
        if k % 2:
            place = HEART + np.array([2.4 * out[0], 3.4, 3.0])
            rows.append((place, HEART - place, 0.06, GOLD, 34.0, 7.5, 8.0, 19.0))
        else:
            place = np.array([0.0, 0.15, hall.END]) + out * (hall.APSE_RADIUS - 0.45)
            rows.append(
                (place, (0.10 * out[0], 1.0, 0.10 * out[2]), 0.06, BLUE if k % 4 else TEAL, 22.0, 7.5, 10.0, 36.0)
            )
    names = ("place", "aim", "sweep", "color", "intensity", "range", "inner", "outer")
    return {name: np.array([row[k] for row in rows], float) for k, name in enumerate(names)}


def _add_lights(scene: Scene, rng: np.random.Generator) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    points, spots = _point_rows(rng), _spot_rows()
    scene.lights.extend(
        "point",
        len(points["centre"]),
        position=points["centre"],
        color=points["color"],
        intensity=points["intensity"],
        range=points["range"],
        source_radius=0.05,
    )
    scene.lights.extend(
        "spot",
        len(spots["place"]),
        position=spots["place"],
        direction=spots["aim"],
        color=spots["color"],
        intensity=spots["intensity"],
        range=spots["range"],
        inner_angle=np.radians(spots["inner"]),
        outer_angle=np.radians(spots["outer"]),
        source_radius=0.05,
    )
    return points, spots


def _add_stone(scene: Scene, rng: np.random.Generator) -> None:
    stone = Material(base_color=(0.56, 0.50, 0.42, 1.0), roughness=0.62, name="limestone")
    polished = Material(roughness=0.24, name="polished floor")
    scene.add(hall.floor(rng).mesh("floor"), material=polished, label=1)
    for name, shape, places in hall.stonework(rng):
        mesh = shape.mesh(name)
        for x, y, z, turn in places:
            scene.add(mesh, transform=translation(x, y, z, turn=turn), material=stone, label=2)


def _add_window(scene: Scene) -> None:
    """Set the rose window into the wall above the apse."""
    place = translation(0.0, 9.05, hall.END + 0.27)
    tracery, panes = hall.rose_window()
    lead = Material(base_color=(0.30, 0.27, 0.23, 1.0), roughness=0.7, name="tracery")
    scene.add(tracery.mesh("tracery"), transform=place, material=lead, label=2)
    for shape, color, power in zip(panes, (ROSE, TEAL, GOLD, AMBER), (0.75, 0.6, 0.9, 1.1), strict=True):
        glass = Material(
            base_color=(0.02, 0.02, 0.02, 1.0), emissive=tuple(power * c for c in color), roughness=0.3, name="glass"
        )
        scene.add(shape.mesh("panes"), transform=place, material=glass, label=8)


def _add_furnishings(scene: Scene) -> None:
    bronze = Material(base_color=(0.36, 0.24, 0.13, 1.0), metallic=1.0, roughness=0.38, name="bronze")
    gold = Material(base_color=(1.0, 0.76, 0.36, 1.0), metallic=0.6, roughness=0.36, name="gold")
    glaze = Material(base_color=(0.05, 0.16, 0.20, 1.0), roughness=0.2, name="glaze")
    marble = Material(base_color=(0.60, 0.56, 0.50, 1.0), roughness=0.4, name="marble")
    base, vase = furnishings.pedestal(0.95, 0.62).mesh("pedestal"), furnishings.urn().mesh("urn")
    for k, z in enumerate(hall.bay_centres()):
        for side in (-1.0, 1.0):
            place = translation(side * 6.35, 0.0, z)
            scene.add(base, transform=place, material=marble, label=3)
            scene.add(
                vase,
                transform=translation(side * 6.35, 0.95, z, turn=np.pi / 2, scale=1.15),
                material=bronze if (k + int(side > 0)) % 2 else glaze,
                label=4,
            )
    *rings, stand = furnishings.armillary_rings(1.7)
    for shape in rings:
        scene.add(shape.mesh("rings"), transform=translation(*HEART), material=gold, label=5)
    scene.add(stand.mesh("stand"), transform=translation(*HEART), material=bronze, label=5)
    top = float(stand.positions[:, 1].min() + HEART[1])
    scene.add(
        furnishings.pedestal(top - 0.6, 1.1).mesh("altar"),
        transform=translation(0.0, 0.6, HEART[2]),
        material=marble,
        label=3,
    )
    body = furnishings.lantern(1.9).mesh("lantern")
    for _ in range(2 * hall.BAYS):
        scene.add(body, material=bronze, label=6)


def _add_glow(scene: Scene, points: dict[str, np.ndarray]) -> None:
    """One glowing ball a point light; few meshes and materials, shared by size and colour."""
    meshes = {
        size: sphere(size, *((32, 16) if size > 0.06 else (12, 6))).mesh("glow") for size in np.unique(points["size"])
    }
    materials: dict[tuple, Material] = {}
    for color, size in zip(points["color"], points["size"], strict=True):
        key = tuple(color)
        if key not in materials:
            black = (0.0, 0.0, 0.0, 1.0)
            emitted = tuple(float(1.6 * c) for c in key)
            materials[key] = Material(base_color=black, emissive=emitted, roughness=1.0, name="glow")
        scene.add(meshes[size], material=materials[key], label=7)


def build(*, seed: int = 7, brightness: float = 1.0) -> Scene:
    """Build the hall.

    Args:
        seed: Of tiles and of the paths of the motes.
        brightness: Factor on every light.
    """
    rng = np.random.default_rng(check_count("hundred_lights.seed", seed, 0, 2**63 - 1))
    factor = check_range("hundred_lights.brightness", brightness, 0.0, 1e6)
    scene = Scene("hundred_lights")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.016, 0.021, 0.038), background=(0.002, 0.002, 0.004))
    scene.cameras.append(
        Camera.look_at((0.70, 1.65, 2.9), (-0.20, 3.10, -14.0), vertical_fov_deg=52.0, exposure=0.5, name="nave")
    )
    _add_stone(scene, rng)
    _add_window(scene)
    _add_furnishings(scene)
    points, spots = _add_lights(scene, rng)
    _add_glow(scene, points)
    for group in (scene.lights.point, scene.lights.spot):
        group.intensity = group.intensity * factor
    count, spot_count = len(points["centre"]), len(spots["place"])
    _motions[scene] = _Motion(
        centre=points["centre"],
        amplitude=points["amplitude"] * rng.uniform(0.7, 1.0, (count, 3)),
        rate=rng.integers(1, 4, (count, 3)) * (2.0 * np.pi / PERIOD),
        phase=rng.uniform(0.0, 2.0 * np.pi, (count, 3)),
        aim=spots["aim"] / np.linalg.norm(spots["aim"], axis=1, keepdims=True),
        sweep=spots["sweep"],
        sweep_rate=rng.integers(1, 3, spot_count) * (2.0 * np.pi / PERIOD),
        sweep_phase=rng.uniform(0.0, 2.0 * np.pi, spot_count),
    )
    animate(scene, 0.0)
    return scene


def animate(scene: Scene, time: float) -> None:
    """Put every light, lantern, mote and ring where it is at a time.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `PERIOD`.

    Raises:
        InputError: If the scene was not made by `build`.
    """
    motion = _motions.get(scene)
    if motion is None:
        raise input_error("hundred_lights.animate.scene", "a scene made by hundred_lights.build", repr(scene))
    time = check_range("hundred_lights.animate.time", time, -1e9, 1e9, unit="s")
    time += _FIRST
    wave = np.sin(motion.rate * time + motion.phase)
    position = motion.centre + motion.amplitude * wave
    scene.lights.point.position = position
    # A spot's axis circles its aim: two perpendiculars, a quarter of a turn apart.
    angle = motion.sweep_rate * time + motion.sweep_phase
    reach = np.tan(motion.sweep)
    helper = np.where(np.abs(motion.aim[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    right = np.cross(motion.aim, helper)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, motion.aim)
    scene.lights.spot.direction = (
        motion.aim + (reach * np.cos(angle))[:, None] * right + (reach * np.sin(angle))[:, None] * up
    )
    # What moves is found by the name of its mesh: keeping the instances here would keep their scene alive for ever.
    matrix = np.eye(4)
    places = {"glow": iter(position), "lantern": iter(position)}
    turns = iter((1.0, -2.0, 3.0))
    for instance in scene.instances:
        if instance.mesh.name in places:
            matrix[:3, 3] = next(places[instance.mesh.name])
            instance.transform = matrix
        elif instance.mesh.name == "rings":
            instance.transform = translation(*HEART, turn=2.0 * np.pi * time / PERIOD * next(turns))
