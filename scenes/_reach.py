"""How far lights must reach so that a stated number of them lights a pixel on average, and how they drift.

The mean is solved for, not estimated: among all pairs of a visible point and a light in front of its surface, sorted by
distance over the light's relative range, the range sought is the distance at which the counted pairs reach the mean.
"""

from __future__ import annotations

import weakref

import numpy as np

from warp_deferred.camera import Camera
from warp_deferred.checks import input_error
from warp_deferred.scene import Scene

__all__ = ["camera_rays", "drift", "range_for_mean", "set_drift"]

PERIOD = 20.0
"""Time after which every drifting light is back where it was [s]."""
_CHUNK = 1 << 21
_drifts: weakref.WeakKeyDictionary[Scene, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = (
    weakref.WeakKeyDictionary()
)


def camera_rays(camera: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Eye (3,) and directions (height, width, 3) through the pixel centres, of view depth 1; perspective only."""
    fx, fy, cx, cy = camera.pixel_projection(width, height)
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (cy - np.arange(height) - 0.5) / fy
    right, up, back = np.array(camera.rotation).reshape(3, 3)
    return np.array(camera.position), x[None, :, None] * right + y[:, None, None] * up - back


def _ratios(points: np.ndarray, normals: np.ndarray, lights: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances below `limit` from points to lights in front of them, and the index of each one's point."""
    found, rows = [], []
    step = max(1, _CHUNK // max(len(lights), 1))
    middle = lights.mean(axis=0)
    p32, l32 = (points - middle).astype(np.float32), (lights - middle).astype(np.float32)
    square = np.einsum("ij,ij->i", l32, l32)
    own = np.einsum("ij,ij->i", p32, p32)
    # |l - p|² by its three terms is one matrix product; it rounds, so a little too much is kept, then measured exactly.
    most = 1.01 * limit * limit + 1e-5 * float(own.max() + square.max())
    for start in range(0, len(points), step):
        chunk = slice(start, start + step)
        product = p32[chunk] @ l32.T
        product *= -2.0
        product += square
        row, column = np.divmod(np.flatnonzero(product < (most - own[chunk])[:, None]), len(lights))
        to_light = lights[column] - points[start + row]
        distance = np.sqrt(np.einsum("ij,ij->i", to_light, to_light))
        lit = (np.einsum("ij,ij->i", to_light, normals[start + row]) > 0.0) & (distance < limit)
        found.append(distance[lit])
        rows.append(start + row[lit])
    return np.concatenate(found), np.concatenate(rows)


def range_for_mean(
    points: np.ndarray, normals: np.ndarray, lights: np.ndarray, mean: float, weights: np.ndarray | None = None
) -> float:
    """Range at which, on average over visible points, `mean` lights lie within it and before the surface [m].

    Args:
        points: (n, 3) visible points [m].
        normals: (n, 3) their unit normals.
        lights: (m, 3) light positions [m].
        mean: Lights wanted per point; what all lights together cannot give is cut to it.
        weights: (n,) share of the picture each point stands for; equal if left out.

    Returns:
        The range common to all lights [m].
    """
    weights = np.ones(len(points)) if weights is None else weights
    share = weights / weights.sum()
    low, high = points.min(axis=0), points.max(axis=0)
    # Far enough to hold a few times the lights wanted; widened until it does, or until all are in.
    limit = 0.25 * float(np.linalg.norm(high - low)) * (8.0 * mean / max(len(lights), 1)) ** 0.5
    most = 4.0 * float(np.linalg.norm(np.maximum(high, lights.max(axis=0)) - np.minimum(low, lights.min(axis=0))))
    while True:
        distance, row = _ratios(points, normals, lights, min(limit, most))
        if limit >= most or share[row].sum() >= mean:
            break
        limit *= 1.6
    order = np.argsort(distance, kind="stable")
    reached = np.cumsum(share[row[order]])
    last = min(int(np.searchsorted(reached, mean)), len(order) - 1)
    return float(distance[order[last]])


def set_drift(scene: Scene, centres: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> None:
    """Give each point light of a scene a closed path around its centre, (n, 3) [m]; `size` (n, 3) [m] bounds it."""
    phase = rng.uniform(0.0, 2.0 * np.pi, centres.shape)
    rate = rng.integers(1, 4, centres.shape) * (2.0 * np.pi / PERIOD)
    _drifts[scene] = (centres, size, rate, phase)
    drift(scene, 0.0)


def drift(scene: Scene, time: float) -> None:
    """Move the point lights of a scene to where they are at `time` [s], one array for all.

    Raises:
        InputError: If the scene was not made by a built-in scene's `build`.
    """
    if scene not in _drifts:
        raise input_error("animate.scene", "a scene made by this module's build", repr(scene))
    centres, size, rate, phase = _drifts[scene]
    if len(centres):
        scene.lights.point.position = centres + size * np.sin(rate * time + phase)
