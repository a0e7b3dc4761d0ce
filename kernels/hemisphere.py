"""Directions around a normal, for rungs of ambient visibility that sample the hemisphere. Functions only."""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


def cosine_directions(count: int) -> np.ndarray:
    """Unit vectors around +z, cosine-weighted and of low discrepancy; (count, 4) float32, fourth component 0."""
    k = np.arange(count, dtype=np.uint64)
    inverse, base = np.zeros(count), 0.5
    while k.any():
        inverse += base * (k & np.uint64(1)).astype(float)
        k, base = k >> np.uint64(1), base * 0.5
    radius2 = (np.arange(count) + 0.5) / count
    angle = 2.0 * np.pi * inverse
    out = np.zeros((count, 4))
    out[:, 0], out[:, 1] = np.sqrt(radius2) * np.cos(angle), np.sqrt(radius2) * np.sin(angle)
    out[:, 2] = np.sqrt(1.0 - radius2)
    return out.astype(np.float32)


@wp.func
def tangent_of(n: wp.vec3):
    """Unit vector across a unit normal (Duff et al. 2017, "Building an Orthonormal Basis, Revisited")."""
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])
