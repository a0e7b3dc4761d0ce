"""Shadow: place the maps' views before clusters are culled, and keep what shading needs to look into them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from ..kernels import shadow as kernels
from ..kernels import structs
from ..program import FIRST
from ..resources import Resources
from ..shadow_slots import ShadowTable, shadow_reason
from ..views import ViewPacker
from .base import Buffer, Pass, Request

__all__ = ["ShadowPass", "clear_maps", "keeps_maps", "make_shadows", "shadow_arguments", "shadow_channels"]

#: Texels a map keeps beyond what it must hold, by rung: the filter's radius, and how far a point is lifted.
BORDERS = {"hard": 3.0, "pcf": 6.0, "pcss": 40.0}


def shadow_channels(request: Request) -> list[str]:
    """Channels that shading reads to look shadows up."""
    if not shadow_reason(request.outputs, request.features, request.settings.shadow):
        return []
    names = ["shadow_first", "shadow_rows", "shadow_tiles"]
    return names + ["depth_keys"] * (request.shadow_slots > 0 and request.candidates > 0)


def shadow_arguments(request: Request) -> tuple[Any, ...] | None:
    """What `make_shade_kernel` takes for `shadow`: the rung and its look-up's arguments, or None without shadows."""
    settings, features = request.settings.shadow, request.features
    if not shadow_reason(request.outputs, features, settings):
        return None
    if settings.rung == "ray_traced":
        return settings.rung, settings.samples, settings.cull, features.masked
    point, spot, directional = (count > 0 for count in features.casters)
    # A wide spot has the maps of a point light; angles may change without another plan.
    kinds = spot + 2 * (point or spot) + 4 * directional
    return settings.rung, kinds, BORDERS[settings.rung]


def make_shadows(resources: Resources, request: Request) -> Any:
    """Struct over what the look-up of a plan reads; empty arrays where it has none."""
    if shadow_channels(request) and request.settings.shadow.rung == "ray_traced":
        from ..kernels.shadow_rays import ShadowRays

        rays, scene = ShadowRays(), resources.scene
        trees = scene.rays()
        rays.first, rays.source = resources.channels["shadow_first"], resources.lights.source
        rays.geometry, rays.materials = scene.geometry, scene.materials
        rays.meshes, rays.worlds, rays.inverses = trees.meshes, trees.worlds, trees.inverses
        rays.tree = trees.tree.id
        rays.tangent = _tangent(request)
        return rays
    maps = structs.ShadowMaps()
    maps.first = resources.channel("shadow_first", wp.int32)
    maps.rows = resources.channel("shadow_rows", wp.vec4)
    maps.tiles = resources.channel("shadow_tiles", wp.vec4i)
    maps.keys = resources.channel("depth_keys", wp.uint32)
    return maps


def _tangent(request: Request) -> float:
    return math.tan(math.radians(request.settings.shadow.directional_angle_deg))


def keeps_maps(request: Request) -> bool:
    """Whether maps stay from frame to frame; the passes before shading then leave them alone."""
    return request.shadow_slots > 0 and request.candidates > 0 and request.settings.shadow.keep_maps


def clear_maps(resources: Resources, request: Request) -> None:
    """Clear the maps that are drawn anew, beside the step before."""
    from ..kernels import shadow_keep

    layout, chunk = resources.layout, int(shadow_keep.CHUNK)
    views = range(request.cameras, len(layout.sizes))
    owners = np.repeat(
        np.array(views, np.int32), [layout.sizes[v].width * layout.sizes[v].height // chunk for v in views]
    )
    chunks = wp.array(owners, dtype=wp.int32, device=resources.device)
    resources.program.launch(
        shadow_keep.clear_maps_kernel,
        layout.depth_pixels // int(shadow_keep.CLEARED),
        [resources.frame.views, chunks, FIRST],
        [resources.channels["depth_keys"]],
        block_dim=shadow_keep.BLOCK_DIM,
        band=chunk,
        beside=True,
    )


class ShadowPass(Pass):
    """Where the shadow maps stand; the raster draws them with all other views."""

    name = "shadow"
    doc = "place shadow maps for lights and cameras"

    def called_for(self) -> str | None:
        """Lights that cast shadows."""
        return shadow_reason(self.request.outputs, self.request.features, self.request.settings.shadow)

    def why_not(self) -> str:
        """Reason why it does not run."""
        if self.request.settings.shadow.rung == "off":
            return "shadow.rung is off"
        return "no lit output asked for" if sum(self.request.features.casters) else "no light casts a shadow"

    def rung(self) -> str:
        """Rung and number of maps."""
        rung, count = self.request.settings.shadow.rung, self.request.shadow_slots
        return f"{rung}, {count} map{'s' * (count != 1)}" if count else rung

    def reads(self) -> tuple[str, ...]:
        """Nothing but the scene."""
        return ()

    def writes(self) -> dict[str, Buffer]:
        """Rows for the look-up; the views lie behind the cameras' own."""
        count = self.request.shadow_slots
        lights = self.request.cameras * self.request.features.light_capacity
        return {
            "shadow_first": Buffer(wp.int32, lights, persistent=True),
            "shadow_rows": Buffer(wp.vec4, max(4 * count, 1), persistent=True),
            "shadow_tiles": Buffer(wp.vec4i, max(count, 1), persistent=True),
        }

    def prepare(self, resources: Resources) -> None:
        """Fill what settings decide."""
        settings = self.request.settings.shadow
        count = max(self.request.shadow_slots, 1)
        self.slots = wp.zeros(count, dtype=wp.vec4i, device=resources.device)
        self.bounds = wp.zeros(6, dtype=wp.float32, device=resources.device)
        self.params = kernels.ShadowParams()
        self.params.first_view, self.params.cascades = self.request.cameras, settings.cascades
        self.params.border = BORDERS.get(settings.rung, 0.0)
        self.params.distance = settings.distance_m or math.inf
        self.params.split_blend = settings.split_blend
        self.params.tangent = _tangent(self.request)
        self.params.keep = int(keeps_maps(self.request))
        self.states = wp.zeros(count, dtype=wp.int32, device=resources.device)
        if self.params.keep:
            instances = resources.scene.instance_count
            self.before = wp.zeros(instances, dtype=structs.Transform, device=resources.device)
            self.moved = wp.zeros(instances + 1, dtype=wp.int32, device=resources.device)
        self.cascaded = min(self.request.features.casters[2], settings.directional_lights) > 0

    def stage(
        self, resources: Resources, packer: ViewPacker, table: ShadowTable, ranges: list[tuple[int, ...]]
    ) -> None:
        """Upload what changes only with declarations: which light a map belongs to, which world it draws.

        Args:
            resources: The plan's.
            packer: The plan's.
            table: The maps, as many as the plan has.
            ranges: For each map what `ViewPacker.write` takes for a view.
        """
        first = np.full((self.request.cameras, self.request.features.light_capacity), -1, np.int32)
        first[:, : table.first.shape[1]] = table.first
        channels = resources.channels
        _send(channels["shadow_first"], first.reshape(-1))
        if not table.slots:
            return
        cameras = self.request.cameras
        _send(self.slots, np.array([(s.light, s.kind, s.part, s.camera) for s in table.slots], np.int32))
        fields = self.layout.fields[cameras:]
        parts = self.request.settings.shadow.cascades
        tiles = [(fields[k][0], s.size, s.kind, parts - s.part) for k, s in enumerate(table.slots)]
        _send(channels["shadow_tiles"], np.array(tiles, np.int32))
        worlds = [s.world for s in table.slots]
        resources.frame.write_slots(packer.slot_rows(cameras, worlds, ranges, self.request.settings.shadow.cull))

    def run(self, resources: Resources) -> None:
        """The scene's box where a cascade needs it, then the views."""
        program, count = resources.program, self.request.shadow_slots
        if self.request.settings.shadow.rung == "ray_traced":
            self._place_instances(resources)
        if not count:
            return
        if self.cascaded:
            program.launch(kernels.clear_bounds_kernel, 6, [], [self.bounds], block_dim=kernels.BLOCK_DIM)
            instances = resources.scene.instance_count
            program.launch(
                kernels.bound_instances_kernel,
                instances,
                [resources.scene.geometry, instances],
                [self.bounds],
                block_dim=kernels.BLOCK_DIM,
            )
        program.launch(
            kernels.place_slots_kernel,
            count,
            [resources.lights.source, self.slots, self.bounds, self.params],
            [resources.frame.views, resources.channels["shadow_rows"], self.states],
            block_dim=kernels.BLOCK_DIM,
        )
        if self.params.keep:
            self._keep(resources)

    def _keep(self, resources: Resources) -> None:
        """Find what moved, and draw the maps anew that it touches."""
        from ..kernels import shadow_keep

        program, block = resources.program, shadow_keep.BLOCK_DIM
        geometry, views, first = resources.scene.geometry, resources.frame.views, self.request.cameras
        count, instances = self.request.shadow_slots, resources.scene.instance_count
        program.launch(shadow_keep.note_moves_kernel, instances, [geometry, self.before], [self.moved], block_dim=block)
        program.launch(
            shadow_keep.touch_slots_kernel,
            (count, instances),
            [views, geometry, self.before, self.moved, first],
            [self.states],
            block_dim=block,
        )
        program.launch(
            shadow_keep.settle_slots_kernel,
            max(count, instances),
            [geometry, first, count, instances],
            [self.states, views, self.before, self.moved],
            block_dim=block,
        )

    def _place_instances(self, resources: Resources) -> None:
        from ..kernels import shadow_rays

        scene, rays = resources.scene, resources.scene.rays()
        resources.program.launch(
            shadow_rays.place_instances_kernel,
            scene.instance_count,
            [scene.geometry],
            [rays.low, rays.high, rays.inverses],
            block_dim=shadow_rays.BLOCK_DIM,
        )
        resources.program.call(rays.tree.refit)

    def bytes_moved(self) -> int:
        """Views in and out, rows out."""
        return self.request.shadow_slots * (2 * 184 + 64 + 16)


def _send(array: wp.array, rows: np.ndarray) -> None:
    array.assign(wp.array(rows, dtype=array.dtype, device="cpu", copy=False))
