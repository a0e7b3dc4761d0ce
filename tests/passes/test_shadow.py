"""Shadows end to end: where they fall, where they must not, and that nothing else about a frame changes.

What a light adds with a rung divided by what it adds with `off` is the share of it that arrives. Scenes are analytic:
a plate or a box over a floor, so that the ray from a pixel to the light says whether it is in shadow, and how far from
the shadow's edge it is. A light seen past the edge by more than the stated bound must arrive whole to the bit.
"""

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from builders import LAYERS, Spy, assert_same, box, gallery, grid, images, sphere, tilt

import warp_deferred as wd

CLAY = wd.Material(model="lambert", base_color=(0.8, 0.8, 0.8, 1.0))
SMALL = (
    "shadow.directional_size=512", "shadow.spot_size=256", "shadow.point_size=128", "shadow.samples=16",
    "gbuffer.rung=full",
)  # fmt: skip
MAPS = ("hard", "pcf", "pcss")
RUNGS = (*MAPS, "ray_traced")
NAMES = ("diffuse", "position", "normal", "light_count")
#: Where the lights of the test scenes stand, and where they shine.
PLACE, TOWARDS = np.array([1.5, 4.0, 1.0]), np.array([-1.5, -4.0, -1.0])


def with_rung(rung, *values):
    return wd.Settings().with_values([*SMALL, f"shadow.rung={rung}", *values])


def render(scene, rung, device, *values, names=NAMES, size=(96, 72), **fields):
    renderer = wd.Renderer(
        scene, width=size[0], height=size[1], device=device, outputs=names, settings=with_rung(rung, *values), **fields
    )
    return images(renderer.render())


def share(scene, rung, device, *values, **fields):
    """Share of the light that arrives, NaN where none would; and the images of the frame without shadows."""
    whole = render(scene, "off", device, *values, **fields)
    shaded = render(scene, rung, device, *values, **fields)
    with np.errstate(invalid="ignore", divide="ignore"):
        return shaded["diffuse"][..., 1] / whole["diffuse"][..., 1], whole


def add_light(scene, kind, **fields):
    """Add one white light that casts shadows."""
    fields = {"casts_shadow": True, "source_radius": 0.02} | fields
    if kind == "directional":
        fields.pop("source_radius")
        scene.lights.add(wd.DirectionalLight(direction=TOWARDS, intensity=2.0, **fields))
    elif kind == "point":
        scene.lights.add(wd.PointLight(position=PLACE, intensity=30.0, **fields))
    else:
        angle = {"spot": 0.7, "wide spot": 1.5}[kind]
        scene.lights.add(
            wd.SpotLight(position=PLACE, direction=TOWARDS, intensity=30.0, **{"outer_angle": angle} | fields)
        )


def plate_scene(kind, **fields):
    """Return a floor with a square plate of side 1 at height 1."""
    scene = wd.Scene()
    scene.add(grid(1, 8.0), transform=tilt(-90.0), material=CLAY)
    scene.add(grid(2, 1.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, 1.0, 0.0)), material=CLAY)
    add_light(scene, kind, **fields)
    scene.camera = wd.Camera.look_at((-1.2, 3.0, 2.6), (-0.2, 0.0, 0.0), vertical_fov_deg=50.0)
    return scene


def to_light(kind, points):
    """Vectors from points to the test scenes' light."""
    return PLACE - points if kind != "directional" else np.broadcast_to(-TOWARDS, points.shape)


def past_edge(kind, floor):
    """Distance [m], in the plate's plane, by which the ray to the light misses the plate; negative: it hits."""
    ray = to_light(kind, floor)
    at_plate = floor + ray / ray[..., 1:2]
    return np.maximum(np.abs(at_plate[..., 0]), np.abs(at_plate[..., 2])) - 0.5


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
@pytest.mark.parametrize("codec", [(), ("gbuffer.rung=compact", "gbuffer.normal=rgb8")], ids=["full", "rgb8"])
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


def mixed_scene():
    """Return a scene with a light of every kind, all casting, over shapes that shadow one another."""
    scene = plate_scene("directional")
    scene.add(box(0.6), transform=tilt(0.0, 30.0, 1.0, (1.2, 0.3, -0.6)), material=CLAY)
    for kind in ("point", "spot", "wide spot"):
        add_light(scene, kind)
    scene.lights.point.position = np.array([[-1.4, 2.0, 1.2]])
    return scene


@pytest.mark.parametrize("rung", MAPS)
def test_maps_of_all_sizes_go_with_the_cameras_views(rung, device):
    scene = mixed_scene()
    names = tuple(n for n in LAYERS if n not in ("color", "light_count"))
    together = render(scene, rung, device, names=names)
    assert_same(together, render(scene, "off", device, names=names), set(names) - {"diffuse", "specular"})
    parts = []
    for kept in range(4):
        alone = mixed_scene()
        for (_, group), count in zip(alone.lights.groups(), (1, 2, 1), strict=True):
            start = {1: 0, 2: 1}[count] if group is not alone.lights.directional else 3
            group.intensity = np.where(np.arange(start, start + count) == kept, group.intensity, 0.0)
        parts.append(render(alone, rung, device, names=names)["diffuse"])
    total = sum(parts[1:], parts[0])
    assert np.abs(total - together["diffuse"]).max() <= 4e-6 * total.max()


@pytest.mark.parametrize("rung", RUNGS)
def test_threads_and_bins_give_the_same_bits(rung, device):
    scene = mixed_scene()
    one = render(scene, rung, device, threads=1)
    for threads, bins in ((2, "off"), (3, "off"), (1, "on")):
        assert_same(one, render(scene, rung, device, f"raster.bins={bins}", threads=threads))


@pytest.mark.parametrize("rung", ["pcf", "ray_traced"])
def test_several_cameras_and_worlds_share_maps_as_needed(rung, device):
    scene = plate_scene("directional")
    add_light(scene, "spot")
    add_light(scene, "point", world=1)
    for world in range(3):
        scene.add(box(0.5), transform=tilt(move=(1.2 * world - 1.2, 0.25, 0.8)), material=CLAY, world=world)
    poses = [scene.camera.replace(world=w) for w in (0, 1, 2, 1)]
    poses.append(wd.Camera.look_at((2.0, 2.5, 2.0), (0.0, 0.0, 0.0), world=-1))
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung(rung))
    batch = renderer.render(poses)
    # Cascades of five cameras, a spot light seen in four worlds, a point light of one.
    assert renderer.plan.request.shadow_slots == (5 * 4 + 4 * 1 + 6 if rung == "pcf" else 0)
    frames = [images(batch, k) for k in range(5)]
    for pose, expected in zip(poses, frames, strict=True):
        assert_same(images(renderer.render(pose)), expected)


def test_a_light_moved_by_a_device_array_moves_its_shadow(device):
    scene = plate_scene("point")
    renderer = wd.Renderer(scene, width=96, height=72, device=device, outputs=NAMES, settings=with_rung("pcf"))
    renderer.render()
    scene.lights.point.position = wp.array([[-1.4, 3.5, -0.8]], dtype=wp.vec3, device=device)
    renderer.render()
    with Spy() as spy:
        scene.lights.point.position.assign(np.array([[-1.0, 3.0, 0.5]], np.float32))
        moved = images(renderer.render())
    assert not spy.plans and not spy.loaded and not spy.kernels
    still = plate_scene("point")
    still.lights.point.position = np.array([[-1.0, 3.0, 0.5]])
    assert_same(moved, render(still, "pcf", device))
    assert not np.array_equal(moved["diffuse"], render(plate_scene("point"), "pcf", device)["diffuse"])


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


def cascade_keys(renderer):
    keys = renderer.plan.resources.channels["depth_keys"]
    return keys.numpy().copy(), renderer.plan.resources.frame.views.numpy()[1:]


def test_cascades_stand_still_while_the_camera_moves_a_little(device):
    scene = plate_scene("directional")
    scene.add(sphere(12, 0.4), transform=tilt(move=(0.8, 0.9, 0.3)), material=CLAY)
    names = ("diffuse",)
    renderer = wd.Renderer(scene, width=96, height=72, device=device, outputs=names, settings=with_rung("hard"),
                           share_memory=False)  # fmt: skip
    renderer.render()
    keys, views = cascade_keys(renderer)
    assert (keys > 0).any()
    same = 0
    for k in range(1, 9):
        # Less than a hundredth of the smallest texel a step.
        step = 1e-5 * k * np.array([1.0, -0.5, 0.7])
        renderer.render(scene.camera.replace(position=tuple(np.array(scene.camera.position) + step)))
        moved, places = cascade_keys(renderer)
        assert np.array_equal(places["scale"], views["scale"]) and np.array_equal(places["far"], views["far"])
        for c in range(4):
            if np.array_equal(places["origin"][c], views["origin"][c]):
                same += 1
                part = slice(512 * 512 * c, 512 * 512 * (c + 1))
                assert np.array_equal(moved[part], keys[part])
            else:
                # It moved by whole texels along the map's own axes.
                shift = places["rotation"][c] @ (places["origin"][c] - views["origin"][c])
                texels = shift * places["scale"][c][0]
                assert np.abs(texels - np.round(texels)).max() < 1e-3 and np.abs(texels).max() < 1.5
    assert same >= 24
    # Turning keeps every texel's size.
    renderer.render(wd.Camera.look_at(scene.camera.position, (0.9, 0.0, -0.4), vertical_fov_deg=50.0))
    assert np.array_equal(cascade_keys(renderer)[1]["scale"], views["scale"])


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


def test_without_a_casting_light_nothing_of_it_is_there(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS)
    plain = images(renderer.render())
    plan = renderer.plan
    assert "shadow" not in [p.name for p in plan.passes] and plan.request.shadow_slots == 0
    assert not any(n.startswith(("shadow", "depth_keys")) for n in plan.memory)
    keys = {kernel.key for kernel, _ in plan.resources.program.kernels}
    assert not any("slot" in key or "bound_instances" in key for key in keys)
    # Forced, it changes no bit.
    for rung in RUNGS:
        settings = wd.Settings().with_values(["shadow.when=always", f"shadow.rung={rung}"])
        forced = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=settings)
        assert_same(images(forced.render()), plain)
        assert "shadow" in [p.name for p in forced.plan.passes]
    # Nor is it there where nothing lit is asked for, or the rung is off.
    scene.lights.spot.casts_shadow = np.ones(2, bool)
    depth = wd.Renderer(scene, width=64, height=48, device=device, outputs=("depth",))
    depth.render()
    assert depth.plan.request.shadow_slots == 0
    off = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS,
                      settings=wd.Settings().with_values(["shadow.rung=off"]))  # fmt: skip
    assert_same(images(off.render()), plain)


def test_lights_past_the_capacity_are_counted_and_lit(device):
    scene = plate_scene("spot")
    add_light(scene, "spot")
    scene.lights.spot.position = np.stack([PLACE, PLACE + np.array([0.3, 0.0, 0.0])])
    values = ("shadow.spot_lights=1",)
    renderer = wd.Renderer(
        scene, width=96, height=72, device=device, outputs=NAMES, settings=with_rung("hard", *values)
    )
    limited = images(renderer.render())
    assert "2 lights cast shadows; 1 past the capacity, without" in str(renderer.explain(measure=False))
    scene.lights.spot.casts_shadow = np.array([True, False])
    assert_same(limited, render(scene, "hard", device))


def test_a_frame_with_shadows_allocates_and_compiles_nothing(device):
    scene = mixed_scene()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung("pcss"))
    renderer.render()
    before = images(renderer.render())
    with Spy() as spy:
        scene.lights.spot.position = scene.lights.spot.position + 0.1
        scene.camera = scene.camera.replace(position=(-1.0, 3.0, 2.0))
        renderer.render()
    spy.assert_nothing()
    assert before["diffuse"].any()


def edge_scene():
    """Return a floor under the straight edge of a plate, x = 0, 0.4 m above it, lit from straight above."""
    scene = wd.Scene()
    scene.add(grid(1, 4.0), transform=tilt(-90.0), material=CLAY)
    scene.add(grid(1, 3.0), transform=tilt(-90.0, move=(-1.5, 0.4, 0.0)), material=CLAY)
    scene.lights.add(wd.DirectionalLight(direction=(0.0, -1.0, 0.0), intensity=2.0, casts_shadow=True))
    scene.camera = wd.Camera.look_at((0.9, 0.35, 0.0), (-0.05, 0.0, 0.0), vertical_fov_deg=30.0)
    return scene


def edge_errors(rung, angle_deg, device, *values):
    """Difference from the closed form, and the distance from the edge in units of the half penumbra."""
    values = (f"shadow.directional_angle_deg={angle_deg}", "shadow.cascades=1", "shadow.distance_m=2.0", *values)
    factor, whole = share(edge_scene(), rung, device, *values, size=(144, 108))
    # What the one map holds.
    floor = (np.abs(whole["position"][..., 1]) < 1e-3) & (whole["diffuse"][..., 1] > 0.0)
    floor &= np.abs(whole["position"][..., 0]) < 0.6
    place = whole["position"][..., 0][floor] / (0.4 * np.tan(np.radians(angle_deg)))
    d = np.clip(place, -1.0, 1.0)
    seen = 0.5 + (d * np.sqrt(1.0 - d * d) + np.arcsin(d)) / np.pi
    return factor[floor] - seen, place


@pytest.mark.parametrize("angle_deg", [5.0, 10.0])
def test_rungs_keep_their_bounds_against_the_closed_form(angle_deg, device):
    """The bounds are those that `ShadowSettings.rung` states."""
    rays, place = edge_errors("ray_traced", angle_deg, device, "shadow.samples=256")
    inside = np.abs(place) < 1.0
    assert inside.sum() > 300 and (place < -2.0).sum() > 50 and (place > 2.0).sum() > 500
    assert not rays[np.abs(place) > 1.02].any()
    best = np.inf
    for rung in MAPS:
        error, place = edge_errors(rung, angle_deg, device)
        # The one map's texels are 8 mm: 4 of them are 0.9 of the narrower half penumbra.
        assert not error[np.abs(place) > 2.0].any(), rung
        best = min(best, np.sqrt(np.mean(error[inside] ** 2)))
        if rung == "pcss":
            assert np.mean(np.abs(error[inside])) <= 0.1
    assert np.sqrt(np.mean(rays[inside] ** 2)) <= min(0.25 * best, 0.5 / 16.0)


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


def drawn(renderer):
    """Which maps the last frame drew anew."""
    count = renderer.plan.request.shadow_slots
    return renderer.plan.resources.frame.views.numpy()["skipped"][-count:] == 0


@pytest.mark.parametrize("threads", [1, 2])
def test_maps_stay_while_neither_their_light_nor_a_caster_moves(threads, device):
    scene = mixed_scene()
    names, settings = ("diffuse",), with_rung("pcf")
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=names, settings=settings, threads=threads)
    # Point, spot, wide spot, four cascades.
    point, spot, wide, cascades = slice(0, 6), slice(6, 7), slice(7, 13), slice(13, 17)

    def check(*expected):
        """Render; the expected maps are drawn, the picture is that of a renderer that never kept any."""
        frame = images(renderer.render())
        fresh = wd.Renderer(scene, width=64, height=48, device=device, outputs=names, settings=settings)
        assert_same(frame, images(fresh.render()))
        marks = np.zeros(17, bool)
        for part in expected:
            marks[part] = True
        return np.array_equal(drawn(renderer), marks)

    everything = slice(0, 17)
    assert check(everything)
    assert check() and check()
    # A light moves: its maps alone. Another colour moves nothing.
    scene.lights.spot.position = scene.lights.spot.position + np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert check(spot)
    scene.lights.spot.color = np.array([[1.0, 0.5, 0.2], [0.3, 1.0, 0.4]])
    assert check()
    # The camera leaps: cascades alone.
    scene.camera = scene.camera.replace(position=(-0.2, 2.6, 2.2))
    assert check(cascades)
    # A caster moves in some maps; where it left counts as well as where it went, and it may come back.
    box_at = scene.instances[2].transform
    scene.instances[2].transform = tilt(0.0, 30.0, 1.0, (1.3, 0.3, -0.6))
    check()
    some = drawn(renderer)
    assert some.any() and not some.all()
    assert check()
    scene.instances[2].transform = tilt(0.0, 30.0, 1.0, (1.3, -900.0, -0.6))
    check()
    assert drawn(renderer)[point].any() and drawn(renderer)[wide].any()
    scene.instances[2].transform = box_at
    check()
    # A light goes out and comes back after a caster moved unseen.
    place = np.array(scene.lights.point.position)
    scene.lights.point.position = wp.array([[np.nan, 0.0, 0.0]], dtype=wp.vec3, device=device)
    check()
    assert not drawn(renderer)[point].any()
    scene.instances[1].transform = tilt(-90.0, 0.0, 1.0, (0.1, 1.1, 0.0))
    check()
    scene.lights.point.position = wp.array(place.astype(np.float32), dtype=wp.vec3, device=device)
    check()
    assert drawn(renderer)[point].all()


def test_maps_are_drawn_every_frame_where_they_are_not_kept(device):
    scene = mixed_scene()
    kept = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung("pcf"))
    settings = with_rung("pcf", "shadow.keep_maps=false")
    plain = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=settings)
    for _ in range(2):
        assert_same(images(kept.render()), images(plain.render()))
    assert drawn(plain).all() and not drawn(kept).any()
    # Another set of casting lights is another set of maps; the old ones do not show.
    scene.lights.spot.casts_shadow = np.array([True, False])
    assert_same(images(kept.render()), images(plain.render()))
    scene.lights.spot.casts_shadow = np.array([False, True])
    assert_same(images(kept.render()), images(plain.render()))
    scene.lights.spot.casts_shadow = np.array([True, True])
    assert_same(images(kept.render()), images(plain.render()))


@pytest.mark.parametrize("rung", ["pcf", "ray_traced"])
def test_samples_share_the_maps_of_their_frame(rung, device):
    scene = mixed_scene()
    values = ("anti_aliasing.rung=samples_4",)
    whole = render(scene, "off", device, *values, names=("diffuse",))["diffuse"]
    kept = render(scene, rung, device, *values, names=("diffuse",))["diffuse"]
    plain = render(scene, rung, device, *values, "shadow.keep_maps=false", names=("diffuse",))["diffuse"]
    one = render(scene, rung, device, names=("diffuse",))["diffuse"]
    assert np.array_equal(kept, plain)
    assert (kept < whole - 1e-6).mean() > 0.1 and np.all(kept <= whole + 1e-6)
    # The average over a pixel is what its centre shows, but for the edges.
    assert np.mean(np.abs(kept - one) > 0.05 * whole.max()) < 0.08
    renderer = wd.Renderer(
        scene, width=96, height=72, device=device, outputs=("diffuse",), settings=with_rung(rung, *values)
    )
    for _ in range(2):
        assert np.array_equal(images(renderer.render())["diffuse"], kept)


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


def test_nothing_of_it_is_imported_without_a_casting_light():
    script = """
import sys
import warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_deferred as wd
scene = wd.load("lambert_plane")
for casts in (False, True):
    scene.lights.point.casts_shadow = [casts]
    wd.Renderer(scene, width=16, height=16, device="cpu").render()
    parts = [name.split(".") for name in sys.modules if name.startswith("warp_deferred.")]
    found = [p for p in parts if "shadow" in p[-1] and p[1] in ("kernels", "passes")]
    assert bool(found) == casts, (casts, found)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_other_passes_pay_nothing_for_the_maps(device):
    scene = mixed_scene()
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    scene.camera = scene.camera.replace(bloom=0.5)
    plans = []
    for rung in ("off", "pcf"):
        renderer = wd.Renderer(
            scene, width=64, height=48, device=device, outputs=("display",), settings=with_rung(rung)
        )
        renderer.render()
        plans.append(renderer.plan)
    own = ("shadow", "depth_keys", "slice_depth_keys", "pairs", "work_entries", "bin_", "large_triangles")
    for name, size in plans[0].memory.items():
        if not name.startswith(own):
            assert plans[1].memory[name] == size, name
    for stage in plans[0].passes:
        other = next(s for s in plans[1].passes if s.name == stage.name)
        # Resolve's estimate knows only how many triangles all views may draw.
        if stage.name not in ("clusters", "raster", "resolve"):
            assert other.bytes_moved() == stage.bytes_moved(), stage.name
