"""White furnace: a white Lambert sphere in constant white light. It vanishes: every pixel is exactly 1.

Diffuse ambient light of radiance 1 leaves a surface of albedo 1 as radiance 1, whatever its shape; with a background
of radiance 1 nothing may be seen, and any trace of the sphere is an error of the pipeline (Heitz 2014 on this test).
"""

from __future__ import annotations

from warp_deferred.camera import Camera
from warp_deferred.checks import check_count, check_range
from warp_deferred.materials import Material
from warp_deferred.scene import Environment, Scene

from .shapes import sphere

__all__ = ["build"]


def build(*, radiance: float = 1.0, segments: int = 64) -> Scene:
    """Build the furnace.

    Args:
        radiance: Radiance of ambient light and background.
        segments: Facets around the sphere.
    """
    value = check_range("furnace.radiance", radiance, 0.0, 60000.0)
    segments = check_count("furnace.segments", segments, 3, 4096)
    scene = Scene("furnace")
    white = Material(model="lambert", name="white")
    scene.add(sphere(1.0, segments, max(2, segments // 2)).mesh("sphere"), material=white)
    scene.environment = Environment(ambient=(value,) * 3, background=(value,) * 3)
    scene.cameras.append(Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), vertical_fov_deg=50.0))
    return scene
