"""Hard cases of clipping, cameras, depth and interpolation: T, Z and I rows, P7, P8, X5."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from pixel_scenes import (
    FAR,
    GEOMETRY,
    TWO_SIDED,
    assert_same,
    at_pixels,
    cover_count,
    in_front,
    loose_mesh,
    pixel_camera,
    render,
    scene_of,
)
from reference_bridge import render_reference

import warp_deferred as wd

SIZE = 48
LIT = ("color", "depth", "normal", "triangle_id")


def triangles_near_the_eye(rng: np.random.Generator, count: int, behind: int) -> np.ndarray:
    """Triangles (count, 3, 3) with that many vertices behind the near plane of 0.5 m, the others in view."""
    depth = rng.uniform(0.7, 6.0, (count, 3))
    xy = rng.uniform(-0.6, 0.6, (count, 3, 2)) * depth[..., None]
    depth[:, :behind] = rng.uniform(-4.0, 0.4, (count, behind))
    return np.concatenate([xy, -depth[..., None]], axis=-1)


@pytest.mark.parametrize("behind", [1, 2, 3])
def test_t1_vertices_behind_the_near_plane(behind, device, rng):
    camera = wd.Camera(near=0.5, vertical_fov=1.2)
    triangles = triangles_near_the_eye(rng, 24, behind)
    scene = wd.Scene()
    for k, triangle in enumerate(triangles):
        scene.add(loose_mesh(triangle[None]), material=TWO_SIDED, world=k)
    cameras = [camera.replace(world=k) for k in range(len(triangles))]
    images = render(scene, cameras, SIZE, SIZE, device=device)
    drawn = images["instance_id"] >= 0
    if behind == 3:
        assert not drawn.any()
        return
    for k, view in enumerate(cameras):
        twin = render_reference(scene, view, SIZE, SIZE)
        sure = twin["edge_distance"] > 3.0
        assert np.array_equal(drawn[k][sure], (twin["instance_id"] >= 0)[sure])
        both = drawn[k] & sure
        # Slopes turn the 1/256 px of the snap into depth; the nearest point is half a metre away.
        assert np.abs(images["depth"][k][both] / twin["depth"][both] - 1.0).max(initial=0.0) < 2e-3
        assert np.isfinite(images["depth"][k][drawn[k]]).all() and (images["depth"][k][drawn[k]] >= 0.5).all()
    assert drawn.any(axis=(1, 2)).sum() >= 8


def test_t2_plane_at_the_near_distance_is_drawn(device):
    camera = wd.Camera(near=0.25)
    corners = in_front([[-8.0, -8.0], [60.0, -8.0], [60.0, 60.0], [-8.0, 60.0]], 0.25, camera, SIZE, SIZE)
    mesh = wd.Mesh(corners.astype(np.float32), [[0, 1, 2], [0, 2, 3]])
    image = render(scene_of(mesh), camera, SIZE, SIZE, device=device)
    assert (image["instance_id"] == 0).all() and (image["depth"] == 0.25).all()


def test_t2_vertices_at_and_around_the_eye_stay_finite(device):
    camera = wd.Camera(near=0.1)
    eye = [0.0, 0.0, 0.0]
    triangles = np.array(
        [
            [[-1, -1, 0], [1, -1, 0], [0, 1, 0]],  # in the eye's plane: w = 0
            [[-1, -1, 0], [1, -1, -3], [0, 1, -3]],  # one vertex with w = 0
            [eye, [1, -1, -3], [-1, -1, -3]],  # a vertex at the eye
            [[0, -1, 1], [0, 1, -2], [0, -1, -2]],  # seen edge-on, through the eye
            [[-1, -1, -0.1], [1, -1, -0.1], [0, 1, -0.1]],  # on the near plane
            [[-1, -1, -0.1], [1, -1, 5], [0, 1, -9]],  # across it
            [[1e-38, 0, -1e-38], [1, 1, -1], [-1, 1, -1]],
            [[-3e37, -1, -1], [3e37, -1, -1], [0, 3e37, -1]],
            [[0, 0, -3e38], [1, 0, -3e38], [0, 3e38, -3e38]],
        ],
        float,
    )
    scene = wd.Scene()
    for k, triangle in enumerate(triangles):
        scene.add(loose_mesh(triangle[None]), material=TWO_SIDED, world=k)
    cameras = [camera.replace(world=k) for k in range(len(triangles))]
    images = render(scene, cameras, SIZE, SIZE, device=device)
    drawn = images["instance_id"] >= 0
    assert np.isfinite(images["depth"][drawn]).all() and (images["depth"][drawn] >= np.float32(0.1) * (1 - 1e-6)).all()
    assert np.isposinf(images["depth"][~drawn]).all()
    assert np.isfinite(images["normal"]).all() and np.isfinite(images["albedo"]).all()
    assert not drawn[0].any() and not drawn[3].any() and drawn[5].any()


@pytest.mark.parametrize("tilt", [(0.5, 0.0), (-0.3, 0.4), (0.0, -0.8)])
def test_t3_fan_through_all_planes_covers_each_pixel_once(tilt, device):
    # A plane in front of every pixel, whose rim lies 1e5 m out: sideways, behind the eye and past the guard band.
    turn = (np.arange(18) + 0.3) * (2.0 * np.pi / 18)
    x, y = 1e5 * np.cos(turn), 1e5 * np.sin(turn)
    points = np.stack([x, y, -5.0 + tilt[0] * x + tilt[1] * y], axis=1)
    points = np.concatenate([[[0.1, 0.2, -5.0 + 0.1 * tilt[0] + 0.2 * tilt[1]]], points])
    fan = np.array([[0, k + 1, (k + 1) % 18 + 1] for k in range(18)])
    count = cover_count(points, fan, wd.Camera(near=0.1), SIZE, SIZE, device)
    assert (count == 1).all()


DEPTHS = (-1.0, -0.5, 0.0, 0.25, 0.75, 1.0, 1.5, 2.0)


def bars(width: int, height: int) -> wd.Scene:
    """Vertical bars at the depth values of DEPTHS, four pixels wide each."""
    corners = []
    for k, z in enumerate(DEPTHS):
        quad = at_pixels(
            [[4 * k, 0], [4 * k + 4, 0], [4 * k + 4, height], [4 * k, height]], width, height, FAR * (1.0 - z)
        )
        corners += [quad[[0, 1, 2]], quad[[0, 2, 3]]]
    return scene_of(loose_mesh(np.array(corners)))


def test_t6_depth_is_clipped_or_clamped(device):
    width, height = 32, 8
    camera = pixel_camera(height)
    renderer = wd.Renderer(bars(width, height), width=width, height=height, outputs=GEOMETRY, device=device)
    depth = renderer.render(camera).numpy("depth")[0][:, ::4]
    z = 1.0 - depth / FAR
    inside = np.array([0.0 <= value <= 1.0 for value in DEPTHS])
    assert np.isposinf(depth[:, ~inside]).all()
    assert np.abs(z[:, inside] - np.array(DEPTHS)[inside]).max() <= 1e-5
    # Clamping is what depth-only views ask for; the same plan with the flag set shows it with ids.
    plan = renderer.plan
    frame = plan.resources.frame
    plan.packer.write(frame.begin()[frame.views_offset :], [camera], renderer._ranges([camera.world]), depth_clamp=True)
    frame.upload()
    plan.replay()
    z = 1.0 - plan.outputs["depth"].numpy()[0][:, ::4] / FAR
    assert np.abs(z - np.clip(DEPTHS, 0.0, 1.0)).max() <= 1e-5


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: wd.Camera.look_at((1, 2, 3), (1, 2, 3)), "target"),
        (lambda: wd.Camera.look_at((np.nan, 2, 3), (1, 2, 3)), "eye"),
        (lambda: wd.Camera(vertical_fov=0.0), "vertical_fov"),
        (lambda: wd.Camera(vertical_fov=np.pi), "vertical_fov"),
        (lambda: wd.Camera(vertical_fov=np.nan), "vertical_fov"),
        (lambda: wd.Camera(near=0.0), "near"),
        (lambda: wd.Camera(near=-1.0), "near"),
        (lambda: wd.Camera(projection="orthographic", near=2.0, far=2.0), "far"),
        (lambda: wd.Camera(projection="orthographic", vertical_extent=0.0), "vertical_extent"),
        (lambda: wd.Camera(position=(0.0, np.inf, 0.0)), "position"),
        (lambda: wd.Camera(rotation=(0.0,) * 9), "rotation"),
        (lambda: wd.Camera.from_intrinsics([[0, 0, 1], [0, 1, 1], [0, 0, 1]], 4, 4), "intrinsics"),
        (lambda: wd.Camera.from_intrinsics(np.eye(3), 0, 4), "width"),
    ],
)
def test_t7_degenerate_cameras_are_named(make, name):
    with pytest.raises(wd.InputError, match=name) as error:
        make()
    assert isinstance(error.value, ValueError) and "expected" in str(error.value)


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, -5.0, 0.0), (0.0, 0.0, 0.0)])
def test_t7_up_along_the_view_falls_back(up, device):
    camera = wd.Camera.look_at((0.0, 4.0, 0.0), (0.0, 0.0, 0.0), up=up)
    rotation = np.array(camera.rotation).reshape(3, 3)
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.allclose(rotation[2], (0.0, 1.0, 0.0))
    floor = reference.quad(50.0)
    image = render(scene_of(wd.Mesh(floor.positions, floor.triangles)), camera, SIZE, SIZE, device=device)
    assert (image["instance_id"] == 0).all() and np.abs(image["depth"] - 4.0).max() < 1e-5


def lit_scene(rng: np.random.Generator, scale: float, shift: np.ndarray, baked: bool):
    """A bumpy ball over a floor with three lights and a camera, on a grid of 2^-8 m, scaled and moved.

    `baked` moves the vertices themselves; otherwise the instances move.
    """
    ball = reference.sphere(1.0, 14, 20)
    points = np.round(ball.positions * (1.0 + 0.1 * rng.random((len(ball.positions), 1))) * 256.0) / 256.0
    floor = reference.quad(4.0, -1.25)
    scene = wd.Scene()
    for positions, triangles in ((points, ball.triangles), (floor.positions, floor.triangles)):
        transform = np.eye(4)
        if not baked:
            transform[:3, 3] = shift
        vertices = (positions * scale + (shift if baked else 0.0)).astype(np.float32)
        material = wd.Material(base_color=(0.7, 0.5, 0.3, 1.0), roughness=0.4)
        scene.add(wd.Mesh(vertices, triangles), material=material, transform=transform)
    gain = scale * scale
    scene.lights.add(
        wd.PointLight(
            position=tuple(np.array([1.5, 2.0, 1.0]) * scale + shift),
            intensity=20.0 * gain,
            range=8.0 * scale,
            source_radius=0.0078125 * scale,
        ),
        wd.SpotLight(
            position=tuple(np.array([-2.0, 3.0, 0.5]) * scale + shift),
            direction=(2.0, -3.0, -0.5),
            intensity=40.0 * gain,
            source_radius=0.0078125 * scale,
        ),
        wd.DirectionalLight(direction=(-1.0, -1.0, -2.0), intensity=0.5),
    )
    camera = wd.Camera.look_at((2.0, 1.5, 4.0), (0.0, -0.25, 0.0), near=0.0625)
    return scene, camera.replace(position=tuple(np.array(camera.position) * scale + shift), near=0.0625 * scale)


def lit_image(device: str, scale: float = 1.0, shift=(0.0, 0.0, 0.0), baked: bool = False):
    scene, camera = lit_scene(np.random.default_rng(5), scale, np.array(shift), baked)
    return render(scene, camera, SIZE, SIZE, outputs=LIT, device=device)


@pytest.mark.parametrize("power", [4, 10, 20, 40])
def test_t9_p7_translating_instances_changes_nothing(power, device):
    shift = 2.0**power * np.array([1.0, -2.0, 3.0])
    assert_same(lit_image(device), lit_image(device, shift=shift))


@pytest.mark.parametrize("power", [4, 8, 13])
def test_t9_p7_translating_vertices_changes_nothing_while_exact(power, device):
    shift = 2.0**power * np.array([1.0, -2.0, 0.5])
    assert_same(lit_image(device), lit_image(device, shift=shift, baked=True))


def test_t9_position_layer_follows_the_camera(device):
    shift = np.array([2.0**20, -(2.0**19), 3.0])
    images = []
    for offset in (np.zeros(3), shift):
        scene, camera = lit_scene(np.random.default_rng(5), 1.0, offset, False)
        images.append(render(scene, camera, SIZE, SIZE, outputs=("position", "triangle_id"), device=device))
    seen = images[0]["triangle_id"] >= 0
    error = images[1]["position"].astype(float) - shift - images[0]["position"]
    # The layer is float32: half a step of the largest coordinate.
    assert np.abs(error[seen]).max() <= 2.0**-24 * np.linalg.norm(shift) and not images[1]["position"][~seen].any()


@pytest.mark.parametrize("power", [-10, -3, 4, 10])
def test_p8_l18_scaling_by_powers_of_two_is_exact(power, device):
    base, scaled = lit_image(device), lit_image(device, scale=2.0**power)
    scaled["depth"] = scaled["depth"] * np.float32(2.0**-power)
    assert_same(base, scaled)


@pytest.mark.parametrize("scale", [1e-3, 0.3, 1e3])
def test_p8_l18_any_unit_gives_the_same_picture(scale, device):
    base, scaled = lit_image(device), lit_image(device, scale=scale)
    assert_same(base, scaled, ("triangle_id",))
    size = np.maximum(np.abs(base["color"]), 1e-2)
    assert (np.abs(base["color"] - scaled["color"]) / size).max() <= 1e-5


def test_z1_close_parallel_planes_keep_their_order(device):
    scene, cameras, expected = wd.Scene(), [], []
    camera = wd.Camera(near=0.05)
    square = np.array([[-10.0, -10.0, -1.0], [10.0, -10.0, -1.0], [10.0, 10.0, -1.0], [-10.0, 10.0, -1.0]])
    for distance in 10.0 ** np.arange(-1.0, 7.0):
        for near_first in (True, False):
            world = len(cameras)
            factors = (1.0, 1.0 + 1e-6) if near_first else (1.0 + 1e-6, 1.0)
            for factor in factors:
                mesh = wd.Mesh((square * distance * factor).astype(np.float32), [[0, 1, 2], [0, 2, 3]])
                scene.add(mesh, material=TWO_SIDED, world=world)
            cameras.append(camera.replace(world=world))
            expected.append(2 * world + (0 if near_first else 1))
    ids = render(scene, cameras, 24, 24, device=device)["instance_id"]
    assert np.array_equal(ids, np.broadcast_to(np.array(expected)[:, None, None], ids.shape))


def test_z2_of_equal_triangles_the_first_wins(device, rng):
    ball = reference.sphere(1.0, 8, 12)
    camera = wd.Camera.look_at((0.0, 0.5, 3.0), (0.0, 0.0, 0.0))
    single = render(scene_of(wd.Mesh(ball.positions, ball.triangles)), camera, SIZE, SIZE, device=device)
    count = len(ball.triangles)
    doubled = wd.Mesh(ball.positions, np.concatenate([ball.triangles, ball.triangles[rng.permutation(count)]]))
    for settings in (("raster.bins=off",), ("raster.bins=on",)):
        scene = scene_of(doubled, wd.Mesh(ball.positions, ball.triangles), doubled)
        assert_same(single, render(scene, camera, SIZE, SIZE, settings=settings, device=device))


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.1, 2.0])
def test_z3_interpenetrating_planes_cross_on_their_line(angle, device):
    # Two planes that meet in a line through the middle of the picture, turned about the view direction.
    square = np.array([[-6.0, -6.0], [6.0, -6.0], [6.0, 6.0], [-6.0, 6.0]])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    scene = wd.Scene()
    for slope in (0.3, -0.3):
        points = np.concatenate([square @ turn.T, (-5.0 + slope * square[:, :1])], axis=1)
        scene.add(wd.Mesh(points.astype(np.float32), [[0, 1, 2], [0, 2, 3]]), material=TWO_SIDED)
    ids = render(scene, wd.Camera(), SIZE, SIZE, device=device)["instance_id"]
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5 - SIZE / 2
    across = x * np.cos(angle) - y * np.sin(angle)
    assert (ids[across > 1.0] == 0).all() and (ids[across < -1.0] == 1).all()


def colored_quad(device: str, colors: np.ndarray):
    camera = wd.Camera()
    corners = in_front([[3.2, 5.1], [44.7, 2.3], [40.9, 45.2], [6.6, 38.8]], [1.3, 0.8, 0.6, 2.0], camera, SIZE, SIZE)
    mesh = wd.Mesh(corners.astype(np.float32), [[0, 1, 2], [0, 2, 3]], colors=colors.astype(np.float32))
    material = wd.Material(model="lambert", two_sided=True)
    scene = scene_of(mesh, material=material)
    return render(scene, camera, SIZE, SIZE, device=device), render_reference(scene, camera, SIZE, SIZE)


@pytest.mark.parametrize("scale", [1.0, 10.0, 5e3, 2.0**100])
def test_i1_perspective_attributes(scale, device, rng):
    colors = rng.random((4, 4)) * scale
    image, twin = colored_quad(device, colors)
    both = (image["triangle_id"] >= 0) & (image["triangle_id"] == twin["triangle_id"])
    assert both.sum() > 1000
    # Affine interpolation would be off by tens of per cent here.
    assert np.abs(image["albedo"] - twin["albedo"])[both].max() <= 1e-6 * scale


def test_i2_a_constant_attribute_stays_constant(device):
    color = np.array([0.1, 0.7, 1.0 / 3.0, 1.0], np.float32)
    image, _ = colored_quad(device, np.tile(color, (4, 1)))
    seen = image["triangle_id"] >= 0
    assert (image["albedo"][seen] == color[:3]).all()


def test_i3_grazing_and_clipped_attributes_stay_in_range(device, rng):
    # A floor from behind the eye to the horizon, and a wall seen at a hair's breadth.
    points = np.array(
        [[-1e4, -0.01, 50.0], [1e4, -0.01, 50.0], [0.0, -0.02, -1e5], [0.5, -5, -1], [0.5001, 5, -1], [5e3, 0, -1e4]]
    )
    colors = rng.uniform(0.25, 0.75, (6, 4))
    mesh = wd.Mesh(points.astype(np.float32), [[0, 1, 2], [3, 4, 5]], colors=colors.astype(np.float32))
    material = wd.Material(model="lambert", two_sided=True)
    image = render(scene_of(mesh, material=material), wd.Camera(near=0.001), SIZE, SIZE, device=device)
    for k in (0, 1):
        seen = image["triangle_id"] == k
        span = colors[3 * k : 3 * k + 3, :3].astype(np.float32)
        assert (image["albedo"][seen] >= span.min(axis=0)).all() and (image["albedo"][seen] <= span.max(axis=0)).all()
    assert (image["triangle_id"] == 0).sum() > 500


def masked(alpha: float, cutoff: float, device: str, texture: int | None = None) -> bool:
    """Whether a full-screen surface of that alpha is there."""
    base = None if texture is None else wd.Texture(np.full((4, 4, 4), texture, np.uint8))
    material = wd.Material(
        model="lambert",
        base_color=(1.0, 1.0, 1.0, alpha),
        alpha_mode="mask",
        alpha_cutoff=cutoff,
        base_color_texture=base,
        two_sided=True,
    )
    corners = at_pixels([[0, 0], [16, 0], [16, 16], [0, 16]], 16, 16)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    mesh = wd.Mesh(corners.astype(np.float32), [[0, 1, 2], [0, 2, 3]], uvs=uvs)
    ids = render(scene_of(mesh, material=material), pixel_camera(16), 16, 16, device=device)["instance_id"]
    assert len(np.unique(ids)) == 1
    return bool(ids[0, 0] == 0)


def test_x5_alpha_at_the_cutoff_is_kept(device):
    assert masked(0.5, 0.5, device) and masked(0.3, 0.3, device)
    assert not masked(float(np.nextafter(np.float32(0.5), np.float32(0.0))), 0.5, device)
    assert masked(0.0, 0.0, device) and not masked(1.0, 1.5, device)


def test_x5_an_alpha_that_is_no_number_is_not_there(device):
    corners = at_pixels([[0, 0], [16, 0], [16, 16], [0, 16]], 16, 16).astype(np.float32)
    mesh = wd.Mesh(corners, [[0, 1, 2], [0, 2, 3]], colors=np.ones((4, 4), np.float32))
    material = wd.Material(model="lambert", alpha_mode="mask", alpha_cutoff=0.5, two_sided=True)
    scene = scene_of(mesh, material=material)
    renderer = wd.Renderer(scene, width=16, height=16, device=device, outputs=GEOMETRY)
    assert (renderer.render(pixel_camera(16)).numpy("instance_id") == 0).all()
    # No way leads there from outside: files are repaired and arrays refused.
    colors = renderer.plan.resources.scene.geometry.colors
    values = colors.numpy().copy()
    values[1, 3] = np.nan
    colors.assign(values)
    ids = renderer.render(pixel_camera(16)).numpy("triangle_id")[0]
    assert set(np.unique(ids)) == {-1, 1}


def test_x5_texel_alpha_at_the_cutoff_is_kept(device):
    for code in (1, 77, 128, 254, 255):
        assert masked(1.0, float(np.float32(code) / np.float32(255.0)), device, code), code
        assert not masked(1.0, (code + 0.5) / 255.0, device, code), code
