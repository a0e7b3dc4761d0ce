"""An independent renderer in float64 NumPy, the oracle of the tests. It imports nothing of the package.

Brute force by design: small images, a few thousand triangles, a few hundred lights. `render(scene, view)` gives all
layers; `coverage_count` and `polygon_coverage` decide coverage in exact integers by another method than the renderer;
the other functions are twins of the kernels' small functions.
"""

from .bloom import bloom_axes, bloom_bilinear, bloom_bright, bloom_chain, bloom_gaussians, bloom_window
from .brdf import MIN_ROUGHNESS, brdf_blinn_phong, brdf_ggx, brdf_lambert, brdf_phong, dot, unit
from .closed_forms import (
    angle_weighted_normals,
    furnace,
    lambert_plane,
    lambert_plane_radiance,
    loose,
    quad,
    scene_of,
    sphere,
    translation,
    view_of,
)
from .color import (
    HALF_MAX,
    linear_depth,
    pack_unorm,
    srgb_decode,
    srgb_encode,
    tone_aces,
    tone_pbr_neutral,
    tone_reinhard,
    unpack_unorm,
)
from .data import Instance, Light, Material, Mesh, Scene, Texture, View
from .encoding import oct_decode, oct_encode, oct_encode_precise, oct_unwrap, oct_wrap
from .geometry import GUARD_PX, Pieces, clip_polygon, make_pieces, project, snap
from .lights import attenuation, incoming, spot_factor
from .raster import Visibility, coverage_count, draw, polygon_coverage
from .render import render, shade
from .surface import barycentrics, cofactor
from .textures import mip_chain, nearest, sample, wrap_index

__all__ = [
    "GUARD_PX",
    "HALF_MAX",
    "MIN_ROUGHNESS",
    "Instance",
    "Light",
    "Material",
    "Mesh",
    "Pieces",
    "Scene",
    "Texture",
    "View",
    "Visibility",
    "angle_weighted_normals",
    "attenuation",
    "barycentrics",
    "bloom_axes",
    "bloom_bilinear",
    "bloom_bright",
    "bloom_chain",
    "bloom_gaussians",
    "bloom_window",
    "brdf_blinn_phong",
    "brdf_ggx",
    "brdf_lambert",
    "brdf_phong",
    "clip_polygon",
    "cofactor",
    "coverage_count",
    "dot",
    "draw",
    "furnace",
    "incoming",
    "lambert_plane",
    "lambert_plane_radiance",
    "linear_depth",
    "loose",
    "make_pieces",
    "mip_chain",
    "nearest",
    "oct_decode",
    "oct_encode",
    "oct_encode_precise",
    "oct_unwrap",
    "oct_wrap",
    "pack_unorm",
    "polygon_coverage",
    "project",
    "quad",
    "render",
    "sample",
    "scene_of",
    "shade",
    "snap",
    "sphere",
    "spot_factor",
    "srgb_decode",
    "srgb_encode",
    "tone_aces",
    "tone_pbr_neutral",
    "tone_reinhard",
    "translation",
    "unit",
    "unpack_unorm",
    "view_of",
    "wrap_index",
]
