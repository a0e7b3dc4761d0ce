"""Normals and depth as a plan's G-buffer gives them back: what shade sees, where outputs are what resolve saw."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp
from warp_deferred.kernels.depth_encoding import make_depth_access
from warp_deferred.kernels.encoding import make_gbuffer_codec
from warp_deferred.kernels.structs import MODULE_OPTIONS, GBuffer, View

from warp_deferred.passes.resolve import depth_format, gbuffer_codec, make_gbuffer
from warp_deferred.plan import Plan

from .timing import run_until

__all__ = ["gbuffer_depth", "gbuffer_normals"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DIM = 64
#: Kinds of G-buffer there are; compiled when a bench first needs them.
VARIANTS = [("compact", "oct24", True), ("compact", "xy16", False), ("full", "float32", True)]


@functools.cache
def make_normals_kernel(rung: str, normal: str, extra: bool):
    """Kernel that decodes the normal of every pixel; arguments as those of `make_gbuffer_codec`."""
    _, decode = make_gbuffer_codec(rung, normal, extra)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def normals_kernel(
        # In
        gbuffer: GBuffer,
        # Params
        count: wp.int32,
        # Out
        out_normals: wp.array[wp.vec3],
    ):
        i = wp.tid()
        if i >= count:
            return
        surface = decode(gbuffer, i)
        out_normals[i] = surface.normal

    return normals_kernel


@functools.cache
def make_depth_kernel(name: str):
    """Kernel that decodes the depth of every pixel of the first view; the argument is that of `make_depth_access`."""
    load = make_depth_access(name)[2]

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def depth_kernel(
        # Frame
        views: wp.array[View],
        # In
        gbuffer: GBuffer,
        # Params
        count: wp.int32,
        # Out
        out_depth: wp.array[wp.float32],
    ):
        i = wp.tid()
        if i >= count:
            return
        out_depth[i] = load(gbuffer, views[0], i)

    return depth_kernel


def gbuffer_depth(plan: Plan) -> np.ndarray:
    """Decoded depth of the first view of a plan, after its frame [m]: (height, width), +inf on the background."""
    # Later passes may have laid their buffers over the G-buffer.
    run_until(plan.resources.program, "shade")
    size = plan.request.sizes[0]
    count = size.width * size.height
    depth = wp.zeros(count, dtype=wp.float32, device=plan.resources.device)
    wp.launch(
        make_depth_kernel(depth_format(plan.request)),
        dim=-(-count // BLOCK_DIM) * BLOCK_DIM,
        inputs=[plan.resources.frame.views, make_gbuffer(plan.resources), count],
        outputs=[depth],
        device=plan.resources.device,
        block_dim=BLOCK_DIM,
    )
    return depth.numpy().reshape(size.height, size.width)


def gbuffer_normals(plan: Plan) -> np.ndarray:
    """Decoded normals of the first view of a plan, after its frame: (pixels, 3), 0 on the background."""
    depth = gbuffer_depth(plan).reshape(-1)
    count = plan.request.sizes[0].width * plan.request.sizes[0].height
    normals = wp.zeros(count, dtype=wp.vec3, device=plan.resources.device)
    wp.launch(
        make_normals_kernel(*gbuffer_codec(plan.request)),
        dim=-(-count // BLOCK_DIM) * BLOCK_DIM,
        inputs=[make_gbuffer(plan.resources), count],
        outputs=[normals],
        device=plan.resources.device,
        block_dim=BLOCK_DIM,
    )
    # Where nothing is seen nothing was written.
    surface = np.isfinite(depth)[:, None]
    return np.where(surface, normals.numpy()[:count], np.float32(0.0))
