"""The reference's coverage, clipping, depth and facing, against exact integers, hand counts and algebra."""

from __future__ import annotations

import ast
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference as ref
from reference import loose as soup
from reference import scene_of, translation
from reference import view_of as camera


def drawn_count(triangles, width, height):
    """Count fragments of snapped triangles by the renderer's own edge functions."""
    xy = np.asarray(triangles, np.int64)
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    keep = area != 0
    pieces = ref.Pieces(xy[keep], np.full((int(keep.sum()), 3), 0.5), area[keep], np.flatnonzero(keep))
    return ref.draw(pieces, width, height, "clip").fragments


def centre(*pixel):
    return [256 * c + 128 for c in pixel]


def random_triangulation(rng, corners, count):
    """Cut a rectangle into triangles by dropping random points into them; slivers are welcome."""
    (x0, y0), (x1, y1) = corners
    triangles = [((x0, y0), (x1, y0), (x1, y1)), ((x0, y0), (x1, y1), (x0, y1))]
    for point in rng.integers((x0 + 1, y0 + 1), (x1, y1), (count, 2)).tolist():
        for k, (a, b, c) in enumerate(triangles):
            sides = [
                (q[0] - p[0]) * (point[1] - p[1]) - (q[1] - p[1]) * (point[0] - p[0])
                for p, q in ((a, b), (b, c), (c, a))
            ]
            if min(sides) > 0:
                triangles[k : k + 1] = [(a, b, tuple(point)), (b, c, tuple(point)), (c, a, tuple(point))]
                break
    return np.array(triangles)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_r1_rotated_quads_cover_each_centre_once(seed, reverse):
    rng = np.random.default_rng(seed)
    angle, w = rng.uniform(0, np.pi), rng.uniform(0.1, 4.0, 4)
    place = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ np.array(
        [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    )
    # The screen shape stays the rotated square, only the depths of its corners differ.
    points = np.concatenate([place * 0.3 * w[:, None], -w[:, None]], axis=1)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    second = faces[1, ::-1] if reverse else faces[1]
    view = camera(cull="none")
    out = ref.render(scene_of(ref.Mesh(points, np.stack([faces[0], second]))), view)
    corners = ref.project(points, view)
    expected = ref.polygon_coverage(ref.snap(corners[:, :2] / corners[:, 3:]), view.width, view.height)
    assert expected.sum() > 300
    assert np.array_equal(out["fragments"], expected.astype(int))


def test_r1_full_screen_quad_leaves_no_pixel_out():
    view = camera(33, 17, focal=16.0)
    x, y = 33 / 32, 17 / 32
    points = np.array([[-x, -y, -1], [x, -y, -1], [x, y, -1], [-x, y, -1.0]])
    out = ref.render(scene_of(ref.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]))), view)
    assert (out["fragments"] == 1).all()


@pytest.mark.parametrize("count", [drawn_count, ref.coverage_count])
def test_r3_edges_through_centres_follow_the_top_left_rule(count):
    a, b, c, d = centre(2, 2), centre(6, 2), centre(6, 5), centre(2, 5)
    expected = np.zeros((8, 9), int)
    expected[2:5, 2:6] = 1
    assert np.array_equal(count(np.array([[a, b, c], [a, c, d]]), 9, 8), expected)
    # Winding and the other diagonal change nothing.
    assert np.array_equal(count(np.array([[b, a, d], [b, d, c]]), 9, 8), expected)


@pytest.mark.parametrize("count", [drawn_count, ref.coverage_count])
def test_r3_centre_shared_by_a_fan_is_covered_once(count):
    hub = centre(4, 4)
    rim = [centre(1, 2), centre(4, 0), centre(8, 1), centre(7, 4), centre(8, 8), centre(4, 7), centre(0, 8)]
    fan = np.array([[hub, rim[i], rim[(i + 1) % len(rim)]] for i in range(len(rim))])
    covered = count(fan, 9, 9)
    assert covered[4, 4] == 1
    assert np.array_equal(covered, ref.polygon_coverage(np.array(rim), 9, 9).astype(int))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [drawn_count, ref.coverage_count])
def test_r4_random_triangulation_covers_its_rectangle_once(count, seed):
    # Corners at odd sub-pixels, then on pixel centres.
    corners = ((300, 401), (24 * 256 + 77, 15 * 256 + 33)) if seed % 2 else (centre(1, 2), centre(22, 13))
    triangles = random_triangulation(np.random.default_rng(seed), corners, 150)
    assert len(triangles) > 280
    (x0, y0), (x1, y1) = corners
    x, y = np.meshgrid(np.arange(26) * 256 + 128, np.arange(18) * 256 + 128)
    expected = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    assert np.array_equal(count(triangles, 26, 18), expected.astype(int))


def test_r4_triangles_between_centres_draw_nothing():
    sliver = np.array([[[140, 140], [380, 150], [370, 370]], [[0, 0], [127, 0], [0, 127]]])
    assert not drawn_count(sliver, 4, 4).any()
    assert not ref.coverage_count(sliver, 4, 4).any()


@pytest.mark.parametrize("step", [1, 64, 128, 256])
def test_r2_edge_functions_agree_with_scan_lines(step):
    # Coarse lattices put vertices and edges on centres; the offset of 128 makes that certain.
    rng = np.random.default_rng(step)
    triangles = rng.integers(-1000 // step, 6000 // step, (300, 3, 2)) * step + (128 if step > 1 else 0)
    for triangle in triangles:
        assert np.array_equal(drawn_count(triangle[None], 18, 14), ref.coverage_count(triangle[None], 18, 14))


def test_p1_closed_convex_mesh_shows_one_front_and_one_back():
    mesh = ref.sphere(0.6, 7, 11)
    scene = replace(scene_of(mesh), instances=(ref.Instance(mesh, 0, translation(0.03, 0.01, -2)),))
    front, back = (ref.render(scene, camera(cull=cull))["fragments"] for cull in ("back", "front"))
    assert front.max() == 1 and front.sum() > 250
    assert np.array_equal(front, back)


def test_oracle_refuses_what_it_cannot_count_exactly():
    with pytest.raises(ValueError, match="snap the vertices"):
        ref.polygon_coverage(np.array([[0.5, 0.0], [1.0, 0.0], [0.0, 1.0]]), 4, 4)
    with pytest.raises(ValueError, match=r"2\^29"):
        ref.polygon_coverage(np.array([[0, 0], [1 << 30, 0], [0, 1]]), 4, 4)


def clip_by_hand(triangle, near):
    """Cut a view-space triangle at z = -near; an independent walk over its corners."""
    front = [p[2] <= -near for p in triangle]
    out = []
    for i in range(3):
        p, q = triangle[i], triangle[(i + 1) % 3]
        if front[i]:
            out.append(p)
        if front[i] != front[(i + 1) % 3]:
            t = (-near - p[2]) / (q[2] - p[2])
            cut = p + t * (q - p)
            cut[2] = -near
            out.append(cut)
    return [np.array([out[0], out[i], out[i + 1]]) for i in range(1, len(out) - 1)]


@pytest.mark.parametrize("behind", [0, 1, 2, 3])
def test_t1_near_clip_equals_the_scene_clipped_before(behind):
    near, rng = 0.1, np.random.default_rng(behind)
    whole, cut = [], []
    for _ in range(40):
        triangle = rng.uniform((-2, -2, -4), (2, 2, -0.2), (3, 3))
        triangle[:behind, 2] = rng.uniform(-0.09, 3.0, behind)
        whole.append(triangle)
        cut += clip_by_hand(triangle, near)
    view = camera(near=near, cull="none")
    a = ref.render(scene_of(soup(whole)), view)
    b = ref.render(scene_of(soup(cut)), view)
    sure = (a["edge_distance"] > 1.0) & (a["z_gap"] > 1e-4)
    assert np.array_equal(a["fragments"][sure], b["fragments"][sure])
    assert a["fragments"].any() == (behind < 3)
    hit = sure & (a["alpha"] > 0)
    assert np.allclose(a["position"][hit], b["position"][hit], rtol=1e-6, atol=1e-6)


def test_t2_vertices_on_the_near_plane_and_through_the_eye_stay_finite():
    near = 0.5
    triangles = [
        [[-1, -1, -near], [1, -1, -near], [0, 1, -2.0]],
        [[0, 0, 0], [1, 0, -3], [0, 1, -3]],
        [[-1, 0.0, 0], [1, 0, 0], [0, 0.5, -2]],
        [[-1, -0.5, 1], [1, -0.5, 1], [0, -0.5, -5]],
    ]
    out = ref.render(scene_of(soup(triangles)), camera(near=near, cull="none"))
    assert out["alpha"].any()
    assert ((out["z"] >= 0) & (out["z"] <= 1)).all()
    for name, layer in out.items():
        if name not in ("depth", "edge_distance", "z_gap", "alpha_margin"):
            assert np.isfinite(layer).all(), name


@pytest.mark.parametrize("seed", range(4))
def test_t3_fan_through_all_clip_planes_has_no_hole_and_no_overdraw(seed):
    # A plane that tilts behind the eye, cut into a fan whose rim lies far outside the guard band.
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, 9, endpoint=False) + rng.uniform(-0.2, 0.2, 9)
    flat = np.stack([np.cos(angles), np.sin(angles)], axis=1) * 1e5
    hub = rng.uniform(-0.2, 0.2, 2)
    slope = rng.uniform(-2.0, 2.0, 2)
    points = np.array([[x, y, x * slope[0] + y * slope[1] - 1.5] for x, y in [hub, *flat]])
    faces = np.array([[0, 1 + i, 1 + (i + 1) % 9] for i in range(9)])
    view = camera(near=0.1, cull="none")
    out = ref.render(scene_of(ref.Mesh(points, faces)), view)
    # The plane's depth along each pixel's ray: w (1 + slope . ray) = 1.5 with the ray at unit depth.
    x, y = np.meshgrid((np.arange(48) + 0.5 - 24) / 40, -(np.arange(32) + 0.5 - 16) / 40)
    reach = 1.5 / (1.0 + slope[0] * x + slope[1] * y)
    expected = (reach > 0.1) & (reach < 5e4)
    assert out["fragments"].max() == 1
    assert expected.mean() > 0.5
    sure = out["edge_distance"] > 1.0
    assert np.array_equal(out["fragments"][sure] == 1, expected[sure])
    # 1 / depth is what is linear on the screen, so that is where half a sub-pixel of snapping shows.
    assert np.allclose(1 / out["depth"][expected & sure], 1 / reach[expected & sure], atol=2e-4)


@pytest.mark.parametrize("clamp", [False, True])
def test_t6_orthographic_depth_is_clipped_or_clamped(clamp):
    levels = [-1, -0.5, 0, 0.25, 0.75, 1, 1.5, 2]
    near, far = 1.0, 5.0
    # One column each, two pixels wide, at z value `level`: view depth far - level (far - near).
    quads = []
    for i, level in enumerate(levels):
        d, x0, x1 = far - level * (far - near), 2.0 * i, 2.0 * i + 2.0
        a, b, c, e = [x0, 0, -d], [x1, 0, -d], [x1, 4, -d], [x0, 4, -d]
        quads += [[a, b, c], [a, c, e]]
    view = ref.View(16, 4, (1, 1, 0, 4), orthographic=True, near=near, far=far, depth_clamp=clamp)
    out = ref.render(scene_of(soup(quads)), view)
    for i, level in enumerate(levels):
        column = out["z"][:, 2 * i : 2 * i + 2], out["alpha"][:, 2 * i : 2 * i + 2]
        if clamp or 0 <= level <= 1:
            assert np.allclose(column[0], np.clip(level, 0, 1), atol=1e-12) and (column[1] == 1).all()
        else:
            assert (column[1] == 0).all()


def test_z1_the_nearer_of_two_close_planes_wins():
    for distance in 10.0 ** np.arange(-1, 7):
        s = distance
        quads = []
        for d in (distance * (1 + 1e-6), distance):
            a, b, c, e = [-s, -s, -d], [s, -s, -d], [s, s, -d], [-s, s, -d]
            quads += [[a, b, c], [a, c, e]]
        out = ref.render(scene_of(soup(quads)), camera(16, 16, near=0.05))
        assert (out["triangle_id"] >= 2).all()
        assert np.allclose(out["depth"], distance, rtol=1e-9)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_z2_ties_go_to_the_smaller_instance_then_primitive(order):
    triangle = [[-1, -1, -2], [1, -1, -2], [0, 1, -2.0]]
    doubled = soup([triangle, triangle])
    # An instance in front but elsewhere shifts nothing: ids, not draw history, decide.
    out = ref.render(scene_of(*[(doubled, soup([triangle]))[i] for i in order]), camera())
    hit = out["alpha"] > 0
    assert hit.sum() > 100 and (out["fragments"][hit] == 3).all()
    assert (out["instance_id"][hit] == 0).all() and (out["triangle_id"][hit] == 0).all()
    assert (out["z_gap"][hit] == 0).all()
    assert (out["instance_id"][~hit] == -1).all() and (out["triangle_id"][~hit] == -1).all()


def test_z3_planes_cross_along_the_analytic_line():
    # Two planes z = -2 ± 0.7 x cross where x = 0, which projects to the middle column.
    quads = []
    for slope in (0.7, -0.7):
        a, b, c, e = ([x, y, -2 + slope * x] for x, y in ((-1.3, -1.3), (1.3, -1.3), (1.3, 1.3), (-1.3, 1.3)))
        quads += [[a, b, c], [a, c, e]]
    out = ref.render(scene_of(soup(quads)), camera(40, 24))
    assert (out["triangle_id"][:, :20] >= 2).all() and (out["triangle_id"][:, 20:] < 2).all()


def test_z4_vertices_without_a_place_draw_nothing_and_harm_nothing():
    good = [[-1, -1, -2], [1, -1, -2], [0, 1, -2.0]]
    for bad in (np.nan, np.inf, -np.inf):
        broken = [[0, 0, -1], [1, bad, -1], [0, 1, -1]]
        a = ref.render(scene_of(soup([good])), camera())
        b = ref.render(scene_of(soup([good, broken])), camera())
        assert all(np.array_equal(a[name], b[name]) for name in a)


def test_l7_degenerate_faces_change_nothing():
    good = [[-1, -1, -2], [1, -1, -2], [0, 1, -2.0]]
    flat = [[[0, 0, -1], [0, 0, -1], [1, 0, -1]], [[-1, -1, -1], [0, 0, -1], [1, 1, -1]]]
    a = ref.render(scene_of(soup([good])), camera(cull="none"))
    b = ref.render(scene_of(soup([good, *flat])), camera(cull="none"))
    assert all(np.array_equal(a[name], b[name]) for name in a)


def test_l1_empty_scene_is_the_background():
    out = ref.render(ref.Scene(background=(0.1, 0.2, 0.3)), camera())
    assert (out["color"] == (0.1, 0.2, 0.3)).all() and not out["alpha"].any()
    assert np.isposinf(out["depth"]).all() and (out["material_id"] == -1).all()


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("cull", ["back", "none", "front"])
def test_r7_culling_knows_winding_and_mirrored_instances(cull, flip, mirror):
    triangle = np.array([[[-1, -1, -2], [1, -1, -2], [0, 1, -2.0]]])
    mesh = soup(triangle[:, ::-1] if flip else triangle)
    transform = np.diag([-1.0 if mirror else 1.0, 1, 1, 1])
    scene = replace(scene_of(mesh), instances=(ref.Instance(mesh, 0, transform),))
    # A mirror turns the outside of a body to the outside again: the stored winding decides, not the seen one.
    front = not flip
    expected = {"back": front, "none": True, "front": not front}[cull]
    out = ref.render(scene, camera(cull=cull))
    assert (out["alpha"] > 0).any() == expected
    both = ref.render(replace(scene, materials=(ref.Material(two_sided=True),)), camera(cull=cull))
    hit = both["alpha"] > 0
    assert hit.any()
    assert np.allclose(both["normal"][hit], (0, 0, 1), atol=1e-12)


def test_mirrored_body_keeps_its_normals_outside():
    mesh = ref.sphere(0.7, 12, 16)
    for scale in ([1, 1, 1], [-1, 1, 1], [-1, -0.5, 2], [-0.5, -1, -1]):
        transform = translation(0, 0, -3) @ np.diag([*scale, 1.0])
        for normals in (mesh.normals, None):
            body = ref.Mesh(mesh.positions, mesh.triangles, normals)
            out = ref.render(ref.Scene((ref.Instance(body, 0, transform),)), camera())
            hit = out["alpha"] > 0
            outward = out["position"][hit] - (0, 0, -3)
            outward = ref.unit(outward / np.square(scale))  # gradient of the ellipsoid
            assert (out["normal"][hit] * outward).sum(axis=1).min() > 0.9
            assert np.allclose(np.linalg.norm(out["normal"][hit], axis=1), 1.0)


def test_l6_zero_normals_give_the_face_normal():
    triangle = [[-1, -1, -2], [1, -1, -2.5], [0, 1, -3.0]]
    plain = ref.render(scene_of(soup([triangle])), camera())
    zero = ref.render(scene_of(soup([triangle], normals=np.zeros((3, 3)))), camera())
    face = ref.unit(np.cross([2, 0, -0.5], [1, 2, -1.0]))
    hit = plain["alpha"] > 0
    assert np.allclose(plain["normal"][hit], face) and np.array_equal(plain["normal"], zero["normal"])


def test_edge_distance_measures_sub_pixels():
    view = ref.View(4, 4, (1, 1, 0, 4), orthographic=True, near=0.0, far=2.0)
    x = 1.5 + 3 / 256
    out = ref.render(scene_of(soup([[[x, -50, -1], [60, 2, -1], [x, 50, -1.0]]])), view)
    assert out["edge_distance"][1, 1] == 3.0 and out["alpha"][1, 1] == 0
    assert out["edge_distance"][1, 2] == 253.0 and out["alpha"][1, 2] == 1


def test_snapping_rounds_to_the_nearest_sub_pixel_halves_up():
    steps = np.array([0.0, 0.49, 0.5, 1.5, -0.5, -0.51, -1.5, 255.75, 1e12, -1e12])
    assert ref.snap(steps / 256).tolist() == [0, 0, 1, 2, 0, -1, -1, 256, 1 << 23, -(1 << 23)]


def test_t3_both_neighbours_cut_a_shared_edge_at_the_same_point():
    rng = np.random.default_rng(3)
    plane = np.array([[0.0, 0.0, -1.0, 1.0]])
    for _ in range(300):
        a, b, c, d = rng.normal(size=(4, 4)) * 10.0
        a[3], b[3] = a[2] + rng.uniform(0.1, 5), b[2] - rng.uniform(0.1, 5)
        one, other = ref.clip_polygon(np.array([a, b, c]), plane), ref.clip_polygon(np.array([b, a, d]), plane)
        shared = {tuple(v) for v in one} & {tuple(v) for v in other}
        assert len(shared) == 2 and tuple(a) in shared


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2)])
def test_z_gap_is_the_step_to_the_next_fragment_in_any_order(order):
    planes = [[[-9, -9, -d], [9, -9, -d], [0, 9, -d]] for d in (1.0, 2.0, 4.0)]
    out = ref.render(scene_of(soup([planes[i] for i in order])), camera(4, 4, near=0.5))
    assert (out["fragments"] == 3).all() and np.allclose(out["z_gap"], 0.25)
    alone = ref.render(scene_of(soup(planes[:1])), camera(4, 4, near=0.5))
    assert np.isposinf(alone["z_gap"]).all()


def test_the_reference_knows_nothing_of_the_package():
    for path in sorted(Path(ref.__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            allowed = {"__future__", "numpy", *sys.stdlib_module_names}
            assert {name.partition(".")[0] for name in names} <= allowed, path.name
