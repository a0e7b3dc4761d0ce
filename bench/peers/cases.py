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


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Numbers of the cases on one kind of device; see `PeerCase`."""

    sizes: dict[str, tuple[int, int]]
    triangles: int
    views: tuple[int, int]  # how many, and their side [px]
    lights: tuple[int, ...]
    shadowed: tuple[int, ...]
    whole: tuple[int, int]  # lights and shadowed lights of a whole frame
    map_size: int


_SIZES = {
    "cuda": _Sizes(
        {"1080p": (1920, 1080), "4k": (3840, 2160)}, 500_000, (64, 256), (1, 16, 200, 1000), (1, 4, 16), (1000, 4), 1024
    ),
    "cpu": _Sizes({"360p": (640, 360)}, 20_000, (4, 128), (1, 16, 200), (1, 4), (200, 1), 512),
    "quick": _Sizes({"quick": (96, 64)}, 2000, (3, 32), (5,), (2,), (5, 1), 128),
}


def peer_cases(device_is_cuda: bool, *, quick: bool = False) -> tuple[PeerCase, ...]:
    """List the cases of a kind of device; with `quick`, one of each kind at a tiny size."""
    of = _SIZES["quick" if quick else "cuda" if device_is_cuda else "cpu"]
    text = f"terrain, {of.triangles // 1000} k triangles"
    shared = {"triangles": of.triangles, "map_size": of.map_size}

    def case(name: str, kind: str, what: str, size: tuple[int, int], **numbers: int) -> PeerCase:
        title = ", ".join(part for part in (text, what) if part)
        return PeerCase(f"{kind}_{name}", kind, title, *size, **shared, **numbers)

    first = next(iter(of.sizes.values()))
    views, side = of.views
    cases = [case(name, "gbuffer", "{}x{}".format(*size), size) for name, size in of.sizes.items()]
    cases.append(case(f"views_{views}", "gbuffer", f"{views} views of {side}x{side}", (side, side), views=views))
    screen = "{}x{}".format(*first)
    for lights in of.lights:
        cases.append(case(str(lights), "lit", f"{_counted(lights, 'light')}, {screen}", first, lights=lights))
    for casting in of.shadowed:
        what = f"{_counted(casting, 'shadowed light')}, {screen}"
        cases.append(case(str(casting), "shadowed", what, first, shadowed=casting))
    lights, casting = of.whole
    for name, size in of.sizes.items():
        what = f"{lights} lights and {casting} shadowed, " + "{}x{}".format(*size)
        cases.append(case(name, "frame", what, size, lights=lights, shadowed=casting))
    return tuple(cases)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count > 1)}"


def narrowed(only: str, device_is_cuda: bool, *, quick: bool) -> list[PeerCase]:
    """List the cases with `only` in their names; all of them if it is empty.

    Raises:
        InputError: If there is none.
    """
    cases = peer_cases(device_is_cuda, quick=quick)
    chosen = [case for case in cases if only in case.name]
    if not chosen:
        raise input_error("--only", f"a part of one of {', '.join(case.name for case in cases)}", only)
    return chosen
