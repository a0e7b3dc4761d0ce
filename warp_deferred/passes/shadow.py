"""Shadow: place the maps' views before clusters are culled, and keep what shading needs to look into them."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..kernels import shadow as kernels
from ..kernels import shadow_bounds as bound_kernels
from ..kernels import structs
from ..kernels.clusters import BOUND_ROWS
from ..kernels.shadow_lookup import BLEND
from ..resources import Resources
from ..sampling import lens_samples
from ..shadow_maps import BORDERS, keeps_maps, light_tangent
from ..shadow_slots import ShadowTable
from ..views import ViewPacker
from .base import Buffer, Pass

__all__ = ["ShadowPass"]


class ShadowPass(Pass):
    """Where the shadow maps stand; the raster draws them with all other views."""

    name = "shadow"
    doc = "place shadow maps for lights and cameras"

    def rung(self) -> str:
        """Rung and number of maps."""
        rung, count = self.request.settings.shadow.rung, self.request.shadow_slots
        return f"{rung}, {count} map{'s' * (count != 1)}" if count else rung

    def reads(self) -> tuple[str, ...]:
        """Nothing but the scene, whose bound points must be up to date."""
        return ("points",) if self.request.features.bound_meshes else ()

    def writes(self) -> dict[str, Buffer]:
        """Rows for the look-up; the views lie behind the cameras' own."""
        count = self.request.shadow_slots
        lights = self.request.cameras * self.request.features.light_capacity
        return {
            "shadow_first": Buffer(wp.int32, lights, persistent=True),
            "shadow_rows": Buffer(wp.vec4, max(4 * count, 1), persistent=True),
            "shadow_tiles": Buffer(wp.vec4i, max(count, 1), persistent=True),
            **({"shadow_bounds": Buffer(wp.vec4, count * int(BOUND_ROWS), persistent=True)} if count else {}),
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
        self.params.tangent = light_tangent(self.request)
        self.params.keep = int(settings.keep_maps)
        # Accumulating reads the counter last, so it lives as long as this pass needs it; 0 in frames of one sample.
        self.counter = resources.channel("sample_counter", wp.int32)
        self.states = wp.zeros(count, dtype=wp.int32, device=resources.device)
        self.keeps = keeps_maps(self.request)
        self.casters = bound_kernels.BoundParams()
        self.casters.first_view, self.casters.border = self.params.first_view, self.params.border
        self.casters.inner, self.casters.distance = 1.0 - float(BLEND), self.params.distance
        self.casters.keep = int(self.keeps)
        # Samples that look through other points of the lens see beyond the frustum.
        self.casters.one_eye = int(lens_samples(self.request) == 1)
        if self.keeps:
            instances = resources.scene.instance_count
            self.before = wp.zeros(instances, dtype=structs.Transform, device=resources.device)
            self.moved = wp.zeros(instances + 1, dtype=wp.int32, device=resources.device)
            bound = [id(resources.scene.meshes[k]) in resources.scene.bound for k in resources.scene.mesh_of]
            self.bound = wp.array(np.array(bound, np.int32), dtype=wp.int32, device=resources.device)
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
            [resources.frame.middle, resources.lights.source, self.slots, self.bounds, self.counter, self.params],
            [resources.frame.views, resources.channels["shadow_rows"], self.states],
            block_dim=kernels.BLOCK_DIM,
        )
        if self.request.candidates:
            program.launch(
                bound_kernels.bound_casters_kernel,
                (count, int(BOUND_ROWS)),
                [resources.frame.middle, resources.frame.views, resources.lights.source, self.slots, self.bounds,
                 self.casters],
                [resources.channels["shadow_bounds"], self.states],
                block_dim=bound_kernels.BLOCK_DIM,
            )  # fmt: skip
        if self.keeps:
            self._keep(resources)

    def _keep(self, resources: Resources) -> None:
        """Find what moved, and draw the maps anew that it touches."""
        from ..kernels import shadow_keep

        program, block = resources.program, shadow_keep.BLOCK_DIM
        geometry, views, first = resources.scene.geometry, resources.frame.views, self.request.cameras
        count, instances = self.request.shadow_slots, resources.scene.instance_count
        inputs = [geometry, self.before, self.bound, self.counter]
        program.launch(shadow_keep.note_moves_kernel, instances, inputs, [self.moved], block_dim=block)
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

    def bytes_moved(self) -> int:
        """Views in and out, rows out."""
        return self.request.shadow_slots * (2 * 192 + 64 + 16)


def _send(array: wp.array, rows: np.ndarray) -> None:
    array.assign(wp.array(rows, dtype=array.dtype, device="cpu", copy=False))
