"""What a peer is to the bench: it says what it computes and what not, opens a case, and times it.

Every peer is handed the same scene and cameras; `Geometry` and `light_table` lay them out as plain arrays, so that no
peer reads anything else. Pictures and depths come back on the host, to be checked against ours.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import Timing, time_launches
from .cases import PeerCase

__all__ = [
    "Geometry", "LightTable", "Peer", "Session", "geometry_of", "light_table", "perspective", "srgb", "time_warp",
    "view_matrix",
]  # fmt: skip


class Session(Protocol):
    """A case opened by a peer: buffers are there, kernels are compiled."""

    #: What the row must say of how it was timed; empty where nothing differs from the peer's `method`.
    note: str

    def time(self, repeats: int) -> Timing:
        """Time one frame of all views [ms]."""

    def depth(self) -> np.ndarray | None:
        """View depth [m], (views, height, width) float32, +inf on the background; None if the peer has none here."""

    def picture(self) -> np.ndarray | None:
        """Picture of the first view, (height, width, 3) uint8, row 0 at the top; None if it makes none."""

    def close(self) -> None:
        """Give the device's memory back."""


class Peer(Protocol):
    """Another renderer, or ours.

    Attributes:
        name: Key in results.
        title: What it is called, in words.
        kinds: Kinds of cases it can do.
        computes: What it computes, in words.
        leaves_out: What it does not compute that ours does, and the other way round.
        method: How its time is taken.
        wins: Where it can be faster than ours, and why.
    """

    name: str
    title: str
    kinds: tuple[str, ...]
    computes: str
    leaves_out: str
    method: str
    wins: str

    def available(self, device: wp.Device) -> str | None:
        """Say why it cannot run on that device; None if it can."""

    def version(self) -> str:
        """Version, and what it draws on where that is not the bench's device."""

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Open a case of one of its kinds."""


@dataclasses.dataclass(frozen=True)
class Geometry:
    """All triangles of a scene, in world space.

    Attributes:
        positions: (n, 3) float32 [m].
        normals: (n, 3) float32 unit vectors.
        triangles: (m, 3) int32.
        albedo: Base colour of the one material, linear.
    """

    positions: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    albedo: tuple[float, float, float]

    @property
    def digest(self) -> str:
        """Same for the same content: what a peer makes of it need not be made twice."""
        parts = (self.positions, self.normals, self.triangles, np.array(self.albedo))
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def geometry_of(scene: Scene) -> Geometry:
    """Lay a scene of one unmoved instance out as plain arrays; all cases here are such scenes."""
    (instance,) = scene.instances
    mesh = instance.mesh
    if not np.array_equal(instance.transform, np.eye(4)) or mesh.origin.any():
        raise ValueError(f"geometry_of: expected an instance that is not moved, got {instance.transform.tolist()}")
    return Geometry(mesh.positions, mesh.normals, mesh.triangles, instance.material.base_color[:3])


@dataclasses.dataclass(frozen=True)
class LightTable:
    """Point and spot lights, in that order, as plain arrays of float32.

    Attributes:
        position: (n, 3) [m].
        color: (n, 3) colour times intensity [cd], linear.
        range: (n,) [m].
        direction: (n, 3) direction a spot shines in; 0 for a point.
        cosines: (n, 2) cosine of inner and outer angle; -2 and -3 for a point, so that it shines everywhere.
        casts: (n,) bool.
    """

    position: np.ndarray
    color: np.ndarray
    range: np.ndarray
    direction: np.ndarray
    cosines: np.ndarray
    casts: np.ndarray

    def __len__(self) -> int:
        return len(self.position)


def light_table(scene: Scene) -> LightTable:
    """Lay the lights of a scene of point and spot lights out as plain arrays."""
    point, spot = scene.lights.point, scene.lights.spot
    ends = np.stack([np.cos(spot.inner_angle), np.cos(spot.outer_angle)], axis=-1)
    columns = (
        np.concatenate([point.position, spot.position]),
        np.concatenate([g.color * g.intensity[:, None] for g in (point, spot)]),
        np.concatenate([point.range, spot.range]),
        np.concatenate([np.zeros((len(point), 3)), spot.direction]),
        np.concatenate([np.tile((-2.0, -3.0), (len(point), 1)), ends]),
    )
    casts = np.concatenate([point.casts_shadow, spot.casts_shadow])
    return LightTable(*(np.ascontiguousarray(c, np.float32) for c in columns), casts)


def view_matrix(camera: Camera) -> np.ndarray:
    """World-to-camera matrix, (4, 4) float64, column vectors; a camera looks down its own -Z."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(camera.rotation).reshape(3, 3)
    matrix[:3, 3] = -matrix[:3, :3] @ np.array(camera.position)
    return matrix


def perspective(camera: Camera, width: int, height: int, far: float) -> np.ndarray:
    """Camera-to-clip matrix of OpenGL, (4, 4) float64: z from -w at the near plane to w at the far one.

    Args:
        camera: A perspective camera whose principal point is in the middle.
        width: Width of the picture [px].
        height: Height of it [px].
        far: Distance of the far plane [m], which ours has not.
    """
    tangent, near = math.tan(0.5 * camera.vertical_fov), camera.near
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = height / (width * tangent), 1.0 / tangent
    matrix[2, 2:] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
    matrix[3, 2] = -1.0
    return matrix


def time_warp(session: Session, device: wp.Device, run: Callable[[], Any], repeats: int) -> Timing:
    """Time a session's launches of Warp kernels as a captured graph; as they are issued where they cannot be captured.

    Args:
        session: Its `note` says so then.
        device: Device of all launches.
        run: Issues them.
        repeats: Measurements.
    """
    try:
        return time_launches(device, run, repeats=repeats)
    except RuntimeError as error:
        session.note = f"not captured: {str(error).splitlines()[0]}"
        return time_launches(device, run, repeats=repeats, captured=False)


def srgb(linear: Any) -> np.ndarray:
    """Encode linear values in [0, 1] for the screen, as uint8 (IEC 61966-2-1)."""
    clipped = np.clip(np.nan_to_num(np.asarray(linear, np.float64)), 0.0, 1.0)
    curve = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * curve).astype(np.uint8)
