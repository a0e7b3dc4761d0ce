"""Projection, snapping, depth and interpolation: functions that decide coverage and what a pixel sees."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from warp_deferred.kernels.clusters import choose_anchor
from warp_deferred.kernels.coverage import accept_depth, edge_threshold, first_pixel, fragment_depth, last_pixel, snap
from warp_deferred.kernels.interpolation import Barycentric, barycentric, mix2, mix3, mix4
from warp_deferred.kernels.intrinsics import bits_float, float_bits
from warp_deferred.kernels.projection import (
    linear_depth,
    pixel_of,
    relative_position,
    vertex_depth,
    view_direction,
)
from warp_deferred.kernels.structs import Instance, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Corner:
    """Homogeneous, pixel-relative vertices of a triangle, with attributes."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    u: wp.vec4
    v: wp.vec4
    w: wp.vec4


@wp.kernel
def snap_kernel(values: wp.array[wp.float32], out_values: wp.array[wp.int32]):
    i = wp.tid()
    out_values[i] = snap(values[i])


@wp.kernel
def pixel_kernel(values: wp.array[wp.int32], out_range: wp.array[wp.vec2i]):
    i = wp.tid()
    out_range[i] = wp.vec2i(first_pixel(values[i]), last_pixel(values[i]))


@wp.kernel
def place_kernel(blocks: wp.array[wp.vec4i], out_places: wp.array[wp.vec3i]):
    i = wp.tid()
    out_places[i] = pixel_of(blocks, i)


@wp.kernel
def threshold_kernel(steps: wp.array[wp.vec2i], out_values: wp.array[wp.int32]):
    i = wp.tid()
    out_values[i] = edge_threshold(steps[i][0], steps[i][1])


@wp.kernel
def fragment_kernel(
    edges: wp.array[wp.vec3], area: wp.array[wp.float32], z: wp.array[wp.vec3], out_depth: wp.array[wp.float32]
):
    i = wp.tid()
    e = edges[i]
    out_depth[i] = fragment_depth(e[0], e[1], e[2], 1.0 / area[i], z[i])


@wp.kernel
def depth_kernel(views: wp.array[View], distance: wp.array[wp.float32], out_values: wp.array[wp.vec4]):
    i = wp.tid()
    view = views[0]
    z = vertex_depth(view, distance[i])
    out_values[i] = wp.vec4(z, linear_depth(view, z), accept_depth(view, z), bits_float(float_bits(z)))


@wp.kernel
def position_kernel(
    views: wp.array[View], pixels: wp.array[wp.vec3], out_points: wp.array[wp.vec3], out_directions: wp.array[wp.vec3]
):
    i = wp.tid()
    p = pixels[i]
    out_points[i] = relative_position(views[0], p[0], p[1], p[2])
    out_directions[i] = view_direction(views[0], out_points[i])


@wp.kernel
def interpolate_kernel(corners: wp.array[Corner], out_weights: wp.array[Barycentric], out_values: wp.array[wp.vec4]):
    i = wp.tid()
    t = corners[i]
    b = barycentric(t.a, t.b, t.c)
    out_weights[i] = b
    value = mix4(b.weight, t.u, t.v, t.w)
    two = mix2(b.weight, wp.vec2(t.u[0], t.u[1]), wp.vec2(t.v[0], t.v[1]), wp.vec2(t.w[0], t.w[1]))
    three = mix3(
        b.weight, wp.vec3(t.u[0], t.u[1], t.u[2]), wp.vec3(t.v[0], t.v[1], t.v[2]), wp.vec3(t.w[0], t.w[1], t.w[2])
    )
    # The three widths agree, or the value becomes NaN.
    if two[1] != value[1] or three[2] != value[2]:
        value = wp.vec4(wp.nan, wp.nan, wp.nan, wp.nan)
    out_values[i] = value


@wp.kernel
def anchor_kernel(instances: wp.array[Instance], eyes: wp.array[wp.vec3d], out_anchors: wp.array[wp.vec3d]):
    i = wp.tid()
    out_anchors[i] = choose_anchor(instances[0], eyes[i])


def run(kernel, inputs, dtype, device):
    """Launch over the first input's rows; inputs are (array, dtype) pairs."""
    arrays = [wp.array(np.asarray(values), dtype=kind, device=device) for values, kind in inputs]
    dtypes = dtype if isinstance(dtype, tuple) else (dtype,)
    count = max(len(a) for a in arrays)
    out = [wp.zeros(count, dtype=kind, device=device) for kind in dtypes]
    wp.launch(kernel, count, arrays, out, device=device)
    return [o.numpy() for o in out] if isinstance(dtype, tuple) else out[0].numpy()


def make_view(orthographic: bool, rng: np.random.Generator | None = None) -> np.ndarray:
    row = np.zeros(1, dtype=View.numpy_dtype())
    row["scale"], row["center"] = (900.0, -910.0), (641.3, 355.1)
    row["near"], row["far"], row["projection"] = 0.1, 1000.0, int(orthographic)
    if orthographic:
        row["scale"] = (20.0, -21.0)
        row["near"] = -3.0
    rotation = np.eye(3)
    if rng is not None:
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
    row["rotation"] = rotation
    return row


def test_snap_rounds_halves_up_and_clamps(device, rng):
    values = rng.uniform(-40000.0, 40000.0, 50_000).astype(np.float32)
    small = rng.uniform(-300.0, 300.0, 50_000).astype(np.float32)
    ties = (np.arange(-1001, 1001, 2) / 512.0).astype(np.float32)
    values = np.concatenate([values, small, ties])
    expected = np.floor(np.clip(values.astype(float), -32768.0, 32768.0) * 256.0 + 0.5)
    got = run(snap_kernel, [(values, wp.float32)], wp.int32, device)
    # Beyond 2^23 sub-pixels a float has no halves: adding one half may round to even there, by one sub-pixel.
    far = np.abs(values) > 2.0**14
    assert np.array_equal(got[~far], expected[~far])
    assert np.abs(got - expected).max() <= 1
    assert np.array_equal(got[-len(ties) :], (np.arange(-1001, 1001, 2) + 1) // 2)


def test_snap_of_extremes_stays_in_the_guard_band(device):
    values = np.array([np.inf, -np.inf, np.nan, 3e38, -3e38, 32768.0, -32768.0, -0.0, 1e-45], np.float32)
    got = run(snap_kernel, [(values, wp.float32)], wp.int32, device)
    limit = 32768 * 256
    assert got[[0, 1, 3, 4, 5, 6, 7, 8]].tolist() == [limit, -limit, limit, -limit, limit, -limit, 0, 0]
    assert -limit <= got[2] <= limit


def test_pixel_range_holds_exactly_the_centres(device):
    values = np.arange(-2000, 2000)
    first, last = run(pixel_kernel, [(values, wp.int32)], wp.vec2i, device).T
    centres = np.arange(-20, 20) * 256 + 128
    for value, low, high in zip(values, first, last, strict=True):
        assert low == np.flatnonzero(centres >= value)[0] - 20
        assert high == np.flatnonzero(centres <= value)[-1] - 20


def test_r3_edge_threshold_gives_each_edge_to_one_side(device):
    steps = np.array([(a, b) for a in range(-3, 4) for b in range(-3, 4) if (a, b) != (0, 0)])
    got = run(threshold_kernel, [(steps, wp.vec2i)], wp.int32, device)
    back = run(threshold_kernel, [(-steps, wp.vec2i)], wp.int32, device)
    # An edge seen from its two triangles steps the opposite way; exactly one of them owns its points.
    assert np.array_equal(got + back, np.ones(len(steps)))
    # y down, inside where the value is >= 0: it grows to the right across a left edge, downwards across a top edge.
    assert got[(steps == (1, 0)).all(axis=1)] == 0 and got[(steps == (-1, 0)).all(axis=1)] == 1
    assert got[(steps == (0, 1)).all(axis=1)] == 0 and got[(steps == (0, -1)).all(axis=1)] == 1


def test_fragment_depth_is_exact_to_a_few_ulp(device, rng):
    count = 100_000
    edges = (rng.random((count, 3)) * 2.0 ** rng.integers(0, 40, (count, 3))).astype(np.int64)
    edges[:, 0] += 1
    area = edges.sum(axis=1)
    z = (2.0 ** rng.uniform(-60.0, 0.0, (count, 3))).astype(np.float32)
    inputs = [(edges.astype(np.float32), wp.vec3), (area.astype(np.float32), wp.float32), (z, wp.vec3)]
    got = run(fragment_kernel, inputs, wp.float32, device).astype(float)
    exact = (edges * z.astype(float)).sum(axis=1) / area
    assert (got >= 0.0).all()
    # Products, two sums, the conversions, the reciprocal and its product: at most seven roundings of 2^-24.
    assert np.abs(got / exact - 1.0).max() <= 7.0 * 2.0**-24


@pytest.mark.parametrize("orthographic", [False, True])
def test_z6_depth_comes_back(orthographic, device, rng):
    view = make_view(orthographic)
    distance = rng.uniform(-3.0, 1000.0, 50_000) if orthographic else 0.1 * 2.0 ** rng.uniform(0.0, 60.0, 50_000)
    distance = distance.astype(np.float32)
    values = run(depth_kernel, [(view, View), (distance, wp.float32)], wp.vec4, device).astype(float)
    z, back, accepted, bits = values.T
    if orthographic:
        assert np.abs(back - distance).max() <= 4.0 * 2.0**-24 * 1003.0
    else:
        assert np.abs(back / distance - 1.0).max() <= 2e-7
        assert (z <= 1.0 + 2**-23).all()
    assert np.array_equal(bits, z) and (accepted[z <= 1.0] == z[z <= 1.0]).all()
    twin = reference.linear_depth(z, near=float(view["near"][0]), far=1000.0, orthographic=orthographic)
    assert (np.abs(back - twin) <= (4.0 * 2.0**-24 * 1003.0 if orthographic else 2e-7 * twin)).all()


def test_z6_cleared_depth_is_infinitely_far(device):
    # A distance of +inf has depth 0, the clear value, which decodes to +inf.
    values = run(depth_kernel, [(make_view(False), View), ([np.inf], wp.float32)], wp.vec4, device)
    assert values[0, 0] == 0.0 and values[0, 1] == np.inf


def test_z4_bad_depth_has_a_rule(device):
    distance = np.array([2000.0, -4.0, np.nan, 3.0, -3.0, 1000.0], np.float32)
    view = make_view(True)
    clipped = run(depth_kernel, [(view, View), (distance, wp.float32)], wp.vec4, device)[:, 2]
    view["depth_clamp"] = 1
    clamped = run(depth_kernel, [(view, View), (distance, wp.float32)], wp.vec4, device)[:, 2]
    assert clipped[[0, 1]].tolist() == [-1.0, -1.0] and clamped[[0, 1]].tolist() == [0.0, 1.0]
    assert clipped[4] == clamped[4] == 1.0 and clipped[5] == clamped[5] == 0.0
    # NaN is not drawn, be it clipped or clamped.
    assert clipped[2] == clamped[2] == -1.0


@pytest.mark.parametrize("orthographic", [False, True])
def test_z6_position_from_depth(orthographic, device, rng):
    view = make_view(orthographic, rng)
    count = 20_000
    pixels = np.stack([rng.uniform(0, 1280, count), rng.uniform(0, 720, count), 2.0 ** rng.uniform(-3, 17, count)], 1)
    pixels = pixels.astype(np.float32)
    points, directions = run(position_kernel, [(view, View), (pixels, wp.vec3)], (wp.vec3, wp.vec3), device)
    x, y, d = pixels.astype(float).T
    scale, center = view["scale"][0].astype(float), view["center"][0].astype(float)
    ray = np.stack([(x - center[0]) / scale[0], (y - center[1]) / scale[1], -np.ones(count)], axis=1)
    ray = np.concatenate([ray[:, :2], -d[:, None]], axis=1) if orthographic else ray * d[:, None]
    rotation = view["rotation"][0].astype(float)
    exact = ray @ rotation
    length = np.linalg.norm(exact, axis=1)
    assert (np.linalg.norm(points - exact, axis=1) / length).max() <= 4e-7
    towards = np.broadcast_to(rotation[2], exact.shape) if orthographic else -exact / length[:, None]
    assert np.abs(directions - towards).max() <= 1e-6


def random_corners(rng: np.random.Generator, count: int) -> np.ndarray:
    """Triangles around the origin pixel in homogeneous pixel coordinates, w from 0.1 to 4, sizes over ten octaves."""
    rows = np.zeros(count, dtype=Corner.numpy_dtype())
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    points = rng.normal(size=(count, 3, 2)) * 2.0 ** rng.uniform(0.0, 10.0, (count, 1, 1))
    points -= (weights[:, :, None] * points).sum(axis=1, keepdims=True)
    w = rng.uniform(0.1, 4.0, (count, 3))
    for k, name in enumerate("abc"):
        rows[name][:, :2] = points[:, k] * w[:, k, None]
        rows[name][:, 2] = w[:, k]
    for name in "uvw":
        rows[name] = rng.uniform(-5e3, 5e3, (count, 4))
    return rows


def exact_weights(rows: np.ndarray, offset=(0.0, 0.0)) -> np.ndarray:
    """Perspective-correct weights at a place near the pixel, in float64, by solving for them."""
    corners = np.stack([rows[n].astype(float) for n in "abc"], axis=2)
    place = np.array([*offset, 1.0])
    solved = np.linalg.solve(corners, np.broadcast_to(place, (len(rows), 3))[..., None])[..., 0]
    return solved / solved.sum(axis=1, keepdims=True)


def test_i1_weights_equal_the_float64_solution(device, rng):
    rows = random_corners(rng, 20_000)
    exact = exact_weights(rows)
    got, _ = run(interpolate_kernel, [(rows, Corner)], (Barycentric, wp.vec4), device)
    xy = [rows[n][:, :2].astype(float) / rows[n][:, 2:].astype(float) for n in "abc"]
    span = np.max([np.linalg.norm(xy[k] - xy[k - 1], axis=1) for k in range(3)], axis=0)
    u, v = xy[1] - xy[0], xy[2] - xy[0]
    height = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / span
    # Rounding moves a vertex by about 2^-23 of its distance; a sliver of that height turns it into weight.
    assert (np.abs(got["weight"] - exact).max(axis=1) * np.minimum(height / span, 1.0)).max() <= 2e-6
    fat = height > 0.2 * span
    assert fat.mean() > 0.3
    for axis, name in enumerate(("ddx", "ddy")):
        delta = 1e-5
        high = exact_weights(rows[fat], (delta, 0.0) if axis == 0 else (0.0, delta))
        low = exact_weights(rows[fat], (-delta, 0.0) if axis == 0 else (0.0, -delta))
        slope = (high - low) / (2.0 * delta)
        size = np.abs(slope).max(axis=1, keepdims=True) + 1.0 / span[fat, None]
        assert (np.abs(got[name][fat] - slope) / size).max() <= 1e-3, name


def test_i2_a_constant_stays_exactly_constant(device, rng):
    rows = random_corners(rng, 5000)
    rows["v"] = rows["w"] = rows["u"]
    _, values = run(interpolate_kernel, [(rows, Corner)], (Barycentric, wp.vec4), device)
    assert np.array_equal(values, rows["u"])


def test_i3_attributes_never_leave_their_range(device, rng):
    rows = random_corners(rng, 5000)
    # Pixels far outside and grazing triangles: what clipping and snapping can ask for.
    for name in "abc":
        rows[name][::2, :2] += 100.0 * rng.normal(size=(2500, 2)).astype(np.float32)
        rows[name][::3, 2] *= np.where(rng.random(len(rows[::3])) < 0.5, 1e-6, -1.0).astype(np.float32)
    rows["c"][::5] = rows["a"][::5]
    got, values = run(interpolate_kernel, [(rows, Corner)], (Barycentric, wp.vec4), device)
    stack = np.stack([rows["u"], rows["v"], rows["w"]])
    assert (values >= stack.min(axis=0)).all() and (values <= stack.max(axis=0)).all()
    assert (got["weight"] >= 0.0).all() and np.abs(got["weight"].sum(axis=1) - 1.0).max() < 1e-6
    assert all(np.isfinite(got[name]).all() for name in ("weight", "ddx", "ddy"))


def test_i1_huge_attributes_do_not_overflow(device, rng):
    rows = random_corners(rng, 2000)
    for name in "uvw":
        rows[name] = rng.uniform(-1.0, 1.0, (2000, 4)) * 2.0**125
    _, values = run(interpolate_kernel, [(rows, Corner)], (Barycentric, wp.vec4), device)
    stack = np.stack([rows["u"], rows["v"], rows["w"]])
    assert (values >= stack.min(axis=0)).all() and (values <= stack.max(axis=0)).all()


def test_p5_turning_the_vertices_changes_only_rounding(device, rng):
    rows = random_corners(rng, 5000)
    turned = rows.copy()
    for new, old in zip("abcuvw", "bcavwu", strict=True):
        turned[new] = rows[old]
    got, values = run(interpolate_kernel, [(rows, Corner)], (Barycentric, wp.vec4), device)
    other, values_turned = run(interpolate_kernel, [(turned, Corner)], (Barycentric, wp.vec4), device)
    assert np.abs(got["weight"] - other["weight"][:, [2, 0, 1]]).max() <= 2.0 * 2.0**-23
    assert np.abs(values - values_turned).max() <= 1e4 * 4.0 * 2.0**-23


def test_t9_anchor_is_on_its_grid_and_near_the_eye(device, rng):
    row = np.zeros(1, dtype=Instance.numpy_dtype())
    row["bounds_low"], row["bounds_high"], row["anchor_grid"] = (-5.0, 0.0, -90.0), (7.0, 3.0, 11.0), 0.125
    eyes = np.concatenate([rng.normal(size=(2000, 3)) * 2.0 ** rng.uniform(-4, 40, (2000, 1)), [[np.nan, 0.0, np.inf]]])
    anchors = run(anchor_kernel, [(row, Instance), (eyes, wp.vec3d)], wp.vec3d, device)
    assert np.isfinite(anchors).all() and np.array_equal(anchors, np.round(anchors * 8.0) / 8.0)
    assert (anchors.astype(np.float32) == anchors).all()
    nearest = np.clip(eyes[:-1], row["bounds_low"], row["bounds_high"])
    assert np.abs(anchors[:-1] - nearest).max() <= 0.0625
    # What is translated by multiples of the grid keeps its anchor, relative to itself, to the bit.
    moved = row.copy()
    shift = np.array([1024.0, -4096.0, 0.125])
    moved["bounds_low"], moved["bounds_high"] = row["bounds_low"] + shift, row["bounds_high"] + shift
    near = np.round(eyes[np.abs(eyes).max(axis=1) < 1e3] * 2.0**20) / 2.0**20
    one = run(anchor_kernel, [(row, Instance), (near, wp.vec3d)], wp.vec3d, device)
    two = run(anchor_kernel, [(moved, Instance), (near + shift, wp.vec3d)], wp.vec3d, device)
    assert np.array_equal(one + shift, two)


def test_threads_find_their_pixels_by_blocks(device):
    blocks = np.int32([[0, 0, 0, 0], [2, 8, 16, 5], [1, 32760, 24, 0]])
    out = wp.zeros(3 * 64, dtype=wp.vec3i, device=device)
    wp.launch(
        place_kernel, 3 * 64, inputs=[wp.array(blocks, dtype=wp.vec4i, device=device)], outputs=[out], device=device
    )
    y, x = np.mgrid[0:8, 0:8]
    expected = [np.stack([0 * x + view, left + x, top + y], axis=-1).reshape(-1, 3) for view, left, top, _ in blocks]
    assert np.array_equal(out.numpy(), np.concatenate(expected))
