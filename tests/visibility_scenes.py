"""Scenes and closed forms for the tests of ambient visibility."""

from __future__ import annotations

import numpy as np
from builders import grid, images, tilt

import warp_deferred as wd

__all__ = ["MATERIAL", "crease_closed_form", "crease_profile", "plane_scene", "render", "visibility"]

MATERIAL = wd.Material(model="lambert", base_color=(0.8, 0.8, 0.8, 1.0), two_sided=True)


def render(scene, *sets, size=(97, 71), camera=None, outputs=("ambient_visibility",), device="cpu", threads=None):
    settings = wd.Settings().with_values([f"ambient_visibility.{s}" for s in sets])
    renderer = wd.Renderer(
        scene, width=size[0], height=size[1], device=device, outputs=outputs, settings=settings, threads=threads
    )
    return images(renderer.render(camera))


def visibility(scene, *sets, **fields):
    return render(scene, *sets, **fields)["ambient_visibility"]


def plane_scene(tilt_deg, distance, projection="perspective"):
    """Return a plane through (0, 0, -distance) that fills the view up to its horizon."""
    scene = wd.Scene()
    scene.add(grid(1, 2000.0 * distance), transform=tilt(-tilt_deg, 0.0, 1.0, (0.0, 0.0, -distance)), material=MATERIAL)
    scene.camera = wd.Camera(near=0.01 * distance, vertical_fov=0.7)
    if projection == "orthographic":
        scene.camera = wd.Camera(
            projection=projection, vertical_extent=distance, near=-100.0 * distance, far=100.0 * distance
        )
    return scene


def crease_profile(rung, *sets, size=(192, 64), device="cpu", extent=2.0):
    """Return distances from a right-angled crease [m] and visibility along a row, seen at 45 degrees to both walls."""
    scene = wd.Scene()
    for side in (-1.0, 1.0):
        # Each wall reaches from the y axis 4 m towards the camera.
        along = np.array([side, 0.0, 1.0]) * np.sqrt(0.5)
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([4.0 * along, [0.0, 40.0, 0.0], np.cross(along, [0.0, 1.0, 0.0])])
        matrix[:3, 3] = 2.0 * along
        scene.add(grid(1, 1.0), transform=matrix, material=MATERIAL)
    scene.camera = wd.Camera(
        position=(0.0, 0.0, 10.0), projection="orthographic", vertical_extent=extent * size[1] / size[0], near=0.0,
        far=20.0,
    )  # fmt: skip
    v = visibility(scene, f"rung={rung}", *sets, size=size, device=device)
    x = (np.arange(size[0]) + 0.5 - size[0] / 2) * extent / size[0]
    return np.abs(x) * np.sqrt(2.0), v[size[1] // 2]


def crease_closed_form(distance, radius):
    """Visibility on one of two perpendicular walls: the unit disk beyond x / radius is blocked."""
    c = np.clip(distance / radius, 0.0, 1.0)
    return 1.0 - (np.arccos(c) - c * np.sqrt(1.0 - c * c)) / np.pi
