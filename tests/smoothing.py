"""FXAA on pictures of one's own, without a renderer; shared by the tests of the kernel and of the pass."""

from __future__ import annotations

import numpy as np
import warp as wp
from warp_deferred.kernels import anti_aliasing as kernels
from warp_deferred.kernels import color, structs

from warp_deferred.views import ViewLayout, ViewSize, table_array


def smooth(pictures: list[np.ndarray], device: str) -> list[np.ndarray]:
    """Run the kernel on (height, width, 4) uint8 pictures as one batch of views."""
    layout = ViewLayout(tuple(ViewSize(p.shape[1], p.shape[0]) for p in pictures), 16)
    views = np.zeros(len(pictures), np.dtype(structs.View.numpy_dtype()))
    for view, fields, p in zip(views, layout.fields, pictures, strict=True):
        view["pixel_offset"], view["row_pitch"] = fields[:2]
        view["height"], view["width"] = p.shape[:2]
    words = np.concatenate([np.ascontiguousarray(p).view(np.uint32).reshape(-1) for p in pictures])
    out = wp.zeros(len(words), dtype=wp.uint32, device=device)
    tables = [wp.array(t, dtype=wp.float32, device=device) for t in (color.srgb_linear(), color.srgb_thresholds())]
    inputs = [
        wp.array(views, dtype=structs.View, device=device), table_array(layout.blocks, wp.get_device(device)),
        wp.array(words, dtype=wp.uint32, device=device), *tables, 0,
    ]  # fmt: skip
    block = kernels.BLOCK_DIM
    wp.launch(kernels.anti_aliasing_kernel, len(layout.blocks) * 64, inputs, [out], device=device, block_dim=block)
    ends = np.cumsum([p.shape[0] * p.shape[1] for p in pictures])[:-1]
    return [w.view(np.uint8).reshape(p.shape) for w, p in zip(np.split(out.numpy(), ends), pictures, strict=True)]
