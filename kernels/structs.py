"""Structs shared by all kernels, and the constants that host and device agree on.

Sizes in bytes (asserted by tests/kernels/test_structs.py): View 208, Transform 64, Instance 80, Pair 92, Cluster 48,
LargeTriangle 48, BloomLevel 28, Material 128 on the device plus its textures' handles.

Only arrays whose content may change from frame to frame hold per-frame values; a captured graph freezes what is
passed by value, so everything here that changes lives in device arrays of these structs.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

#: Options of every specialised kernel's own module, which does not take its file's: without fused multiply-adds CPU and
#: CUDA agree to the bit.
MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
#: Options by how a kernel may round: `fused` merges products and sums into one rounding, `fast` also takes CUDA's
#: approximate division, root, power and exponential and flushes what is denormal to 0.
ARITHMETIC_OPTIONS = {
    "precise": MODULE_OPTIONS,
    "fused": MODULE_OPTIONS | {"fuse_fp": True},
    "fast": MODULE_OPTIONS | {"fuse_fp": True, "fast_math": True},
}

#: Side of the square of pixels that 64 consecutive threads of a pixel pass cover.
PIXEL_BLOCK = wp.constant(8)
PIXEL_BLOCK_AREA = wp.constant(64)
#: Side of the screen tiles that large triangles are binned to.
BIN_TILE = wp.constant(16)
BIN_TILE_AREA = wp.constant(256)
#: Triangles in a cluster, and lanes of a raster block.
CLUSTER_SIZE = wp.constant(128)
#: Sub-pixel positions: 1/256 px.
SUBPIXEL = wp.constant(256)
#: Vertices beyond this many pixels from the origin are clipped, so that edge values fit 51 bits.
GUARD_BAND_PX = wp.constant(32768.0)
#: Largest 32-bit id: no triangle has it.
ALL_BITS = wp.constant(wp.uint32(0xFFFFFFFF))
#: Lights a mask word, and a summary word of mask words, stands for.
MASK_BITS = wp.constant(32)

PERSPECTIVE = wp.constant(0)
ORTHOGRAPHIC = wp.constant(1)
CULL_NONE = wp.constant(0)
CULL_BACK = wp.constant(1)
CULL_FRONT = wp.constant(2)

MODEL_LAMBERT = wp.constant(0)
MODEL_PHONG = wp.constant(1)
MODEL_BLINN_PHONG = wp.constant(2)
MODEL_GGX = wp.constant(3)

FLAG_TWO_SIDED = wp.constant(1)
FLAG_MASKED = wp.constant(2)
FLAG_SMOOTH = wp.constant(4)
FLAG_COLORS = wp.constant(8)

LIGHT_POINT = wp.constant(0)
LIGHT_SPOT = wp.constant(1)
LIGHT_DIRECTIONAL = wp.constant(2)
LIGHT_POLYNOMIAL = wp.constant(4)

SLOT_SPOT = wp.constant(0)
SLOT_FACE = wp.constant(1)
SLOT_CASCADE = wp.constant(2)


@wp.struct
class View:
    """A camera with a rectangle of the pixel arena; kernels address pixels only through it."""

    origin: wp.vec3d  # world position of the eye [m]
    pixel_offset: wp.int64  # first pixel in the arena of its kind of keys
    rotation: wp.mat33  # world to view; rows right, up, backward
    scale: wp.vec2  # (fx, -fy): pixels per unit of x/w, y/w (orthographic: per metre)
    center: wp.vec2  # principal point [px], jitter included
    near: wp.float32  # near plane [m]
    far: wp.float32  # far plane [m]; perspective: what lies wholly beyond it is culled where depth_clamp is set
    exposure: wp.float32  # linear factor
    aperture: wp.float32  # diameter of the lens opening [m]; 0: a pinhole, or orthographic
    focus_distance: wp.float32  # view depth in focus [m]
    projection: wp.int32  # PERSPECTIVE or ORTHOGRAPHIC
    cull_mode: wp.int32
    depth_clamp: wp.int32  # orthographic: clamp depth to [0, 1] instead of dropping fragments; perspective: cull by far
    depth_only: wp.int32  # 32-bit keys, no attributes
    world: wp.int32  # -1 sees all
    row_pitch: wp.int32  # pixels from one row to the next
    width: wp.int32
    height: wp.int32
    tile_offset: wp.int32  # first light tile
    tiles_x: wp.int32
    coarse_offset: wp.int32  # first coarse light tile
    coarse_x: wp.int32
    bin_offset: wp.int32  # first raster bin
    bins_x: wp.int32
    pair_offset: wp.int32  # first (view, instance) pair
    shared_instances: wp.int32  # instances that stand in every world come first ...
    own_first: wp.int32  # ... then those of the view's own world
    own_count: wp.int32
    shared_clusters: wp.int32
    own_cluster_first: wp.int32
    own_cluster_count: wp.int32
    skipped: wp.int32  # 1: nothing is drawn, as for the shadow map of a light that is out
    shutter: wp.float32  # share of the frame interval that the shutter is open
    bloom: wp.float32  # share of light the lens scatters
    spare: wp.int32


@wp.struct
class Transform:
    """Object to world: linear part in float32, origin in float64."""

    origin: wp.vec3d
    linear: wp.mat33


@wp.struct
class Instance:
    """What stays about a placed mesh, but for the box of one with bound points; sorted by world, shared ones first."""

    mesh_origin: wp.vec3d  # taken out of the mesh's positions at load
    bounds_low: wp.vec3  # box of the mesh's faces that can be drawn
    bounds_high: wp.vec3
    anchor_grid: wp.float32  # power of two: anchors are multiples of it
    id_base: wp.uint32  # first visible id, a multiple of CLUSTER_SIZE; in public instance order
    public_id: wp.int32  # index in Scene.instances
    triangle_first: wp.int32  # in Geometry.triangles
    material: wp.int32
    label: wp.int32
    flags: wp.int32
    spare: wp.int32


@wp.struct
class Pair:
    """One instance as one view sees it: q = p - anchor; (x_px w, y_px w, w) = matrix q + offset, centre not added."""

    matrix: wp.mat33
    offset: wp.vec3
    anchor: wp.vec3
    camera: wp.vec3  # eye in object space (perspective), or direction towards the viewer (orthographic)
    radius_scale: wp.float32  # bound on how much the linear part stretches
    view: wp.int32
    instance: wp.int32
    flip: wp.int32  # 1 where the transform mirrors, else 0
    drawn: wp.int32  # 0 where the transform is not finite


@wp.struct
class Cluster:
    """At most CLUSTER_SIZE triangles with a bounding sphere and a cone of normals, in object space."""

    center: wp.vec3
    radius: wp.float32
    axis: wp.vec3
    cutoff: wp.float32  # > 1: no cone
    first: wp.int32  # in Geometry.cluster_triangles
    count: wp.int32
    spare0: wp.int32
    spare1: wp.int32


@wp.struct
class Geometry:
    """All meshes of the scene, one after the other. Vertex indices are scene-wide."""

    positions: wp.array[wp.vec4]  # fourth component unused: one load a vertex
    normals: wp.array[wp.vec4]
    uvs: wp.array[wp.vec2]
    colors: wp.array[wp.vec4]
    triangles: wp.array[wp.vec4i]  # mesh order: three vertices, fourth component unused
    cluster_triangles: wp.array[wp.vec4i]  # cluster order: three vertices and the mesh-local triangle id
    clusters: wp.array[Cluster]
    slots: wp.array[wp.vec2i]  # (instance, cluster), sorted by world
    instances: wp.array[Instance]
    id_blocks: wp.array[wp.int32]  # visible id / CLUSTER_SIZE -> instance
    transforms: wp.array[Transform]


@wp.struct
class LargeTriangle:
    """A snapped, oriented triangle kept for the bins."""

    p0: wp.vec2i  # 1/256 px
    p1: wp.vec2i
    p2: wp.vec2i
    z: wp.vec3
    id: wp.uint32
    view: wp.int32
    spare: wp.int32


@wp.struct
class WorkList:
    """Clusters to draw: (pair, cluster) from the front, those that may need clipping or a discard from the back."""

    entries: wp.array[wp.vec2i]
    counts: wp.array[wp.int32]  # [plain, careful]


@wp.struct
class RasterTarget:
    """Visibility keys and the store of large triangles."""

    keys: wp.array[wp.uint64]  # z bits above (0xFFFFFFFF - id)
    depth_keys: wp.array[wp.uint32]  # z bits, for depth-only views
    large: wp.array[LargeTriangle]
    large_count: wp.array[wp.int32]  # [large, huge]
    behind: wp.array[wp.uint64]  # keys a fragment must lie behind, where that mode is compiled in


@wp.struct
class Material:
    """Surface parameters and textures."""

    base_color: wp.vec4
    emissive: wp.vec3
    metallic: wp.float32
    specular: wp.vec3
    roughness: wp.float32
    shininess: wp.float32
    occlusion_strength: wp.float32
    alpha_cutoff: wp.float32
    model: wp.int32
    textured: wp.int32  # bit i: texture i is there (base colour, metallic-roughness, emissive, occlusion)
    flags: wp.int32
    base_color_size: wp.vec2  # width, height [texel], for the level of detail
    metallic_roughness_size: wp.vec2
    emissive_size: wp.vec2
    occlusion_size: wp.vec2
    mask_wrap: wp.vec2i  # wrap modes of the base colour texture: repeat 0, clamp 1, mirror 2
    base_color_texture: wp.Texture2D
    metallic_roughness_texture: wp.Texture2D
    emissive_texture: wp.Texture2D
    occlusion_texture: wp.Texture2D
    mask_texture: wp.Texture2D  # alpha of the base colour texture, exact texels


@wp.struct
class GBuffer:
    """Surface attributes a pixel; which arrays are used is the codec's choice (see encoding.py)."""

    depth: wp.array[wp.float32]  # linear view depth [m], +inf on the background
    depth16: wp.array[wp.uint16]  # codes of depth where its format has some (see depth_encoding.py), 0: background
    depth32: wp.array[wp.uint32]  # those of more than 16 bits
    normal: wp.array[wp.uint32]  # low 24 bits normal, high 8 bits model and flags
    normal_wide: wp.array[wp.uint32]  # 32-bit normal codecs
    albedo: wp.array[wp.uint32]  # three 8-bit square roots of albedo and roughness or shininess
    extra: wp.array[wp.uint32]  # by model
    full_normal: wp.array[wp.vec4]  # float32: normal, model
    full_albedo: wp.array[wp.vec4]  # float32: albedo, roughness or shininess
    full_extra: wp.array[wp.vec4]  # float32: metallic, occlusion, 0, 0 or specular


@wp.struct
class Layers:
    """Outputs written by the resolve where they were asked for."""

    normal: wp.array[wp.vec3]
    position: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    alpha: wp.array[wp.float32]
    instance_id: wp.array[wp.int32]
    semantic_id: wp.array[wp.int32]
    material_id: wp.array[wp.int32]
    triangle_id: wp.array[wp.int32]
    emissive: wp.array[wp.vec3]  # emitted radiance, for shade; written where the surface emits


@wp.struct
class Lights:
    """All lights in global order, staged for a frame; positions per view, relative to its eye."""

    # [view * capacity + light]: xyz [m] (directional: unit vector to the light), range (-1: contributes nothing, inf:
    # everywhere)
    position: wp.array[wp.vec4]
    color: wp.array[wp.vec4]  # colour times intensity, cosine of the outer angle
    axis: wp.array[wp.vec4]  # unit direction the light shines in, angle scale
    shape: wp.array[wp.vec4]  # angle offset, 1 / source radius squared, 1 / range squared, kind
    polynomial: wp.array[wp.vec4]  # constant, linear, quadratic of the polynomial fall-off
    capacity: wp.int32


@wp.struct
class LightMasks:
    """Which lights a tile considers: one bit a light, and one summary bit a word. Holds one band of tiles."""

    words: wp.array[wp.uint32]  # [tile in band * words_per_tile + word]
    summary: wp.array[wp.uint32]  # [tile in band * summary_per_tile + word / 32]
    coarse: wp.array[wp.uint32]  # [coarse tile in band * words_per_tile + word]
    bounds: wp.array[wp.vec2]  # nearest and farthest depth a tile of the band [m]
    coarse_bounds: wp.array[wp.vec2]
    words_per_tile: wp.int32
    summary_per_tile: wp.int32
    first_tile: wp.int32  # tiles before the band
    first_coarse: wp.int32
    tile_shift: wp.int32  # log2 of the tile size
    coarse_shift: wp.int32  # log2 of the tiles along a coarse tile's side


@wp.struct
class ShadowMaps:
    """Maps of the lights that cast shadows, as shading reads them."""

    first: wp.array[wp.int32]  # [view * light capacity + light]: first slot, -1: casts no shadow
    rows: wp.array[wp.vec4]  # four a slot: axes right, up, backward, each with its offset [m]; then
    # texels per unit of x/w (orthographic: per metre), near, far [m], radius of the source [m] (directional: tangent)
    tiles: wp.array[wp.vec4i]  # first texel, side [texel], SLOT_*, slots of the light from this one on
    keys: wp.array[wp.uint32]  # bits of z, larger is nearer to the light


@wp.struct
class FrameValues:
    """Per-frame values that are no View's: one element, refreshed by the upload."""

    ambient: wp.vec3
    light_count: wp.int32
    background: wp.vec3
    view_count: wp.int32


@wp.struct
class BloomLevel:
    """One level of a view's bloom: texels 2^level pixels wide; those of the last row or column may cross the edge."""

    first: wp.int32  # in the buffer of all levels
    width: wp.int32
    height: wp.int32
    edge_x: wp.int32  # twice the place of the picture's right edge [texel], rounded: what lies beyond is mirrored there
    edge_y: wp.int32
    wider: wp.float32  # share of the wider levels in what this one hands on; 0: there are none
    last: wp.int32  # row of the view's widest level


@wp.struct
class Bloom:
    """Scattered light as display reads it, and the curve that says which part of a pixel's light is scattered."""

    texels: wp.array[wp.uint64]  # half4 levels, exposed
    full: wp.array[wp.vec3]  # one value a pixel, exposed: the reference rung
    levels: wp.array[BloomLevel]  # [view * level_count + level - 1]
    bright: wp.array[wp.int32]  # 0: no pixel is above the threshold, and what the other arrays hold is stale
    level_count: wp.int32
    threshold: wp.float32  # exposed white is 1
    knee: wp.float32  # half the width of the soft start
    soft: wp.float32  # 1 / (4 knee), 0 without one
    firefly: wp.float32  # 1 / the luminance at which a pixel counts half in level 1


@wp.struct
class LightSource:
    """Lights as the scene gives them, in global order; what a frame may change, in the scene's own units."""

    position: wp.array[wp.vec3d]
    direction: wp.array[wp.vec3]
    color: wp.array[wp.vec3]
    intensity: wp.array[wp.float32]
    range: wp.array[wp.float32]
    source_radius: wp.array[wp.float32]
    coefficients: wp.array[wp.vec3]
    angles: wp.array[wp.vec2]  # inner, outer [rad]
    kind: wp.array[wp.int32]  # LIGHT_*, plus LIGHT_POLYNOMIAL
    world: wp.array[wp.int32]
