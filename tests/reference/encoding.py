"""Octahedral unit vectors, plain and precise. Source: Cigolle et al. 2014, JCGT 3(2)."""

from __future__ import annotations

import numpy as np

__all__ = ["oct_decode", "oct_encode", "oct_encode_precise", "oct_unwrap", "oct_wrap"]


def _sign(x: np.ndarray) -> np.ndarray:
    # A fold at exactly 0 must go somewhere: a sign of 0 would pull the vector onto an axis.
    return np.where(x >= 0.0, 1.0, -1.0)


def oct_wrap(normals: np.ndarray) -> np.ndarray:
    """Map unit vectors (..., 3) onto the square [-1, 1]² (..., 2); zero or non-finite ones go where +z goes."""
    n = np.asarray(normals, float)
    size = np.abs(n).sum(axis=-1, keepdims=True)
    good = np.isfinite(size) & (size > 0.0)
    n = np.where(good, n, (0.0, 0.0, 1.0))
    p = n / np.where(good, size, 1.0)
    xy = p[..., :2]
    return np.where(p[..., 2:] < 0.0, (1.0 - np.abs(xy[..., ::-1])) * _sign(xy), xy)


def oct_unwrap(square: np.ndarray) -> np.ndarray:
    """Map points of the square [-1, 1]² (..., 2) back to unit vectors (..., 3)."""
    p = np.asarray(square, float)
    z = 1.0 - np.abs(p).sum(axis=-1, keepdims=True)
    xy = np.where(z < 0.0, (1.0 - np.abs(p[..., ::-1])) * _sign(p), p)
    n = np.concatenate([xy, z], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def _top(bits: int) -> float:
    # Signed fixed point: an odd number of codes, so that 0 and both ends are exact.
    return float(2 ** (bits - 1) - 1)


def oct_encode(normals: np.ndarray, bits: int) -> np.ndarray:
    """Quantise to two signed whole numbers of `bits` bits by rounding to the nearest code, (..., 2)."""
    return np.floor(oct_wrap(normals) * _top(bits) + 0.5).astype(np.int64)


def oct_encode_precise(normals: np.ndarray, bits: int) -> np.ndarray:
    """Quantise to the best of the four codes around the exact point, (..., 2)."""
    n = np.asarray(normals, float)
    square = oct_wrap(n)
    exact = oct_unwrap(square)
    base = np.floor(square * _top(bits))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    codes = np.minimum(base[..., None, :] + corners, _top(bits))
    closeness = (oct_decode(codes, bits) * exact[..., None, :]).sum(axis=-1)
    choice = closeness.argmax(axis=-1)
    return np.take_along_axis(codes, choice[..., None, None], axis=-2)[..., 0, :].astype(np.int64)


def oct_decode(codes: np.ndarray, bits: int) -> np.ndarray:
    """Turn codes (..., 2) back into unit vectors (..., 3)."""
    return oct_unwrap(np.asarray(codes, float) / _top(bits))
