"""Bloom's functions: the bright part, the mirrors, the widths."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from warp_deferred.kernels.bloom import mirrored
from warp_deferred.kernels.bloom_bright import bright_part, exposed
from warp_deferred.kernels.bloom_exact import folded
from warp_deferred.kernels.structs import Bloom

from warp_deferred.passes.bloom import MAX_LEVELS, level_count, spread, weights

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def bright_kernel(values: wp.array[wp.vec3], bloom: Bloom, exposure: wp.float32, out_values: wp.array[wp.vec3]):
    i = wp.tid()
    out_values[i] = bright_part(exposed(values[i], exposure), bloom)


@wp.kernel
def index_kernel(values: wp.array[wp.vec3i], out_values: wp.array[wp.vec2i]):
    i = wp.tid()
    v = values[i]
    out_values[i] = wp.vec2i(mirrored(v[0], v[1], v[2]), folded(v[0], v[1]))


def bright(values, threshold, knee, exposure=1.0, device="cpu"):
    bloom = Bloom()
    bloom.threshold, bloom.knee, bloom.soft = threshold, knee, 0.25 / knee if knee else 0.0
    source = wp.array(np.asarray(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
    out = wp.zeros_like(source)
    wp.launch(bright_kernel, len(source), [source, bloom, exposure], [out], device=device)
    return out.numpy()


@pytest.mark.parametrize(("threshold", "knee"), [(1.0, 0.5), (1.0, 0.0), (2.0, 2.0), (0.25, 0.1)])
def test_bright_part_is_the_soft_threshold(threshold, knee, rng, device):
    values = rng.uniform(0.0, 4.0, (4096, 3)) * rng.choice([0.1, 1.0, 100.0], (4096, 1))
    expected = reference.bloom_bright(values, threshold, knee)
    actual = bright(values, threshold, knee, device=device)
    np.testing.assert_allclose(actual, expected, rtol=2e-5, atol=2e-6)
    peak = values.max(axis=1)
    assert np.array_equal(actual[peak < threshold - knee], np.zeros_like(actual[peak < threshold - knee]))
    assert (actual.max(axis=1)[peak > threshold + knee + 1e-3] > 0.0).all()


def test_without_a_threshold_the_bright_part_is_everything_to_the_bit(rng, device):
    values = (10.0 ** rng.uniform(-30, 4.8, (4096, 3))).astype(np.float32)
    assert np.array_equal(bright(values, 0.0, 0.0, device=device), values)


def test_bright_part_is_smooth_at_both_ends_of_the_knee():
    peaks = np.linspace(0.3, 1.7, 1401)
    curve = bright(np.repeat(peaks[:, None], 3, 1), 1.0, 0.5)[:, 0].astype(float)
    slope = np.diff(curve) / np.diff(peaks)
    assert slope.min() > -1e-3 and slope.max() < 1.001
    assert np.abs(np.diff(slope)).max() < 3e-3


def test_m1_values_that_are_no_radiance_are_black(device):
    bad = (np.nan, np.inf, -np.inf, -1e-3, -65504.0)
    values = [[b if k == c else 1.0 for k in range(3)] for b in bad for c in range(3)] + [[b] * 3 for b in bad]
    assert not bright(values, 0.0, 0.0, device=device).any()


def test_p11_exposed_radiance_is_finite_at_any_exposure(rng, device):
    values = 10.0 ** rng.uniform(-30, 30, (4096, 3))
    for exposure in (2.0**-64, 1.0, 2.0**64):
        for threshold, knee in ((0.0, 0.0), (1.0, 0.5), (65504.0, 65504.0)):
            out = bright(values, threshold, knee, exposure, device)
            assert np.isfinite(out).all() and out.min() >= 0.0 and out.max() <= 65504.0


def test_mirrors_agree_with_a_mirrored_row(device):
    rows = [(i, n, 2 * n) for n in (1, 2, 5, 8) for i in range(-3 * n, 4 * n)] + [(i, 68, 135) for i in range(-5, 74)]
    out = wp.zeros(len(rows), dtype=wp.vec2i, device=device)
    wp.launch(index_kernel, len(rows), [wp.array(rows, dtype=wp.vec3i, device=device)], [out], device=device)
    for (i, n, edge), (near, far) in zip(rows, out.numpy(), strict=True):
        endless = np.concatenate([np.arange(n), np.arange(n)[::-1]])[i % (2 * n)]
        assert far == endless
        if edge == 2 * n and -n <= i < 2 * n:
            assert near == endless
        assert 0 <= near < n
        if edge == 135 and i >= 68:
            # The edge runs through the middle of the last texel.
            assert near == 134 - i


def test_spread_is_the_width_of_the_pyramid():
    """The closed form against the pyramid's own matrices, averaged over the places a pixel may have."""
    length = 1024
    for levels in range(1, 6):
        axes = reference.bloom_axes(length, levels)
        # One axis of the 13 taps: half of a and half of s, at every level.
        mean = axes["first"][0]
        for k in range(levels - 1):
            mean = 0.5 * (axes["a"][k] + axes["s"][k]) @ mean
        for k in reversed(range(levels - 1)):
            mean = axes["tent"][k] @ mean
        mean = axes["bilinear"][0] @ mean
        x = np.arange(length)
        inner = slice(448, 448 + 2**levels)
        column = mean[:, inner]
        assert np.allclose(column.sum(axis=0).mean(), 1.0)
        variance = ((x[:, None] - x[inner]) ** 2 * column).sum(axis=0).mean()
        assert np.isclose(np.sqrt(variance), spread(levels), rtol=1e-9)
        shift = ((x[:, None] - x[inner]) * column).sum(axis=0)
        assert np.abs(shift).max() < 1e-9


def test_levels_follow_the_height():
    assert [level_count(h, 0.07) for h in (1, 20, 540, 1080, 2160)] == [1, 1, 5, 6, 7]
    assert level_count(16384, 0.5) <= MAX_LEVELS
    for count in (1, 4, 9):
        row = weights(count, 0.7)
        assert np.isclose(row.sum(), 1.0) and np.allclose(row[1:] / row[:-1], 0.7)
