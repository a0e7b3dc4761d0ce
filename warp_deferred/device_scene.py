"""The scene on a device: geometry, materials, instances, and the staging of what a frame may change.

Instances are sorted by world, the ones every world shares first, so that a view's instances are two ranges. Visible
ids follow the public order of instances, padded to whole clusters, so that id -> instance is one table look-up.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .clustering import CLUSTER_SIZE, Clusters, cut_clusters
from .device_arrays import as_float_array
from .errors import CapacityError
from .features import MODELS
from .kernels import clusters as cluster_kernels
from .kernels import structs
from .materials import Material
from .normals import smooth_normals
from .scene import Mesh, Scene
from .textures import WRAP_CODES, TextureStore

if TYPE_CHECKING:
    from .point_store import PointStore
    from .ray_scene import RayScene

__all__ = ["DeviceScene"]

MAX_BLOCKS = 2**32 // CLUSTER_SIZE - 1
MAX_ELEMENTS = 2**31 - 1
_cut_cache: dict[tuple[int, bool], tuple[weakref.ref, Clusters, np.ndarray | None]] = {}


def _capacity(count: int, whole: int) -> int:
    """Exact for a view of everything, else the next power of two, so that moving between worlds keeps the plan."""
    if count <= 0:
        return 0
    return count if count % max(whole, 1) == 0 else 1 << (count - 1).bit_length()


def _prepare(mesh: Mesh, moving: bool) -> tuple[Clusters, np.ndarray | None]:
    """Clusters and normals of a mesh, made once per mesh; None for normals means each face's own.

    Of a mesh with moving points all that is made every frame is left for the device to fill in.
    """
    key = (id(mesh.positions), moving)
    if key not in _cut_cache or _cut_cache[key][0]() is not mesh.positions:
        normals = mesh.normals
        if moving:
            normals = np.zeros_like(mesh.positions) if normals is not None or mesh.smooth else None
        elif normals is None and mesh.smooth and len(mesh.triangles):
            normals = smooth_normals(mesh.positions, mesh.triangles)
        reference = weakref.ref(mesh.positions, lambda _: _cut_cache.pop(key, None))
        _cut_cache[key] = (reference, cut_clusters(mesh.positions, mesh.triangles, moving=moving), normals)
    return _cut_cache[key][1:]


class DeviceScene:
    """Everything of a scene that lives on the device and does not depend on the view.

    Attributes:
        geometry: `structs.Geometry` for kernels.
        materials: Array of `structs.Material`.
        points: What meshes with bound points need; None where no mesh has them.
        order: Index in `Scene.instances` of each instance on the device.
        first_vertex: id of a mesh -> its first vertex.
        first_triangle: id of a mesh -> its first triangle.
        cluster_range: id of a mesh -> its first cluster, clusters.
        triangle_count: Triangles over all instances.
        cluster_slots: (instance, cluster) pairs.
        meshes: Each mesh once.
        bound: id of each mesh with bound points.
        mesh_of: Index in `meshes` of each instance, in the order of instances on the device.
        worlds: World of each instance, in that order.
        placed: (n, 4) int64: slot, first row of Geometry.triangles, triangles and world of each instance.
        bytes: Device memory held.
    """

    def __init__(self, scene: Scene, device: wp.Device) -> None:
        self.device = device
        self.meshes = list({id(i.mesh): i.mesh for i in scene.instances}.values())
        self.bound = {id(mesh) for binding in scene.point_bindings for mesh in binding.meshes}
        prepared = {id(m): _prepare(m, id(m) in self.bound) for m in self.meshes}
        self._check_capacity(scene, prepared)
        self.order = sorted(range(len(scene.instances)), key=lambda k: (scene.instances[k].world, k))
        numbers = {id(mesh): k for k, mesh in enumerate(self.meshes)}
        self.mesh_of = [numbers[id(scene.instances[k].mesh)] for k in self.order]
        self.worlds = [scene.instances[k].world for k in self.order]
        self._rays: RayScene | None = None
        self._textures = TextureStore(device)
        self._build_materials(scene)
        self.geometry = structs.Geometry()
        self._arrays: dict[str, wp.array] = {}
        self._build_meshes(prepared)
        self._build_instances(scene, prepared)
        self.bytes = sum(a.capacity for a in self._arrays.values()) + self._textures.bytes
        self.points: PointStore | None = None
        if self.bound:
            # Its kernels are imported for the scenes that need them alone.
            from .point_store import PointStore

            self.points = PointStore(scene, self)
            self.bytes += self.points.bytes
        self.update_transforms(scene)

    @staticmethod
    def _check_capacity(scene: Scene, prepared: dict[int, tuple[Clusters, np.ndarray | None]]) -> None:
        blocks = sum(-(-len(i.mesh.triangles) // CLUSTER_SIZE) for i in scene.instances)
        slots = sum(len(prepared[id(i.mesh)][0].first) for i in scene.instances)
        vertices = sum(len(m.positions) for m in {id(i.mesh): i.mesh for i in scene.instances}.values())
        for name, got, most in (
            ("triangles (in blocks of 128 per instance)", blocks, MAX_BLOCKS),
            ("clusters over all instances", slots, MAX_ELEMENTS),
            ("vertices over all meshes", vertices, MAX_ELEMENTS),
        ):
            if got > most:
                raise CapacityError(f"Scene: expected at most {most} {name}, got {got}; split the scene")

    def _put(self, name: str, data: np.ndarray, dtype: type) -> wp.array:
        if not len(data):
            data = np.zeros((1, *data.shape[1:]), data.dtype)
        self._arrays[name] = wp.array(data, dtype=dtype, device=self.device)
        return self._arrays[name]

    def _build_materials(self, scene: Scene) -> None:
        self._material_of: dict[int, int] = {}
        rows = []
        for instance in scene.instances:
            if id(instance.material) not in self._material_of:
                self._material_of[id(instance.material)] = len(rows)
                rows.append(self._material(instance.material))
        self.material_count = len(rows)
        self.materials = wp.array(rows or [structs.Material()], dtype=structs.Material, device=self.device)

    def _material(self, m: Material) -> structs.Material:
        row = structs.Material()
        row.base_color = wp.vec4(*m.base_color)
        row.emissive = wp.vec3(*m.emissive)
        row.metallic, row.roughness = m.metallic, m.roughness
        row.specular, row.shininess = wp.vec3(*m.specular), m.shininess
        row.occlusion_strength, row.alpha_cutoff = m.occlusion_strength, m.alpha_cutoff
        row.model = MODELS[m.model]
        textured = 0
        for bit, (name, texture) in enumerate(
            zip(("base_color", "metallic_roughness", "emissive", "occlusion"), m.textures, strict=True)
        ):
            if texture is None:
                continue
            textured |= 1 << bit
            setattr(row, f"{name}_texture", self._textures.filtered(texture))
            setattr(row, f"{name}_size", wp.vec2(float(texture.pixels.shape[1]), float(texture.pixels.shape[0])))
        row.textured = textured
        if m.alpha_mode == "mask":
            row.flags = int(structs.FLAG_MASKED)
            if m.base_color_texture is not None:
                row.mask_texture = self._textures.mask(m.base_color_texture)
                row.mask_wrap = wp.vec2i(*(WRAP_CODES[w] for w in m.base_color_texture.wrap))
        return row

    def _build_meshes(self, prepared: dict[int, tuple[Clusters, np.ndarray | None]]) -> None:
        self.first_vertex, self.first_triangle, self.cluster_range = {}, {}, {}
        vertex = triangle = cluster_row = cluster = 0
        parts: dict[str, list[np.ndarray]] = {
            k: [] for k in ("positions", "normals", "uvs", "colors", "triangles", "rows", "clusters")
        }
        any_normals = any(n is not None for _, n in prepared.values())
        any_uvs = any(m.uvs is not None for m in self.meshes)
        any_colors = any(m.colors is not None for m in self.meshes)
        for mesh in self.meshes:
            cut, normals = prepared[id(mesh)]
            count = len(mesh.positions)
            self.first_vertex[id(mesh)], self.first_triangle[id(mesh)] = vertex, triangle
            self.cluster_range[id(mesh)] = cluster, len(cut.first)
            parts["positions"].append(mesh.positions)
            if any_normals:
                parts["normals"].append(np.zeros((count, 3), np.float32) if normals is None else normals)
            if any_uvs:
                parts["uvs"].append(np.zeros((count, 2), np.float32) if mesh.uvs is None else mesh.uvs)
            if any_colors:
                parts["colors"].append(np.ones((count, 4), np.float32) if mesh.colors is None else mesh.colors)
            parts["triangles"].append(mesh.triangles + vertex)
            parts["rows"].append(cut.triangles + np.array([vertex, vertex, vertex, 0], np.int32))
            table = np.zeros(len(cut.first), np.dtype(structs.Cluster.numpy_dtype()))
            for name in ("center", "radius", "axis", "cutoff", "count"):
                table[name] = getattr(cut, name)
            table["first"] = cut.first + cluster_row
            parts["clusters"].append(table)
            vertex += count
            triangle += len(mesh.triangles)
            cluster_row += len(cut.triangles)
            cluster += len(cut.first)
        empty = {"uvs": (0, 2), "colors": (0, 4), "rows": (0, 4)}
        joined = {k: np.concatenate(p) if p else np.zeros(empty.get(k, (0, 3)), np.float32) for k, p in parts.items()}
        if not parts["clusters"]:
            joined["clusters"] = np.zeros(0, np.dtype(structs.Cluster.numpy_dtype()))
        g = self.geometry
        g.positions = self._put("positions", _padded(joined["positions"], np.float32), wp.vec4)
        g.normals = self._put("normals", _padded(joined["normals"], np.float32), wp.vec4)
        g.uvs = self._put("uvs", joined["uvs"], wp.vec2)
        g.colors = self._put("colors", joined["colors"], wp.vec4)
        g.triangles = self._put("triangles", _padded(joined["triangles"], np.int32), wp.vec4i)
        g.cluster_triangles = self._put("cluster_triangles", joined["rows"].astype(np.int32), wp.vec4i)
        g.clusters = self._put("clusters", joined["clusters"], structs.Cluster)

    def _build_instances(self, scene: Scene, prepared: dict[int, tuple[Clusters, np.ndarray | None]]) -> None:
        instances = scene.instances
        sizes = [-(-len(i.mesh.triangles) // CLUSTER_SIZE) for i in instances]
        bases = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        table = np.zeros(len(instances), np.dtype(structs.Instance.numpy_dtype()))
        blocks = np.zeros(int(bases[-1]), np.int32)
        self.placed = np.zeros((len(instances), 4), np.int64)
        slots: list[np.ndarray] = []
        starts: dict[int, tuple[int, int]] = {}
        slot_count = 0
        for place, k in enumerate(self.order):
            instance, mesh = instances[k], instances[k].mesh
            cut, normals = prepared[id(mesh)]
            row = table[place]
            row["mesh_origin"] = mesh.origin
            if len(cut.first):
                row["bounds_low"], row["bounds_high"] = cut.low.min(axis=0), cut.high.max(axis=0)
            # In float64: two float32 corners may lie farther apart than float32 reaches; the grid stays normal.
            extent = float(np.subtract(row["bounds_high"], row["bounds_low"], dtype=np.float64).max())
            row["anchor_grid"] = 2.0 ** max(math.floor(math.log2(extent)) - 6, -126) if extent > 0.0 else 1.0
            row["id_base"] = bases[k] * CLUSTER_SIZE
            row["public_id"], row["triangle_first"] = k, self.first_triangle[id(mesh)]
            row["material"], row["label"] = self._material_of[id(instance.material)], instance.label
            m = instance.material
            row["flags"] = (
                int(structs.FLAG_TWO_SIDED) * m.two_sided
                + int(structs.FLAG_MASKED) * (m.alpha_mode == "mask")
                + int(structs.FLAG_SMOOTH) * (normals is not None)
                + int(structs.FLAG_COLORS) * (mesh.colors is not None)
            )
            self.placed[place] = place, row["triangle_first"], len(mesh.triangles), instance.world
            blocks[bases[k] : bases[k + 1]] = place
            starts.setdefault(instance.world, (place, slot_count))
            pairs = np.empty((len(cut.first), 2), np.int32)
            pairs[:, 0], pairs[:, 1] = place, self.cluster_range[id(mesh)][0] + np.arange(len(cut.first))
            slots.append(pairs)
            slot_count += len(pairs)
        self._boxes = np.stack([table["bounds_low"], table["bounds_high"]], axis=1).astype(np.float64)
        self.instance_count = len(instances)
        self.cluster_slots = slot_count
        self.triangle_count = sum(len(i.mesh.triangles) for i in instances)
        self._ranges(starts)
        g = self.geometry
        g.slots = self._put("slots", np.concatenate(slots) if slots else np.zeros((0, 2), np.int32), wp.vec2i)
        g.instances = self._put("instances", table, structs.Instance)
        g.id_blocks = self._put("id_blocks", blocks, wp.int32)
        g.transforms = wp.zeros(max(len(instances), 1), dtype=structs.Transform, device=self.device)
        self._arrays["transforms"] = g.transforms
        self._transform_table = np.zeros(max(len(instances), 1), np.dtype(structs.Transform.numpy_dtype()))

    @property
    def ray_bytes(self) -> int:
        """Device memory of the trees for rays; 0 where nobody asked for them."""
        return self._rays.bytes if self._rays is not None else 0

    def rays(self) -> RayScene:
        """Trees for rays, made when they are first asked for."""
        if self._rays is None:
            from .ray_scene import RayScene

            self._rays = RayScene(self)
        return self._rays

    def _ranges(self, starts: dict[int, tuple[int, int]]) -> None:
        """World -> (first instance, instances, first slot, slots); -1 is what every world shares."""
        worlds = sorted(starts)
        # Without instances there is no world, and nothing that ends.
        ends = [starts[w] for w in worlds[1:]] + [(self.instance_count, self.cluster_slots)] * bool(worlds)
        self._world_ranges = {
            w: (starts[w][0], e[0] - starts[w][0], starts[w][1], e[1] - starts[w][1])
            for w, e in zip(worlds, ends, strict=True)
        }

    def view_range(self, world: int) -> tuple[int, int, int, int, int, int]:
        """(shared instances, own first, own count, shared slots, own first slot, own slots) of a view of that world."""
        _, shared, _, shared_slots = self._world_ranges.get(-1, (0, 0, 0, 0))
        if world < 0:
            return (self.instance_count, 0, 0, self.cluster_slots, 0, 0)
        first, count, slot, slots = self._world_ranges.get(world, (0, 0, 0, 0))
        return (shared, first, count, shared_slots, slot, slots)

    def capacities(self, worlds: Sequence[int]) -> dict[str, int]:
        """How much views of these worlds may see, as fields of a request."""
        ranges = [self.view_range(w) for w in worlds]
        return {
            "pairs": _capacity(sum(r[0] + r[2] for r in ranges), self.instance_count),
            "candidates": _capacity(sum(r[3] + r[5] for r in ranges), self.cluster_slots),
            "instances_per_view": _capacity(max(r[0] + r[2] for r in ranges), self.instance_count),
            "clusters_per_view": _capacity(max(r[3] + r[5] for r in ranges), self.cluster_slots),
        }

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Box around all instances [m], as the host's transforms placed them last: (low, high), zeros for none."""
        if not self.instance_count:
            return np.zeros(3), np.zeros(3)
        table = self._transform_table[: self.instance_count]
        middle, half = self._boxes.mean(axis=1), np.ptp(self._boxes, axis=1) / 2.0
        linear = table["linear"].reshape(-1, 3, 3).astype(np.float64)
        middle = np.einsum("nij,nj->ni", linear, middle) + table["origin"]
        half = np.einsum("nij,nj->ni", np.abs(linear), half)
        return (middle - half).min(axis=0), (middle + half).max(axis=0)

    def update_transforms(self, scene: Scene) -> None:
        """Upload the host's transforms, mesh origins folded in; float64 origins, float32 linear parts."""
        table = self._transform_table
        instances = scene.instances
        for place, k in enumerate(self.order):
            matrix = instances[k].transform
            row = table[place]
            row["linear"] = matrix[:3, :3]
            origin = instances[k].mesh.origin
            row["origin"] = matrix[:3, :3] @ origin + matrix[:3, 3] if origin.any() else matrix[:3, 3]
        self.geometry.transforms.assign(wp.array(table, dtype=structs.Transform, device="cpu", copy=False))

    def stage_transforms(self, bound: object) -> None:
        """Copy bound device transforms into the staging, on the device."""
        count = self.instance_count
        array = as_float_array("Scene.bind_transforms", bound, self.device, (count, 4, 4), (count, 7))
        kernel = cluster_kernels.stage_poses_kernel if array.ndim == 2 else cluster_kernels.stage_matrices_kernel
        wp.launch(
            kernel,
            dim=self.instance_count,
            inputs=[self.geometry.instances, array],
            outputs=[self.geometry.transforms],
            device=self.device,
            block_dim=cluster_kernels.BLOCK_DIM,
        )


def _padded(rows: np.ndarray, dtype: type) -> np.ndarray:
    """(n, 3) rows with a zero fourth column, so that a kernel loads a row in one access."""
    out = np.zeros((len(rows), 4), dtype)
    out[:, :3] = rows
    return out
