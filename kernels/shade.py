"""Shade: light every pixel by the lights of its tile, in light order, in float32. One thread a pixel, block size 64.

The loop runs over the summary bits, the mask words they stand for and the lights of each word. A light that does not
reach adds nothing at all, so any mask that misses none gives the same bits as all of them.

Two settings stand for what other renderers do, to be measured. Half sums are those of a renderer that adds light by
light into half4 targets, here one for diffuse and one for specular light: radiance, rounded after each light. Fused and
fast arithmetic are options of this kernel alone: coverage, ids, depth and masks are decided elsewhere, and the margins
of masks (1e-4 of a light's range) are far above what its arithmetic moves, so that no light is missed with it either.
"""

from __future__ import annotations

import functools

import warp as wp

from .brdf import INVERSE_PI, MIN_N_DOT_V, diffuse_albedo, make_reflectance
from .depth_encoding import make_depth_access
from .encoding import FLAG_EMISSIVE, Surface, make_gbuffer_codec
from .image import store_limit, to_half
from .intrinsics import load_vec4, load_vec4i, lowest_bit, unpack_half3
from .lights import make_arrive
from .projection import pixel_in_block, pixel_index, relative_position, view_direction
from .structs import (
    ARITHMETIC_OPTIONS,
    PIXEL_BLOCK_AREA,
    FrameValues,
    GBuffer,
    LightMasks,
    Lights,
    ShadowMaps,
    View,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Blocks a multiprocessor holds at least: fewer registers than the lobe would like, but more warps that wait at once.
BOUNDS = (64, 18)
#: The same where shadow maps are looked up by a short filter, whose fetches want registers.
MAP_BOUNDS = (64, 16)
MAP_RUNGS = ("hard", "pcf")
OUTPUTS = ("color", "diffuse", "specular", "light_count", "bright")
#: (codec, models, kinds, polynomial, emissive, outputs, visible, shadow, depth, accumulation, arithmetic): what CI
#: compiles; the last four may be left out.
VARIANTS = [
    (("compact", "oct24", True), 15, 7, True, True, ("color", "diffuse", "specular", "light_count"), True),
    (("compact", "oct24", True), 8, 3, False, True, (), True),
    (("compact", "oct24", True), 8, 3, False, True, ("bright",), True),
    (("compact", "oct24", True), 8, 4, False, False, (), False),
    (("compact", "oct24", False), 1, 1, False, False, (), False),
    (("compact", "oct24", False), 1, 0, False, False, (), False),
    (("full", "float32", True), 15, 7, True, True, ("color",), False),
    (("compact", "oct24", True), 8, 7, False, False, (), False, ("hard", 7, 3.0)),
    (("compact", "oct24", True), 8, 4, False, False, (), False, ("pcf", 4, 6.0)),
    (("compact", "oct24", True), 8, 7, False, False, (), False, ("pcf", 7, 6.0)),
    (("compact", "oct24", True), 8, 7, False, False, (), False, ("pcss", 7, 40.0)),
    (("compact", "oct24", True), 8, 7, False, False, (), False, ("ray_traced", 64, "none", True)),
    (("compact", "oct24", True), 8, 3, False, True, (), False, None, "unorm16"),
    (("compact", "oct24", True), 8, 3, False, True, (), False, None, "ufloat16", "half", "fused"),
    (("compact", "oct24", True), 8, 7, False, False, (), False, ("pcf", 7, 6.0), "unorm24", "float32", "fast"),
    (("full", "float32", True), 15, 7, True, True, ("color",), False, None, "float32", "half"),
    (("full", "float32", True), 15, 7, True, True, ("color",), False, None, "float32", "float32", "fast"),
]


@wp.struct
class ShadeTarget:
    """Where lighting goes."""

    radiance: wp.array[wp.uint64]  # half4, behind the display, where float32 is not asked for
    color: wp.array[wp.vec3]
    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    light_count: wp.array[wp.int32]
    bright: wp.array[wp.int32]  # set to 1 where exposed radiance is above a level: bloom has work this frame
    bright_level: wp.float32


@functools.cache
def make_sums(half: bool):
    """(add_diffuse, add_specular, reflected) functions: a light's part added to a sum, and radiance of the diffuse sum.

    Sums of halves are of radiance from the start, as a render target would hold them: the irradiance of the sun is past
    their range.
    """

    @wp.func
    def add(sum: wp.vec3, light: wp.vec3):
        return sum + light

    @wp.func
    def add_irradiance(sum: wp.vec3, light: wp.vec3, s: Surface):
        return sum + light

    @wp.func
    def reflected(sum: wp.vec3, albedo: wp.vec3):
        return wp.cw_mul(sum, albedo * INVERSE_PI)

    @wp.func
    def add_half(sum: wp.vec3, light: wp.vec3):
        return unpack_half3(to_half(sum + light))

    @wp.func
    def add_radiance(sum: wp.vec3, light: wp.vec3, s: Surface):
        return unpack_half3(to_half(sum + wp.cw_mul(light, diffuse_albedo(s) * INVERSE_PI)))

    @wp.func
    def already(sum: wp.vec3, albedo: wp.vec3):
        return sum

    return (add_radiance, add_half, already) if half else (add_irradiance, add, reflected)


@functools.cache
def make_shade_kernel(
    codec: tuple,
    models: int,
    kinds: int,
    polynomial: bool,
    emissive: bool,
    outputs: tuple[str, ...],
    visible: bool,
    shadow: tuple | None = None,
    depth_format: str = "float32",
    accumulation: str = "float32",
    arithmetic: str = "precise",
):
    """Kernel that lights the G-buffer.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
        models: Bit m: specular model m occurs.
        kinds: Bit k: light kind k occurs (point, spot, directional).
        polynomial: Some light has the polynomial fall-off.
        emissive: Some material emits.
        outputs: Names out of OUTPUTS to write; without `color` the half4 radiance is written.
        visible: Ambient light is multiplied by the ambient visibility; else nothing reads it.
        shadow: Arguments of `make_shadow_factor`, or "ray_traced" and those of `make_ray_factor`; None: none casts.
        depth_format: Depth format of the G-buffer, out of DEPTH_CODECS.
        accumulation: `half`: both sums are rounded to half after each light; `float32`: not at all.
        arithmetic: Key of ARITHMETIC_OPTIONS.
    """
    add_diffuse, add_specular, reflected = make_sums(accumulation == "half")
    load_depth = make_depth_access(depth_format)[2]
    decode = make_gbuffer_codec(*codec)[1]
    view_lobe, reflect = make_reflectance(models)
    towards, arrive = make_arrive(kinds, polynomial)
    # Only what a plan needs is loaded: the look-ups are no part of a frame without shadows.
    shadow_factor, Shadows = None, ShadowMaps
    if shadow is not None and shadow[0] == "ray_traced":
        from .shadow_rays import ShadowRays as Shadows
        from .shadow_rays import make_ray_factor

        shadow_factor = make_ray_factor(*shadow[1:], depth_format)
    elif shadow is not None:
        from .shadow_lookup import make_shadow_factor

        shadow_factor = make_shadow_factor(*shadow, depth_format)

    @wp.func
    def write(
        view: View, i: wp.int32, out: ShadeTarget, total: wp.vec3, diffuse: wp.vec3, specular: wp.vec3, count: wp.int32
    ):
        if wp.static("color" in outputs):
            out.color[i] = store_limit(total, 3.0e38)
        else:
            out.radiance[i] = to_half(total)
        if wp.static("diffuse" in outputs):
            out.diffuse[i] = store_limit(diffuse, 3.0e38)
        if wp.static("specular" in outputs):
            out.specular[i] = store_limit(specular, 3.0e38)
        if wp.static("light_count" in outputs):
            out.light_count[i] = count
        if wp.static("bright" in outputs):
            peak = wp.max(total[0], wp.max(total[1], total[2])) * view.exposure
            # Every thread that stores stores 1. After the first one a read is all that bright pixels cost.
            if peak > out.bright_level and view.bloom > 0.0:
                if out.bright[0] == 0:
                    out.bright[0] = 1

    # The longer look-ups have more to keep than bounds leave room for; spilling it would cost more than waiting.
    bounds = BOUNDS if shadow is None else MAP_BOUNDS if shadow[0] in MAP_RUNGS else None

    @wp.kernel(module="unique", module_options=ARITHMETIC_OPTIONS[arithmetic], grid_stride=False, launch_bounds=bounds)
    def shade_kernel(
        # Frame
        views: wp.array[View],
        values: wp.array[FrameValues],
        blocks: wp.array[wp.vec4i],
        # In
        gbuffer: GBuffer,
        emission: wp.array[wp.vec3],
        visibility: wp.array[wp.float32],
        lights: Lights,
        masks: LightMasks,
        shadows: Shadows,
        # Params
        first: wp.int32,
        # Out
        out_target: ShadeTarget,
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        corner = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + corner[0], block[2] + corner[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        depth = load_depth(gbuffer, view, i)
        zero = wp.vec3()
        if not wp.isfinite(depth):
            write(view, i, out_target, values[0].background, zero, zero, 0)
            return
        s = decode(gbuffer, i)
        diffuse, specular = wp.vec3(), wp.vec3()
        count = wp.int32(0)
        if wp.static(kinds != 0):
            point = relative_position(view, wp.float32(x) + 0.5, wp.float32(y) + 0.5, depth)
            v = view_direction(view, point)
            lobe = view_lobe(s, wp.max(wp.dot(s.normal, v), MIN_N_DOT_V))
            tile = view.tile_offset - masks.first_tile
            tile += (y >> masks.tile_shift) * view.tiles_x + (x >> masks.tile_shift)
            base = block[0] * lights.capacity
            for group in range(masks.summary_per_tile):
                summary = masks.summary[tile * masks.summary_per_tile + group]
                while summary != wp.uint32(0):
                    word = group * 32 + lowest_bit(summary)
                    summary = summary & (summary - wp.uint32(1))
                    bits = masks.words[tile * masks.words_per_tile + word]
                    while bits != wp.uint32(0):
                        light = word * 32 + lowest_bit(bits)
                        bits = bits & (bits - wp.uint32(1))
                        place = load_vec4(lights.position, base + light)
                        to_light = towards(lights, light, place, point)
                        facing = wp.dot(s.normal, to_light)
                        if facing > 0.0:
                            a = arrive(lights, light, place[3], to_light)
                            # Shadows is named here too: a deferred annotation alone would not capture it.
                            if wp.static(shadow is not None and Shadows is not None):
                                if a.power > 0.0:
                                    a.power *= shadow_factor(
                                        shadows, view, base + light, light, point, to_light, s.normal, depth
                                    )
                            if a.power > 0.0:
                                n_dot_l = facing * a.inverse
                                c = load_vec4(lights.color, light)
                                irradiance = wp.vec3(c[0], c[1], c[2]) * (a.power * n_dot_l)
                                f = reflect(s, lobe, to_light * a.inverse, v, n_dot_l)
                                diffuse = add_diffuse(diffuse, wp.cw_mul(f.diffuse, irradiance), s)
                                specular = add_specular(specular, wp.cw_mul(f.specular, irradiance))
                                count += 1
        albedo = diffuse_albedo(s)
        diffuse = reflected(diffuse, albedo)
        ambient = wp.cw_mul(albedo, values[0].ambient) * s.occlusion
        if wp.static(visible):
            ambient = ambient * visibility[i]
        total = diffuse + specular + ambient
        if wp.static(emissive):
            if (s.flags & FLAG_EMISSIVE) != 0:
                total += emission[i]
        write(view, i, out_target, total, diffuse, specular, count)

    return shade_kernel
