"""Colour and quantisation twins: sRGB, tone curves, unorm packing, linear depth."""

from __future__ import annotations

import numpy as np

__all__ = [
    "HALF_MAX",
    "linear_depth",
    "pack_unorm",
    "srgb_decode",
    "srgb_encode",
    "tone_aces",
    "tone_agx",
    "tone_pbr_neutral",
    "tone_reinhard",
    "unpack_unorm",
]

HALF_MAX = 65504.0


def srgb_decode(code: np.ndarray) -> np.ndarray:
    """Turn sRGB values in [0, 1] into linear ones. Source: IEC 61966-2-1."""
    code = np.asarray(code, float)
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """Turn linear values in [0, 1] into sRGB ones. Source: IEC 61966-2-1."""
    linear = np.asarray(linear, float)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def pack_unorm(values: np.ndarray, bits: int) -> np.ndarray:
    """Pack [0, 1] into whole numbers of that many bits; NaN becomes 0, the rest is clamped.

    Source: Direct3D 11 functional specification, 3.2.3.6: scale by 2^n - 1, add 0.5, drop the fraction.
    """
    values = np.asarray(values, float)
    clamped = np.clip(np.where(np.isnan(values), 0.0, values), 0.0, 1.0)
    return np.floor(clamped * (2**bits - 1) + 0.5).astype(np.int64)


def unpack_unorm(codes: np.ndarray, bits: int) -> np.ndarray:
    """Undo `pack_unorm`. Source: Direct3D 11 functional specification, 3.2.3.5."""
    return np.asarray(codes, float) / (2**bits - 1)


def _scene_range(radiance: np.ndarray) -> np.ndarray:
    # Curves divide large by large: without the bound, inf / inf is NaN.
    radiance = np.asarray(radiance, float)
    return np.clip(np.where(np.isnan(radiance), 0.0, radiance), 0.0, HALF_MAX)


def tone_reinhard(radiance: np.ndarray) -> np.ndarray:
    """Compress each channel by x / (1 + x). Source: Reinhard et al. 2002, equation 3, applied per channel."""
    x = _scene_range(radiance)
    return x / (1.0 + x)


def tone_aces(radiance: np.ndarray) -> np.ndarray:
    """Compress each channel by a rational fit of the ACES curve.

    Source: Narkowicz 2015, ACES Filmic Tone Mapping Curve; result clamped to [0, 1].
    """
    x = _scene_range(radiance)
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)


def tone_pbr_neutral(radiance: np.ndarray) -> np.ndarray:
    """Keep base colours below 0.76 as they are less the 4 % of Fresnel light, and compress highlights towards white.

    Source: Khronos PBR Neutral Tone Mapper specification (KhronosGroup/ToneMapping).

    Args:
        radiance: (..., 3).
    """
    rgb = _scene_range(radiance)
    knee, desaturation = 0.8 - 0.04, 0.15
    low = rgb.min(axis=-1, keepdims=True)
    rgb = rgb - np.where(low < 0.08, low - 6.25 * low**2, 0.04)
    peak = rgb.max(axis=-1, keepdims=True)
    room = 1.0 - knee
    squeezed = 1.0 - room**2 / (np.maximum(peak, knee) + room - knee)
    towards_white = 1.0 - 1.0 / (desaturation * (peak - squeezed) + 1.0)
    high = rgb * (squeezed / np.maximum(peak, knee))
    return np.where(peak < knee, rgb, high + (squeezed - high) * towards_white)


def tone_agx(radiance: np.ndarray) -> np.ndarray:
    """Compress by AgX. Source: Wrensch 2023, Minimal AgX Implementation; rows of the matrices scaled to a sum of 1.

    Args:
        radiance: (..., 3).
    """
    inset = np.array(
        [
            [0.842479062253094, 0.0784335999999992, 0.0792237451477643],
            [0.0423282422610123, 0.878468636469772, 0.0791661274605434],
            [0.0423756549057051, 0.0784336, 0.879142973793104],
        ]
    )
    outset = np.array(
        [
            [1.19687900512017, -0.0980208811401368, -0.0990297440797205],
            [-0.0528968517574562, 1.15190312990417, -0.0989611768448433],
            [-0.0529716355144438, -0.0980434501171241, 1.15107367264116],
        ]
    )
    inset, outset = (m / m.sum(axis=1, keepdims=True) for m in (inset, outset))
    low, high = -12.47393, 4.026069
    with np.errstate(divide="ignore"):
        stops = np.clip(np.log2(_scene_range(radiance) @ inset.T), low, high)
    curve = np.polyval([15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], (stops - low) / (high - low))
    return np.clip(curve @ outset.T, 0.0, 1.0) ** 2.2


def linear_depth(z: np.ndarray, *, near: float, far: float, orthographic: bool) -> np.ndarray:
    """Decode a depth value to view depth [m].

    Perspective: near / z, reversed with an infinite far plane (0 is +inf). Orthographic: 1 at near, 0 at far, linear.
    """
    z = np.asarray(z, float)
    if orthographic:
        return far - z * (far - near)
    with np.errstate(divide="ignore"):
        return near / z
