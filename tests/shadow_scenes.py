"""Scenes with a light of each kind and a caster, and the share of its light that arrives, for the tests of shadows.

What a light adds with a rung divided by what it adds with `off` is the share of it that arrives. Scenes are analytic:
a plate or a box over a floor, so that the ray from a pixel to the light says whether it is in shadow, and how far from
the shadow's edge it is.
"""

from __future__ import annotations

import numpy as np
from builders import box, grid, images, tilt

import warp_deferred as wd

__all__ = [
    "CLAY", "MAPS", "NAMES", "PLACE", "RUNGS", "TOWARDS", "add_light", "drawn", "edge_errors", "mixed_scene",
    "past_edge", "plate_scene", "render", "share", "to_light", "with_rung",
]  # fmt: skip

CLAY = wd.Material(model="lambert", base_color=(0.8, 0.8, 0.8, 1.0))
SMALL = (
    "shadow.directional_size=512", "shadow.spot_size=256", "shadow.point_size=128", "shadow.samples=16",
    "gbuffer.rung=full",
)  # fmt: skip
MAPS = ("hard", "pcf", "pcss")
RUNGS = (*MAPS, "ray_traced")
NAMES = ("diffuse", "position", "normal", "light_count")
#: Where the lights of the test scenes stand, and where they shine.
PLACE, TOWARDS = np.array([1.5, 4.0, 1.0]), np.array([-1.5, -4.0, -1.0])


def with_rung(rung, *values):
    return wd.Settings().with_values([*SMALL, f"shadow.rung={rung}", *values])


def render(scene, rung, device, *values, names=NAMES, size=(96, 72), **fields):
    renderer = wd.Renderer(
        scene, width=size[0], height=size[1], device=device, outputs=names, settings=with_rung(rung, *values), **fields
    )
    return images(renderer.render())


def share(scene, rung, device, *values, **fields):
    """Share of the light that arrives, NaN where none would; and the images of the frame without shadows."""
    whole = render(scene, "off", device, *values, **fields)
    shaded = render(scene, rung, device, *values, **fields)
    with np.errstate(invalid="ignore", divide="ignore"):
        return shaded["diffuse"][..., 1] / whole["diffuse"][..., 1], whole


def add_light(scene, kind, **fields):
    """Add one white light that casts shadows."""
    fields = {"casts_shadow": True, "source_radius": 0.02} | fields
    if kind == "directional":
        fields.pop("source_radius")
        scene.lights.add(wd.DirectionalLight(direction=TOWARDS, intensity=2.0, **fields))
    elif kind == "point":
        scene.lights.add(wd.PointLight(position=PLACE, intensity=30.0, **fields))
    else:
        angle = {"spot": 0.7, "wide spot": 1.5}[kind]
        scene.lights.add(
            wd.SpotLight(position=PLACE, direction=TOWARDS, intensity=30.0, **{"outer_angle": angle} | fields)
        )


def plate_scene(kind, **fields):
    """Return a floor with a square plate of side 1 at height 1."""
    scene = wd.Scene()
    scene.add(grid(1, 8.0), transform=tilt(-90.0), material=CLAY)
    scene.add(grid(2, 1.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, 1.0, 0.0)), material=CLAY)
    add_light(scene, kind, **fields)
    scene.camera = wd.Camera.look_at((-1.2, 3.0, 2.6), (-0.2, 0.0, 0.0), vertical_fov_deg=50.0)
    return scene


def to_light(kind, points):
    """Vectors from points to the test scenes' light."""
    return PLACE - points if kind != "directional" else np.broadcast_to(-TOWARDS, points.shape)


def past_edge(kind, floor):
    """Distance [m], in the plate's plane, by which the ray to the light misses the plate; negative: it hits."""
    ray = to_light(kind, floor)
    at_plate = floor + ray / ray[..., 1:2]
    return np.maximum(np.abs(at_plate[..., 0]), np.abs(at_plate[..., 2])) - 0.5


def mixed_scene():
    """Return a scene with a light of every kind, all casting, over shapes that shadow one another."""
    scene = plate_scene("directional")
    scene.add(box(0.6), transform=tilt(0.0, 30.0, 1.0, (1.2, 0.3, -0.6)), material=CLAY)
    for kind in ("point", "spot", "wide spot"):
        add_light(scene, kind)
    scene.lights.point.position = np.array([[-1.4, 2.0, 1.2]])
    return scene


def edge_scene(turn_deg=0.0):
    """Return a floor under the straight edge of a plate, 0.4 m above it, lit from straight above.

    The edge is at x = 0, turned by an angle about the vertical through the origin.
    """
    scene = wd.Scene()
    scene.add(grid(1, 4.0), transform=tilt(-90.0), material=CLAY)
    a = np.radians(turn_deg)
    place = (-1.5 * np.cos(a), 0.4, 1.5 * np.sin(a))
    scene.add(grid(1, 3.0), transform=tilt(-90.0, turn_deg, move=place), material=CLAY)
    scene.lights.add(wd.DirectionalLight(direction=(0.0, -1.0, 0.0), intensity=2.0, casts_shadow=True))
    scene.camera = wd.Camera.look_at((0.9, 0.35, 0.0), (-0.05, 0.0, 0.0), vertical_fov_deg=30.0)
    return scene


def edge_errors(rung, angle_deg, device, *values, turn_deg=0.0):
    """Difference from the closed form, and the distance from the edge in units of the half penumbra."""
    values = (f"shadow.directional_angle_deg={angle_deg}", "shadow.cascades=1", "shadow.distance_m=2.0", *values)
    factor, whole = share(edge_scene(turn_deg), rung, device, *values, size=(144, 108))
    # What the one map holds.
    floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
    floor &= np.abs(whole["position"][..., 0]) < 0.6
    a = np.radians(turn_deg)
    across = whole["position"][..., 0] * np.cos(a) - whole["position"][..., 2] * np.sin(a)
    place = across[floor] / (0.4 * np.tan(np.radians(angle_deg)))
    d = np.clip(place, -1.0, 1.0)
    seen = 0.5 + (d * np.sqrt(1.0 - d * d) + np.arcsin(d)) / np.pi
    return factor[floor] - seen, place


def drawn(renderer):
    """Which maps the last frame drew anew."""
    count = renderer.plan.request.shadow_slots
    return renderer.plan.resources.frame.views.numpy()["skipped"][-count:] == 0
