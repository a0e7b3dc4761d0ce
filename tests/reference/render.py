"""The reference renderer: every triangle, every light, every pixel, float64, no tiles and no shortcuts."""

from __future__ import annotations

import numpy as np

from . import brdf
from .color import linear_depth
from .data import Material, Scene, View
from .geometry import Pieces, make_pieces, seen, unproject
from .lights import incoming
from .raster import Visibility, draw
from .surface import Soup, Surface, alpha_at, gather, make_soup

__all__ = ["back_facing", "render", "shade", "to_viewer"]


def back_facing(pieces: Pieces, soup: Soup) -> np.ndarray:
    """Tell which pieces show their back: clockwise as seen, the other way round for mirrored instances."""
    return (pieces.area > 0) != soup.mirrored[pieces.source]


def _cull(pieces: Pieces, soup: Soup, scene: Scene, view: View) -> Pieces:
    two_sided = np.array([m.two_sided for m in scene.materials], bool)[soup.material[pieces.source]]
    back = back_facing(pieces, soup)
    keep = {"back": ~back, "front": back, "none": np.ones(len(back), bool)}[view.cull] | two_sided
    return Pieces(pieces.xy[keep], pieces.z[keep], pieces.area[keep], pieces.source[keep])


def _see(scene: Scene, view: View, soup: Soup, pieces: Pieces, edges: bool) -> tuple[Visibility, np.ndarray]:
    margin = np.full((view.height, view.width), np.inf)
    masked = np.array([m.alpha_cutoff is not None for m in scene.materials], bool)

    def discard(piece: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        triangle = pieces.source[piece]
        material = scene.materials[soup.material[triangle]]
        if material.alpha_cutoff is None:
            return np.zeros(len(x), bool)
        alpha, near = alpha_at(soup, material, triangle, x, y)
        margin[y, x] = np.minimum(margin[y, x], near)
        return ~(alpha >= material.alpha_cutoff)

    depth = "clamp" if view.depth_clamp or not view.orthographic else "clip"
    return draw(pieces, view.width, view.height, depth, discard if masked.any() else None, edges), margin


def to_viewer(view: View, position: np.ndarray) -> np.ndarray:
    """Unit directions from world points (n, 3) to the eye, or against the view direction if orthographic."""
    if view.orthographic:
        return np.broadcast_to(np.asarray(view.rotation, float)[2], position.shape)
    return brdf.unit(np.asarray(view.eye, float) - position)


def _reflect(material: Material, surface: Surface, pick: np.ndarray, to_light: np.ndarray, viewer: np.ndarray):
    normal, albedo = surface.normal[pick], surface.base_color[pick, :3]
    if material.model == "lambert":
        return brdf.brdf_lambert(normal, to_light, viewer, albedo=albedo)
    if material.model == "ggx":
        return brdf.brdf_ggx(
            normal,
            to_light,
            viewer,
            base_color=albedo,
            metallic=surface.metallic[pick],
            roughness=surface.roughness[pick],
        )
    lobe = {"phong": brdf.brdf_phong, "blinn_phong": brdf.brdf_blinn_phong}[material.model]
    specular = np.broadcast_to(np.asarray(material.specular, float), albedo.shape)
    return lobe(normal, to_light, viewer, albedo=albedo, specular=specular, shininess=material.shininess)


def shade(scene: Scene, view: View, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum the light of all lights, in order.

    Returns:
        Diffuse and specular outgoing radiance (n, 3), and how many lights reach each pixel (n,): those whose
        irradiance on the surface, cosine included, is not zero.
    """
    count = len(surface.position)
    diffuse, specular, lit_by = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.int64)
    viewer = to_viewer(view, surface.position)
    groups = [(scene.materials[i], surface.material == i) for i in np.unique(surface.material)]
    for light in scene.lights:
        if not seen(light.world, view):
            continue
        to_light, arriving = incoming(light, surface.position)
        irradiance = arriving * np.maximum(brdf.dot(surface.normal, to_light), 0.0)
        reached = irradiance.any(axis=1)
        lit_by += reached
        for material, mine in groups:
            pick = np.flatnonzero(mine & reached)
            if len(pick):
                f_diffuse, f_specular = _reflect(material, surface, pick, to_light[pick], viewer[pick])
                diffuse[pick] += f_diffuse * irradiance[pick]
                specular[pick] += f_specular * irradiance[pick]
    return diffuse, specular, lit_by


def _ambient(scene: Scene, surface: Surface) -> np.ndarray:
    share = np.ones_like(surface.occlusion)
    for index in np.unique(surface.material):
        here, material = surface.material == index, scene.materials[index]
        if material.model == "ggx":
            share[here] = 1.0 - surface.metallic[here]
        elif material.model != "lambert":
            share[here] = 1.0 - max(material.specular)
    return surface.base_color[:, :3] * share * surface.occlusion * np.asarray(scene.ambient, float)


def _material_ids(scene: Scene) -> np.ndarray:
    """Number materials in the order in which instances first use them; -1 for unused ones."""
    ids = np.full(len(scene.materials), -1)
    for instance in scene.instances:
        if ids[instance.material] < 0:
            ids[instance.material] = ids.max() + 1
    return ids


def render(scene: Scene, view: View, edges: bool = True, point_from: str = "surface") -> dict[str, np.ndarray]:
    """Render one view.

    Args:
        scene: What there is.
        view: From where and how large.
        edges: Whether `edge_distance` is worth its time.
        point_from: Where a pixel's world position comes from, which light falls on. "surface": the exact point of the
            original triangle. "depth": the pixel's ray at the stored depth, which carries the snap of the vertices by
            up to 1/512 px; a deferred renderer that keeps no positions can do no better.

    Returns:
        Arrays of (height, width) or (height, width, 3). Layers: color, diffuse, specular, alpha, depth, normal,
        position, albedo, instance_id, material_id, semantic_id, triangle_id, light_count. Beside them, for tests:
        z (depth value, 0 on the background), fragments (drawn fragments, seen or hidden), and how sure the pixel is:
        edge_distance [1/256 px], z_gap (to the next fragment), alpha_margin [texels], each +inf where nothing is near.
    """
    soup = make_soup(scene, view)
    pieces = _cull(make_pieces(soup.clip, view), soup, scene, view)
    seen_by, alpha_margin = _see(scene, view, soup, pieces, edges)
    y, x = np.nonzero(seen_by.piece >= 0)
    piece = seen_by.piece[y, x]
    source = pieces.source[piece]
    surface = gather(scene, soup, source, back_facing(pieces, soup)[piece], x, y)
    z = seen_by.z[y, x]
    depth = linear_depth(z, near=view.near, far=view.far, orthographic=view.orthographic)
    if point_from == "depth":
        surface.position = unproject(x, y, depth, view)
    diffuse, specular, light_count = shade(scene, view, surface)
    color = diffuse + specular + _ambient(scene, surface) + surface.emissive
    labels = np.array([i.label for i in scene.instances], int)
    instance = soup.instance[source]

    def image(values: np.ndarray, blank: float = 0.0) -> np.ndarray:
        out = np.empty((view.height, view.width, *values.shape[1:]), values.dtype)
        out[...] = blank
        out[y, x] = values
        return out

    return {
        "color": image(color, np.asarray(scene.background, float)),
        "diffuse": image(diffuse),
        "specular": image(specular),
        "alpha": image(np.ones(len(x))),
        "depth": image(depth, np.inf),
        "normal": image(surface.normal),
        "position": image(surface.position),
        "albedo": image(surface.base_color[:, :3]),
        "instance_id": image(instance, -1),
        "material_id": image(_material_ids(scene)[surface.material], -1),
        "semantic_id": image(labels[instance] if len(labels) else instance, -1),
        "triangle_id": image(soup.primitive[source], -1),
        "light_count": image(light_count),
        "z": image(z),
        "fragments": seen_by.fragments,
        "edge_distance": seen_by.edge_distance,
        "z_gap": seen_by.z_gap,
        "alpha_margin": alpha_margin,
    }
