"""Tone curves and the sRGB encoding."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from warp_deferred.kernels.color import (
    CURVES,
    clamp_radiance,
    curve_aces,
    curve_off,
    curve_pbr_neutral,
    curve_reinhard,
    srgb_code,
    srgb_linear,
    srgb_thresholds,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def tone_kernel(values: wp.array[wp.vec3], curve: wp.int32, out_values: wp.array[wp.vec3]):
    i = wp.tid()
    v = clamp_radiance(values[i])
    if curve == 0:
        out_values[i] = curve_off(v)
    elif curve == 1:
        out_values[i] = curve_reinhard(v)
    elif curve == 2:
        out_values[i] = curve_aces(v)
    else:
        out_values[i] = curve_pbr_neutral(v)


@wp.kernel
def code_kernel(
    values: wp.array[wp.float32],
    thresholds: wp.array[wp.float32],
    out_codes: wp.array[wp.uint8],
):
    i = wp.tid()
    out_codes[i] = wp.uint8(srgb_code(values[i], thresholds))


def tone(values: np.ndarray, curve: str, device: str) -> np.ndarray:
    source = wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)
    out = wp.zeros(len(source), dtype=wp.vec3, device=device)
    wp.launch(tone_kernel, len(source), [source, CURVES.index(curve)], [out], device=device)
    return out.numpy()


def codes(values: np.ndarray, device: str) -> np.ndarray:
    source = wp.array(np.asarray(values, np.float32), dtype=wp.float32, device=device)
    thresholds = wp.array(srgb_thresholds(), dtype=wp.float32, device=device)
    out = wp.zeros(len(source), dtype=wp.uint8, device=device)
    wp.launch(code_kernel, len(source), [source, thresholds], [out], device=device)
    return out.numpy()


TWINS = {
    "off": lambda v: np.clip(v, 0.0, 1.0),
    "reinhard": reference.tone_reinhard,
    "aces": reference.tone_aces,
    "pbr_neutral": reference.tone_pbr_neutral,
}


@pytest.mark.parametrize("curve", CURVES)
def test_o1_curves_take_any_number(curve, device):
    values = np.array([0.0, -0.0, -1.0, np.nan, 65504.0, 1e19, np.inf, -np.inf, 1e-45, 3.4e38], np.float32)
    grid = np.stack(np.meshgrid(values, values, values), axis=-1).reshape(-1, 3)
    result = tone(grid, curve, device)
    assert np.isfinite(result).all()
    assert result.min() >= 0.0 and result.max() <= 1.0
    # NaN and negative count as black; beyond half's range counts as its end.
    plain = np.clip(np.where(np.isnan(grid), 0.0, grid), 0.0, 65504.0)
    assert np.array_equal(result, tone(plain, curve, device))
    assert np.array_equal(tone(np.zeros((1, 3)), curve, device), np.zeros((1, 3)))


@pytest.mark.parametrize("curve", CURVES)
def test_o2_curves_never_fall(curve, device):
    # Steps of a thirty-second of a stop: far above float32's rounding, far below what a picture shows.
    grey = 2.0 ** np.arange(-14.0, 16.0, 1.0 / 32.0)
    result = tone(np.repeat(grey[:, None], 3, axis=1), curve, device)
    assert (np.diff(result, axis=0) >= -1e-7).all()
    assert result[-1].min() > 0.99 and np.ptp(result, axis=1).max() < 1e-6


@pytest.mark.parametrize("curve", CURVES)
def test_curves_equal_their_twins(curve, device, rng):
    values = 2.0 ** rng.uniform(-14.0, 16.0, (20_000, 3))
    values[::7] *= rng.random((len(values[::7]), 3)) < 0.5
    assert np.abs(tone(values, curve, device) - TWINS[curve](values.astype(np.float32))).max() < 2e-6


def test_o3_pbr_neutral_keeps_base_colours(device):
    grey = np.linspace(0.08, 0.79, 200)
    result = tone(np.repeat(grey[:, None], 3, axis=1), "pbr_neutral", device)
    assert np.abs(result - (grey[:, None] - 0.04)).max() <= 1e-6


def test_o4_codes_are_rounded_exactly(device):
    values = np.concatenate([np.linspace(0.0, 1.0, 2_000_001), 2.0 ** np.linspace(-40.0, 0.0, 50_000)])
    values = values.astype(np.float32)
    exact = reference.srgb_encode(values) * 255.0
    got = codes(values, device).astype(float)
    assert np.abs(got - exact).max() <= 0.5 + 1e-4
    assert (np.diff(got[:2_000_001]) >= 0).all() and set(got) == set(range(256))


def test_o4_codes_change_at_the_rounding_points(device):
    # Between two codes the threshold is the linear value of their middle; a float above it has the upper code.
    middle = reference.srgb_decode((np.arange(255) + 0.5) / 255.0).astype(np.float32)
    assert np.array_equal(codes(np.nextafter(middle, np.float32(0.0)), device), np.arange(255))
    assert np.array_equal(codes(np.nextafter(middle, np.float32(1.0)), device), np.arange(1, 256))
    # Every float around each rounding point: the code steps once.
    bits = middle.view(np.int32)[:, None] + np.arange(-300, 301)
    around = codes(bits.astype(np.int32).view(np.float32).reshape(-1), device).reshape(bits.shape).astype(int)
    assert (np.diff(around, axis=1) >= 0).all()
    assert np.array_equal(around[:, 0], np.arange(255)) and np.array_equal(around[:, -1], np.arange(1, 256))


def test_o4_bad_values_have_a_code(device):
    assert codes([-1.0, -0.0, 0.0, 1.0, 2.0, np.inf, np.nan], device).tolist() == [0, 0, 0, 255, 255, 255, 0]


def test_p12_codes_come_back(device):
    linear = reference.srgb_decode(np.arange(256) / 255.0)
    assert np.array_equal(srgb_linear(), linear.astype(np.float32))
    assert np.array_equal(codes(linear, device), np.arange(256))
