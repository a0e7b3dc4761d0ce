"""Tone curves and the sRGB encoding.

Every curve takes radiance clamped to [0, 65504], so that no finite input can leave [0, 1] or turn into NaN.
reinhard: x / (1 + x) per channel (Reinhard et al. 2002). aces: Narkowicz 2015, "ACES Filmic Tone Mapping Curve",
x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14). pbr_neutral: Khronos PBR Neutral 1.0 (KhronosGroup/ToneMapping),
which keeps base colours up to 0.8 and compresses highlights towards white. off: clamp to [0, 1].
The encoding to 8 bits decides by the exact decoded thresholds between codes and only guesses by a power, so it
gives the same byte on every device (IEC 61966-2-1; Direct3D functional specification 3.2.3.8).
"""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from .intrinsics import srgb_guess

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CURVES = ("off", "reinhard", "aces", "pbr_neutral")
#: Distance from a code's border within which the guess is checked by the exact thresholds [codes].
DOUBT = 0.03


def srgb_thresholds() -> np.ndarray:
    """(257,) float32: least linear value of each code 0 to 255, then inf."""
    code = (np.arange(1, 256) - 0.5) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return np.concatenate([[0.0], linear, [np.inf]]).astype(np.float32)


def srgb_linear() -> np.ndarray:
    """(256,) float32: linear value of each code, which `srgb_code` takes back to it."""
    code = np.arange(256) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


@wp.func
def clamp_radiance(v: wp.vec3):
    """NaN to 0, then [0, 65504] per channel."""
    r = wp.vec3()
    for k in range(3):
        if v[k] > 0.0:
            r[k] = wp.min(v[k], 65504.0)
    return r


@wp.func
def curve_off(v: wp.vec3):
    """Clamp to [0, 1]."""
    return wp.min(v, wp.vec3(1.0, 1.0, 1.0))


@wp.func
def curve_reinhard(v: wp.vec3):
    """Simple Reinhard curve."""
    return wp.vec3(v[0] / (1.0 + v[0]), v[1] / (1.0 + v[1]), v[2] / (1.0 + v[2]))


@wp.func
def aces_channel(x: wp.float32):
    """Narkowicz's fit of one channel."""
    return wp.min(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)


@wp.func
def curve_aces(v: wp.vec3):
    """Narkowicz's fit of the ACES reference curve."""
    return wp.vec3(aces_channel(v[0]), aces_channel(v[1]), aces_channel(v[2]))


@wp.func
def curve_pbr_neutral(v: wp.vec3):
    """Khronos PBR Neutral."""
    start = wp.float32(0.8 - 0.04)
    low = wp.min(v[0], wp.min(v[1], v[2]))
    offset = wp.float32(0.04)
    if low < 0.08:
        offset = low - 6.25 * low * low
    c = v - wp.vec3(offset, offset, offset)
    peak = wp.max(c[0], wp.max(c[1], c[2]))
    if peak < start:
        return wp.max(c, wp.vec3())
    d = 1.0 - start
    new_peak = 1.0 - d * d / (peak + d - start)
    c = c * (new_peak / peak)
    g = 1.0 - 1.0 / (0.15 * (peak - new_peak) + 1.0)
    mixed = c * (1.0 - g) + wp.vec3(new_peak, new_peak, new_peak) * g
    return wp.max(wp.min(mixed, wp.vec3(1.0, 1.0, 1.0)), wp.vec3())


@functools.cache
def tone_curve(name: str):
    """Return the Warp function of a curve's name."""
    return {"off": curve_off, "reinhard": curve_reinhard, "aces": curve_aces, "pbr_neutral": curve_pbr_neutral}[name]


@wp.func
def srgb_code(value: wp.float32, thresholds: wp.array[wp.float32]):
    """8-bit sRGB code of a linear value in [0, 1], rounded exactly; one read in seventeen values."""
    v = wp.clamp(value, 0.0, 1.0)
    encoded = v * 12.92
    if v > 0.0031308:
        encoded = srgb_guess(v)
    scaled = encoded * 255.0 + 0.5
    code = wp.int32(scaled)
    rest = scaled - wp.float32(code)
    if rest < wp.static(DOUBT):
        if v < thresholds[code]:
            code -= 1
    elif rest > wp.static(1.0 - DOUBT):
        if v >= thresholds[code + 1]:
            code += 1
    return wp.uint32(code)
