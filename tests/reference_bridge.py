"""Turns a scene and a camera of the package into the reference's plain data; the only file that knows both."""

from __future__ import annotations

from typing import Any

import numpy as np
import reference

import warp_deferred as wd

__all__ = ["reference_scene", "reference_view", "render_reference"]


def _host(array: Any) -> np.ndarray:
    """Copy a NumPy, Warp or torch array to the host."""
    if isinstance(array, np.ndarray):
        return array
    if hasattr(array, "cpu"):
        return np.asarray(array.cpu())
    return array.numpy() if hasattr(array, "numpy") else np.asarray(array)


def _texture(texture: Any, made: dict[int, Any]) -> reference.Texture | None:
    if texture is None:
        return None
    if id(texture) not in made:
        made[id(texture)] = reference.Texture(texture.pixels, texture.srgb, texture.wrap, texture.linear_filter)
    return made[id(texture)]


def _material(material: wd.Material, made: dict[int, Any]) -> reference.Material:
    return reference.Material(
        model=material.model,
        base_color=material.base_color,
        metallic=material.metallic,
        roughness=material.roughness,
        specular=material.specular,
        shininess=material.shininess,
        emissive=material.emissive,
        base_color_texture=_texture(material.base_color_texture, made),
        metallic_roughness_texture=_texture(material.metallic_roughness_texture, made),
        emissive_texture=_texture(material.emissive_texture, made),
        occlusion_texture=_texture(material.occlusion_texture, made),
        occlusion_strength=material.occlusion_strength,
        alpha_cutoff=material.alpha_cutoff if material.alpha_mode == "mask" else None,
        two_sided=material.two_sided,
    )


def _mesh(mesh: wd.Mesh) -> reference.Mesh:
    normals = mesh.normals
    if normals is None and mesh.smooth:
        normals = reference.angle_weighted_normals(mesh.positions, mesh.triangles)
    return reference.Mesh(mesh.positions.astype(float) + mesh.origin, mesh.triangles, normals, mesh.uvs, mesh.colors)


def _quaternion_matrix(rows: np.ndarray) -> np.ndarray:
    """Turn (n, 7) positions and quaternions (x, y, z, w) into (n, 4, 4) matrices."""
    x, y, z, w = (rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)).T
    out = np.zeros((len(rows), 4, 4))
    out[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    out[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    out[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    out[:, :3, 3], out[:, 3, 3] = rows[:, :3], 1.0
    return out


def _transforms(scene: wd.Scene) -> list[np.ndarray]:
    if scene.transforms is None:
        return [instance.transform for instance in scene.instances]
    array = _host(scene.transforms).astype(float)
    return list(array if array.shape[1:] == (4, 4) else _quaternion_matrix(array))


def _lights(scene: wd.Scene) -> tuple[reference.Light, ...]:
    lights = []
    for kind, group in scene.lights.groups():
        columns = {name: _host(getattr(group, name)) for name in group.FIELDS[kind]}
        for i in range(len(group)):
            row = {name: column[i] for name, column in columns.items()}
            fields: dict[str, Any] = {
                name: float(row[name])
                for name in ("range", "source_radius", "inner_angle", "outer_angle")
                if name in row
            }
            fields |= {name: tuple(map(float, row[name])) for name in ("position", "direction") if name in row}
            if row.get("attenuation", 0) == 1:
                fields["coefficients"] = tuple(map(float, row["coefficients"]))
            radiance = tuple(float(c) * float(row["intensity"]) for c in row["color"])
            lights.append(reference.Light(kind, radiance=radiance, world=int(row["world"]), **fields))
    return tuple(lights)


def reference_scene(scene: wd.Scene) -> reference.Scene:
    """Convert a scene. Materials are numbered in the order in which instances first use them, each object once."""
    meshes: dict[int, reference.Mesh] = {}
    textures: dict[int, reference.Texture] = {}
    index: dict[int, int] = {}
    materials, instances = [], []
    for instance, transform in zip(scene.instances, _transforms(scene), strict=True):
        if id(instance.mesh) not in meshes:
            meshes[id(instance.mesh)] = _mesh(instance.mesh)
        if id(instance.material) not in index:
            index[id(instance.material)] = len(materials)
            materials.append(_material(instance.material, textures))
        instances.append(
            reference.Instance(
                meshes[id(instance.mesh)],
                index[id(instance.material)],
                np.asarray(transform, float),
                instance.world,
                instance.label,
            )
        )
    environment = scene.environment
    return reference.Scene(
        tuple(instances),
        tuple(materials) or (reference.Material(),),
        _lights(scene),
        environment.ambient,
        environment.background,
    )


def reference_view(
    camera: wd.Camera, width: int, height: int, *, cull: str = "back", depth_clamp: bool = False
) -> reference.View:
    """Convert a camera for an image of that size."""
    return reference.View(
        width,
        height,
        camera.pixel_projection(width, height),
        camera.position,
        np.array(camera.rotation).reshape(3, 3),
        camera.projection == "orthographic",
        camera.near,
        camera.far,
        camera.world,
        cull,
        depth_clamp,
    )


def render_reference(
    scene: wd.Scene,
    camera: wd.Camera | None,
    width: int,
    height: int,
    *,
    cull: str | None = None,
    depth_clamp: bool = False,
    edges: bool = True,
    point_from: str = "surface",
) -> dict[str, np.ndarray]:
    """Render a scene of the package with the reference; camera and culling default to the scene's own.

    `point_from` as in `reference.render`: "surface" is the truth, "depth" what a position rebuilt from depth can reach.
    """
    view = reference_view(
        camera or scene.camera, width, height, cull=cull or scene.settings.raster.cull, depth_clamp=depth_clamp
    )
    return reference.render(reference_scene(scene), view, edges, point_from)
