"""Rolling terrain, 20 m square, of any number of triangles: under a sun, or under scattered point lights.

The height field of the raster benchmark: y = 10 (0.05 sin 20u cos 17w + 0.02 sin(90u + 40w)) [m] for u = x / 10 and
w = z / 10 in [-1, 1], sampled on a square net, seen from (0, 3, 9) towards the origin. All Lambert, so that nothing
else is compiled in.
"""

from __future__ import annotations

import math

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range
from warp_deferred.lights import DirectionalLight
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Mesh, Scene

from ._reach import drift, range_for_mean, set_drift

__all__ = ["animate", "build", "height", "net"]

#: Colours of the scattered lights, linear: mostly warm, so that the few cool ones carry the eye.
PALETTE = np.array([[1.0, 0.62, 0.28], [1.0, 0.42, 0.16], [1.0, 0.80, 0.52], [0.22, 0.65, 1.0], [0.9, 0.22, 0.55]])
SHARES = (0.34, 0.24, 0.18, 0.16, 0.08)


def height(x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height of the terrain and its slopes dy/dx and dy/dz at places of equal shape [m]."""
    u, w = x / 10.0, z / 10.0
    ripple = 90.0 * u + 40.0 * w
    y = 10.0 * (0.05 * np.sin(20.0 * u) * np.cos(17.0 * w) + 0.02 * np.sin(ripple))
    slope_x = np.cos(20.0 * u) * np.cos(17.0 * w) + 1.8 * np.cos(ripple)
    slope_z = -0.85 * np.sin(20.0 * u) * np.sin(17.0 * w) + 0.8 * np.cos(ripple)
    return y, slope_x, slope_z


def net(side: int) -> Mesh:
    """Mesh of side x side vertices, rows along z, so that neighbours in memory are neighbours in space."""
    line = np.linspace(-10.0, 10.0, side)
    x, z = np.meshgrid(line, line)
    y, slope_x, slope_z = height(x, z)
    positions = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    normals = np.stack([-slope_x, np.ones_like(y), -slope_z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(side - 1, dtype=np.int64)[:, None] * side + np.arange(side - 1)).ravel()
    right, below = corner + 1, corner + side
    triangles = np.stack([corner, below, right, right, below, below + 1], -1).reshape(-1, 3)
    return Mesh(positions, triangles, normals=normals, name="terrain")


def _visible(camera: Camera, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random points of the terrain in a 16:9 picture, their normals, and the share of it each stands for."""
    x, z = rng.uniform(-10.0, 10.0, (2, count))
    y, slope_x, slope_z = height(x, z)
    points, upright = np.stack([x, y, z], -1), np.stack([-slope_x, np.ones(count), -slope_z], -1)
    view = (points - camera.position) @ np.array(camera.rotation).reshape(3, 3).T
    depth, tangent = -view[:, 2], math.tan(0.5 * camera.vertical_fov)
    # Solid angle of a piece of ground: its area along the ray over the depth squared; hills in front are left out.
    facing = np.einsum("ij,ij->i", camera.position - points, upright)
    seen = (depth > 0.05) & (np.abs(view[:, 1]) < tangent * depth) & (np.abs(view[:, 0]) < tangent * depth * 16 / 9)
    seen &= facing > 0.0
    weights = facing[seen] / depth[seen] ** 3
    return points[seen], upright[seen] / np.linalg.norm(upright[seen], axis=1, keepdims=True), weights


def build(*, triangles: int = 500_000, lights: int = 0, seed: int = 0, mean: float = 5.0) -> Scene:
    """Build the terrain.

    Args:
        triangles: Triangles wanted; the nearest 2 (n - 1)² is taken.
        lights: Point lights scattered over it; with 0 there is a sun and ambient light.
        seed: Of the scattering.
        mean: Lights that reach a visible pixel on average, about.
    """
    triangles = check_count("terrain.triangles", triangles, 2, 200_000_000)
    lights = check_count("terrain.lights", lights, 0, 1_000_000)
    mean = check_range("terrain.mean", mean, 0.1, 1000.0)
    rng = np.random.default_rng(check_count("terrain.seed", seed, 0, 2**63 - 1))
    scene = Scene("terrain")
    scene.animate = animate
    scene.add(
        net(round(math.sqrt(triangles / 2)) + 1),
        material=Material(model="lambert", base_color=(0.34, 0.40, 0.22, 1.0), name="meadow"),
    )
    camera = Camera.look_at((0.0, 3.0, 9.0), (0.0, 0.0, 0.0), vertical_fov_deg=60.0, near=0.05)
    scene.cameras.append(camera)
    if lights:
        scene.environment = Environment(ambient=(0.012, 0.016, 0.028), background=(0.010, 0.016, 0.034))
        _scatter(scene, camera, lights, mean, rng)
    else:
        scene.environment = Environment(ambient=(0.22, 0.27, 0.36), background=(0.30, 0.50, 0.84))
        scene.lights.add(
            DirectionalLight(direction=(0.40, -1.0, -0.25), color=(1.0, 0.90, 0.74), intensity=3.4, name="sun")
        )
    return scene


def _scatter(scene: Scene, camera: Camera, count: int, mean: float, rng: np.random.Generator) -> None:
    x, z = rng.uniform(-9.9, 9.9, (2, count))
    # Nearly the spacing of lights under which a disc holds `mean` of them: the scale of all that follows.
    scale = 20.0 * math.sqrt(mean / (math.pi * count))
    above = np.minimum(scale * rng.uniform(0.35, 0.6, count), 1.5)
    centres = np.stack([x, height(x, z)[0] + above, z], -1)
    points, normals, weights = _visible(camera, 6000, rng)
    reach = range_for_mean(points, normals, centres, mean, weights)
    # Radiance under a light goes with intensity over height squared: this keeps it the same for any count.
    scene.lights.extend(
        "point",
        count,
        position=centres,
        color=PALETTE[rng.choice(len(PALETTE), count, p=SHARES)],
        intensity=1.1 * (reach * 0.5) ** 2 * rng.uniform(0.6, 1.4, count),
        range=reach,
    )
    set_drift(scene, centres, np.minimum(0.25 * above, 0.2)[:, None] * np.ones(3), rng)


def animate(scene: Scene, time: float) -> None:
    """Let the point lights drift; without any, nothing moves.

    Args:
        scene: A scene made by `build`.
        time: Time [s]; everything repeats after `_reach.PERIOD`.
    """
    if len(scene.lights.point):
        drift(scene, time)
