"""Scenes around a mesh whose points are bound, and how near its picture must come to that of a mesh made from them."""

from __future__ import annotations

import numpy as np
import warp as wp
from builders import FULL, LAYERS, add_lights, assert_same, grid, images, tilt

import warp_deferred as wd

__all__ = [
    "INF", "NAN", "as_plain", "as_vectors", "assert_close", "remade", "render", "renderer_of", "scene_of", "wave",
]  # fmt: skip

NAN, INF = float("nan"), float("inf")
#: What does not depend on normals.
FIRM = ("alpha", "depth", "position", "albedo", "instance_id", "semantic_id", "material_id", "triangle_id")
#: Normals within 1e-6 of the host's; radiance by that times the slope of a lobe of roughness 0.6, about 10 at most.
NORMAL_BOUND, LIGHT_BOUND = 1e-6, 2e-5


def wave(positions, phase=0.0, amount=0.15):
    p = np.asarray(positions, float)
    return (p + amount * np.sin(4.0 * p[:, [1, 2, 0]] + [phase, 1.0 + phase, 2.0]) + [0.0, 0.1, 0.0]).astype(np.float32)


def remade(mesh, points, triangles=None):
    """Return the mesh made anew from points."""
    faces = mesh.triangles if triangles is None else triangles
    return wd.Mesh(points, faces, uvs=mesh.uvs, colors=mesh.colors, smooth=mesh.smooth)


def scene_of(mesh, *, copies=1, world=-1):
    scene = wd.Scene()
    material = wd.Material(roughness=0.6)
    scene.add(grid(2, 9.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, -1.0, 0.0)))
    for k in range(copies):
        place = tilt(10.0, 30.0 * k, (1.0 - 2.0 * (k % 2), 1.0, 1.0), (1.3 * k - 0.4 * (copies > 1), 0.2, -0.5 * k))
        scene.add(mesh, transform=place, material=material, world=world, label=k)
    add_lights(scene)
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    scene.camera = wd.Camera.look_at((0.4, 1.0, 3.2), (0.0, 0.0, 0.0), vertical_fov_deg=50.0)
    return scene


def renderer_of(scene, device, **fields):
    return wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL, **fields)


def render(scene, device, camera=None, **fields):
    return images(renderer_of(scene, device, **fields).render(camera))


def assert_close(expected, actual):
    """Firm layers agree to the bit, normals and radiance within their bounds."""
    assert_same(expected, actual, FIRM)
    assert np.abs(expected["normal"] - actual["normal"]).max() <= NORMAL_BOUND
    for name in ("color", "diffuse", "specular"):
        assert np.abs(expected[name] - actual[name]).max() <= LIGHT_BOUND * max(1.0, expected[name].max()), name


def as_plain(values, device):
    return wp.array(values, dtype=wp.float32, device=device)


def as_vectors(values, device):
    return wp.array(values, dtype=wp.vec3, device=device)
