"""Shadows end to end: where they fall, where they must not, and at every rung within its bounds.

A light seen past the edge of a shadow by more than the stated bound must arrive whole to the bit.
"""

import numpy as np
import pytest
import warp as wp
from builders import assert_same, box, grid, images, sphere, tilt
from shadow_scenes import (
    CLAY,
    MAPS,
    RUNGS,
    add_light,
    edge_errors,
    mixed_scene,
    past_edge,
    plate_scene,
    render,
    share,
    to_light,
    with_rung,
)  # fmt: skip

import warp_deferred as wd


@pytest.mark.parametrize("kind", ["directional", "spot", "wide spot", "point"])
@pytest.mark.parametrize("rung", RUNGS)
def test_a_shadow_falls_where_geometry_says(kind, rung, device):
    factor, whole = share(plate_scene(kind), rung, device)
    floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
    miss = past_edge(kind, whole["position"].astype(float))
    # Texels here are below 45 mm; a filter reads 2.8 of them, the lift moves the edge by as many at most.
    margin = 0.25
    lit, dark = floor & (miss > margin), floor & (miss < -margin)
    assert lit.sum() > 500 and dark.sum() > 50
    assert np.all(factor[lit] == 1.0), f"{(factor[lit] != 1.0).sum()} lit pixels lose light"
    assert np.all(factor[dark] == 0.0), f"{(factor[dark] != 0.0).sum()} pixels in shadow are lit"
    assert np.all((factor[floor] >= 0.0) & (factor[floor] <= 1.0))


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
@pytest.mark.parametrize("rung", RUNGS)
@pytest.mark.parametrize(
    "codec",
    [
        (),
        ("gbuffer.rung=compact", "gbuffer.normal=rgb8"),
        ("gbuffer.rung=compact", "gbuffer.depth=unorm16"),
        ("gbuffer.rung=compact", "gbuffer.depth=ufloat16"),
    ],
    ids=["full", "rgb8", "unorm16", "ufloat16"],
)
def test_s1_a_lit_plane_does_not_shadow_itself(kind, rung, codec, device):
    for angle in (0.0, 20.0, 45.0, 70.0, 80.0, 85.0):
        for scale in (64, 256):
            scene = wd.Scene()
            scene.add(grid(3, 6.0), transform=tilt(-90.0, 13.0), material=CLAY)
            a = np.radians(angle)
            to = np.array([np.sin(a) * 0.8, np.cos(a), np.sin(a) * 0.6])
            if kind == "directional":
                scene.lights.add(wd.DirectionalLight(direction=-to, intensity=2.0, casts_shadow=True))
            elif kind == "point":
                scene.lights.add(wd.PointLight(position=2.0 * to, intensity=9.0, casts_shadow=True))
            else:
                scene.lights.add(
                    wd.SpotLight(position=3.0 * to, direction=-to, intensity=9.0, casts_shadow=True, outer_angle=0.5)
                )
            scene.camera = wd.Camera.look_at((0.5, 2.2, 2.0), (0.0, 0.0, 0.0))
            sizes = [f"shadow.{name}_size={max(scale, 128)}" for name in ("directional", "spot", "point")]
            factor, whole = share(scene, rung, device, *sizes, *codec)
            lit = whole["diffuse"][..., 1] > 0.0
            assert lit.sum() > 200
            assert np.all(factor[lit] == 1.0), (angle, scale, (factor[lit] < 1.0).sum(), np.nanmin(factor[lit]))


def hits_box(kind, floor, margin):
    """Whether the ray to the light hits the unit box on the floor, its sides and top taken back by a margin [m]."""
    ray = to_light(kind, floor)
    low, high = np.array([margin - 0.5, 0.0, margin - 0.5]), np.array([0.5 - margin, 1.0 - margin, 0.5 - margin])
    with np.errstate(divide="ignore"):
        a, b = (low - floor) / ray, (high - floor) / ray
    return np.minimum(a, b).max(axis=-1) < np.maximum(a, b).min(axis=-1)


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
@pytest.mark.parametrize("rung", RUNGS)
def test_s2_no_light_comes_in_under_a_box(kind, rung, device):
    scene = wd.Scene()
    scene.add(grid(1, 8.0), transform=tilt(-90.0), material=CLAY)
    scene.add(box(1.0), transform=tilt(move=(0.0, 0.5, 0.0)), material=CLAY)
    add_light(scene, kind)
    # From the shaded side, near enough that the seam between box and floor is many pixels long.
    scene.camera = wd.Camera.look_at((-2.4, 1.0, -1.6), (-0.5, 0.0, -0.4), vertical_fov_deg=40.0)
    factor, whole = share(scene, rung, device, "shadow.point_size=256")
    floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
    points = whole["position"].astype(float)
    # The texels are at most 37 mm here; the bound is 2.8 of them, and one.
    deep = floor & hits_box(kind, points, 0.14)
    seam = deep & (np.maximum(np.abs(points[..., 0]), np.abs(points[..., 2])) < 0.54)
    assert deep.sum() > 100 and seam.sum() > 20
    assert np.all(factor[deep] == 0.0), (factor[deep] > 0.0).sum()


@pytest.mark.parametrize("rung", RUNGS)
def test_s5_what_no_map_holds_is_lit(rung, device):
    # A spot light in the plane of a wall: half of the floor is behind it, or outside its cone.
    scene = wd.Scene()
    scene.add(grid(1, 30.0), transform=tilt(-90.0), material=CLAY)
    scene.add(grid(1, 0.5), transform=tilt(0.0, 0.0, 1.0, (0.0, 0.25, -2.0)), material=CLAY)
    scene.lights.add(
        wd.SpotLight(
            position=(0.0, 1.0, 0.0), direction=(0.0, -0.3, -1.0), outer_angle=0.6, intensity=20.0, casts_shadow=True
        )
    )
    scene.camera = wd.Camera.look_at((0.0, 9.0, 0.1), (0.0, 0.0, 0.0), vertical_fov_deg=70.0)
    factor, whole = share(scene, rung, device)
    lit = whole["diffuse"][..., 1] > 0.0
    behind = whole["position"][..., 2] > 0.0
    assert lit.sum() > 100 and (lit & behind).sum() == 0
    assert np.all(np.isfinite(factor[lit])) and (factor[lit] == 0.0).any() and (factor[lit] == 1.0).mean() > 0.7
    if rung == "ray_traced":
        return
    # Beyond the distance up to which a directional light's maps reach, everything is lit.
    scene = plate_scene("directional")
    factor, whole = share(scene, rung, device, "shadow.distance_m=0.5")
    assert np.all(factor[whole["diffuse"][..., 1] > 0.0] == 1.0)


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_s6_a_face_turned_away_gets_nothing(kind, device):
    scene = wd.Scene()
    scene.add(sphere(24, 1.0), material=CLAY)
    add_light(scene, kind)
    scene.camera = wd.Camera.look_at((-2.0, 0.3, 1.5), (0.0, 0.0, 0.0))
    for rung in RUNGS:
        shaded = render(scene, rung, device)
        away = np.einsum("yxc,yxc->yx", shaded["normal"], to_light(kind, shaded["position"])) <= 0.0
        assert away.sum() > 200
        assert not shaded["diffuse"][away].any() and not shaded["light_count"][away].any()


def test_s10_nothing_to_cast_and_a_light_inside_a_mesh(device):
    for rung in RUNGS:
        # A light inside a closed box lights its inner walls and nothing outside; all is finite.
        scene = wd.Scene()
        two_sided = wd.Material(model="lambert", two_sided=True)
        scene.add(box(2.0), transform=tilt(move=(0.0, 1.0, 0.0)), material=two_sided)
        scene.add(grid(1, 20.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, -1.0, 0.0)), material=CLAY)
        scene.lights.add(wd.PointLight(position=(0.0, 1.0, 0.0), intensity=5.0, casts_shadow=True))
        scene.camera = wd.Camera.look_at((4.0, 3.0, 5.0), (0.0, 0.0, 0.0))
        outside = render(scene, rung, device)["diffuse"]
        assert np.isfinite(outside).all() and not outside.any()
        scene.camera = wd.Camera.look_at((0.6, 1.2, 0.5), (-1.0, 0.6, -1.0))
        inside = share(scene, rung, device)[0]
        assert np.isfinite(inside).all() and np.mean(inside == 1.0) > 0.9
        # Lights, but no triangle.
        empty = wd.Scene()
        add_light(empty, "point")
        add_light(empty, "directional")
        empty.camera = scene.camera
        assert not render(empty, rung, device, names=("diffuse",))["diffuse"].any()


@pytest.mark.parametrize("rung", ["pcf", "ray_traced"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_numbers_on_the_device_leave_the_others_alone(bad, rung, device):
    scene = mixed_scene()
    clean = mixed_scene()
    clean.lights.point.intensity = np.zeros(1)
    expected = render(clean, rung, device)
    scene.lights.point.position = wp.array([[bad, 1.0, 0.0]], dtype=wp.vec3, device=device)
    assert_same(render(scene, rung, device), expected)
    # A caster that cannot be placed casts nothing.
    scene, missing = plate_scene("spot"), plate_scene("spot")
    scene.add(box(0.7), material=CLAY)
    poses = np.stack([i.transform for i in scene.instances]).astype(np.float32)
    poses[2, 0, 3] = bad
    scene.bind_transforms(wp.array(poses, dtype=wp.float32, device=device))
    assert_same(render(scene, rung, device), render(missing, rung, device))


def test_shadows_far_from_the_origin_are_the_same(device):
    near = render(plate_scene("spot"), "pcf", device)["diffuse"]
    scene = plate_scene("spot")
    shift = np.array([3e6, -1e6, 2e6])
    for instance in scene.instances:
        matrix = instance.transform.copy()
        matrix[:3, 3] += shift
        instance.transform = matrix
    scene.lights.spot.position = scene.lights.spot.position + shift
    scene.camera = scene.camera.replace(position=tuple(np.array(scene.camera.position) + shift))
    assert np.abs(render(scene, "pcf", device)["diffuse"] - near).max() < 1e-4


@pytest.mark.parametrize("rung", MAPS)
def test_an_orthographic_camera_sees_the_same_shadow(rung, device):
    scene = plate_scene("directional")
    scene.camera = wd.Camera.look_at(
        (-1.2, 3.0, 2.6), (-0.2, 0.0, 0.0), projection="orthographic", vertical_extent=4.0, near=-5.0, far=50.0
    )
    factor, whole = share(scene, rung, device)
    floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
    miss = past_edge("directional", whole["position"].astype(float))
    assert np.all(factor[floor & (miss > 0.25)] == 1.0) and np.all(factor[floor & (miss < -0.25)] == 0.0)
    assert (floor & (miss < -0.25)).sum() > 50


@pytest.mark.parametrize("angle_deg", [1.0, 2.0, 5.0, 10.0])
def test_rungs_keep_their_bounds_against_the_closed_form(angle_deg, device):
    """The bounds are those that `ShadowSettings.rung` states."""
    assert wd.Settings().shadow.samples == 256
    rays, place = edge_errors("ray_traced", angle_deg, device, "shadow.samples=256")
    inside = np.abs(place) < 1.0
    # Half the penumbra [m]; the one map's texels are 8 mm, so 4 of them are 0.9 of it at 5 degrees.
    half = 0.4 * np.tan(np.radians(angle_deg))
    limit = max(2.0, 0.04 / half)
    assert inside.sum() > 100 and (place < -limit).sum() > 50 and (place > limit).sum() > 500
    assert not rays[np.abs(place) > 1.02].any()
    best = np.inf
    for rung in MAPS:
        error, place = edge_errors(rung, angle_deg, device)
        assert not error[np.abs(place) > limit].any(), rung
        best = min(best, np.sqrt(np.mean(error[inside] ** 2)))
        if rung == "pcss":
            assert np.mean(np.abs(error[inside])) <= 0.1
    assert np.sqrt(np.mean(rays[inside] ** 2)) <= min(0.25 * best, 0.001)
    for samples, bound in ((64, 0.003), (16, 0.01)):
        error, _ = edge_errors("ray_traced", angle_deg, device, f"shadow.samples={samples}")
        assert np.sqrt(np.mean(error[inside] ** 2)) <= bound, samples


def test_rays_tell_an_edge_of_any_direction(device):
    """Bounds from float64: 0.0006 over all directions, 0.0027 along the lattice itself, at 31.7 degrees."""
    squares = []
    for turn_deg in (0.0, 17.0, 31.7, 45.0, 58.3, 80.0):
        errors, place = edge_errors("ray_traced", 10.0, device, "shadow.samples=256", turn_deg=turn_deg)
        inside = np.abs(place) < 1.0
        assert inside.sum() > 500 and not errors[np.abs(place) > 1.02].any()
        squares.append(np.mean(errors[inside] ** 2))
    assert np.sqrt(np.max(squares)) <= 0.003 and np.sqrt(np.mean(squares)) <= 0.0015, np.sqrt(squares)


@pytest.mark.parametrize("rung", RUNGS)
def test_alpha_masks_shape_shadows(rung, device):
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[:, 4:, 3] = 0
    texture = wd.Texture(pixels, wrap=("clamp", "clamp"))
    half = wd.Material(model="lambert", base_color_texture=texture, alpha_mode="mask", two_sided=True)
    factors = []
    for material, size in ((half, 1.0), (CLAY, 0.5)):
        scene = wd.Scene()
        scene.add(grid(1, 8.0), transform=tilt(-90.0), material=CLAY)
        # The half that is there is the left one; the other scene has a plate in its place.
        stretch = (size, 1.0, 1.0)
        scene.add(grid(1, 1.0), transform=tilt(-90.0, 0.0, stretch, (size / 2 - 0.5, 1.0, 0.0)), material=material)
        add_light(scene, "spot")
        scene.camera = plate_scene("spot").camera
        factor, whole = share(scene, rung, device)
        floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
        factors.append(np.where(floor, factor, np.nan))
    both = np.isfinite(factors[0]) & np.isfinite(factors[1])
    assert (factors[1][both] == 0.0).sum() > 30
    assert np.mean(np.abs(factors[0] - factors[1])[both] > 1e-6) < 0.002


@pytest.mark.parametrize("rung", ["hard", "ray_traced"])
def test_culled_sides_cast_nothing(rung, device):
    # The plate faces up, towards the light: culling back sides keeps its shadow, culling front ones drops it. A
    # mirroring transform turns no face round.
    for mirror in (1.0, -1.0):
        scene = plate_scene("spot")
        matrix = scene.instances[1].transform.copy()
        matrix[:3, 0] *= mirror
        scene.instances[1].transform = matrix
        shadows = {cull: share(scene, rung, device, f"shadow.cull={cull}")[0] for cull in ("none", "back", "front")}
        dark = shadows["none"] == 0.0
        assert dark.sum() > 100
        assert np.array_equal(shadows["back"], shadows["none"], equal_nan=True)
        assert np.all(shadows["front"][dark] == 1.0)


@pytest.mark.parametrize("rung", ["hard", "ray_traced"])
def test_bound_points_move_their_shadow(rung, device):
    scene = plate_scene("spot")
    plate = scene.instances[1].mesh
    start = plate.positions.copy()
    bound = wp.array(start, dtype=wp.vec3, device=device)
    scene.bind_points(plate, bound)
    renderer = wd.Renderer(scene, width=96, height=72, device=device, outputs=("diffuse",), settings=with_rung(rung))
    renderer.render()
    renderer.render()
    for shift in ((0.4, 0.2, -0.3), (-0.5, 0.0, 0.2)):
        moved = start + np.array(shift, np.float32)
        bound.assign(moved)
        fresh = plate_scene("spot")
        still = wd.Scene()
        still.add(fresh.instances[0].mesh, transform=fresh.instances[0].transform, material=CLAY)
        mesh = wd.Mesh(moved, plate.triangles)
        still.add(mesh, transform=fresh.instances[1].transform, material=CLAY)
        add_light(still, "spot")
        still.camera = fresh.camera
        expected = render(still, rung, device, names=("diffuse",))["diffuse"]
        got = images(renderer.render())["diffuse"]
        assert np.mean(np.abs(got - expected) > 1e-4) < 0.003
    # A vertex that is not finite takes its faces along, not the others.
    moved[0] = np.nan
    bound.assign(moved)
    assert np.isfinite(images(renderer.render())["diffuse"]).all()
