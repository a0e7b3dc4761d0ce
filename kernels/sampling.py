"""Several samples a pixel: move the views, sum what each sample shows, average. Block size 64.

The sample part of a frame is launched once a sample. `begin_sample_kernel` opens it: the counter on the device says
which sample it is, and the views that the passes use are the uploaded ones moved by its jitter. The accumulating
kernel closes it: a sum is stored by the first sample and added to by the others, in their order, in float32, so a
result is the same from run to run and memory does not depend on their number; a row of weight 0 is looked at by the
other outputs alone and adds nothing. Averages divide by the number of samples.

Bytes a pixel and sample: image in (8 or 12), sum in and out (24); each part 12 + 24, alpha 4 + 8.
"""

from __future__ import annotations

import functools

import warp as wp

from .image import Image, make_image_codec, store_limit
from .structs import MODULE_OPTIONS, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: (half, image, diffuse, specular, alpha): what CI compiles.
VARIANTS = [(True, True, False, False, False), (False, True, True, True, True), (True, False, False, False, True)]


@wp.struct
class Sample:
    """Where one sample lies."""

    jitter: wp.vec2  # from the pixel's centre [px]
    lens: wp.vec2  # in [0, 1)^2
    time: wp.float32  # share of the time the shutter is open
    weight: wp.float32  # 1, or 0 for a look at the centre


@wp.struct
class Parts:
    """What shading gives a pixel, besides the image; absent ones are one element long and never touched."""

    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    alpha: wp.array[wp.float32]


@wp.kernel(grid_stride=False)
def begin_sample_kernel(
    # Frame
    views: wp.array[View],
    # In
    samples: wp.array[Sample],
    counter: wp.array[wp.int32],
    # Out
    out_views: wp.array[View],
):
    """One thread a view: the view of this sample. Views of depth alone stay: they are no camera's."""
    v = wp.tid()
    view = views[v]
    sample = samples[wp.min(counter[0], samples.shape[0] - 1)]
    if view.depth_only == 0:
        # What lies at centre + jitter is seen by a pixel whose image is moved the other way.
        view.center = view.center - sample.jitter
    out_views[v] = view


@wp.kernel(grid_stride=False)
def end_sample_kernel(
    # In
    samples: wp.array[Sample],
    # Out
    out_counter: wp.array[wp.int32],
):
    """One thread: count the sample."""
    out_counter[0] = wp.min(out_counter[0] + 1, samples.shape[0] - 1)


@wp.func
def bounded(value: wp.float32):
    """The number itself, 0 for NaN, the nearest of -3e38 and 3e38 beyond them: what is summed stays finite."""
    if value >= -3.0e38 and value <= 3.0e38:
        return value
    return wp.where(value > 0.0, 3.0e38, wp.where(value < 0.0, -3.0e38, 0.0))


@functools.cache
def make_sampling_kernels(half: bool, image: bool, diffuse: bool, specular: bool, alpha: bool):
    """(accumulate, average) kernels, one thread a pixel of the arena.

    Args:
        half: Whether the image is half4.
        image: Sum the image.
        diffuse: Sum the diffuse part.
        specular: Sum the specular part.
        alpha: Sum coverage.
    """
    load, store = make_image_codec(half)

    @wp.func
    def add3(sums: wp.array[wp.vec3], i: wp.int32, value: wp.vec3, first: wp.bool):
        total = value
        if not first:
            total = sums[i] + value
        sums[i] = wp.vec3(bounded(total[0]), bounded(total[1]), bounded(total[2]))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def accumulate_kernel(
        # In
        samples: wp.array[Sample],
        counter: wp.array[wp.int32],
        shown: Image,
        parts: Parts,
        # Params
        first: wp.int32,
        # Out
        out_image: wp.array[wp.vec3],
        out_parts: Parts,
    ):
        i = wp.tid() + first
        sample = wp.min(counter[0], samples.shape[0] - 1)
        if samples[sample].weight == 0.0:
            return
        start = sample == 0
        if wp.static(image):
            add3(out_image, i, load(shown, i), start)
        if wp.static(diffuse):
            add3(out_parts.diffuse, i, parts.diffuse[i], start)
        if wp.static(specular):
            add3(out_parts.specular, i, parts.specular[i], start)
        if wp.static(alpha):
            covered = parts.alpha[i]
            if not start:
                covered = out_parts.alpha[i] + covered
            out_parts.alpha[i] = bounded(covered)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, grid_stride=False)
    def average_kernel(
        # In
        sums: wp.array[wp.vec3],
        part_sums: Parts,
        # Params
        count: wp.float32,
        first: wp.int32,
        # Out
        out_image: Image,
        out_parts: Parts,
    ):
        i = wp.tid() + first
        if wp.static(image):
            store(out_image, i, sums[i] / count)
        if wp.static(diffuse):
            out_parts.diffuse[i] = store_limit(part_sums.diffuse[i] / count, 3.0e38)
        if wp.static(specular):
            out_parts.specular[i] = store_limit(part_sums.specular[i] / count, 3.0e38)
        if wp.static(alpha):
            out_parts.alpha[i] = bounded(part_sums.alpha[i] / count)

    return accumulate_kernel, average_kernel
