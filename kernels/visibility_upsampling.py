"""Doubling the size of an image of occlusion words (see ambient_visibility.py).

A pixel takes the bilinear weights of its up to four half-size neighbours times how near their points lie to the plane
through its point across its normal (after Kopf et al. 2007, "Joint Bilateral Upsampling"). Block size 64, one thread a
pixel; deterministic.
"""

from __future__ import annotations

import functools

import warp as wp

from .ambient_visibility import CODE_MASK, OPEN_WORD, half_index, point_in_view
from .bilateral import TOLERANCE, final_visibility, word_depth, word_visibility
from .encoding import make_gbuffer_codec
from .intrinsics import load_float, load_vec4i, load_word
from .projection import pixel_block, pixel_in_block, pixel_index
from .structs import MODULE_OPTIONS, ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: What a neighbour counts for that lies on another surface: it decides only where all do.
STRANGER = wp.constant(1.0e-4)
#: Codecs of the G-buffer: what CI compiles.
VARIANTS = [(("compact", "oct24", True),), (("full", "float32", True),)]


@functools.cache
def make_upsample_kernel(codec: tuple):
    """Kernel that doubles the size of a half-size image of words.

    Args:
        codec: Arguments of `make_gbuffer_codec`.
    """
    decode = make_gbuffer_codec(*codec)[1]

    @wp.func
    def add_point(
        view: View,
        word: wp.uint32,
        share: wp.float32,
        across: wp.float32,
        plane: wp.vec2,
        tightness: wp.float32,
        sums: wp.vec2,
    ):
        """(weighted visibility, weight) after a half-size pixel.

        across is the normal's x and y parts times the pixel's x / depth and y / depth (orthographic: x and y); plane is
        the normal's z and the plane's offset.
        """
        if share == 0.0:
            return sums
        weight = STRANGER * share
        if word != OPEN_WORD:
            affine = word_depth(word)
            height = across - plane[0] * affine
            if view.projection != ORTHOGRAPHIC:
                height = (across - plane[0]) * (1.0 / affine)
            near = 1.0 - wp.abs(height - plane[1]) * tightness
            if near > 0.0:
                weight += share * near
        return sums + wp.vec2(weight * word_visibility(word), weight)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def upsample_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        gbuffer: GBuffer,
        words: wp.array[wp.uint32],
        # Params
        radius: wp.float32,
        power: wp.float32,
        first: wp.int32,
        # Out
        out_visibility: wp.array[wp.float32],
    ):
        thread = wp.tid() + first
        block = load_vec4i(blocks, pixel_block(thread))
        view = views[block[0]]
        place = pixel_in_block(thread)
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        d = load_float(gbuffer.depth, i)
        if not wp.isfinite(d):
            out_visibility[i] = 1.0
            return
        # Half-size pixel k is pixel 2 k: an odd pixel stands midway between two, if there are two.
        pitch, k = view.bins_x * 8, half_index(view, x >> 1, y >> 1)
        right = wp.where((x & 1) != 0 and x + 1 < view.width, 1, 0)
        below = wp.where((y & 1) != 0 and y + 1 < view.height, 1, 0)
        w00, w10 = load_word(words, k), load_word(words, k + right)
        w01, w11 = load_word(words, k + below * pitch), load_word(words, k + below * pitch + right)
        v = word_visibility(w00)
        # As in the blur: an average of equals needs no weights.
        if (((w10 ^ w00) | (w01 ^ w00) | (w11 ^ w00)) & CODE_MASK) != wp.uint32(0):
            inverse = wp.vec2(1.0 / view.scale[0], 1.0 / view.scale[1])
            n = view.rotation * decode(gbuffer, i).normal
            point = point_in_view(view, wp.float32(x) + 0.5, wp.float32(y) + 0.5, d, inverse)
            plane = wp.vec2(n[2], wp.dot(n, point))
            tx, ty = n[0] * inverse[0], n[1] * inverse[1]
            px, py = wp.float32(x & -2) + 0.5 - view.center[0], wp.float32(y & -2) + 0.5 - view.center[1]
            left, up = tx * px, ty * py
            rim, foot = tx * (px + 2.0), ty * (py + 2.0)
            sx, sy = 0.5 * wp.float32(right), 0.5 * wp.float32(below)
            # A depth's 16 bits are no nearer than this.
            tightness = 1.0 / (TOLERANCE * radius + 2.0e-4 * wp.abs(d))
            sums = wp.vec2(0.0, 0.0)
            sums = add_point(view, w00, (1.0 - sx) * (1.0 - sy), left + up, plane, tightness, sums)
            sums = add_point(view, w10, sx * (1.0 - sy), rim + up, plane, tightness, sums)
            sums = add_point(view, w01, (1.0 - sx) * sy, left + foot, plane, tightness, sums)
            sums = add_point(view, w11, sx * sy, rim + foot, plane, tightness, sums)
            v = sums[0] / sums[1]
        out_visibility[i] = final_visibility(v, power)

    return upsample_kernel
