"""Properties that hold for whatever hypothesis draws: P1 to P13, culling against brute force, exact coverage.

Two profiles (conftest.py): `ci`, few examples, the same in every run; `stress`, thousands: `make stress`. What fails is
kept in .hypothesis and tried again first. An example draws a seed and a few choices; NumPy makes the rest of it, so
that one example is many triangles or lights.
"""

from __future__ import annotations

import functools

import numpy as np
import reference
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pixel_scenes import (
    TWO_SIDED,
    assert_same,
    at_pixels,
    grid_triangles,
    loose_mesh,
    pixel_camera,
    render,
    scene_of,
    snapped,
)

import warp_deferred as wd

SIZE = 48
seeds = st.integers(0, 2**32 - 1)
#: The device comes from a fixture that holds no state.
ON_DEVICES = {"suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]}


def examples(factor: float):
    """Run a multiple of the profile's number of examples."""
    return settings(max_examples=max(4, int(settings.default.max_examples * factor)), **ON_DEVICES)


def drawn(triangles_px, depth, device, **fields):
    """Ids, depth and attributes of triangles (m, 3, 2) in pixels, at depths that broadcast over (m, 3)."""
    depth = np.broadcast_to(depth, triangles_px.shape[:2])
    mesh = loose_mesh(at_pixels(triangles_px, SIZE, SIZE, depth), **fields)
    material = TWO_SIDED.replace(base_color=(1.0, 1.0, 1.0, 1.0)) if fields else TWO_SIDED
    return render(scene_of(mesh, material=material), pixel_camera(SIZE), SIZE, SIZE, device=device)


def some_triangles(rng, count):
    """Triangles (count, 3, 2) on the sub-pixel grid: slivers, tiny, large, with vertices on centres and corners."""
    center = rng.uniform(-8.0, SIZE + 8.0, (count, 1, 2))
    corners = center + rng.normal(size=(count, 3, 2)) * 2.0 ** rng.uniform(-2.0, 7.0, (count, 1, 1))
    sliver = rng.random(count) < 0.2
    corners[sliver, 2] = corners[sliver, 1] + rng.uniform(-0.3, 0.3, (sliver.sum(), 2))
    corners = snapped(corners) / 256.0
    # Half of them have vertices exactly on pixel centres or corners, where the top-left rule decides.
    on_grid = rng.random(count) < 0.5
    corners[on_grid] = np.floor(corners[on_grid]) + rng.choice([0.0, 0.5], (on_grid.sum(), 1, 1))
    return corners


# ---- coverage


@examples(1)
@given(seed=seeds, bins=st.sampled_from(["on", "off"]))
def test_r2_any_triangles_cover_what_whole_numbers_say(seed, bins, device):
    rng = np.random.default_rng(seed)
    triangles = some_triangles(rng, 100)
    mesh = loose_mesh(at_pixels(triangles, SIZE, SIZE, 1.0 + np.arange(100)[:, None] / 16.0))
    ids = render(scene_of(mesh), pixel_camera(SIZE), SIZE, SIZE, device=device, settings=(f"raster.bins={bins}",))[
        "triangle_id"
    ]
    expected = np.full((SIZE, SIZE), -1)
    for k in range(99, -1, -1):
        expected[reference.coverage_count(snapped(triangles[k : k + 1]), SIZE, SIZE) > 0] = k
    assert np.array_equal(ids, expected)


@examples(1)
@given(seed=seeds, turned=st.booleans())
def test_p1_triangulations_cover_their_polygon_once(seed, turned, device):
    rng = np.random.default_rng(seed)
    columns, rows = (int(n) for n in rng.integers(2, 9, 2))
    low, high = rng.uniform(-4.0, 10.0, 2), rng.uniform(14.0, SIZE + 4.0, 2)
    x, y = np.meshgrid(np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows))
    points = np.stack([x, y], axis=-1)
    step = (high - low) / (columns - 1, rows - 1)
    points[1:-1, 1:-1] += rng.uniform(-0.2, 0.2, (rows - 2, columns - 2, 2)) * step  # more would turn triangles over
    points = snapped(points.reshape(-1, 2)) / 256.0
    triangles = points[grid_triangles(columns, rows)]
    triangles = triangles[:, ::-1] if turned else triangles
    # With depths that rise and with depths that fall a pixel covered twice would show two ids.
    depth = 1.0 + np.arange(len(triangles))[:, None] * (8.0 / len(triangles))
    up, down = (drawn(triangles, d, device)["triangle_id"] for d in (depth, depth[::-1]))
    corners = points[[0, columns - 1, rows * columns - 1, (rows - 1) * columns]]
    assert np.array_equal(up, down)
    assert np.array_equal(up >= 0, reference.polygon_coverage(snapped(corners), SIZE, SIZE))


@examples(0.5)
@given(seed=seeds)
def test_p1_closed_meshes_have_one_outline(seed, device):
    rng = np.random.default_rng(seed)
    ball = reference.sphere(1.0, int(rng.integers(3, 12)), int(rng.integers(3, 16)))
    stretch = rng.normal(size=(3, 3)) + 2.0 * np.eye(3)
    eye = reference.unit(rng.normal(size=3)) * 9.0
    camera = wd.Camera.look_at(tuple(eye), (0.0, 0.0, 0.0), near=0.05)
    mesh = wd.Mesh((ball.positions @ stretch.T).astype(np.float32), ball.triangles)
    scene = scene_of(mesh, material=wd.Material(model="lambert"))
    front, back = (
        render(scene, camera, SIZE, SIZE, device=device, settings=(f"raster.cull={cull}",))
        for cull in ("back", "front")
    )
    assert np.array_equal(front["triangle_id"] >= 0, back["triangle_id"] >= 0)
    seen = front["triangle_id"] >= 0
    assert seen.any()


@examples(1)
@given(seed=seeds)
def test_p13_any_triangle_cut_in_four_covers_the_same(seed, device):
    rng = np.random.default_rng(seed)
    corners = rng.integers(-SIZE, 2 * SIZE, (3, 2)) * 2.0
    a, b, c = corners
    ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
    parts = np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]) / 2.0
    tint = rng.uniform(0.2, 0.8, (3, 4)).astype(np.float32)
    ta, tb, tc = tint
    tab, tbc, tca = (ta + tb) / 2.0, (tb + tc) / 2.0, (tc + ta) / 2.0
    whole = drawn(corners[None] / 2.0, 8.0, device, colors=tint)
    quarters = drawn(
        parts, 8.0, device, colors=np.concatenate([[ta, tab, tca], [tab, tb, tbc], [tca, tbc, tc], [tab, tbc, tca]])
    )
    assert np.array_equal(whole["triangle_id"] >= 0, quarters["triangle_id"] >= 0)
    assert np.abs(whole["albedo"] - quarters["albedo"]).max() <= 1e-6


# ---- order, layout, place, scale


@examples(1)
@given(seed=seeds)
def test_p2_any_order_of_triangles_shows_the_same(seed, device):
    rng = np.random.default_rng(seed)
    triangles, depth = some_triangles(rng, 40), 1.0 + rng.permutation(40)[:, None] * 0.3
    # Some twice, in one place: of those either id may show, but nothing else differs.
    source = np.concatenate([np.arange(40), rng.integers(0, 40, 10)])
    order = rng.permutation(50)
    one = drawn(triangles[source], depth[source], device)
    two = drawn(triangles[source[order]], depth[source[order]], device)
    for image, names in ((one, source), (two, source[order])):
        seen = image["triangle_id"] >= 0
        image["triangle_id"][seen] = names[image["triangle_id"][seen]]
    assert_same(one, two)


@examples(0.5)
@given(
    seed=seeds,
    tile=st.sampled_from([8, 16, 32, 64]),
    rung=st.sampled_from(["tiles", "tiles_depth", "brute_force"]),
    bins=st.sampled_from(["on", "off"]),
    capacity=st.integers(0, 200),
    threads=st.integers(1, 5),
    share=st.booleans(),
)
def test_p3_how_the_work_is_cut_does_not_show(seed, tile, rung, bins, capacity, threads, share, device):
    rng = np.random.default_rng(seed)
    triangles = some_triangles(rng, 60)
    scene = scene_of(loose_mesh(at_pixels(triangles, SIZE, SIZE, rng.uniform(1.0, 15.0, (60, 3)))))
    for place in rng.uniform(-24.0, 24.0, (20, 2)):
        scene.lights.add(wd.PointLight(position=(*place, -rng.uniform(0.0, 16.0)), intensity=50.0, range=12.0))
    changes = (
        f"light_culling.tile_size={tile}", f"light_culling.rung={rung}", f"raster.bins={bins}",
        f"raster.large_capacity={capacity}", f"raster.bin_capacity={capacity}",
    )  # fmt: skip
    names = ("color", "depth", "triangle_id")
    fields = {"outputs": names, "device": device}
    plain = render(scene, pixel_camera(SIZE), SIZE, SIZE, **fields)
    other = render(
        scene, pixel_camera(SIZE), SIZE, SIZE, settings=changes, threads=threads, share_memory=share, **fields
    )
    assert_same(plain, other)


@examples(1)
@given(seed=seeds)
def test_p5_any_turn_of_the_vertices_changes_rounding_only(seed, device):
    rng = np.random.default_rng(seed)
    triangles, depth = some_triangles(rng, 30), rng.uniform(1.0, 15.0, (30, 3))
    tint = rng.uniform(0.0, 1.0, (30, 3, 4)).astype(np.float32)
    turn = (np.arange(3)[None] + rng.integers(0, 3, (30, 1))) % 3
    rows = np.arange(30)[:, None]
    one = drawn(triangles, depth, device, colors=tint.reshape(-1, 4))
    two = drawn(triangles[rows, turn], depth[rows, turn], device, colors=tint[rows, turn].reshape(-1, 4))
    same = one["triangle_id"] == two["triangle_id"]
    # Depth is rounded otherwise, so that of two triangles that cross the other one may win right on the line.
    assert np.array_equal(one["triangle_id"] >= 0, two["triangle_id"] >= 0) and same.mean() >= 0.995
    seen = same & (one["triangle_id"] >= 0)
    assert np.abs(one["albedo"] - two["albedo"])[seen].max(initial=0.0) <= 4.0 * 2.0**-23
    flat = drawn(triangles, depth, device, colors=np.tile(tint[0, :1], (90, 1)))
    assert (flat["albedo"][flat["triangle_id"] >= 0] == tint[0, 0, :3]).all()


def lit_scene(seed, scale, shift):
    """Some triangles and lights on a grid of 2^-8 m, scaled by a power of two and moved."""
    rng = np.random.default_rng(seed)
    scene, shift = wd.Scene(), np.asarray(shift, float)
    for _ in range(3):
        corners = np.round(rng.uniform(-2.0, 2.0, (8, 3, 3)) * 256.0) / 256.0
        place = np.eye(4)
        place[:3, 3] = np.round(rng.uniform(-1.0, 1.0, 3) * 256.0) / 256.0 * scale + shift
        material = wd.Material(base_color=(0.7, 0.5, 0.3, 1.0), roughness=0.4, two_sided=True)
        scene.add(loose_mesh(corners * scale), transform=place, material=material)
    for k in range(4):
        place = np.round(rng.uniform(-3.0, 3.0, 3) * 256.0) / 256.0 * scale + shift
        scene.lights.add(
            wd.PointLight(
                position=tuple(place), intensity=(k + 1.0) * 4.0 * scale**2, range=4.0 * scale,
                source_radius=2.0**-7 * scale,
            )
        )  # fmt: skip
    eye = np.round(reference.unit(rng.normal(size=3)) * 6.0 * 256.0) / 256.0
    camera = wd.Camera.look_at(tuple(eye), (0.0, 0.0, 0.0))
    scene.camera = camera.replace(position=tuple(eye * scale + shift), near=2.0**-5 * scale)
    return scene


LIT = ("color", "depth", "triangle_id", "light_count")


@examples(0.5)
@given(seed=seeds, power=st.integers(0, 30), steps=st.tuples(*[st.integers(-3, 3)] * 3))
def test_p7_moving_everything_shows_the_same(seed, power, steps, device):
    still, moved = lit_scene(seed, 1.0, (0.0, 0.0, 0.0)), lit_scene(seed, 1.0, 2.0**power * np.array(steps))
    fields = {"outputs": LIT, "device": device}
    assert_same(render(still, still.camera, SIZE, SIZE, **fields), render(moved, moved.camera, SIZE, SIZE, **fields))


@examples(0.5)
@given(seed=seeds, power=st.integers(-10, 10))
def test_p8_scaling_everything_shows_the_same(seed, power, device):
    scale = 2.0**power
    plain, scaled = lit_scene(seed, 1.0, (0.0, 0.0, 0.0)), lit_scene(seed, scale, (0.0, 0.0, 0.0))
    fields = {"outputs": LIT, "device": device}
    one, two = (render(s, s.camera, SIZE, SIZE, **fields) for s in (plain, scaled))
    two["depth"] = (two["depth"] / scale).astype(np.float32)
    assert_same(one, two)


# ---- light


@functools.cache
def light_room(device):
    """A scene with lights that draws change in place, and a renderer for each way to cull; made once a device."""
    from test_hard_cases_lights import room

    scene = room()
    scene.lights.extend("point", 24)
    scene.lights.extend("spot", 24)
    changes = (
        ("light_culling.rung=brute_force",),
        ("light_culling.rung=tiles",),
        ("light_culling.rung=tiles_depth", "light_culling.tile_size=8"),
    )
    renderers = [
        wd.Renderer(
            scene, width=37, height=29, device=device, outputs=("color", "light_count"),
            settings=wd.Settings().with_values(list(c)),
        )
        for c in changes
    ]  # fmt: skip
    return scene, renderers


def draw_lights(scene, rng):
    """Change every light of the room, and return a camera."""
    center = rng.uniform((-8.0, -0.5, -14.0), (8.0, 5.0, 9.0))
    for kind in ("point", "spot"):
        group = getattr(scene.lights, kind)
        count = len(group)
        spread = 10.0 ** rng.uniform(-2.0, 1.0)
        group.position = center + rng.normal(size=(count, 3)) * spread
        group.range = 10.0 ** rng.uniform(-2.0, 2.0, count)
        group.intensity = 10.0 ** rng.uniform(-3.0, 4.0, count)
    scene.lights.spot.direction = rng.normal(size=(24, 3))
    outer = rng.uniform(0.01, 1.55, 24)
    scene.lights.spot.inner_angle, scene.lights.spot.outer_angle = 0.0 * outer, outer
    eye = rng.uniform((-4.0, 0.1, -6.0), (4.0, 4.0, 8.0))
    if rng.random() < 0.3:
        return wd.Camera.look_at(
            tuple(eye), tuple(center), projection="orthographic", vertical_extent=float(rng.uniform(0.5, 20.0)),
            near=-5.0, far=40.0,
        )  # fmt: skip
    return wd.Camera.look_at(tuple(eye), tuple(center), vertical_fov=float(rng.uniform(0.1, 2.5)), near=0.01)


@examples(10)
@given(seed=seeds)
def test_c1_any_lights_are_culled_without_a_trace(seed, device):
    scene, renderers = light_room(device)
    camera = draw_lights(scene, np.random.default_rng(seed))
    images = []
    for renderer in renderers:
        frame = renderer.render(camera)
        images.append({name: frame.numpy(name)[0] for name in ("color", "light_count")})
    for image in images[1:]:
        assert_same(images[0], image)


@examples(1)
@given(seed=seeds)
def test_p6_any_lights_that_reach_nothing_change_nothing(seed, device):
    scene, renderers = light_room(device)
    rng = np.random.default_rng(seed)
    camera = draw_lights(scene, rng)
    chosen = rng.random(24) < 0.5
    before = np.array(scene.lights.point.intensity)
    scene.lights.point.intensity = np.where(chosen, 0.0, before)
    plain = renderers[2].render(camera).numpy("color")
    # Back on, but out of reach of everything: behind the camera's back, as far as the room is deep.
    scene.lights.point.intensity = before
    places = np.array(scene.lights.point.position)
    places[chosen] = (0.0, 500.0, 0.0)
    scene.lights.point.position = places
    assert np.array_equal(plain, renderers[2].render(camera).numpy("color"))


@examples(1)
@given(seed=seeds)
def test_p10_twice_the_light_is_twice_the_colour(seed, device):
    scene, renderers = light_room(device)
    camera = draw_lights(scene, np.random.default_rng(seed))
    one = renderers[2].render(camera).numpy("color")
    for _, group in scene.lights.groups():
        if len(group):
            group.intensity = 2.0 * np.array(group.intensity)
    two = renderers[2].render(camera).numpy("color")
    # What is subnormal has fewer bits to double.
    normal = one > 1e-36
    assert np.array_equal(two[normal], 2.0 * one[normal])
