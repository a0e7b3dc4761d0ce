"""Resolve: visibility keys to G-buffer and layers, one thread a pixel, 64 threads an 8 x 8 block.

Each pixel finds its triangle through the key, interpolates attributes from the original vertices with their screen
derivatives, samples the material's textures and encodes the surface. Depth is the key's depth. Block size 64.
"""

from __future__ import annotations

import functools

import warp as wp

from .clusters import pair_of_instance
from .depth_encoding import make_depth_access
from .encoding import FLAG_EMISSIVE, Surface, make_gbuffer_codec
from .interpolation import Barycentric, barycentric, mix2, mix3, mix4, relative_vertex
from .intrinsics import bits_float, load_vec4i
from .projection import linear_depth, normal_of, pixel_index, pixel_of, position_of, relative_position
from .structs import (
    ALL_BITS,
    CLUSTER_SIZE,
    FLAG_COLORS,
    FLAG_SMOOTH,
    MODULE_OPTIONS,
    GBuffer,
    Geometry,
    Instance,
    Layers,
    Material,
    Pair,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
LAYER_NAMES = ("normal", "position", "albedo", "alpha", "instance_id", "semantic_id", "material_id", "triangle_id")
#: (codec or None, layers, textured, colors, emissive, depth, linear): what CI compiles; the last two may be left out.
VARIANTS = [
    (("compact", "oct24", True), (), True, True, True),
    (("compact", "oct24", True), (), False, False, False),
    (("compact", "oct24", False), (), False, False, False),
    (("full", "float32", True), LAYER_NAMES, True, True, True),
    (None, LAYER_NAMES, False, False, False),
    (("compact", "rgb8", True), (), False, False, False),
    (("compact", "xy16", True), (), False, False, False),
    (("compact", "oct16", True), (), False, False, False),
    (("compact", "oct32", True), (), False, False, False),
    (("compact", "float32", True), (), False, False, False),
    (("compact", "oct24", True), (), False, False, False, "unorm16", False),
    (("compact", "oct24", True), (), False, False, False, "ufloat16", True),
    (("compact", "oct24", True), (), False, False, False, "unorm24", False),
]


@wp.func
def cofactor(m: wp.mat33, n: wp.vec3):
    """Cofactor matrix of m times n: transforms normals, also of a singular or mirroring m (up to the sign of det m)."""
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    return wp.vec3(wp.dot(wp.cross(r1, r2), n), wp.dot(wp.cross(r2, r0), n), wp.dot(wp.cross(r0, r1), n))


@wp.func
def scaled_normal(v: wp.vec3):
    """Unit vector of v; one so tiny or huge that its square would vanish or overflow is scaled first. 0 for 0."""
    square = wp.dot(v, v)
    if square > 1.0e-30 and square < 1.0e30:
        return v * (1.0 / wp.sqrt(square))
    largest = wp.max(wp.abs(v[0]), wp.max(wp.abs(v[1]), wp.abs(v[2])))
    if not (largest > 0.0 and wp.isfinite(largest)):
        return wp.vec3()
    return wp.normalize(v / largest)


@wp.func
def level_of_detail(dx: wp.vec2, dy: wp.vec2, size: wp.vec2):
    """Mip level whose texels match a pixel: log2 of the longer side of its footprint (OpenGL 4.6, 8.14.1)."""
    a, b = wp.cw_mul(dx, size), wp.cw_mul(dy, size)
    footprint = wp.max(wp.dot(a, a), wp.dot(b, b))
    return 0.5 * wp.log2(wp.clamp(footprint, 1.0, 1.0e10))


@functools.cache
def make_textured_surface(emissive: bool):
    """Function that multiplies a surface by its material's textures and returns base alpha and emission."""

    @wp.func
    def textured_surface(m: Material, s: Surface, b: Barycentric, t0: wp.vec2, t1: wp.vec2, t2: wp.vec2):
        uv = mix2(b.weight, t0, t1, t2)
        u, v = t1 - t0, t2 - t0
        dx = u * b.ddx[1] + v * b.ddx[2]
        dy = u * b.ddy[1] + v * b.ddy[2]
        result = s
        if (m.textured & 1) != 0:
            lod = level_of_detail(dx, dy, m.base_color_size)
            c = wp.texture_sample(m.base_color_texture, uv, dtype=wp.vec4, lod=lod)
            result.albedo = wp.cw_mul(result.albedo, wp.vec3(c[0], c[1], c[2]))
        if (m.textured & 2) != 0:
            lod = level_of_detail(dx, dy, m.metallic_roughness_size)
            c = wp.texture_sample(m.metallic_roughness_texture, uv, dtype=wp.vec4, lod=lod)
            result.roughness *= c[1]
            result.metallic *= c[2]
        if wp.static(emissive):
            if (m.textured & 4) != 0:
                lod = level_of_detail(dx, dy, m.emissive_size)
                c = wp.texture_sample(m.emissive_texture, uv, dtype=wp.vec4, lod=lod)
                # Emission travels in the specular slot until the caller takes it out.
                result.specular = wp.vec3(c[0], c[1], c[2])
        if (m.textured & 8) != 0:
            lod = level_of_detail(dx, dy, m.occlusion_size)
            c = wp.texture_sample(m.occlusion_texture, uv, dtype=wp.vec4, lod=lod)
            result.occlusion = 1.0 + m.occlusion_strength * (c[0] - 1.0)
        return result

    return textured_surface


@wp.func
def surface_normal(geometry: Geometry, flags: wp.int32, slot: wp.int32, pair: Pair, b: Barycentric, v: wp.vec4i):
    """World normal of a pixel, turned to the viewer: interpolated, or the face's own where there is none."""
    normal = wp.vec3()
    if (flags & FLAG_SMOOTH) != 0:
        normal = mix3(b.weight, normal_of(geometry, v[0]), normal_of(geometry, v[1]), normal_of(geometry, v[2]))
    if wp.dot(normal, normal) < 1.0e-12:
        p0 = position_of(geometry, v[0])
        normal = scaled_normal(wp.cross(position_of(geometry, v[1]) - p0, position_of(geometry, v[2]) - p0))
    # With y down, front faces are negative; a mirroring transform turns both the face and the cofactors round.
    mirrored = wp.where(pair.flip != 0, -1.0, 1.0)
    facing = wp.where(b.orientation * mirrored <= 0.0, mirrored, -mirrored)
    return scaled_normal(cofactor(geometry.transforms[slot].linear, normal)) * facing


@wp.func
def plain_surface(m: Material, normal: wp.vec3):
    """Surface of a material before textures and vertex colours."""
    s = Surface()
    s.normal = normal
    s.albedo = wp.vec3(m.base_color[0], m.base_color[1], m.base_color[2])
    s.roughness = m.roughness
    s.metallic = m.metallic
    s.shininess = m.shininess
    s.occlusion = 1.0
    s.model = m.model
    return s


@functools.cache
def make_write_layers(layers: tuple[str, ...]):
    """(background, surface) functions that write the layers asked for."""

    @wp.func
    def write_background(i: wp.int32, out: Layers):
        if wp.static("normal" in layers):
            out.normal[i] = wp.vec3()
        if wp.static("position" in layers):
            out.position[i] = wp.vec3()
        if wp.static("albedo" in layers):
            out.albedo[i] = wp.vec3()
        if wp.static("alpha" in layers):
            out.alpha[i] = 0.0
        if wp.static("instance_id" in layers):
            out.instance_id[i] = -1
        if wp.static("semantic_id" in layers):
            out.semantic_id[i] = -1
        if wp.static("material_id" in layers):
            out.material_id[i] = -1
        if wp.static("triangle_id" in layers):
            out.triangle_id[i] = -1

    @wp.func
    def write_surface(
        i: wp.int32,
        out: Layers,
        s: Surface,
        instance: Instance,
        triangle: wp.int32,
        origin: wp.vec3d,
        relative: wp.vec3,
    ):
        if wp.static("normal" in layers):
            out.normal[i] = s.normal
        if wp.static("position" in layers):
            out.position[i] = wp.vec3(
                wp.float32(origin[0] + wp.float64(relative[0])),
                wp.float32(origin[1] + wp.float64(relative[1])),
                wp.float32(origin[2] + wp.float64(relative[2])),
            )
        if wp.static("albedo" in layers):
            out.albedo[i] = s.albedo
        if wp.static("alpha" in layers):
            out.alpha[i] = 1.0
        if wp.static("instance_id" in layers):
            out.instance_id[i] = instance.public_id
        if wp.static("semantic_id" in layers):
            out.semantic_id[i] = instance.label
        if wp.static("material_id" in layers):
            out.material_id[i] = instance.material
        if wp.static("triangle_id" in layers):
            out.triangle_id[i] = triangle

    return write_background, write_surface


@functools.cache
def make_resolve_kernel(
    codec: tuple | None,
    layers: tuple[str, ...],
    textured: bool,
    colors: bool,
    emissive: bool,
    depth: str = "float32",
    linear: bool = False,
):
    """Kernel that fills the G-buffer and the layers asked for.

    Args:
        codec: Arguments of `make_gbuffer_codec`, or None where no pass reads the G-buffer.
        layers: Names out of LAYER_NAMES to write.
        textured: Some material in use has a texture.
        colors: Some mesh in use has vertex colours.
        emissive: Some material in use emits.
        depth: Depth format of the G-buffer, out of DEPTH_CODECS.
        linear: Linear depth is written beside a depth of codes, for what reads that.
    """
    store_depth, clear_depth, _ = make_depth_access(depth)
    encode = make_gbuffer_codec(*(codec or ("compact", "oct24", False)))[0]
    textured_surface = make_textured_surface(emissive)
    write_background, write_surface = make_write_layers(layers)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def resolve_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # Scene
        geometry: Geometry,
        materials: wp.array[Material],
        # In
        pairs: wp.array[Pair],
        keys: wp.array[wp.uint64],
        # Params
        first: wp.int32,
        # Out
        out_gbuffer: GBuffer,
        out_layers: Layers,
    ):
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        key = keys[i]
        if key == wp.uint64(0):
            if wp.static(codec is not None):
                clear_depth(out_gbuffer, i)
            if wp.static(linear):
                out_gbuffer.depth[i] = wp.inf
            write_background(i, out_layers)
            return
        z = bits_float(wp.uint32(key >> wp.uint64(32)))
        identity = ALL_BITS - wp.uint32(key)
        instance_slot = geometry.id_blocks[wp.int32(identity / wp.uint32(CLUSTER_SIZE))]
        instance = geometry.instances[instance_slot]
        triangle = wp.int32(identity - instance.id_base)
        v = load_vec4i(geometry.triangles, instance.triangle_first + triangle)
        pair = pairs[pair_of_instance(view, instance_slot)]
        px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
        b = barycentric(
            relative_vertex(view, pair, position_of(geometry, v[0]), px, py),
            relative_vertex(view, pair, position_of(geometry, v[1]), px, py),
            relative_vertex(view, pair, position_of(geometry, v[2]), px, py),
        )
        material = materials[instance.material]
        s = plain_surface(material, surface_normal(geometry, instance.flags, instance_slot, pair, b, v))
        if wp.static(colors):
            if (instance.flags & FLAG_COLORS) != 0:
                c = mix4(b.weight, geometry.colors[v[0]], geometry.colors[v[1]], geometry.colors[v[2]])
                s.albedo = wp.cw_mul(s.albedo, wp.vec3(c[0], c[1], c[2]))
        emission = material.emissive
        if wp.static(textured):
            if material.textured != 0:
                s = textured_surface(material, s, b, geometry.uvs[v[0]], geometry.uvs[v[1]], geometry.uvs[v[2]])
                if (material.textured & 4) != 0:
                    emission = wp.cw_mul(emission, s.specular)
        s.specular = material.specular
        if wp.static(emissive):
            if emission[0] + emission[1] + emission[2] > 0.0:
                s.flags = FLAG_EMISSIVE
                out_layers.emissive[i] = emission
        if wp.static(codec is not None):
            store_depth(out_gbuffer, view, i, z)
            encode(out_gbuffer, i, s)
        if wp.static(linear):
            out_gbuffer.depth[i] = linear_depth(view, z)
        relative = wp.vec3()
        if wp.static("position" in layers):
            relative = relative_position(view, px, py, linear_depth(view, z))
        write_surface(i, out_layers, s, instance, triangle, view.origin, relative)

    return resolve_kernel


@wp.kernel(grid_stride=False)
def depth_layer_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    keys: wp.array[wp.uint64],
    # Params
    first: wp.int32,
    # Out
    out_depth: wp.array[wp.float32],
):
    """Linear view depth [m] straight from the keys, +inf on the background."""
    pixel = pixel_of(blocks, wp.tid() + first)
    view = views[pixel[0]]
    x, y = pixel[1], pixel[2]
    if x >= view.width or y >= view.height:
        return
    i = pixel_index(view, x, y)
    key = keys[i]
    depth = wp.float32(wp.inf)
    if key != wp.uint64(0):
        depth = linear_depth(view, bits_float(wp.uint32(key >> wp.uint64(32))))
    out_depth[i] = depth
