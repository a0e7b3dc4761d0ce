"""The functions of ambient visibility against NumPy: roots, angles, words, patterns and the pyramid's addresses."""

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels.ambient_visibility import arc_part, fast_rsqrt, pack_visibility, rough_rsqrt, slice_pattern
from warp_deferred.kernels.ambient_visibility_ssao import FRACTION_LOW, hemisphere_points
from warp_deferred.kernels.bilateral import word_depth, word_visibility
from warp_deferred.kernels.depth_pyramid import BIN_WORDS, LEVELS, pyramid_index
from warp_deferred.kernels.hemisphere import cosine_directions
from warp_deferred.kernels.structs import View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def root_kernel(values: wp.array[wp.float32], out_values: wp.array[wp.vec2]):
    i = wp.tid()
    out_values[i] = wp.vec2(fast_rsqrt(values[i]), rough_rsqrt(values[i]))


@wp.kernel
def arc_kernel(values: wp.array[wp.float32], out_values: wp.array[wp.float32]):
    i = wp.tid()
    out_values[i] = arc_part(values[i])


@wp.kernel
def word_kernel(depth: wp.array[wp.float32], values: wp.array[wp.float32], out_values: wp.array[wp.vec2]):
    i = wp.tid()
    word = pack_visibility(depth[i], values[i])
    out_values[i] = wp.vec2(word_depth(word), word_visibility(word))


@wp.kernel
def index_kernel(views: wp.array[View], out_index: wp.array3d[wp.int32]):
    level, y, x = wp.tid()
    out_index[level, y, x] = pyramid_index(views[0], level + 1, x, y)


def test_roots_are_within_their_bound(device):
    x = np.concatenate([np.logspace(-37, 37, 20000), [0.0, 1.0]]).astype(np.float32)
    out = wp.zeros(len(x), dtype=wp.vec2, device=device)
    wp.launch(root_kernel, len(x), [wp.array(x, dtype=wp.float32, device=device)], [out], device=device)
    fine, rough = out.numpy().astype(float).T
    some = x > 0.0
    assert np.abs(fine[some] * np.sqrt(x[some].astype(float)) - 1.0).max() <= 5e-6
    assert np.abs(rough[some] * np.sqrt(x[some].astype(float)) - 1.0).max() <= 1e-3
    assert np.isfinite(fine).all() and np.isfinite(rough).all()


def test_arcs_are_within_their_bound_rise_and_are_odd_to_the_bit(device):
    x = np.linspace(-1.0, 1.0, 20001).astype(np.float32)
    out = wp.zeros(len(x), dtype=wp.float32, device=device)
    wp.launch(arc_kernel, len(x), [wp.array(x, dtype=wp.float32, device=device)], [out], device=device)
    part, c = out.numpy().astype(float), x.astype(float)
    assert np.abs(part - np.arcsin(c) - c * np.sqrt(1.0 - c * c)).max() <= 6e-4
    assert np.array_equal(part, -part[::-1]) and np.diff(part).min() >= -2e-7


def test_words_keep_depth_to_15_bits_and_visibility_to_8(device, rng):
    depth = np.concatenate([np.logspace(-30, 30, 1000), -np.logspace(-3, 3, 100), [np.inf, 0.0]]).astype(np.float32)
    values = rng.random(len(depth)).astype(np.float32)
    values[:5] = 0.0, 1.0, 2.0, -1.0, np.nan
    out = wp.zeros(len(depth), dtype=wp.vec2, device=device)
    arrays = [wp.array(a, dtype=wp.float32, device=device) for a in (depth, values)]
    wp.launch(word_kernel, len(depth), arrays, [out], device=device)
    kept, visibility = out.numpy().T
    finite = np.isfinite(depth) & (depth != 0.0)
    assert np.abs(kept[finite] / depth[finite] - 1.0).max() <= 2.0**-15
    assert np.array_equal(kept[~finite], depth[~finite])
    assert np.abs(visibility[5:] - values[5:]).max() <= 0.5 / 255.0 + 1e-6
    assert visibility[:5].tolist() == [0.0, 1.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("slices", [1, 2, 5])
def test_the_pattern_spreads_directions_evenly_and_jitters_independently(slices):
    table = slice_pattern(slices).astype(float)
    assert np.allclose(table[:, 0] ** 2 + table[:, 1] ** 2, 1.0, atol=1e-6)
    angle = np.sort(np.arctan2(table[:, 1], table[:, 0]) % np.pi)
    assert np.allclose(np.diff(angle), np.pi / (16 * slices), atol=1e-6)
    for k in range(slices):
        jitter = np.sort(table[k * 16 : (k + 1) * 16, 2])
        assert np.allclose(jitter, (np.arange(16) + 0.5) / 16.0)


def test_directions_are_cosine_weighted():
    for count in (16, 256):
        d = cosine_directions(count).astype(float)
        assert np.allclose(np.linalg.norm(d[:, :3], axis=1), 1.0, atol=1e-6) and d[:, 2].min() > 0.0
        # Of the density cos / pi: mean cosine 2/3, mean squared cosine 1/2, no side preferred.
        assert abs(d[:, 2].mean() - 2.0 / 3.0) <= 1.0 / count and abs((d[:, 2] ** 2).mean() - 0.5) <= 1e-6
        assert np.abs(d[:, :2].mean(axis=0)).max() <= 2.0 / count
    points = hemisphere_points(16).astype(float)
    length = np.linalg.norm(points[:, :3], axis=1)
    assert len(points) == 256 and length.min() >= FRACTION_LOW - 1e-6 and length.max() <= 1.0 and length.std() > 0.15


def test_texels_of_the_pyramid_never_meet(device):
    bins = (3, 2)
    view = View()
    view.bin_offset, view.bins_x = 4, bins[0]
    views = wp.array([view], dtype=View, device=device)
    size = (16 * bins[1], 16 * bins[0])
    out = wp.zeros((int(LEVELS), *size), dtype=wp.int32, device=device)
    wp.launch(index_kernel, out.shape, [views], [out], device=device)
    index = out.numpy()
    texels = [np.unique(index[k]) for k in range(int(LEVELS))]
    assert [len(t) for t in texels] == [size[0] * size[1] >> 2 * k for k in range(1, int(LEVELS) + 1)]
    together = np.concatenate(texels)
    assert len(np.unique(together)) == len(together)
    assert together.min() >= 4 * BIN_WORDS and together.max() < (4 + bins[0] * bins[1]) * BIN_WORDS
    for k in range(int(LEVELS)):
        step = 2 << k
        assert np.array_equal(index[k], np.kron(index[k][::step, ::step], np.ones((step, step), int)))
