"""The arithmetic of shadow look-ups: biases, filters and splits against exact values."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels.shadow import split_depth, step_above, step_below
from warp_deferred.kernels.shadow_filters import disc_factor, hard_factor, mean_blocker, pcf_factor
from warp_deferred.kernels.shadow_lookup import biased_depth, face_of
from warp_deferred.kernels.structs import ShadowMaps

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def bias_kernel(rows: wp.array2d[wp.float32], out_values: wp.array[wp.float32]):
    i = wp.tid()
    out_values[i] = biased_depth(rows[i, 0], rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3])


@wp.kernel
def step_kernel(values: wp.array[wp.float32], out_steps: wp.array[wp.vec2]):
    i = wp.tid()
    out_steps[i] = wp.vec2(step_below(values[i]), step_above(values[i]))


@wp.kernel
def split_kernel(near: wp.float32, far: wp.float32, blend: wp.float32, parts: wp.int32, out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = split_depth(near, far, i, parts, blend)


@wp.kernel
def face_kernel(directions: wp.array[wp.vec3], out_faces: wp.array[wp.int32]):
    i = wp.tid()
    out_faces[i] = face_of(directions[i])


@wp.kernel
def filter_kernel(
    maps: ShadowMaps, tile: wp.vec4i, places: wp.array[wp.vec2], z: wp.float32, radius: wp.float32,
    out_values: wp.array[wp.vec4],
):  # fmt: skip
    i = wp.tid()
    u, v = places[i][0], places[i][1]
    out_values[i] = wp.vec4(
        hard_factor(maps, tile, u, v, z),
        pcf_factor(maps, tile, u, v, z),
        disc_factor(maps, tile, u, v, z, wp.vec2(0.0, 0.0), radius),
        mean_blocker(maps, tile, u, v, z, wp.vec2(0.0, 0.0), radius),
    )


def test_s3_depth_bias_has_exact_values(device):
    cases = [
        # z, units, slope term, limit -> depth
        (0.25, 8388608.0, 0.0, 0.0, 0.5),
        (0.25, 8388608.0, 0.0, 0.125, 0.375),
        (0.25, -8388608.0, 0.0, 0.0, 0.0),
        (0.25, -8388608.0, 0.0, -0.125, 0.125),
        # A quad tilted by half a depth a pixel, slope factors 1 and -0.5.
        (0.25, 0.0, 0.5, 0.0, 0.75),
        (0.25, 0.0, -0.25, 0.0, 0.0),
        (0.25, 0.0, 0.0, 0.0, 0.25),
    ]
    rows = wp.array(np.array([c[:4] for c in cases], np.float32), dtype=wp.float32, device=device)
    result = wp.zeros(len(cases), dtype=wp.float32, device=device)
    wp.launch(bias_kernel, len(cases), inputs=[rows], outputs=[result], device=device)
    assert np.array_equal(result.numpy(), np.array([c[4] for c in cases], np.float32))


def filtered(keys, places, z, radius, device):
    """(hard, pcf, disc, mean blocker) at places [texel] of a square map."""
    maps = ShadowMaps()
    # Texels outside the map hold the opposite, so that a read past its rim shows.
    side = len(keys)
    padded = np.concatenate([[1.0 - keys.flat[0]] * 7, keys.reshape(-1), [1.0 - keys.flat[0]] * 7]).astype(np.float32)
    maps.keys = wp.array(padded.view(np.uint32), dtype=wp.uint32, device=device)
    maps.first, maps.rows = wp.zeros(1, dtype=wp.int32, device=device), wp.zeros(1, dtype=wp.vec4, device=device)
    maps.tiles = wp.zeros(1, dtype=wp.vec4i, device=device)
    result = wp.zeros(len(places), dtype=wp.vec4, device=device)
    inputs = [maps, wp.vec4i(7, side, 0, 0), wp.array(places, dtype=wp.vec2, device=device), z, radius]
    wp.launch(filter_kernel, len(places), inputs=inputs, outputs=[result], device=device)
    return result.numpy()


def places_in(side, rng, count=4000):
    places = rng.uniform(0.0, side, (count, 2)).astype(np.float32)
    return np.concatenate([places, [[0, 0], [side, side], [0.5, 0.5], [3.0, 3.0], [3.5, 2.5]]]).astype(np.float32)


@pytest.mark.parametrize("radius", [1.5, 4.0, 13.7, 32.0])
def test_s7_all_lit_is_one_and_all_dark_is_zero(radius, rng, device):
    places = places_in(64, rng)
    lit = filtered(np.full((64, 64), 0.25), places, 0.5, radius, device)
    assert np.all(lit[:, :3] == 1.0) and np.all(lit[:, 3] == -1.0)
    dark = filtered(np.full((64, 64), 0.75), places, 0.5, radius, device)
    assert np.all(dark[:, :3] == 0.0) and np.allclose(dark[:, 3], 0.75, rtol=1e-6)


def test_pcf_is_a_tent_over_bilinear_weights(rng, device):
    keys = np.where(rng.random((32, 32)) < 0.5, 0.75, 0.25)
    places = rng.uniform(3.0, 29.0, (500, 2)).astype(np.float32)
    got = filtered(keys, places, 0.5, 1.5, device)[:, 1]
    base = np.floor(places - 0.5).astype(int)
    f = np.floor((places - 0.5 - base) * 256.0) / 256.0
    w = np.stack([1 - f, 2 - f, 1 + f, f], axis=1) / 4.0
    lit = (keys <= 0.5).astype(float)
    expected = [
        sum(w[n, j, 1] * w[n, i, 0] * lit[y - 1 + j, x - 1 + i] for j in range(4) for i in range(4))
        for n, (x, y) in enumerate(base)
    ]
    assert np.array_equal(got, np.float32(expected))


def test_the_disc_follows_the_area_it_covers(rng, device):
    keys = np.zeros((128, 128))
    keys[:, :64] = 1.0
    radius = 20.0
    x = np.linspace(30.0, 98.0, 200).astype(np.float32)
    got = filtered(keys, np.stack([x, np.full(200, 64.0, np.float32)], axis=1), 0.5, radius, device)[:, 2]
    d = np.clip((x - 64.0) / radius, -1.0, 1.0)
    area = 0.5 + (d * np.sqrt(1.0 - d * d) + np.arcsin(d)) / np.pi
    # The lattice has a tap every 4 texels: half of one is 2 / (pi 20) of the area at the steepest place.
    assert np.abs(got - area).max() < 0.05
    assert np.all(np.diff(got) >= -1e-6)


def test_steps_enclose_what_they_are_made_from(rng, device):
    values = np.exp(rng.uniform(-20.0, 20.0, 1000)).astype(np.float32)
    result = wp.zeros(1000, dtype=wp.vec2, device=device)
    wp.launch(step_kernel, 1000, inputs=[wp.array(values, device=device)], outputs=[result], device=device)
    low, high = result.numpy().T
    assert np.all(low <= values) and np.all(values < high)
    assert np.allclose(high / low, np.sqrt(2.0), rtol=1e-6)
    assert np.allclose(np.log2(low) * 2.0, np.round(np.log2(low) * 2.0), atol=1e-5)


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_splits_follow_the_practical_scheme(parts, device):
    near, far = 0.25, 180.0
    for blend in (0.0, 0.5, 0.85, 1.0):
        result = wp.zeros(parts + 1, dtype=wp.float32, device=device)
        wp.launch(split_kernel, parts + 1, inputs=[near, far, blend, parts], outputs=[result], device=device)
        k = np.arange(parts + 1) / parts
        expected = blend * near * (far / near) ** k + (1.0 - blend) * (near + (far - near) * k)
        assert np.allclose(result.numpy(), expected, rtol=1e-5)


def test_faces_are_those_directions_go_through(rng, device):
    directions = rng.normal(size=(2000, 3)).astype(np.float32)
    result = wp.zeros(2000, dtype=wp.int32, device=device)
    inputs = [wp.array(directions, dtype=wp.vec3, device=device)]
    wp.launch(face_kernel, 2000, inputs=inputs, outputs=[result], device=device)
    axis = np.abs(directions).argmax(axis=1)
    expected = 2 * axis + (directions[np.arange(2000), axis] < 0.0)
    assert np.array_equal(result.numpy(), expected)
