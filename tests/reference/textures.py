"""Texture look-up: exact texels, linear filtering of linear values, box-filtered mips, level chosen by derivatives."""

from __future__ import annotations

import functools

import numpy as np

from .color import srgb_decode
from .data import Texture

__all__ = ["mip_chain", "nearest", "sample", "texel_margin", "wrap_index"]


def _box(count: int) -> np.ndarray:
    """Weights (count // 2, count) that average neighbours; an odd count shares the texels on borders by area."""
    half = max(1, count // 2)
    edges = np.arange(half + 1) * (count / half)
    texels = np.arange(count)
    overlap = np.minimum(edges[1:, None], texels + 1) - np.maximum(edges[:-1, None], texels)
    return np.clip(overlap, 0.0, None) * (half / count)


@functools.lru_cache(maxsize=64)
def mip_chain(texture: Texture) -> tuple[np.ndarray, ...]:
    """Decode to linear RGBA in float64, (h, w, 4), and halve down to one texel.

    One channel is grey, two are grey and alpha; missing alpha is 1. Alpha is never sRGB.
    """
    values = texture.pixels.astype(float) / 255.0
    channels = values.shape[2]
    rgb = values[..., :3] if channels >= 3 else np.repeat(values[..., :1], 3, axis=2)
    alpha = values[..., channels - 1 :] if channels in (2, 4) else np.ones((*values.shape[:2], 1))
    level = np.concatenate([srgb_decode(rgb) if texture.srgb else rgb, alpha], axis=2)
    levels = [level]
    while max(level.shape[:2]) > 1:
        rows = np.tensordot(_box(level.shape[0]), level, axes=(1, 0))
        level = np.tensordot(_box(level.shape[1]), rows, axes=(1, 1)).transpose(1, 0, 2)
        levels.append(level)
    return tuple(levels)


def wrap_index(index: np.ndarray, count: int, mode: str) -> np.ndarray:
    """Bring a texel index into [0, count) by repeat, clamp or mirror."""
    if mode == "clamp":
        return np.clip(index, 0, count - 1)
    if mode == "repeat":
        return index % count
    folded = index % (2 * count)
    return np.minimum(folded, 2 * count - 1 - folded)


def _fetch(level: np.ndarray, i: np.ndarray, j: np.ndarray, wrap: tuple[str, str]) -> np.ndarray:
    return level[wrap_index(j, level.shape[0], wrap[1]), wrap_index(i, level.shape[1], wrap[0])]


def nearest(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """Take the texel of the finest level that uv (n, 2) falls into; linear RGBA (n, 4)."""
    level = mip_chain(texture)[0]
    texel = np.floor(uv * (level.shape[1], level.shape[0])).astype(np.int64)
    return _fetch(level, texel[:, 0], texel[:, 1], texture.wrap)


def texel_margin(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """Distance of uv (n, 2) from the nearest border between texels of the finest level [texels], (n,)."""
    place = uv * (texture.pixels.shape[1], texture.pixels.shape[0])
    return np.abs(place - np.round(place)).min(axis=1)


def _bilinear(texture: Texture, level: np.ndarray, uv: np.ndarray) -> np.ndarray:
    place = uv * (level.shape[1], level.shape[0]) - 0.5
    corner = np.floor(place).astype(np.int64)
    (s, t), (i, j) = (place - corner).T[..., None], corner.T
    top = _fetch(level, i, j, texture.wrap) * (1 - s) + _fetch(level, i + 1, j, texture.wrap) * s
    bottom = _fetch(level, i, j + 1, texture.wrap) * (1 - s) + _fetch(level, i + 1, j + 1, texture.wrap) * s
    return top * (1 - t) + bottom * t


def sample(texture: Texture, uv: np.ndarray, uv_dx: np.ndarray, uv_dy: np.ndarray) -> np.ndarray:
    """Sample with trilinear filtering, or the nearest texel where the texture asks for no filter.

    Level of detail: log2 of the longer of the two pixel steps in texels of the finest level, within [0, levels - 1].
    Source: OpenGL 4.6 core, 8.14.1 (scale factor and level of detail).

    Args:
        texture: What to sample.
        uv: (n, 2), v = 0 at the top row.
        uv_dx: Change of uv over one pixel to the right, (n, 2).
        uv_dy: Change of uv over one pixel down, (n, 2).

    Returns:
        Linear RGBA (n, 4).
    """
    if not texture.linear_filter:
        return nearest(texture, uv)
    levels = mip_chain(texture)
    size = np.array([levels[0].shape[1], levels[0].shape[0]], float)
    step = np.maximum(np.linalg.norm(uv_dx * size, axis=1), np.linalg.norm(uv_dy * size, axis=1))
    lod = np.clip(np.log2(np.maximum(step, 1e-300)), 0.0, len(levels) - 1.0)
    lower = np.minimum(np.floor(lod).astype(int), max(0, len(levels) - 2))
    result = np.zeros((len(uv), 4))
    for index in np.unique(lower):
        here = lower == index
        fine = _bilinear(texture, levels[index], uv[here])
        if index + 1 < len(levels):
            part = (lod[here] - index)[:, None]
            fine = fine * (1 - part) + _bilinear(texture, levels[index + 1], uv[here]) * part
        result[here] = fine
    return result
