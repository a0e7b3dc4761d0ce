"""Hard cases of coverage and raster paths: R rows, P1, P2, P13, L7."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from pixel_scenes import (
    FAR,
    TWO_SIDED,
    assert_same,
    at_pixels,
    cover_count,
    grid_triangles,
    in_front,
    loose_mesh,
    pixel_camera,
    render,
    scene_of,
    snapped,
)

import warp_deferred as wd

SIZE = 64


def drawn(triangles_px: np.ndarray, depth=8.0, device: str = "cpu", size: int = SIZE, settings=()) -> np.ndarray:
    """Triangle ids of triangles (m, 3, 2) in pixels; two-sided; depth (m,) or a number."""
    depth = np.broadcast_to(np.asarray(depth, float), len(triangles_px))[:, None]
    mesh = loose_mesh(at_pixels(triangles_px, size, size, depth))
    return render(scene_of(mesh), pixel_camera(size), size, size, device=device, settings=settings)["triangle_id"]


def covered_once(triangles_px: np.ndarray, device: str) -> np.ndarray:
    """Mask of covered pixels, having checked that no pixel is covered twice.

    Drawn with depths falling and with depths rising, a pixel that two triangles cover would show different ones.
    """
    depth = 1.0 + np.arange(len(triangles_px)) * (8.0 / max(len(triangles_px), 1))
    up, down = drawn(triangles_px, depth, device), drawn(triangles_px, depth[::-1], device)
    assert np.array_equal(up, down)
    return up >= 0


def rotated_quads(rng: np.random.Generator, count: int) -> np.ndarray:
    """Corners (count, 4, 2) of turned rectangles, on the sub-pixel grid."""
    angle = rng.uniform(0.0, np.pi, count)
    half = rng.uniform(1.0, 40.0, (count, 2))
    center = rng.uniform(10.0, SIZE - 10.0, (count, 1, 2))
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    local = signs[None] * half[:, None]
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    return snapped(local @ turn + center) / 256.0


def test_r1_shared_edges_of_quads_are_drawn_once(device, rng):
    for k, quad in enumerate(rotated_quads(rng, 24)):
        first, second = ([0, 1, 2], [0, 2, 3]) if k % 2 else ([0, 1, 2], [0, 3, 2])
        triangles = quad[[first, second]]
        expected = reference.polygon_coverage(snapped(quad), SIZE, SIZE)
        assert np.array_equal(covered_once(triangles, device), expected), quad


def test_r1_full_screen_quad_misses_no_pixel(device):
    quad = np.array([[0.0, 0.0], [SIZE, 0.0], [SIZE, SIZE], [0.0, SIZE]])
    assert covered_once(quad[[[0, 1, 2], [0, 2, 3]]], device).all()
    far = (quad - SIZE / 2) * 400.0 + SIZE / 2
    assert covered_once(far[[[0, 3, 1], [1, 2, 3]]], device).all()


def test_r1_perspective_grid_is_drawn_once(device, rng):
    columns = rows = 5
    camera = wd.Camera(near=0.01)
    x, y = np.meshgrid(np.linspace(-8.0, SIZE + 8.0, columns), np.linspace(-8.0, SIZE + 8.0, rows))
    points_px = np.stack([x, y], axis=-1).reshape(-1, 2)
    inner = np.abs(points_px - SIZE / 2).max(axis=1) < SIZE / 2 + 7.0
    points_px[inner] += rng.uniform(-7.0, 7.0, (inner.sum(), 2))
    # w from 0.1 to 4 at each vertex: neighbours at very different depths still share their edge.
    points = in_front(points_px, 2.0 ** rng.uniform(-3.3, 2.0, len(points_px)), camera, SIZE, SIZE)
    count = cover_count(points, grid_triangles(columns, rows), camera, SIZE, SIZE, device)
    assert (count == 1).all()


def test_r2_triangle_sets_equal_exact_coverage(device, rng):
    sets = [rng.uniform(-20.0, SIZE + 20.0, (30, 3, 2)), rng.uniform(20.0, 44.0, (60, 3, 2))]
    strip = np.stack([np.repeat(np.arange(12.0), 2) * 5.3, np.tile([10.2, 40.7], 12)], axis=1)
    strip[:, 1] += rng.uniform(-5.0, 5.0, len(strip))
    sets.append(np.stack([strip[k : k + 3] for k in range(len(strip) - 2)]))
    turn = np.linspace(0.0, 2.0 * np.pi, 24)
    rim = 32.3 + 30.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    sets.append(np.stack([np.array([[31.7, 30.2], rim[k], rim[k + 1]]) for k in range(len(rim) - 1)]))
    for triangles in sets:
        triangles = snapped(triangles) / 256.0
        ids = drawn(triangles, 1.0 + np.arange(len(triangles)) / 16.0, device)
        expected = np.full((SIZE, SIZE), -1)
        for k in range(len(triangles) - 1, -1, -1):
            expected[reference.coverage_count(snapped(triangles[k : k + 1]), SIZE, SIZE) > 0] = k
        assert np.array_equal(ids, expected)


def test_r3_vertices_on_pixel_centres(device):
    # The long side is a right or bottom edge: its centres are not inside. The short ones are left and top edges.
    triangle = np.array([[[0.5, 0.5], [8.5, 0.5], [0.5, 8.5]]])
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    assert np.array_equal(drawn(triangle, device=device) >= 0, x + y < 8)
    assert np.array_equal(drawn(triangle[:, ::-1], device=device) >= 0, x + y < 8)
    turned = np.array([[[8.5, 8.5], [0.5, 8.5], [8.5, 0.5]]])
    assert np.array_equal(drawn(turned, device=device) >= 0, (x + y >= 8) & (x < 8) & (y < 8))


def test_r3_axis_aligned_edges_through_centres(device):
    square = np.array([[10.5, 20.5], [30.5, 20.5], [30.5, 25.5], [10.5, 25.5]])
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    expected = (x >= 10) & (x < 30) & (y >= 20) & (y < 25)
    assert np.array_equal(covered_once(square[[[0, 1, 2], [0, 2, 3]]], device), expected)
    assert np.array_equal(covered_once(square[[[1, 2, 3], [1, 3, 0]]], device), expected)
    # Four triangles that meet in one centre: exactly one of them has it.
    fan = np.array([[20.5, 22.5], *square])
    ids = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]
    assert np.array_equal(covered_once(fan[ids], device), expected)


def test_r3_a_point_between_centres_covers_nothing(device):
    tiny = np.array([[[5.6, 5.6], [6.4, 5.7], [6.0, 6.4]], [[9.5, 9.5], [9.5, 9.5], [9.75, 9.5]]])
    assert (drawn(tiny, device=device) < 0).all()


def test_r4_sub_pixel_triangulation_fills_its_rectangle(device, rng):
    columns, rows = 61, 49
    x, y = np.meshgrid(np.linspace(10.5, 30.5, columns), np.linspace(4.25, 20.25, rows))
    points = np.stack([x, y], axis=-1)
    points[1:-1, 1:-1] += rng.uniform(-0.13, 0.13, (rows - 2, columns - 2, 2))
    points = snapped(points.reshape(-1, 2)) / 256.0
    triangles = points[grid_triangles(columns, rows)]
    corners = np.array([[10.5, 4.25], [30.5, 4.25], [30.5, 20.25], [10.5, 20.25]])
    expected = reference.polygon_coverage(snapped(corners), SIZE, SIZE)
    assert expected.sum() == 20 * 16
    assert np.array_equal(covered_once(triangles, device), expected)


def test_r4_slivers_equal_exact_coverage(device, rng):
    start, end = rng.uniform(0.0, SIZE, (200, 2)), rng.uniform(0.0, SIZE, (200, 2))
    third = end + rng.uniform(-0.6, 0.6, (200, 2))
    slivers = snapped(np.stack([start, end, third], axis=1)) / 256.0
    count = reference.coverage_count(snapped(slivers), SIZE, SIZE)
    assert np.array_equal(drawn(slivers, device=device) >= 0, count > 0)


def mixed_triangles(rng: np.random.Generator) -> np.ndarray:
    """Huge, large, small and tiny triangles, and some with edges exactly on tile borders."""
    center = rng.uniform(0.0, 150.0, (120, 1, 2))
    size = 2.0 ** rng.uniform(-2.0, 12.0, (120, 1, 1))
    border = np.array([[[16, 16], [48, 16], [48, 80]], [[64, 0], [64, 100], [0, 100]], [[0, 0], [160, 0], [0, 160]]])
    return snapped(np.concatenate([center + rng.normal(size=(120, 3, 2)) * size, border])) / 256.0


def mixed_mesh(rng: np.random.Generator) -> wd.Mesh:
    """Mixed triangles, tilted, the smaller ones in front, so that all sizes show."""
    triangles = mixed_triangles(rng)
    extent = np.ptp(triangles, axis=1).max(axis=1)
    depth = 1.0 + np.clip(np.log2(extent), 0.0, 13.0)[:, None] + rng.uniform(0.0, 1.0, (len(triangles), 3))
    return loose_mesh(at_pixels(triangles, 150, 130, depth))


PATHS = [
    ("raster.bins=off",),
    ("raster.bins=on",),
    ("raster.bins=on", "raster.bin_capacity=1"),
    ("raster.bins=on", "raster.large_capacity=1"),
    ("raster.bins=on", "raster.bin_capacity=40", "raster.large_capacity=40"),
]


def test_r6_raster_paths_and_capacities_give_the_same_bits(device, rng):
    mesh = mixed_mesh(rng)
    images = [
        render(scene_of(mesh), pixel_camera(130), 150, 130, settings=settings, device=device) for settings in PATHS
    ]
    for image in images[1:]:
        assert_same(images[0], image)
    assert len(np.unique(images[0]["triangle_id"])) > 20


@pytest.mark.parametrize("tile_size", [8, 32, 64])
def test_r6_light_tiles_do_not_show(tile_size, rng):
    mesh = mixed_mesh(rng)
    scene = scene_of(mesh)
    for place in rng.uniform(-70.0, 70.0, (40, 2)):
        scene.lights.add(wd.PointLight(position=(*place, -rng.uniform(0.0, 16.0)), intensity=200.0, range=30.0))
    images = [
        render(scene, pixel_camera(130), 150, 130, outputs=("color",), settings=(f"light_culling.tile_size={size}",))
        for size in (16, tile_size)
    ]
    assert_same(*images)
    assert images[0]["color"].max() > 0.0


@pytest.mark.parametrize("cull", ["back", "front", "none"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_r7_cull_mode_and_winding(cull, mirrored, device):
    one_sided = wd.Material(model="lambert")
    left = np.array([[4.0, 4.0], [4.0, 28.0], [28.0, 28.0]])  # counter-clockwise as seen, y down
    both = np.stack([left, left[::-1] + np.array([32.0, 0.0]), left + np.array([0.0, 32.0]), left[::-1] + 32.0])
    mesh = loose_mesh(at_pixels(both, SIZE, SIZE))
    scene = wd.Scene()
    scene.add(mesh, material=one_sided, transform=np.diag([1.0, 1.0, -1.0, 1.0]) if mirrored else None)
    camera = pixel_camera(SIZE, near=-FAR)
    ids = render(scene, camera, SIZE, SIZE, settings=(f"raster.cull={cull}",), device=device)["triangle_id"]
    front = {1, 3} if mirrored else {0, 2}
    expected = {"back": front, "front": {0, 1, 2, 3} - front, "none": {0, 1, 2, 3}}[cull]
    assert set(np.unique(ids)) - {-1} == expected
    if cull == "none":
        assert np.array_equal(ids >= 0, reference.coverage_count(snapped(both), SIZE, SIZE) > 0)


def test_r7_normals_face_the_viewer_of_a_two_sided_face(device):
    front = np.array([[4.0, 4.0], [4.0, 28.0], [28.0, 28.0]])
    mesh = loose_mesh(at_pixels(np.stack([front, front[::-1] + 32.0]), SIZE, SIZE))
    image = render(scene_of(mesh), pixel_camera(SIZE), SIZE, SIZE, device=device)
    assert np.array_equal(
        image["normal"][image["triangle_id"] >= 0],
        np.tile([0.0, 0.0, 1.0], (image["triangle_id"] >= 0).sum()).reshape(-1, 3),
    )


def test_r9_nothing_is_written_outside_a_view(device):
    # The views of a batch lie side by side in memory: the empty one in the middle is the canary.
    width, height = 33, 17
    quad = at_pixels([[-1.0, -1.0], [width + 1, -1.0], [width + 1, height + 1], [-1.0, height + 1]], width, height)
    scene = wd.Scene()
    for world in (0, 2):
        for scale in (1.0, 50.0):
            scene.add(wd.Mesh(quad * [scale, scale, 1.0], [[0, 1, 2], [0, 2, 3]]), material=TWO_SIDED, world=world)
    cameras = [pixel_camera(height, world=world) for world in (0, 1, 2)]
    for settings in (("raster.bins=off",), ("raster.bins=on",)):
        image = render(scene, cameras, width, height, settings=settings, device=device)
        assert (image["instance_id"][1] == -1).all() and np.isposinf(image["depth"][1]).all()
        assert (image["instance_id"][[0, 2]] >= 0).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 513), (17, 33), (257, 255)])
def test_e5_a_render_is_the_crop_of_a_larger_one(width, height, device, rng):
    margin = 24
    triangles = rng.uniform(-30.0, [width + 30.0, height + 30.0], (60, 3, 2))
    triangles = np.concatenate([triangles, [[[-5e3, -5e3], [5e3, -4e3], [0.0, 9e3]]]])
    corners = at_pixels(snapped(triangles) / 256.0, width, height, rng.uniform(1.0, 15.0, (61, 3)))
    scene = scene_of(loose_mesh(corners))
    small = render(scene, pixel_camera(height), width, height, device=device)
    big_w, big_h = width + 2 * margin, height + 2 * margin
    big = render(scene, pixel_camera(big_h), big_w, big_h, device=device)
    assert_same(small, {n: v[margin:-margin, margin:-margin] for n, v in big.items()})
    assert (small["triangle_id"] >= 0).any()


@pytest.mark.parametrize(("width", "height"), [(0, 4), (4, -1), (16385, 4), (4, 1.5)])
def test_e5_sizes_are_checked(width, height):
    with pytest.raises(wd.InputError, match=r"Renderer\.(width|height)"):
        wd.Renderer(wd.Scene(), width=width, height=height)


@pytest.mark.parametrize("meshes", [0, 1])
def test_l1_an_empty_scene_is_background(meshes, device):
    scene = scene_of(*[wd.Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))] * meshes)
    scene.environment = wd.Environment(background=(0.25, 0.5, 1.0), ambient=(1.0, 1.0, 1.0))
    image = render(scene, wd.Camera(), 33, 17, device=device)
    assert (image["instance_id"] == -1).all() and (image["triangle_id"] == -1).all()
    assert np.isposinf(image["depth"]).all() and not image["normal"].any()
    scene.lights.add(wd.PointLight(), wd.DirectionalLight())
    color = render(scene, wd.Camera(), 33, 17, outputs=("color", "display"), device=device)
    assert (color["color"] == np.array([0.25, 0.5, 1.0], np.float32)).all()
    assert (color["display"] == color["display"][0, 0]).all()


def test_l7_degenerate_faces_do_not_show(device, rng):
    good = snapped(rng.uniform(0.0, SIZE, (20, 3, 2))) / 256.0
    depth = rng.uniform(1.0, 15.0, (20, 3))
    points = at_pixels(good, SIZE, SIZE, depth).reshape(-1, 3)
    faces = np.arange(60).reshape(-1, 3)
    line = np.array([[0.0, 0.0, -1.0], [8.0, 8.0, -1.0], [16.0, 16.0, -1.0]])
    bad = np.array([[0, 0, 5], [7, 3, 3], [60, 61, 62], [9, 9, 9]])
    mixed = np.concatenate([bad[:2], faces[:10], bad[2:], faces[10:]])
    clean = render(scene_of(wd.Mesh(points.astype(np.float32), faces)), pixel_camera(SIZE), SIZE, SIZE, device=device)
    all_points = np.concatenate([points, line]).astype(np.float32)
    dirty = render(scene_of(wd.Mesh(all_points, mixed)), pixel_camera(SIZE), SIZE, SIZE, device=device)
    number = np.concatenate([[-1, -1], np.arange(10), [-1, -1], np.arange(10, 20), [-1]])
    dirty["triangle_id"] = number[dirty["triangle_id"]]
    assert_same(clean, dirty)


def ball_scene(positions: np.ndarray, triangles: np.ndarray, settings_cull: str, device: str):
    camera = wd.Camera.look_at((0.4, 0.3, 2.5), (0.0, 0.0, 0.0), vertical_fov_deg=50.0)
    scene = scene_of(wd.Mesh(positions.astype(np.float32), triangles), material=wd.Material(model="lambert"))
    return render(scene, camera, SIZE, SIZE, settings=(f"raster.cull={settings_cull}",), device=device)


def test_p1_closed_mesh_has_the_same_outline_from_both_sides(device):
    for rings, sectors in ((6, 8), (48, 64)):
        mesh = reference.sphere(1.0, rings, sectors)
        front, back = (ball_scene(mesh.positions, mesh.triangles, cull, device) for cull in ("back", "front"))
        assert np.array_equal(front["triangle_id"] >= 0, back["triangle_id"] >= 0)
        seen = front["triangle_id"] >= 0
        assert 1000 < seen.sum() < SIZE * SIZE and (front["depth"][seen] < back["depth"][seen]).all()


def test_p1_closed_mesh_is_covered_once_from_the_front(device):
    mesh = reference.sphere(1.0, 6, 8)
    camera = wd.Camera.look_at((0.4, 0.3, 2.5), (0.0, 0.0, 0.0), vertical_fov_deg=50.0)
    count = cover_count(mesh.positions, mesh.triangles, camera, SIZE, SIZE, device)
    assert set(np.unique(count)) == {0, 2}


def test_p2_permuting_triangles_changes_nothing(device, rng):
    mesh = reference.sphere(1.0, 12, 16)
    triangles = np.concatenate([mesh.triangles, mesh.triangles[:40]])  # duplicates tie
    base = ball_scene(mesh.positions, triangles, "back", device)
    for _ in range(3):
        order = rng.permutation(len(mesh.triangles))
        shuffled = ball_scene(mesh.positions, mesh.triangles[order], "back", device)
        shuffled["triangle_id"] = np.where(shuffled["triangle_id"] >= 0, order[shuffled["triangle_id"]], -1)
        assert_same(base, shuffled, ("depth", "triangle_id", "instance_id"))
        assert np.abs(base["normal"] - shuffled["normal"]).max() == 0.0


def test_p5_turning_vertex_indices_keeps_ids(device, rng):
    mesh = reference.sphere(1.0, 12, 16)
    turn = rng.integers(0, 3, len(mesh.triangles))
    turned = np.stack([np.roll(t, k) for t, k in zip(mesh.triangles, turn, strict=True)])
    one = ball_scene(mesh.positions, mesh.triangles, "back", device)
    two = ball_scene(mesh.positions, turned, "back", device)
    assert_same(one, two, ("triangle_id", "instance_id"))
    seen = one["triangle_id"] >= 0
    assert np.abs(one["depth"][seen] / two["depth"][seen] - 1.0).max() <= 4.0 * 2.0**-23


def test_p13_cutting_a_triangle_in_four_keeps_its_coverage(device, rng):
    for _ in range(8):
        corners = rng.integers(-20, SIZE + 20, (3, 2)) * 2.0
        a, b, c = corners
        ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
        whole = drawn(corners[None] / 2.0, device=device) >= 0
        parts = np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]) / 2.0
        assert np.array_equal(covered_once(parts, device), whole)
