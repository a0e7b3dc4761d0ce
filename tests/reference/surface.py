"""What is known about the surface at each pixel: attributes interpolated from the original triangles.

Weights come from the unclipped, unsnapped clip vertices: with homogeneous pixel vertices v = (X, Y, W), the weight of
vertex i at a pixel p = (x, y, 1) is proportional to (v_j x v_k) . p. Source: Olano and Greer 1997, Triangle scan
conversion using 2D homogeneous coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .data import Instance, Material, Mesh, Scene, View
from .geometry import project, seen, to_world
from .textures import nearest, sample, texel_margin

__all__ = ["Soup", "Surface", "alpha_at", "barycentrics", "cofactor", "gather", "make_soup"]


@dataclass
class Soup:
    """All triangles a view takes, in (instance, primitive) order; every array has their number as first axis.

    `mirrored` tells instances of negative determinant, `face` is the outward world normal (not unit), `uvs` and
    `colors` hold the defaults (0 and white) where a mesh has none, `normals` world vectors, 0 where missing.
    """

    clip: np.ndarray
    world: np.ndarray
    normals: np.ndarray
    face: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray
    mirrored: np.ndarray
    instance: np.ndarray
    primitive: np.ndarray
    material: np.ndarray


@dataclass
class Surface:
    """Attributes of n pixels: world position, unit normal towards the viewer, base colour RGBA, material inputs."""

    position: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    occlusion: np.ndarray
    emissive: np.ndarray
    material: np.ndarray


def cofactor(linear: np.ndarray) -> np.ndarray:
    """Return the cofactor matrix of (3, 3): it carries normals, and needs no inverse. Its rows are cross products."""
    a, b, c = np.asarray(linear, float)
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])


def _instance_soup(index: int, instance: Instance, view: View) -> Soup:
    mesh = instance.mesh
    faces = np.asarray(mesh.triangles, np.int64).reshape(-1, 3)
    linear = np.asarray(instance.transform, float)[:3, :3]
    mirrored = bool(np.linalg.det(linear) < 0.0)
    turn = cofactor(linear).T * (-1.0 if mirrored else 1.0)
    local = np.asarray(mesh.positions, float)[faces]
    count = len(faces)
    uvs = np.zeros((count, 3, 2)) if mesh.uvs is None else np.asarray(mesh.uvs, float)[faces]
    colors = np.ones((count, 3, 4)) if mesh.colors is None else np.asarray(mesh.colors, float)[faces]
    normals = np.zeros((count, 3, 3)) if mesh.normals is None else np.asarray(mesh.normals, float)[faces] @ turn
    world = to_world(instance)[faces]
    with np.errstate(invalid="ignore"):
        face = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]) @ turn
    return Soup(
        project(world, view),
        world,
        normals,
        face,
        uvs,
        colors,
        np.full(count, mirrored),
        np.full(count, index),
        np.arange(count),
        np.full(count, instance.material),
    )


def make_soup(scene: Scene, view: View) -> Soup:
    """Collect the triangles of every instance that takes part in the view."""
    parts = [_instance_soup(i, item, view) for i, item in enumerate(scene.instances) if seen(item.world, view)]
    if not parts:
        parts = [_instance_soup(0, Instance(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))), view)]
    return Soup(*(np.concatenate([getattr(p, name) for p in parts]) for name in Soup.__dataclass_fields__))


def barycentrics(clip: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weigh the three vertices at pixel centres.

    Args:
        clip: (n, 3, 4) clip vertices.
        x: Pixel columns (n,).
        y: Pixel rows (n,).

    Returns:
        Weights (n, 3), at least 0 and of sum 1, and their change over one pixel in x and in y, each (n, 3).
    """
    # Moving the pixel to the origin keeps the determinants and drops most of the cancellation.
    w = clip[..., 3]
    px = clip[..., 0] - (x + 0.5)[:, None] * w
    py = clip[..., 1] - (y + 0.5)[:, None] * w
    j, k = [1, 2, 0], [2, 0, 1]
    value = px[:, j] * py[:, k] - py[:, j] * px[:, k]
    d_dx = py[:, j] * w[:, k] - w[:, j] * py[:, k]
    d_dy = w[:, j] * px[:, k] - px[:, j] * w[:, k]
    # The determinant of the three vertices gives the sign: a pixel just outside a steep triangle could turn the sum.
    sign = np.where((w * value).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    value, d_dx, d_dy = value * sign, d_dx * sign, d_dy * sign
    clamped = np.maximum(value, 0.0)
    total = clamped.sum(axis=1, keepdims=True)
    flat = total <= 0.0
    safe = np.where(flat, 1.0, total)
    weights = np.where(flat, 1.0 / 3.0, clamped / safe)
    raw = value.sum(axis=1, keepdims=True)
    raw = np.where(raw > 0.0, raw, safe)
    slope_x = (d_dx - value / raw * d_dx.sum(axis=1, keepdims=True)) / raw
    slope_y = (d_dy - value / raw * d_dy.sum(axis=1, keepdims=True)) / raw
    return weights, np.where(flat, 0.0, slope_x), np.where(flat, 0.0, slope_y)


def _mix(weights: np.ndarray, corners: np.ndarray) -> np.ndarray:
    # Differences to the first corner keep a constant attribute exactly constant.
    first = corners[:, 0]
    return first + weights[:, 1:2] * (corners[:, 1] - first) + weights[:, 2:3] * (corners[:, 2] - first)


def alpha_at(soup: Soup, material: Material, triangle: int, x: np.ndarray, y: np.ndarray):
    """Find the alpha that a mask tests, and how near its uv is to another texel.

    Returns:
        Alpha (n,) and distance to the nearest texel border (n,) [texels], +inf without a texture.
    """
    source = np.full(len(x), triangle)
    weights, _, _ = barycentrics(soup.clip[source], x, y)
    alpha = _mix(weights, soup.colors[source])[:, 3] * material.base_color[3]
    texture = material.base_color_texture
    if texture is None:
        return alpha, np.full(len(x), np.inf)
    uv = _mix(weights, soup.uvs[source])
    return alpha * nearest(texture, uv)[:, 3], texel_margin(texture, uv)


def gather(scene: Scene, soup: Soup, source: np.ndarray, back: np.ndarray, x: np.ndarray, y: np.ndarray) -> Surface:
    """Interpolate the attributes of one triangle per pixel and apply the materials.

    Args:
        scene: Where the materials are.
        soup: All triangles.
        source: Triangle of each pixel (n,).
        back: Whether its back is seen (n,).
        x: Pixel columns (n,).
        y: Pixel rows (n,).
    """
    weights, slope_x, slope_y = barycentrics(soup.clip[source], x, y)
    normal = _mix(weights, soup.normals[source])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    face = soup.face[source]
    normal = np.where(length > 0.0, normal, face)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0.0, length, 1.0) * np.where(back, -1.0, 1.0)[:, None]
    corners = soup.uvs[source]
    uv = _mix(weights, corners)
    uv_dx, uv_dy = (np.einsum("ni,nik->nk", slope, corners) for slope in (slope_x, slope_y))
    surface = Surface(
        position=_mix(weights, soup.world[source]),
        normal=normal,
        base_color=_mix(weights, soup.colors[source]),
        metallic=np.zeros((len(x), 1)),
        roughness=np.zeros((len(x), 1)),
        occlusion=np.ones((len(x), 1)),
        emissive=np.zeros((len(x), 3)),
        material=soup.material[source],
    )
    for index in np.unique(surface.material):
        here = surface.material == index
        _apply(scene.materials[index], surface, here, (uv[here], uv_dx[here], uv_dy[here]))
    return surface


def _apply(material: Material, surface: Surface, here: np.ndarray, place: tuple[np.ndarray, ...]) -> None:
    surface.base_color[here] *= material.base_color
    surface.metallic[here], surface.roughness[here] = material.metallic, material.roughness
    surface.emissive[here] = material.emissive
    if material.base_color_texture is not None:
        surface.base_color[here] *= sample(material.base_color_texture, *place)
    if material.metallic_roughness_texture is not None:
        texel = sample(material.metallic_roughness_texture, *place)
        surface.roughness[here] *= texel[:, 1:2]
        surface.metallic[here] *= texel[:, 2:3]
    if material.emissive_texture is not None:
        surface.emissive[here] *= sample(material.emissive_texture, *place)[:, :3]
    if material.occlusion_texture is not None:
        red = sample(material.occlusion_texture, *place)[:, :1]
        surface.occlusion[here] = 1.0 + material.occlusion_strength * (red - 1.0)
