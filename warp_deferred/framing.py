"""A camera for a scene that has none, and light for one that is dark."""

from __future__ import annotations

import math

import numpy as np

from .camera import Camera
from .lights import DirectionalLight
from .scene import Environment, Scene

__all__ = ["frame_camera", "light_if_dark"]

#: Where the camera stands: to the right of the front (+Z, as glTF has it) and above the floor [degrees].
AZIMUTH_DEG, ELEVATION_DEG = 30.0, 17.0
VERTICAL_FOV_DEG = 40.0
#: Share of the picture's half height or width that the box may fill.
FILL = 0.92
#: Vertices up to which each is looked at; larger scenes are framed by their box.
MAX_POINTS = 4_000_000
#: Lamps around a scene with metal, and the share of the sphere, from the top, that they are spread over.
DOME_LIGHTS, DOME_SHARE = 40, 0.75


def frame_camera(scene: Scene, *, aspect: float = 16.0 / 9.0) -> Camera:
    """Return a three-quarter view that shows the whole scene, as large as it goes.

    The direction is fixed. In camera axes with depth z along the view, a point (x, y, z) is inside the picture of an
    eye at (a, b, -d) when |x - a| <= k (z + d) and |y - b| <= l (z + d), k and l being the tangents of the half
    angles: per axis two planes from each side touch the points, and where they meet is the nearest eye, in closed
    form. The points are the vertices, so that what is seen fills the picture and stands in its middle; their box
    would leave room for corners that nothing fills.

    Args:
        scene: What to show; an empty scene gets a camera that looks at the origin.
        aspect: Width over height of the picture.

    Returns:
        The camera; its near plane is a thousandth of the distance, or half of the nearest point's depth.
    """
    bounds = scene.bounds()
    low, high = (np.full(3, -1.0), np.full(3, 1.0)) if bounds is None else bounds
    middle, size = (low + high) / 2.0, float((high - low).max())
    if not size > 0.0:
        # A single point: any distance frames it; one that suits its place in float64 is taken.
        size = max(1.0, float(np.abs(middle).max()) * 1e-3)
        low, high = middle - size / 2.0, middle + size / 2.0
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    flat = math.cos(elevation)
    back = np.array([math.sin(azimuth) * flat, math.sin(elevation), math.cos(azimuth) * flat])
    right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    up = np.cross(back, right)
    points = _vertices(scene)
    if points is None:
        points = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    x, y, z = np.stack([right, up, -back]) @ (points - middle).T
    tangent = math.tan(math.radians(VERTICAL_FOV_DEG) / 2.0) * FILL
    a, distance_x = _nearest(x, z, tangent * aspect)
    b, distance_y = _nearest(y, z, tangent)
    distance = max(distance_x, distance_y)
    if not float(z.min() + distance) > 1e-6 * size:
        # A face seen edge-on, or all but a point: the nearest eye would touch it.
        distance = size - float(z.min())
    eye = middle + right * a + up * b + back * distance
    near = min(1e-3 * distance, 0.5 * float(z.min() + distance))
    return Camera.look_at(eye, eye - back * distance, vertical_fov_deg=VERTICAL_FOV_DEG, near=near, name="framed")


def _vertices(scene: Scene) -> np.ndarray | None:
    """Return all vertices that faces use in world space, (n, 3) float64, or None for none, too many or a lone point."""
    used: dict[int, np.ndarray] = {}
    count, parts = 0, []
    for instance in scene.instances:
        mesh = instance.mesh
        if id(mesh) not in used:
            used[id(mesh)] = mesh.positions[np.unique(mesh.triangles)].astype(np.float64) + mesh.origin
        count += len(used[id(mesh)])
        if count > MAX_POINTS:
            return None
        parts.append(used[id(mesh)] @ instance.transform[:3, :3].T + instance.transform[:3, 3])
    points = np.concatenate(parts) if parts else np.empty((0, 3))
    return points if len(points) and (points != points[0]).any() else None


def _nearest(x: np.ndarray, z: np.ndarray, tangent: float) -> tuple[float, float]:
    """Return (sideways place, distance) of the nearest eye that sees all points of one axis."""
    a, b = float((x - tangent * z).max()), float((-x - tangent * z).max())
    return (a - b) / 2.0, (a + b) / (2.0 * tangent)


def light_if_dark(scene: Scene) -> list[str]:
    """Give a scene without any light a warm key, a cool fill, a rim, some ambient light and a calm background.

    The lights are placed by the camera's view (`scene.camera`, or the one `frame_camera` would make): the key from
    the upper left, the fill from the right, the rim from behind. Metal shows only what it reflects, and ambient light
    is diffuse, so a scene with metal gets a dome of weak lamps too. A scene with lights, with ambient light, or whose
    materials all only glow is left as it is.

    Returns:
        Remarks that say so, which are appended to `scene.notes` too.
    """
    ambient = max(scene.environment.ambient) > 0.0
    if len(scene.lights) or ambient or _only_glows(scene):
        return []
    axes = np.array((scene.camera or frame_camera(scene)).rotation).reshape(3, 3)
    metal = any(i.material.model == "ggx" and i.material.metallic > 0.0 for i in scene.instances)
    # Towards the light, in the camera's axes: right, up, back.
    lamps = [
        ("key", (-0.65, 0.85, 0.75), 2.5, (1.0, 0.95, 0.87)),
        ("fill", (0.9, 0.15, 0.55), 0.45, (0.8, 0.9, 1.0)),
        ("rim", (0.75, 0.5, -0.8), 1.4, (0.85, 0.93, 1.0)),
    ]
    lamps += _dome() if metal else []
    for name, towards, lux, color in lamps:
        direction = tuple((-np.array(towards) @ axes).tolist())
        scene.lights.add(DirectionalLight(direction=direction, color=color, intensity=lux, name=name))
    background = scene.environment.background
    if max(background) == 0.0:
        background = (0.032, 0.038, 0.048)
    # The dome lights what is not metal as well.
    level = 0.5 if metal else 1.0
    scene.environment = Environment(ambient=(0.14 * level, 0.15 * level, 0.17 * level), background=background)
    dome = f" and, for the metal to reflect, {DOME_LIGHTS} lamps around" if metal else ""
    notes = [f"no light in the file: added key, fill, rim and ambient light{dome}"]
    scene.notes += notes
    return notes


def _dome() -> list[tuple[str, tuple[float, float, float], float, tuple[float, float, float]]]:
    """Return lamps on a spiral whose turns are a golden angle apart, as name, direction to it, lux and colour."""
    lamps = []
    for k in range(DOME_LIGHTS):
        y = 1.0 - 2.0 * DOME_SHARE * (k + 0.5) / DOME_LIGHTS
        turn, radius = k * math.pi * (3.0 - math.sqrt(5.0)), math.sqrt(1.0 - y * y)
        x, z = radius * math.cos(turn), radius * math.sin(turn)
        lux, color = 0.18 if y > 0.0 else 0.1, (1.0, 0.97, 0.93) if x < 0.0 else (0.88, 0.95, 1.0)
        lamps.append(("dome", (x, y, z), lux, color))
    return lamps


def _only_glows(scene: Scene) -> bool:
    """Tell whether every material emits light and reflects none."""
    materials = {id(i.material): i.material for i in scene.instances}.values()
    return bool(materials) and all(max(m.emissive) > 0.0 and max(m.base_color[:3]) == 0.0 for m in materials)
