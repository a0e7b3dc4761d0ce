"""Which shadow maps are drawn anew: those whose view, or whose casters, are not what they were a frame ago.

All on the device, since lights and transforms may live there. A map is kept where its view is the same to the bit and
no instance that moved touches its volume, neither where it was nor where it is now; a mesh with bound points counts as
one that moves everywhere, once a frame. What is kept is neither cleared nor drawn; since drawing it again would give
the same bits, keeping never shows. A number that is not finite counts as a move. Where a frame takes several samples
a pixel, all this happens in each: what the shutter moves is drawn anew, the rest once. Block size 128.
"""

from __future__ import annotations

import warp as wp

from .clusters import classify_sphere, to_double, to_single, widen
from .intrinsics import store_zeros
from .structs import Geometry, Instance, Transform, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 128
#: Texels that a thread clears, and that a row of the table of maps stands for; sides are multiples of 64.
CLEARED = wp.constant(4)
CHUNK = wp.constant(4096)


@wp.func
def same_transform(a: Transform, b: Transform):
    """Whether two transforms are the same number for number."""
    for k in range(3):
        if a.origin[k] != b.origin[k]:
            return False
        for j in range(3):
            if a.linear[k, j] != b.linear[k, j]:
                return False
    return True


@wp.kernel
def note_moves_kernel(
    # Scene
    geometry: Geometry,
    # In
    before: wp.array[Transform],
    bound: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    # Out
    out_moved: wp.array[wp.int32],
):
    """Mark the instances that moved since the last frame or sample, 2 where points did; last: whether any moved."""
    i = wp.tid()
    moved = wp.where(same_transform(geometry.transforms[i], before[i]), 0, 1)
    # Points are the same for all samples of a frame.
    if bound[i] != 0 and counter[0] == 0:
        moved = wp.int32(2)
    out_moved[i] = moved
    if moved != 0:
        out_moved[out_moved.shape[0] - 1] = 1


@wp.func
def touches(view: View, instance: Instance, transform: Transform):
    """Whether an instance's box may reach into a view."""
    linear = widen(transform.linear)
    half = to_double(instance.bounds_high - instance.bounds_low) * wp.float64(0.5)
    middle = transform.origin + linear * (to_double(instance.bounds_low) + half)
    reach = wp.vec3d()
    for k in range(3):
        reach[k] = wp.abs(linear[k, 0]) * half[0] + wp.abs(linear[k, 1]) * half[1] + wp.abs(linear[k, 2]) * half[2]
    away = to_single(widen(view.rotation) * (middle - view.origin))
    # As for clusters: a share of radius and distance covers the rounding of what is drawn.
    radius = wp.length(to_single(reach)) * 1.001 + 1.0e-5 * wp.length(away)
    return classify_sphere(view, wp.vec3(view.scale[0] * away[0], view.scale[1] * away[1], -away[2]), radius) != 0


@wp.kernel
def touch_slots_kernel(
    # Frame
    views: wp.array[View],
    # Scene
    geometry: Geometry,
    # In
    before: wp.array[Transform],
    moved: wp.array[wp.int32],
    # Params
    first_view: wp.int32,
    # Out
    out_states: wp.array[wp.int32],
):
    """Have the kept slots drawn that an instance moved in, out of, or within."""
    s, i = wp.tid()
    if moved[moved.shape[0] - 1] == 0 or moved[i] == 0 or out_states[s] != 0:
        return
    view = views[first_view + s]
    own = i - view.own_first
    if i >= view.shared_instances and (own < 0 or own >= view.own_count):
        return
    instance = geometry.instances[i]
    # Where bound points were a frame ago nobody knows.
    if moved[i] == 2 or touches(view, instance, before[i]) or touches(view, instance, geometry.transforms[i]):
        out_states[s] = 1


@wp.kernel
def settle_slots_kernel(
    # Scene
    geometry: Geometry,
    # Params
    first_view: wp.int32,
    slot_count: wp.int32,
    instance_count: wp.int32,
    # Out
    out_states: wp.array[wp.int32],
    out_views: wp.array[View],
    out_before: wp.array[Transform],
    out_moved: wp.array[wp.int32],
):
    """Tell the views whether they are drawn, and remember this frame's transforms."""
    k = wp.tid()
    if k < slot_count:
        view = out_views[first_view + k]
        view.skipped = wp.where(out_states[k] == 1, 0, 1)
        out_views[first_view + k] = view
    if k < instance_count:
        out_before[k] = geometry.transforms[k]
    if k == 0:
        out_moved[out_moved.shape[0] - 1] = 0


@wp.kernel
def clear_maps_kernel(
    # Frame
    views: wp.array[View],
    # In
    chunks: wp.array[wp.int32],
    # Params
    first: wp.int32,
    # Out
    out_keys: wp.array[wp.uint32],
):
    """Clear the maps that are drawn anew."""
    texel = (wp.tid() + first) * CLEARED
    if views[chunks[texel // CHUNK]].skipped == 0:
        store_zeros(out_keys, texel)
