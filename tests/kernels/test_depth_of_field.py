"""The functions of depth of field against NumPy: circles of confusion, points of the lens, reduced images."""

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels import depth_of_field_pack as pack
from warp_deferred.kernels import lens, lens_layers
from warp_deferred.kernels.structs import View

import warp_deferred as wd
from warp_deferred.passes.depth_of_field import blur_weights
from warp_deferred.views import ViewLayout, ViewPacker, ViewSize

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
SIZE = (160, 90)


@wp.kernel
def circle_kernel(
    views: wp.array[View], depth: wp.array[wp.float32], limit: wp.float32, out_radius: wp.array[wp.float32]
):
    i = wp.tid()
    out_radius[i] = lens.circle_of_confusion(lens.lens_terms(views[0]), depth[i], limit)


@wp.kernel
def project_kernel(
    views: wp.array[View],
    square: wp.array[wp.vec2],
    points: wp.array[wp.vec3],
    out_disc: wp.array[wp.vec2],
    out_pixel: wp.array[wp.vec2],
):
    i = wp.tid()
    disc = lens.disc_point(square[i][0], square[i][1])
    view = lens.through_lens(views[0], disc)
    origin = wp.vec3(wp.float32(view.origin[0]), wp.float32(view.origin[1]), wp.float32(view.origin[2]))
    p = view.rotation * (points[i] - origin)
    out_disc[i] = disc
    out_pixel[i] = wp.cw_mul(view.scale, wp.vec2(p[0], p[1])) / -p[2] + view.center


@wp.kernel
def merge_kernel(children: wp.array2d[wp.vec4], out_texel: wp.array[wp.vec4]):
    i = wp.tid()
    out_texel[i] = lens_layers.merged(children[i, 0], children[i, 1], children[i, 2], children[i, 3])


def views_of(camera, device):
    """One camera as the renderer packs it."""
    packer = ViewPacker(ViewLayout((ViewSize(*SIZE),), 16), "back")
    block = bytearray(packer.size)
    packer.write(memoryview(block), [camera], [(0,) * 7])
    row = np.frombuffer(block, np.dtype(View.numpy_dtype()))
    return wp.array(row, dtype=View, device=device), row[0]


def circles(camera, depths, limit, device):
    views, _ = views_of(camera, device)
    out = wp.zeros(len(depths), dtype=wp.float32, device=device)
    inputs = [views, wp.array(np.float32(depths), dtype=wp.float32, device=device), limit]
    wp.launch(circle_kernel, len(depths), inputs=inputs, outputs=[out], device=device)
    return out.numpy()


@pytest.mark.parametrize("focus", [0.06, 2.5, 1e9])
def test_f3_circles_of_confusion_follow_the_closed_form(focus, device):
    camera = wd.Camera(aperture=0.02, focus_distance=focus)
    fx = camera.pixel_projection(*SIZE)[0]
    depths = np.float32(np.geomspace(0.05, 1e6, 200))
    depth = depths.astype(float)
    # The diameter, A fx |z - f| / (z f), is twice the signed radius.
    expected = camera.aperture * fx * (depth - focus) / (depth * focus)
    found = 2.0 * circles(camera, depths, 1e30, device)
    scale = camera.aperture * fx * (1.0 / depth + 1.0 / focus)
    assert np.abs(expected).max() > 0.5
    assert (np.abs(found - expected) <= 1e-5 * scale).all()
    # Limits: infinitely far, at the plane in focus, and beyond the largest radius allowed.
    far, sharp = circles(camera, [np.inf, focus], 1e30, device)
    assert np.isclose(2.0 * far, camera.aperture * fx / focus, rtol=1e-5) and abs(sharp) < 1e-4
    assert np.abs(circles(camera, depths, 0.75, device)).max() == 0.75


def test_pinholes_and_parallel_rays_have_no_circles(device):
    for camera in (wd.Camera(), wd.Camera(projection="orthographic", aperture=0.5)):
        assert np.array_equal(circles(camera, [0.1, 1.0, 30.0, np.inf], 32.0, device), np.zeros(4))
        assert camera.lens_flags == 0


def test_f3_views_through_the_lens_make_the_same_circles(device, rng):
    camera = wd.Camera.look_at((1.0, 2.0, 3.0), (0.0, 0.5, -1.0), aperture=0.3, focus_distance=2.0)
    camera = camera.replace(intrinsics=(120.0, 80.0, 70.0, 50.0), image_size=SIZE)
    views, row = views_of(camera, device)
    n = 4096
    square = np.float32(rng.random((n, 2)))
    square[0] = 0.5
    depth = rng.uniform(0.7, 9.0, n)
    depth[: n // 2] = 2.0
    local = np.stack([rng.uniform(-0.5, 0.5, n) * depth, rng.uniform(-0.4, 0.4, n) * depth, -depth], axis=1)
    world = local @ np.reshape(camera.rotation, (3, 3)) + camera.position
    disc, pixel = (wp.zeros(n, dtype=wp.vec2, device=device) for _ in range(2))
    inputs = [views, wp.array(square, dtype=wp.vec2, device=device), wp.array(np.float32(world), dtype=wp.vec3,
                                                                           device=device)]  # fmt: skip
    wp.launch(project_kernel, n, inputs=inputs, outputs=[disc, pixel], device=device)
    disc, pixel = disc.numpy(), pixel.numpy()
    pinhole = local[:, :2] / depth[:, None] * row["scale"] + row["center"]
    # What lies in the plane in focus does not move; all else moves as far as its circle says.
    assert np.abs(pixel - pinhole)[: n // 2].max() < 1e-3
    shift = 0.5 * camera.aperture * (1.0 / depth - 1.0 / 2.0)[:, None] * disc * -row["scale"]
    assert np.abs(pixel - pinhole - shift).max() < 1e-3 and np.abs(shift).max() > 5.0
    # The disc is filled evenly: its middle stays, and radii squared are uniform.
    assert np.array_equal(disc[0], (0.0, 0.0))
    radius = np.hypot(*disc.T)
    assert radius.max() <= 1.0 + 1e-6
    assert np.abs(np.sort(radius**2) - (np.arange(n) + 0.5) / n).max() < 0.03
    assert np.abs(disc.mean(axis=0)).max() < 0.03


def test_reduced_texels_hold_one_side_and_no_sharp_colour(device):
    red, blue = (4.0, 0.0, 0.0), (0.0, 0.0, 2.0)
    cases = [
        ([(*red, 8.0)] * 2 + [(*blue, 0.1)] * 2, (*red, 8.0)),
        ([(*red, -8.0)] * 3 + [(*blue, 30.0)], (*red, -8.0)),
        ([(*red, -8.0)] + [(*blue, 6.0)] * 3, (*blue, 6.0)),
        ([(*red, 8.0), (*blue, 8.0)] * 2, (2.0, 0.0, 1.0, 8.0)),
        ([(*red, 0.0), (*blue, 0.5)] * 2, (2.0, 0.0, 1.0, 0.25)),
        ([(*red, 0.0)] * 4, (*red, 0.0)),
        # What is sharp votes: one child before it does not make the texel its own, nor shows in it; two or three do.
        ([(*red, -8.0)] + [(*blue, 0.25)] * 3, (*blue, 0.25)),
        ([(*red, -8.0)] * 3 + [(*blue, 0.25)], (*red, -8.0)),
        ([(*red, -8.0), (*blue, 0.0)] * 2, (*red, -8.0)),
        ([(*blue, 6.0), (*red, -8.0)] * 2, (*red, -8.0)),
    ]
    children = wp.array(np.float32([c for c, _ in cases]), dtype=wp.vec4, device=device)
    out = wp.zeros(len(cases), dtype=wp.vec4, device=device)
    wp.launch(merge_kernel, len(cases), inputs=[children], outputs=[out], device=device)
    assert np.array_equal(out.numpy(), np.float32([e for _, e in cases]))


@wp.kernel
def rows_kernel(views: wp.array[View], tiles: wp.int32, out_rows: wp.array[lens_layers.Rows]):
    i = wp.tid()
    out_rows[i] = lens_layers.rows_of(views[0], tiles, i + 1)


def test_levels_lie_one_after_the_other(device):
    views, row = views_of(wd.Camera(), device)
    tiles, out = 70, wp.zeros(3, dtype=lens_layers.Rows, device=device)
    wp.launch(rows_kernel, 3, inputs=[views, tiles], outputs=[out], device=device)
    assert (row["bins_x"], row["bin_offset"]) == (10, 0)
    found = [tuple(rows) for rows in out.numpy()]
    assert found == [(0, 80, 79, 44), (tiles * 64, 40, 39, 22), (tiles * 80, 20, 19, 11)]
    assert lens_layers.LEVEL_TEXELS == 64 + 16 + 4 and lens_layers.LAYER_TEXELS == 64


def tiles_of(device):
    """Rows (view, x, y, 0) of the 16 x 16 tiles of a view of SIZE, as the renderer makes them."""
    y, x = np.mgrid[0 : SIZE[1] : 16, 0 : SIZE[0] : 16]
    return wp.array(np.stack([0 * x, x, y, 0 * x], axis=-1).reshape(-1, 4), dtype=wp.vec4i, device=device)


@pytest.mark.parametrize("limit", [1.0, 32.0, 64.0])
def test_two_passes_dilate_like_a_square(limit, device, rng):
    views, tiles = views_of(wd.Camera(), device)[0], tiles_of(device)
    high, wide = 6, 10
    largest = np.float32(rng.uniform(0.0, limit, (high, wide)) * (rng.random((high, wide)) < 0.3))
    halves = np.stack([largest, largest * 0.5], axis=-1)
    rng.permuted(halves, axis=-1, out=halves)
    rows, reach = (wp.zeros(high * wide, dtype=wp.float32, device=device) for _ in range(2))
    nearest = wp.array(halves.ravel(), dtype=wp.float32, device=device)
    wp.launch(pack.near_rows_kernel, high * wide, [views, tiles, nearest, limit, 0], [rows], device=device)
    wp.launch(pack.near_columns_kernel, high * wide, [views, tiles, rows, limit, 0], [reach], device=device)
    y, x = np.mgrid[0:high, 0:wide]
    expected = np.zeros((high, wide), np.float32)
    for j, i in np.ndindex(high, wide):
        gap = 16.0 * np.maximum(np.maximum(abs(x - i), abs(y - j)) - 2, 0)
        expected[j, i] = np.max(largest, where=largest > gap, initial=0.0)
    assert np.array_equal(reach.numpy().reshape(high, wide), expected) and expected.max() > 0.0


def test_every_level_is_merged_from_the_one_below(device, rng):
    """Odd numbers of texels too: 160 x 90 pixels have 80 x 45, 40 x 23 and 20 x 12."""
    views, tiles = views_of(wd.Camera(aperture=0.3, focus_distance=2.0), device)[0], tiles_of(device)
    width, height = SIZE
    color = np.float32(rng.uniform(0.0, 5.0, (height, width, 3)))
    depth = np.float32(
        rng.choice([0.5, 1.9, 2.0, 2.2, 9.0, np.inf], (height // 5, width // 5)).repeat(5, 0).repeat(5, 1)
    )
    image, taps = pack.Image(), lens_layers.Taps()
    image.full = wp.array(color.reshape(-1, 3), dtype=wp.vec3, device=device)
    image.half = wp.zeros(1, dtype=wp.uint64, device=device)
    taps.half = wp.zeros(1, dtype=wp.uint64, device=device)
    taps.full = wp.zeros(60 * lens_layers.LEVEL_TEXELS, dtype=wp.vec4, device=device)
    taps.tiles = 60
    far, near, nearest = (wp.zeros(60 * n, dtype=wp.float32, device=device) for n in (64, 64, 2))
    inputs = [views, tiles, image, wp.array(depth.ravel(), dtype=wp.float32, device=device), 20.0, 0]
    kernel = pack.make_depth_of_field_pack_kernel(False)
    wp.launch(kernel, 60 * 64, inputs, [taps, far, near, nearest], device=device, block_dim=pack.BLOCK_DIM)
    radius = circles(wd.Camera(aperture=0.3, focus_distance=2.0), depth.ravel(), 20.0, device).reshape(height, width)
    below, first, found = np.concatenate([color, radius[..., None]], axis=-1), 0, taps.full.numpy()
    for level in (1, 2, 3):
        wide = (width - 1 >> level) + 1
        high = (height - 1 >> level) + 1
        pitch = 10 * (16 >> level)
        texels = found[first : first + 60 * (256 >> 2 * level)].reshape(-1, pitch, 4)[:high, :wide]
        padded = np.pad(below, ((0, 2 * high - below.shape[0]), (0, 2 * wide - below.shape[1]), (0, 0)), "edge")
        children = [padded[0::2, 0::2], padded[0::2, 1::2], padded[1::2, 0::2], padded[1::2, 1::2]]
        given = wp.array(np.stack(children, axis=2).reshape(-1, 4, 4), dtype=wp.vec4, device=device)
        merged = wp.zeros(high * wide, dtype=wp.vec4, device=device)
        wp.launch(merge_kernel, high * wide, inputs=[given], outputs=[merged], device=device)
        assert np.array_equal(merged.numpy().reshape(high, wide, 4), texels)
        below, first = texels, first + 60 * (256 >> 2 * level)
    # Largest circles of squares and of tiles' halves.
    blocks = np.pad(radius, ((0, 6), (0, 0))).reshape(6, 8, 2, 10, 8, 2).transpose(0, 3, 1, 4, 2, 5).reshape(-1, 4)
    assert np.array_equal(far.numpy(), np.maximum(blocks.max(axis=1), 0.0))
    assert np.array_equal(near.numpy(), np.maximum(-blocks.min(axis=1), 0.0))
    assert np.array_equal(nearest.numpy(), near.numpy().reshape(-1, 32).max(axis=1)) and nearest.numpy().max() == 20.0


@pytest.mark.parametrize("radius", [1, 8, 32])
def test_blur_weights_add_up_to_one(radius):
    weights = blur_weights(radius).astype(float)
    assert abs(weights[0] + 2.0 * weights[1:].sum() - 1.0) < 1e-6 and (np.diff(weights) < 0.0).all()
