"""Debug views: a buffer of the frame as sRGB bytes. One thread a pixel, 8 x 8 blocks, block size 64; last in the frame.

Imported and compiled only where a view is asked for, and only for the kind of view it is. Colours are made for eyes,
not for speed: nothing here is part of a frame that shows the picture. Every byte is defined whatever the buffer holds.
"""

from __future__ import annotations

import functools

import warp as wp

from .clusters import pair_of_instance
from .color import clamp_radiance, srgb_code, tone_curve
from .color_map import hash_bits, heat, heat_of_count, id_color
from .encoding import pack_unorm
from .image import Image, make_image_codec
from .interpolation import barycentric, relative_vertex
from .intrinsics import bits_float, float_bits, load_vec4i
from .projection import pixel_index, pixel_of, pixel_ray, position_of
from .structs import (
    ALL_BITS,
    CLUSTER_SIZE,
    MODULE_OPTIONS,
    ORTHOGRAPHIC,
    Geometry,
    Instance,
    LightMasks,
    Pair,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Ways to show a pixel; each is a function `show_KIND` below.
KINDS = (
    "direction", "depth", "position", "albedo", "radiance", "share", "id", "count", "tiles", "clusters", "wireframe",
    "shadow_atlas", "invalid",
)  # fmt: skip
#: (kind, tone curve, half radiance): what CI compiles.
VARIANTS = [(kind, "pbr_neutral" if kind in ("radiance", "invalid") else "off", False) for kind in KINDS]
VARIANTS.append(("invalid", "pbr_neutral", True))
OPAQUE = wp.constant(wp.uint32(0xFF000000))
SIGN = wp.constant(wp.uint32(0x80000000))


@wp.struct
class Shown:
    """What a view may read; arrays it does not are one element long and never touched."""

    vectors: wp.array[wp.vec3]
    scalars: wp.array[wp.float32]
    indices: wp.array[wp.int32]
    normals: wp.array[wp.vec3]  # 0 on the background
    image: Image
    keys: wp.array[wp.uint64]
    depth_keys: wp.array[wp.uint32]
    pairs: wp.array[Pair]
    geometry: Geometry
    clusters: wp.array[wp.int32]  # triangle of Geometry.triangles -> cluster
    masks: LightMasks
    ranges: wp.array[wp.uint32]  # [2 view]: ordered bits of the largest depth, and complement of the smallest's
    thresholds: wp.array[wp.float32]  # of sRGB codes
    maps: wp.vec4i  # first view that is a shadow map, their number, columns, rows of their grid


@wp.func
def ordered_bits(value: wp.float32):
    """Bits of a float as an integer that orders as it does, negative ones too."""
    bits = float_bits(value)
    if (bits & SIGN) != wp.uint32(0):
        return ~bits
    return bits | SIGN


@wp.func
def from_ordered(bits: wp.uint32):
    """Undo `ordered_bits`."""
    if (bits & SIGN) != wp.uint32(0):
        return bits_float(bits ^ SIGN)
    return bits_float(~bits)


@wp.kernel(grid_stride=False)
def depth_range_kernel(
    # Frame
    views: wp.array[View],
    blocks: wp.array[wp.vec4i],
    # In
    depth: wp.array[wp.float32],
    # Out
    out_ranges: wp.array[wp.uint32],
):
    """Nearest and farthest surface of each view; the maximum is taken after a look, and does not depend on order."""
    pixel = pixel_of(blocks, wp.tid())
    view = views[pixel[0]]
    x, y = pixel[1], pixel[2]
    if x >= view.width or y >= view.height:
        return
    d = depth[pixel_index(view, x, y)]
    if not wp.isfinite(d):
        return
    bits = ordered_bits(d)
    slot = 2 * pixel[0]
    if bits > out_ranges[slot]:
        wp.atomic_max(out_ranges, slot, bits)
    if ~bits > out_ranges[slot + 1]:
        wp.atomic_max(out_ranges, slot + 1, ~bits)


@wp.kernel(grid_stride=False)
def cluster_of_triangle_kernel(
    # Scene
    geometry: Geometry,
    # Out
    out_clusters: wp.array[wp.int32],
):
    """One thread an (instance, cluster) slot: name the cluster at each of its triangles, in the mesh's own order."""
    slot = geometry.slots[wp.tid()]
    cluster = geometry.clusters[slot[1]]
    first = geometry.instances[slot[0]].triangle_first
    for k in range(cluster.count):
        # Instances of one mesh write the same number.
        out_clusters[first + geometry.cluster_triangles[cluster.first + k][3]] = slot[1]


@wp.func
def facing(view: View, normal: wp.vec3, x: wp.int32, y: wp.int32):
    """Cosine between a normal and the way to the viewer, at least 0; 0 for no normal."""
    ray = wp.vec3(0.0, 0.0, -1.0)
    if view.projection != ORTHOGRAPHIC:
        ray = wp.normalize(pixel_ray(view, wp.float32(x) + 0.5, wp.float32(y) + 0.5))
    return wp.clamp(-wp.dot(normal, wp.transpose(view.rotation) * ray), 0.0, 1.0)


@wp.func
def grey(value: wp.float32):
    """One number in three channels."""
    return wp.vec3(value, value, value)


@wp.func
def show_direction(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Components from [-1, 1]; black where there is no direction."""
    n = shown.vectors[i]
    if wp.dot(n, n) == 0.0:
        return wp.vec3()
    return n * 0.5 + grey(0.5)


@wp.func
def show_depth(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Heat of the depth's logarithm between the view's ends; linear where orthographic, since it may be negative."""
    d = shown.scalars[i]
    if not wp.isfinite(d):
        return wp.vec3()
    farthest = from_ordered(shown.ranges[2 * index])
    nearest = from_ordered(~shown.ranges[2 * index + 1])
    if view.projection != ORTHOGRAPHIC:
        d, nearest, farthest = wp.log2(d), wp.log2(nearest), wp.log2(farthest)
    share = wp.float32(0.0)
    if farthest > nearest:
        share = (d - nearest) / (farthest - nearest)
    return heat(1.0 - share)


@wp.func
def show_position(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """A wave of 2 m along each axis, without steps."""
    p = shown.vectors[i]
    c = wp.vec3()
    for k in range(3):
        share = p[k] * 0.5
        c[k] = wp.abs(2.0 * (share - wp.floor(share)) - 1.0)
    if wp.dot(p, p) == 0.0:
        return wp.vec3()
    return c


@wp.func
def show_share(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Grey."""
    return grey(shown.scalars[i])


@wp.func
def show_id(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Hash colour."""
    if shown.indices[i] < 0:
        return wp.vec3()
    return id_color(wp.uint32(shown.indices[i]))


@wp.func
def show_count(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Heat by doublings."""
    return heat_of_count(shown.indices[i])


@wp.func
def show_tiles(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Heat of the number of bits of the tile's mask, with the surface showing through; tiles have a dark edge."""
    shift = shown.masks.tile_shift
    tile = view.tile_offset - shown.masks.first_tile + (y >> shift) * view.tiles_x + (x >> shift)
    count = wp.int32(0)
    for k in range(shown.masks.words_per_tile):
        bits = shown.masks.words[tile * shown.masks.words_per_tile + k]
        while bits != wp.uint32(0):
            bits = bits & (bits - wp.uint32(1))
            count += 1
    level = 0.5 + 0.5 * facing(view, shown.normals[i], x, y)
    inside = (1 << shift) - 1
    if (x & inside) == 0 or (y & inside) == 0:
        level *= 0.6
    return heat_of_count(count) * level


@wp.struct
class Hit:
    """The triangle that a pixel shows."""

    slot: wp.int32
    instance: Instance
    triangle: wp.int32


@wp.func
def hit_of_key(geometry: Geometry, key: wp.uint64):
    """Read a key that is not 0."""
    identity = ALL_BITS - wp.uint32(key)
    result = Hit()
    result.slot = geometry.id_blocks[wp.int32(identity / wp.uint32(CLUSTER_SIZE))]
    result.instance = geometry.instances[result.slot]
    result.triangle = result.instance.triangle_first + wp.int32(identity - result.instance.id_base)
    return result


@wp.func
def show_clusters(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Hash colour of (instance, cluster), as light as the surface faces the viewer."""
    if shown.keys[i] == wp.uint64(0):
        return wp.vec3()
    hit = hit_of_key(shown.geometry, shown.keys[i])
    instance = hash_bits(wp.uint32(hit.instance.public_id))
    color = id_color(wp.uint32(shown.clusters[hit.triangle]) + instance)
    return color * (0.5 + 0.5 * facing(view, shown.normals[i], x, y))


@wp.func
def show_wireframe(shown: Shown, view: View, index: wp.int32, x: wp.int32, y: wp.int32, i: wp.int32):
    """Edges by the weights' distance from 0 in pixels; fainter where triangles are so small that all would be edge."""
    if shown.keys[i] == wp.uint64(0):
        return wp.vec3()
    geometry = shown.geometry
    hit = hit_of_key(geometry, shown.keys[i])
    v = load_vec4i(geometry.triangles, hit.triangle)
    pair = shown.pairs[pair_of_instance(view, hit.slot)]
    px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
    b = barycentric(
        relative_vertex(view, pair, position_of(geometry, v[0]), px, py),
        relative_vertex(view, pair, position_of(geometry, v[1]), px, py),
        relative_vertex(view, pair, position_of(geometry, v[2]), px, py),
    )
    distance, height = wp.float32(1.0e6), wp.float32(1.0e6)
    for k in range(3):
        change = wp.sqrt(b.ddx[k] * b.ddx[k] + b.ddy[k] * b.ddy[k])
        if change > 1.0e-6:
            distance = wp.min(distance, b.weight[k] / change)
            height = wp.min(height, 1.0 / change)
    line = wp.clamp(1.25 - distance, 0.0, 1.0) * wp.clamp(height * 0.2, 0.3, 1.0)
    surface = grey(0.1 + 0.3 * facing(view, shown.normals[i], x, y))
    return surface * (1.0 - line) + wp.vec3(1.0, 0.62, 0.2) * line


@wp.func
def show_shadow_atlas(shown: Shown, views: wp.array[View], view: View, x: wp.int32, y: wp.int32):
    """Root of z in the pixel's cell of a grid of shadow maps, each stretched to its cell; dark grey past the last.

    Perspective z falls like 1 / distance: its fourth root spreads what lies far from the light.
    """
    columns, rows = shown.maps[2], shown.maps[3]
    column, row = x * columns // view.width, y * rows // view.height
    number = row * columns + column
    if number >= shown.maps[1]:
        return grey(0.15)
    map = views[shown.maps[0] + number]
    u = wp.float32(x * columns - column * view.width) / wp.float32(view.width)
    v = wp.float32(y * rows - row * view.height) / wp.float32(view.height)
    mx = wp.min(wp.int32(u * wp.float32(map.width)), map.width - 1)
    my = wp.min(wp.int32(v * wp.float32(map.height)), map.height - 1)
    root = wp.sqrt(bits_float(shown.depth_keys[pixel_index(map, mx, my)]))
    if map.projection != ORTHOGRAPHIC:
        root = wp.sqrt(root)
    return grey(root)


#: Kinds that give sRGB codes / 255 from a pixel's own numbers alone; the others are written out in the kernel.
SHOW = {
    "direction": show_direction, "depth": show_depth, "position": show_position, "share": show_share, "id": show_id,
    "count": show_count, "tiles": show_tiles, "clusters": show_clusters, "wireframe": show_wireframe,
}  # fmt: skip


@wp.func
def pack_linear(v: wp.vec3, thresholds: wp.array[wp.float32]):
    """Bytes of linear values, encoded as `display` does."""
    return (
        srgb_code(v[0], thresholds)
        | (srgb_code(v[1], thresholds) << wp.uint32(8))
        | (srgb_code(v[2], thresholds) << wp.uint32(16))
        | OPAQUE
    )


@wp.func
def pack_encoded(v: wp.vec3):
    """Bytes of values that are encoded already."""
    r, g, b = pack_unorm(v[0], 255.0), pack_unorm(v[1], 255.0), pack_unorm(v[2], 255.0)
    return r | (g << wp.uint32(8)) | (b << wp.uint32(16)) | OPAQUE


@wp.func
def mark_invalid(value: wp.vec3, mapped: wp.vec3):
    """Red for a NaN, green for an infinity, else a third of the picture's lightness."""
    if wp.isnan(value[0]) or wp.isnan(value[1]) or wp.isnan(value[2]):
        return wp.vec3(1.0, 0.0, 0.0)
    if wp.isinf(value[0]) or wp.isinf(value[1]) or wp.isinf(value[2]):
        return wp.vec3(0.0, 1.0, 0.0)
    return grey((0.2126 * mapped[0] + 0.7152 * mapped[1] + 0.0722 * mapped[2]) * 0.3)


@functools.cache
def make_debug_view_kernel(kind: str, curve: str, half: bool):
    """Kernel that shows one kind of buffer.

    Args:
        kind: One of KINDS.
        curve: Name of the tone curve, for kinds that show light.
        half: Whether the HDR image is half4.
    """
    show, tone, load = SHOW.get(kind, show_share), tone_curve(curve), make_image_codec(half)[0]

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def debug_view_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        shown: Shown,
        # Params
        first: wp.int32,
        # Out
        out_display: wp.array[wp.uint32],
    ):
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        if wp.static(kind == "albedo"):
            out_display[i] = pack_linear(shown.vectors[i], shown.thresholds)
        elif wp.static(kind == "radiance"):
            mapped = tone(clamp_radiance(shown.vectors[i] * view.exposure))
            out_display[i] = pack_linear(mapped, shown.thresholds)
        elif wp.static(kind == "invalid"):
            value = load(shown.image, i)
            mapped = tone(clamp_radiance(value * view.exposure))
            out_display[i] = pack_linear(mark_invalid(value, mapped), shown.thresholds)
        elif wp.static(kind == "shadow_atlas"):
            out_display[i] = pack_encoded(show_shadow_atlas(shown, views, view, x, y))
        else:
            out_display[i] = pack_encoded(show(shown, view, pixel[0], x, y, i))

    return debug_view_kernel
