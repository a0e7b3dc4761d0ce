"""Tone curves and the sRGB encoding."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from warp_deferred.kernels.color import (
    CURVES,
    clamp_radiance,
    curve_aces,
    curve_agx,
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
    elif curve == 3:
        out_values[i] = curve_pbr_neutral(v)
    else:
        out_values[i] = curve_agx(v)


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
    "agx": reference.tone_agx,
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
    # AgX's polynomial has factors of 40 whose sum is below 1; a code of the picture is 0.0003 wide at its narrowest.
    bound = 2e-5 if curve == "agx" else 2e-6
    assert np.abs(tone(values, curve, device) - TWINS[curve](values.astype(np.float32))).max() < bound


def test_agx_goes_to_white_and_keeps_its_order(device):
    # Published behaviour: what is bright enough loses its hue, and more light of one colour never darkens a channel.
    red = np.array([1.0, 0.1, 0.05]) * 2.0 ** np.arange(-12.0, 16.0, 0.25)[:, None]
    result = tone(red, "agx", device)
    assert np.ptp(result[-1]) < 0.01 and np.ptp(result[48]) > 0.2
    assert (np.diff(result.sum(axis=1)) >= -1e-6).all()
    # Middle grey, 0.18, is mapped near itself.
    assert 0.15 < tone([[0.18, 0.18, 0.18]], "agx", device)[0, 1] < 0.25


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


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-40, 8))
def test_p12_any_value_keeps_its_code(seed, power, device):
    # Encoded, decoded and encoded again is encoded: of any value, of any float at all, and around each code's own.
    rng = np.random.default_rng(seed)
    values = np.concatenate([
        rng.uniform(-0.1, 1.1, 500).astype(np.float32) * np.float32(2.0) ** np.float32(power),
        rng.integers(0, 2**32, 500, np.uint32).view(np.float32),
        np.nextafter(srgb_linear(), rng.choice([0.0, 2.0], 256).astype(np.float32)),
    ])  # fmt: skip
    once = codes(values, device)
    assert np.array_equal(codes(srgb_linear()[once], device), once)
