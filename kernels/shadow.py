"""Shadow maps: where each slot's view stands. First stage of the frame; lights and cameras are read on the device.

A spot light has one perspective map as wide as its cone, a point light six of 90 degrees, a directional light cascades:
orthographic maps of slices of what a camera sees. Every map keeps BORDER texels beyond what it must hold, so that a
filter never looks outside.

Cascades end by the practical split scheme (Zhang et al. 2006, "Parallel-Split Shadow Maps for Large-scale Virtual
Environments", equation 3), between the nearest and the farthest depth at which the scene can stand. A map covers the
sphere around its slice, so its texels keep their size while the camera turns, and its origin moves in whole texels, so
they keep their place while it moves. The two depths come in steps of sqrt 2 for the same reason.
Depths, splits and origins are made by operations that CPU and CUDA round alike. Block size 64.
"""

from __future__ import annotations

import warp as wp

from .clusters import to_double, to_single, widen
from .intrinsics import bits_float, float_bits
from .lights import usable
from .structs import ORTHOGRAPHIC, PERSPECTIVE, SLOT_CASCADE, SLOT_FACE, Geometry, LightSource, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
SQRT_2 = wp.constant(1.4142135)
#: Share of the coordinates that rounding may take where something must be behind everything.
BEHIND_SLACK = wp.constant(wp.float32(1.0e-5))
#: A cascade's depth reaches to the end of the scene where that is no more than so many radii away.
FAR_RADII = wp.constant(wp.float32(4.0))


@wp.struct
class ShadowParams:
    """Settings of a plan, as the slots' kernel reads them."""

    first_view: wp.int32  # view of the first slot
    cascades: wp.int32
    border: wp.float32  # texels a map keeps beyond what it must hold
    distance: wp.float32  # depth up to which directional lights cast [m], inf: as far as the scene reaches
    split_blend: wp.float32
    tangent: wp.float32  # of a directional light's angular radius
    keep: wp.int32  # 1: keep maps from frame to frame; 0: from sample to sample alone


@wp.func
def step_below(x: wp.float32):
    """Largest power of sqrt 2 that is not above x > 0, by its bits."""
    power = bits_float(float_bits(x) & wp.uint32(0x7F800000))
    return wp.where(x >= power * SQRT_2, power * SQRT_2, power)


@wp.func
def step_above(x: wp.float32):
    """Power of sqrt 2 above x > 0: at most twice x."""
    power = bits_float(float_bits(x) & wp.uint32(0x7F800000))
    return wp.where(x >= power * SQRT_2, power * 2.0, power * SQRT_2)


@wp.func
def split_depth(near: wp.float32, far: wp.float32, part: wp.int32, parts: wp.int32, blend: wp.float32):
    """Depth [m] where slice `part` of 1, 2 or 4 begins: a blend of equal steps and equal ratios."""
    if part == 0:
        return near
    if part == parts:
        return far
    # Roots round alike everywhere; a power would not.
    ratio = wp.sqrt(far / near)
    if parts == 4:
        root = wp.sqrt(ratio)
        if part == 1:
            ratio = root
        elif part == 3:
            ratio = ratio * root
    even = near + (far - near) * (wp.float32(part) / wp.float32(parts))
    if not (near > 0.0):
        # Behind the eye of an orthographic view there are no ratios.
        return even
    return blend * near * ratio + (1.0 - blend) * even


@wp.func
def slice_sphere(view: View, near: wp.float32, far: wp.float32):
    """Sphere around a view's slice between two depths: centre (right, up, depth) and radius [m]."""
    fx, fy = view.scale[0], -view.scale[1]
    left, right = -view.center[0] / fx, (wp.float32(view.width) - view.center[0]) / fx
    bottom, top = (view.center[1] - wp.float32(view.height)) / fy, view.center[1] / fy
    x, y = 0.5 * (left + right), 0.5 * (bottom + top)
    wide, tall = 0.5 * (right - left), 0.5 * (top - bottom)
    spread = wide * wide + tall * tall
    if view.projection == ORTHOGRAPHIC:
        half = 0.5 * (far - near)
        return wp.vec4(x, y, near + half, wp.sqrt(spread + half * half))
    # As far from the near corners as from the far ones, where the slice is long enough for that.
    depth = wp.min(0.5 * (near + far) * (1.0 + spread), far)
    radius = wp.float32(0.0)
    for k in range(4):
        sx, sy = wp.where(k % 2 == 0, right, left), wp.where(k < 2, top, bottom)
        for end in range(2):
            d = wp.where(end == 0, near, far)
            radius = wp.max(radius, wp.length(wp.vec3(sx * d - x * depth, sy * d - y * depth, d - depth)))
    return wp.vec4(x * depth, y * depth, depth, radius)


@wp.func
def look_along(direction: wp.vec3):
    """Rows right, up, backward of a view that looks along a unit vector; depends on nothing else."""
    backward = -direction
    up = wp.vec3(0.0, 1.0, 0.0)
    if wp.abs(direction[1]) > 0.99:
        up = wp.vec3(1.0, 0.0, 0.0)
    right = wp.normalize(wp.cross(up, backward))
    return wp.matrix_from_rows(right, wp.cross(backward, right), backward)


@wp.func
def face_axis(face: wp.int32):
    """Direction in which a face of a point light looks: +x, -x, +y, -y, +z, -z."""
    axis = wp.vec3()
    axis[face // 2] = wp.where(face % 2 == 0, 1.0, -1.0)
    return axis


@wp.func
def extent_of(view: View, bounds: wp.array[wp.float32], distance: wp.float32):
    """Nearest and farthest depth that cascades must cover [m]; the first is not below the second: none.

    The scene's box as a sphere: what the camera sees of it changes as it turns, the sphere does not.
    """
    low, high = wp.vec3(bounds[0], bounds[1], bounds[2]), wp.vec3(-bounds[3], -bounds[4], -bounds[5])
    if not (low[0] <= high[0]):
        return wp.vec2(1.0, 0.0)
    away = wp.length(to_single(to_double((low + high) * 0.5) - view.origin))
    # A millionth of the coordinates covers their rounding; nothing is nearer to anything than 1e-3 of the scene's size.
    radius = 0.5 * wp.length(high - low) + 1.0e-6 * wp.max(wp.length(low), wp.length(high))
    reach = wp.max(wp.max(radius, 1.0e-6), away) * 1.0e-3
    far = wp.min(step_above(away + radius), distance)
    near = step_below(wp.max(away - radius, reach))
    if view.projection == ORTHOGRAPHIC:
        if away <= radius:
            # The scene may begin behind the eye.
            return wp.vec2(wp.max(view.near, -far), wp.min(view.far, far))
        return wp.vec2(wp.max(view.near, near), wp.min(view.far, far))
    return wp.vec2(wp.max(view.near, near), far)


@wp.kernel
def clear_bounds_kernel(
    # Out
    out_bounds: wp.array[wp.float32],
):
    """Empty the scene's box."""
    out_bounds[wp.tid()] = wp.inf


@wp.kernel
def bound_instances_kernel(
    # Scene
    geometry: Geometry,
    # Params
    count: wp.int32,
    # Out
    out_bounds: wp.array[wp.float32],
):
    """World box of all instances: low corner, then the high one negated, both by minimum."""
    i = wp.tid()
    if i >= count:
        return
    instance = geometry.instances[i]
    transform = geometry.transforms[i]
    linear = widen(transform.linear)
    half = to_double(instance.bounds_high - instance.bounds_low) * wp.float64(0.5)
    middle = transform.origin + linear * (to_double(instance.bounds_low) + half)
    for k in range(3):
        reach = wp.abs(linear[k, 0]) * half[0] + wp.abs(linear[k, 1]) * half[1] + wp.abs(linear[k, 2]) * half[2]
        low, high = wp.float32(middle[k] - reach), wp.float32(-middle[k] - reach)
        if wp.isfinite(low) and wp.isfinite(high):
            # What is read may be stale, never too small: most instances need no atomic.
            if low < out_bounds[k]:
                wp.atomic_min(out_bounds, k, low)
            if high < out_bounds[3 + k]:
                wp.atomic_min(out_bounds, 3 + k, high)


@wp.func
def local_view(view: View, source: LightSource, light: wp.int32, kind: wp.int32, part: wp.int32, border: wp.float32):
    """View of a spot light, or of one face of a point light."""
    result = view
    result.projection = PERSPECTIVE
    result.origin = source.position[light]
    half = 0.5 * wp.float32(view.width) - border
    if kind == SLOT_FACE:
        result.rotation = look_along(face_axis(part))
    else:
        result.rotation = look_along(wp.normalize(source.direction[light]))
        # Eighths: so that the last bit of the tangent, which devices round differently, hardly ever shows.
        half = wp.floor(8.0 * half / wp.tan(source.angles[light][1])) * 0.125
    result.scale = wp.vec2(half, -half)
    # What lies inside the source, such as the bulb around it, does not stop its light.
    result.near = source.source_radius[light]
    result.far = source.range[light]
    return result


@wp.func
def deepest(view: View, bounds: wp.array[wp.float32], slack: wp.float32):
    """Depth of the deepest corner of the scene's box in an orthographic map, and `slack` times its rounding [m]."""
    low, high = wp.vec3(bounds[0], bounds[1], bounds[2]), wp.vec3(-bounds[3], -bounds[4], -bounds[5])
    half = (high - low) * 0.5
    middle = to_single(widen(view.rotation) * (to_double((low + high) * 0.5) - view.origin))
    r = view.rotation
    reach = wp.abs(r[2, 0]) * half[0] + wp.abs(r[2, 1]) * half[1] + wp.abs(r[2, 2]) * half[2]
    return reach - middle[2] + slack * BEHIND_SLACK * (wp.length(low) + wp.length(high))


@wp.func
def cascade_view(
    view: View,
    camera: View,
    direction: wp.vec3,
    part: wp.int32,
    extent: wp.vec2,
    bounds: wp.array[wp.float32],
    params: ShadowParams,
):
    """View of one cascade, its origin on the grid of its own texels."""
    near = split_depth(extent[0], extent[1], part, params.cascades, params.split_blend)
    far = split_depth(extent[0], extent[1], part + 1, params.cascades, params.split_blend)
    sphere = slice_sphere(camera, near, far)
    result = view
    result.projection = ORTHOGRAPHIC
    result.rotation = look_along(direction)
    # One texel more than the border, for the move onto the grid.
    texel = 2.0 * sphere[3] / (wp.float32(view.width) - 2.0 * params.border - 2.0)
    result.scale = wp.vec2(1.0 / texel, -1.0 / texel)
    result.far = sphere[3] + 2.0 * texel
    result.near = -result.far
    middle = wp.transpose(widen(camera.rotation)) * to_double(wp.vec3(sphere[0], sphere[1], -sphere[2]))
    rotation = widen(result.rotation)
    place = rotation * (camera.origin + middle)
    step = wp.float64(texel)
    for k in range(3):
        place[k] = wp.floor(place[k] / step) * step
    result.origin = wp.transpose(rotation) * place
    # Where the map reaches behind all there is, coarser ones need not hold what it holds (shadow_bounds.py).
    end = deepest(result, bounds, 2.0)
    if end <= FAR_RADII * sphere[3]:
        result.far = wp.max(result.far, end)
    return result


@wp.func
def same_view(a: View, b: View):
    """Whether two views of a slot show the same from the same place, to the bit."""
    for k in range(3):
        if a.origin[k] != b.origin[k]:
            return False
        for j in range(3):
            if a.rotation[k, j] != b.rotation[k, j]:
                return False
    return a.scale[0] == b.scale[0] and a.near == b.near and a.far == b.far


@wp.kernel
def place_slots_kernel(
    # Frame
    cameras: wp.array[View],
    # In
    source: LightSource,
    slots: wp.array[wp.vec4i],
    bounds: wp.array[wp.float32],
    counter: wp.array[wp.int32],
    # Params
    params: ShadowParams,
    # Out
    out_views: wp.array[View],
    out_rows: wp.array[wp.vec4],
    out_states: wp.array[wp.int32],
):
    """Write each slot's view, its rows for the look-up, and its state: 1 to be drawn, 0 kept, -1 skipped."""
    s = wp.tid()
    slot = slots[s]
    light, kind, part = slot[0], slot[1], slot[2]
    view = out_views[params.first_view + s]
    result = view
    state = wp.int32(-1)
    size = wp.float32(0.0)
    eye = wp.vec3d()
    if usable(source, light):
        if kind == SLOT_CASCADE:
            # Not as a sample moves it within pixel and lens: else each sample would have maps of its own.
            camera = cameras[slot[3]]
            extent = extent_of(camera, bounds, params.distance)
            if extent[0] < extent[1]:
                direction = wp.normalize(source.direction[light])
                result = cascade_view(view, camera, direction, part, extent, bounds, params)
                state = wp.int32(1)
                size = params.tangent
                eye = widen(result.rotation) * (out_views[slot[3]].origin - result.origin)
        else:
            result = local_view(view, source, light, kind, part, params.border)
            state = wp.int32(1)
            size = source.source_radius[light]
    if state == 1 and (params.keep != 0 or counter[0] > 0) and same_view(result, view):
        state = wp.int32(0)
    if state == -1:
        # No slot that is drawn has such planes: once its light is back, its view is another one.
        result.near = -1.0
        result.far = -1.0
    result.skipped = wp.where(state == 1, 0, 1)
    out_states[s] = state
    out_views[params.first_view + s] = result
    offset = to_single(eye)
    r = result.rotation
    for k in range(3):
        out_rows[4 * s + k] = wp.vec4(r[k, 0], r[k, 1], r[k, 2], offset[k])
    # A far plane below 0 holds nothing: what stands in no cascade is lit.
    out_rows[4 * s + 3] = wp.vec4(result.scale[0], result.near, result.far, size)
