"""Lights: staging for a frame, and how much of a light reaches a point.

Staging runs first in the frame: positions are taken relative to each view's eye in float64, derived numbers are
computed once, and a light with a non-finite number, no power or another world contributes nothing. Units and formulas:
KHR_lights_punctual (range window clamp(1 - (d/range)⁴, 0, 1), spot angle scale and offset, squared); `polynomial` is
1 / (constant + linear d + quadratic d²) inside the range, as in X3D 4.0, 17.2.2.1.
Block size 128.
"""

from __future__ import annotations

import functools

import warp as wp

from .clusters import to_double, to_single
from .intrinsics import load_vec4
from .structs import (
    LIGHT_DIRECTIONAL,
    LIGHT_POINT,
    LIGHT_POLYNOMIAL,
    LIGHT_SPOT,
    FrameValues,
    Lights,
    LightSource,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 128


@wp.struct
class Arrival:
    """Light arriving at a point."""

    inverse: wp.float32  # turns the vector to the light into a unit vector
    power: wp.float32  # irradiance at normal incidence per colour; 0 where nothing arrives


@wp.func
def usable(source: LightSource, i: wp.int32):
    """Whether every number of a light can be used."""
    kind = source.kind[i] & 3
    tint = source.color[i]
    power = source.intensity[i]
    good = wp.isfinite(tint) and wp.isfinite(power) and power > 0.0
    good = good and wp.min(tint[0], wp.min(tint[1], tint[2])) >= 0.0 and tint[0] + tint[1] + tint[2] > 0.0
    if kind != LIGHT_POINT:
        length = wp.length(source.direction[i])
        good = good and wp.isfinite(length) and length > 0.0
    if kind != LIGHT_DIRECTIONAL:
        good = good and wp.isfinite(to_single(source.position[i])) and source.range[i] > 0.0
    return good


@wp.kernel
def stage_lights_kernel(
    # Frame
    views: wp.array[View],
    values: wp.array[FrameValues],
    # In
    source: LightSource,
    # Params
    first: wp.int32,
    # Out
    out_lights: Lights,
):
    """Stage every light for every view."""
    row, i = wp.tid()
    v = row + first
    view = views[v]
    place = v * out_lights.capacity + i
    if i >= values[0].light_count or not usable(source, i):
        out_lights.position[place] = wp.vec4(0.0, 0.0, 0.0, -1.0)
        return
    kind = source.kind[i]
    shape = kind & 3
    reach = source.range[i]
    relative = wp.vec3()
    axis = wp.vec3()
    if shape != LIGHT_POINT:
        axis = wp.normalize(source.direction[i])
    if shape == LIGHT_DIRECTIONAL:
        reach = wp.inf
        relative = -axis
    else:
        relative = to_single(source.position[i] - view.origin)
    world = source.world[i]
    reach_here = reach
    if world >= 0 and view.world >= 0 and world != view.world:
        reach_here = -1.0
    out_lights.position[place] = wp.vec4(relative[0], relative[1], relative[2], reach_here)
    # What follows is shared by all views, so it must not know the first one's world.
    if v > 0:
        return
    outer_cosine = wp.float32(-1.0)
    scale, offset = wp.float32(0.0), wp.float32(1.0)
    if shape == LIGHT_SPOT:
        angles = source.angles[i]
        outer_cosine = wp.cos(angles[1])
        scale = 1.0 / wp.max(0.001, wp.cos(angles[0]) - outer_cosine)
        offset = -outer_cosine * scale
    inverse = wp.float32(0.0)
    if wp.isfinite(reach):
        inverse = 1.0 / (reach * reach)
    radius = source.source_radius[i]
    tint = source.color[i] * source.intensity[i]
    c = source.coefficients[i]
    out_lights.color[i] = wp.vec4(tint[0], tint[1], tint[2], outer_cosine)
    out_lights.axis[i] = wp.vec4(axis[0], axis[1], axis[2], scale)
    out_lights.shape[i] = wp.vec4(offset, 1.0 / wp.max(radius * radius, 1.0e-30), inverse, wp.float32(kind))
    out_lights.polynomial[i] = wp.vec4(c[0], c[1], c[2], 0.0)


@wp.kernel
def stage_vector_kernel(
    # In
    values: wp.array2d[wp.float32],
    # Params
    offset: wp.int32,
    # Out
    out_values: wp.array[wp.vec3],
):
    """Copy a bound (lights, 3) array into its group's place."""
    i = wp.tid()
    out_values[offset + i] = wp.vec3(values[i, 0], values[i, 1], values[i, 2])


@wp.kernel
def stage_position_kernel(
    # In
    values: wp.array2d[wp.float32],
    # Params
    offset: wp.int32,
    # Out
    out_values: wp.array[wp.vec3d],
):
    """Copy a bound (lights, 3) array of positions into its group's place, widened."""
    i = wp.tid()
    out_values[offset + i] = to_double(wp.vec3(values[i, 0], values[i, 1], values[i, 2]))


@wp.kernel
def stage_scalar_kernel(
    # In
    values: wp.array[wp.float32],
    # Params
    offset: wp.int32,
    # Out
    out_values: wp.array[wp.float32],
):
    """Copy a bound (lights,) array into its group's place."""
    i = wp.tid()
    out_values[offset + i] = values[i]


@functools.cache
def make_arrive(kinds: int, polynomial: bool):
    """(towards, arrive): vector to a light, and what arrives; bit k of `kinds` says that kind k occurs.

    They are two, so that a surface that faces away costs neither a root nor a division.
    """

    @wp.func
    def towards(lights: Lights, i: wp.int32, place: wp.vec4, point: wp.vec3):
        if wp.static(kinds == 4):
            return wp.vec3(place[0], place[1], place[2])
        to_light = wp.vec3(place[0], place[1], place[2]) - point
        if wp.static((kinds & 4) != 0):
            if (wp.int32(lights.shape[i][3]) & 3) == LIGHT_DIRECTIONAL:
                to_light = wp.vec3(place[0], place[1], place[2])
        return to_light

    @wp.func
    def arrive(lights: Lights, i: wp.int32, reach: wp.float32, to_light: wp.vec3):
        result = Arrival()
        # A range below 0 marks a light that contributes nothing.
        if not (reach > 0.0):
            return result
        if wp.static((kinds & 4) != 0):
            if (wp.int32(lights.shape[i][3]) & 3) == LIGHT_DIRECTIONAL:
                result.inverse = 1.0
                result.power = 1.0
                return result
        if wp.static((kinds & 3) != 0):
            d2 = wp.dot(to_light, to_light)
            # At the range itself it is exactly 0; the second test is for points where the light is.
            if d2 >= reach * reach or d2 == 0.0:
                return result
            shape = load_vec4(lights.shape, i)
            distance = wp.sqrt(d2)
            result.inverse = 1.0 / distance
            ratio = d2 * shape[2]
            power = wp.max(1.0 - ratio * ratio, 0.0) * wp.min(result.inverse * result.inverse, shape[1])
            if wp.static(polynomial):
                if (wp.int32(shape[3]) & LIGHT_POLYNOMIAL) != 0:
                    c = lights.polynomial[i]
                    power = 1.0 / wp.max(c[0] + c[1] * distance + c[2] * d2, 1.0e-8)
            if wp.static((kinds & 2) != 0):
                if (wp.int32(shape[3]) & 3) == LIGHT_SPOT:
                    axis = load_vec4(lights.axis, i)
                    cosine = -wp.dot(wp.vec3(axis[0], axis[1], axis[2]), to_light) * result.inverse
                    angle = wp.clamp(cosine * axis[3] + shape[0], 0.0, 1.0)
                    power *= angle * angle
            result.power = power
        return result

    return towards, arrive
