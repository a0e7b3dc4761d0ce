"""The blur and the upsampling of occlusion words against NumPy, and the arithmetic they stand on."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels import bilateral, visibility_upsampling
from warp_deferred.kernels.bilateral import TOLERANCE, rough_reciprocal
from warp_deferred.kernels.intrinsics import fma, fnma, saturated_fma
from warp_deferred.kernels.structs import ORTHOGRAPHIC, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

OPEN = 0x7F800000
RADIUS = 0.5


@wp.kernel
def fused_kernel(values: wp.array[wp.vec3], out_values: wp.array[wp.vec3], out_reciprocals: wp.array[wp.float32]):
    i = wp.tid()
    v = values[i]
    out_values[i] = wp.vec3(fma(v[0], v[1], v[2]), fnma(v[0], v[1], v[2]), saturated_fma(v[0], v[1], v[2]))
    out_reciprocals[i] = rough_reciprocal(v[0])


def fused(values, device):
    values = np.asarray(values, np.float32)
    out = wp.zeros(len(values), dtype=wp.vec3, device=device)
    reciprocals = wp.zeros(len(values), dtype=wp.float32, device=device)
    wp.launch(
        fused_kernel, len(values), [wp.array(values, dtype=wp.vec3, device=device)], [out, reciprocals], device=device
    )
    return out.numpy(), reciprocals.numpy()


def test_fused_sums_are_rounded_once(device, rng):
    values = rng.normal(size=(2000, 3)).astype(np.float32)
    # Products that almost cancel with the sum tell one rounding from two.
    values[:1000, 2] = -(values[:1000, 0] * values[:1000, 1])
    out, _ = fused(values, device)
    for (a, b, c), (plus, minus, clamped) in zip(values.tolist(), out, strict=True):
        exact = Fraction(a) * Fraction(b) + Fraction(c)
        assert np.float32(float(exact)) == plus
        assert np.float32(float(Fraction(c) - Fraction(a) * Fraction(b))) == minus
        assert clamped == min(max(plus, 0.0), 1.0)
    assert np.count_nonzero(out[:1000, 0]) > 900


def test_a_saturated_sum_is_0_where_it_is_no_number(device):
    out, _ = fused([(np.inf, 0.0, 1.0), (np.nan, 1.0, 1.0), (np.inf, 1.0, 0.0), (-np.inf, 1.0, 0.0)], device)
    assert out[:, 2].tolist() == [0.0, 0.0, 1.0, 0.0]


def test_the_reciprocal_is_within_its_bound(device):
    x = np.zeros((20001, 3), np.float32)
    x[1:, 0] = np.logspace(-37, 37, 20000)
    _, y = fused(x, device)
    assert np.abs(y[1:] * x[1:, 0].astype(float) - 1.0).max() <= 3e-4
    assert y[0] == np.inf


def image_view(width, height, projection):
    view = View()
    view.width, view.height, view.row_pitch, view.pixel_offset = width, height, width + 3, 5
    view.bins_x, view.bin_offset = (width + 15) // 16, 1
    view.projection = projection
    view.scale = (400.0, -400.0)
    return view


def tiles_of(view):
    bins = [(0, 16 * x, 16 * y, 0) for y in range((view.height + 15) // 16) for x in range(view.bins_x)]
    return np.array(bins, np.int32)


def places(view, half):
    """Indices of the words of an image, (height, width)."""
    if half:
        y, x = np.mgrid[: (view.height + 1) // 2, : (view.width + 1) // 2]
        return view.bin_offset * 64 + y * view.bins_x * 8 + x
    y, x = np.mgrid[: view.height, : view.width]
    return view.pixel_offset + y * view.row_pitch + x


def random_words(shape, rng):
    """Words on a few tilted planes with steps between them, a few of the background."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    depth = 0.5 + 0.002 * x - 0.001 * y + 0.25 * (x // 11 % 2) + 0.02 * (y // 7 % 2)
    words = (depth.astype(np.float32).view(np.uint32) & 0xFFFFFF00) | rng.integers(0, 256, shape).astype(np.uint32)
    words[rng.random(shape) < 0.05] = OPEN
    return words


def blur_lines(words, view, step):
    """Codes of words blurred along rows, in float64, and which of them."""
    depth, code = words.view(np.float32).astype(float), (words & 255).astype(float)

    def shifted(values, offset, outside):
        result = np.full(values.shape, outside)
        if abs(offset) < values.shape[1]:
            source, target = (
                slice(max(offset, 0), values.shape[1] + min(offset, 0)),
                slice(max(-offset, 0), values.shape[1] + min(-offset, 0)),
            )
            result[:, target] = values[:, source]
        return result

    depths = {k: shifted(depth, k * step, np.inf) for k in (-2, -1, 0, 1, 2)}
    with np.errstate(invalid="ignore"):
        before, after = depth - depths[-1], depths[1] - depth
        slope = np.where(np.abs(before) < np.abs(after), before, after)
        tolerance = float(TOLERANCE) * RADIUS * (1.0 if view.projection == int(ORTHOGRAPHIC) else depth * depth)
        total, weights = np.zeros_like(depth), tolerance * np.ones_like(depth)
        for k, share in ((-2, 0.5), (-1, 1.0), (1, 1.0), (2, 0.5)):
            difference = shifted(code, k * step, 0.0) - code
            weight = share * np.nan_to_num(np.maximum(tolerance - np.abs(depths[k] - (depth + k * slope)), 0.0))
            if step > 1:
                weight = weight * np.clip(1.0 - np.abs(difference) * 8.0 / 255.0, 0.0, 1.0)
            total, weights = total + weight * difference, weights + weight
        result = code + total / weights
    return np.where(words == OPEN, 0.0, result)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("projection", [0, int(ORTHOGRAPHIC)])
@pytest.mark.parametrize("size", [(37, 50), (16, 16), (3, 1)])
def test_blurs_are_the_averages_of_their_definition(wide, half, projection, size, device, rng):
    view = image_view(*size, projection)
    where = places(view, half)
    words = random_words(where.shape, rng)
    step = 3 if wide else 1
    rows = blur_lines(words, view, step)
    between = (words & np.uint32(0xFFFFFF00)) | np.rint(rows).astype(np.uint32)
    expected = blur_lines(np.ascontiguousarray(between.T), view, step).T
    # A code on the edge of two may be rounded either way, and the next average sees it.
    final = wide and not half
    tiles = tiles_of(view)
    buffer = np.full(max(where.max() + 1, 64 * (len(tiles) + 1)), OPEN, np.uint32)
    buffer[where] = words
    out = wp.full(len(buffer), 0, dtype=wp.float32 if final else wp.uint32, device=device)
    inputs = [
        wp.array([view], dtype=View, device=device), wp.array(tiles, dtype=wp.vec4i, device=device),
        wp.array(buffer, dtype=wp.uint32, device=device), RADIUS, 1.0, 0,
    ]  # fmt: skip
    wp.launch(
        bilateral.make_blur_kernel(half, wide), 64 * len(tiles), inputs, [out], device=device,
        block_dim=bilateral.BLOCK_DIM,
    )  # fmt: skip
    result = out.numpy()[where]
    if final:
        assert np.abs(result * 255.0 - (255.0 - expected)).max() <= 1.0
    else:
        assert np.array_equal(result & 0xFFFFFF00, words & 0xFFFFFF00)
        assert np.abs((result & 255) - expected).max() <= 1.0
    kept = np.ones(len(buffer), bool)
    kept[where] = False
    assert not out.numpy()[kept].any(), "written outside the image"


@pytest.mark.parametrize("size", [(37, 50), (16, 16), (2, 1), (1, 1)])
def test_upsampling_keeps_edges_and_interpolates_planes(size, device):
    view = image_view(*size, 0)
    tiles = tiles_of(view)
    y, x = np.mgrid[: view.height, : view.width]
    # Two walls with a step in depth between them, each with a visibility of its own that is linear across it.
    near = x < 13
    depth = np.where(near, 1.0, 3.0).astype(np.float32)
    blocked = np.where(near, 20.0 + 2.0 * x, 200.0 - 2.0 * y)
    half_where, where = places(view, True), places(view, False)
    affine = (1.0 / depth[::2, ::2]).astype(np.float32)
    words = np.full(64 * (len(tiles) + 1), OPEN, np.uint32)
    words[half_where] = (affine.view(np.uint32) & 0xFFFFFF00) | np.rint(blocked[::2, ::2]).astype(np.uint32)
    depths = np.full(where.max() + 1, np.inf, np.float32)
    depths[where] = depth
    if view.width > 8:
        depths[where[5, 7]] = np.inf
    out = wp.full(len(depths), -1.0, dtype=wp.float32, device=device)
    inputs = [
        wp.array([view], dtype=View, device=device), wp.array(tiles, dtype=wp.vec4i, device=device),
        wp.array(depths, dtype=wp.float32, device=device), wp.array(words, dtype=wp.uint32, device=device),
        RADIUS, 1.0, 0,
    ]  # fmt: skip
    wp.launch(
        visibility_upsampling.upsample_kernel, 64 * len(tiles), inputs, [out], device=device,
        block_dim=visibility_upsampling.BLOCK_DIM,
    )  # fmt: skip
    result = out.numpy()[where]
    expected = 1.0 - blocked / 255.0
    inner = np.ones(expected.shape, bool)
    # An odd last row or column has one neighbour; the step stands between two half-size pixels.
    inner[:, -1:], inner[-1:] = view.width % 2 == 1, inner[-1:] & (view.height % 2 == 1)
    error = np.abs(result - expected)
    if view.width > 8:
        assert result[5, 7] == 1.0
        error[5, 7] = 0.0
    assert error[inner].max(initial=0.0) <= 2.5 / 255.0
    assert error.max() <= 4.5 / 255.0
    kept = np.ones(len(depths), bool)
    kept[where] = False
    assert np.all(out.numpy()[kept] == -1.0)
