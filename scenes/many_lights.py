"""A city at night under any number of point lights, a stated mean of which reaches a pixel.

Stepped towers on a street grid fill the whole picture. Lights hover over ground, roofs and walls, equally dense on each
square metre; the range they share is solved for with rays from the scene's own camera (16:9), so that on average
`mean` lights lie within their range of a pixel's surface and before it: what the output `light_count` counts.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from ._reach import camera_rays, drift, range_for_mean, set_drift
from .shapes import box, plane

__all__ = ["animate", "build"]

PITCH = 9.0
"""Distance between the middles of neighbouring towers [m]."""
GROUND = 320.0
"""Side of the square ground [m]."""
#: Colours of the lights, linear, and how often each occurs, by what they hover over: tungsten and sodium in streets,
#: neon on the walls, a cool blue on the roofs, so that the shape of the city reads from colour alone.
STREETS = np.array([[1.0, 0.56, 0.20], [1.0, 0.74, 0.42], [1.0, 0.38, 0.10]]), (0.5, 0.3, 0.2)
WALLS = np.array([[1.0, 0.18, 0.42], [0.62, 0.22, 1.0], [1.0, 0.45, 0.16]]), (0.45, 0.3, 0.25)
ROOFS = np.array([[0.10, 0.48, 1.0], [0.08, 0.80, 0.85], [0.35, 0.55, 1.0]]), (0.5, 0.3, 0.2)
#: (base colour, roughness) of the towers.
FACADES = [
    ((0.34, 0.33, 0.34), 0.55),
    ((0.22, 0.24, 0.29), 0.40),
    ((0.42, 0.36, 0.30), 0.65),
    ((0.16, 0.18, 0.22), 0.35),
]


def _towers(rng: np.random.Generator) -> np.ndarray:
    """Boxes as rows (low x y z, high x y z) [m]: each tower a wide foot and a slimmer top."""
    x, z = np.meshgrid(np.arange(-11, 12) * PITCH, np.arange(-14, 4) * PITCH)
    middle = np.stack([x.ravel(), z.ravel()], -1)
    count = len(middle)
    # Towers grow with the distance, so that the far ones still stand out and the near ones hide little.
    far = np.clip((20.0 - middle[:, 1]) / 130.0, 0.0, 1.0)
    foot = rng.uniform(0.8, 2.6, count) + 2.0 * far * rng.random(count)
    top = foot + rng.gamma(1.6, 1.4, count) * (0.5 + 2.2 * far)
    wide, slim = rng.uniform(2.2, 3.0, (count, 2)), rng.uniform(0.45, 0.8, (count, 2))
    boxes = []
    for half, low, high in ((wide, np.zeros(count), foot), (wide * slim, foot, top)):
        boxes.append(np.column_stack([middle[:, 0] - half[:, 0], low, middle[:, 1] - half[:, 1],
                                      middle[:, 0] + half[:, 0], high, middle[:, 1] + half[:, 1]]))  # fmt: skip
    return np.concatenate(boxes)


def _visible(camera: Camera, boxes: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Where rays through a picture of that size first meet a box or the ground, and the normals there."""
    eye, rays = camera_rays(camera, width, height)
    rays = rays.reshape(-1, 3)
    best = -eye[1] / rays[:, 1]
    face = np.full(len(rays), 1)
    # One row a coordinate: the slabs of a box are then four short passes over contiguous memory.
    inverse = 1.0 / np.where(rays == 0.0, 1e-12, rays).T
    forward = inverse > 0.0
    for low, high in zip(boxes[:, :3, None] - eye[:, None], boxes[:, 3:, None] - eye[:, None], strict=True):
        near = np.where(forward, low, high) * inverse
        far = np.where(forward, high, low) * inverse
        enter = np.maximum(np.maximum(near[0], near[1]), near[2])
        leave = np.minimum(np.minimum(far[0], far[1]), far[2])
        hit = np.flatnonzero((enter <= leave) & (enter > 0.0) & (enter < best))
        best[hit] = enter[hit]
        face[hit] = near[:, hit].argmax(axis=0)
    normals = np.eye(3)[face] * -np.sign(np.take_along_axis(rays, face[:, None], axis=1))
    return eye + rays * best[:, None], normals


def _scatter(
    boxes: np.ndarray, camera: Camera, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Points on the faces turned to the camera, equally dense, their normals, and that density [1/m²]."""
    low, high = boxes[:, :3], boxes[:, 3:]
    half_fov = math.tan(0.5 * camera.vertical_fov) * 16 / 9
    eye = np.array(camera.position)
    corners, edges, normals = [[[-95.0, 0.0, -105.0]]], [[[[190.0, 0.0, 0.0], [0.0, 0.0, 125.0]]]], [[[0.0, 1.0, 0.0]]]
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for side in (low, high):
            sign = 1.0 if side is high else -1.0
            corner = low.copy()
            corner[:, axis] = side[:, axis]
            size = high - low
            corners.append(corner)
            edges.append(np.stack([size[:, [b]] * np.eye(3)[b], size[:, [c]] * np.eye(3)[c]], 1))
            normals.append(np.tile(np.eye(3)[axis] * sign, (len(low), 1)))
    corner, edge, normal = np.concatenate(corners), np.concatenate(edges), np.concatenate(normals)
    area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    area[np.einsum("ij,ij->i", eye - corner, normal) <= 0.0] = 0.0
    # Draw more than needed and keep what the camera can see or nearly see, until there are enough.
    found, total = [], 0
    kept, drawn = 0, 0
    while total < count:
        batch = 2 * count + 64
        face = rng.choice(len(area), batch, p=area / area.sum())
        point = corner[face] + np.einsum("ij,ijk->ik", rng.random((batch, 2)), edge[face])
        view = (point - eye) @ np.array(camera.rotation).reshape(3, 3).T
        near = np.abs(view[:, 0]) < half_fov * -view[:, 2] + 2.0
        near &= np.abs(view[:, 1]) < half_fov * 9 / 16 * -view[:, 2] + 2.0
        found.append(np.column_stack([point, normal[face]])[near])
        kept, drawn, total = kept + int(near.sum()), drawn + batch, total + int(near.sum())
    result = np.concatenate(found)[:count]
    return result[:, :3], result[:, 3:], count / (area.sum() * kept / drawn)


def build(*, lights: int = 10_000, mean: float = 5.0, seed: int = 0, triangles: int = 100_000) -> Scene:
    """Build the city.

    Args:
        lights: Point lights.
        mean: Lights that reach a pixel on average, in a 16:9 picture from the scene's camera.
        seed: Of towers and lights.
        triangles: Triangles wanted, about; at least 10 k.
    """
    lights = check_count("many_lights.lights", lights, 1, 1_000_000)
    mean = check_range("many_lights.mean", mean, 0.01, 0.5 * lights, mend="at most half of the lights")
    triangles = check_count("many_lights.triangles", triangles, 2, 100_000_000)
    rng = np.random.default_rng(check_count("many_lights.seed", seed, 0, 2**63 - 1))
    scene = Scene("many_lights")
    scene.animate = animate
    scene.environment = Environment(ambient=(0.020, 0.026, 0.050), background=(0.004, 0.006, 0.014))
    camera = Camera.look_at((6.0, 36.0, 34.0), (0.0, 0.0, -14.0), vertical_fov_deg=38.0, exposure=0.0)
    scene.cameras.append(camera)
    boxes = _towers(rng)
    _place(scene, boxes, triangles, rng)
    on, normal, density = _scatter(boxes, camera, lights, rng)
    # Radius of the disc that holds `mean` lights: the scale of heights and drifts, whatever the number.
    scale = math.sqrt(mean / (math.pi * density))
    above = scale * rng.uniform(0.45, 0.70, lights)
    centres = on + normal * above[:, None]
    points, normals = _visible(camera, boxes, 96, 54)
    reach = range_for_mean(points, normals, centres, mean)
    scene.lights.extend(
        "point",
        lights,
        position=centres,
        color=_colors(on, normal, rng),
        intensity=6.0 / max(mean, 1.0) * above**2 * rng.uniform(0.5, 1.5, lights),
        range=reach,
    )
    set_drift(scene, centres, (0.3 * above)[:, None] * np.ones(3), rng)
    return scene


def _colors(on: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Colour of each light by the kind of face it hovers over, (n, 3)."""
    wall = normal[:, 1] < 0.5
    kinds = (~wall & (on[:, 1] <= 0.0), wall, ~wall & (on[:, 1] > 0.0))
    colors = np.zeros_like(on)
    for chosen, (palette, shares) in zip(kinds, (STREETS, WALLS, ROOFS), strict=True):
        colors[chosen] = palette[rng.choice(len(palette), int(chosen.sum()), p=shares)]
    return colors


def _place(scene: Scene, boxes: np.ndarray, triangles: int, rng: np.random.Generator) -> None:
    """Add ground and towers; cells are spent so that all of it comes to about `triangles`."""
    cells = max(1, int(math.sqrt(0.7 * triangles / (12 * len(boxes)))))
    side = max(1, round(math.sqrt(max(triangles - 12 * len(boxes) * cells**2, 2) / 2)))
    asphalt = Material(base_color=(0.16, 0.165, 0.18, 1.0), roughness=0.38, name="asphalt")
    scene.add(plane(GROUND, GROUND, columns=side, rows=side).mesh("ground"), material=asphalt)
    facades = [Material(base_color=(*color, 1.0), roughness=rough) for color, rough in FACADES]
    unit = box(1.0, 1.0, 1.0, cells=cells).mesh("tower")
    for b in boxes:
        matrix = np.diag([*(b[3:] - b[:3]), 1.0])
        matrix[:3, 3] = 0.5 * (b[0] + b[3]), b[1], 0.5 * (b[2] + b[5])
        scene.add(unit, transform=matrix, material=facades[rng.integers(len(facades))], label=1)


def animate(scene: Scene, time: float) -> None:
    """Let the lights drift around their places.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `_reach.PERIOD`.
    """
    drift(scene, time)
