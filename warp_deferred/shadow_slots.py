"""Shadow slots: which maps a frame has, from what the host declares about lights, cameras and settings.

A slot is one depth-only view behind the cameras' views. Where its light stands, and what a cascade must cover, only
the device knows: `kernels/shadow.py` places the slots before anything is drawn.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from .effect_settings import ShadowSettings
from .kernels import structs
from .lights import Lights

__all__ = ["MAP_RUNGS", "ShadowSlot", "ShadowTable", "beyond_capacity", "plan_slots"]

#: Rungs that look into maps.
MAP_RUNGS = ("hard", "pcf", "pcss")
#: A wider cone does not fit one perspective map and takes the six of a point light.
WIDE_SPOT = math.radians(75.0)


@dataclasses.dataclass(frozen=True)
class ShadowSlot:
    """One shadow map.

    Attributes:
        light: Index in the global order of lights.
        kind: SLOT_SPOT, SLOT_FACE or SLOT_CASCADE of `kernels.structs`.
        part: Which face or cascade.
        camera: View whose slices a cascade covers; of the others the only view that looks them up, -1 where there are
            several.
        world: World that is drawn into it; -1 draws all.
        size: Side [texel].
    """

    light: int
    kind: int
    part: int
    camera: int
    world: int
    size: int


@dataclasses.dataclass(frozen=True)
class ShadowTable:
    """All maps of a frame.

    Attributes:
        slots: In the order of their views; the maps of one light follow one another.
        first: (views, lights) int32: first slot a view finds a light's shadow in, -1 where it has none. Where rays are
            traced and there are no slots: 0 for every light that casts.
    """

    slots: tuple[ShadowSlot, ...]
    first: np.ndarray


def beyond_capacity(casters: Sequence[int], settings: ShadowSettings) -> int:
    """Count casting lights (point, spot, directional) that have no map, since their kind's capacity is used up."""
    if settings.rung not in MAP_RUNGS:
        return 0
    limits = (settings.point_lights, settings.spot_lights, settings.directional_lights)
    return sum(max(0, count - limit) for count, limit in zip(casters, limits, strict=True))


def plan_slots(lights: Lights, worlds: Sequence[int], settings: ShadowSettings) -> ShadowTable:
    """Give the casting lights their maps, kind by kind in the order of lights, as far as capacities reach.

    A map shows one world: the light's own, or for a light of all worlds the camera's. So a point or spot light of all
    worlds has one set of maps for each world that some camera sees, a directional light has cascades for every camera.

    Args:
        lights: All lights; their `casts_shadow`, `world` and `outer_angle` count.
        worlds: World of each camera.
        settings: Rung, sizes and capacities.
    """
    first = np.full((len(worlds), len(lights)), -1, np.int32)
    slots: list[ShadowSlot] = []
    start = 0
    for kind, group in lights.groups():
        casting = np.flatnonzero(group.casts_shadow)
        if settings.rung in MAP_RUNGS:
            for k in casting[: getattr(settings, f"{kind}_lights")]:
                shape = _shape(kind, group, k, settings)
                _add_light(slots, first, start + int(k), int(group.world[k]), worlds, *shape)
        else:
            first[:, start + casting] = 0
        start += len(group)
    return ShadowTable(tuple(slots), first)


def _shape(kind: str, group: object, k: int, settings: ShadowSettings) -> tuple[int, int, int]:
    """(slot kind, maps, side) of a light."""
    if kind == "directional":
        return int(structs.SLOT_CASCADE), settings.cascades, settings.directional_size
    if kind == "spot" and group.outer_angle[k] <= WIDE_SPOT:
        return int(structs.SLOT_SPOT), 1, settings.spot_size
    return int(structs.SLOT_FACE), 6, settings.point_size


def _add_light(
    slots: list[ShadowSlot], first: np.ndarray, light: int, world: int, worlds: Sequence[int], kind: int, parts: int,
    size: int,
) -> None:  # fmt: skip
    known: dict[int, int] = {}
    for camera, seen in enumerate(worlds):
        if world >= 0 and seen >= 0 and world != seen:
            continue
        drawn = world if world >= 0 else seen
        if kind == int(structs.SLOT_CASCADE) or drawn not in known:
            known[drawn] = len(slots)
            slots += [ShadowSlot(light, kind, part, camera, drawn, size) for part in range(parts)]
        else:
            place = known[drawn]
            slots[place : place + parts] = [dataclasses.replace(s, camera=-1) for s in slots[place : place + parts]]
        first[camera, light] = known[drawn]
