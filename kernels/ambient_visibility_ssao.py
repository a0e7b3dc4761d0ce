"""Ambient visibility by points around the surface (ssao): the cheapest rung.

A few points of the hemisphere over each pixel, along cosine-weighted directions, are projected; one whose pixel shows
something nearer than itself is blocked, and so is the direction it stands for (after Mittring 2007, "Finding Next Gen:
CryEngine 2", with the hemisphere of StarCraft II, Filion and McNaughton 2008). Points lie between FRACTION_LOW and 1 of
the radius: a nearer one would find walls further out free. What blocks must itself rise above the tangent plane, by the
bias at least, and be no further than REACH radii, beyond which it is another thing in front.

Points turn with a pattern of 4 x 4 pixels that the blur averages out. Arithmetic is + - * /, bit casts and table
look-ups: CPU and CUDA write the same bits. Block size 64, one thread a pixel; deterministic. With 16 points at 1920 x
1080: 29 MB as gtao, 7 us at 4.2 TB/s, and about 900 instructions a pixel.
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from .ambient_visibility import OPEN_WORD, affine_depth, fetch_point, pack_visibility, point_in_view, sample_level
from .encoding import make_gbuffer_codec
from .hemisphere import cosine_directions, tangent_of
from .intrinsics import load_vec4, load_vec4i
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Nearest point to the surface, as a share of the radius.
FRACTION_LOW = 0.3
#: Farthest thing that blocks, in radii.
REACH = wp.constant(1.5)
#: Codecs of the G-buffer: what CI compiles.
VARIANTS = [(("compact", "oct24", True),), (("full", "float32", True),)]


def hemisphere_points(count: int) -> np.ndarray:
    """Points over +z for a radius of 1, [phase * count + point]: (16 count, 4) float32, fourth component 0.

    The phases turn the set about z by 16ths of a turn and shift its radii, both in the order of a Bayer matrix.
    """
    bayer = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])
    base = cosine_directions(count).astype(float)
    golden = (np.arange(count) * 0.6180339887498949) % 1.0
    table = np.zeros((16, count, 4))
    for phase, rank in enumerate(bayer):
        angle = 2.0 * np.pi * (rank + 0.5) / 16.0
        fraction = FRACTION_LOW + (1.0 - FRACTION_LOW) * ((golden + (7 * rank % 16 + 0.5) / 16.0) % 1.0)
        c, s = np.cos(angle), np.sin(angle)
        table[phase, :, 0] = (base[:, 0] * c - base[:, 1] * s) * fraction
        table[phase, :, 1] = (base[:, 0] * s + base[:, 1] * c) * fraction
        table[phase, :, 2] = base[:, 2] * fraction
    return table.reshape(-1, 4).astype(np.float32)


@functools.cache
def make_ambient_visibility_ssao_kernel(codec: tuple):
    """Kernel that tests points and writes a word a pixel: affine depth and noisy visibility.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
    """
    decode = make_gbuffer_codec(*codec)[1]

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def ambient_visibility_ssao_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        gbuffer: GBuffer,
        pyramid: wp.array[wp.float32],
        points: wp.array[wp.vec4],
        # Params
        count: wp.int32,
        radius: wp.float32,
        bias: wp.float32,
        first: wp.int32,
        # Out
        out_words: wp.array[wp.uint32],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, pixel_block(thread))
        view = views[block[0]]
        place = pixel_in_block(thread)
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        d = gbuffer.depth[i]
        if not wp.isfinite(d):
            out_words[i] = OPEN_WORD
            return
        inverse = wp.vec2(1.0 / view.scale[0], 1.0 / view.scale[1])
        px, py = wp.float32(x) + 0.5, wp.float32(y) + 0.5
        p = point_in_view(view, px, py, d, inverse)
        n = view.rotation * decode(gbuffer, i).normal
        tangent = tangent_of(n)
        across = wp.cross(n, tangent)
        reach2 = REACH * radius * REACH * radius
        phase = ((y & 3) * 4 + (x & 3)) * count
        blocked = wp.float32(0.0)
        for k in range(count):
            row = load_vec4(points, phase + k)
            q = p + (tangent * row[0] + across * row[1] + n * row[2]) * radius
            shrink = wp.float32(1.0)
            if view.projection != ORTHOGRAPHIC:
                shrink = -1.0 / q[2]
            qx = q[0] * view.scale[0] * shrink + view.center[0]
            qy = q[1] * view.scale[1] * shrink + view.center[1]
            # Compared as floats: they may exceed any integer. No sample leaves the view or stands behind the eye.
            if (
                qx >= 0.0
                and qy >= 0.0
                and qx < wp.float32(view.width)
                and qy < wp.float32(view.height)
                and shrink > 0.0
            ):
                level = sample_level(qx - px, qy - py)
                s = fetch_point(view, gbuffer.depth, pyramid, inverse, wp.int32(qx), wp.int32(qy), level)
                v = s - p
                # Also false for the background and whatever is not finite.
                if s[2] > q[2] and wp.dot(v, n) > bias * radius and wp.dot(v, v) < reach2:
                    blocked += 1.0
        out_words[i] = pack_visibility(affine_depth(view, d), 1.0 - blocked / wp.float32(count))

    return ambient_visibility_ssao_kernel
