"""Ambient visibility by rays (ray_traced): the reference rung, in the picture's pixels but against all triangles.

Rays follow one cosine-weighted low-discrepancy set (Hammersley points, mapped by r = sqrt(u), Malley's method: Pharr,
Jakob and Humphreys 2023, "Physically Based Rendering", 13.6.3) that each pixel turns about its normal by an angle of
its own, another one in each of its samples, and end at the radius. The mean over rays is the share of ambient light
that arrives. They start a bias above the surface, lest it blocks itself where normals are interpolated or large
triangles are rounded. Where the viewer does not see that point something is in between, such as the floor under a
skirting's chamfer, behind which all would be open: rays then start nearer, down to a 64th of the bias, as far up as the
viewer sees. Block size 64, one thread a
pixel; deterministic on one device. CPU and CUDA differ where a ray grazes an edge: by 1 / rays a pixel.
"""

from __future__ import annotations

import functools

import warp as wp

from .bilateral import final_visibility
from .encoding import make_gbuffer_codec
from .hemisphere import tangent_of
from .intrinsics import float_bits, load_vec4, load_vec4i
from .projection import pixel_in_block, pixel_index, relative_position, view_direction
from .ray_scene import RayScene, make_blocked
from .structs import MODULE_OPTIONS, PIXEL_BLOCK_AREA, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Rounding of a position rebuilt from depth, as a share of its distance from the eye.
POSITION_ERROR = wp.constant(4.0e-6)
#: Heights above the surface that are tried, each a quarter of the one before.
LIFTS = wp.constant(4)
#: What is looked through towards the viewer, in heights; and at most as a share of the way.
CLEARANCE = wp.constant(16.0)
CLEAR_SHARE = wp.constant(0.5)
#: 2 pi / 2^32: from the bits of a hash to an angle.
TURN = wp.constant(1.4629180792671596e-09)
#: Multipliers and increment of the hash.
HASH_ROW = wp.constant(wp.uint32(16411))
HASH_SCALE = wp.constant(wp.uint32(747796405))
HASH_SHIFT = wp.constant(wp.uint32(2891336453))
HASH_WORD = wp.constant(wp.uint32(277803737))
HASH_SAMPLE = wp.constant(wp.uint32(2654435769))
#: (codec,): what CI compiles.
VARIANTS = [(("compact", "oct24", True),), (("full", "float32", True),)]


@wp.func
def pixel_hash(x: wp.int32, y: wp.int32, sample: wp.uint32):
    """32 bits that look random, of a pixel (Jarzynski and Olano 2020, "Hash Functions for GPU Rendering", pcg)."""
    state = (wp.uint32(x) + wp.uint32(y) * HASH_ROW + sample) * HASH_SCALE + HASH_SHIFT
    word = ((state >> ((state >> wp.uint32(28)) + wp.uint32(4))) ^ state) * HASH_WORD
    return (word >> wp.uint32(22)) ^ word


@functools.cache
def make_ambient_visibility_traced_kernel(codec: tuple):
    """Kernel that traces rays from every pixel's surface.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
    """
    decode = make_gbuffer_codec(*codec)[1]
    # Both sides block, and alpha masks are taken for solid: as depth in the picture knows neither.
    blocked = make_blocked("none", False)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def ambient_visibility_traced_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # Scene
        rays: RayScene,
        # In
        gbuffer: GBuffer,
        directions: wp.array[wp.vec4],
        # Params
        radius: wp.float32,
        bias: wp.float32,
        power: wp.float32,
        first: wp.int32,
        # Out
        out_visibility: wp.array[wp.float32],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        view = views[block[0]]
        place = pixel_in_block(thread)
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        depth = gbuffer.depth[i]
        n = decode(gbuffer, i).normal
        point = relative_position(view, wp.float32(x) + 0.5, wp.float32(y) + 0.5, depth)
        lift = wp.float32(bias * radius)
        surface = point + n * (POSITION_ERROR * wp.length(point))
        highest = surface + n * lift
        # The background, and whatever is not finite: nothing is known to block.
        if not (wp.isfinite(depth) and wp.isfinite(wp.dot(highest, highest)) and wp.isfinite(n)):
            out_visibility[i] = 1.0
            return
        towards = view_direction(view, point)
        clear = wp.min(CLEARANCE * lift, CLEAR_SHARE * depth)
        tries, hidden = wp.int32(0), wp.bool(True)
        while hidden and tries < LIFTS:
            hidden = blocked(rays, view.origin, surface + n * lift, towards, clear, view.world)
            if hidden:
                lift = lift * 0.25
            tries += 1
        start = wp.where(hidden, highest, surface + n * lift)
        # Samples of one pixel turn their rays differently, so that their mean has as many as all of them; 0 without.
        shift_x = float_bits(view.center[0] - 0.5 * wp.float32(view.width))
        shift_y = float_bits(view.center[1] - 0.5 * wp.float32(view.height))
        sample = shift_x * HASH_SAMPLE + shift_y * HASH_WORD
        angle = wp.float32(pixel_hash(x, y, sample)) * TURN
        cosine, sine = wp.cos(angle), wp.sin(angle)
        tangent = tangent_of(n)
        across = wp.cross(n, tangent)
        hits = wp.int32(0)
        for k in range(directions.shape[0]):
            d = load_vec4(directions, k)
            u, v = d[0] * cosine - d[1] * sine, d[0] * sine + d[1] * cosine
            if blocked(rays, view.origin, start, tangent * u + across * v + n * d[2], radius, view.world):
                hits += 1
        visibility = 1.0 - wp.float32(hits) / wp.float32(directions.shape[0])
        out_visibility[i] = final_visibility(visibility, power)

    return ambient_visibility_traced_kernel
