"""What a scene calls for, as host-side declarations: the facts that select passes and kernels, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np

from .clustering import CLUSTER_SIZE
from .scene import Scene

__all__ = ["Features"]

MODELS = {"lambert": 0, "phong": 1, "blinn_phong": 2, "ggx": 3}


@dataclasses.dataclass(frozen=True)
class Features:
    """Facts about a scene that a plan is built for; equal facts mean the same plan.

    Attributes:
        models: Bit m: specular model m is in use.
        kinds: Bit k: light kind k (point, spot, directional) is there.
        polynomial: Some light has the polynomial fall-off.
        light_capacity: Lights the buffers hold, a power of two.
        emissive: Some material in use emits.
        textured: Some material in use has a texture.
        colors: Some mesh in use has vertex colours.
        masked: Some material in use is alpha-masked.
        extra: Some material needs metalness, occlusion or a specular colour in the G-buffer.
        ambient: Ambient light is not zero.
        infinite_lights: Lights without a range, which are in every tile.
        casters: Lights of each kind (point, spot, directional) that declare a shadow.
        bound_meshes: Meshes whose points come from bound arrays.
        bound_vertices: Vertices of these.
        bound_clusters: Most clusters these may have.
    """

    models: int
    kinds: int
    polynomial: bool
    light_capacity: int
    emissive: bool
    textured: bool
    colors: bool
    masked: bool
    extra: bool
    ambient: bool
    infinite_lights: int
    casters: tuple[int, int, int] = (0, 0, 0)
    bound_meshes: int = 0
    bound_vertices: int = 0
    bound_clusters: int = 0

    @classmethod
    def of(cls, scene: Scene) -> Features:
        """Read the declarations of a scene."""
        materials = {id(i.material): i.material for i in scene.instances}.values()
        meshes = {id(i.mesh): i.mesh for i in scene.instances}.values()
        models = 0
        for material in materials:
            models |= 1 << MODELS[material.model]
        kinds = 0
        for k, (_, group) in enumerate(scene.lights.groups()):
            kinds |= (len(group) > 0) << k
        local = (scene.lights.point, scene.lights.spot)
        bound = [mesh for binding in scene.point_bindings for mesh in binding.meshes]
        emits = [max(m.emissive) > 0.0 for m in materials]
        return cls(
            models=models or 1,
            kinds=kinds,
            polynomial=any(bool(np.any(g.attenuation == 1)) for g in local),
            light_capacity=max(32, 1 << max(0, len(scene.lights) - 1).bit_length()),
            emissive=any(emits),
            textured=any(t is not None for m in materials for t in m.textures),
            colors=any(mesh.colors is not None for mesh in meshes),
            masked=any(m.alpha_mode == "mask" for m in materials),
            extra=models > 1 or any(m.occlusion_texture is not None for m in materials),
            ambient=max(scene.environment.ambient) > 0.0,
            infinite_lights=scene.lights.infinite_count(),
            casters=tuple(int(np.count_nonzero(group.casts_shadow)) for _, group in scene.lights.groups()),
            bound_meshes=len(bound),
            bound_vertices=sum(len(m.positions) for m in bound),
            bound_clusters=sum(-(-len(m.triangles) // CLUSTER_SIZE) for m in bound),
        )
