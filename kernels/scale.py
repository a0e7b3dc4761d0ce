"""Up-scaling: the picture of the rendered size to the size that is shown. One thread a shown pixel, block size 64.

It works on sRGB codes, whose steps look alike, after everything else. `nearest` takes the rendered pixel below. `edge`
weighs the 4 x 4 rendered pixels around a shown one by a kernel that is narrower across an edge than along it, an idea
of AMD's FidelityFX Super Resolution 1; the form here is our own:

- The brightness gradients at the four middle pixels give a structure tensor (Foerstner and Guelch 1987). Its axes say
  which way the edge runs, its coherence c in [0, 1] how sure that is; gradients of about a code count as noise.
- A pixel at d counts by its squared distance r = |d|^2 - b c along^2, `along` being the part of d along the edge. With
  q = across^2 = (|d|^2 + cos 2t (dx^2 - dy^2) + sin 2t 2 dx dy) / 2 this takes no angle and no root but the tensor's.
- Its weight is (1 - r / 4)^4 (1 - r) within r < 4, else 0: within 0.02 of the radial Lanczos kernel of two lobes.
- The result is clamped to the range of the four middle pixels, channel by channel, so nothing rings and a constant
  stays to the bit.

Bytes a shown pixel: 4 out, 4 (rendered / shown) in; 28 loads, from cache, and about 400 operations.
"""

from __future__ import annotations

import functools

import warp as wp

from .intrinsics import load_vec4i
from .projection import pixel_index, pixel_of
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
FILTERS = ("edge", "nearest")
#: (filter,): what CI compiles.
VARIANTS = [(name,) for name in FILTERS]
OPAQUE = wp.constant(wp.uint32(0xFF000000))
#: b above: at 1 a kernel along a sure edge would not end.
STRETCH = 0.5
#: Squared gradients that count as noise [code^2].
NOISE = 4.0


@wp.func
def code_at(image: wp.array[wp.uint32], view: View, x: wp.int32, y: wp.int32):
    """Codes of a rendered pixel, 0 to 255; beyond the edge those of the edge."""
    word = image[pixel_index(view, wp.clamp(x, 0, view.width - 1), wp.clamp(y, 0, view.height - 1))]
    return wp.vec3(
        wp.float32(word & wp.uint32(255)),
        wp.float32((word >> wp.uint32(8)) & wp.uint32(255)),
        wp.float32((word >> wp.uint32(16)) & wp.uint32(255)),
    )


@wp.func
def brightness(image: wp.array[wp.uint32], view: View, x: wp.int32, y: wp.int32):
    """Rough lightness of a rendered pixel [codes]."""
    c = code_at(image, view, x, y)
    return 0.25 * c[0] + 0.625 * c[1] + 0.125 * c[2]


@wp.func
def edge_tensor(image: wp.array[wp.uint32], view: View, x: wp.int32, y: wp.int32, u: wp.float32, v: wp.float32):
    """(coherence cos 2t, coherence sin 2t, coherence) between pixels (x, y) and (x + 1, y + 1); t: gradient's angle."""
    xx, xy, yy = wp.float32(0.0), wp.float32(0.0), wp.float32(0.0)
    for k in range(4):
        px, py = x + (k & 1), y + (k >> 1)
        share = wp.where((k & 1) == 0, 1.0 - u, u) * wp.where((k >> 1) == 0, 1.0 - v, v)
        gx = brightness(image, view, px + 1, py) - brightness(image, view, px - 1, py)
        gy = brightness(image, view, px, py + 1) - brightness(image, view, px, py - 1)
        xx += share * gx * gx
        xy += share * gx * gy
        yy += share * gy * gy
    scale = 1.0 / (xx + yy + wp.static(NOISE))
    cosine, sine = (xx - yy) * scale, 2.0 * xy * scale
    return wp.vec3(cosine, sine, wp.sqrt(cosine * cosine + sine * sine))


@wp.func
def kernel_weight(r: wp.float32):
    """Weight of a squared distance [rendered px^2]."""
    if r >= 4.0:
        return wp.float32(0.0)
    s = 1.0 - 0.25 * r
    return s * s * s * s * (1.0 - r)


@wp.func
def edge_scaled(image: wp.array[wp.uint32], view: View, sx: wp.float32, sy: wp.float32):
    """Codes at a place of the rendered picture [px from its first pixel's centre]."""
    x, y = wp.int32(wp.floor(sx)), wp.int32(wp.floor(sy))
    u, v = sx - wp.floor(sx), sy - wp.floor(sy)
    tensor = edge_tensor(image, view, x, y, u, v)
    total, weights = wp.vec3(), wp.float32(0.0)
    low, high = wp.vec3(255.0, 255.0, 255.0), wp.vec3()
    for k in range(16):
        i, j = (k & 3) - 1, (k >> 2) - 1
        c = code_at(image, view, x + i, y + j)
        dx, dy = wp.float32(i) - u, wp.float32(j) - v
        square = dx * dx + dy * dy
        # Coherence times the squared part along the edge, from twice the angle.
        along = 0.5 * (tensor[2] * square - tensor[0] * (dx * dx - dy * dy) - tensor[1] * 2.0 * dx * dy)
        weight = kernel_weight(square - wp.static(STRETCH) * along)
        total = total + c * weight
        weights += weight
        if (i == 0 or i == 1) and (j == 0 or j == 1):
            low = wp.min(low, c)
            high = wp.max(high, c)
    return wp.max(wp.min(total * (1.0 / wp.max(weights, 0.1)), high), low)


@functools.cache
def make_scale_kernel(name: str):
    """Kernel that up-scales.

    Args:
        name: One of FILTERS.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def scale_kernel(
        # Frame
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        # In
        places: wp.array[wp.vec4i],
        image: wp.array[wp.uint32],
        # Params
        first: wp.int32,
        # Out
        out_display: wp.array[wp.uint32],
    ):
        pixel = pixel_of(blocks, wp.tid() + first)
        view, shown = views[pixel[0]], load_vec4i(places, pixel[0])
        x, y = pixel[1], pixel[2]
        if x >= shown[1] or y >= shown[2]:
            return
        sx = (wp.float32(x) + 0.5) * (wp.float32(view.width) / wp.float32(shown[1])) - 0.5
        sy = (wp.float32(y) + 0.5) * (wp.float32(view.height) / wp.float32(shown[2])) - 0.5
        if wp.static(name == "nearest"):
            c = code_at(image, view, wp.int32(wp.floor(sx + 0.5)), wp.int32(wp.floor(sy + 0.5)))
        else:
            c = edge_scaled(image, view, sx, sy)
        r, g, b = wp.uint32(c[0] + 0.5), wp.uint32(c[1] + 0.5), wp.uint32(c[2] + 0.5)
        out_display[shown[0] + y * shown[1] + x] = r | (g << wp.uint32(8)) | (b << wp.uint32(16)) | OPAQUE

    return scale_kernel
