"""Motion blur: gather along the longest motion nearby, or poses at the times of samples. Block size 64.

`velocity_gather` follows McGuire, Hennessy, Bukowski and Osman 2012, "A Reconstruction Filter for Plausible Motion
Blur": the longest motion of each tile, of its neighbourhood, and a gather along it that weighs depth. The shutter
closes at the frame's own time, so a surface's trail reaches back from where it is; and a tap stands for a share of the
shutter's time in which the pixel saw the tap's surface in place of its own:

- a tap no farther than the pixel, while its own trail crosses the pixel;
- a tap behind the pixel, while the pixel's surface had not yet come to cover it, which the length of its trail tells.

The rest of the time the pixel sees itself, so the weights add up to 1 and a pixel near which nothing moves keeps its
bits. Bytes a pixel: image and motion in, image out, 16 + 8; taps of 20 from the caches where something moves.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .intrinsics import load_vec4i
from .projection import pixel_index, pixel_of
from .sampling import Sample
from .structs import MODULE_OPTIONS, Transform, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half image,): what CI compiles.
VARIANTS = [(True,), (False,)]
#: Trails shorter than this stay within their pixel [px].
STILL_PX = wp.constant(wp.float32(0.5))
#: Share of its depth by which a tap must lie farther away to be wholly behind.
BEHIND = wp.constant(wp.float32(0.05))
HALF_MAX = wp.constant(wp.float32(65504.0))


@wp.func
def trail(motion: wp.vec2, view: View, limit: wp.float32):
    """Way of a surface while the shutter is open [px], at most as long as the limit."""
    v = motion * view.shutter
    return v * wp.min(1.0, limit / wp.max(wp.length(v), 1.0e-6))


@wp.func
def longer(a: wp.vec2, b: wp.vec2):
    """The longer of two motions; of equally long ones the first."""
    if wp.length_sq(b) > wp.length_sq(a):
        return b
    return a


@wp.kernel
def row_motion_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    motion: wp.array[wp.vec2],
    # Params
    limit: wp.float32,
    first: wp.int32,
    # Out
    out_rows: wp.array[wp.vec2],
):
    """One thread a row of a tile of 16 x 16 pixels: its longest trail."""
    thread = wp.tid() + first
    tile = load_vec4i(tiles, thread // 16)
    view = views[tile[0]]
    y = tile[2] + thread % 16
    longest = wp.vec2(0.0, 0.0)
    if y < view.height and view.depth_only == 0:
        for x in range(tile[1], wp.min(tile[1] + 16, view.width)):
            longest = longer(longest, trail(motion[pixel_index(view, x, y)], view, limit))
    out_rows[thread] = longest


@wp.kernel
def tile_motion_kernel(
    # In
    rows: wp.array[wp.vec2],
    # Params
    first: wp.int32,
    # Out
    out_tiles: wp.array[wp.vec2],
):
    """One thread a tile: its longest trail."""
    tile = wp.tid() + first
    longest = wp.vec2(0.0, 0.0)
    for k in range(16):
        longest = longer(longest, rows[16 * tile + k])
    out_tiles[tile] = longest


@wp.kernel
def near_motion_kernel(
    # Frame
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    # In
    longest: wp.array[wp.vec2],
    # Params
    limit: wp.float32,
    first: wp.int32,
    # Out
    out_near: wp.array[wp.vec2],
):
    """One thread a tile: the longest trail that may reach it."""
    tile = wp.tid() + first
    row = load_vec4i(tiles, tile)
    view = views[row[0]]
    span = wp.int32(wp.ceil(limit * 0.0625))
    cx, cy = row[1] >> 4, row[2] >> 4
    found = longest[tile]
    for y in range(wp.max(cy - span, 0), wp.min(cy + span, (view.height - 1) >> 4) + 1):
        for x in range(wp.max(cx - span, 0), wp.min(cx + span, view.bins_x - 1) + 1):
            v = longest[view.bin_offset + y * view.bins_x + x]
            gap = 16 * (wp.max(wp.abs(x - cx), wp.abs(y - cy)) - 1)
            if wp.length(v) > wp.float32(gap):
                found = longer(found, v)
    out_near[tile] = found


@wp.func
def share_of_time(length: wp.float32, distance: wp.float32, longest: wp.float32):
    """Share of a tap's place at which a trail of that length passes, times the slower pace at which it does."""
    share = wp.clamp(length - distance + 0.5, 0.0, 1.0)
    return share * longest / wp.max(length, STILL_PX)


@wp.func
def nearest_way(motion: wp.array[wp.vec2], view: View, limit: wp.float32, x: wp.int32, y: wp.int32, way: wp.vec2):
    """Way to gather along: the pixel's own where it is of about the tile's length, or of what the tile's leads to.

    A tile's one direction shows in what turns (Guertin, McGuire and Nowrouzezahrai 2014, "A Fast and Stable
    Feature-Aware Motion Blur Filter", take both).
    """
    bar = 0.25 * wp.length_sq(way)
    own = trail(motion[pixel_index(view, x, y)], view, limit)
    if wp.length_sq(own) >= bar:
        return own
    for k in range(1, 4):
        # A trail that crosses the pixel starts on the way that leads back along it.
        tx = wp.clamp(x + wp.int32(wp.round(0.25 * wp.float32(k) * way[0])), 0, view.width - 1)
        ty = wp.clamp(y + wp.int32(wp.round(0.25 * wp.float32(k) * way[1])), 0, view.height - 1)
        found = trail(motion[pixel_index(view, tx, ty)], view, limit)
        if wp.length_sq(found) >= bar:
            return found
    return way


@functools.cache
def make_motion_blur_kernel(half: bool):
    """Kernel that gathers along motions; `half`: whether the plan keeps half4 images."""
    load, store = make_image_codec(half)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def motion_blur_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        image: Image,
        depth: wp.array[wp.float32],
        motion: wp.array[wp.vec2],
        near: wp.array[wp.vec2],
        # Params
        limit: wp.float32,
        most: wp.int32,
        first: wp.int32,
        # Out
        out_image: Image,
    ):
        pixel = pixel_of(blocks, wp.tid() + first)
        view = views[pixel[0]]
        x, y = pixel[1], pixel[2]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        color = load(image, i)
        way = near[view.bin_offset + (y >> 4) * view.bins_x + (x >> 4)]
        longest = wp.length(way)
        if longest > STILL_PX:
            way = nearest_way(motion, view, limit, x, y, way)
            longest = wp.length(way)
            along = way * (1.0 / longest)
            own = wp.abs(wp.dot(trail(motion[i], view, limit), along))
            nearness = 1.0 / depth[i]
            softness = 1.0 / wp.max(BEHIND * nearness, 1.0e-20)
            taps = wp.clamp(wp.int32(wp.ceil(longest)), 1, most)
            inverse = 1.0 / wp.float32(taps)
            total = wp.vec3(0.0, 0.0, 0.0)
            weight = wp.float32(0.0)
            for k in range(taps):
                distance = (wp.float32(k) + 0.5) * inverse * longest
                tx = wp.clamp(x + wp.int32(wp.round(along[0] * distance)), 0, view.width - 1)
                ty = wp.clamp(y + wp.int32(wp.round(along[1] * distance)), 0, view.height - 1)
                j = pixel_index(view, tx, ty)
                length = wp.max(wp.dot(trail(motion[j], view, limit), along), 0.0)
                farther = wp.clamp((nearness - 1.0 / depth[j]) * softness, 0.0, 1.0)
                w = (1.0 - farther) * share_of_time(length, distance, longest)
                w = (w + farther * share_of_time(own, distance, longest)) * inverse
                total = total + store_limit(load(image, j), HALF_MAX) * w
                weight = weight + w
            if weight > 0.0:
                scale = wp.min(weight, 1.0)
                color = color + (total * (1.0 / weight) - color) * scale
        store(out_image, i, color)

    return motion_blur_kernel


@wp.func
def turn_between(a: wp.mat33, b: wp.mat33, t: wp.float32):
    """Rotation a share of the way from one to another along the shortest arc, as a matrix (Shoemake 1985)."""
    p, q = wp.quat_from_matrix(a), wp.quat_from_matrix(b)
    if wp.dot(p, q) < 0.0:
        q = -q
    return wp.quat_to_matrix(wp.normalize(wp.quat_slerp(p, q, t)))


@wp.func
def rotation_part(m: wp.mat33):
    """Rotation nearest to the columns of m in turn (Gram-Schmidt); mirrored ones are turned round."""
    x = wp.normalize(wp.vec3(m[0, 0], m[1, 0], m[2, 0]))
    y = wp.vec3(m[0, 1], m[1, 1], m[2, 1])
    y = wp.normalize(y - x * wp.dot(x, y))
    z = wp.cross(x, y)
    return wp.matrix_from_cols(x, y, z)


@wp.func
def between(a: Transform, b: Transform, t: wp.float32):
    """Transform a share of the way: places along a line, rotations along an arc, stretch linearly; b itself at 1."""
    result = b
    if t < 1.0 and not (a.origin == b.origin and a.linear == b.linear):
        ra, rb = rotation_part(a.linear), rotation_part(b.linear)
        sa, sb = wp.transpose(ra) * a.linear, wp.transpose(rb) * b.linear
        result.linear = turn_between(ra, rb, t) * (sa + (sb - sa) * t)
        result.origin = a.origin + (b.origin - a.origin) * wp.float64(t)
    return result


@wp.kernel
def shutter_views_kernel(
    # In
    samples: wp.array[Sample],
    counter: wp.array[wp.int32],
    known: wp.array[wp.int32],
    uploaded: wp.array[View],
    # Out
    out_old: wp.array[View],
    out_views: wp.array[View],
    out_middle: wp.array[View],
):
    """One thread a view: its pose at the sample's time, with the sample's jitter and without; the last row keeps the
    frame's for the next.
    """
    v = wp.tid()
    sample = samples[wp.min(counter[0], samples.shape[0] - 1)]
    # One by one: as a tuple they would be references, and changing one would change the array.
    now = uploaded[v]
    view = out_views[v]
    middle = uploaded[v]
    t = 1.0 - now.shutter * sample.time
    if known[0] != 0 and t < 1.0:
        old = out_old[v]
        if not (old.origin == now.origin and old.rotation == now.rotation):
            view.origin = old.origin + (now.origin - old.origin) * wp.float64(t)
            view.rotation = turn_between(old.rotation, now.rotation, t)
            out_views[v] = view
            middle.origin = view.origin
            middle.rotation = view.rotation
    out_middle[v] = middle
    if sample.weight == 0.0:
        out_old[v] = now


@wp.kernel
def shutter_transforms_kernel(
    # In
    samples: wp.array[Sample],
    counter: wp.array[wp.int32],
    known: wp.array[wp.int32],
    uploaded: wp.array[View],
    # Out
    out_old: wp.array[Transform],
    out_now: wp.array[Transform],
    out_transforms: wp.array[Transform],
):
    """One thread an instance: its transform at the sample's time; the first sample keeps the frame's, the last row
    puts it back and keeps it for the next frame.
    """
    i = wp.tid()
    k = wp.min(counter[0], samples.shape[0] - 1)
    if k == 0:
        out_now[i] = out_transforms[i]
    now = out_now[i]
    shutter = wp.float32(0.0)
    for v in range(uploaded.shape[0]):
        shutter = wp.max(shutter, uploaded[v].shutter)
    t = 1.0 - shutter * samples[k].time
    if known[0] != 0:
        out_transforms[i] = between(out_old[i], now, t)
    if samples[k].weight == 0.0:
        out_transforms[i] = now
        out_old[i] = now


@wp.kernel
def shutter_known_kernel(
    # In
    samples: wp.array[Sample],
    counter: wp.array[wp.int32],
    # Out
    out_known: wp.array[wp.int32],
):
    """One thread: the poses of a frame are known once its last row has been."""
    if samples[wp.min(counter[0], samples.shape[0] - 1)].weight == 0.0:
        out_known[0] = 1
