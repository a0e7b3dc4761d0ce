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


def frame_camera(scene: Scene, *, aspect: float = 16.0 / 9.0) -> Camera:
    """Return a three-quarter view that shows the whole scene, as large as it goes.

    The direction is fixed. In camera axes with depth z along the view, a point (x, y, z) is inside the picture of an
    eye at (a, b, -d) when |x - a| <= k (z + d) and |y - b| <= l (z + d), k and l being the tangents of the half
    angles: per axis two planes from each side touch the box, and where they meet is the nearest eye, in closed form.

    Args:
        scene: What to show; an empty scene gets a camera that looks at the origin.
        aspect: Width over height of the picture.

    Returns:
        The camera; its near plane is a thousandth of the distance, or half of the nearest corner's depth.
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
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    x, y, z = np.stack([right, up, -back]) @ (corners - middle).T
    tangent = math.tan(math.radians(VERTICAL_FOV_DEG) / 2.0) * FILL
    a, distance_x = _nearest(x, z, tangent * aspect)
    b, distance_y = _nearest(y, z, tangent)
    distance = max(distance_x, distance_y)
    eye = middle + right * a + up * b + back * distance
    near = min(1e-3 * distance, 0.5 * float(z.min() + distance))
    return Camera.look_at(eye, eye - back * distance, vertical_fov_deg=VERTICAL_FOV_DEG, near=near, name="framed")


def _nearest(x: np.ndarray, z: np.ndarray, tangent: float) -> tuple[float, float]:
    """Return (sideways place, distance) of the nearest eye that sees all points of one axis."""
    a, b = float((x - tangent * z).max()), float((-x - tangent * z).max())
    return (a - b) / 2.0, (a + b) / (2.0 * tangent)


def light_if_dark(scene: Scene) -> list[str]:
    """Give a scene without any light a warm key, a cool fill, some ambient light and a calm background.

    The lights are placed by the camera's view (`scene.camera`, or the one `frame_camera` would make): the key from
    the upper left, the fill from the right. A scene with lights, with ambient light, or whose materials all only
    glow is left as it is.

    Returns:
        Remarks that say so, which are appended to `scene.notes` too.
    """
    ambient = max(scene.environment.ambient) > 0.0
    if len(scene.lights) or ambient or _only_glows(scene):
        return []
    camera = scene.camera or frame_camera(scene)
    right, up, back = np.array(camera.rotation).reshape(3, 3)
    key = -(-0.65 * right + 0.85 * up + 0.75 * back)
    fill = -(0.9 * right + 0.15 * up + 0.55 * back)
    scene.lights.add(
        DirectionalLight(direction=tuple(key.tolist()), color=(1.0, 0.95, 0.87), intensity=3.2, name="key"),
        DirectionalLight(direction=tuple(fill.tolist()), color=(0.8, 0.9, 1.0), intensity=0.8, name="fill"),
    )
    background = scene.environment.background
    if max(background) == 0.0:
        background = (0.032, 0.038, 0.048)
    scene.environment = Environment(ambient=(0.22, 0.235, 0.26), background=background)
    notes = ["no light in the file: added a key light, a fill light and ambient light"]
    scene.notes += notes
    return notes


def _only_glows(scene: Scene) -> bool:
    """Tell whether every material emits light and reflects none."""
    materials = {id(i.material): i.material for i in scene.instances}.values()
    return bool(materials) and all(max(m.emissive) > 0.0 and max(m.base_color[:3]) == 0.0 for m in materials)
