"""The cases all peers are given, frozen: one terrain under cameras and lights that each of them can be told of.

Lights with shadows are spots: every peer that has shadows has spots, and one map a light is what shadow maps are best
at. Their cones have the cosines 0.95 and 0.85, which Newton's spots have built in.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warp_deferred import Camera, Scene, SpotLight, load
from warp_deferred.checks import input_error

from ..cases import reachable_mean, terrain_scene

__all__ = ["KINDS", "PeerCase", "narrowed", "peer_cases"]

#: Kinds of cases, in the order of the tables, and what a frame of each is.
KINDS = {
    "gbuffer": "G-buffer only: nearest surface of each pixel with its depth, normal and material",
    "lit": "point lights, none with a shadow, and ambient light",
    "shadowed": "spot lights that cast shadows, and ambient light",
    "frame": "whole frame: many point lights, a few spot lights with shadows, ambient light",
}
#: Cosines of a spot's cone: full light within the first, none beyond the second.
COSINES = (0.95, 0.85)
#: Direction the spots shine in: from aside, so that hills throw shadows.
TILT = (0.5, -1.0, -0.35)
#: Half of the ground's side that spots are spread over [m].
HALF_SIDE = 6.0


@dataclasses.dataclass(frozen=True)
class PeerCase:
    """One case.

    Attributes:
        name: Key in results.
        kind: Key of `KINDS`.
        title: What it is, in words.
        width: Width of a view [px].
        height: Height of a view [px].
        triangles: Triangles wanted.
        views: Views in one frame.
        lights: Point lights.
        shadowed: Spot lights, each with a shadow.
        map_size: Side of a spot light's shadow map, where a peer has maps [texel].
    """

    name: str
    kind: str
    title: str
    width: int
    height: int
    triangles: int
    views: int = 1
    lights: int = 0
    shadowed: int = 0
    map_size: int = 1024

    def build(self) -> Scene:
        """Build the scene: terrain and lights; a G-buffer needs no lights."""
        if self.kind == "gbuffer":
            return terrain_scene(round(math.sqrt(self.triangles / 2)) + 1)
        mean = f"&mean={reachable_mean(self.lights, 5):g}" if self.lights else ""
        scene = load(f"terrain?triangles={self.triangles}&lights={self.lights}{mean}")
        if not self.lights:
            scene.lights.clear()
        add_spots(scene, self.shadowed)
        return scene

    def cameras(self, scene: Scene) -> list[Camera]:
        """Cameras of all views: the scene's own, or a ring around the terrain."""
        if self.views == 1:
            return [scene.camera]
        turns = 2.0 * math.pi * np.arange(self.views) / self.views
        eyes = [(9.0 * math.sin(turn), 3.0, 9.0 * math.cos(turn)) for turn in turns]
        return [Camera.look_at(eye, (0.0, 0.0, 0.0), vertical_fov_deg=60.0, near=0.05) for eye in eyes]


def add_spots(scene: Scene, count: int) -> None:
    """Turn spot lights to the middle of the terrain, each to a cell of a square grid, which its cone covers."""
    across = math.ceil(math.sqrt(count))
    spacing = 2.0 * HALF_SIDE / max(across, 1)
    above = 0.6 * math.sqrt(2.0) * spacing * COSINES[1] / math.sqrt(1.0 - COSINES[1] ** 2)
    for k in range(count):
        row, column = divmod(k, across)
        x, z = (-HALF_SIDE + (place + 0.5) * spacing for place in (column, row))
        scene.lights.add(
            SpotLight(
                position=(x - TILT[0] * above, above, z - TILT[2] * above),
                direction=TILT,
                intensity=4.0 * above**2,
                range=3.0 * above,
                inner_angle=math.acos(COSINES[0]),
                outer_angle=math.acos(COSINES[1]),
                casts_shadow=True,
            )
        )


def peer_cases(*, quick: bool) -> tuple[PeerCase, ...]:
    """List the cases; with `quick`, one of each kind at a tiny size."""
    full = {"1080p": (1920, 1080), "4k": (3840, 2160)}
    n = 500_000
    if quick:
        full, n = {"quick": (96, 64)}, 2000
    first = next(iter(full.items()))
    text = f"terrain, {n // 1000} k triangles"
    cases = [PeerCase(f"gbuffer_{name}", "gbuffer", f"{text}, {w}x{h}", w, h, n) for name, (w, h) in full.items()]
    views, side = (3, 32) if quick else (64, 256)
    cases.append(
        PeerCase(f"gbuffer_views_{views}", "gbuffer", f"{text}, {views} views of {side}x{side}", side, side, n, views)
    )
    name, (w, h) = first
    for lights in (5,) if quick else (1, 16, 200, 1000):
        what = f"{lights} light{'s' * (lights > 1)}"
        cases.append(PeerCase(f"lit_{lights}", "lit", f"{text}, {what}, {w}x{h}", w, h, n, lights=lights))
    for casting in (2,) if quick else (1, 4, 16):
        what = f"{casting} shadowed light{'s' * (casting > 1)}"
        cases.append(PeerCase(f"shadowed_{casting}", "shadowed", f"{text}, {what}, {w}x{h}", w, h, n, shadowed=casting))
    lights, casting = (5, 1) if quick else (1000, 4)
    for name, (w, h) in full.items():
        what = f"{lights} lights and {casting} shadowed"
        cases.append(
            PeerCase(f"frame_{name}", "frame", f"{text}, {what}, {w}x{h}", w, h, n, lights=lights, shadowed=casting)
        )
    return tuple(dataclasses.replace(case, map_size=128) if quick else case for case in cases)


def narrowed(only: str, *, quick: bool) -> list[PeerCase]:
    """List the cases with `only` in their names; all of them if it is empty.

    Raises:
        InputError: If there is none.
    """
    cases = peer_cases(quick=quick)
    chosen = [case for case in cases if only in case.name]
    if not chosen:
        raise input_error("--only", f"a part of one of {', '.join(case.name for case in cases)}", only)
    return chosen
